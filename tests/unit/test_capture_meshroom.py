"""Cameras of Meshroom become a turntable's: files written here after AliceVision's description, in all its versions."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from unit.test_capture_colmap import COLUMNS, ROWS, around, photographs, write_model

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.photogrammetry import read_meshroom
from nishiki.errors import UserError
from nishiki.formats.problems import CaptureError
from nishiki.geometry.camera import load_cameras
from nishiki.observations.views_store import write_views
from nishiki.progress import Progress
from nishiki.stages.cameras import CamerasSettings
from nishiki.stages.cameras import run as stage
from nishiki.stages.ingest import IngestSettings

FX, FY, CX, CY = 40.0, 41.0, 16.0, 10.5  # pixels, from the centre of the first one
SENSOR_MM = 36.0
NAMES = [name for name, _, _ in around()]
K1, K2, K3, T1, T2 = 0.04, -0.02, 0.003, 0.002, -0.001


def intrinsic(version, model="pinhole", parameters=(), **more):
    """As `StructureFromMotion` writes it: every number is text."""
    written = {"intrinsicId": "12", "width": str(COLUMNS), "height": str(ROWS), "serialNumber": "", "type": model}
    written |= {"sensorWidth": str(SENSOR_MM), "sensorHeight": "24", "distortionParams": list(map(repr, parameters))}
    if version < (1, 2):
        written |= {"pxFocalLength": repr(FX), "pxInitialFocalLength": "-1"}
    elif version < (1, 2, 2):
        written["pxFocalLength"] = [repr(FX), repr(FY)]
    else:
        written["focalLength"] = repr(FX / COLUMNS * SENSOR_MM)
        written["pixelRatio"] = repr(FX / FY if version < (1, 2, 5) else FY / FX)
    middle = (0, 0) if version < (1, 2, 1) else (COLUMNS / 2, ROWS / 2)
    written["principalPoint"] = [repr(CX - middle[0]), repr(CY - middle[1])]
    return written | more


def write_cameras(folder, *, version=(1, 2, 8), lenses=None, name="cameras.sfm", change=None):
    """A file of the cameras of `around`, and of two views without a pose."""
    lenses = [intrinsic(version)] if lenses is None else lenses
    views, poses = [], []
    for i, (file, rotation, translation) in enumerate(around()):
        number, lens = str(900 + i), lenses[i % len(lenses)]["intrinsicId"]
        path = [f"C:\\Users\\me\\{file}", f"/mnt/photographs/{file}"][i % 2]
        views.append({"viewId": number, "poseId": number, "intrinsicId": lens, "path": path, "metadata": {"a": "b"}})
        matrix = rotation.as_matrix()
        columns = [repr(float(matrix[row, column])) for column in range(3) for row in range(3)]
        centre = [repr(float(value)) for value in -matrix.T @ translation]
        poses.append({"poseId": number, "pose": {"transform": {"rotation": columns, "center": centre}, "locked": "0"}})
    views.append({"viewId": "1", "poseId": "1", "intrinsicId": lenses[0]["intrinsicId"], "path": "/x/other.png"})
    content = {"version": [str(part) for part in version], "views": views, "intrinsics": lenses, "poses": poses}
    if change:
        change(content)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(content))


def seen(point, rotation, translation, parameters=(0, 0, 0, 0, 0)):
    """Column and row of a point, step by step; parameters: k1, k2, k3, t1, t2 of AliceVision's brown model."""
    x, y, z = rotation.apply(point) + translation
    x, y = x / z, y / z
    k1, k2, k3, t1, t2 = parameters
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
    shifted = x * radial + t2 * (square + 2 * x * x) + 2 * t1 * x * y
    lowered = y * radial + t1 * (square + 2 * y * y) + 2 * t2 * x * y
    return FX * shifted + CX, FY * lowered + CY


@pytest.mark.parametrize("version", [(1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 2, 4), (1, 2, 5), (1, 2, 8), (1, 3, 0)])
def test_matrices_are_those_of_the_colmap_import(tmp_path, version):
    """The same cameras as both programs write them; COLMAP counts pixels from the corner."""
    photographs(tmp_path / "m", [*NAMES, "other.png"])
    write_cameras(tmp_path / "m", version=version)
    made = convert(tmp_path / "m", tmp_path / "meshroom")
    assert made.layout.endswith(" Meshroom")
    assert any("other.png" in str(note) for note in made.warnings)
    photographs(tmp_path / "c", NAMES)
    write_model(tmp_path / "c", "binary", camera=(1, "PINHOLE", [FX, FY, CX + 0.5, CY + 0.5]))
    convert(tmp_path / "c", tmp_path / "colmap")
    ours, theirs = load_capture(tmp_path / "meshroom"), load_capture(tmp_path / "colmap")
    assert ours.settings.turntable.full_turn
    assert ours.settings.turntable.intrinsics is None
    assert list(ours.matrices) == list(theirs.matrices)
    for view, matrix in ours.matrices.items():
        np.testing.assert_allclose(matrix, theirs.matrices[view], atol=1e-9)


def test_the_oldest_files_have_one_focal_length(tmp_path):
    write_cameras(tmp_path, version=(1, 0, 0), name="sfm.sfm")
    (view, *_) = read_meshroom(tmp_path / "sfm.sfm").views
    assert (view.lens.fx, view.lens.fy, view.lens.cx, view.lens.cy) == pytest.approx((FX, FX, CX, CY))


@pytest.mark.parametrize(
    ("model", "kind", "parameters", "all_five"),
    [
        ("radial1", None, (K1,), (K1, 0, 0, 0, 0)),
        ("radial3", None, (K1, K2, K3), (K1, K2, K3, 0, 0)),
        ("pinhole", "radialk3", (K1, K2, K3), (K1, K2, K3, 0, 0)),
        ("pinhole", "brown", (K1, K2, K3, T1, T2), (K1, K2, K3, T1, T2)),
    ],
)
def test_a_distorted_lens_goes_along_and_every_camera_has_it(tmp_path, model, kind, parameters, all_five):
    source = tmp_path / "s"
    photographs(source / "images", NAMES)
    more = {"distortionType": kind, "undistortionType": "none"} if kind else {}
    write_cameras(source, lenses=[intrinsic((1, 2, 8), model, parameters, **more)])
    convert(source, tmp_path / "capture")
    folder = tmp_path / "ingest"
    folder.mkdir()
    capture = load_capture(tmp_path / "capture")
    write_views(capture, folder, settings=IngestSettings())
    context = SimpleNamespace(
        inputs={"ingest": SimpleNamespace(folder=folder)},
        settings=CamerasSettings(),
        output=SimpleNamespace(path=lambda name: tmp_path / name),
        progress=Progress("t/cameras"),
    )
    stage.run(context)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    for camera, (_, rotation, translation) in zip(load_cameras(tmp_path / "cameras.json"), around(), strict=True):
        pixels, _ = camera.project(points)
        expected = [seen(point, rotation, translation, all_five) for point in points]
        np.testing.assert_allclose(pixels, expected, atol=1e-9)


def set_in(content, *path, value):
    for key in path[:-1]:
        content = content[key]
    content[path[-1]] = value


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        (("intrinsics", 0, "type"), "fisheye4", "fisheye4"),
        (("intrinsics", 0, "distortionType"), "3deanamorphic4", "3deanamorphic4"),
        (("intrinsics", 0, "width"), "0", "0 x 24"),
        (("intrinsics", 0, "focalLength"), "nan", "'nan'"),
        (("intrinsics", 0, "focalLength"), "-1", r"cameras\.sfm"),
        (("intrinsics", 0, "sensorWidth"), "0", "sensorWidth 0"),
        (("intrinsics", 0, "pixelRatio"), "0", "pixelRatio 0"),
        pytest.param(("intrinsics", 0, "focalLength"), 10**400, r"cameras\.sfm", id="too-large"),
        (("views", 0, "rigId"), "3", "rig"),
        (("views", 0, "intrinsicId"), "5", "'5'"),
        (("poses", 0, "pose", "transform", "rotation"), ["1"] * 9, "rotation"),
        (("poses", 0, "pose", "transform", "center"), ["1"] * 2, "reshape"),
        (("poses",), [], r"cameras\.sfm"),
        (("views",), None, r"cameras\.sfm"),
        (("version",), ["1", "x"], r"cameras\.sfm"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, path, value, text):
    photographs(tmp_path / "s", NAMES)
    write_cameras(tmp_path / "s", change=lambda content: set_in(content, *path, value=value))
    with pytest.raises(CaptureError, match=text):
        convert(tmp_path / "s", tmp_path / "c")


def test_two_lenses_are_kept_apart(tmp_path):
    photographs(tmp_path / "s", NAMES)
    lenses = [intrinsic((1, 2, 8), "radial1", (k,), intrinsicId=str(n)) for n, k in enumerate((0.1, 0.2))]
    write_cameras(tmp_path / "s", lenses=lenses)
    convert(tmp_path / "s", tmp_path / "c")
    capture = load_capture(tmp_path / "c")
    assert [capture.distortion_of(view)[0] for view in capture.views] == [0.1, 0.2] * (len(NAMES) // 2)


def test_doubts_are_refused(tmp_path):
    photographs(tmp_path / "s", NAMES)
    write_cameras(tmp_path / "s", change=lambda content: set_in(content, "views", 0, "path", value=f"a/{NAMES[1]}"))
    with pytest.raises(CaptureError) as refused:
        convert(tmp_path / "s", tmp_path / "c")
    assert refused.value.problems[0].kind == "photograph-repeats"
    write_cameras(tmp_path / "s")
    (tmp_path / "s" / NAMES[2]).unlink()
    with pytest.raises(CaptureError, match=NAMES[2]):
        convert(tmp_path / "s", tmp_path / "c")
    write_cameras(tmp_path / "t", name="a.sfm")
    write_cameras(tmp_path / "t", name="b.sfm")
    with pytest.raises(UserError, match="several"):
        convert(tmp_path / "t", tmp_path / "c")


def test_files_that_end_anywhere_are_refused(tmp_path):
    write_cameras(tmp_path)
    content = (tmp_path / "cameras.sfm").read_bytes()
    for length in range(0, len(content), 41):
        (tmp_path / "cameras.sfm").write_bytes(content[:length])
        with pytest.raises(CaptureError):
            read_meshroom(tmp_path / "cameras.sfm")
    (tmp_path / "cameras.sfm").write_bytes(b"[" * 100_000)
    with pytest.raises(CaptureError):
        read_meshroom(tmp_path / "cameras.sfm")


def test_rotations_are_read_column_by_column(tmp_path):
    """The first pose of a scene that AliceVision ships with its own tests: the turn by sqrt(3) about (-1, -1, -1)."""
    numbers = [0.22629564095020641, -0.18300791965761709, 0.95671227870741093]
    listed = [*numbers, numbers[2], numbers[0], numbers[1], numbers[1], numbers[2], numbers[0]]
    turn = Rotation.from_rotvec([-1, -1, -1]).as_matrix()

    def change(content):
        content["poses"][0]["pose"]["transform"] = {"rotation": list(map(repr, listed)), "center": ["-1"] * 3}

    write_cameras(tmp_path, change=change)
    view = next(view for view in read_meshroom(tmp_path / "cameras.sfm").views if view.name.endswith(NAMES[0]))
    lens = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    np.testing.assert_allclose(view.matrix, lens @ np.column_stack([turn, turn @ [1, 1, 1]]), atol=1e-9)
