"""Cameras of COLMAP, text and binary, become a turntable's: files written here after COLMAP's description of them."""

import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.registered import read_colmap
from nishiki.formats.problems import CaptureError
from nishiki.geometry.camera import Camera

ROWS, COLUMNS = 24, 32
PINHOLE = (1, "PINHOLE", [40.0, 41.0, 16.5, 11.0])


def around(count=8):
    """Names, rotations and translations of cameras once round the object, looking at it."""
    for i, turn in enumerate(2 * np.pi * np.arange(count) / count):
        rotation = Rotation.from_euler("zx", [np.degrees(turn), 100], degrees=True)
        yield f"view{i}.png", rotation, np.array([0.1, -0.2, 5.0])


def write_model(folder, kind, *, camera=PINHOLE, views=None):
    folder.mkdir(parents=True, exist_ok=True)
    number, model, parameters = camera
    views = list(around()) if views is None else views
    quaternions = [rotation.as_quat()[[3, 0, 1, 2]] for _, rotation, _ in views]
    if kind == "text":
        numbers = " ".join(map(repr, parameters))
        (folder / "cameras.txt").write_text(f"# comment\n7 {model} {COLUMNS} {ROWS} {numbers}\n")
        lines = ["# comment"]
        for i, ((name, _, translation), q) in enumerate(zip(views, quaternions, strict=True)):
            pose = " ".join(repr(float(v)) for v in (*q, *translation))
            lines += [f"{i + 1} {pose} 7 {name}", "1.5 2.5 -1" if i % 2 else ""]
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
        return
    head = struct.pack("<QiiQQ", 1, 7, number, COLUMNS, ROWS)
    (folder / "cameras.bin").write_bytes(head + struct.pack(f"<{len(parameters)}d", *parameters))
    content = struct.pack("<Q", len(views))
    for i, ((name, _, translation), q) in enumerate(zip(views, quaternions, strict=True)):
        content += struct.pack("<i7di", i + 1, *q, *translation, 7) + name.encode() + b"\0"
        content += struct.pack("<Q", i) + struct.pack("<ddq", 1.5, 2.5, -1) * i
    (folder / "images.bin").write_bytes(content)


def photographs(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((ROWS, COLUMNS, 3), 20 * i + 5, np.uint8))


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
def test_a_reconstruction_becomes_a_turntable(tmp_path, kind, place):
    source = tmp_path / "object"
    photographs(source if place == "." else source / "images", [name for name, _, _ in around()] + ["other.png"])
    write_model(source / place, kind)
    conversion = convert(source, tmp_path / "capture")
    assert conversion.layout.endswith(" COLMAP")
    assert any("other.png" in str(note) for note in conversion.warnings)
    capture = load_capture(tmp_path / "capture")
    assert capture.settings.turntable.full_turn
    point = np.array([0.3, -0.2, 0.4])
    for name, rotation, translation in around():
        seen = rotation.apply(point) + translation
        x, y, w = capture.matrices[name.removesuffix(".png")] @ [*point, 1]
        # COLMAP's pixels count from the corner of the first one, a capture's from its centre
        np.testing.assert_allclose(
            [x / w + 0.5, y / w + 0.5],
            [40 * seen[0] / seen[2] + 16.5, 41 * seen[1] / seen[2] + 11.0],
            atol=1e-9,
        )


@pytest.mark.parametrize(
    ("number", "model", "parameters", "brown"),
    [
        (2, "SIMPLE_RADIAL", [40.0, 16.0, 12.0, 0.04], (0.04, 0, 0, 0, 0)),
        (3, "RADIAL", [40.0, 16.0, 12.0, 0.04, -0.02], (0.04, -0.02, 0, 0, 0)),
        (4, "OPENCV", [40.0, 41.0, 16.0, 12.0, 0.04, -0.02, 0.003, -0.001], (0.04, -0.02, 0.003, -0.001, 0)),
        (6, "FULL_OPENCV", [40.0, 41.0, 16.0, 12.0, 0.1, 0.2, 0.01, 0.02, 0.3, 0, 0, 0], (0.1, 0.2, 0.01, 0.02, 0.3)),
    ],
)
@pytest.mark.parametrize("kind", ["text", "binary"])
def test_a_distorted_lens_goes_along(tmp_path, kind, number, model, parameters, brown):
    """Points fall where OpenCV, whose models these are, sees them."""
    photographs(tmp_path / "s", [name for name, _, _ in around()])
    write_model(tmp_path / "s", kind, camera=(number, model, parameters))
    convert(tmp_path / "s", tmp_path / "capture")
    capture = load_capture(tmp_path / "capture")
    assert capture.distortion_of("view0") == pytest.approx(brown)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    fx, fy, cx, cy = parameters[:4] if number > 3 else [parameters[0], *parameters[:3]]
    inner = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    for name, rotation, translation in around():
        matrix = capture.matrices[name.removesuffix(".png")]
        camera = replace(
            Camera.from_matrix("v", matrix, rows=ROWS, columns=COLUMNS), distortion=capture.distortion_of("view0")
        )
        expected = cv2.projectPoints(points, rotation.as_rotvec(), translation, inner, np.array(brown))[0][:, 0]
        np.testing.assert_allclose(camera.project(points)[0] + 0.5, expected, atol=1e-9)


def test_other_distortions_are_refused(tmp_path):
    full = [40.0, 41.0, 16.0, 12.0, 0.1, 0.2, 0, 0, 0.3, 0.01, 0, 0]
    for camera in ((6, "FULL_OPENCV", full), (5, "OPENCV_FISHEYE", [40.0, 40, 16, 12, 0, 0, 0, 0])):
        write_model(tmp_path, "text", camera=camera)
        with pytest.raises(CaptureError, match="image_undistorter"):
            read_colmap(tmp_path)
    write_model(tmp_path, "text", camera=(2, "SIMPLE_RADIAL", [40.0, 16.0, 12.0, 0.0]))
    assert len(read_colmap(tmp_path).views) == 8
    write_model(tmp_path, "text", camera=(2, "SIMPLE_RADIAL", [-40.0, 16.0, 12.0, 0.0]))
    with pytest.raises(CaptureError) as refused:
        read_colmap(tmp_path)
    assert [problem.kind for problem in refused.value.problems] == ["cameras-unreadable"]


def test_photographs_that_are_missing_or_of_another_size_are_named(tmp_path):
    names = [name for name, _, _ in around()]
    photographs(tmp_path / "s", names[1:])
    write_model(tmp_path / "s", "binary")
    with pytest.raises(CaptureError, match=r"view0\.png"):
        convert(tmp_path / "s", tmp_path / "capture")
    cv2.imwrite(str(tmp_path / "s" / names[0]), np.zeros((ROWS + 1, COLUMNS, 3), np.uint8))
    with pytest.raises(CaptureError, match="32 x 24"):
        convert(tmp_path / "s", tmp_path / "capture")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "binary"])
def test_files_that_end_anywhere_are_read_or_refused(tmp_path, kind):
    write_model(tmp_path, kind)
    suffix = ".txt" if kind == "text" else ".bin"
    for file in (f"cameras{suffix}", f"images{suffix}"):
        content = (tmp_path / file).read_bytes()
        count = 0
        for length in range(len(content)):
            (tmp_path / file).write_bytes(content[:length])
            try:
                read_colmap(tmp_path)
            except CaptureError:
                count += 1
        (tmp_path / file).write_bytes(content)
        assert count > (len(content) * 0.9 if kind == "binary" else 5)
    (tmp_path / "images.txt").unlink(missing_ok=True)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 2**60))
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 0))
    with refused(CaptureError, kind="cameras-unreadable"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("lacking", ["all", "some", "none"])
@pytest.mark.parametrize("stated", [None, 8, 12])
def test_photographs_without_their_line_of_points_are_not_lost(tmp_path, lacking, stated):
    names = [name for name, _, _ in around()]
    write_model(tmp_path, "text")
    lines = (tmp_path / "images.txt").read_text().split("\n")[1:]
    keep = {"all": lambda i: i % 2 == 0, "some": lambda i: i % 2 == 0 or i % 6 == 1, "none": lambda i: True}[lacking]
    heading = f"# Number of images: {stated}, mean observations per image: 0\n" if stated else ""
    text = heading + "# IMAGE_ID, QW ...\n" + "\n".join(line for i, line in enumerate(lines) if keep(i))
    (tmp_path / "images.txt").write_text(text.replace("\n6 ", "\n# a comment\n\n6 ") + "\n")
    found = read_colmap(tmp_path)
    assert [view.name for view in found.views] == names
    assert [note.kind for note in found.notes] == (["cameras-count"] if stated == 12 else [])


@pytest.mark.parametrize("line", ["1.5 2.5 -1 3.5 4.5 -1", "9 0 0 1 0 0 0 5 7", "9 0 0 1 0 0 0 5 x view.png"])
def test_lines_that_are_neither_are_refused(tmp_path, line):
    write_model(tmp_path, "text")
    text = (tmp_path / "images.txt").read_text()
    (tmp_path / "images.txt").write_text(f"{line}\n{text}")
    with pytest.raises(CaptureError) as refused:
        read_colmap(tmp_path)
    assert refused.value.problems[0].kind == "cameras-unreadable"


@pytest.mark.parametrize(
    "camera",
    [
        (11, "RAD_TAN_THIN_PRISM_FISHEYE", [40.0, 40, 16, 12, *[0.0] * 12]),
        (12, "SIMPLE_DIVISION", [40.0, 16, 12, 0.1]),
        (15, "FISHEYE", [40.0, 40, 16, 12]),
        (16, "EUCM", [40.0, 40, 16, 12, 0.5, 1.0]),
        (17, "EQUIRECTANGULAR", [32.0, 24.0]),
        (40, "A_MODEL_TO_COME", [40.0, 1.0]),
    ],
)
@pytest.mark.parametrize("kind", ["text", "binary"])
def test_newer_models_are_lenses_that_are_not_read(tmp_path, camera, kind):
    write_model(tmp_path, kind, camera=camera)
    with pytest.raises(CaptureError) as refused:
        read_colmap(tmp_path)
    assert refused.value.problems[0].kind == "cameras-distorted"


def test_back_slashes_separate_folders_and_views_stand_in_the_order_of_the_turn(tmp_path):
    """Two cameras whose photographs alternate, as Windows names them, numbered without leading zeros."""
    views = [(f"cam{i % 2}\\{9 + i // 2}.png", *view[1:]) for i, view in enumerate(around(12))]
    for i, (name, _, _) in enumerate(views):
        path = tmp_path / "s/images" / name.replace("\\", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((ROWS, COLUMNS, 3), 20 * i + 5, np.uint8))
    write_model(tmp_path / "s/sparse", "text", views=views)
    convert(tmp_path / "s", tmp_path / "capture")
    capture = load_capture(tmp_path / "capture")
    assert capture.settings.turntable.full_turn
    levels = [cv2.imread(str(frame.path))[0, 0, 0] for frame in capture.frames]
    assert levels == [20 * i + 5 for i in range(12)]
    for i, (name, _, _) in enumerate(views):  # masks in the same folders, as COLMAP names them
        path = tmp_path / "masks" / (name.replace("\\", "/") + ".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = np.zeros((ROWS, COLUMNS), np.uint8)
        mask[2 : 5 + i, 3:9] = 255
        cv2.imwrite(str(path), mask)
    convert(tmp_path / "s", tmp_path / "masked", mask=tmp_path / "masks")
    capture = load_capture(tmp_path / "masked")
    masks = [cv2.imread(str(capture.silhouette_of(view).silhouette_path), 0) for view in capture.views]
    assert [int((mask > 0).sum()) for mask in masks] == [6 * (3 + i) for i in range(12)]
