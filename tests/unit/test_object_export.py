"""Textures of exported objects: what is read at a surface point is what the tiles hold there. Addresses of views."""

import json
from dataclasses import replace
from types import SimpleNamespace
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
from unit.test_patches_atlas import atlas_of
from unit.test_patches_charts import around, ball

from nishiki.brdf.slopes import isotropic_lobe
from nishiki.brdf.texels.model import CaptureLamps
from nishiki.stages.export import OBJECT_LIMITS as LIMITS
from nishiki.stages.export import object as object_export
from nishiki.stages.export.object import pitch_mm
from nishiki.stages.export.object_look import ALPHA_PER_SIGMA, ObjectLook, SeenPoints, fill_gaps, sample, texture_atlas


@pytest.fixture(scope="module")
def atlas():
    """The atlas of a bumpy ball."""
    return atlas_of(ball(4, noise=0.001), around(4))


def test_the_texture_shows_at_every_surface_point_what_the_tiles_show(atlas):
    layout = texture_atlas(atlas)
    assert layout.placed.all()
    texture = np.full((*layout.shape, 1), np.nan)
    random = np.random.default_rng(2)
    values = random.random(layout.shape)  # neighbouring tiles share their border texels
    for row, column in layout.origin:
        window = (slice(row, row + atlas.size), slice(column, column + atlas.size))
        texture[window] = values[window][..., None]
    triangle = random.integers(0, len(atlas.chart), 4000).astype(np.int32)
    u, v = np.sort(random.random((2, 4000)), axis=0)
    shares = np.stack([u, v - u, 1 - v], axis=1)
    tile, s, t = atlas.locate(triangle, shares[:, :2].astype(np.float32))
    expected = sample(values[..., None], layout.origin[tile] + np.stack([s, t], axis=1))
    places = np.sum(layout.corners[triangle] * shares[..., None], axis=1)
    np.testing.assert_allclose(sample(texture, places), expected, atol=1e-3)


def test_charts_do_not_overlap_and_lie_inside_the_texture(atlas):
    layout = texture_atlas(atlas)
    assert (layout.corners > -0.5).all()
    assert (layout.corners < np.array(layout.shape) - 0.5).all()
    used = np.zeros(layout.shape, int)
    leaders = atlas.chart_grid[atlas.tile_chart, 0]
    for first in np.unique(leaders):
        rows, columns = layout.origin[leaders == first].T
        used[rows.min() : rows.max() + atlas.size, columns.min() : columns.max() + atlas.size] += 1
    assert used.max() == 1
    assert used.mean() > 0.4


def test_gaps_take_the_nearest_texel():
    texture = np.zeros((4, 5, 1))
    texture[1, 1], texture[2, 4] = 3, 7
    known = texture[..., 0] > 0
    filled = fill_gaps(texture, known)
    assert filled[0, 0] == 3
    assert filled[3, 4] == 7
    np.testing.assert_array_equal(fill_gaps(texture, np.zeros((4, 5), bool)), texture)


def test_the_lobe_has_the_peak_and_the_half_width_of_ours():
    sigma, strength = 0.08, 0.3
    alpha = ALPHA_PER_SIGMA * sigma
    reflectance = 4 * alpha**2 * strength
    assert np.pi * reflectance * isotropic_lobe(np.array(1.0), 1.0, 1.0, alpha) == pytest.approx(strength, rel=1e-6)
    half = np.cos(2 * np.sqrt(np.sqrt(2) - 1) * sigma)
    assert isotropic_lobe(half, 1.0, 1.0, alpha) / isotropic_lobe(1.0, 1.0, 1.0, alpha) == pytest.approx(0.5, abs=0.01)


def test_lamps_at_a_place_and_in_a_direction(atlas):
    camera = around(4)[0]
    positions = np.array([[0.1, 0.0, 0.2], [0.0, -0.3, 0.1]])
    normals = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]])
    towards = (camera.centre - positions) / np.linalg.norm(camera.centre - positions, axis=1, keepdims=True)
    far = CaptureLamps("direction", ((0.0, 0.0, 1.0),)).lamp(camera)
    for lamp, light in ((CaptureLamps("camera").lamp(camera), towards), (far, np.tile(far.vector, (2, 1)))):
        points = SeenPoints(positions, normals, np.zeros((2, 2)), camera.centre, lamp, np.ones((1, 2), bool))
        half = (light + towards) / np.linalg.norm(light + towards, axis=1, keepdims=True)
        for found, vectors in zip(points.cosines(), (half, light, towards), strict=False):
            np.testing.assert_allclose(found, np.maximum(np.sum(normals * vectors, axis=1), 0), atol=1e-6)


@pytest.mark.parametrize("name", ["gltf", "usd", "materialx"])
def test_limits_hold_for_whatever_formats_are_asked_for(name):
    figures = {"losses": {name: {"placed": 0.3, "clipped": 0.01}}}
    beyond = {limit.name: limit.beyond(limit.figure(figures)) for limit in LIMITS}
    assert beyond == {"clipped": False, "placed": True}
    assert [limit.figure({"losses": {}}) for limit in LIMITS] == [None, None]


def test_the_scale_of_a_view_is_that_of_its_middle():
    mesh, camera = ball(3), around(4)[1]
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    aside = middle + 0.01 * camera.rotation[0]  # to the right in the picture
    projected = [camera.matrix @ [*point, 1] for point in (middle, aside)]
    pixels = np.diff([point[0] / point[2] for point in projected])[0]
    assert pitch_mm(mesh, camera, "cm") == pytest.approx(10 * 0.01 / pixels, rel=1e-6)
    assert pitch_mm(mesh, camera, "arbitrary") is None


def test_addresses_of_views_are_those_of_their_files_whatever_the_views_are_called(tmp_path, monkeypatch):
    names = ["IMG #1", "a?b", "50%20", "é/2"]
    mesh, cameras = ball(2), around(4)
    grey, everywhere = np.full((4, 6, 3), 0.5, np.float32), np.ones((4, 6), bool)
    renderer = SimpleNamespace(
        captured=lambda place: SimpleNamespace(camera=cameras[place]),
        render=lambda shots: [SimpleNamespace(linear=grey, covered=everywhere) for _ in shots],
    )
    decoded = SimpleNamespace(
        views=names, mesh=mesh, encoding="srgb", numbers=lambda left_out: [], renderer=lambda **_: renderer
    )
    pictures = {name: np.full((4, 6, 3), 99, np.uint8) for name in object_export.LAYERS}
    monkeypatch.setattr(object_export.DecodedObject, "open", lambda inputs: decoded)
    monkeypatch.setattr(
        object_export, "Photographs", lambda inputs: SimpleNamespace(read=lambda *_: (grey, everywhere))
    )
    monkeypatch.setattr(object_export, "layers", lambda *_: pictures)
    (tmp_path / "exports/iiif").mkdir(parents=True)
    context = SimpleNamespace(
        inputs={
            "mesh": SimpleNamespace(diagnostics={"unit": "mm"}),
            "ingest": SimpleNamespace(diagnostics={"capture": {}}),
        },
        settings=SimpleNamespace(hold_out=(), iiif=SimpleNamespace(address="https://museum.example/jar")),
        output=SimpleNamespace(folder=tmp_path, path=lambda file: tmp_path / file),
        stamp={"version": "1", "scene": "jar", "key": "0"},
    )
    object_export.write_iiif(context, None)
    canvases = json.loads((tmp_path / "exports/iiif/manifest.json").read_text())["items"]
    assert [each["label"]["en"] for each in canvases] == [[f"View {name}"] for name in names]
    assert len({each["id"] for each in canvases}) == len(names)
    for canvas in canvases:
        (painted,) = canvas["items"][0]["items"]
        for image in painted["body"]["items"]:
            for address in (image["id"], f"{image['service'][0]['id']}/info.json"):
                parts = urlsplit(address)
                assert not parts.query
                assert not parts.fragment
                assert (tmp_path / "exports/iiif" / unquote(parts.path).removeprefix("/jar/")).is_file(), address


def test_with_one_strength_each_highlight_keeps_its_height():
    specular, roughness = np.array([[20, 60], [120, 0]], np.uint8), np.array([[150, 120], [180, 90]], np.uint8)
    look = ObjectLook(None, None, np.zeros((2, 2, 3), np.uint8), roughness, specular, factor=2.0, scale=1.0, clipped=0)
    one = look.with_mean_strength()
    assert (one.specular == 50).all()
    along_normal = [
        each.specular / 255 * each.normal_reflectance * isotropic_lobe(*np.ones((3, 2, 2)), (each.roughness / 255) ** 2)
        for each in (look, one)
    ]
    strong = specular > 0
    np.testing.assert_allclose(along_normal[1][strong], along_normal[0][strong], rtol=4 / 150)  # 8 bits, four times
    assert one.roughness[1, 1] == 255  # no gloss at all: as wide as it can be
    matte = replace(look, specular=np.zeros_like(specular)).with_mean_strength()
    np.testing.assert_array_equal(matte.roughness, roughness)
