"""Make surfaces to be covered with cloth, and the direction of the weft at their vertices."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.artifacts.provenance import file_digest
from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh, load_geometry, read_triangles
from nishiki.installation import optional
from nishiki.render.cloth.scene import Surface


def transport_tangents(
    count: int, triangles: np.ndarray, normals: np.ndarray, weft: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, int]:
    """Compute unit tangents (count, 3) at all vertices, and the number of vertices at which they are arbitrary.

    Between two vertices a tangent is carried by the smallest rotation that takes one normal to the other. Unknown
    tangents, as complex numbers in each vertex's own frame, are those that differ least, squared and summed over the
    edges, from what their neighbours carry to them: the harmonic field of the connection Laplacian (N. Sharp, Y.
    Soliman, K. Crane, The vector heat method, ACM TOG 2019, with equal weights of the edges). Where the field is next
    to nothing (a singularity), a vertex takes the tangent of its strongest neighbour. Parts of the surface without
    any known tangent get one that changes as little as the frames allow: the projection of the axis that lies
    flattest.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import spsolve

    weft = weft.copy()
    edges = _edges(triangles)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    ones = np.ones(len(i))
    labels = connected_components(coo_matrix((ones, (i, j)), (count, count)), directed=False)[1]
    fed = np.bincount(labels, weights=known, minlength=labels.max(initial=-1) + 1) > 0
    orphan = ~fed[labels]
    if orphan.any():
        weft[orphan] = _flattest(normals[orphan])
    unknown = ~known & ~orphan
    if not unknown.any():
        return weft, int(orphan.sum())
    right = _flattest(normals)
    up = np.cross(normals, right)
    # right of j turned by the smallest rotation from one normal to the other; of opposite normals by half a turn
    axis, cosine = np.cross(normals[j], normals[i]), np.sum(normals[j] * normals[i], axis=1, keepdims=True)
    along = np.sum(axis * right[j], axis=1, keepdims=True) / np.maximum(1 + cosine, 1e-9)
    carried = cosine * right[j] + np.cross(axis, right[j]) + axis * along
    carried -= np.sum(carried * normals[i], axis=1, keepdims=True) * normals[i]
    # Angle of j's frame after it has come to i; a tangent z at j arrives as turn * z.
    turn = np.sum(carried * right[i], axis=1) + 1j * np.sum(carried * up[i], axis=1)
    turn /= np.maximum(np.abs(turn), 1e-300)
    gather = coo_matrix((turn, (i, j)), (count, count)).tocsr()
    degree = np.bincount(i, minlength=count).astype(float)
    values = np.sum(weft * right, axis=1) + 1j * np.sum(weft * up, axis=1)
    free = np.flatnonzero(unknown)
    fixed = np.flatnonzero(~unknown)
    matrix = (diags(degree[free]) - gather[free][:, free]).tocsc()
    values[free] = spsolve(matrix, gather[free][:, fixed] @ values[fixed])
    values = _rescue(values, free, gather)
    values /= np.maximum(np.abs(values), 1e-300)
    weft[free] = (values.real[:, None] * right + values.imag[:, None] * up)[free]
    return weft, int(orphan.sum())


def _edges(triangles: np.ndarray) -> np.ndarray:
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    return pairs.astype(np.int64)


def _flattest(normals: np.ndarray) -> np.ndarray:
    """Compute unit tangents (n, 3): the coordinate axis furthest from the normal, projected."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across = axis - np.sum(axis * normals, axis=1, keepdims=True) * normals
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def _rescue(values: np.ndarray, free: np.ndarray, gather) -> np.ndarray:
    """Replace values of nearly no length by the strongest neighbour's, until none are left or nothing helps."""
    values = values.copy()
    for _ in range(8):
        weak = free[np.abs(values[free]) < 1e-9]
        if not len(weak):
            break
        before = values.copy()
        for vertex in weak:
            row = gather.indptr[vertex], gather.indptr[vertex + 1]
            brought = gather.data[row[0] : row[1]] * before[gather.indices[row[0] : row[1]]]
            values[vertex] = brought[np.argmax(np.abs(brought))] if len(brought) else 0
    weak = free[np.abs(values[free]) < 1e-9]
    values[weak] = 1.0
    return values


FLAT = 1e-6
"""Sine of the angle below which a direction counts as parallel to the normal, relative area below which texture
coordinates of a triangle count as degenerate."""


@dataclass(frozen=True)
class TangentField:
    """Tangents of the weft."""

    weft: np.ndarray  # (v, 3) float64: unit vectors across the normals
    filled: np.ndarray  # (v,) bool: transported from the neighbours, since nothing was known there
    arbitrary: int  # vertices in parts of the surface where nothing was known at all


def from_texture(
    vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, uv: np.ndarray, *, turn: float = 0.0
) -> TangentField:
    """Compute the weft along u from texture coordinates (v, 2), u along the weft, v along the warp.

    In every triangle the surface's gradients of u and v are solved for; the weft is the direction that halves the error
    where u and v are not at right angles on the surface (cloth shears): the normalised sum of dP/du and of dP/dv turned
    back by 90 degrees. turn: radians by which the cloth is turned on the surface, from weft to warp. Triangles without
    area, on the surface or in (u, v), do not count; mirrored ones (u, v running the other way round) do.
    """
    uv = np.asarray(uv, np.float64)
    if uv.shape != (len(vertices), 2) or not np.isfinite(uv).all():
        raise UserError(f"tangent field: expected finite texture coordinates ({len(vertices)}, 2), found {uv.shape}")
    a, b, c = (np.asarray(vertices, np.float64)[triangles[:, k]] for k in range(3))
    (u1, v1), (u2, v2) = ((uv[triangles[:, k]] - uv[triangles[:, 0]]).T for k in (1, 2))
    area, flat = u1 * v2 - u2 * v1, np.cross(b - a, c - a)
    size = np.linalg.norm(flat, axis=1)
    scale = np.abs(u1 * v2) + np.abs(u2 * v1)
    known = (np.abs(area) > FLAT * scale) & (size > 0)
    safe = np.where(known, area, 1.0)[:, None]
    along_u = ((b - a) * v2[:, None] - (c - a) * v1[:, None]) / safe
    along_v = ((c - a) * u1[:, None] - (b - a) * u2[:, None]) / safe
    face = flat / np.where(size > 0, size, 1)[:, None]
    # Warp turned back by 90 degrees, the way round that (u, v) itself goes.
    back = -np.cross(face, along_v) * np.sign(safe)
    weft = unit(along_u) + unit(back)
    weft = np.where(known[:, None], unit(weft), 0.0)
    return _settle(
        vertices, triangles, normals, _gather(weft, np.where(known, size, 0), triangles, len(vertices)), turn
    )


def from_direction(
    vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, direction: np.ndarray, *, turn: float = 0.0
) -> TangentField:
    """Compute the weft along a direction (3,), or one for every vertex (v, 3), made orthogonal to the normals.

    Where the direction is parallel to the normal, zero or not finite, the weft is transported from the neighbours.
    """
    given = np.array(np.broadcast_to(np.asarray(direction, np.float64), np.shape(vertices)))
    given[~np.isfinite(given).all(axis=1)] = 0.0
    return _settle(vertices, triangles, normals, unit(given), turn)


def _settle(vertices, triangles, normals, given: np.ndarray, turn: float) -> TangentField:
    """Project directions (v, 3) of about unit length to tangents; transport them where nothing is left; rotate them."""
    normals = unit(np.asarray(normals, np.float64))
    across = given - np.sum(given * normals, axis=1, keepdims=True) * normals
    length = np.linalg.norm(across, axis=1)
    known = length > FLAT
    weft, arbitrary = unit(across), 0
    if not known.all():
        weft, arbitrary = transport_tangents(len(vertices), triangles, normals, weft, known)
    if turn:
        weft = np.cos(turn) * weft + np.sin(turn) * np.cross(normals, weft)
    return TangentField(weft, ~known, arbitrary)


def _gather(directions: np.ndarray, weights: np.ndarray, triangles: np.ndarray, count: int) -> np.ndarray:
    """Average the triangles' directions (f, 3) by weight at the vertices (count, 3); unit length or 0."""
    sums = np.zeros((count, 3))
    for axis in range(3):
        for k in range(3):
            sums[:, axis] += np.bincount(triangles[:, k], weights=weights * directions[:, axis], minlength=count)
    total = sum(np.bincount(triangles[:, k], weights=weights, minlength=count) for k in range(3))
    # Directions that cancel each other say nothing.
    return np.where((np.linalg.norm(sums, axis=1) > FLAT * total)[:, None], unit(sums), 0.0)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), 0.0)


FILE = Path(__file__).with_name("draped_cloth.npz")
STEP = 2e-6
"""Length in metres; it turns no normal of the smooth surface by more than 0.05 degrees."""


def read_drape(path: Path = FILE) -> np.ndarray:
    """Read a square of cloth draped over a ball: points (n, n, 3) in metres, [i, j] at weft i and warp j, y up.

    `benchmarks/draped_cloth.py` made the shipped file: extended position-based dynamics (Macklin et al. 2016 and
    2019) of a sheet of 250 g/m2 and 1 m over a ball of 16 cm on the floor y = 0.
    """
    with np.load(path) as stored:
        return STEP * np.cumsum(np.cumsum(stored["differences"], axis=0), axis=1)


def grid_triangles(rows: int, columns: int) -> np.ndarray:
    """Return (f, 3) int32: two triangles for each cell of a grid of points numbered row by row, first index down.

    Counter-clockwise seen from where the first index runs to the right and the second up.
    """
    number = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    # The diagonals alternate, so that a bulge has no grain.
    even = (np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0)[..., None]
    first = np.where(even, np.stack([a, b, c], axis=2), np.stack([a, b, d], axis=2))
    second = np.where(even, np.stack([a, c, d], axis=2), np.stack([b, c, d], axis=2))
    return np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])


def sheet(points: np.ndarray, *, side: int | None = None) -> tuple[Surface, np.ndarray]:
    """Make a surface of a grid of points (n, n, 3), [i, j] at weft i and warp j.

    The bicubic spline through them, at `side` points a side; and its texture coordinates (v, 2), 0 to 1.

    Normals are the spline's own, so that highlights run smoothly over the triangles; the weft halves the angle by which
    the yarns depart from a right one.
    """
    from scipy.interpolate import RectBivariateSpline

    n = len(points)
    side = side or (3 * n - 1) // 2
    at, to = np.linspace(0, 1, n), np.linspace(0, 1, side)
    splines = [RectBivariateSpline(at, at, points[..., k]) for k in range(3)]
    place, along, across = (
        np.stack([spline(to, to, dx=d[0], dy=d[1]) for spline in splines], axis=2).reshape(-1, 3)
        for d in ((0, 0), (1, 0), (0, 1))
    )
    normal = np.cross(along, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    weft = unit(along) + np.cross(unit(across), normal)
    weft = unit(weft - np.sum(weft * normal, axis=1, keepdims=True) * normal)
    mesh = Mesh(np.ascontiguousarray(place), grid_triangles(side, side), normal.astype(np.float32))
    u, v = np.meshgrid(to, to, indexing="ij")
    return Surface(mesh, weft), np.column_stack([u.ravel(), v.ravel()])


def cylinder(radius: float, height: float, *, centre=(0.0, 0.0, 0.0), turn: float = 0.0) -> Surface:
    """Make an upright tube of cloth, its weft around, its warp upwards; turn: radians from weft to warp."""
    angle, rise = np.linspace(0, 2 * np.pi, 193), np.linspace(-0.5, 0.5, 33)
    a, y = np.meshgrid(angle, rise, indexing="ij")
    across = np.stack([np.sin(a), np.zeros_like(a), np.cos(a)], axis=2).reshape(-1, 3)
    place = radius * across + np.stack([0 * y, height * y, 0 * y], axis=2).reshape(-1, 3) + np.asarray(centre, float)
    mesh = Mesh(place, grid_triangles(193, 33), across.astype(np.float32))
    uv = np.column_stack([radius * a.ravel(), height * y.ravel()])
    field = from_texture(mesh.vertices, mesh.triangles, mesh.normals, uv, turn=turn)
    return Surface(mesh, field.weft)


def swatch(width: float, height: float, *, centre=(0.0, 0.0, 0.0), turn: float = 0.0) -> Surface:
    """Make a flat rectangle that faces z, weft to the right."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9) * width, np.linspace(-0.5, 0.5, 9) * height, indexing="ij")
    place = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3) + np.asarray(centre, float)
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(place), 1))
    weft = np.tile([np.cos(turn), np.sin(turn), 0.0], (len(place), 1))
    return Surface(Mesh(place, grid_triangles(9, 9), normals), weft)


def paper(width: float, depth: float, height: float, bend: float, *, turn: float = 0.0) -> Surface:
    """Make a studio's seamless paper: a floor y = 0 that reaches `depth` back and front, bent up into a wall behind.

    bend: radius of the bend. turn: azimuth of the camera about the vertical, so that the wall stands behind the scene.
    """
    front = np.concatenate([np.linspace(3 * depth, depth, 5)[:-1], np.linspace(depth, -depth + bend, 70)])
    arc = np.linspace(0, np.pi / 2, 24)[1:]
    z = np.concatenate([front, -depth + bend - bend * np.sin(arc), np.full(6, -depth)])
    y = np.concatenate([np.zeros(len(front)), bend - bend * np.cos(arc), np.linspace(bend, height, 7)[1:]])
    inner = np.linspace(-depth, depth, 72)
    x = np.concatenate([np.linspace(-width, -depth, 6)[:-1], inner, np.linspace(depth, width, 6)[1:]])
    across = np.broadcast_to(x[:, None], (len(x), len(z)))
    place = np.stack([across, np.broadcast_to(y, across.shape), np.broadcast_to(z, across.shape)], axis=2)
    c, s = np.cos(turn), np.sin(turn)
    place = place.reshape(-1, 3) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    mesh = Mesh.of(place, grid_triangles(len(x), len(z)))
    return Surface(mesh, np.tile([c, 0.0, -s], (len(place), 1)), material=1)


@dataclass(frozen=True)
class FileSurface:
    """mesh; uv (v, 2) float64 or None; sha256 of the file."""

    mesh: Mesh
    uv: np.ndarray | None
    sha256: str


def read_surface(path: Path, *, sha256: str = "", smooth: bool = True) -> FileSurface:
    """Read a PLY or OBJ file. smooth: normals averaged over the triangles of a vertex; otherwise each triangle its own.

    UserError where it is no surface (see `geometry.mesh_files.read_triangles`) or not the file with this digest.
    """
    path = Path(path)
    vertices, triangles = read_triangles(path)
    digest = file_digest(path)
    if sha256 and digest != sha256:
        raise UserError(f"{path}: expected the file with SHA-256 {sha256}, found {digest}. Remedy: correct mesh.sha256")
    uv = _texture(path, len(vertices))
    if not smooth:
        vertices, uv = vertices[triangles.reshape(-1)], None if uv is None else uv[triangles.reshape(-1)]
        triangles = np.arange(len(vertices)).reshape(-1, 3)
    return FileSurface(Mesh.of(vertices, triangles), uv, digest)


def _texture(path: Path, count: int) -> np.ndarray | None:
    """Return texture coordinates (count, 2), one pair a vertex as the reader splits them at seams, or None."""
    trimesh = optional("trimesh")

    with open(path, "rb") as stream:
        loaded = load_geometry(stream, path.suffix.lower().lstrip("."))
    parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    known = [getattr(getattr(part, "visual", None), "uv", None) for part in parts]
    if any(uv is None for uv in known):
        return None
    uv = np.concatenate([np.asarray(uv, np.float64) for uv in known])
    return uv if uv.shape == (count, 2) and np.isfinite(uv).all() else None
