"""Cameras of a COLMAP reconstruction: `cameras` and `images`, as text (.txt) or binary (.bin)."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.capture.registered import CORNER, UNDISTORT, RegisteredView, Registration, reading_cameras
from nishiki.capture.turntable_schema import Intrinsics
from nishiki.formats.bounds import bound
from nishiki.formats.files import read_bytes
from nishiki.formats.problems import CaptureError, Problem, error, warning
from nishiki.formats.text_tables import expect_rows

PLACES = (".", "sparse", "sparse/0")
KINDS = (".txt", ".bin")
REMEDY = "Export the model again, as text or binary"
# Name, number of parameters, and how many of these come before the distortion, by COLMAP's number of the model; models
# of another number are newer. The distortion begins with k1, k2, p1, p2, k3 of Brown's model as far as it goes; what
# follows is another model's.
MODELS = (
    ("SIMPLE_PINHOLE", 3, 3),
    ("PINHOLE", 4, 4),
    ("SIMPLE_RADIAL", 4, 3),
    ("RADIAL", 5, 3),
    ("OPENCV", 8, 4),
    ("OPENCV_FISHEYE", 8, 4),
    ("FULL_OPENCV", 12, 4),
    ("FOV", 5, 4),
    ("SIMPLE_RADIAL_FISHEYE", 4, 3),
    ("RADIAL_FISHEYE", 5, 3),
    ("THIN_PRISM_FISHEYE", 12, 4),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16, 4),
    ("SIMPLE_DIVISION", 4, 3),
    ("DIVISION", 5, 4),
    ("SIMPLE_FISHEYE", 3, 3),
    ("FISHEYE", 4, 4),
    ("EUCM", 6, 4),
    ("EQUIRECTANGULAR", 2, 2),
)
BROWN = 5
OTHERS = ("FISHEYE", "FOV", "DIVISION", "EUCM", "EQUIRECTANGULAR")  # words of models that are not Brown's
NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?(nan|inf)", re.IGNORECASE)
HEADING = re.compile(rb"Number of images:\s*([0-9]{1,9})")


@dataclass(frozen=True)
class _Camera:
    rows: int
    columns: int
    lens: Intrinsics


@dataclass(frozen=True)
class _Image:
    """quaternion: w, x, y, z of the rotation from world to camera."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]


def colmap_folder(source: Path) -> Path | None:
    """Where the reconstruction of a folder of photographs lies: in it, in `sparse` or in `sparse/0`; or None."""
    for place in PLACES:
        if any(all((source / place / f"{part}{kind}").is_file() for part in ("cameras", "images")) for kind in KINDS):
            return source / place
    return None


def read_colmap(folder: Path) -> Registration:
    """The registered photographs.

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


def _view(image: _Image, cameras: dict[int, _Camera], file: str) -> RegisteredView:
    from scipy.spatial.transform import Rotation

    camera = cameras.get(image.camera)
    if camera is None:
        what = f"the photograph '{image.name}' names a camera that is not there"
        raise CaptureError(error("cameras-unreadable", file, what, found=f"camera {image.camera}"))
    w, x, y, z = image.quaternion
    if not np.isfinite([*image.quaternion, *image.translation]).all() or not any(image.quaternion):
        raise CaptureError(error("camera-values", file, f"pose of the photograph '{image.name}'"))
    pose = np.column_stack([Rotation.from_quat([x, y, z, w]).as_matrix(), image.translation])
    return RegisteredView.of(image.name, (camera.rows, camera.columns), camera.lens, pose)


def _camera(model: str, parameters: Sequence[float], rows: int, columns: int) -> _Camera:
    """CaptureError (cameras-distorted) where the camera has another distortion than Brown's."""
    plain = next((before for name, _, before in MODELS if name == model), 0)
    distortion = [float(value) for value in parameters[plain:]]
    straight = "DIVISION" in model and not any(distortion)
    if not plain or any(distortion[BROWN:]) or (any(word in model for word in OTHERS) and not straight):
        what = f"the camera {model} of {columns} x {rows} pixels has a distortion that is not read"
        expected = "PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV"
        raise CaptureError(error("cameras-distorted", "cameras", what, expected=expected, remedy=UNDISTORT))
    fx, fy = (parameters[0], parameters[0]) if plain == 3 else parameters[:2]
    cx, cy = (value - CORNER for value in parameters[plain - 2 : plain])
    brown = tuple((distortion + [0.0] * BROWN)[:BROWN])
    if not (np.isfinite([fx, fy, cx, cy, *brown]).all() and min(fx, fy) > 0):
        raise ValueError(f"camera {model} with {' '.join(f'{value:g}' for value in parameters)}")
    return _Camera(rows, columns, Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, distortion=brown))


def _text_cameras(content: bytes) -> dict[int, _Camera]:
    cameras = {}
    for line in _lines(content):
        number, model, columns, rows, *parameters = line.split()
        count = {name: count for name, count, _ in MODELS}.get(model, len(parameters))
        if count != len(parameters):
            raise ValueError(f"camera {number}: model {model} with {len(parameters)} parameters")
        cameras[int(number)] = _camera(model, list(map(float, parameters)), int(rows), int(columns))
    return cameras


def _text_images(content: bytes, notes: list[Problem]) -> list[_Image]:
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
            numbers = tuple(map(float, words[1:8]))
            images.append(_Image(words[9], int(words[8]), numbers[:4], numbers[4:]))
            points = False
        else:
            raise ValueError(f"neither a photograph nor points: {line[:60]}")
    stated = HEADING.search(content)
    if stated and int(stated[1]) != len(images):
        what, remedy = "photographs", "If some are missing, export the model again; it may have been cut off"
        expected = f"{int(stated[1])} as its heading says"
        found = f"{len(images)}"
        notes.append(warning("cameras-count", "images.txt", what, expected=expected, found=found, remedy=remedy))
    return images


def _is_number(word: str) -> bool:
    return NUMBER.fullmatch(word) is not None


def _lines(content: bytes) -> list[str]:
    lines = (line.strip() for line in content.decode("utf-8-sig").split("\n"))
    return [line for line in lines if line and not line.startswith("#")]


def _binary_cameras(content: bytes) -> dict[int, _Camera]:
    cameras, at = {}, 8
    for _ in range(_count(content)):
        number, model, columns, rows = struct.unpack_from("<iiQQ", content, at)
        if not 0 <= model < 1 << 16:
            raise ValueError(f"camera {number}: model number {model}")
        name, count, _ = MODELS[model] if model < len(MODELS) else (f"of model {model}", 0, 0)
        cameras[number] = _camera(name, struct.unpack_from(f"<{count}d", content, at + 24), rows, columns)
        at += 24 + 8 * count
    return cameras


def _binary_images(content: bytes) -> list[_Image]:
    images, at = [], 8
    for _ in range(_count(content)):
        _, *numbers, camera = struct.unpack_from("<i7di", content, at)
        end = content.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", content, end + 1)
        images.append(_Image(content[at + 64 : end].decode(), camera, tuple(numbers[:4]), tuple(numbers[4:])))
        at = end + 9 + 24 * points
        if at > len(content):
            raise ValueError(f"the file ends before the {points} points of '{images[-1].name}'")
    return images


def _count(content: bytes) -> int:
    """The number of entries that a file begins with, which a broken one may state as any number."""
    (count,) = struct.unpack_from("<Q", content)
    if count > bound("views"):
        raise ValueError(f"{count} entries, more than the {bound('views')} views that are read")
    return count
