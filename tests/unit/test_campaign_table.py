"""The table of a campaign: figures of all scenes, whatever stages each has."""

import csv
import json
from types import SimpleNamespace

import pytest
from refusals import expect_facts

from nishiki.cli import main
from nishiki.engine import workflow
from nishiki.engine.finished import campaign_rows, columns_of, figures


@pytest.fixture
def campaign(tmp_path, monkeypatch):
    """Two scenes, the second of them not finished."""
    diagnostics = {"normals": {"solver": "lobe", "pixels": 12, "sigma": {"median_deg": 0.5, "lights": [1, 2]}}}
    plans = {}
    for name, geometry in (("vase", "plane"), ("cup", "turntable")):
        facts = SimpleNamespace(geometry=geometry, lights=("a", "b"), views=(), pixels=300)
        plans[name] = SimpleNamespace(
            scene=SimpleNamespace(capture=f"captures/{name}"), facts=facts, stages=diagnostics
        )
    current = tmp_path / "results/vase/current"
    (current / "normals").mkdir(parents=True)
    (current / "index.json").write_text("{}")
    manifest = {"key": "abc", "diagnostics": diagnostics["normals"]}
    (current / "normals/artifact.json").write_text(json.dumps(manifest))
    flow = SimpleNamespace(plans=plans, results=str(tmp_path / "results"))
    monkeypatch.setattr(workflow, "Workflow", lambda *arguments, **named: flow)
    (tmp_path / "config.yaml").write_text("{}")
    return tmp_path, flow


def test_a_row_holds_the_figures_of_every_published_stage(campaign):
    _, flow = campaign
    vase, cup = campaign_rows(flow)
    assert vase["finished"] is True
    assert vase["normals.sigma.median_deg"] == 0.5
    assert (vase["normals.key"], vase["normals.solver"], vase["normals.pixels"]) == ("abc", "lobe", 12.0)
    assert "normals.sigma.lights" not in vase
    assert cup["finished"] is False
    assert cup["geometry"] == "turntable"
    assert not [name for name in cup if name.startswith("normals")]


def test_columns_have_one_type_and_a_gap_where_a_scene_has_no_figure():
    columns = columns_of([{"a": 1.0, "b": "x"}, {"b": 2.0, "c": True}])
    assert columns == {"a": [1.0, None], "b": ["x", "2.0"], "c": [None, True]}


def test_figures_of_deep_blocks_and_of_none():
    assert dict(figures({"a": {"b": {"c": {"d": {"e": 1}}}}, "g": None, "f": 2}, "s")) == {"s.f": 2.0}


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_the_command_writes_what_other_programs_read(campaign, suffix, capsys):
    folder, _ = campaign
    if suffix == "parquet":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra export)")
    path = folder / f"campaign.{suffix}"
    with pytest.raises(SystemExit) as ended:
        main(["table", str(path), "--configfile", str(folder / "config.yaml")])
    assert ended.value.code == 0
    expect_facts(capsys.readouterr().out, 2, 1)
    if suffix == "csv":
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["normals.sigma.median_deg"] for row in rows] == ["0.5", ""]
    else:
        from pyarrow import parquet

        rows = parquet.read_table(path).to_pylist()
        assert [row["normals.sigma.median_deg"] for row in rows] == [0.5, None]
    assert [row["scene"] for row in rows] == ["vase", "cup"]


def test_another_kind_of_file_is_refused(campaign, capsys):
    folder, _ = campaign
    with pytest.raises(SystemExit) as ended:
        main(["table", "campaign.xlsx", "--configfile", str(folder / "config.yaml")])
    assert ended.value.code == 2
    assert ".csv or .parquet" in capsys.readouterr().err
