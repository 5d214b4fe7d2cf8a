"""The cloth chain through the workflow: everything is made, only what depends on a change is made again."""

import json

import pytest
import trimesh
from loaded_and_read import WhatIsLoadedAndRead

pytestmark = pytest.mark.slow

AFTER_CLOTH_BRDF = ["cloth_render", "cloth_evaluate", "cloth_report"]


class TestCloth(WhatIsLoadedAndRead):
    """The cloth."""

    @pytest.fixture
    def finished(self, finished_cloth):
        """The scene."""
        return finished_cloth


def artifact(site, stage):
    return json.loads((site.folder / "results/tiny/current" / stage / "artifact.json").read_text())


def test_every_stage_ran_and_nothing_is_left_to_do(cloth_site):
    assert set(cloth_site.run_facts()) == cloth_site.usual_stages()
    assert cloth_site.would_run() == []


def test_what_a_user_opens_is_there(cloth_site):
    current = cloth_site.folder / "results/tiny/current"
    assert {".html", ".png", ".exr", ".ply", ".npz"} <= {path.suffix for path in current.iterdir()}
    assert (current / "report.html").stat().st_size > 20_000


def test_fewer_oblique_measurements_rerun_from_the_fit_on(cloth_site):
    cloth_site.configure(cloth_brdf={"oblique": 0})
    assert cloth_site.planned() == ["cloth_brdf", *AFTER_CLOTH_BRDF]


def test_another_dye_reruns_pictures_and_report_only_and_settings_of_others_nothing(cloth_site):
    small = {"view": {"rows": 72, "columns": 72}, "supersampling": 1}
    others = {"normals": {"solver": "least_squares"}, "residual": {"amount": 1.0}}
    cloth_site.configure(cloth_render={**small, "dyes": {"green": "#207040"}}, **others)
    assert cloth_site.planned() == ["cloth_render", "cloth_report"]


def test_the_plan_says_what_the_capture_holds(cloth_site):
    assert "pairs" in cloth_site.ask("plan")


@pytest.mark.parametrize("stage", ["goniometer_samples", "cloth_brdf", "cloth_render"])
def test_a_flipped_bit_is_named(cloth_site, stage):
    folder = cloth_site.folder / "results/tiny" / stage
    victim = max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)
    sound = victim.read_bytes()
    victim.write_bytes(sound[:-9] + bytes([sound[-9] ^ 16]) + sound[-8:])
    try:
        done = cloth_site.nishiki("verify", check=False)
        assert done.returncode == 1
        assert victim.name in done.stdout
    finally:
        victim.write_bytes(sound)


def test_a_cloth_is_exported(cloth_site):
    wrong = cloth_site.nishiki("export", "tiny", "wood", check=False)
    assert wrong.returncode == 2
    assert "wood" in wrong.stderr
    cloth_site.nishiki("export", "tiny", "gltf", "mitsuba", "--output", "for-others")
    (mesh,) = trimesh.load(cloth_site.folder / "for-others/cloth.glb").geometry.values()
    (manifest,) = (cloth_site.folder / "results/tiny/cloth_export").glob("*/artifact.json")
    assert (cloth_site.folder / "for-others/mitsuba/nishiki_cloth.py").is_file()
    surface = artifact(cloth_site, "cloth_render")["diagnostics"]["surface"]
    assert len(mesh.faces) == surface["triangles"]
    assert json.loads(manifest.read_text())["diagnostics"]["losses"]["gltf"]["against_model"]["delta_e"]["mean"] < 5
