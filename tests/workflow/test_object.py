"""The object chain through the workflow: everything is made, only what depends on a change is made again."""

import json

import numpy as np
import pytest
import trimesh
from examples import run_examples
from iiif_prezi3 import Manifest
from loaded_and_read import WhatIsLoadedAndRead
from PIL import Image

from nishiki.installation import is_installed

pytestmark = pytest.mark.slow

AFTER_RESIDUAL = ["object_render", "object_evaluate", "object_report"]


class TestObject(WhatIsLoadedAndRead):
    """The object."""

    @pytest.fixture
    def finished(self, finished_object):
        """The scene."""
        return finished_object


def artifact(site, stage):
    return json.loads((site.folder / "results/tiny/current" / stage / "artifact.json").read_text())


def test_every_stage_ran_and_nothing_is_left_to_do(object_site):
    assert set(object_site.run_facts()) == object_site.usual_stages()
    assert object_site.would_run() == []


def test_what_a_user_opens_is_there(object_site):
    current = object_site.folder / "results/tiny/current"
    names = {path.suffix for path in current.iterdir()}
    assert {".html", ".png", ".exr", ".ply"} <= names
    assert (current / "report.html").stat().st_size > 20_000


def test_pictures_are_near_the_photographs_and_nearer_than_the_model(object_site):
    psnr = artifact(object_site, "object_evaluate")["diagnostics"]["psnr"]
    assert psnr["captured"]["worst_psnr_db"] > psnr["model_alone"]["mean_psnr_db"]
    assert psnr["captured"]["mean_psnr_db"] > 30


@pytest.mark.parametrize("name", ["read_object", "render_view"])
def test_examples_of_the_public_functions_run(object_site, tmp_path, monkeypatch, name):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/jar").symlink_to(object_site.folder / "results/tiny")
    monkeypatch.chdir(tmp_path)
    run_examples(name)


def test_an_amount_of_bytes_reruns_from_the_residual_on(object_site):
    object_site.configure(residual={"amount": 2.0})
    assert object_site.planned() == ["residual", *AFTER_RESIDUAL]


def test_a_film_setting_reruns_pictures_and_report_only_and_a_paintings_nothing(object_site):
    painting = {"solver": "least_squares"}
    object_site.configure(object_render={"views": 6, "between": 0, "film": None}, normals=painting)
    assert object_site.planned() == ["object_render", "object_report"]


def test_views_held_out_are_predicted(object_site):
    assert "003" not in object_site.ask("plan")  # there is a truth
    object_site.configure(hold_out=["003"])
    assert "003" in object_site.ask("plan")
    stages = object_site.planned()
    assert "ingest" not in stages
    assert "residual" in stages


@pytest.mark.parametrize("stage", ["residual", "texels", "polarise"])
def test_a_flipped_bit_is_named(object_site, stage):
    folder = object_site.folder / "results/tiny" / stage
    victim = max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    sound = victim.read_bytes()
    victim.write_bytes(sound[:-9] + bytes([sound[-9] ^ 16]) + sound[-8:])
    try:
        done = object_site.nishiki("verify", check=False)
        assert done.returncode == 1
        assert victim.name in done.stdout
    finally:
        victim.write_bytes(sound)


def expect_views_for_museums(folder, losses, evaluated):
    """A canvas for each view with layers and scale, as iiif-prezi3 reads it; pictures near the photographs."""
    stored = json.loads((folder / "manifest.json").read_text())
    read = Manifest(**stored)
    assert read.behavior == ["individuals"]
    assert len(read.items) == losses["views"] == len(list(folder.glob("view-*")))
    scales = [canvas["service"][0]["physicalScale"] for canvas in stored["items"]]
    np.testing.assert_allclose(scales, scales[0], rtol=0.05)  # the camera goes round at one distance
    for canvas in stored["items"]:
        assert canvas["label"]["en"][0].startswith("View ")
        (painted,) = canvas["items"][0]["items"]
        assert len(painted["body"]["items"]) == 3
        for image in painted["body"]["items"]:
            with Image.open(folder / image["id"].removeprefix("http://localhost:8000/")) as picture:
                assert picture.size == (canvas["width"], canvas["height"])
    psnr = losses["kinds"]["iiif"]["psnr_db"]["fitted"]
    assert psnr["lights"] == losses["views"]
    assert psnr["all"] == pytest.approx(evaluated["diagnostics"]["psnr"]["captured"]["mean_psnr_db"], abs=4)
    view, model, normals = (tile(folder / f"view-000/{name}", read.items[0]) for name in ("view", "model", "normals"))
    assert 0 < np.abs(view.astype(int) - model).mean() < 20
    coded = normals[normals[..., 2] > 140] / 255 * 2 - 1
    np.testing.assert_allclose(np.median(np.linalg.norm(coded, axis=-1)), 1, atol=0.03)


def tile(folder, canvas):
    """The upper left tile at full resolution."""
    wide, high = min(512, canvas.width), min(512, canvas.height)
    with Image.open(folder / f"0,0,{wide},{high}/{wide},{high}/0/default.jpg") as picture:
        return np.asarray(picture)


def test_an_object_is_exported(object_site):
    more = [name for name, package in (("usd", "usd-core"), ("materialx", "materialx")) if is_installed(package)]
    object_site.nishiki("export", "tiny", "gltf", "mitsuba", "iiif", "kintsugi", *more, "--output", "for-others")
    mesh = trimesh.load(object_site.folder / "for-others/object.glb", force="mesh")
    given = trimesh.load(object_site.folder / "results/tiny/current/mesh.ply", process=False)
    np.testing.assert_allclose(mesh.bounds, given.bounds / 1000, rtol=1e-5)
    assert len(mesh.faces) == len(given.faces)
    (manifest,) = (object_site.folder / "results/tiny/object_export").glob("*/artifact.json")
    losses = json.loads(manifest.read_text())["diagnostics"]["losses"]
    figures = losses["gltf"]["kinds"]["gltf"]["psnr_db"]
    evaluation = json.loads((object_site.folder / "results/tiny/current/object_evaluate/evaluation.json").read_text())
    model = evaluation["figures"]["model_alone"]["mean_covered_psnr_db"]
    assert figures["fitted"]["all"] > model - 0.5, "the textures show no less than the model without its residual"
    for name in more:
        assert losses[name]["kinds"][name]["psnr_db"]["fitted"]["all"] == pytest.approx(
            figures["fitted"]["all"], abs=0.6
        )
    decibels = losses["mitsuba"]["kinds"]["model"]["psnr_db"]["fitted"]["all"]
    assert decibels > figures["fitted"]["all"] - 1.5
    assert losses["kintsugi"]["kinds"]["kintsugi"]["psnr_db"]["fitted"]["all"] > figures["fitted"]["all"] - 2
    same = trimesh.load(object_site.folder / "for-others/kintsugi/object.glb", force="mesh")
    np.testing.assert_allclose(same.bounds, mesh.bounds, rtol=1e-6)
    scene = object_site.folder / "for-others/mitsuba"
    np.testing.assert_allclose(trimesh.load(scene / "object.ply").bounds, mesh.bounds, rtol=1e-5)
    views = json.loads((scene / "scene.json").read_text())["views"]
    assert len(views) == 12
    expect_views_for_museums(
        object_site.folder / "for-others/iiif", losses["iiif"], artifact(object_site, "object_evaluate")
    )
    if "usd" in more:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(object_site.folder / "for-others/object.usdz"))
        points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/surface/mesh")).GetPointsAttr().Get())
        np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], mesh.bounds, rtol=1e-5)
