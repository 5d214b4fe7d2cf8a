"""Pack a renderer's inputs beside the residual in few bytes: mesh, cameras, charts, lamps; and count all bytes.

Draco (https://google.github.io/draco; glTF's KHR_draco_mesh_compression)
walks over the surface from edge to edge and predicts each position from its neighbours, so that vertices and triangles
come back in the order of that walk; normals as small tilts against those of the triangles.
"""

import lzma
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.geometry.camera import NO_DISTORTION, Camera
from nishiki.geometry.mesh import Mesh, measure_tilts, tilt_normals

_HEADER = struct.Struct("<i3iI")  # exponent of the grid's step, lowest corner in steps, bytes of the tilts
_PACKED: dict = {"format": lzma.FORMAT_RAW, "filters": [{"id": lzma.FILTER_LZMA2, "preset": 9}]}
_LEVELS = (7, 10)  # of Draco's effort: the first gives fewer bytes below some thousand triangles, the second above
GRID_PX = 0.05  # by which a grid may move a vertex
_LARGEST = 2**29  # steps along an axis; Draco predicts in 32-bit integers


@dataclass(frozen=True)
class CompactMesh:
    """A coded mesh."""

    data: bytes
    order: np.ndarray  # (n,) int64: number of each decoded triangle in the mesh that was coded; step of the grid
    step: float

    def restore(self, mesh: Mesh) -> Mesh:
        """Return the decoded positions and normals in the order of `mesh`, in which vertices may lie on one place."""
        return tilt_normals(np.round(mesh.vertices / self.step) * self.step, mesh.triangles, measure_tilts(mesh))


def encode_mesh(mesh: Mesh, *, step: float) -> CompactMesh:
    """Code a mesh: positions rounded to multiples of `step` (a power of two), triangles without loss.

    Triangles with two corners on one point of the grid are dropped. The unit is the world's.

    Raises ValueError where the step is no power of two, or too small for the size of the mesh.
    """
    import DracoPy

    exponent = int(np.log2(step))
    if 2.0**exponent != step:
        raise ValueError(f"expected a step that is a power of two, found {step!r}")
    grid = np.round(np.asarray(mesh.vertices, np.float64) / step)
    corners = grid[mesh.triangles]
    kept = np.flatnonzero(~(corners == np.roll(corners, 1, axis=1)).all(axis=2).any(axis=1))
    used, triangles = np.unique(mesh.triangles[kept], return_inverse=True)
    triangles = triangles.reshape(-1, 3).astype(np.uint32)
    lowest = grid[used].min(axis=0)
    points = grid[used] - lowest
    if points.max() >= _LARGEST or np.abs(lowest).max() >= 2**31:
        raise ValueError(f"step {step!r} is too small for positions up to {np.abs(mesh.vertices[used]).max()!r}")
    forms = [DracoPy.encode(points.astype(np.uint32), triangles, compression_level=level) for level in _LEVELS]
    form = min(forms, key=len)
    decoded = DracoPy.decode(form)
    order, vertex_of = _same_triangles(points, triangles, np.asarray(decoded.points), np.asarray(decoded.faces))
    tilts = lzma.compress(measure_tilts(mesh)[used[vertex_of]].T.tobytes(), **_PACKED)
    header = _HEADER.pack(exponent, *lowest.astype(int).tolist(), len(tilts))
    return CompactMesh(header + tilts + form, kept[order], step)


def decode_mesh(data: bytes) -> Mesh:
    """Decode the bytes of `encode_mesh`. Raises ValueError where they are not such bytes or are cut short."""
    import DracoPy

    try:
        exponent, *lowest, size = _HEADER.unpack_from(data)
        tilts, form = np.split(np.frombuffer(data, np.uint8, offset=_HEADER.size), [size])
        decoded = DracoPy.decode(form.tobytes())
        steps = np.frombuffer(lzma.decompress(tilts.tobytes(), **_PACKED), np.int8).reshape(2, -1).T
    except Exception as error:  # Draco has errors of its own
        raise ValueError(f"not a compact mesh ({error})") from None
    points = np.asarray(decoded.points).astype(np.int64)
    vertices = (points + np.array(lowest)) * 2.0**exponent
    return tilt_normals(vertices, np.asarray(decoded.faces).astype(np.int32), steps)


def _same_triangles(points, triangles, decoded_points, decoded_triangles) -> tuple[np.ndarray, np.ndarray]:
    """Find for each decoded triangle the number (f,) of that with the same three points in the same turn.

    Second, for each decoded vertex the number (v,) of its own before.
    """
    _, places = np.unique(np.concatenate([points, decoded_points]), axis=0, return_inverse=True)
    places = places.reshape(-1)
    ranks, rolled = [], []
    for numbers, corners in (
        (triangles, places[triangles]),
        (decoded_triangles, places[len(points) :][decoded_triangles]),
    ):
        turned = (corners.argmin(axis=1)[:, None] + np.arange(3)) % 3
        ranks.append(np.lexsort(np.take_along_axis(corners, turned, axis=1).T))
        rolled.append(np.take_along_axis(numbers, turned, axis=1))
    order, vertex_of = np.empty(len(ranks[0]), np.int64), np.empty(len(decoded_points), np.int64)
    order[ranks[1]] = ranks[0]
    vertex_of[rolled[1]] = rolled[0][order]
    return order, vertex_of


def grid_step(mesh: Mesh, cameras: list[Camera], *, shift_px: float = GRID_PX) -> float:
    """Find the largest power of two (world's unit) whose grid moves no vertex by more than `shift_px` in any view."""
    used = np.unique(mesh.triangles)
    points = np.asarray(mesh.vertices, np.float64)[used]
    if not len(points):
        return 1.0
    extent = float(np.ptp(points, axis=0).max()) or 1.0
    step = 2.0 ** np.floor(np.log2(extent / 64))
    while shift(points, np.round(points / step) * step, cameras) > shift_px and step > extent * 2.0**-30:
        step *= 0.5
    return float(step)


def shift(points: np.ndarray, moved: np.ndarray, cameras: list[Camera]) -> float:
    """Measure the largest distance in pixels of points (n, 3) before a camera to their copies, over all cameras."""
    worst = 0.0
    for camera in cameras:
        (before, depth), (after, depth_after) = camera.project(points), camera.project(moved)
        front = (depth > 0) & (depth_after > 0)
        if front.any():
            worst = max(worst, float(np.linalg.norm(after[front] - before[front], axis=1).max()))
    return worst


def mesh_step(mesh: Mesh, cameras: list[Camera]) -> float:
    """Return the grid step of a mesh's vertices where it is at most 16 times finer than needed, else `grid_step`."""
    needed = grid_step(mesh, cameras)
    points = np.asarray(mesh.vertices, np.float64)[np.unique(mesh.triangles)]
    for halvings in range(-10, 5):
        step = needed * 0.5**halvings
        if np.array_equal(np.round(points / step) * step, points):
            return step
    return needed


_CHART_NUMBERS = 2  # texels per unit along rows and columns


def camera_bytes(cameras: Sequence[Camera]) -> int:
    """Count rows, columns and the number of numbers, and 4 bytes for each number of a camera.

    They are fx, skew, fy, cx, cy, rotation vector, translation, and distortion where any has one.
    """
    distorted = any(tuple(camera.distortion) != NO_DISTORTION for camera in cameras)
    return 4 * (3 + len(cameras) * (11 + len(NO_DISTORTION) * distorted))


def chart_bytes(chart: np.ndarray, order: np.ndarray) -> int:
    """Count the bytes of the atlas: chart numbers (f,) in the order (f,) of the mesh's walk, and each chart's own."""
    charts = int(chart.max(initial=-1)) + 1
    along = chart[order].astype(np.min_scalar_type(charts)).tobytes()
    return len(lzma.compress(along, **_PACKED)) + 4 * _CHART_NUMBERS * charts


def lamp_bytes(lighting: dict) -> int:
    """Count 4 bytes for each number of `Lighting.as_dict`."""

    def numbers(value) -> int:
        if isinstance(value, dict):
            return sum(map(numbers, value.values()))
        if isinstance(value, list | tuple):
            return sum(map(numbers, value))
        return int(isinstance(value, int | float))

    return 4 * numbers(lighting)


@dataclass(frozen=True)
class MeshCoding:
    """Bytes by part; mesh: as it was coded; vertex_shift_px: the largest shift of a vertex by that coding."""

    parts: dict[str, int]
    mesh: CompactMesh
    vertex_shift_px: float

    @property
    def total(self) -> int:
        """All bytes."""
        return sum(self.parts.values())


def cost_of(mesh: Mesh, chart: np.ndarray, cameras: list, lighting: dict, residual: dict[str, int]) -> MeshCoding:
    """Count the bytes of all parts of a coded object.

    chart (f,): of the atlas; lighting: as plain data; residual: its bytes by part, parameters included (a "total" among
    them is left out).
    """
    coded = encode_mesh(mesh, step=mesh_step(mesh, cameras))
    used = np.unique(mesh.triangles)
    moved = shift(mesh.vertices[used], coded.restore(mesh).vertices[used], cameras)
    parts = {f"residual_{name}": int(size) for name, size in residual.items() if name != "total"}
    parts |= {
        "mesh": len(coded.data),
        "charts": chart_bytes(chart, coded.order),
        "cameras": camera_bytes(cameras),
        "lamps": lamp_bytes(lighting),
    }
    return MeshCoding(parts, coded, moved)
