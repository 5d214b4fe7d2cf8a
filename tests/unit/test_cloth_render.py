"""The stage cloth_render: every product, surfaces from files, films, and what is told where the input is wrong."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from benchmarks.cloth_peers import Ward
from refusals import refused

from nishiki.artifacts.artifact import ArtifactWriter, open_artifact
from nishiki.artifacts.declaration import parse
from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.store import save_brdf
from nishiki.errors import UserError
from nishiki.progress import Progress
from nishiki.render.cloth.models import ClothModels
from nishiki.render.cloth.studio import ClothPicture
from nishiki.render.cloth.surfaces import STEP, read_drape, read_surface
from nishiki.render.display import develop, shoulder
from nishiki.stages.render import ClothRenderSettings
from nishiki.stages.render.cloth import choose_exposure
from nishiki.stages.table import CHAIN
from nishiki.stages.viewer import ClothViewerSettings
from nishiki.stages.viewer.cloth import shape_of, surfaces

PROJECT = Path(__file__).resolve().parents[2]
STAMP = {"scene": "small", "stage": "cloth_render", "key": "0" * 12, "version": "0.1.0"}
SMALL = {
    "view": {"rows": 48, "columns": 48},
    "supersampling": 1,
    "around": 0.2,
    "film": None,
}
QUAD = """v 0 0 0
v 2 0 0
v 2 0.5 -1
v 0 0.5 -1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 2/2 3/3
f 1/1 3/3 4/4
"""


def script():
    """The stage's module."""
    return importlib.import_module("nishiki.stages.render.cloth")


@pytest.fixture(scope="module")
def cloth_brdf(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chain") / "cloth_brdf" / ("a" * 12)
    models = {
        "ward": Ward(diffuse=np.array([0.05]), specular=np.array([0.2]), alpha_x=0.4, alpha_y=0.15),
        "dull": Ward(diffuse=np.array([0.05]), specular=np.array([0.0]), alpha_x=0.4, alpha_y=0.15),
    }
    with ArtifactWriter(folder) as writer:
        for name, brdf in models.items():
            save_brdf(writer.path(f"models/cloth/{name}.npz"), brdf)
        told = {name: {"used": [0]} for name in models}
        text = json.dumps({"default": "ward", "regions": ["cloth"], "models": {"cloth": told}})
        writer.path("cloth_brdf.json").write_text(text)
        return writer.finish({**STAMP, "stage": "cloth_brdf", "settings": {}, "upstream": {}, "diagnostics": {}}, {})


def rendered(folder, cloth_brdf, **settings):
    chosen = parse(ClothRenderSettings, {**SMALL, **settings}, "settings")
    with ArtifactWriter(folder) as writer:
        context = Context({"cloth_brdf": cloth_brdf}, chosen, writer, None, None, STAMP, Progress("test"))
        told = script().run(context)
        writer.finish({**STAMP, "settings": {}, "upstream": {}, "diagnostics": told}, {})
    return open_artifact(folder)


@pytest.mark.slow
def test_the_default_products(cloth_brdf, tmp_path):
    done = rendered(tmp_path / ("0" * 12), cloth_brdf)
    names = {"drape", "drape-light-left", "drape-light-right", "drape-dye-red", "drape-dye-indigo", "drape-dye-gold"}
    assert set(done.diagnostics["pictures"]) == {*names, "cylinders"}
    pictures = {name: cv2.imread(str(done.path(f"{name}.png"))).astype(int) for name in done.diagnostics["pictures"]}
    assert all(done.path(f"{name}.exr").is_file() for name in pictures)
    assert pictures["drape"].shape == (48, 48, 3)
    middle = {name: pictures[name][16:32, 16:32].mean(axis=(0, 1)) for name in names}  # blue, green, red
    assert middle["drape-dye-red"].argmax() == 2
    assert middle["drape-dye-indigo"].argmax() == 0
    assert middle["drape-dye-gold"].argmin() == 0
    assert np.all(middle["drape"] >= middle["drape-light-left"])
    assert not np.allclose(middle["drape-light-left"], middle["drape-light-right"], atol=2)
    assert done.diagnostics["model"] == "ward"
    assert done.diagnostics["surface"]["kind"] == "ball"
    assert done.diagnostics["video"] == {}
    again = rendered(tmp_path / "again" / ("0" * 12), cloth_brdf)
    assert again.digest == done.digest


def test_another_model_and_nothing_else(cloth_brdf, tmp_path):
    settings = {"dyes": {}, "swatches": False, "paper": 0, "exposure": 1.0}
    dull = rendered(tmp_path / ("0" * 12), cloth_brdf, model="dull", **settings)
    assert set(dull.diagnostics["pictures"]) == {"drape", "drape-light-left", "drape-light-right"}
    glossy = rendered(tmp_path / "glossy" / ("0" * 12), cloth_brdf, **settings)
    best = [done.diagnostics["pictures"]["drape"]["brightest"] for done in (dull, glossy)]
    assert best[1] > 1.3 * best[0]
    # Without paper the picture's corners are empty, and shown as the background.
    assert np.all(cv2.imread(str(dull.path("drape.png")))[0, 0] == 255)


def test_a_surface_from_a_file(cloth_brdf, tmp_path):
    path = tmp_path / "quad.obj"
    path.write_text(QUAD)
    settings = {"dyes": {}, "swatches": False, "mesh": {"file": str(path)}}
    done = rendered(tmp_path / ("0" * 12), cloth_brdf, **settings)
    assert done.diagnostics["surface"] == {
        "kind": "file", "vertices": 4, "triangles": 2, "transported": 0, "arbitrary": 0,
        "sha256": read_surface(path).sha256,
    }  # fmt: skip
    laid = {**settings, "mesh": {"file": str(path), "weft": "y", "smooth": False}}
    assert rendered(tmp_path / "y" / ("0" * 12), cloth_brdf, **laid).diagnostics["surface"]["vertices"] == 6


def test_the_page_of_the_cloth_takes_the_surface_of_the_pictures(tmp_path):
    path = tmp_path / "quad.obj"
    path.write_text(QUAD)
    shown = ClothRenderSettings(mesh={"file": str(path), "turned_deg": 90})
    mesh = CHAIN["cloth_viewer"].filled(ClothViewerSettings(), SimpleNamespace(cloth_render=shown))["mesh"]
    assert (mesh.sha256, mesh.turned_deg) == (read_surface(path).sha256, 90)
    nothing = CHAIN["cloth_viewer"].filled(ClothViewerSettings(), SimpleNamespace(cloth_render=ClothRenderSettings()))
    assert list(surfaces(nothing["mesh"])) == ["drape", "flat", "cylinders"]
    assert list(surfaces(mesh)) == ["file", "drape", "flat", "cylinders"]
    shape = shape_of(surfaces(mesh)["file"]())
    vertices = np.cumsum(shape.arrays["vertices"], axis=0) * shape.numbers["step"]
    np.testing.assert_allclose(vertices[:4], [[0, 0, 0], [2, 0, 0], [2, 0.5, -1], [0, 0.5, -1]], atol=1e-4)
    weft = np.cumsum(shape.arrays["weft"][:4].astype(int), axis=0) / 32767
    np.testing.assert_allclose(abs(weft), np.tile(np.array([0, 0.5, 1]) / np.sqrt(1.25), (4, 1)), atol=1e-3)  # turned


def test_a_missing_surface_is_told_by_the_setting_that_names_it(tmp_path):
    missing, none = {"file": str(tmp_path / "none.obj")}, SimpleNamespace(cloth_render=ClothRenderSettings())
    with pytest.raises(UserError, match=r"cloth_viewer\.mesh\.file"):
        CHAIN["cloth_viewer"].filled(ClothViewerSettings(mesh=missing), none)
    shown = SimpleNamespace(cloth_render=ClothRenderSettings(mesh=missing))
    with pytest.raises(UserError, match=r"cloth_render\.mesh\.file"):
        CHAIN["cloth_viewer"].filled(ClothViewerSettings(), shown)


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        ({"sha256": "00"}, "SHA-256"),
        ({"file": "plain.ply"}, "mesh.weft"),
        ({"file": "none.obj"}, "none.obj"),
    ],
)
def test_surfaces_that_cannot_be_used(cloth_brdf, tmp_path, mesh, words):
    (tmp_path / "quad.obj").write_text(QUAD)
    (tmp_path / "plain.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    named = {"file": str(tmp_path / mesh.get("file", "quad.obj")), "sha256": mesh.get("sha256", "")}
    with pytest.raises(UserError, match=words):
        rendered(tmp_path / "out" / ("0" * 12), cloth_brdf, mesh=named)


@pytest.mark.parametrize("moves", ["turn", "light"])
def test_a_film(cloth_brdf, tmp_path, moves):
    film = {"moves": moves, "frames": 3, "columns": 32, "supersampling": 1}
    settings = {"as_measured": False, "dyes": {}, "swatches": False, "film": film}
    done = rendered(tmp_path / ("0" * 12), cloth_brdf, **settings)
    assert done.diagnostics["video"]["frames"] == 3
    assert done.path(done.diagnostics["video"]["file"]).stat().st_size > 500


def test_unknown_names_are_reported(cloth_brdf, tmp_path):
    with refused(UserError, "velvet"):
        rendered(tmp_path / ("0" * 12), cloth_brdf, model="velvet")
    with refused(UserError, "lining"):
        rendered(tmp_path / ("1" * 12), cloth_brdf, region="lining")
    with refused(UserError, "cloth_brdf"):
        ClothModels(tmp_path)
    with pytest.raises(UserError, match="dyes"):
        parse(ClothRenderSettings, {"dyes": {"red": "crimson"}}, "settings")


def test_tone():
    ramp = np.linspace(0, 5, 400)[:, None] * np.ones(3)
    bent = shoulder(ramp)
    assert np.allclose(bent[ramp < 0.6], ramp[ramp < 0.6])
    assert np.all(np.diff(bent[:, 0]) > 0)
    assert bent.max() < 1
    assert np.abs(np.diff(bent[:, 0], 2)).max() < 1e-3  # no kink
    colours = np.random.default_rng(0).random((500, 3)) * 4
    shown = shoulder(colours)
    assert shown.max() <= 1 + 1e-9
    assert shown.min() >= 0
    assert np.array_equal(shown.argmax(axis=1), colours.argmax(axis=1))
    cloth = np.zeros((4, 4), np.float32)
    cloth[:2] = 1
    linear = np.full((4, 4, 3), 0.2, np.float32)
    picture = ClothPicture(linear, np.ones((4, 4), np.float32), cloth, 16, 16, 0.0, 0.0)
    automatic = ClothRenderSettings()
    white_sheet = 1 / (1.15 + 0.16)  # its light under the brightest lamp and the room
    assert choose_exposure(automatic, [picture]) == pytest.approx(white_sheet)
    assert choose_exposure(automatic, [replace(picture, linear=linear / 50)]) == pytest.approx(
        white_sheet
    )  # black stays black
    linear[:2] = 1.9  # gloss brighter than white paper bounds the exposure
    assert choose_exposure(automatic, [picture]) == pytest.approx(0.5, rel=1e-3)
    assert choose_exposure(automatic, []) == pytest.approx(white_sheet)
    image = develop(np.full((2, 2, 3), 0.25, np.float32), np.full((2, 2), 0.0, np.float32), background=1.0)
    assert np.all(image.pixels == 255)


PROGRAM = Path(__file__).resolve().parents[2] / "benchmarks/draped_cloth.py"


def program():
    """The program that made the shipped file."""
    spec = importlib.util.spec_from_file_location("draped_cloth", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_shipped_cloth_rests_on_the_ball_and_the_floor_with_its_length_kept():
    points = read_drape()
    assert points.shape == (129, 129, 3)
    away = np.linalg.norm(points - [0, 0.30, 0], axis=2) - 0.16
    assert away.min() > 0.0019
    assert points[..., 1].min() > 0.0019
    assert points[64, 64, 1] == pytest.approx(0.462, abs=1e-4)
    assert points[0, 0, 1] < 0.2  # its corners hang
    for axis in (0, 1):
        lengths = np.linalg.norm(np.diff(points, axis=axis), axis=2)
        assert np.sqrt(np.mean((128 * lengths - 1) ** 2)) < 0.02


def test_points_are_kept_to_a_micrometre(tmp_path):
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (9, 9, 3))
    program().write_drape(tmp_path / "cloth.npz", points)
    np.testing.assert_allclose(read_drape(tmp_path / "cloth.npz"), points, atol=STEP / 2 + 1e-12)


@pytest.mark.long
def test_the_shipped_cloth_is_what_its_program_makes():
    points, speed = program().drape()
    assert speed < 0.02
    # Other processors round differently, and a fold may then move by a little.
    assert np.abs(points - read_drape()).max() < 1e-3
