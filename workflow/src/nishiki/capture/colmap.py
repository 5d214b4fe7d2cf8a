"""Cameras of COLMAP (`cameras` and `images`, as text or binary) and of NeRF programs (`transforms.json`).

`transforms.json` is as Blender's exporters, instant-ngp, nerfstudio and others write it: `transform_matrix` takes
points of the camera to the world; the camera's axes are OpenGL's (x right, y up, looking along -z). `fl_x`, `fl_y`,
`cx`, `cy` are in pixels from the corner of the first one, `camera_angle_x` is the angle of view over the whole width in
radians; k1, k2, p1, p2, k3 are Brown's, as OpenCV orders them. A frame may have its own.
"""

import json
import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nishiki.capture.registered import (
    CORNER,
    GL,
    NEAR,
    UNDISTORT,
    Pictures,
    RegisteredView,
    Registration,
    aims_at,
    finite,
    positive,
    reading_cameras,
    rigid,
    whole,
)
from nishiki.capture.tables import Intrinsics
from nishiki.formats.files import bound, files_with, read_bytes, read_text
from nishiki.formats.problems import CaptureError, Problem, error, refuse, warning
from nishiki.formats.text_tables import expect_rows, reading

PLACES = (".", "sparse", "sparse/0")
KINDS = (".txt", ".bin")
REMEDY = "Export the model again, as text or binary"
# Name, number of parameters, and how many of these come before the distortion, by COLMAP's number of the model; 0 where
# the model is none of Brown's, as are all of larger numbers. The distortion begins with k1, k2, p1, p2, k3 of Brown's
# model as far as it goes; what follows is another model's.
MODELS = (
    ("SIMPLE_PINHOLE", 3, 3),
    ("PINHOLE", 4, 4),
    ("SIMPLE_RADIAL", 4, 3),
    ("RADIAL", 5, 3),
    ("OPENCV", 8, 4),
    ("OPENCV_FISHEYE", 8, 0),
    ("FULL_OPENCV", 12, 4),
)
BROWN = 5  # numbers of a lens that are read: k1, k2, p1, p2, k3
NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?(nan|inf)", re.IGNORECASE)
HEADING = re.compile(rb"Number of images:\s*([0-9]{1,9})")


Camera = tuple[tuple[int, int], Intrinsics]
"""Rows and columns, and the lens."""
Image = tuple[str, int, tuple[float, ...]]
"""Name, number of the camera, and the pose: w, x, y, z of the rotation from world to camera, then the translation."""


def colmap_folder(source: Path) -> Path | None:
    """Find the reconstruction of a folder of photographs: in it, in `sparse` or in `sparse/0`; None without."""
    for place in PLACES:
        if any(all((source / place / f"{part}{kind}").is_file() for part in ("cameras", "images")) for kind in KINDS):
            return source / place
    return None


def read_colmap(folder: Path, pictures: Pictures | None = None) -> Registration:
    """Read the registered photographs.

    Raises CaptureError: cameras-unreadable, cameras-many; cameras-distorted where a lens cannot be said by Brown's five
    numbers.
    """
    kind = ".bin" if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file() else ".txt"
    file, notes = f"images{kind}", []
    with reading_cameras(f"cameras{kind}", "COLMAP", REMEDY):
        content = read_bytes(folder / f"cameras{kind}", "table_bytes")
        cameras = _text_cameras(content) if kind == ".txt" else _binary_cameras(content)
    with reading_cameras(file, "COLMAP", REMEDY):
        content = read_bytes(folder / file, "table_bytes")
        images = _text_images(content, notes) if kind == ".txt" else _binary_images(content)
    expect_rows(len(images), "views", file, "cameras")
    return Registration(tuple(_view(image, cameras, file) for image in images), tuple(notes))


def _view(image: Image, cameras: dict[int, Camera], file: str) -> RegisteredView:
    from scipy.spatial.transform import Rotation

    name, camera, numbers = image
    if camera not in cameras:
        refuse("cameras-unreadable", file, f"the photograph '{name}' names the camera {camera}, which is not there")
    if not np.isfinite(numbers).all() or not any(numbers[:4]):
        refuse("camera-values", file, f"pose of the photograph '{name}'")
    pose = np.column_stack([Rotation.from_quat(np.roll(numbers[:4], -1)).as_matrix(), numbers[4:]])
    return RegisteredView.of(name, *cameras[camera], pose)


def _camera(model: str, parameters: Sequence[float], rows: int, columns: int) -> Camera:
    """CaptureError (cameras-distorted) where the camera has another distortion than Brown's."""
    plain = next((before for name, _, before in MODELS if name == model), 0)
    distortion = [float(value) for value in parameters[plain:]]
    if not plain or any(distortion[BROWN:]):
        what = f"the camera {model} of {columns} x {rows} pixels has a distortion that is not read"
        expected = "PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV"
        refuse("cameras-distorted", "cameras", what, expected=expected, remedy=UNDISTORT)
    fx, fy = (parameters[0], parameters[0]) if plain == 3 else parameters[:2]
    cx, cy = (value - CORNER for value in parameters[plain - 2 : plain])
    brown = tuple((distortion + [0.0] * BROWN)[:BROWN])
    if not (np.isfinite([fx, fy, cx, cy, *brown]).all() and min(fx, fy) > 0):
        raise ValueError(f"camera {model} with {' '.join(f'{value:g}' for value in parameters)}")
    return (rows, columns), Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, distortion=brown)


def _text_cameras(content: bytes) -> dict[int, Camera]:
    cameras = {}
    for line in _lines(content):
        number, model, columns, rows, *parameters = line.split()
        count = {name: count for name, count, _ in MODELS}.get(model, len(parameters))
        if count != len(parameters):
            raise ValueError(f"camera {number}: model {model} with {len(parameters)} parameters")
        cameras[int(number)] = _camera(model, list(map(float, parameters)), int(rows), int(columns))
    return cameras


def _text_images(content: bytes, notes: list[Problem]) -> list[Image]:
    """Lines `number quaternion translation camera name`, each followed by a line of triples for its points.

    Files that people and scripts write for known poses lack the lines of points, all or some: a line of points is
    known by its numbers, so that no photograph is taken for one.
    """
    images, points = [], True
    for line in _lines(content):
        words = line.split(maxsplit=9)
        if len(line.split()) % 3 == 0 and all(map(_is_number, line.split())):
            if points:
                raise ValueError(f"a line of points without its photograph: {line[:60]}")
            points = True
        elif len(words) == 10 and all(map(_is_number, words[:9])):
            images.append((words[9], int(words[8]), tuple(map(float, words[1:8]))))
            points = False
        else:
            raise ValueError(f"neither a photograph nor points: {line[:60]}")
    stated = HEADING.search(content)
    if stated and int(stated[1]) != len(images):
        what = f"expected {int(stated[1])} photographs as its heading says, found {len(images)}"
        remedy = "If some are missing, export the model again; it may have been cut off"
        notes.append(warning("cameras-count", "images.txt", what, remedy=remedy))
    return images


def _is_number(word: str) -> bool:
    return NUMBER.fullmatch(word) is not None


def _lines(content: bytes) -> list[str]:
    lines = (line.strip() for line in content.decode("utf-8-sig").split("\n"))
    return [line for line in lines if line and not line.startswith("#")]


def _binary_cameras(content: bytes) -> dict[int, Camera]:
    cameras, at = {}, 8
    for _ in range(_count(content)):
        number, model, columns, rows = struct.unpack_from("<iiQQ", content, at)
        if not 0 <= model < 1 << 16:
            raise ValueError(f"camera {number}: model number {model}")
        name, count, _ = MODELS[model] if model < len(MODELS) else (f"of model {model}", 0, 0)
        cameras[number] = _camera(name, struct.unpack_from(f"<{count}d", content, at + 24), rows, columns)
        at += 24 + 8 * count
    return cameras


def _binary_images(content: bytes) -> list[Image]:
    images, at = [], 8
    for _ in range(_count(content)):
        _, *numbers, camera = struct.unpack_from("<i7di", content, at)
        end = content.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", content, end + 1)
        images.append((content[at + 64 : end].decode(), camera, tuple(numbers)))
        at = end + 9 + 24 * points
        if at > len(content):
            raise ValueError(f"the file ends before the {points} points of '{images[-1][0]}'")
    return images


def _count(content: bytes) -> int:
    """Return the number of entries that a file begins with, which a broken one may state as any number."""
    (count,) = struct.unpack_from("<Q", content)
    if count > bound("views"):
        raise ValueError(f"{count} entries, more than the {bound('views')} views that are read")
    return count


NAME = "transforms.json"
PARTS = "transforms_"  # of a set in parts: transforms_train.json, transforms_val.json, transforms_test.json
LENSES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
BROWN_NAMES = ("k1", "k2", "p1", "p2", "k3")
OTHER_NAMES = ("k4", "k5", "k6", "k7", "k8", "p3", "p4", "s1", "s2", "s3", "s4")  # of richer models, and of fish-eyes
SAME_ANGLE = 0.01  # relative difference of a focal length and an angle of view that state the same
MIDDLE = (0.2, 0.8)  # where principal points lie, of the picture's sides


def transforms_file(source: Path) -> Path | None:
    """Find `transforms.json` of a folder, else the first part of a set in parts; None without."""
    names = {path.name: path for path in files_with(source, (".json",))}
    return names.get(NAME, next((path for name, path in names.items() if name.startswith(PARTS)), None))


def read_transforms(path: Path, pictures: Pictures) -> Registration:
    """Read the photographs of all frames, of all parts of a set in parts.

    Raises CaptureError: cameras-unreadable, cameras-many, photograph-missing; cameras-distorted where a lens cannot be
    said by Brown's five numbers; camera-values where the focal length or the principal point is not of the photograph.
    """
    frames: dict[str, dict] = {}
    files = (
        [path] if path.name == NAME else [p for p in files_with(path.parent, (".json",)) if p.name.startswith(PARTS)]
    )
    with reading_cameras(path.name, "NeRF", "Write the file again with the program that made it"):
        for file in files:
            with reading(file.name, "cameras"):
                content = json.loads(read_text(file, "json_bytes"))
            shared = {key: value for key, value in content.items() if key != "frames"}
            expect_rows(len(frames) + len(content["frames"]), "views", path.name, "cameras")
            for frame in content["frames"]:
                before = frames.setdefault(str(frame["file_path"]), {**shared, **frame})
                if before["transform_matrix"] != frame["transform_matrix"]:
                    raise ValueError(f"two cameras of {frame['file_path']}")
        matrices = []
        for frame in frames.values():
            matrix = np.array([[finite(value) for value in row] for row in frame["transform_matrix"]])
            if matrix.shape not in ((4, 4), (3, 4)):
                raise ValueError(f"a transform_matrix of {' x '.join(map(str, matrix.shape))} numbers")
            matrices.append(np.column_stack([rigid(matrix[:3, :3]), matrix[:3, 3]]))
        if not frames:
            raise ValueError("no frames")
    pictures.paths(list(frames), path.name)
    lenses = [_lens(frame, pictures.size(name, path.name), name) for name, frame in frames.items()]
    poses, notes = _poses(np.array(matrices), path.name)
    views = zip(frames, lenses, poses, strict=True)
    return Registration(tuple(RegisteredView.of(name, *lens, pose) for name, lens, pose in views), notes)


def _poses(matrices: np.ndarray, file: str) -> tuple[np.ndarray, tuple[Problem, ...]]:
    """(n, 3, 4) from world to camera, and a note where the file has another convention than it should.

    Scripts write matrices of OpenCV's axes, or from world to camera, into the same key. The cameras then look away from
    the object, or their lines of sight miss each other; a reading that makes all of them meet is taken where it is the
    only one.
    """
    rotation, place = matrices[:, :, :3], matrices[:, :, 3:]
    inverse = np.concatenate([rotation.transpose(0, 2, 1), -rotation.transpose(0, 2, 1) @ place], axis=2)
    readings = {
        "camera to world, axes of OpenGL": GL @ inverse,
        "camera to world, axes of OpenCV": inverse,
        "world to camera, axes of OpenGL": GL @ matrices,
        "world to camera, axes of OpenCV": matrices,
    }
    usual, *others = readings
    aims = {name: aims_at(poses) for name, poses in readings.items()}
    fitting = [name for name in others if aims[name] is not None and aims[name] < NEAR]
    if len(fitting) != 1 or (aims[usual] is not None and aims[usual] < NEAR):
        return readings[usual], ()
    what = "the cameras would look away from the object: transform_matrix is read otherwise than such files have it"
    note = warning("cameras-convention", file, what, expected=usual, found=fitting[0], remedy="Check the mesh's shape")
    return readings[fitting[0]], (note,)


def _lens(frame: dict, size: tuple[int, int], name: str) -> tuple[tuple[int, int], Intrinsics]:
    """Rows and columns, and the lens in pixels from the centre of the first one."""
    try:
        model, fisheye = str(frame.get("camera_model", "OPENCV")).upper(), frame.get("is_fisheye", False)
        if model not in LENSES or fisheye or any(finite(frame.get(key, 0)) for key in OTHER_NAMES):
            what, expected = f"a lens of the model {'fish-eye' if fisheye else model}", "none, or Brown's distortion"
            refuse("cameras-distorted", name, what, expected=expected, remedy=UNDISTORT)
        rows, columns = whole(frame.get("h", size[0])), whole(frame.get("w", size[1]))
        fx = _focal_length(frame, "x", columns)
        fy = _focal_length(frame, "y", rows) or fx
        fx = fx or fy
        if fx is None:
            raise ValueError("neither fl_x nor camera_angle_x")
        cx, cy = (finite(frame.get(key, side / 2)) for key, side in (("cx", columns), ("cy", rows)))
        if not all(MIDDLE[0] <= at / side <= MIDDLE[1] for at, side in ((cx, columns), (cy, rows))):
            raise ValueError(f"principal point {cx:g}, {cy:g} in a picture of {columns} x {rows} pixels")
        distortion = tuple(finite(frame.get(key, 0)) for key in BROWN_NAMES)
    except (ValueError, TypeError) as e:
        remedy = "Give the photographs that the file was made for, or mend its numbers"
        raise CaptureError(error("camera-values", name, "camera", found=str(e)[:120], remedy=remedy)) from e
    return (rows, columns), Intrinsics(fx=fx, fy=fy, cx=cx - CORNER, cy=cy - CORNER, distortion=distortion)


def _focal_length(frame: dict, axis: str, side: int) -> float | None:
    """Pixels, from the focal length or the angle of view; None without. ValueError where the two disagree."""
    length, angle = frame.get(f"fl_{axis}"), frame.get(f"camera_angle_{axis}")
    stated = None if length is None else positive(length, f"fl_{axis}")
    if angle is None:
        return stated
    implied = side / 2 / math.tan(min(positive(angle, f"camera_angle_{axis}"), math.pi - 1e-6) / 2)
    if stated and abs(implied / stated - 1) > SAME_ANGLE:
        raise ValueError(f"fl_{axis} {stated:g}, but camera_angle_{axis} makes {implied:g} over {side} pixels")
    return stated or implied
