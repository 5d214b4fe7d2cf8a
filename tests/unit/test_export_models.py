"""Our reflection model in tables of MERL."""

import json

import numpy as np
import OpenEXR
import pytest
from small_painting import exported_painting

from nishiki.brdf.torrance_sparrow import specular


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The painting, the folder of its exports, and what the stage reports."""
    with exported_painting(tmp_path_factory.mktemp("painting"), ("merl", "mitsuba")) as made:
        yield made


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
    (gloss,) = json.loads((exported.folder / "mitsuba/scene.json").read_text())["gloss"]["regions"]
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
            for b, g in zip(gloss["beta"], gloss["gamma"], strict=True)
        )
        body = value * np.pi - lobes / light[2]  # the colour, but for the surface's loss and the cells' size
        errors.append(body)
    body = np.median(errors, axis=0)
    with OpenEXR.File(str(exported.folder / "mitsuba/albedo.exr"), separate_channels=True) as file:
        colour = np.stack([file.channels()[name].pixels for name in "RGB"], axis=-1)
    srgb = colour[exported.painting.known].mean(axis=0)
    np.testing.assert_allclose(body, srgb, rtol=0.1)
    assert np.percentile(np.abs(errors - body), 90) < 0.1 * body.mean()
