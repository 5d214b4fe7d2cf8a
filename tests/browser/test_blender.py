"""Exported files in Blender's Cycles: their light is that of the formulas that the loss is reckoned with."""

from dataclasses import replace

import blender_scene
import numpy as np
import pytest
from small_painting import COLUMNS, PITCH_MM, ROWS, export_context, small_painting
from textured_ball import textured_ball

from nishiki.colour.colour import decode, encode
from nishiki.formats.textured_surface import write_usdz
from nishiki.installation import is_installed
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.object_look import SeenPoints, show_in
from nishiki.stages.export.painting import run
from nishiki.stages.export.scene import ExportedScene

pytestmark = pytest.mark.skipif(blender_scene.missing() is not None, reason=str(blender_scene.missing()))
LAMPS = [np.array(lamp) / np.linalg.norm(lamp) for lamp in ((0.5, 0.3, 0.81), (-0.6, 0.1, 0.8), (0.1, 0.1, 1))]


def decibels(theirs, ours):
    """PSNR of sRGB-coded values, peak 1."""
    coded = (np.clip(encode(np.clip(each, 0, 1), "srgb"), 0, 1) for each in (theirs, ours))
    return -10 * np.log10(np.mean(np.square(np.subtract(*coded))))


def test_a_painting_of_two_finishes_is_drawn_as_the_formulas_say_and_stands_where_it_should(tmp_path):
    regions = np.zeros((ROWS, COLUMNS), np.uint8)
    regions[10:30, 20:51] = 1
    painting = small_painting(tmp_path, regions=regions)
    context = export_context(painting, tmp_path / "export", ExportSettings(formats=("gltf",)))
    with context.output as output:
        run(context)
        look = PaintingSurface(context, ExportedScene(painting.inputs)).look
        pictures = blender_scene.pictures(
            output.folder / "exports/painting.glb",
            blender_scene.above(ROWS, COLUMNS, PITCH_MM / 1000),
            [{"direction": lamp} for lamp in LAMPS],
            flat=True,
        )
    base = decode(look.colours.reshape(-1, 3) / 255, "srgb")
    normals = look.normals.reshape(-1, 3) / 255 * 2 - 1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    material = look.gloss.gltf.of(np.arange(ROWS), np.arange(COLUMNS))
    for lamp, picture in zip(LAMPS, pictures, strict=True):
        covered = picture[..., 3] > 0.99
        assert not (covered & ~painting.known)[:-1, 1:].any()  # triangles reach half a pixel
        assert covered[painting.known].mean() > 0.98
        compared = (covered & painting.known).ravel()
        drawn = picture[..., :3].reshape(-1, 3)[compared]
        assert decibels(drawn, material.render(base, normals, lamp)[compared]) > 55
        for wrong in (normals * [-1, 1, 1], normals * [1, -1, 1]):
            assert decibels(drawn, material.render(base, wrong, lamp)[compared]) < 40, "other normals show"
        other = look.gloss.gltf.materials[0].render(base, normals, lamp)
        assert decibels(drawn, other[compared]) < 40, "the gloss of each region shows"


@pytest.mark.skipif(not is_installed("usd-core"), reason="usd-core is not installed (extra export)")
def test_an_object_in_usd_is_drawn_from_captured_views_as_the_formulas_say(tmp_path):
    look, mesh = textured_ball()
    write_usdz(tmp_path / "object.usdz", mesh, look.with_mean_strength().surface(), name="ball", facts={})
    for view in (0, 1):
        points = SeenPoints.of(look, view)
        camera = blender_scene.pinhole(look.decoded.cameras[view], 1.0)
        (picture,) = blender_scene.pictures(
            tmp_path / "object.usdz", camera, [{"position": points.lamp.vector, "reference": 1.0}]
        )
        covered = picture[..., 3] > 0.99
        assert np.mean(covered != points.covered) < 0.005
        seen = picture[points.covered]
        squares = np.sum((points.positions - points.lamp.vector) ** 2, axis=1, keepdims=True)  # ours has no fall-off
        compared = (seen[:, 3] > 0.99) & (points.cosines()[2] > 0.5) & (seen[:, 0] > 0)
        drawn, expected = (seen[:, :3] * squares)[compared], show_in(look, "usd")(points)[compared]
        assert decibels(drawn, expected) > 45
        turned = replace(look, colour=np.ascontiguousarray(look.colour[::-1]))
        assert decibels(drawn, show_in(turned, "usd")(points)[compared]) < 30, "the places in the texture show"
