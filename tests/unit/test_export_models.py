"""Our reflection model in tables of MERL and as a BSDF of Mitsuba."""

import importlib.util
import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from small_painting import PITCH_MM, exported_painting

from nishiki.brdf.torrance_sparrow import specular
from nishiki.colour.colour import illuminant, white_xyz, xyz_to_srgb_linear
from nishiki.render.plane.frame import render
from nishiki.render.plane.scene import Gloss, Light, PlaneScene, View


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The painting, the folder of its exports, and what the stage reports."""
    with exported_painting(tmp_path_factory.mktemp("painting"), ("merl", "mitsuba")) as made:
        yield made


def plane_scene(painting):
    """The painting as our own renderer takes it."""
    normals = np.where(painting.known[..., None], painting.normals, np.float32(0))
    height = np.where(painting.known, painting.height, np.nan).astype(np.float32)
    gloss = Gloss([[0.6]], [[0.25]], [1.45])
    fields = {"coefficients": painting.coefficients, "basis": painting.basis, "pitch": PITCH_MM}
    return PlaneScene(normals, gloss=gloss, height=height, **fields)


def merl_value(table, light, view):
    """The MERL database's look-up: (3,) of the cell that two unit vectors above the surface fall into."""
    half = (light + view) / np.linalg.norm(light + view)
    theta, phi = np.arccos(half[2]), np.arctan2(half[1], half[0])
    about_z = np.array([[np.cos(phi), np.sin(phi), 0], [-np.sin(phi), np.cos(phi), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(theta), 0, -np.sin(theta)], [0, 1, 0], [np.sin(theta), 0, np.cos(theta)]])
    difference = about_y @ about_z @ light
    turn = np.arctan2(difference[1], difference[0]) % np.pi
    row = int(np.sqrt(np.degrees(theta) * 90))
    column = int(np.degrees(np.arccos(np.clip(difference[2], -1, 1))))
    return table[:, row, column, min(int(np.degrees(turn)), 179)] * [1 / 1500, 1.15 / 1500, 1.66 / 1500]


def test_a_merl_table_holds_the_reflection_model(exported):
    content = (exported.folder / "merl/region-0.binary").read_bytes()
    assert np.frombuffer(content, "<i4", 3).tolist() == [90, 90, 180]
    table = np.frombuffer(content, "<f8", offset=12).reshape(3, 90, 90, 180)
    assert (table[:, 89, 80, 90] < 0).all()  # the light is below the surface
    gloss = json.loads((exported.folder / "mitsuba/scene.json").read_text())["gloss"]
    beta, gamma = (np.array([float(v) for v in gloss[name].split()]) for name in ("beta", "gamma"))
    random, up = np.random.default_rng(0), np.array([0, 0, 1.0])
    errors = []
    for _ in range(400):
        light, view = random.normal((0, 0, 1.2), 1, size=(2, 3))
        light, view = light / np.linalg.norm(light), view / np.linalg.norm(view)
        if min(light[2], view[2]) < 0.3:
            continue
        value = merl_value(table, light, view)
        lobes = sum(
            specular(up, light, view, beta=b, gamma=g, refractive_index=gloss["index"])
            for b, g in zip(beta, gamma, strict=True)
        )
        body = value * np.pi - lobes / light[2]  # the colour, but for the surface's loss and the cells' size
        errors.append(body)
    body = np.median(errors, axis=0)
    with OpenEXR.File(str(exported.folder / "mitsuba/albedo.exr"), separate_channels=True) as file:
        colour = np.stack([file.channels()[name].pixels for name in "RGB"], axis=-1)
    srgb = colour[exported.painting.known].mean(axis=0)
    np.testing.assert_allclose(body, srgb, rtol=0.1)
    assert np.percentile(np.abs(errors - body), 90) < 0.1 * body.mean()


@pytest.fixture(scope="module")
def nishiki_paint(exported):
    """The exported module of Mitsuba, with a variant set."""
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (group path-tracing)")
    mitsuba.set_variant("scalar_rgb")
    spec = importlib.util.spec_from_file_location("nishiki_paint", exported.folder / "mitsuba/nishiki_paint.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("lamp", [(0.6, 0.1, 0.79), (-0.1, -0.05, 0.99)])
def test_mitsuba_renders_what_we_render(exported, nishiki_paint, lamp):
    import mitsuba

    painting = exported.painting
    folder = exported.folder / "mitsuba"
    flat = np.array(mitsuba.render(nishiki_paint.load([lamp], relief=False, samples=1, folder=folder)))
    light = Light(direction=lamp, spectrum=illuminant("D65"))
    scene = replace(plane_scene(painting), height=None)
    d65 = white_xyz(illuminant("D65"))
    ours = xyz_to_srgb_linear(render(scene, [light], View()).xyz, white=d65)
    known = painting.known & (ours.min(axis=-1) > 0.01)
    np.testing.assert_allclose(flat[known], ours[known], rtol=0.01)
    assert known.mean() > 0.9
    relief = np.array(mitsuba.render(nishiki_paint.load([lamp], samples=1, folder=folder)))
    inner = known.copy()
    inner[[0, -1]] = inner[:, [0, -1]] = False
    assert np.median(np.abs(relief[inner] - ours[inner])) < 0.01
