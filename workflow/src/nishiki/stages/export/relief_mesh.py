"""The surface of a painting as triangles: its plane, displaced by the height, band by band."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nishiki.stages.export.scene import ExportedScene, block_mean


@dataclass(frozen=True)
class Relief:
    """Some rows of vertices of the mesh, and the triangles between them and the row above.

    Attributes
    ----------
    step : int
        Pixels along the side of the square that a vertex stands for.
    places, normals : (v, 3) float32 ndarray
        Positions in the scene's unit, origin in the middle of the picture; unit normals.
    colours : (v, 3) float32 ndarray
        Linear sRGB, 0 where none was asked for.
    texture : (v, 2) float32 ndarray
        Place in the picture, 0 to 1, from its left and its top.
    triangles : (t, 3) int64 ndarray
        Numbers of vertices, counted from the first of the whole mesh; counter-clockwise seen from the camera.
    """

    step: int
    places: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    texture: np.ndarray
    triangles: np.ndarray


def reliefs(scene: ExportedScene, most: int, *, colours: np.ndarray | None) -> Iterator[Relief]:
    """The mesh from top to bottom, at most `most` vertices, each the mean over a square of pixels that have a height.

    Vertices stand in the middles of their squares. So that the mesh is as large as the picture, there is one more row
    or column of them on each of its edges, with the heights of their neighbours. At the edge of an object inside the
    picture the mesh ends at the middles of the outer squares.

    colours : (3, K) from the coefficients to linear sRGB; None: they are not read.
    """
    rows, columns = scene.shape
    longest = max(rows, columns)
    step = next((n for n in range(1, longest) if (-(-rows // n) + 2) * (-(-columns // n) + 2) <= most), longest)
    across = -(-columns // step)
    high = max(1, scene.band_rows // step) * step
    places_across = np.minimum((np.arange(across) + 0.5) * step, (np.arange(across) * step + columns) / 2)
    right = np.concatenate([[0], places_across, [columns]])
    above = np.full(len(right), -1, np.int64)
    count = 0
    for top in range(0, rows, high):
        band = slice(top, min(top + high, rows))
        height = scene.height(band)
        known = np.isfinite(height)
        share = block_mean(known, step)
        weight = np.where(share > 0, share, 1)
        middles = top + (np.arange(len(share)) + 0.5) * step
        down = np.minimum(middles, (np.minimum(middles + step / 2, rows) + middles - step / 2) / 2)
        edges = (int(top == 0), int(band.stop == rows))
        down = np.concatenate([[0] * edges[0], down, [rows] * edges[1]])
        here = _with_edges(share >= 0.5, edges)
        x = np.broadcast_to((right - columns / 2) * scene.pitch, here.shape)
        y = np.broadcast_to(((rows / 2 - down) * scene.pitch)[:, None], here.shape)
        z = _with_edges(block_mean(np.where(known, height, 0), step) / weight, edges)
        normals = block_mean(np.where(known[..., None], scene.relief_normals(band), 0), step)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.where(length > 0, normals / np.where(length > 0, length, 1), [0, 0, 1])
        linear = np.zeros_like(normals)
        if colours is not None:
            values = np.where(known[..., None], np.nan_to_num(scene.coefficients(band)), 0)
            linear = (block_mean(values, step) / weight[..., None]) @ colours.T
        normals, linear = (_with_edges(values, edges) for values in (normals, linear))
        numbers = np.where(here, count + np.cumsum(here).reshape(here.shape) - 1, -1)
        count += int(here.sum())
        u = np.broadcast_to(right / columns, here.shape)
        v = np.broadcast_to((down / rows)[:, None], here.shape)
        triangles = _triangles(np.concatenate([above[None], numbers]) if top else numbers)
        above = numbers[-1]
        yield Relief(
            step,
            np.stack([x, y, z], axis=-1)[here].astype(np.float32),
            normals[here].astype(np.float32),
            linear[here].astype(np.float32),
            np.stack([u, v], axis=-1)[here].astype(np.float32),
            triangles,
        )


def _with_edges(values: np.ndarray, edges: tuple[int, int]) -> np.ndarray:
    """Values (rows, columns, ...) with the first and last column once more, and so many more first and last rows."""
    return np.pad(values, [edges, (1, 1), *[(0, 0)] * (values.ndim - 2)], mode="edge")


def _triangles(numbers: np.ndarray) -> np.ndarray:
    """(t, 3): two triangles between four neighbours that are all there; numbers (rows, columns), -1: none."""
    a, b, c, d = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, :-1], numbers[1:, 1:]
    all_there = np.minimum(np.minimum(a, b), np.minimum(c, d)) >= 0
    a, b, c, d = (corner[all_there] for corner in (a, b, c, d))
    return np.stack([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)], axis=1).reshape(-1, 3)
