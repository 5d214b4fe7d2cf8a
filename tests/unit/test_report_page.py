"""The whole page of small scenes, from capture to HTML, and the evaluation behind it."""

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from captures import make_capture
from markupsafe import escape
from pages import make_artifact, parsed
from refusals import refused

from nishiki.artifacts.artifact import Artifact, open_artifact
from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.artifacts.provenance import module_of
from nishiki.artifacts.stage import Context
from nishiki.capture.folder import load_capture
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.engine.project import truth_digest
from nishiki.errors import UserError
from nishiki.evaluate.relighting import stated_levels
from nishiki.observations.plane import Observations
from nishiki.observations.plane_store import write_observations
from nishiki.progress import Progress
from nishiki.stages.brdf import BrdfSettings
from nishiki.stages.evaluate import EvaluateSettings
from nishiki.stages.height import HeightSettings
from nishiki.stages.ingest import IngestSettings
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.render import RenderSettings
from nishiki.stages.report import ReportSettings
from nishiki.stages.spectra import SpectraSettings

PROJECT = Path(__file__).resolve().parents[2]
STAMP = {"scene": "small", "stage": "report", "key": "0" * 12, "version": "0.1.0"}
TITLE = 'Tea caddy <b>&"quoted"</b>'


def script(name: str):
    """A stage's module."""
    return importlib.import_module(f"nishiki.stages.{module_of(name)}")


def artifact(root: Path, settings, fill) -> Artifact:
    """An artifact whose files `fill(writer)` makes; what it returns becomes the diagnostics."""
    return make_artifact(root, settings, fill, stamp=STAMP)


def run(root: Path, name: str, inputs, settings, *, truth=None) -> Artifact:
    """A stage by its script's own function."""
    module = script(name)
    return artifact(
        root, settings, lambda writer: module.run(Context(inputs, settings, writer, None, truth, STAMP, Progress("t")))
    )


def ingested(root: Path, *, channels: str, **options) -> Artifact:
    capture = load_capture(make_capture(root / "capture", yaml_extra={"title": TITLE}, **options))

    def fill(writer):
        found = write_observations(
            capture, writer.folder, settings=IngestSettings(channels=channels), progress=Progress("t")
        )
        curves = {}
        if channels == "all":
            centres = np.array([[610.0], [540.0], [450.0]])
            curves = {
                "illuminant": np.linspace(50, 150, 61),
                "sensitivities": np.exp(-0.5 * ((WAVELENGTHS_NM - centres) / 35) ** 2),
            }
        np.savez(writer.path("curves.npz"), **curves)
        return {"capture": capture.settings.model_dump(mode="json"), **found}

    return artifact(root, IngestSettings(channels=channels), fill)


def exact_normals(root: Path, ingest: Artifact) -> Artifact:
    """The flat plane that was photographed: its reflectance is the first photograph, taken from above."""
    frames = Observations(ingest.folder)
    rows, columns = frames.shape

    def fill(writer):
        maps = MapWriter(writer.folder, rows=rows, columns=columns, band_rows=16, stamp=STAMP)
        normals = np.zeros((rows, columns, 3), np.float32)
        normals[..., 2] = 1
        flags = np.zeros((rows, columns), np.uint8)
        flags[0, 0] = 1
        reflectance = frames.read(slice(0, rows), lights=np.array([0]))[0][0]
        maps.write("normals", normals)
        maps.write("reflectance", reflectance)
        maps.write("sigma", np.full((rows, columns), 0.01, np.float32))
        maps.write("lights_used", np.full((rows, columns), 4, np.uint16))
        maps.write("flags", flags)
        return {"object_pixels": rows * columns, "valid_pixels": rows * columns - 1, "sigma_median_deg": 0.5}

    return artifact(root, NormalsSettings(), fill)


def others(root: Path, ingest: Artifact) -> dict[str, Artifact]:
    """Height, spectra, gloss and a picture of the flat plane."""
    frames = Observations(ingest.folder)
    rows, columns = frames.shape
    random = np.random.default_rng(5)

    def height(writer):
        maps = MapWriter(writer.folder, rows=rows, columns=columns, band_rows=16, stamp=STAMP)
        maps.write("height", np.zeros((rows, columns), np.float32), unit="mm")
        return {"bow": 0.3}

    def spectra(writer):
        maps = MapWriter(writer.folder, rows=rows, columns=columns, band_rows=16, stamp=STAMP)
        basis = np.stack([np.ones(61), np.linspace(0, 1, 61)])
        values = random.random((rows, columns, 2)).astype(np.float32) * 0.4
        maps.write("coefficients", values, basis=basis.tolist())
        maps.write("sigma", np.full((rows, columns), 0.02, np.float32), profile=[1.0] * 61)
        maps.write("flags", np.zeros((rows, columns), np.uint8))

    def brdf(writer):
        phi = np.linspace(0, 1, 40)
        lobe = (0.5 * 2.0 ** -((phi / 0.2) ** 2)).tolist()
        profile = {"phi": phi.tolist(), "value": lobe, "count": [9] * 40, "fitted": lobe}
        region = {"beta": [0.0], "gamma": [0.2], "refractive_index": 1.45, "samples": 9, "residual": 0.1, "flags": "0"}
        parameters = {"regions": [region | {"profile": profile, "transmission": 0.0}]}
        writer.path("parameters.json").write_text(json.dumps(parameters))

    def render(writer):
        import cv2

        picture = random.integers(0, 255, (rows, columns, 3)).astype(np.uint8)
        names = [picture.name for picture in RenderSettings().pictures]
        for name in names:
            writer.path(f"{name}.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())
        writer.path("moving-light.mp4").write_bytes(b"0" * 3_000_000)
        film = {"moving-light": {"file": "moving-light.mp4", "exposure": 1.0}}
        return {"pictures": {name: {"exposure": 1.5} for name in names} | film, "notes": []}

    made = ((HeightSettings, height), (SpectraSettings, spectra), (BrdfSettings, brdf), (RenderSettings, render))
    return {settings.STAGE: artifact(root, settings(), fill) for settings, fill in made}


def plane_truth(folder: Path) -> Path:
    folder.mkdir()
    normals = np.zeros((24, 32, 3), np.float32)
    normals[..., 2] = 1
    np.savez(folder / "normals.npz", normals=normals)
    return folder


@pytest.fixture(scope="module")
def full(tmp_path_factory) -> dict[str, Artifact]:
    """A scene of all stages with a check light and a truth."""
    root = tmp_path_factory.mktemp("full")
    ingest = ingested(root, channels="all")
    inputs = {"ingest": ingest, "normals": exact_normals(root, ingest), **others(root, ingest)}
    truth = plane_truth(root / "truth")
    settings = EvaluateSettings(truth_sha256=truth_digest(truth))
    chosen = {name: inputs[name] for name in ("ingest", "normals", "height", "spectra", "brdf")}
    return inputs | {"evaluate": run(root, "evaluate", chosen, settings, truth=truth)}


@pytest.fixture(scope="module")
def report(full, tmp_path_factory) -> Artifact:
    return run(tmp_path_factory.mktemp("report"), "report", full, ReportSettings())


@pytest.fixture(scope="module")
def page(report) -> str:
    return report.path("report.html").read_text(encoding="utf-8")


def test_evaluation_of_an_exact_record_finds_only_quantisation(full):
    found = json.loads(full["evaluate"].path("evaluation.json").read_text())
    (light,) = found["lights"]
    assert light["role"] == "check"
    # 12 bits of which a dark level of 100 and a white at 80 % are used: steps of 3e-4, errors of some 1e-4
    assert light["psnr_linear_db"] > 60
    assert light["de00"]["mean"] < 0.1
    assert light["excluded"] == {"saturated_or_clipped": 0, "no_estimate": 1, "not_finite": 0}
    assert light["by_class"]["diffuse"]["de00"]["count"] == 24 * 32 - 1
    assert found["normals"]["estimated"]["worst"] < 1e-5
    assert found["height"] is None
    assert found["overall"]["levels"]["fadgi"] == "4 stars"
    assert sum(part["share"] for part in found["parts"]) == pytest.approx(1)
    assert all(abs(light["level_error"]) < 0.01 for part in found["parts"] for light in part["lights"])


def test_the_worst_part_decides_the_level_and_a_wrong_tone_has_none():
    lights = [{"level_error": 0.02}, {"level_error": -0.06}]
    good = {"de00": {"mean": 1.0, "p90": 2.0}, "lights": lights}
    worse = {"de00": {"mean": 4.2, "p90": 8.0}, "lights": lights}
    assert stated_levels([good]) == {"fadgi": "4 stars", "iso_19264": "A"}
    assert stated_levels([good, worse]) == {"fadgi": "2 stars", "iso_19264": "B"}
    assert set(stated_levels([{**good, "lights": [*lights, {"level_error": -0.12}]}]).values()) == {"none"}


def test_evaluation_maps_and_table_agree_with_the_figures(full):
    maps = Maps(full["evaluate"].folder)
    found = json.loads(full["evaluate"].path("evaluation.json").read_text())
    index = found["lights"][0]["index"]
    difference = maps.read(f"de00_{index:03d}")
    assert np.isnan(difference[0, 0])
    assert np.nanmean(difference) == pytest.approx(found["lights"][0]["de00"]["mean"], rel=1e-5)
    assert "light L05," in full["evaluate"].path("evaluation.csv").read_text()


def test_a_truth_that_changed_since_the_plan_is_refused(full, tmp_path):
    truth = plane_truth(tmp_path / "truth")
    inputs = {name: full[name] for name in ("ingest", "normals")}
    with refused(UserError, by="planned_truth"):
        run(tmp_path, "evaluate", inputs, EvaluateSettings(truth_sha256="0" * 64), truth=truth)


def test_the_page_is_whole_and_opens_offline(page):
    sections = {"appearance", "relighting", "shape", "colour", "gloss", "capture", "left-out", "made", "verify"}
    assert sections <= parsed(page).ids
    assert not re.search(r"https?://|@import|url\(|<script|<link", page)
    assert len(page.encode()) < 8e6


def test_diagnostics_state_the_size_of_the_page(report, page):
    assert open_artifact(report.folder).diagnostics["bytes"] == len(page.encode())


def test_a_result_beyond_a_limit_that_warns_is_told_at_the_top(page):
    note = page[page.index('class="note warn"') :]
    assert note.index("set height.flatten: true") < note.index('id="appearance"')


def test_the_title_is_text_not_markup(page):
    assert escape(TITLE) in page
    assert "<b>&" not in page


def test_a_large_video_is_named_not_carried(page):
    assert "<video" not in page
    assert "render/aaaaaaaaaaaa/moving-light.mp4" in page


def test_changed_settings_and_reasons_are_reported(full, tmp_path):
    settings = ReportSettings(title="Own title", left_out={"separate": "its method is set to none"})
    inputs = {name: full[name] for name in ("ingest", "normals")}
    text = run(tmp_path, "report", inputs, settings).path("report.html").read_text(encoding="utf-8")
    assert f"<h1>{settings.title}</h1>" in text
    assert "its method is set to none" in text
    assert 'id="relighting"' not in text


@pytest.mark.slow
def test_a_scene_of_luminance_and_a_mask_has_its_page(tmp_path):
    mask = np.zeros((24, 32), bool)
    mask[4:20, 5:30] = True
    ingest = ingested(tmp_path, channels="luminance", mask=mask, checks=0, white=False)
    inputs = {"ingest": ingest, "normals": exact_normals(tmp_path, ingest)}
    text = run(tmp_path, "report", inputs, ReportSettings(picture_columns=128)).path("report.html").read_text()
    parsed(text)
    assert "52.1 %" in text


def test_left_out_spectra_and_gloss_leave_no_gap(full, tmp_path):
    inputs = {name: full[name] for name in ("ingest", "normals", "height")}
    truthless = run(tmp_path / "e", "evaluate", inputs, EvaluateSettings())
    found = json.loads(truthless.path("evaluation.json").read_text())
    assert (found["normals"], found["reflectance"]) == (None, None)
    assert found["classes_from"] == "model"
    text = (
        run(tmp_path / "r", "report", inputs | {"evaluate": truthless}, ReportSettings())
        .path("report.html")
        .read_text()
    )
    parsed(text)
    assert 'id="gloss"' not in text
    assert 'id="relighting"' in text
