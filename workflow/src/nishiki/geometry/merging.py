"""Registered range scans merged into one surface."""

from __future__ import annotations

import numpy as np

from nishiki.packages import optional

NORMAL_NEIGHBOURS = 12
"""Points around a point by whose principal axes it gets its normal, in clouds without triangles."""


def merge(
    scans: list[np.ndarray], faces: list[np.ndarray | None], *, cells: int = 256
) -> tuple[np.ndarray, np.ndarray, dict]:
    """One surface through registered scans: vertices (v, 3), triangles (f, 3), and figures.

    A single scan with triangles stays as it is. Else screened Poisson reconstruction (M. Kazhdan and H. Hoppe, ACM
    Trans. Graphics 32(3), 2013) on about `cells` cells along the longest side; what lies further than three of them
    from any point is a guess and is left out. Raises UserError where pymeshlab cannot do it.
    """
    from scipy.spatial import cKDTree

    if len(scans) == 1 and faces[0] is not None:
        return scans[0], faces[0], {"merged": False, "guessed_triangles": 0}
    cell = float(np.ptp(np.concatenate(scans), axis=0).max()) / cells
    scans, faces = zip(
        *(_filled(each, triangles_of, 3 * cell) for each, triangles_of in zip(scans, faces, strict=True)), strict=True
    )
    points = np.concatenate(scans)
    normals = [_scan_normals(each, triangles_of) for each, triangles_of in zip(scans, faces, strict=True)]
    if any(scan_normals is None for scan_normals in normals):
        normals = [_outward_normals(each, points.mean(axis=0)) for each in scans]
    vertices, triangles = _poisson(points, np.concatenate(normals), cells)
    distance, _ = cKDTree(points).query(vertices)
    reach = 3 * max(cell, max(_spacing(each) for each in scans))
    sure = (distance <= reach)[triangles].all(axis=1)
    return vertices, triangles[sure], {"merged": True, "guessed_triangles": int((~sure).sum())}


def _filled(points: np.ndarray, triangles: np.ndarray | None, longest: float) -> tuple[np.ndarray, np.ndarray | None]:
    """A scan whose triangles are cut up until no edge is longer than this: what lies inside a triangle was measured
    too, however far its corners are apart."""
    if triangles is None or not len(triangles):
        return points, None
    optional("trimesh")
    from trimesh.remesh import subdivide_to_size

    edges = np.linalg.norm(points[triangles] - points[np.roll(triangles, 1, axis=1)], axis=2)
    if edges.max() <= longest:
        return points, triangles
    vertices, cut = subdivide_to_size(points, triangles, longest, max_iter=20)
    corners, place = np.unique(vertices, axis=0, return_inverse=True)
    return corners, place.reshape(-1)[cut]


def _spacing(points: np.ndarray) -> float:
    """Median distance of a scan's points to the third of their neighbours."""
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(points).query(points[:: max(1, len(points) // 5000)], k=min(4, len(points)))
    return float(np.median(distance[:, -1]))


def _scan_normals(points: np.ndarray, triangles: np.ndarray | None) -> np.ndarray | None:
    """Normals of a scan's own triangles; None without."""
    from nishiki.geometry.mesh import vertex_normals

    return None if triangles is None else vertex_normals(points, triangles).astype(np.float64)


def _outward_normals(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Normals of a cloud by principal axes, turned alike along the shortest links between neighbours (H. Hoppe et al.,
    Surface reconstruction from unorganized points, SIGGRAPH 1992), as a whole away from the centre."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
    from scipy.spatial import cKDTree

    _distance, near = cKDTree(points).query(points, k=min(NORMAL_NEIGHBOURS, len(points)))
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    first, second = np.repeat(np.arange(len(points)), near.shape[1] - 1), near[:, 1:].reshape(-1)
    differ = 1.0001 - np.abs(np.einsum("ij,ij->i", normals[first], normals[second]))
    graph = coo_matrix((differ, (first, second)), (len(points),) * 2).tocsr()
    tree = minimum_spanning_tree(graph.maximum(graph.T))
    parts, labels = connected_components(tree, directed=False)
    for part in range(parts):
        mine = np.flatnonzero(labels == part)
        order, parents = breadth_first_order(tree, mine[0], directed=False)
        for point in order[1:]:
            if normals[point] @ normals[parents[point]] < 0:
                normals[point] = -normals[point]
        if np.einsum("ij,ij->", normals[mine], points[mine] - centre) < 0:
            normals[mine] = -normals[mine]
    return normals


def _poisson(points: np.ndarray, normals: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Screened Poisson surface of oriented points by MeshLab."""
    from nishiki.geometry.meshlab import mesh_set

    pymeshlab = optional("pymeshlab")

    work = mesh_set()
    # MeshLab computes in float32: around the origin and of size one it loses least.
    centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max()) or 1.0
    work.add_mesh(pymeshlab.Mesh(vertex_matrix=(points - centre) / size, v_normals_matrix=normals))
    depth = int(np.clip(np.rint(np.log2(1.1 * cells)), 4, 11))
    work.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1, preclean=False)
    surface = work.current_mesh()
    return surface.vertex_matrix() * size + centre, surface.face_matrix().astype(np.int64)
