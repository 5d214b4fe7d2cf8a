"""Cut a mesh into few, large, connected charts, each flat when seen along its own direction.

Triangles are labelled by the one of six directions that their smoothed normal is nearest to, four of them around the
turntable's axis; small pieces go to their neighbours; and where the projection along a piece's mean normal turns a
triangle over, or lays one onto another, the piece is split. What is left is a bijection from every chart to the plane.
"""

import itertools
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.atlas.adjacency import across_edges, borders, components, smooth_over_triangles, smoothed_vertices, spread
from nishiki.errors import require
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors
from nishiki.geometry.visibility import bounds, edge


def turning(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors (3,): up along the turntable's axis, and front across it towards the first camera.

    Up is the mean of the pictures' own up: over a turn what lies across the axis cancels. In a world that is known up
    to an affine map only, both are still constant over the object.
    """
    up = -np.sum([camera.rotation[1] for camera in cameras], axis=0)
    length = np.linalg.norm(up)
    up = up / length if length > 1e-6 else np.array([0.0, 1.0, 0.0])
    back = -cameras[0].rotation[2]
    front = back - (back @ up) * up
    if np.linalg.norm(front) < 1e-3:  # looking down: the picture's foot is in front
        front = cameras[0].rotation[1] - (cameras[0].rotation[1] @ up) * up
    if np.linalg.norm(front) < 1e-3:
        front = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return up, front / np.linalg.norm(front)


def probe_spacing(mesh: Mesh, cameras: list[Camera], *, texels_per_pixel: float) -> float:
    """Compute half a texel in the world's unit, for the median over views of a pixel's size at the mesh's middle."""
    middle = np.median(mesh.vertices[mesh.triangles.reshape(-1)], axis=0)
    sizes = []
    for camera in cameras:
        depth = camera.project(middle[None])[1][0]
        if depth > 0:
            sizes.append(depth / np.sqrt(abs(camera.intrinsics[0, 0] * camera.intrinsics[1, 1])))
    extent = np.linalg.norm(np.nanmax(mesh.vertices, axis=0) - np.nanmin(mesh.vertices, axis=0))
    return float(np.median(sizes)) / (2 * texels_per_pixel) if sizes else float(extent) / 1000


@dataclass(frozen=True)
class ChartAxes:
    """The axes of charts: their rows and columns, viewed from outside with the turntable's axis upright."""

    direction: np.ndarray  # (charts, 3) float64 away from the surface
    down: np.ndarray  # (charts, 3)
    right: np.ndarray  # (charts, 3)


def frame_along(direction: np.ndarray, *, up: np.ndarray, front: np.ndarray) -> ChartAxes:
    """Choose axes for directions (n, 3): down is as near to the turntable's foot as the chart allows.

    For charts that face along the axis (within 18 degrees) it is as near to `front` instead.
    """
    direction = np.asarray(direction, np.float64)
    upright = np.broadcast_to(np.asarray(up, np.float64) / np.linalg.norm(up), direction.shape)
    along = (direction * upright).sum(axis=1, keepdims=True)
    forward = np.asarray(front, np.float64) / np.linalg.norm(front)
    down = np.where(np.abs(along) < 0.95, -upright, np.sign(along) * forward)
    down = down - (down * direction).sum(axis=1, keepdims=True) * direction
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    return ChartAxes(direction, down, np.cross(direction, down))


def flatten(corners: np.ndarray, chart: np.ndarray, frames: ChartAxes) -> np.ndarray:
    """Project corners (f, 3, 3) into the planes of their charts (f,): (f, 3, 2) float64 (down, right).

    Values are in the world's unit, 0 where the chart is negative.
    """
    plane = np.zeros((*corners.shape[:2], 2))
    inside = chart >= 0
    for axis, vectors in enumerate((frames.down, frames.right)):
        plane[inside, :, axis] = np.einsum("fkx,fx->fk", corners[inside], vectors[chart[inside]])
    return plane


def overlapping(
    plane: np.ndarray, chart: np.ndarray, neighbours: np.ndarray, areas: np.ndarray, *, spacing: float
) -> np.ndarray:
    """Find triangles (f,) bool that would lie on another one of their chart.

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
        grow(plane, members, chart, neighbours, (low, 1 / (spacing * coarser)), grid, reached, overlaps)
    return overlaps


@numba.njit(cache=True, nogil=True, error_model="numpy")
def grow(plane, members, chart, neighbours, frame, grid, reached, overlaps):
    """Fill `overlaps` of one chart of `overlapping`; frame: its corner, cells a unit; reached: triangles looked at."""
    low, scale = frame
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
    """Check whether a probe inside a triangle (3, 2) (column, row) is taken; with `mark`, take them all."""
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


ROUNDS = 12
"""Rounds of splitting and naming anew; each split-off piece is judged by its own direction in the next round."""
SMOOTHING = (0, 4, 16, 64, 256)
"""Rounds of smoothing tried before the projection, in this order."""
FEW = 0.005
"""Share of the triangles that may be split off at first; more, and the attempt is given up."""
MANY = 50
"""Charts that are few enough."""


RANGE_OF_NORMALS = 0.02  # over which normals are averaged before they are judged, of the mesh's extent
SMALLEST = 0.01  # area below which a piece is merged, of the whole surface
STEEPEST_DEG = 80.0  # largest angle between a triangle and its chart


@dataclass(frozen=True)
class Charts:
    """The charts of a mesh."""

    chart: np.ndarray  # (f,) int32, -1 for triangles without area that touch no other
    frames: ChartAxes  # direction and axes of each chart
    plane: np.ndarray  # (f, 3, 2) float64: (down, right) of the corners in the chart's plane, in the world's unit
    smoothing_rounds: int  # of `smoothed_vertices` before the projection
    degenerate: int  # triangles without area
    flipped: int  # triangles split off because they were turned over, over all rounds
    overlapped: int  # triangles split off because they overlapped


def make_charts(mesh: Mesh, *, up: np.ndarray, front: np.ndarray, spacing: float) -> Charts:
    """Cut a mesh into charts.

    up, front (3,): the turntable's axis and a direction across it; spacing: distance of the probes that look for
    overlaps, in the world's unit (half a texel). The surface is flattened as it is where that
    makes at most `MANY` charts, otherwise smoothed before, by as many of `SMOOTHING` rounds as make so few, or the
    fewest: on a rough surface many triangles turn away from any direction, and each would become a chart of its own.
    """
    best: Charts | None = None
    for rounds in SMOOTHING:
        vertices = smoothed_vertices(mesh.vertices, mesh.triangles, rounds=rounds)
        patience = FEW if best is not None or rounds < SMOOTHING[-1] else 1.0
        charts = cut_charts(mesh, vertices, rounds, up=up, front=front, spacing=spacing, patience=patience)
        if charts is not None and (best is None or len(charts.frames.direction) < len(best.frames.direction)):
            best = charts
        if best is not None and len(best.frames.direction) <= MANY:
            break
    return require(best)  # the last cut has patience for any number


def cut_charts(
    mesh: Mesh, vertices: np.ndarray, rounds: int, *, up: np.ndarray, front: np.ndarray, spacing: float, patience: float
) -> Charts | None:
    """Cut a mesh into charts; None where more than `patience` of the triangles are turned over.

    vertices (v, 3): smoothed in `rounds`; the charts are flattened with them.
    """
    neighbours = across_edges(mesh.triangles)
    normals, areas = unit_normals(mesh, vertices)
    usable, lowest = areas > 0, np.cos(np.radians(STEEPEST_DEG))
    reach = RANGE_OF_NORMALS
    labels = nearest_direction(vertices, normals, areas, neighbours, up=up, front=front, smoothing=reach)
    labels = components(np.where(usable, labels, -1).astype(np.int32), neighbours)
    corners = vertices[mesh.triangles]
    lengths = np.nan_to_num(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2), posinf=0.0)
    totals = [0, 0]
    for _ in range(2):  # what splits leave behind is merged once more
        labels = merge_small(labels, normals, areas, neighbours, lengths, smallest=SMALLEST, lowest=lowest)
        for attempt in itertools.count():
            frames = frame_along(directions_of(labels, normals, areas), up=up, front=front)
            plane = flatten(vertices[mesh.triangles], labels, frames)
            cosines = (normals * frames.direction[labels]).sum(axis=1)
            flipped = usable & (labels >= 0) & (cosines < lowest)
            overlap = overlapping(plane, np.where(flipped, -1, labels), neighbours, areas, spacing=spacing)
            away = flipped | overlap
            if not away.any():
                break
            if flipped.mean() > patience:  # smoothing helps against folds, not against overlaps
                return None
            totals[0] += int(flipped.sum())
            totals[1] += int(overlap.sum())
            if attempt < ROUNDS:
                labels = split(labels, away, normals, neighbours)
            else:  # a triangle alone is flat, so this comes to an end
                labels = labels.copy()
                labels[away] = labels.max() + 1 + np.arange(away.sum())
    labels = spread(np.where(usable, labels, -1).astype(np.int32), neighbours)
    inside = labels >= 0
    size = np.bincount(labels[inside], areas[inside], minlength=int(labels.max(initial=-1)) + 1)
    place = np.empty(len(size), np.int32)  # charts are numbered by area, the largest first
    place[np.argsort(-size, kind="stable")] = np.arange(len(size))
    labels = np.where(inside, place[labels] if len(size) else -1, -1).astype(np.int32)
    frames = frame_along(directions_of(labels, normals, areas), up=up, front=front)
    plane = flatten(vertices[mesh.triangles], labels, frames)
    return Charts(labels, frames, plane, rounds, int((~usable).sum()), *totals)


def unit_normals(mesh: Mesh, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (f, 3) and areas (f,) float64 of the triangles between smoothed vertices (v, 3).

    Both are 0 where a triangle has no area, smoothed or not.
    """
    faces, true_faces = face_vectors(vertices, mesh.triangles), face_vectors(mesh.vertices, mesh.triangles)
    areas, true_areas = (np.linalg.norm(v, axis=1) / 2 for v in (faces, true_faces))
    usable = has_area(areas) & has_area(true_areas)
    normals = np.where(usable[:, None], faces / np.where(usable, 2 * areas, 1)[:, None], 0.0)
    return normals, np.where(usable, areas, 0.0)


def has_area(areas: np.ndarray) -> np.ndarray:
    """Check which areas are finite and not negligible beside the largest: (f,) bool."""
    finite = np.isfinite(areas)
    return finite & (areas > 1e-12 * np.max(areas, where=finite, initial=0.0))


def nearest_direction(vertices, normals, areas, neighbours, *, up, front, smoothing: float) -> np.ndarray:
    """Label triangles (f,) int32 by the nearest of six directions: along the axis, and four across it."""
    frame = frame_along(np.asarray(front, np.float64)[None], up=up, front=front)
    axes = np.concatenate([frame.direction, -frame.down, frame.right])
    mean_edge = np.sqrt(areas.sum() / max(1, np.count_nonzero(areas)) * 4 / np.sqrt(3))
    extent = np.linalg.norm(np.nanmax(vertices, axis=0) - np.nanmin(vertices, axis=0))
    # Averaging over neighbours spreads like diffusion: the range grows with the root of the rounds.
    rounds = int(np.clip((smoothing * extent / max(mean_edge, 1e-300)) ** 2, 1, 400))
    mean = smooth_over_triangles(normals, areas, neighbours, rounds=rounds)
    return np.argmax(mean @ np.concatenate([axes, -axes]).T, axis=1).astype(np.int32)


def directions_of(labels: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Average the normals (charts, 3) of each chart, weighted by area, unit length; (0, 0, 1) where they cancel."""
    inside = labels >= 0
    count = int(labels.max(initial=-1)) + 1
    weighted = normals * areas[:, None]
    sums = np.stack([np.bincount(labels[inside], weighted[inside, k], minlength=count) for k in range(3)], axis=1)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0])


def merge_small(labels, normals, areas, neighbours, lengths, *, smallest: float, lowest: float) -> np.ndarray:
    """Merge pieces smaller than `smallest` of the surface into the neighbour with the longest common border.

    No triangle of the piece may turn away from that neighbour; a piece that no neighbour can take stays.
    """
    total = areas.sum()
    for _ in range(40):
        count = int(labels.max(initial=-1)) + 1
        size = np.bincount(labels[labels >= 0], areas[labels >= 0], minlength=count)
        directions = directions_of(labels, normals, areas)
        pairs, common = borders(labels, neighbours, lengths)
        small = size[pairs[:, 0]] < smallest * total
        pairs, common = pairs[small], common[small]
        order = np.lexsort((-common, pairs[:, 0], size[pairs[:, 0]]))
        rank = np.argsort(labels, kind="stable")
        edges = np.searchsorted(labels[rank], np.arange(count + 1))
        target, busy = np.arange(count), np.zeros(count, bool)
        for piece, neighbour in pairs[order]:
            if busy[piece] or target[neighbour] != neighbour:
                continue
            members = rank[edges[piece] : edges[piece + 1]]
            if (normals[members] @ directions[neighbour]).min() > lowest:
                target[piece] = neighbour
                busy[piece] = busy[neighbour] = True
        if (target == np.arange(count)).all():
            break
        labels = np.where(labels >= 0, target[labels], -1)
        labels = np.unique(labels, return_inverse=True)[1].astype(np.int32) - int((labels < 0).any())
    return labels.astype(np.int32)


def split(labels: np.ndarray, away: np.ndarray, normals: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Relabel (f,) int32 so that the triangles `away` leave their charts, grouped by connection and octant."""
    octant = ((normals > 0) * np.array([1, 2, 4])).sum(axis=1)
    keys = np.where(away, 8 * labels.astype(np.int64) + octant, 8 * labels.astype(np.int64) + 8 * (labels.max() + 1))
    keys = np.where(labels >= 0, keys, -1)
    named = np.unique(keys, return_inverse=True)[1].reshape(-1) - int((keys < 0).any())
    return components(named.astype(np.int32), neighbours)
