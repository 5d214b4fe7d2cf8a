"""Measure and simplify surfaces: distance between two meshes, fewest triangles within a deviation, shape facts."""

from dataclasses import dataclass

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.decimation import collapse
from nishiki.geometry.mesh import Mesh, face_vectors, row_numbers

CANDIDATES = 6  # nearest samples whose triangles are looked at
MEASURED = 10_000
"""Vertices, evenly taken, at which a deviation is measured."""
THIN, FINEST = 40.0, 3.0
"""Thickness in deviations below which they count more in proportion, and how much more at most: half a pixel makes a
prism of a rung of five pixels."""


@dataclass(frozen=True)
class SimplifiedMesh:
    """A simplified mesh."""

    mesh: Mesh
    # distance of the original's surface in pixels of the sharpest view that 99 in 100 vertices stay below (see THIN)
    deviation_px: float
    deviation_largest_px: float  # the largest (tips of needles)
    before: int  # triangles of the original


def decimate(mesh: Mesh, triangles: int) -> Mesh:
    """Reduce a mesh to about `triangles` triangles (no fewer than a collapse leaves; never more), deterministic."""
    if triangles >= len(mesh.triangles):
        return mesh
    vertices, faces = mesh.vertices.copy(), mesh.triangles.copy()
    return compact(vertices, faces[collapse(vertices, faces, triangles)])


def compact(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Make a mesh of those vertices (v, 3) that faces (f, 3) use."""
    used, renumbered = np.unique(faces, return_inverse=True)
    return Mesh.of(vertices[used], renumbered.reshape(-1, 3))


def pixels_per_unit(points: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """Compute pixels (n,) float64 per unit of length across the line of sight at each point, in the sharpest view."""
    largest = np.zeros(len(points))
    for camera in cameras:
        depth = points @ camera.rotation[2] + camera.translation[2]
        focal = max(abs(camera.intrinsics[0, 0]), abs(camera.intrinsics[1, 1]))
        np.maximum(largest, np.where(depth > 0, focal / np.where(depth > 0, depth, 1), 0), out=largest)
    return largest


def distances(points: np.ndarray, mesh: Mesh, *, spacing: float | None = None) -> np.ndarray:
    """Compute distances (n,) float64 of points (n, 3) to the surface of a mesh.

    Nearest among the triangles whose samples (one per `spacing` along every edge, by default the square root of the
    mean area a point has) are nearest: at most a small part of the spacing too large, never too small.
    """
    from scipy.spatial import cKDTree

    areas = 0.5 * np.linalg.norm(face_vectors(mesh.vertices, mesh.triangles), axis=1)
    spacing = spacing or float(np.sqrt(areas.sum() / max(1, len(points)))) or 1.0
    samples, owners = sample(mesh, spacing)
    _, nearest = cKDTree(samples).query(points, k=np.arange(min(CANDIDATES, len(samples))) + 1, workers=-1)
    corners = mesh.vertices[mesh.triangles[owners[nearest.T]]]
    return np.min([point_to_triangle(points, each) for each in corners], axis=0)


def sample(mesh: Mesh, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (n, 3) inside the triangles, at most `spacing` apart along edges; return their triangles (n,) too.

    At most 64 points lie along one edge. None lies on a border: triangles would share it, and of a corner's many
    triangles the nearest might not be looked at.
    """
    corners = mesh.vertices[mesh.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.clip(np.ceil(sides / spacing), 1, 64).astype(int)
    points, owners = [], []
    for count in np.unique(parts):
        mine = np.flatnonzero(parts == count)
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        inside = i + j <= count
        corners_apart = np.column_stack([i[inside], j[inside], count - i[inside] - j[inside]])
        weights = (corners_apart + 1 / 3) / (count + 1)
        points.append(np.einsum("wk,fkc->fwc", weights, corners[mine]).reshape(-1, 3))
        owners.append(np.repeat(mine, len(weights)))
    return np.concatenate(points), np.concatenate(owners)


def point_to_triangle(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Compute distances (n,) of points (n, 3) to triangles (n, 3 corners, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal)
    flat = square > 0
    above = np.einsum("ij,ij->i", points - a, normal)
    foot = points - (above / np.where(flat, square, 1))[:, None] * normal
    inside = flat.copy()
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ij,ij->i", np.cross(end - start, foot - start), normal) >= 0
    nearest = np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        length = np.einsum("ij,ij->i", along, along)
        t = np.clip(np.einsum("ij,ij->i", points - start, along) / np.where(length > 0, length, 1), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - start - t[:, None] * along, axis=1))
    return np.where(inside, np.abs(above) / np.sqrt(np.where(flat, square, 1)), nearest)


def fewest_triangles(
    mesh: Mesh, cameras: list[Camera], *, deviation_px: float, most: int | None = None, rounds: int = 4
) -> SimplifiedMesh:
    """Simplify a mesh as far as 99 in 100 original vertices stay within `deviation_px` pixels of its surface.

    Pixels as `pixels_per_unit`, more where the body is thin. A quarter of the triangles is tried as long as that
    suffices, then bisection (`rounds` halvings of the logarithm), each from the last surface that does; 0 keeps all.
    most: no more triangles than this, whatever the deviation. Deterministic.
    """
    from nishiki.geometry.visibility import cast, make_tree

    chosen = np.unique(mesh.triangles)
    chosen = chosen[:: max(1, len(chosen) // MEASURED)]
    points, inwards, before = mesh.vertices[chosen], -mesh.normals[chosen], len(mesh.triangles)
    scale = pixels_per_unit(points, cameras)
    quarter = decimate(mesh, max(before // 4, min(64, before)))
    if deviation_px > 0:
        inwards *= (deviation_px / np.maximum(scale, 1e-300))[:, None]
        deep = cast(make_tree(quarter.vertices, quarter.triangles), points + inwards, inwards).distance
        scale *= np.clip(THIN / (1 + deep), 1, FINEST)

    def measure(light: Mesh) -> SimplifiedMesh:
        off = distances(points, light) * scale
        return SimplifiedMesh(light, float(np.percentile(off, 99)), float(off.max()), before)

    best = SimplifiedMesh(mesh, 0.0, 0.0, before)
    if most is not None and most < before:
        best = measure(decimate(mesh, most))
    if deviation_px <= 0 or best.deviation_px > deviation_px:
        return best
    low, high, lowest = None, np.log(len(best.mesh.triangles)), np.log(min(64, before))
    while rounds and high > lowest:
        target = max(high - np.log(4), lowest) if low is None else 0.5 * (low + high)
        rounds -= low is not None
        tried = measure(quarter if low is None and best.mesh is mesh else decimate(best.mesh, int(np.exp(target))))
        if tried.deviation_px <= deviation_px:
            best, high = tried, target
        else:
            low = target
    return best


def snap(mesh: Mesh, step: float) -> Mesh:
    """Snap vertices to the grid of multiples of `step`; vanishing triangles are dropped."""
    vertices = np.round(mesh.vertices / step) * step
    areas = np.linalg.norm(face_vectors(vertices, mesh.triangles), axis=1)
    return compact(vertices, mesh.triangles[areas > 0])


def smooth_outline_steps(mesh: Mesh, cameras: list[Camera], *, most_px: float, rounds: int = 8) -> Mesh:
    """Smooth away the steps of the grid and the noise of the outlines, moving vertices by `most_px` at most.

    G. Taubin, A signal processing approach to fair surface design, SIGGRAPH 1995: alternately towards the neighbours'
    mean and a little further back, so that the whole does not shrink. Pixels as `pixels_per_unit`.
    """
    graph = vertex_adjacency(mesh)
    counts = np.maximum(graph.sum(axis=1), 1)[:, None]
    points = mesh.vertices
    for _ in range(rounds):
        for factor in (0.5, -0.53):
            points = points + factor * (graph @ points / counts - points)
    moved = points - mesh.vertices
    limit = most_px / np.maximum(pixels_per_unit(mesh.vertices, cameras), 1e-300)
    length = np.linalg.norm(moved, axis=1)
    moved *= np.minimum(1.0, limit / np.maximum(length, 1e-300))[:, None]
    return Mesh.of(mesh.vertices + moved, mesh.triangles)


def vertex_adjacency(mesh: Mesh):
    """Make the matrix (v, v), sparse, that is 1 where two vertices share an edge."""
    from scipy.sparse import coo_array

    ends, others = np.repeat(mesh.triangles, 2, axis=1).ravel(), mesh.triangles[:, [1, 2, 2, 0, 0, 1]].ravel()
    graph = coo_array((np.ones(len(ends), np.int8), (ends, others)), (len(mesh.vertices),) * 2).tocsr()
    graph.data = np.ones(graph.nnz)
    return graph


@dataclass(frozen=True)
class MeshFacts:
    """Facts of a mesh."""

    vertices: int
    triangles: int
    open_edges: int  # edges of one triangle only
    crowded_edges: int  # of more than two
    parts: int  # connected parts
    watertight: bool  # no open, crowded or inconsistently turned edge
    genus: int | None  # number of handles over all parts, None where not watertight
    volume: float | None  # volume, area: world's unit cubed (None where not watertight) and squared
    area: float


def shape_of(mesh: Mesh) -> MeshFacts:
    """Measure topology and size of a mesh."""
    parts, _ = parts_of(mesh.triangles, len(mesh.vertices))
    directed = np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    counts = np.bincount(row_numbers(np.sort(directed, axis=1)))
    repeated = np.bincount(row_numbers(directed)).max(initial=0) > 1
    watertight = bool(len(mesh.triangles)) and not (counts != 2).any() and not repeated
    used = len(np.unique(mesh.triangles))
    genus = (2 * parts - (used - len(counts) + len(mesh.triangles))) // 2 if watertight else None
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return MeshFacts(
        len(mesh.vertices),
        len(mesh.triangles),
        int((counts == 1).sum()),
        int((counts > 2).sum()),
        parts,
        watertight,
        int(genus) if genus is not None else None,
        float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6) if watertight else None,
        float(0.5 * np.linalg.norm(face_vectors(mesh.vertices, mesh.triangles), axis=1).sum()),
    )


def parts_of(triangles: np.ndarray, vertices: int) -> tuple[int, np.ndarray]:
    """Count the connected parts and find the part (f,) of each triangle."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(vertices, vertices))
    _, labels = connected_components(graph, directed=False)
    numbers, mine = np.unique(labels[triangles[:, 0]], return_inverse=True)
    return len(numbers), mine


def without_small_parts(mesh: Mesh, *, smallest: float = 0.05) -> tuple[Mesh, int]:
    """Remove parts whose box has a diagonal below `smallest` times that of the largest; count them."""
    count, mine = parts_of(mesh.triangles, len(mesh.vertices))
    if count < 2:
        return mesh, 0
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for k in range(3):
        np.minimum.at(low, mine, mesh.vertices[mesh.triangles[:, k]])
        np.maximum.at(high, mine, mesh.vertices[mesh.triangles[:, k]])
    diagonal = np.linalg.norm(high - low, axis=1)
    kept = diagonal >= smallest * diagonal.max()
    return compact(mesh.vertices, mesh.triangles[kept[mine]]), int((~kept).sum())
