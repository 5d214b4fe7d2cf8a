"""What a renderer needs beside mesh and residual, in few bytes: cameras, charts, lamps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nishiki.codec.integer_code import encode_integers
from nishiki.geometry.camera import NO_DISTORTION, Camera
from nishiki.geometry.camera_path import rotation_matrix, rotation_vector

_CHART_NUMBERS = 2  # texels per unit along rows and columns
_SAME = 11  # numbers of a camera without distortion


def pack_cameras(cameras: Sequence[Camera]) -> bytes:
    """float32 numbers a camera: fx, skew, fy, cx, cy, rotation vector, translation, and distortion where any has one;
    preceded by rows, columns and the number of numbers.  Names are not kept."""
    distorted = any(tuple(camera.distortion) != NO_DISTORTION for camera in cameras)
    rows = []
    for camera in cameras:
        k = camera.intrinsics
        inner = [k[0, 0], k[0, 1], k[1, 1], k[0, 2], k[1, 2]]
        outer = [*rotation_vector(camera.rotation), *camera.translation]
        rows.append([*inner, *outer, *(camera.distortion if distorted else ())])
    size = _SAME + (len(NO_DISTORTION) if distorted else 0)
    head = np.array([cameras[0].rows, cameras[0].columns, size] if cameras else [0, 0, size], "<i4")
    return head.tobytes() + np.array(rows, "<f4").tobytes()


def unpack_cameras(data: bytes) -> list[Camera]:
    """Inverse of `pack_cameras`, to float32 precision; cameras are named by their place."""
    rows, columns, size = (int(v) for v in np.frombuffer(data, "<i4", 3))
    table = np.frombuffer(data, "<f4", offset=12).reshape(-1, size).astype(np.float64)
    cameras = []
    for number, (fx, skew, fy, cx, cy, *rest) in enumerate(table):
        intrinsics = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
        distortion = tuple(rest[6:]) if size > _SAME else NO_DISTORTION
        rotation = rotation_matrix(np.array(rest[:3]))
        cameras.append(Camera(str(number), intrinsics, rotation, np.array(rest[3:6]), rows, columns, distortion))
    return cameras


def chart_bytes(chart: np.ndarray, order: np.ndarray) -> int:
    """Bytes of the atlas: each triangle's chart number (f,), in the order (f,) of the mesh's walk, against that of the
    triangle before; and the numbers from which a chart's corners and tiles follow, once the mesh is known."""
    along = chart[order].astype(np.int64)
    change = np.diff(along, prepend=along[:1]) if len(along) else along
    moved = np.concatenate([[0], (change[:-1] != 0)]).astype(np.int64) if len(along) else along
    charts = int(chart.max(initial=-1)) + 1
    return len(encode_integers(change, moved, 2)) + 4 * _CHART_NUMBERS * charts


def lamp_bytes(lighting: dict) -> int:
    """4 bytes for each number of `Lighting.as_dict`."""

    def numbers(value) -> int:
        if isinstance(value, dict):
            return sum(map(numbers, value.values()))
        if isinstance(value, list | tuple):
            return sum(map(numbers, value))
        return int(isinstance(value, int | float))

    return 4 * numbers(lighting)
