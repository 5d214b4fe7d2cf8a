"""Errors of predicted reflectances: known errors, planes, and the stage."""

import csv
import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.cloth_peers import Ward

from nishiki.artifacts.artifact import ArtifactWriter, open_artifact
from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.store import save_brdf
from nishiki.errors import UserError
from nishiki.goniometry.directions import unit
from nishiki.goniometry.table import ReflectanceSet, write_reflectances
from nishiki.progress import Progress
from nishiki.stages.evaluate import ClothEvaluateSettings
from nishiki.stages.evaluate.cloth import by_incidence, in_plane, judge, plane_name
from nishiki.stages.goniometer_samples import OUTPUTS

PROJECT = Path(__file__).resolve().parents[2]
STAMP = {"scene": "small", "stage": "cloth_evaluate", "key": "0" * 12, "version": "0.1.0"}
TRUE = Ward(diffuse=np.array([0.02]), specular=np.array([0.2]), alpha_x=0.5, alpha_y=0.2)
DULL = Ward(diffuse=np.array([0.02]), specular=np.array([0.1]), alpha_x=0.5, alpha_y=0.2)


def grid(step=15.0):
    """Views every `step` degrees, the normal once."""
    theta, phi = np.meshgrid(np.radians(np.arange(step, 90, step)), np.radians(np.arange(0, 360, step)))
    return np.concatenate([[[0, 0, 1.0]], unit(theta.ravel(), phi.ravel())])


def table(incidences=((0, 0), (30, 0), (30, 90), (60, 45))):
    views = grid()
    incident = np.concatenate([np.tile(unit(*np.radians(light)), (len(views), 1)) for light in incidences])
    outgoing = np.tile(views, (len(incidences), 1))
    return incident, outgoing, TRUE.evaluate(incident, outgoing)


def test_known_errors():
    incident, outgoing, measured = table()
    rows = judge(incident, outgoing, measured, 1.25 * measured, np.zeros_like(measured))
    assert [(row.theta_i_deg, row.plane) for row in rows] == [(0, "any"), (30, "weft"), (30, "warp"), (60, "bias")]
    for row in rows:
        assert row.rms_rel == pytest.approx(0.25)
        assert row.bias_rel == pytest.approx(0.25)
        assert row.peak_value_rel == pytest.approx(0.25)
        assert row.peak_direction_deg == pytest.approx(0)
        assert row.noise_rel is None
        assert row.views == 121
    means = by_incidence(rows)
    assert list(means) == ["0", "30", "60"]
    assert means["30"]["incidences"] == 2
    assert means["30"]["rms_rel"] == pytest.approx(0.25)


def test_noise_is_what_noise_alone_would_give():
    rng = np.random.default_rng(0)
    incident, outgoing, measured = table(((30, 0),))
    measured = np.repeat(measured, 3, axis=1)
    sigma = np.full_like(measured, 0.02)
    found = [
        judge(incident, outgoing, measured + rng.normal(0, 0.02, measured.shape), measured, sigma)[0] for _ in range(40)
    ]
    assert np.sqrt(np.mean([row.rms_rel**2 for row in found])) == pytest.approx(found[0].noise_rel, rel=0.1)


def test_few_views_say_nothing_of_the_peak():
    incident, outgoing, measured = (part[:5] for part in table(((30, 0),)))
    row = judge(incident, outgoing, measured, measured, np.zeros_like(measured))[0]
    assert row.peak_value_rel is None
    assert row.peak_direction_deg is None
    assert by_incidence([row])["30"]["peak_value_rel"] is None


@pytest.mark.parametrize(
    ("phi", "name"),
    [(0, "weft"), (180, "weft"), (90, "warp"), (271, "warp"), (45, "bias"), (135, "bias"), (20, "20°"), (340, "20°")],
)
def test_names_of_planes(phi, name):
    assert plane_name(phi) == name


def test_views_in_a_plane_are_sorted_and_signed():
    views = grid()
    rows, angle = in_plane(views, np.pi / 2)
    assert np.allclose(np.degrees(angle), np.arange(-75, 76, 15))
    assert np.allclose(views[rows, 0], 0, atol=1e-12)
    assert np.allclose(views[rows, 1], np.sin(angle))


def script():
    """The stage's module."""
    return importlib.import_module("nishiki.stages.evaluate.cloth")


def artifact(root, stage, fill):
    with ArtifactWriter(root / stage / ("a" * 12)) as writer:
        fill(writer)
        return writer.finish({**STAMP, "stage": stage, "key": "a" * 12, "settings": {}, "upstream": {},
                              "diagnostics": {}}, {})  # fmt: skip


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    root = tmp_path_factory.mktemp("chain")
    incident, outgoing, values = table()
    measured = ReflectanceSet.of(incident, outgoing, values)
    measured.valid[130] = False
    normal = np.flatnonzero(measured.normal_incidence).tolist()
    models = {
        "true": (TRUE, [*normal, 125, 130]),
        "dull": (DULL, normal),
        "seen": (DULL, np.flatnonzero(measured.valid[:, 0]).tolist()),
    }

    def cloth_brdf(writer):
        for name, (brdf, _) in models.items():
            save_brdf(writer.path(f"models/cloth/{name}.npz"), brdf)
        told = {name: {"used": used, "seconds": 0.5} for name, (_, used) in models.items()}
        text = json.dumps({"default": "true", "regions": ["cloth"], "models": {"cloth": told}})
        writer.path("cloth_brdf.json").write_text(text)

    made = [
        artifact(root, "goniometer_samples", lambda writer: write_reflectances(writer.folder, OUTPUTS, measured)),
        artifact(root, "cloth_brdf", cloth_brdf),
    ]
    return {item.stage: item for item in made}


def evaluated(folder, inputs, **settings):
    with ArtifactWriter(folder) as writer:
        context = Context(inputs, ClothEvaluateSettings(**settings), writer, None, None, STAMP, Progress("test"))
        told = script().run(context)
        writer.finish({**STAMP, "settings": {}, "upstream": {}, "diagnostics": told}, {})
    return open_artifact(folder)


def test_the_stage_judges_all_models_on_the_same_measurements(inputs, tmp_path):
    done = evaluated(tmp_path / ("0" * 12), inputs)
    found = json.loads(done.path("evaluation.json").read_text())["regions"]["cloth"]
    # Four incidences of 121 views; the normal one is used, one measurement is not valid, one more was used.
    assert found["valid"] == 483
    assert found["held_out"] == 3 * 121 - 2
    for model, entry in found["models"].items():
        assert entry["held_out"]["measurements"] == 361, model
    rows = found["models"]["true"]["held_out"]["rows"]
    assert max(row["rms_rel"] for row in rows) < 1e-12
    dull = found["models"]["dull"]["held_out"]["by_incidence"]
    assert 0.3 < dull["30"]["rms_rel"] < 0.6
    assert dull["30"]["peak_value_rel"] == pytest.approx(0.5, abs=0.1)
    assert done.diagnostics["regions"]["cloth"]["references"] == ["seen"]
    told = done.diagnostics["regions"]["cloth"]
    assert told["rms_rel"]["dull"]["60"] == dull["60"]["rms_rel"]
    assert told["rms_rel_default"] == told["rms_rel"][done.diagnostics["default"]]
    with done.path("evaluation.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == sum(len(e[k]["rows"]) for e in found["models"].values() for k in ("held_out", "fitted"))
    assert {row["set"] for row in table} == {"held_out", "fitted"}
    again = evaluated(tmp_path / "again" / ("0" * 12), inputs)
    assert again.digest == done.digest


def test_curves_hold_what_was_measured(inputs, tmp_path):
    done = evaluated(tmp_path / ("0" * 12), inputs, curves=3)
    curves = json.loads(done.path("evaluation.json").read_text())["regions"]["cloth"]["curves"]
    assert [(c["theta_i_deg"], c["plane"]) for c in curves] == [(0, "warp"), (0, "weft"), (30, "warp")]
    for curve in curves:
        assert np.allclose(curve["measured"], curve["predicted"]["true"])
        assert curve["theta_r_deg"] == sorted(curve["theta_r_deg"])
        assert any(curve["held_out"]) == (curve["theta_i_deg"] > 0)
    none = evaluated(tmp_path / "none" / ("0" * 12), inputs, curves=0)
    assert json.loads(none.path("evaluation.json").read_text())["regions"]["cloth"]["curves"] == []


def test_an_unknown_region_is_named(inputs, tmp_path):
    with pytest.raises(UserError, match="velvet"):
        evaluated(tmp_path / ("0" * 12), inputs, regions=("velvet",))
