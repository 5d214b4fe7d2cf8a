"""The page of a cloth: with everything, with the least, and its parts."""

import importlib
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks.cloth_peers import Ward
from pages import make_artifact, parsed
from refusals import expect_facts

from nishiki.artifacts.artifact import ArtifactWriter
from nishiki.artifacts.provenance import module_of
from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.models import MODELS
from nishiki.brdf.cloth.store import save_brdf
from nishiki.goniometry.directions import unit
from nishiki.goniometry.hemisphere import complete
from nishiki.goniometry.table import ReflectanceSet, write_reflectances
from nishiki.progress import Progress
from nishiki.report.svg import BOTTOM
from nishiki.stages.evaluate import ClothEvaluateSettings
from nishiki.stages.goniometer_samples import OUTPUTS, GoniometerSamplesSettings
from nishiki.stages.render import ClothRenderSettings
from nishiki.stages.report import ClothReportSettings
from nishiki.stages.report.cloth import (
    YARN_MEANINGS,
    curve,
    notes,
    parameters,
    section_words,
    summary,
    tile_picture,
    yarn_table,
)
from nishiki.stages.report.cloth_reflection import disc_directions, disc_picture, error_chart, lobes_plot, plane_chart
from nishiki.stages.weave import WeaveSettings

PROJECT = Path(__file__).resolve().parents[2]
STAMP = {"scene": "small", "stage": "cloth_report", "key": "0" * 12, "version": "0.1.0"}
TITLE = 'Robe <b>&"quoted"</b>'
WARD = Ward(diffuse=np.array([0.02]), specular=np.array([0.2]), alpha_x=0.5, alpha_y=0.2)
PART = {"incidences": 1, "views": 9, "rms_rel": 0.1234, "worst_rms_rel": 0.2}
PART |= {"peak_value_rel": 0.25, "peak_direction_deg": 3.5}
ROW = {"theta_i_deg": 30.0, "phi_i_deg": 90.0, "plane": "warp", "views": 9, "rms_rel": 0.1234, "bias_rel": -0.01}
ROW |= {"peak_direction_deg": None, "peak_value_rel": None, "noise_rel": 0.004}


def script(name="cloth_report"):
    """A stage's module."""
    return importlib.import_module(f"nishiki.stages.{module_of(name)}")


def artifact(root, stage, settings, fill):
    return make_artifact(root, settings, fill, stamp=STAMP, stage=stage)


def measured():
    theta, phi = np.meshgrid(np.radians(np.arange(5, 90, 10)), np.radians(np.arange(0, 91, 15)))
    views = np.concatenate([[[0, 0, 1.0]], unit(theta.ravel(), phi.ravel())])
    incident = np.tile([0, 0, 1.0], (len(views), 1))
    found = ReflectanceSet.of(incident, views, WARD.evaluate(incident, views))
    return complete(found, grid_deg=10)[0]


def reflectance_of(writer):
    light = {"theta_deg": 0.0, "phi_deg": 0.0, "views": 64, "unusable": 1, "covered": 0.875, "gap_deg": 9.0}
    more = {"coverage": [{**light, "steepest_deg": 85.0}]}
    write_reflectances(writer.folder, OUTPUTS, measured(), more=more)
    writer.path("coverage.svg").write_text('<svg viewBox="0 0 9 9"><circle cx="4" cy="4" r="3"/></svg>')
    return {"directions": 64, "incidences": 1, "normal_incidence": 64, "regions": ["cloth"], "channels": ["grey"],
            "symmetry": "quarter", "symmetry_errors": None, "weave": "satin", "noise_relative": 0.0123}  # fmt: skip


def cloth_of(writer):
    for name in ("facets", "ward"):
        save_brdf(writer.path(f"models/cloth/{name}.npz"), WARD)
    told = {name: {"used": [0, 1], "seconds": None, "albedo": 0.25, "words": "x"} for name in ("facets", "ward")}
    text = json.dumps({"default": "facets", "regions": ["cloth"], "models": {"cloth": told}})
    writer.path("cloth_brdf.json").write_text(text)
    facts = {"used": 564, "reciprocity_error": 0.01234, "albedo_max": {"0": 0.25, "60": 1.75}}
    return {"default": "facets", "regions": {"cloth": {"facets": facts, "ward": {"used": 3}}}}


NUMBER = {"value": 0.5, "low": 0.4, "high": 0.6, "determined": True}
YARNS = {
    "alike": ["satin of 5 yarns, step 2", "twill of 6 yarns"], "ranking": [{}] * 12, "rms_rel": 0.045, "variation": 0.3,
    "determined": True,
    "parameters": dict.fromkeys(YARN_MEANINGS, NUMBER) | {"spacing_ratio": {**NUMBER, "determined": False}},
}  # fmt: skip


def test_a_weave_is_not_stated_where_the_data_do_not_tell_it():
    text = summary({"yarns": YARNS})
    expect_facts(text, 12, *YARNS["alike"])
    text = summary({"yarns": {**YARNS, "variation": 0.05, "determined": False}})
    assert "5.0 %" in text
    rows = {row[0]: row[1] for row in yarn_table(YARNS, 0.95).rows}
    assert isinstance(rows[YARN_MEANINGS["spacing_ratio"]], str)
    assert rows[YARN_MEANINGS["aspect_warp"]] == 0.5


def png(shape=(6, 8)):
    done, data = cv2.imencode(".png", np.full((*shape, 3), 120, np.uint8))
    assert done
    return data.tobytes()


def weave_of(writer):
    plane = {"theta_r_deg": [10.0, 20.0, 40.0], "measured": [0.1, 0.2, 0.3],
             "gloss": [0.05, 0.1, 0.1], "body": [0.04, 0.1, 0.1], "interpolated": False}  # fmt: skip
    entry = {
        "weave": "satin", "harness": 5, "weft": {"theta_a": 0.5, "n": 4.0}, "warp": {"theta_a": 0.2, "m": 0.3},
        "rms_rel": {"weft": 0.0321, "warp": 0.05}, "curves": {"weft": plane, "warp": plane},
        "identifiability": {"free": ["l_warp · r_warp"], "weak": ["r_warp", "k_s · index"], "weak_error": [12.0, 0.25]},
        "at_bounds": ["index"], "yarns": YARNS,
    }  # fmt: skip
    writer.path("weave.json").write_text(json.dumps({"format": 1, "regions": {"cloth": entry}}))
    for name in ("weft", "warp"):
        writer.path(f"section_{name}.svg").write_text(f'<svg viewBox="0 0 9 9"><title>{name}</title></svg>')
    writer.path("weave.png").write_bytes(png((90, 20)))
    told = {"parameters": {"theta_a_weft": 0.5, "k_s": 1.5}, "intervals": {"theta_a_weft": [0.25, 0.75]}}
    return {"regions": {"cloth": told}}


def render_of(writer):
    names = ("drape", "drape-light-left", "drape-dye-red", "drape-dye-gold", "cylinders")
    for name in names:
        writer.path(f"{name}.png").write_bytes(png())
    writer.path("film.mp4").write_bytes(b"\0" * 2000)
    return {"model": "facets", "pictures": {name: {} for name in names}, "notes": ["a note"],
            "video": {"file": "film.mp4", "frames": 96}}  # fmt: skip


def evaluation_of(writer):
    kind = {"measurements": 9, "rows": [ROW], "by_incidence": {"30": PART}}
    none = {"measurements": 0, "rows": [], "by_incidence": {}}
    models = {
        "facets": {"facts": {}, "reference": False, "held_out": kind, "fitted": kind},
        "bard_linear": {"facts": {}, "reference": True, "held_out": kind, "fitted": none},
    }
    line = {"theta_i_deg": 30.0, "phi_i_deg": 90.0, "plane": "warp", "theta_r_deg": [-10.0, 0.0, 20.0]}
    line |= {"held_out": [True] * 3, "measured": [0.1, 0.2, 0.1], "predicted": {"facets": [0.1, 0.2, 0.2]}}
    region = {"valid": 99, "held_out": 9, "models": models, "curves": [line, {**line, "held_out": [False] * 3}]}
    text = json.dumps({"default": "facets", "regions": {"cloth": region}})
    writer.path("evaluation.json").write_text(text)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    root = tmp_path_factory.mktemp("artifacts")
    made = [
        artifact(root, "goniometer_samples", GoniometerSamplesSettings(), reflectance_of),
        artifact(root, "weave", WeaveSettings(), weave_of),
        artifact(root, "cloth_brdf", None, cloth_of),
        artifact(root, "cloth_render", ClothRenderSettings(supersampling=2), render_of),
        artifact(root, "cloth_evaluate", ClothEvaluateSettings(), evaluation_of),
    ]
    return {item.stage: item for item in made}


def page_of(folder, inputs, **settings):
    with ArtifactWriter(folder) as writer:
        context = Context(inputs, ClothReportSettings(**settings), writer, None, None, STAMP, Progress("test"))
        module = script()
        # The page's records need only stages that are in the table; the parts here are those of any table.
        diagnostics = module.run(context)
        text = writer.path("report.html").read_text(encoding="utf-8")
    assert diagnostics["bytes"] == len(text.encode())
    assert diagnostics["stages"] == sorted(inputs)
    return text


def test_the_whole_page(inputs, tmp_path):
    text = page_of(tmp_path / "one", inputs, title=TITLE, left_out={"ingest": "not asked for"})
    parsed(text)
    assert '<b>&"quoted"' not in text
    assert "Robe &lt;b&gt;" in text
    for expected in ("BARD", "0.123", "25 %, 3.5°", "Gold", "Red",
                     "satin of 5", "3.2 %",
                     "28.6", "43", "not asked for", "a note", "30°", "87.50", "96",
                     "0.250", "1.75", "0.0123", "Coverage", "1.23"):  # fmt: skip
        assert expected in text, expected
    assert len(re.findall(r"<video", text)) == 1


def test_the_least(inputs, tmp_path):
    text = page_of(tmp_path / "few", {"goniometer_samples": inputs["goniometer_samples"]})
    parser = parsed(text)
    assert "<h1>small</h1>" in text
    for section in ("rendered", "weave", "lobes", "errors", "curves"):
        assert section not in parser.ids
        assert f'"#{section}"' not in text
    assert {"coverage", "made", "verify"} <= parser.ids


def test_a_large_video_is_named_not_carried(inputs, tmp_path):
    text = page_of(tmp_path / "video", inputs, video_mb=0.001)
    assert "<video" not in text
    assert "cloth_render/aaaaaaaaaaaa/film.mp4" in text


def test_discs_show_every_view_once():
    views, inside = disc_directions(40)
    assert np.allclose(np.linalg.norm(views, axis=1), 1)
    assert np.all(views[:, 2] > 0)
    assert inside.sum() == len(views)
    picture = disc_picture(np.linspace(0.01, 1, len(views)), inside, 0.01, 1.0)
    assert (picture.columns, picture.rows) == (40, 40)
    image = np.zeros(inside.shape)
    image[inside] = views[:, 0]
    assert image[20, 35] > 0.5  # weft to the right
    image[inside] = views[:, 1]
    assert image[5, 20] > 0.5  # warp upwards


def test_lobes_are_drawn_towards_the_light():
    directions = []
    svg = lobes_plot(lambda degrees, azimuth, along: directions.append(along) or along[:, 1], "warp")
    assert svg.count("<path") == 6  # three lobes and their lines in the legend
    np.testing.assert_allclose(directions[0][-1], [0, np.sin(np.radians(80)), np.cos(np.radians(80))], atol=1e-12)


def test_every_model_of_the_error_chart_has_a_line_of_its_own_within_the_drawing():
    names = [*MODELS, "facets", "ward"]
    models = {name: {"15": {"rms_rel": 0.02 * 2**k}, "75": {"rms_rel": 0.05 * 2**k}} for k, name in enumerate(names)}
    svg = error_chart(models, "yarn_facets")
    lines = re.findall(r'<path d="M([^"]*)" fill="none" stroke="(#[0-9a-f]*)" stroke-width="1.8"([^/]*)/>', svg)
    assert len({(colour, dash) for _, colour, dash in lines}) == len(names)
    height = [float(point.split()[1]) for points, _, _ in lines for point in points.split("L")]
    assert len(set(height)) == len(height)  # none ends at the edge
    floor = float(re.search(r'viewBox="0 0 \d+ (\d+)"', svg)[1]) - BOTTOM
    assert floor - 286 < min(height)
    assert max(height) < floor


def test_charts_without_anything_to_show():
    assert error_chart({}, "facets") == ""
    assert error_chart({"facets": {}}, "facets") == ""
    line = {"theta_r_deg": [0.0, 1.0], "measured": [0.0, 0.0], "predicted": {}}
    assert plane_chart(line, ["facets"], "facets").startswith("<svg")


def test_parts_of_the_weave():
    told = {"parameters": {"theta_a_weft": np.pi / 6, "k_s": 2.0, "n_weft": 4.0}, "intervals": {"n_weft": [3.0, 5.0]}}
    rows = {name: rest for name, *rest in parameters(told)}
    assert rows["theta_a_weft"][0] == pytest.approx(30)
    assert rows["theta_a_weft"][1] is None
    assert rows["n_weft"][1:3] == [3.0, 5.0]
    assert rows["n_weft"][3].endswith(", weft")
    assert "gloss" in rows["k_s"][3]
    assert notes({}) == []
    told = notes({"identifiability": {"free": ["l_warp · r_warp", "k_s^0.3 · index"]}, "at_bounds": ["flank_weft"]})
    assert ["index" in told[0], "flank_weft" in told[1], len(told)] == [True, True, 2]
    expect_facts(section_words({"theta_a": np.pi / 4, "n": 1.0}), "45.0°")
    expect_facts(section_words({"theta_a": np.pi / 4, "n": 4.0}), "45.0°", 4)
    values = {"theta_r_deg": [10.0, 20.0], "measured": [0.1, 0.2], "gloss": [0.05, 0.1], "body": [0.05, 0.1]}
    drawn = curve({**values, "interpolated": True}, "warp")
    assert ">interpolated<" in drawn.svg
    tile = tile_picture(png((900, 300)), 100)
    assert (tile.columns, tile.rows) == (100, 100)
    with pytest.raises(ValueError, match="not a picture"):
        tile_picture(b"nothing", 100)
