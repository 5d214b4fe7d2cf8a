"""OpenPBR materials drawn by the shaders that MaterialX makes of them, beside the formulas of their loss."""

from dataclasses import replace

import numpy as np
import pytest
import viewer_pages
from textured_ball import textured_ball

from nishiki.brdf.slopes import isotropic_lobe
from nishiki.colour.colour import decode, encode
from nishiki.formats.textured_surface import SurfaceLook, write_materialx
from nishiki.installation import is_installed
from nishiki.stages.export.object_look import SeenPoints, show_in

pytestmark = [
    pytest.mark.slow,  # a software rasteriser compiles a shader of 100,000 characters
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=str(viewer_pages.missing())),
    pytest.mark.skipif(not is_installed("materialx"), reason="materialx is not installed (extra export)"),
]
ROWS, COLUMNS = 12, 20
VIEW = np.array([0.0, 0.0, 1.0])
LIGHTS = [np.array(light) / np.linalg.norm(light) for light in ((0.1, 0.2, 0.97), (0.5, 0.3, 0.81), (-0.7, 0.3, 0.65))]


def decibels(theirs, ours):
    """PSNR of sRGB-coded values, peak 1."""
    coded = (np.clip(encode(each, "srgb"), 0, 1) for each in (theirs, ours))
    return -10 * np.log10(np.mean(np.square(np.subtract(*coded))))


def formulas(look, normals, light):
    """(ROWS * COLUMNS, 3) what the loss is reckoned with, for textures of all inputs, seen along z."""
    base, weight = decode(look.colour.reshape(-1, 3) / 255, "srgb"), look.weight.ravel() / 255
    half = (light + VIEW) / np.linalg.norm(light + VIEW)
    cos_phi, cos_i, cos_r = (np.maximum(normals @ each, 0) for each in (half, light, VIEW))
    metal = np.broadcast_to(look.metallic, look.weight.shape).reshape(-1, 1) / 255
    normal = (weight * look.reflectance)[:, None]
    normal = normal + metal * (base - normal)
    reflected = normal + (1 - normal) * (1 - half[2]) ** 5
    gloss = np.pi * isotropic_lobe(cos_phi, cos_i, cos_r, (look.roughness.ravel() / 255) ** 2)
    return ((1 - metal) * (1 - reflected) * base + reflected * gloss[:, None]) * cos_i[:, None]


def test_colour_normals_roughness_and_weight_are_drawn_as_the_formulas_say(tmp_path):
    import materialx_page

    random = np.random.default_rng(1)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    colour = random.integers(20, 255, (ROWS, COLUMNS, 3)).astype(np.uint8)
    normals = random.normal(0, 0.3, (ROWS, COLUMNS, 3)) * [1, 1, 0] + VIEW
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    coded = np.rint((normals + 1) / 2 * 255).astype(np.uint8)
    roughness, weight = (60 + 5 * x).astype(np.uint8), (40 + 19 * y).astype(np.uint8)
    metallic = np.where(x < COLUMNS // 3, 255, 0).astype(np.uint8)
    weight = np.maximum(weight, metallic)
    look = SurfaceLook(colour, roughness, 0.08, weight=weight, normals=coded, metallic=metallic)
    told = coded.reshape(-1, 3) / 255 * 2 - 1
    told /= np.linalg.norm(told, axis=1, keepdims=True)
    write_materialx(tmp_path / "surface.mtlx", look, facts={})
    with materialx_page.opened(tmp_path / "surface.mtlx", ROWS, COLUMNS) as draw:
        for light in LIGHTS:
            theirs = draw(light).reshape(-1, 3)
            assert decibels(theirs, formulas(look, told, light)) > 50
            for wrong in (told * [-1, 1, 1], told * [1, -1, 1]):
                assert decibels(theirs, formulas(look, wrong, light)) < 40, "other normals show"
            assert decibels(theirs, formulas(replace(look, metallic=0.0), told, light)) < 40, "metals show"
            faint = replace(look, weight=np.full_like(weight, 10))
            assert decibels(theirs, formulas(faint, told, light)) < 40, "the strength of the gloss shows"


def test_an_object_is_drawn_on_its_own_mesh_as_the_formulas_say(tmp_path):
    import materialx_page

    look, mesh = textured_ball()
    write_materialx(tmp_path / "object.mtlx", look.surface(), facts={})
    camera = look.decoded.cameras[0]
    with materialx_page.opened_object(tmp_path / "object.mtlx", mesh, camera.rows, camera.columns) as draw:
        for view in (0, 1):
            points = SeenPoints.of(look, view)
            picture = draw(look.decoded.cameras[view], points.lamp.vector)
            covered = picture[..., 3] > 0
            assert np.mean(covered != points.covered) < 0.002
            # At grazing view the body of OpenPBR loses the gloss's mean over all lights, and is darker than ours.
            both = covered[points.covered] & (points.cosines()[2] > 0.5)
            theirs = picture[points.covered][both, :3]
            assert decibels(theirs, show_in(look, "materialx")(points)[both]) > 50
            dull = replace(look, specular=np.full_like(look.specular, 20))
            assert decibels(theirs, show_in(dull, "materialx")(points)[both]) < 40, "the strength of the gloss shows"
