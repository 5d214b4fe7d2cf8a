"""Paintings in Mitsuba 3: its pictures beside those of our own renderer, with all that a painting can have."""

import importlib.util
import json
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
import zarr
from small_painting import COLUMNS, ROWS, export_context, small_painting

from nishiki.brdf.slopes import slope_covariance
from nishiki.colour.colour import illuminant, white_xyz, xyz_to_srgb_linear
from nishiki.render.plane.frame import render
from nishiki.render.plane.scene import Light, View
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.painting import run
from nishiki.stages.export.scene import ExportedScene
from nishiki.stages.render.painting import load_scene

pytestmark = pytest.mark.slow

LABELS = np.zeros((ROWS, COLUMNS), np.uint8)
LABELS[10:30, 20:51] = 1
TURNED_AWAY = np.s_[20:23, 30:34]  # facets that lean further than the view sees
LAMPS = [(0.6, 0.1, 0.79), (-0.1, -0.05, 0.99)]
D65 = illuminant("D65")


def terms(count):
    """(rows, columns, count) terms of the body shading that differ from place to place."""
    y, x = np.mgrid[:ROWS, :COLUMNS] / 20
    body = 0.8 + 0.1 * np.sin(x), 0.2 * np.cos(y), 0.3 * np.sin(x + y) ** 2
    return np.stack([*body, 0.4 * np.sin(y), 0.3 * np.cos(x)], axis=-1)[..., :count]


@contextmanager
def exported(folder, **changes):
    """A painting, the folder of its export, what the stage reports, and what our own renderer takes."""
    painting = small_painting(folder, **changes)
    normals = zarr.open_group(painting.inputs["normals"].folder / "maps.zarr", mode="r+")["normals"]
    normals[TURNED_AWAY] = np.broadcast_to(np.float32([0.96, 0.2, -0.2]) / np.sqrt(1.0016), (3, 4, 3))
    context = export_context(painting, folder / "export", ExportSettings(formats=("mitsuba",)))
    scene = replace(load_scene(painting.inputs, cast_shadows=False), labels=changes.get("regions"))
    with context.output as output:
        losses = run(context)["losses"]["mitsuba"]
        made = output.folder / "exports/mitsuba"
        yield SimpleNamespace(painting=painting, folder=made, losses=losses, scene=scene)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """One finish, Lambert's body."""
    with exported(tmp_path_factory.mktemp("plain")) as made:
        yield made


@pytest.fixture(scope="module")
def rich(tmp_path_factory):
    """Two finishes, five terms of the body shading, losses at the surface."""
    changes = {"regions": LABELS, "shading": terms(5), "transmission": 1.0}
    with exported(tmp_path_factory.mktemp("rich"), **changes) as made:
        yield made


@pytest.fixture(scope="module")
def mi():
    """Mitsuba with a variant that needs nothing else."""
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (group path-tracing)")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def nishiki_paint(folder):
    """The exported module."""
    spec = importlib.util.spec_from_file_location("nishiki_paint", folder / "nishiki_paint.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def ours(scene, lamp):
    """Our own picture (rows, columns, 3), linear sRGB."""
    xyz = render(scene, [Light(direction=lamp, spectrum=D65)], View()).xyz
    return xyz_to_srgb_linear(xyz, white=white_xyz(D65))


@pytest.mark.parametrize("lamp", LAMPS)
@pytest.mark.parametrize("kind", ["plain", "rich"])
def test_mitsuba_renders_what_we_render(mi, request, kind, lamp):
    made = request.getfixturevalue(kind)
    module = nishiki_paint(made.folder)
    flat = np.array(mi.render(module.load([lamp], relief=False, samples=1, folder=made.folder)))
    expected = ours(made.scene, lamp)
    known = made.painting.known & (expected.min(axis=-1) > 0.01)
    assert known.mean() > 0.8
    assert known[TURNED_AWAY].all() == (kind == "plain" and lamp == LAMPS[0])  # else they are black
    np.testing.assert_allclose(flat[known], expected[known], rtol=0.001)
    if kind == "rich":  # each of them counts
        for left_out in ({"slopes": None}, {"labels": None}, {"shading": terms(3)}):
            apart = np.abs(ours(replace(made.scene, **left_out), lamp)[known] / expected[known] - 1)
            assert np.percentile(apart, 99) > 0.01, left_out
    relief = np.array(mi.render(module.load([lamp], relief=True, samples=1, folder=made.folder)))
    inner = known.copy()
    inner[[0, -1]] = inner[:, [0, -1]] = False
    assert np.median(np.abs(relief[inner] - expected[inner])) < 0.01


def test_shadows_are_cast_by_the_relief_unless_the_body_shading_holds_them(mi, plain, rich):
    for made, mesh in ((plain, "relief.ply"), (rich, "flat.ply")):
        scene = nishiki_paint(made.folder).description(LAMPS, folder=made.folder)
        assert scene["painting"]["filename"] == str(made.folder / mesh)


def test_variants_without_rgb_are_refused_with_those_that_do(mi, plain):
    mi.set_variant("scalar_spectral")
    try:
        with pytest.raises(RuntimeError, match=r"not scalar_spectral\. Remedy: scalar_rgb"):
            nishiki_paint(plain.folder).define()
    finally:
        mi.set_variant("scalar_rgb")


def test_textures_are_written_where_a_painting_has_them(plain, rich):
    names = {made.folder: json.loads((made.folder / "scene.json").read_text())["textures"] for made in (plain, rich)}
    assert names[plain.folder] == ["albedo", "normals", "shading", "slopes"]
    assert names[rich.folder] == ["albedo", "normals", "shading", "directional", "slopes", "regions"]
    for made in (plain, rich):
        assert sorted(f"exports/mitsuba/{path.name}" for path in made.folder.iterdir()) == sorted(made.losses["files"])


def test_a_painting_whose_gloss_was_left_out_is_matte(mi, tmp_path):
    painting = small_painting(tmp_path)
    del painting.inputs["brdf"]
    context = export_context(painting, tmp_path / "export", ExportSettings(formats=("mitsuba",)))
    with context.output as output:
        run(context)
        folder = output.folder / "exports/mitsuba"
        assert json.loads((folder / "scene.json").read_text())["textures"] == ["albedo", "normals", "shading"]
        albedo = exr(folder / "albedo.exr").reshape(ROWS, COLUMNS, 3)
        flat = np.array(mi.render(nishiki_paint(folder).load(LAMPS[:1], relief=False, samples=1, folder=folder)))
    normals = np.where(painting.known[..., None], painting.normals, 0)
    lit = painting.known & (normals @ LAMPS[0] > 0.05)
    shade = normals @ LAMPS[0] / np.linalg.norm(LAMPS[0])
    np.testing.assert_allclose(flat[lit], (albedo * shade[..., None])[lit], rtol=1e-3)


def test_slopes_by_bands_are_those_of_the_whole_picture(plain):
    scene = ExportedScene(plain.painting.inputs)
    whole = slope_covariance(scene.shading_normals(slice(0, ROWS)))
    bands = [scene.slopes(rows) for rows in scene.bands()]
    assert len(bands) > 2
    np.testing.assert_array_equal(np.concatenate(bands), whole)


def exr(path):
    """A float picture (pixels, channels)."""
    with OpenEXR.File(str(path)) as file:
        (channel,) = file.channels().values()
        return channel.pixels.reshape(ROWS * COLUMNS, -1).astype(float)
