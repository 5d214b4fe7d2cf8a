"""Surfaces to be covered with cloth: the shipped drape, squares and cylinders, meshes from files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.artifacts.provenance import file_digest
from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.mesh_files import load_geometry, read_triangles
from nishiki.packages import optional
from nishiki.render.cloth.scene import Surface
from nishiki.render.cloth.tangent import from_texture, unit

FILE = Path(__file__).with_name("draped_cloth.npz")
STEP = 2e-6
"""Metres; it turns no normal of the smooth surface by more than 0.05 degrees."""


def write_drape(path: Path, points: np.ndarray) -> None:
    """Write a grid of points (n, n, 3), metres, as whole steps of 2 micrometres.

    Differences of differences along both axes are small, so that they compress to half of what single precision takes.
    """
    steps = np.round(points / STEP).astype(np.int32)
    differences = np.diff(np.diff(steps, axis=0, prepend=0), axis=1, prepend=0)
    np.savez_compressed(path, differences=differences)


def read_drape(path: Path = FILE) -> np.ndarray:
    """Read a square of cloth that fell over a ball: points (n, n, 3) in metres, [i, j] at weft i and warp j, y up.

    `tests/benchmarks/draped_cloth.py` made the shipped file: extended position-based dynamics (Macklin et al. 2016 and
    2019) of a sheet of 250 g/m2 and 1 m over a ball of 16 cm on the floor y = 0.
    """
    with np.load(path) as stored:
        return STEP * np.cumsum(np.cumsum(stored["differences"], axis=0), axis=1)


def grid_triangles(rows: int, columns: int) -> np.ndarray:
    """(f, 3) int32: two triangles for each cell of a grid of points numbered row by row, first index down.

    Counter-clockwise seen from where the first index runs to the right and the second up.
    """
    number = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    # The diagonals alternate, so that a bulge has no grain.
    even = (np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0)[..., None]
    first = np.where(even, np.stack([a, b, c], axis=2), np.stack([a, b, d], axis=2))
    second = np.where(even, np.stack([a, c, d], axis=2), np.stack([b, c, d], axis=2))
    return np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])


def sheet(points: np.ndarray, *, side: int | None = None, material: int = 0) -> tuple[Surface, np.ndarray]:
    """A grid of points (n, n, 3), [i, j] at weft i and warp j, as surface: the bicubic spline through them, at `side`
    points a side; and its texture coordinates (v, 2), 0 to 1.

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
    return Surface(mesh, weft, material), np.column_stack([u.ravel(), v.ravel()])


def cylinder(
    radius: float, height: float, *, centre=(0.0, 0.0, 0.0), turn: float = 0.0, sectors: int = 192, material: int = 0
) -> Surface:
    """An upright tube of cloth, its weft around, its warp upwards; turn: radians from weft to warp."""
    angle, rise = np.linspace(0, 2 * np.pi, sectors + 1), np.linspace(-0.5, 0.5, 33)
    a, y = np.meshgrid(angle, rise, indexing="ij")
    across = np.stack([np.sin(a), np.zeros_like(a), np.cos(a)], axis=2).reshape(-1, 3)
    place = radius * across + np.stack([0 * y, height * y, 0 * y], axis=2).reshape(-1, 3) + np.asarray(centre, float)
    mesh = Mesh(place, grid_triangles(sectors + 1, 33), across.astype(np.float32))
    uv = np.column_stack([radius * a.ravel(), height * y.ravel()])
    field = from_texture(mesh.vertices, mesh.triangles, mesh.normals, uv, turn=turn)
    return Surface(mesh, field.weft, material)


def swatch(width: float, height: float, *, centre=(0.0, 0.0, 0.0), turn: float = 0.0, material: int = 0) -> Surface:
    """A flat rectangle that faces z, weft to the right."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9) * width, np.linspace(-0.5, 0.5, 9) * height, indexing="ij")
    place = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3) + np.asarray(centre, float)
    normals = np.tile(np.float32([0, 0, 1]), (len(place), 1))
    weft = np.tile([np.cos(turn), np.sin(turn), 0.0], (len(place), 1))
    return Surface(Mesh(place, grid_triangles(9, 9), normals), weft, material)


def paper(width: float, depth: float, height: float, bend: float, *, turn: float = 0.0, material: int = 1) -> Surface:
    """A studio's seamless paper: a floor y = 0 that reaches `depth` back and front, bent up into a wall behind.

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
    return Surface(mesh, np.tile([c, 0.0, -s], (len(place), 1)), material)


@dataclass(frozen=True)
class FileSurface:
    """mesh; uv (v, 2) float64 or None; sha256 of the file."""

    mesh: Mesh
    uv: np.ndarray | None
    sha256: str


def read_surface(path: Path, *, sha256: str = "", smooth: bool = True) -> FileSurface:
    """A PLY or OBJ file. smooth: normals averaged over the triangles of a vertex; otherwise each triangle its own.

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
    """Texture coordinates (count, 2), one pair a vertex as the reader splits them at seams, or None."""
    trimesh = optional("trimesh")

    with open(path, "rb") as stream:
        loaded = load_geometry(stream, path.suffix.lower().lstrip("."))
    parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    known = [getattr(getattr(part, "visual", None), "uv", None) for part in parts]
    if any(uv is None for uv in known):
        return None
    uv = np.concatenate([np.asarray(uv, np.float64) for uv in known])
    return uv if uv.shape == (count, 2) and np.isfinite(uv).all() else None
