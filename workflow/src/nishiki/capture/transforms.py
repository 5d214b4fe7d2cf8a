"""Cameras of `transforms.json`, as Blender's NeRF exporters, instant-ngp, nerfstudio and others write them.

`transform_matrix` takes points of the camera to the world; the camera's axes are OpenGL's (x right, y up, looking along
-z). `fl_x`, `fl_y`, `cx`, `cy` are in pixels from the corner of the first one, `camera_angle_x` is the angle of view
over the whole width in radians; k1, k2, p1, p2, k3 are Brown's, as OpenCV orders them. A frame may have its own.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

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
from nishiki.capture.turntable_schema import Intrinsics
from nishiki.formats.files import files_with, read_text
from nishiki.formats.problems import CaptureError, Problem, error, warning
from nishiki.formats.text_tables import expect_rows, reading

NAME = "transforms.json"
PARTS = "transforms_"  # of a set in parts: transforms_train.json, transforms_val.json, transforms_test.json
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
BROWN = ("k1", "k2", "p1", "p2", "k3")
OTHERS = ("k4", "k5", "k6", "k7", "k8", "p3", "p4", "s1", "s2", "s3", "s4")  # of richer models, and of fish-eyes
SAME_ANGLE = 0.01  # relative difference of a focal length and an angle of view that state the same
MIDDLE = (0.2, 0.8)  # where principal points lie, of the picture's sides


def transforms_file(source: Path) -> Path | None:
    """`transforms.json` of a folder, else the first part of a set in parts; None without."""
    names = {path.name: path for path in files_with(source, (".json",))}
    parts = [path for name, path in names.items() if name.startswith(PARTS)]
    return names.get(NAME, parts[0] if parts else None)


def read_transforms(path: Path, pictures: Pictures) -> Registration:
    """The photographs of all frames, of all parts of a set in parts.

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
        matrices = [_matrix(frame["transform_matrix"]) for frame in frames.values()]
        if not frames:
            raise ValueError("no frames")
    pictures.paths(list(frames), path.name)
    lenses = [_lens(frame, pictures.size(name, path.name), name) for name, frame in frames.items()]
    poses, notes = _poses(np.array(matrices), path.name)
    views = zip(frames, lenses, poses, strict=True)
    return Registration(tuple(RegisteredView.of(name, *lens, pose) for name, lens, pose in views), notes)


def _matrix(rows: Any) -> np.ndarray:
    """(3, 4): rotation and place of a camera."""
    matrix = np.array([[finite(value) for value in row] for row in rows])
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"a transform_matrix of {' x '.join(map(str, matrix.shape))} numbers")
    return np.column_stack([rigid(matrix[:3, :3]), matrix[:3, 3]])


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
        if model not in MODELS or fisheye or any(finite(frame.get(key, 0)) for key in OTHERS):
            what, expected = f"a lens of the model {'fish-eye' if fisheye else model}", "none, or Brown's distortion"
            raise CaptureError(error("cameras-distorted", name, what, expected=expected, remedy=UNDISTORT))
        rows, columns = whole(frame.get("h", size[0])), whole(frame.get("w", size[1]))
        fx = _focal_length(frame, "x", columns)
        fy = _focal_length(frame, "y", rows) or fx
        fx = fx or fy
        if fx is None:
            raise ValueError("neither fl_x nor camera_angle_x")
        cx, cy = (finite(frame.get(key, side / 2)) for key, side in (("cx", columns), ("cy", rows)))
        if not all(MIDDLE[0] <= at / side <= MIDDLE[1] for at, side in ((cx, columns), (cy, rows))):
            raise ValueError(f"principal point {cx:g}, {cy:g} in a picture of {columns} x {rows} pixels")
        distortion = tuple(finite(frame.get(key, 0)) for key in BROWN)
    except (ValueError, TypeError) as e:
        what, remedy = "camera", "Give the photographs that the file was made for, or mend its numbers"
        raise CaptureError(error("camera-values", name, what, found=str(e)[:120], remedy=remedy)) from e
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
