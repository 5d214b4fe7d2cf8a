"""A painting cut into fields, digitised through the workflow: joined, packed, and a field replaced."""

import json
import shutil

import numpy as np
import pytest
from benchmarks.cut_mosaic import cut_capture

from nishiki.artifacts.maps import Maps

pytestmark = pytest.mark.slow

LIGHTS = ("--rings", "1", "--ring-lights", "6")
FIELDS = ("wall--a1", "wall--a2")
OF_FIELDS = ("ingest", "separate", "normals", "brdf")


@pytest.fixture(scope="module")
def wall(new_site, tmp_path_factory):
    """A copy of the project with the scene wall, whose two fields were digitised and joined."""
    site = new_site(tmp_path_factory.mktemp("wall"), "plane")
    whole = ("--output", "captures/whole", "--truth", "captures/truth")
    site.nishiki("simulate", *whole, "--rows", "240", "--columns", "400", *LIGHTS)
    cut_capture(site.folder / "captures/whole", site.folder / "captures/wall", grid=(1, 2), overlap=0.3, seed=1)
    (site.folder / "config/scenes.tsv").write_text("scene\tcapture\nwall\tcaptures/wall\n")
    site.configure(products=["height", "viewer", "export", "report"])
    site.nishiki("run", "wall")
    return site


@pytest.fixture
def ask(wall, monkeypatch, capsys):
    """Call the command line inside this process; what it prints, and its exit status as attribute `status`."""
    from nishiki.cli import main

    def call(*arguments: str, status: int = 0) -> str:
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        assert (ended.value.code or 0) == status
        return capsys.readouterr().out

    monkeypatch.chdir(wall.folder)
    return call


def states(ask) -> dict[str, set[str]]:
    """Stages that would run, by scene, as the command plan tells."""
    plans = map(json.loads, ask("plan", "wall", "--json").splitlines())
    return {plan["scene"]: {each["stage"] for each in plan["stages"] if each["state"] == "run"} for plan in plans}


def test_the_fields_become_one_record(wall):
    current = wall.folder / "results/wall/current"
    described = json.loads((current / "mosaic/mosaic.json").read_text())
    figures = json.loads((current / "mosaic/artifact.json").read_text())["diagnostics"]
    assert described["fields"].keys() == {name.removeprefix("wall--") for name in FIELDS}
    assert sum(overlap["used"] for overlap in described["overlaps"]) == 1
    assert figures["registration_rms_px"] < 0.3
    assert figures["seam_deg"] < 2
    height, normals = Maps(current / "height"), Maps(current / "mosaic")
    assert height.read("height").shape == tuple(described["shape"]) == normals.read("normals").shape[:2]
    assert np.isfinite(height.read("height")).mean() > 0.85
    assert all((current / name).is_file() for name in ("report.html", "viewer/index.html", "exports/height.tif"))
    assert all((wall.folder / "results" / field / "current/normals").exists() for field in FIELDS)


def test_what_is_finished_is_not_made_again_and_is_sound(wall, ask):
    assert states(ask) == {scene: set() for scene in (*FIELDS, "wall")}
    assert ": done" not in wall.nishiki("run").stderr
    ask("verify", "results")
    assert '"remove"' not in ask("prune", "--json")


def test_a_crate_holds_the_fields_with_their_captures_and_is_audited(ask, tmp_path):
    ask("pack", "wall", "--output", str(tmp_path / "crate"))
    ask("verify", str(tmp_path / "crate"))
    assert len(list(tmp_path.glob("crate/artifacts/*/normals/*/artifact.json"))) == len(FIELDS)
    shutil.rmtree(tmp_path / "crate/artifacts/a2")
    ask("verify", str(tmp_path / "crate"), status=1)


def test_a_replaced_field_makes_again_itself_and_the_mosaic(wall, ask):
    field, saved = wall.folder / "captures/wall/fields/a2", wall.folder / "a2"
    shutil.move(field, saved)
    shutil.copytree(saved / "data", field)
    (field / "capture.yaml").write_text((field / "capture.yaml").read_text() + "notes: photographed again\n")
    ask("seal", "captures/wall")
    planned = states(ask)
    assert {scene for scene in planned if planned[scene]} == {"wall--a2", "wall"}
    assert planned["wall--a2"] == set(OF_FIELDS)
    assert {"mosaic", "height"} <= planned["wall"]
    shutil.rmtree(field)
    shutil.move(saved, field)
    assert not any(states(ask).values())
