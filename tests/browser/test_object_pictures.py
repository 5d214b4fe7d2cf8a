"""The page of an object whose views are coded as pictures, in a real browser, against the renderer."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import viewer_pages
from coded_dome import coded_dome

from nishiki.render.display import encode_display
from nishiki.report.viewer.page import Blocks
from nishiki.stages.viewer.object import write_object

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=str(viewer_pages.missing())),
]


def test_views_coded_as_pictures_show_them_and_lend_to_views_between(tmp_path):
    decoded = coded_dome(tmp_path, pictures=True)
    blocks = Blocks(SimpleNamespace(path=lambda name: tmp_path / name), inline_bytes=10**8)
    about = {"title": "Ball", "scene": "ball", "key": "", "version": "", "unit": "mm"}
    write_object(decoded, blocks, about, without=frozenset())
    renderer, alone = (decoded.renderer(rim=0, model_only=only) for only in (False, True))
    plain = {"options": {}, "lamps": [], "ambient": 0, "layer": "appearance"}
    with viewer_pages.opened(tmp_path / "index.html", width=300, height=200) as page:
        for captured, shot in ((3, renderer.captured(3)), (9.5, renderer.between(9, 0.5))):
            picture, model = (next(each.render([shot])) for each in (renderer, alone))
            inner = cv2.erode(picture.covered.astype(np.uint8), np.ones((5, 5))) > 0
            want, without = (encode_display(each.linear).pixels for each in (picture, model))
            shown = page.picture(shot.camera.columns, shot.camera.rows, **plain, view={"captured": captured})
            apart = viewer_pages.difference(shown, want)[inner]
            assert inner.sum() > 3000
            assert apart.mean() < 0.15 * viewer_pages.difference(without, want)[inner].mean()
            print(captured, apart.mean(), np.median(apart), viewer_pages.difference(without, want)[inner].mean())
        place = np.argwhere(inner)[inner.sum() // 2].tolist()
        page.page.evaluate("nishiki.idle()")
        layer = page.picture(150, 130, **{**plain, "layer": "residual"}, view={"captured": 3})
        assert np.ptp(layer[place[0] - 10 : place[0] + 10].astype(int)) > 20
