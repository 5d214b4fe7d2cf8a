"""A painting as glTF in three.js: the lobe, colours and normals of the file are drawn as its loss was reckoned."""

import numpy as np
import pytest
import three_page
import viewer_pages
from small_painting import PITCH_MM, export_context, small_painting

from nishiki.colour.colour import decode, encode
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.painting import run
from nishiki.stages.export.scene import ExportedScene

pytestmark = [
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=str(viewer_pages.missing())),
    pytest.mark.skipif(
        three_page.THREE is None, reason="the npm package three is not installed (set NODE_PATH to its folder)"
    ),
]


@pytest.mark.parametrize("gilded", [False, True], ids=["paint", "gilded"])
def test_three_draws_the_material_that_the_loss_is_reckoned_with(tmp_path, gilded):
    regions = np.pad(np.ones((20, 31), np.uint8), ((10, 15), (20, 9))) if gilded else None
    painting = small_painting(tmp_path, regions=regions, gilded=gilded)
    context = export_context(painting, tmp_path / "export", ExportSettings(formats=("gltf",)))
    with context.output as output:
        run(context)
        look = PaintingSurface(context, ExportedScene(painting.inputs)).look
        rows, columns = look.colours.shape[:2]
        with three_page.opened(output.folder / "exports" / "painting.glb") as draw:
            pictures = {
                lamp: draw(rows, columns, PITCH_MM / 1000, lamp) for lamp in ((0.5, 0.3, 0.81), (-0.9, 0.0, 0.44))
            }
    base = decode(look.colours.reshape(-1, 3) / 255, "srgb")
    normals = look.normals.reshape(-1, 3) / 255 * 2 - 1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    material = look.gloss.gltf.of(np.arange(rows), np.arange(columns))
    for lamp, picture in pictures.items():
        direction = np.array(lamp) / np.linalg.norm(lamp)
        expected = encode(material.render(base, normals, direction), "srgb").reshape(rows, columns, 3)
        covered = picture[..., 3] == 255
        assert np.mean(covered[painting.known]) > 0.98  # less at the unknown corner
        apart = np.abs(picture[..., :3] / 255 - np.clip(expected, 0, 1))[covered & painting.known]
        assert apart.mean() < 0.01  # three.js does not take the light of the gloss from the body: up to 0.04 of it
        assert np.percentile(apart, 99) < 0.03
        assert picture[covered, :3].std() > 10
