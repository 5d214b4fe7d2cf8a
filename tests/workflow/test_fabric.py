"""The fabric chain through the workflow: everything is made, only what depends on a change is made again."""

import json

import pytest

pytestmark = pytest.mark.slow

AFTER_FABRIC = ["fabric_render", "fabric_evaluate", "fabric_report", "publish"]


def artifact(site, stage):
    return json.loads((site.folder / "results/tiny/current" / stage / "artifact.json").read_text())


def test_every_stage_ran_and_nothing_is_left_to_do(fabric_site):
    assert set(fabric_site.run_facts()) == set(fabric_site.stages())
    assert fabric_site.would_run() == []


def test_what_a_user_opens_is_there(fabric_site):
    current = fabric_site.folder / "results/tiny/current"
    assert {".html", ".png", ".exr", ".ply", ".npz"} <= {path.suffix for path in current.iterdir()}
    assert (current / "report.html").stat().st_size > 20_000


def test_fewer_oblique_measurements_rerun_from_the_fit_on(fabric_site):
    fabric_site.configure(fabric={"oblique": 0})
    assert fabric_site.would_run() == ["fabric", *AFTER_FABRIC]


def test_another_dye_reruns_pictures_and_report_only(fabric_site):
    small = {"view": {"rows": 72, "columns": 72}, "cloth": {"points": 33}, "supersampling": 1}
    fabric_site.configure(fabric_render={**small, "dyes": {"green": "#207040"}})
    assert fabric_site.would_run() == ["fabric_render", "fabric_report", "publish"]


def test_a_painting_or_object_setting_reruns_nothing(fabric_site):
    fabric_site.configure(normals={"solver": "least_squares"}, residual={"amount": 1.0})
    assert fabric_site.would_run() == []


def test_the_plan_says_what_the_capture_holds(fabric_site):
    assert "pairs of directions" in fabric_site.nishiki("plan").stdout


@pytest.mark.parametrize("stage", ["reflectance", "fabric", "fabric_render"])
def test_a_flipped_bit_is_named(fabric_site, stage):
    folder = fabric_site.folder / "results/tiny" / stage
    victim = max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    sound = victim.read_bytes()
    victim.write_bytes(sound[:-9] + bytes([sound[-9] ^ 16]) + sound[-8:])
    try:
        done = fabric_site.nishiki("verify", check=False)
        assert done.returncode == 1
        assert victim.name in done.stdout
    finally:
        victim.write_bytes(sound)
