"""The stage from capture folder to cameras.json: boards, correspondences, matrices, and what is missing."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from boards import COLUMNS, DISTORTION, LENS, ROWS, SHAPE, board_camera, photograph, rotation_of, turned
from refusals import refused
from turned_cameras import outlines

from nishiki.capture.folder import load_capture
from nishiki.errors import UserError
from nishiki.geometry.camera import Camera, load_cameras
from nishiki.observations.views_store import geometry_sources, write_views
from nishiki.progress import Progress
from nishiki.stages.cameras import CamerasSettings
from nishiki.stages.cameras import run as stage
from nishiki.stages.ingest import IngestSettings

MIDDLE = np.array([70.0, 50.0, 0.0])
TILT = turned(32, 8, 5)


def table_camera(name: str, degrees: float) -> Camera:
    """A camera at rest before a board that turns in its own plane on a tilted table, not about its middle."""
    turn = rotation_of((0, 0, np.radians(degrees)))
    pivot = MIDDLE + np.array([6.0, -4.0, 0.0])
    rotation = TILT @ turn
    return Camera(name, LENS, rotation, np.array([0, 0, 235.0]) - TILT @ MIDDLE + TILT @ pivot - rotation @ pivot,
                  ROWS, COLUMNS, DISTORTION)  # fmt: skip


ANGLES = {"000": 0.0, "012": 12.0, "024": 24.0, "036": 36.0}
LOOSE = {"loose-1": ((-25, 12, 30), (-25, 10, 210)), "loose-2": ((5, 38, 170), (10, 18, 230))}


@pytest.fixture(scope="module")
def pictures():
    found = {name: photograph(table_camera(name, angle), seed=k) for k, (name, angle) in enumerate(ANGLES.items())}
    return found | {name: photograph(board_camera(name, *pose)) for name, pose in LOOSE.items()}


def make(folder, pictures, *, boards=(), turntable=None, tables=None, samples=ANGLES):
    """A capture whose photographs are the pictures of the table, ingested; returns the artifact's folder."""
    capture, artifact = folder / "capture", folder / "ingest"
    (artifact / "geometry").mkdir(parents=True)
    capture.mkdir()
    rows = ["file,role,view"]
    for name, image in pictures.items():
        cv2.imwrite(str(capture / f"{name}.png"), image)
        if name in samples:
            rows.append(f"{name}.png,sample,{name}")
    for k, name in enumerate(boards):
        cv2.imwrite(str(capture / f"board{k}.png"), pictures[name])
        rows.append(f"board{k}.png,board,{name if name in ANGLES else ''}")
    (capture / "frames.csv").write_text("\n".join(rows) + "\n")
    for name, text in (tables or {}).items():
        (capture / name).write_text(text)
    (capture / "capture.yaml").write_text(
        yaml.safe_dump(
            {
                "format": 1,
                "title": "table",
                "geometry": "turntable",
                "camera": {"channels": ["grey"], "encoding": "srgb"},
                "turntable": turntable or {},
            }
        )
    )
    loaded = load_capture(capture)
    write_views(loaded, artifact, settings=IngestSettings())
    for source, name in geometry_sources(loaded):
        (artifact / name).write_bytes(source.read_bytes())
    return artifact


def run(artifact, tmp_path, **settings):
    out = tmp_path / "out"
    out.mkdir(exist_ok=True)
    context = SimpleNamespace(
        inputs={"ingest": SimpleNamespace(folder=artifact)},
        settings=CamerasSettings(**settings),
        output=SimpleNamespace(folder=out, path=lambda name: out / name),
        progress=Progress("test"),
    )
    told = stage.run(context)
    json.dumps(told, allow_nan=False)
    return told, load_cameras(out / "cameras.json")


def expect_true(cameras, *, degrees, share):
    for camera, (name, angle) in zip(cameras, ANGLES.items(), strict=True):
        true = table_camera(name, angle)
        assert camera.name == name
        turn = cv2.Rodrigues(camera.rotation @ true.rotation.T)[0]
        assert np.degrees(np.linalg.norm(turn)) < degrees
        assert np.linalg.norm(camera.centre - true.centre) < share * np.linalg.norm(true.translation)


BOARD = {
    "squares_x": SHAPE.squares_x,
    "squares_y": SHAPE.squares_y,
    "square_mm": SHAPE.square,
    "marker_mm": SHAPE.marker,
    "dictionary": SHAPE.dictionary,
}
LENS_FILE = yaml.safe_dump(
    {"fx": 610.0, "fy": 604.0, "cx": 285.3, "cy": 204.6, "distortion": [float(value) for value in DISTORTION]}
)


def test_poses_from_the_board_of_every_view(pictures, tmp_path):
    """The lens is calibrated from the same pictures and two loose ones; the world's unit is the centimetre."""
    artifact = make(tmp_path, pictures, boards=(*ANGLES, *LOOSE), turntable={"board": BOARD, "unit": "cm"})
    told, cameras = run(artifact, tmp_path)
    assert told["source"] == "boards"
    assert told["calibration"]["rms_px"] < 0.1
    assert told["reprojection_worst_px"] < 0.1
    assert told["turntable"]["left_out_axis_px"] < 0.15
    np.testing.assert_allclose(np.abs(told["turntable"]["angles_deg"]), list(ANGLES.values()), atol=0.05)
    in_mm = [Camera(c.name, c.intrinsics, c.rotation, 10 * c.translation, c.rows, c.columns, c.distortion)
             for c in cameras]  # fmt: skip
    expect_true(in_mm, degrees=0.3, share=0.01)


@pytest.mark.slow
def test_poses_from_correspondences_with_a_wrong_one(pictures, tmp_path):
    rng = np.random.default_rng(0)
    rows = ["view,column,row,x,y,z"]
    for name, angle in ANGLES.items():
        points = rng.uniform((0, 0, 0), (140, 100, 40), (15, 3))
        pixels = table_camera(name, angle).project(points)[0] + rng.normal(0, 0.3, (15, 2))
        pixels[3] += 60
        rows += [",".join([name, *(f"{v:.6f}" for v in (*p, *x))]) for p, x in zip(pixels, points, strict=True)]
    artifact = make(
        tmp_path,
        pictures,
        turntable={"correspondences": "points.csv", "intrinsics": "lens.yaml"},
        tables={"points.csv": "\n".join(rows) + "\n", "lens.yaml": LENS_FILE},
    )
    told, cameras = run(artifact, tmp_path)
    assert told["source"] == "correspondences"
    assert set(told["outliers"].values()) == {1}
    assert told["calibration"] is None
    assert told["turntable"]["left_out_own_px"] > 0
    expect_true(cameras, degrees=0.3, share=0.01)
    own, _ = run(artifact, tmp_path, turntable="off")
    assert own["turntable"] is None
    assert own["reprojection_mean_px"] < told["reprojection_mean_px"] or not told["turntable"]["used"]
    with refused(UserError, "turntable.cameras"):
        run(artifact, tmp_path, source="boards")


def matrices(extra=1.0) -> str:
    heading = ",".join(["view", *(f"p{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))])
    rows = [
        ",".join([name, *(repr(float(extra * value)) for value in table_camera(name, angle).matrix.ravel())])
        for name, angle in ANGLES.items()
    ]
    return "\n".join([heading, *rows]) + "\n"


def test_given_matrices(pictures, tmp_path):
    artifact = make(tmp_path, pictures, turntable={"cameras": "cameras.csv"}, tables={"cameras.csv": matrices(-2.5)})
    told, cameras = run(artifact, tmp_path)
    assert told["source"] == "matrices"
    assert told["mirror"] is None
    assert told["reprojection_mean_px"] is None
    np.testing.assert_allclose(told["circle"]["steps_deg"][:3], 12, atol=1e-6)
    expect_true(cameras, degrees=1e-5, share=1e-8)


def test_nothing_to_go_by(pictures, tmp_path):
    with refused(UserError, "turntable.cameras"):
        run(make(tmp_path, pictures), tmp_path)


def test_boards_that_are_not_seen_are_named(pictures, tmp_path):
    spoilt = {**pictures, "024": np.full((ROWS, COLUMNS), 80, np.uint8)}
    artifact = make(
        tmp_path,
        spoilt,
        boards=tuple(ANGLES),
        turntable={"board": BOARD, "intrinsics": "lens.yaml"},
        tables={"lens.yaml": LENS_FILE},
    )
    with refused(UserError, "024"):
        run(artifact, tmp_path)


@pytest.mark.parametrize("scale", [{"unit": "mm", "height": 160.0}, {"unit": "arbitrary"}])
def test_photographs_once_round_are_enough(tmp_path, scale):
    shades = np.random.default_rng(1).normal(150, 4, (240, 320))
    views = {f"{k:02d}": np.where(mask, shades, 12.0) for k, mask in enumerate(outlines(np.arange(18) * 20.0))}
    artifact = make(tmp_path, views, turntable={"full_turn": True, **scale}, samples=views)
    told, cameras = run(artifact, tmp_path)
    estimate = told["estimate"]
    assert (told["source"], told["unit"], len(cameras)) == ("photographs", scale["unit"], 18)
    assert abs(estimate["focal_px"] - 560) < max(3 * estimate["focal_sd_px"], 12)
    assert estimate["height"] == pytest.approx(scale.get("height", estimate["height"]))
    assert told["circle"]["radius"] == pytest.approx(450 if "height" in scale else 1, rel=0.06)
    assert np.ptp(told["circle"]["steps_deg"]) < 2


def test_photographs_whose_scale_is_not_stated_give_no_cameras(tmp_path):
    views = {f"{k:02d}": np.where(mask, 150, 12) for k, mask in enumerate(outlines(np.arange(9) * 40.0))}
    artifact = make(tmp_path, views, turntable={"full_turn": True, "unit": "mm"}, samples=views)
    with refused(UserError, "full_turn"):
        run(artifact, tmp_path)
