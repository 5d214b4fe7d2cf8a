"""Flattening: charts projected along their mean normal, and the proof that nothing lies on anything else."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from nishiki.geometry.raster import bounds, edge


@dataclass(frozen=True)
class Frame:
    """Axes of charts: direction (charts, 3) float64 away from the surface; down, right (charts, 3): the chart's rows
    and columns as someone sees them who looks at the surface from outside, with the turntable's axis upright."""

    direction: np.ndarray
    down: np.ndarray
    right: np.ndarray


def frame_along(direction: np.ndarray, *, up: np.ndarray, front: np.ndarray) -> Frame:
    """Axes for directions (n, 3): down is as near to the turntable's foot as the chart allows; for charts that look
    along the axis (within 18 degrees), as near to `front` instead."""
    direction = np.asarray(direction, np.float64)
    upright = np.broadcast_to(np.asarray(up, np.float64) / np.linalg.norm(up), direction.shape)
    along = (direction * upright).sum(axis=1, keepdims=True)
    forward = np.asarray(front, np.float64) / np.linalg.norm(front)
    down = np.where(np.abs(along) < 0.95, -upright, np.sign(along) * forward)
    down = down - (down * direction).sum(axis=1, keepdims=True) * direction
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    return Frame(direction, down, np.cross(direction, down))


def flatten(corners: np.ndarray, chart: np.ndarray, frames: Frame) -> np.ndarray:
    """(f, 3, 2) float64: (down, right) of the corners (f, 3, 3) in the planes of their charts (f,), in the world's
    unit; 0 where the chart is negative."""
    plane = np.zeros((*corners.shape[:2], 2))
    inside = chart >= 0
    for axis, vectors in enumerate((frames.down, frames.right)):
        plane[inside, :, axis] = np.einsum("fkx,fx->fk", corners[inside], vectors[chart[inside]])
    return plane


def overlapping(
    plane: np.ndarray, chart: np.ndarray, neighbours: np.ndarray, areas: np.ndarray, *, spacing: float
) -> np.ndarray:
    """(f,) bool: triangles that would lie on another one of their chart.

    Each chart grows from its largest triangle, ring by ring, over a grid of probes `spacing` apart; a triangle one of
    whose probes is taken is told. Negative charts take no part.
    """
    order = np.lexsort((-areas, chart))
    order = order[np.searchsorted(chart[order], 0) :].astype(np.int32)
    first = np.flatnonzero(np.diff(chart[order], prepend=-1))
    stop = np.append(first[1:], len(order))
    overlaps = np.zeros(len(chart), np.bool_)
    reached = np.zeros(len(chart), np.bool_)
    for begin, end in zip(first, stop, strict=True):
        members = order[begin:end]
        points = plane[members]
        low = points.min(axis=(0, 1))
        size = np.ceil((points.max(axis=(0, 1)) - low) / spacing).astype(np.int64) + 2
        # A crumb of a huge chart must not cost a huge grid, nor a wrong unit all memory.
        coarser = max(1.0, np.sqrt(size.prod() / 6.4e7))
        size = np.ceil(size / coarser).astype(np.int64) + 1
        grid = np.zeros(tuple(size), np.bool_)
        grow(plane, members, chart, neighbours, low, 1 / (spacing * coarser), grid, reached, overlaps)
    return overlaps


@numba.njit(cache=True, nogil=True, error_model="numpy")
def grow(plane, members, chart, neighbours, low, scale, grid, reached, overlaps):
    """One chart of `overlapping`: fills `overlaps`; `reached` is a note of who has been looked at."""
    queue = np.empty(len(members), np.int32)
    points = np.empty((3, 2))
    for seed in members:
        if reached[seed]:
            continue
        reached[seed], queue[0], head, tail = True, seed, 0, 1
        while head < tail:
            here = queue[head]
            head += 1
            for k in range(3):
                points[k, 0] = (plane[here, k, 1] - low[1]) * scale
                points[k, 1] = (plane[here, k, 0] - low[0]) * scale
            if take(points, grid, False):
                overlaps[here] = True
                continue
            take(points, grid, True)
            for k in range(3):
                there = neighbours[here, k]
                if there >= 0 and not reached[there] and chart[there] == chart[here]:
                    reached[there], queue[tail] = True, there
                    tail += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def take(points, grid, mark):
    """Whether a probe inside a triangle (3, 2) (column, row) is taken; with `mark`, take them all."""
    area = edge(points, 0, 1, points[2, 0], points[2, 1])
    b, c = (1, 2) if area > 0 else (2, 1)
    # Probes on an edge, as nearly as can be told, belong to neither side: touching is no overlap.
    least = 1e-9 * abs(area)
    left, right = bounds((points[0, 0], points[1, 0], points[2, 0]), grid.shape[1])
    top, bottom = bounds((points[0, 1], points[1, 1], points[2, 1]), grid.shape[0])
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            x, y = np.float64(column), np.float64(row)
            lowest = min(edge(points, b, c, x, y), edge(points, c, 0, x, y), edge(points, 0, b, x, y))
            if lowest > least:
                if mark:
                    grid[row, column] = True
                elif grid[row, column]:
                    return True
    return False
