"""The page of a turntable scene: with everything, with the least, and its parts."""

import importlib
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from pages import make_artifact, parsed
from refusals import expect_facts

from nishiki.artifacts.artifact import ArtifactWriter
from nishiki.artifacts.stage import Context
from nishiki.atlas.atlas import Atlas
from nishiki.brdf.texels.parameters import ParameterMaps, Parameters, ParameterWriter, TexelFlag
from nishiki.geometry.camera import Camera, save_cameras
from nishiki.progress import Progress
from nishiki.report.scene_page import fact_rows
from nishiki.stages.brdf import OBJECT_OUTPUTS, ObjectBrdfSettings
from nishiki.stages.cameras import CamerasSettings
from nishiki.stages.evaluate import ObjectEvaluateSettings
from nishiki.stages.ingest import IngestSettings
from nishiki.stages.mesh import MeshSettings
from nishiki.stages.polarise import PolariseSettings
from nishiki.stages.render import ObjectRenderSettings
from nishiki.stages.report import ObjectReportSettings
from nishiki.stages.report.capture import facts_of_object
from nishiki.stages.report.object import CAMERAS, SURFACE, at_a_glance, parameter_figures, separation, turn_plot
from nishiki.stages.residual import ResidualSettings
from nishiki.stages.texels import TexelsSettings

PROJECT = Path(__file__).resolve().parents[2]
STAMP = {"scene": "small", "stage": "object_report", "key": "0" * 12, "version": "0.1.0"}
TITLE = 'Jar <b>&"quoted"</b>'
VIEWS = ["000", "001", "002", "003"]


def script():
    """The stage's module."""
    return importlib.import_module("nishiki.stages.report.object")


def artifact(root, settings, fill):
    return make_artifact(root, settings, fill, stamp=STAMP)


def ring():
    cameras = []
    for k, name in enumerate(VIEWS):
        turn = np.pi / 2 * k
        rotation = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, -1, 0], [-np.sin(turn), 0, -np.cos(turn)]])
        cameras.append(Camera(name, np.eye(3), rotation, np.array([0.0, 0, 100]), 20, 30))
    return cameras


def ingest(_):
    return {
        "capture": {
            "title": TITLE,
            "camera": {"encoding": "linear", "bits": 12, "model": None},
            "lights": {"kind": "camera"},
            "turntable": {"full_turn": True},
            "creator": "somebody",
        },
        "views": VIEWS,
        "states": ["off", "on"],
        "rows": 20,
        "columns": 30,
        "channels": ["red", "green", "blue"],
        "warnings": ["view 002 is dark"],
    }


def cameras_of(writer):
    settings = dict(unit="mm", full_turn=True, source="matrices", reprojection_px=[None] * 4)
    save_cameras(writer.path("cameras.json"), ring(), **settings)
    return {
        "source": "boards",
        "unit": "mm",
        "circle": {
            "axis": [0, 1, 0],
            "centre": [0, 0, 0],
            "radius": 100.0,
            "off_plane": 1e-17,
            "steps_deg": [90.0] * 4,
        },
        "reprojection_px": {"000": 0.25, "001": 0.5, "002": None},
    }


def atlas(size=8):
    """Two charts: of 1 x 2 cells with one tile missing, and of 1 x 1."""
    return Atlas(
        size,
        np.zeros(0, np.int32),
        np.zeros((0, 3, 2), np.float32),
        np.array([[0, 1, 2], [2, 1, 1]], np.int32),
        np.array([0, -1, 1], np.int32),
        np.array([0, 1], np.int32),
        np.array([[0, 0], [0, 0]], np.int32),
        np.ones((2, 2)),
    )


def texels_of(writer):
    atlas().save(writer.path("atlas.npz"))


def reflection_of(writer):
    out = ParameterWriter(writer.folder, OBJECT_OUTPUTS, (2, 8, 8, 3), stamp=STAMP)
    rng = np.random.default_rng(0)
    for tile in range(2):
        flags = np.zeros((8, 8), np.uint8)
        flags[0] = TexelFlag.OUTSIDE
        kd, ks = rng.random((2, 8, 8, 3), np.float32)
        out.write(tile, Parameters(kd, ks, np.full((8, 8), 0.2, np.float32), flags))
    shares = {"highlight_share": 0.5, "filled_share": 0.25, "unseen_share": 0.0}
    return {**shares, "median_sigma": 0.2, "lighting": "camera", "texels": 112, "samples": 999, "psnr_db": 34.56}


def residual_of(_):
    curve = [{"bytes": 1000 * k, "psnr_db": 30.0 + k, "step": 0.1, "kept": k} for k in (3, 1, 2)]
    return {
        "psnr_db": 44.4, "model_psnr_db": 30.1, "kept": 123, "kept_of_all": 0.01, "kept_of_visible": 0.03, "tiles": 2,
        "empty_tiles": 1, "step": 0.01, "bits_per_pixel": 0.5, "pixels": 900, "curve": curve,
        "bytes": {"total": 3000, "parameters": 700}, "pictures": None,
        "renderer_bytes": {"mesh": 500, "charts": 80, "cameras": 60, "lamps": 60, "total": 3700},
    }  # fmt: skip


def evaluation_of(writer):
    picture = np.full((5, 7, 3), 90, np.uint8)
    np.savez(writer.path("compare-000.npz"), photograph=picture, rendered=picture, model=picture, error=picture)
    figures = {"views": 3, "mean_psnr_db": 41.5, "worst_psnr_db": 40.0, "pooled_psnr_db": 41.0, "mean_similarity": 0.9}
    figures |= {"mean_covered_psnr_db": 42.0, "uncovered_pixels": 3, "superfluous_pixels": 2, "pixels": 900}
    row = {"view": "000", "light": "", "left_out": False, "picture": "decoded", "against": "photograph", "pixels": 9}
    row |= {
        "psnr_db": 41.5,
        "covered_psnr_db": 42.0,
        "similarity": None,
        "uncovered_pixels": 3,
        "superfluous_pixels": 2,
    }
    sizes = {"mesh": 500, "residual_parameters": 200, "residual_total": 3000, "total": 3700}
    evaluation = {
        "figures": {"captured": figures, "left_out_interpolated": {**figures, "mean_psnr_db": 33.25}},
        "left_out": {"views": ["003"], "used": "interpolated"},
        "rows": [row],
        "encoding": "linear",
        "bytes": sizes,
        "pictures": [{"view": "000", "left_out": False, "file": "compare-000.png", "arrays": "compare-000.npz"}],
    }
    writer.path("evaluation.json").write_text(json.dumps(evaluation))
    return {"psnr": evaluation["figures"], "bytes": sizes, "bits_per_object_pixel": 0.75}


def render_of(writer):
    done, data = cv2.imencode(".png", np.full((6, 8, 3), 120, np.uint8))
    assert done
    for name in ("view-000", "view-003-predicted", "between-000-001"):
        writer.path(f"{name}.png").write_bytes(data.tobytes())
    writer.path("turn.mp4").write_bytes(b"\0" * 2000)
    pictures = {name: {"pixels": 9} for name in ("view-000", "view-003-predicted", "between-000-001")}
    return {"pictures": pictures, "video": {"frames": 12, "file": "turn.mp4"}, "notes": ["a note"]}


def mesh_of(writer):
    cv2.imwrite(str(writer.path("preview.png")), np.zeros((4, 12, 3), np.uint8))
    fit = {"iou_mean": 0.987, "iou_least": 0.98, "iou_held_out": None}
    return {"triangles": 1234, "vertices": 619, "watertight": True, "cleaned": {"degenerate": 2}, "fit": fit}


def polarise_of(writer):
    view = {"diffuse": 0.04, "specular": 0.008, "negative": 0.3, "doubtful": 0.01}
    pictures = {"pictures/002_040_side_by_side.png": "040"}
    for file in pictures if writer else ():
        writer.path(file).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(writer.path(file)), np.zeros((4, 12, 3), np.uint8))
    return {
        "by_view": [view, {**view, "diffuse": 0.06}],
        "boards": {"lamp": {"channel": [0.4, 0.41, 0.37]}},
        "unit": "full scale",
        "pictures": pictures,
    }


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    root = tmp_path_factory.mktemp("artifacts")
    made = [
        artifact(root, IngestSettings(), ingest),
        artifact(root, CamerasSettings(), cameras_of),
        artifact(root, MeshSettings(), mesh_of),
        artifact(root, PolariseSettings(), polarise_of),
        artifact(root, TexelsSettings(hold_out=("003",)), texels_of),
        artifact(root, ObjectBrdfSettings(), reflection_of),
        artifact(root, ResidualSettings(), residual_of),
        artifact(root, ObjectRenderSettings(), render_of),
        artifact(root, ObjectEvaluateSettings(), evaluation_of),
    ]
    return {item.stage: item for item in made}


def page_of(folder, inputs, **settings):
    with ArtifactWriter(folder) as writer:
        context = Context(inputs, ObjectReportSettings(**settings), writer, None, None, STAMP, Progress("test"))
        diagnostics = script().run(context)
        text = writer.path("report.html").read_text(encoding="utf-8")
    assert diagnostics["bytes"] == len(text.encode())
    assert diagnostics["stages"] == sorted(inputs)
    return text


def test_the_whole_page(inputs, tmp_path):
    text = page_of(tmp_path / "one", inputs, left_out={"separate": "not asked for"})
    parsed(text)
    assert '<b>&"quoted"' not in text
    assert "Jar &lt;b&gt;" in text
    for expected in ("41.5", "33.2", "44.4", "34.6", "002", "0.987", "000", "001", "003", "not asked for", "a note",
                     "0.400", "11.5", "somebody", "12 frames", "0.375"):  # fmt: skip
        assert expected in text, expected
    assert text.count("out)</title>") == 1
    assert len(re.findall(r"<video", text)) == 1


def test_the_least(inputs, tmp_path):
    few = {name: inputs[name] for name in ("ingest", "cameras")}
    text = page_of(tmp_path / "few", few, title="Another")
    parser = parsed(text)
    assert "<h1>Another</h1>" in text
    for section in ("model", "residual", "comparison", "views", "separation", "rendered", "geometry"):
        assert section not in parser.ids
    assert {"cameras", "made", "verify"} <= parser.ids


def test_a_series_from_one_place_has_no_cameras(inputs, tmp_path):
    text = page_of(tmp_path / "series", {name: inputs[name] for name in ("ingest", "polarise")})
    parser = parsed(text)
    assert "cameras" not in parser.ids
    assert {"separation", "made", "verify"} <= parser.ids
    assert "040" in text


def test_a_separation_without_boards_tells_of_none():
    boards = [label for label, _ in separation({**polarise_of(None), "boards": {"": None}}) if "board" in label]
    assert boards == []
    rows = separation(polarise_of(None))
    expect_facts("; ".join(f"{label} {value}" for label, value in rows), "0.0500", "0.00800", "full scale")
    expect_facts(" ".join(map(str, rows[-1])), "lamp", "0.400", "0.410", "0.370")
    smoothed = [{**view, "changed": {"diffuse": 0.001, "specular": 0.004}} for view in polarise_of(None)["by_view"]]
    changed = [value for label, value in separation({**polarise_of(None), "by_view": smoothed}) if "smoothing" in label]
    assert [value.split()[0] for value in changed] == ["0.00400", "0.00100"]


def test_a_large_video_is_named_not_carried(inputs, tmp_path):
    text = page_of(tmp_path / "video", inputs, video_mb=0.001)
    assert "<video" not in text
    assert "object_render/aaaaaaaaaaaa/turn.mp4" in text


def test_parameters_round_trip(inputs):
    maps = ParameterMaps(inputs["object_brdf"].folder)
    assert (maps.tiles, maps.size, maps.channels) == (2, 8, 3)
    part = maps.read(1)
    assert part.kd.shape == (8, 8, 3)
    assert part.flags[0, 0] == TexelFlag.OUTSIDE
    assert np.all(part.sigma == np.float32(0.2))


def test_sheets_of_gloss_only_where_there_is_any():
    parameters = np.full((6, 9, 7), 0.2, np.float32)
    assert len(parameter_figures(parameters)) == 3
    parameters[..., 3:6] = 0
    assert len(parameter_figures(parameters)) == 1


def test_drawings():
    centres = np.array([camera.centre for camera in ring()])
    drawing = turn_plot(centres, VIEWS, {"001"})
    places = [tuple(map(float, found)) for found in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="4.5"', drawing)]
    assert len(places) == 3
    radii = [np.hypot(x - 170, y - 170) for x, y in places]
    np.testing.assert_allclose(radii, radii[0], atol=0.2)
    assert drawing.count(" out") == 1
    assert turn_plot(np.zeros((1, 3)), ["a"], set()).startswith("<svg")


def test_sections_of_little():
    assert fact_rows({"triangles": 5}, SURFACE) == [("triangles", 5)]
    assert [value for _, value in fact_rows({"parts": 1, "genus": 0, "watertight": False}, SURFACE)] == ["no", 1, 0]
    assert at_a_glance({}) == []
    sizes = {"bytes": {"total": 3000}, "renderer_bytes": {"mesh": 700, "total": 3700}}
    assert [tile.value for tile in at_a_glance({"residual": sizes})] == [3.7]
    assert fact_rows({}, CAMERAS) == []
    told = ingest(None)
    told["capture"] = {"camera": {}, "lights": None, "turntable": {}}
    assert "Lighting" in dict(facts_of_object(told))
