"""Align range scans of one object and merge them into one surface.

Without the system library libOpenGL, pymeshlab imports but lacks every filter of some of its plugins, without a word.

Pairs are aligned by iterated closest points (P. J. Besl and N. D. McKay, A method for registration of 3-D shapes, IEEE
Trans. PAMI 14(2), 1992) with distances to the tangent plane (Y. Chen and G. Medioni, Object modelling by registration
of multiple range images, Image and Vision Computing 10(3), 1992), on the closest part of the points only, as scans
overlap only partly (D. Chetverikov et al., The trimmed iterative closest point algorithm, ICPR 2002).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nishiki.errors import UserError
from nishiki.installation import optional

FILTERS = ("generate_surface_reconstruction_screened_poisson",)
"""Filters that this project calls."""
PACKAGES = ("libgl1", "libopengl0")
"""Debian packages that pymeshlab's plugins load libraries from."""
APT_LINE = f"apt-get install {' '.join(PACKAGES)}"


def missing_filters() -> tuple[str, ...]:
    """List the missing filters; all of them where pymeshlab cannot be imported."""
    try:
        import pymeshlab
    except ImportError:
        return FILTERS
    mesh_set = pymeshlab.MeshSet()
    return tuple(name for name in FILTERS if not hasattr(mesh_set, name))


def mesh_set():
    """Return an empty pymeshlab.MeshSet. Raises UserError where the package or its filters are missing."""
    pymeshlab = optional("pymeshlab")
    missing = missing_filters()
    if missing:
        raise UserError(
            f"pymeshlab lacks {', '.join(missing)}: its plugins need system libraries that are not installed. Remedy: "
            f"`{APT_LINE}` on Debian and Ubuntu (then start again), or give a finished mesh instead of scans"
        )
    return pymeshlab.MeshSet()


NORMAL_NEIGHBOURS = 12
"""Points around a point by whose principal axes it gets its normal, in clouds without triangles."""


def merge(
    scans: list[np.ndarray], faces: list[np.ndarray | None], *, cells: int = 256
) -> tuple[np.ndarray, np.ndarray, dict]:
    """Merge registered scans into one surface: vertices (v, 3), triangles (f, 3), and figures.

    A single scan with triangles stays as it is. Else screened Poisson reconstruction (M. Kazhdan and H. Hoppe, ACM
    Trans. Graphics 32(3), 2013) on about `cells` cells along the longest side; what lies further than three of them
    from any point is a guess and is left out. Raises UserError where pymeshlab cannot do it.
    """
    from scipy.spatial import cKDTree

    from nishiki.geometry.mesh import vertex_normals

    if len(scans) == 1 and faces[0] is not None:
        return scans[0], faces[0], {"merged": False, "guessed_triangles": 0}
    cell = float(np.ptp(np.concatenate(scans), axis=0).max()) / cells
    scans, faces = zip(
        *(_subdivide(each, triangles_of, 3 * cell) for each, triangles_of in zip(scans, faces, strict=True)),
        strict=True,
    )
    points = np.concatenate(scans)
    meshes = [(each, triangles) for each, triangles in zip(scans, faces, strict=True) if triangles is not None]
    if len(meshes) == len(scans):
        normals = [vertex_normals(*mesh).astype(np.float64) for mesh in meshes]
    else:
        normals = [_outward_normals(each, points.mean(axis=0)) for each in scans]
    vertices, triangles = _poisson(points, np.concatenate(normals), cells)
    distance, _ = cKDTree(points).query(vertices)
    spacings = []  # of each scan: the median distance of its points to the third of their neighbours
    for each in scans:
        apart, _ = cKDTree(each).query(each[:: max(1, len(each) // 5000)], k=min(4, len(each)))
        spacings.append(float(np.median(apart[:, -1])))
    reach = 3 * max(cell, *spacings)
    sure = (distance <= reach)[triangles].all(axis=1)
    return vertices, triangles[sure], {"merged": True, "guessed_triangles": int((~sure).sum())}


def _subdivide(
    points: np.ndarray, triangles: np.ndarray | None, longest: float
) -> tuple[np.ndarray, np.ndarray | None]:
    """Subdivide a scan's triangles until no edge is longer than this, since their inside was measured too."""
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


def _outward_normals(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Estimate the normals of a cloud by principal axes, turned outwards from the centre.

    They are turned alike along the shortest links between neighbours (H. Hoppe et al., SIGGRAPH 1992).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

    near, normals = _principal_axes(points, points)
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


def _principal_axes(points: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the neighbours (n, k) among the points of each place (n, 3), and the normals (n, 3) of their planes."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(points).query(places, k=min(NORMAL_NEIGHBOURS, len(points)))
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    return near, np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]


def _poisson(points: np.ndarray, normals: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the screened Poisson surface of oriented points by MeshLab."""
    pymeshlab = optional("pymeshlab")

    work = mesh_set()
    # MeshLab computes in float32: around the origin and of size one it loses least.
    centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max()) or 1.0
    work.add_mesh(pymeshlab.Mesh(vertex_matrix=(points - centre) / size, v_normals_matrix=normals))
    depth = int(np.clip(np.rint(np.log2(1.1 * cells)), 4, 11))
    work.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1, preclean=False)
    surface = work.current_mesh()
    return surface.vertex_matrix() * size + centre, surface.face_matrix().astype(np.int64)


POINTS = 4000
"""Points of a scan that are used to align it."""
COARSE_POINTS = 400  # of a scan for the first search
GOOD_ENOUGH, WORST = 0.4, 1.5
"""Residual of two aligned scans, in spacings of the thinned points: below the first the given place is taken without a
search, above the second they do not fit."""


@dataclass(frozen=True)
class Motion:
    """A rigid motion: x goes to rotation x + translation. rotation (3, 3), translation (3,) float64."""

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def none(cls) -> "Motion":
        """Return the identity motion."""
        return cls(np.eye(3), np.zeros(3))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Move points (n, 3)."""
        return points @ self.rotation.T + self.translation

    def after(self, first: "Motion") -> "Motion":
        """Compose this motion after another one."""
        return Motion(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)


@dataclass(frozen=True)
class Registered:
    """Registered scans."""

    motions: tuple[Motion, ...]  # of each scan into the frame of the first
    # (n,): root mean square distance to the tangent planes of the others over the overlapping part, world's unit (0
    # for a single scan); order in which scans were added
    residual: np.ndarray
    order: tuple[int, ...]
    moved: tuple[int, ...]  # scans that were searched for from many starts because their given place was too inexact

    def as_dict(self) -> dict:
        """Return plain data, for JSON."""
        return {
            "motions": [np.column_stack([motion.rotation, motion.translation]).tolist() for motion in self.motions],
            "residual": [float(value) for value in self.residual],
            "order": list(self.order),
            "searched": list(self.moved),
        }


@dataclass(frozen=True)
class Cloud:
    """Thinned points of a scan with their normals (signs without meaning), and the mean distance to a neighbour."""

    points: np.ndarray
    normals: np.ndarray
    spacing: float

    @cached_property
    def tree(self):
        """Search tree of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


def cloud_of(points: np.ndarray, *, most: int = POINTS) -> Cloud:
    """Sample about `most` points of a scan evenly (one per cell of a grid), with normals by principal axes."""
    from scipy.spatial import cKDTree

    chosen = thin_points(points, most)
    distance, _ = cKDTree(chosen).query(chosen, k=2)
    return Cloud(chosen, _principal_axes(points, chosen)[1], float(np.median(distance[:, 1])))


def thin_points(points: np.ndarray, most: int) -> np.ndarray:
    """Select the first point of each cell of a cubic grid so fine that about `most` cells are filled."""
    if len(points) <= most:
        return points
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max() or 1.0
    coarse, fine = 1.0, float(len(points))
    for _ in range(40):
        cells = np.sqrt(coarse * fine)
        _, first = np.unique(np.floor((points - low) / extent * cells).astype(np.int64), axis=0, return_index=True)
        coarse, fine = (cells, fine) if len(first) < most else (coarse, cells)
        if abs(len(first) - most) < 0.05 * most:
            break
    return points[np.sort(first)]


def register(scans: list[np.ndarray], *, overlap: float = 0.5) -> Registered:
    """Find the motions that bring scans, list of (n, 3) points, together in the frame of the first.

    overlap: part of a scan's points that the others have too. Where the given places already fit after alignment
    (residual below 0.4 spacings of the thinned points), they are the start; else the 60 rotations of an icosahedron
    about the centroids are tried. Scans are added one by one, the one that fits best first; then all are aligned once
    more against all others. Raises UserError where a scan fits nowhere.
    """
    clouds = [cloud_of(points) for points in scans]
    motions: dict[int, Motion] = {0: Motion.none()}
    order, searched = [0], []
    while len(motions) < len(scans):
        target = _join_clouds(clouds, motions)
        candidates = []
        for index in sorted(set(range(len(scans))) - set(motions)):
            motion, residual = align(clouds[index], target, Motion.none(), overlap=overlap)
            candidates.append((residual, index, motion))
        residual, index, motion = min(candidates, key=lambda item: item[:2])
        if residual > GOOD_ENOUGH * clouds[index].spacing:
            again = [(*_search(clouds[i], target, overlap), i) for _, i, _ in candidates]
            motion, residual, index = min(again, key=lambda item: item[1:])
            searched.append(index)
            if residual > WORST * clouds[index].spacing:
                raise UserError(
                    f"scans: scan {index + 1} fits none of the others (residual {residual:.3g}, points "
                    f"{clouds[index].spacing:.3g} apart). Remedy: scans need a common part of at least "
                    f"{overlap:.0%} (setting overlap); or align them in MeshLab and give them in one frame"
                )
        motions[index] = motion
        order.append(index)
    # align each scan to all others in turn, the first held
    residuals = np.zeros(len(clouds))
    for _ in range(3 if len(clouds) > 1 else 0):
        for index in range(len(clouds)):
            target = _join_clouds(clouds, motions, without=index)
            motion, residuals[index] = align(
                clouds[index], target, motions[index], overlap=overlap, steps=0 if index == 0 else 15
            )
            motions[index] = motion
    return Registered(tuple(motions[i] for i in range(len(scans))), residuals, tuple(order), tuple(searched))


def _join_clouds(clouds: list[Cloud], motions: dict[int, Motion], without: int | None = None) -> Cloud:
    chosen = [index for index in sorted(motions) if index != without]
    return Cloud(
        np.concatenate([motions[i].apply(clouds[i].points) for i in chosen]),
        np.concatenate([clouds[i].normals @ motions[i].rotation.T for i in chosen]),
        float(np.median([clouds[i].spacing for i in chosen])),
    )


def _search(cloud: Cloud, target: Cloud, overlap: float) -> tuple[Motion, float]:
    """Find the best of many rotations about the centroids, aligned coarsely with few points, the best five finely."""
    from scipy.spatial.transform import Rotation

    few = Cloud(thin_points(cloud.points, COARSE_POINTS), np.empty((0, 3)), cloud.spacing)
    middle, aim = cloud.points.mean(axis=0), target.points.mean(axis=0)
    tried = []
    for number, rotation in enumerate(Rotation.create_group("I").as_matrix()):
        start = Motion(rotation, aim - rotation @ middle)
        motion, residual = align(few, target, start, overlap=overlap, steps=15)
        tried.append((residual, number, motion))
    best = sorted(tried, key=lambda item: item[:2])[:5]
    fine = [align(cloud, target, motion, overlap=overlap) for _, _, motion in best]
    return min(fine, key=lambda item: item[1])


def align(cloud: Cloud, target: Cloud, start: Motion, *, overlap: float, steps: int = 40) -> tuple[Motion, float]:
    """Align a cloud to a target by trimmed closest points; return the motion and its error.

    The error is the root mean square distance to the points' tangent planes (at least a tenth of the distance to the
    points) over the closest part `overlap`.
    """
    from scipy.spatial.transform import Rotation

    keep = max(6, int(overlap * len(cloud.points)))
    motion = start
    for step in range(steps + 1):
        moved = motion.apply(cloud.points)
        distance, near = target.tree.query(moved)
        chosen = np.argpartition(distance, keep - 1)[:keep]
        chosen.sort()
        points, normals = moved[chosen], target.normals[near[chosen]]
        gaps = np.einsum("ij,ij->i", points - target.points[near[chosen]], normals)
        if step == steps:
            break
        centre = points.mean(axis=0)
        size = float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())) or 1.0
        system = np.column_stack([np.cross((points - centre) / size, normals), normals])
        # A sphere or a plane leaves directions open: a weak pull to stay keeps them still.
        matrix = system.T @ system + 1e-6 * len(points) * np.eye(6)
        change = -np.linalg.solve(matrix, system.T @ gaps)
        turn = Rotation.from_rotvec(change[:3] / size).as_matrix()
        motion = Motion(turn, centre - turn @ centre + change[3:]).after(motion)
        if np.abs(change).max() < 1e-6 * size:
            break
    return motion, float(np.sqrt((np.maximum(np.abs(gaps), 0.1 * distance[chosen]) ** 2).mean()))
