"""Gilding in the viewer, drawn by its shader in Chromium as the stage render shows it."""

import numpy as np
import pytest
import viewer_pages
from small_painting import COLUMNS, ROWS, STAMP, small_painting

from nishiki.artifacts.artifact import ArtifactWriter
from nishiki.artifacts.stage import Context
from nishiki.progress import Progress
from nishiki.stages.viewer import ViewerSettings
from nishiki.stages.viewer import painting as viewer

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=str(viewer_pages.missing())),
]
GOLD = np.pad(np.ones((20, 31), np.uint8), ((10, 15), (20, 9)))
FRONTAL = {"x": 0, "y": 0, "zoom": 1, "tilt_deg": 0, "azimuth_deg": 0}


def test_gold_is_drawn_as_render_shows_it(tmp_path):
    painting = small_painting(tmp_path, regions=GOLD, gilded=True)
    paint = small_painting(tmp_path / "paint", regions=GOLD)
    scene, other = (viewer_pages.plane_scene(each.inputs) for each in (painting, paint))
    with ArtifactWriter(tmp_path / STAMP["key"]) as output:
        viewer.run(Context(painting.inputs, ViewerSettings(), output, None, None, STAMP, Progress("small/viewer")))
        with viewer_pages.opened(output.folder / "index.html") as shown:
            for azimuth, elevation in ((40, 75), (200, 55)):
                state = {"lamps": [viewer_pages.lamp(azimuth, elevation)], "ambient": 0.0, "exposure": 1.0}
                state["view"] = FRONTAL
                picture = shown.picture(COLUMNS, ROWS, **state).copy()
                gold = (GOLD == 1) & painting.known
                errors = [
                    np.percentile(viewer_pages.difference(picture, viewer_pages.rendered(each, state)[0])[gold], 99)
                    for each in (scene, other)
                ]
                assert errors[0] < 2
                assert errors[1] > 10
