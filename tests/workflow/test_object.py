"""The object chain through the workflow: everything is made, only what depends on a change is made again."""

import json

import pytest
from examples import run_examples

pytestmark = pytest.mark.slow

AFTER_RESIDUAL = ["object_render", "object_evaluate", "object_report", "publish"]


def artifact(site, stage):
    return json.loads((site.folder / "results/tiny/current" / stage / "artifact.json").read_text())


def test_every_stage_ran_and_nothing_is_left_to_do(object_site):
    assert set(object_site.run_facts()) == set(object_site.stages())
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
    assert object_site.would_run() == ["residual", *AFTER_RESIDUAL]


def test_a_film_setting_reruns_pictures_and_report_only(object_site):
    object_site.configure(object_render={"views": 6, "between": 0, "film": None})
    assert object_site.would_run() == ["object_render", "object_report", "publish"]


def test_a_painting_setting_reruns_nothing(object_site):
    object_site.configure(normals={"solver": "least_squares"})
    assert object_site.would_run() == []


def test_views_held_out_are_predicted(object_site):
    plan = object_site.nishiki("plan").stdout
    assert "held out" not in plan  # there is a truth
    object_site.configure(hold_out=["003"])
    assert "held out of every fit and predicted instead: 003" in object_site.nishiki("plan").stdout
    stages = object_site.would_run()
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
