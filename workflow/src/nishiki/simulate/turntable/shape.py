"""Define the shape of the simulated object as a distance field, and mesh it evenly.

Lengths in mm; the axis of the turntable is the y axis (upwards), the jar stands on y = 0.
"""

from dataclasses import dataclass, field

import numpy as np

from nishiki.installation import optional
from nishiki.simulate.capture import CameraSettings, check_ranges, declare_range
from nishiki.threads import strips

PARTS = ("body", "lid", "rope", "handles", "fruit", "animal")
BODY, LID, ROPE, HANDLES, FRUIT, ANIMAL = range(6)
LOW = (-104.0, -4.0, -82.0)
HIGH = (104.0, 188.0, 90.0)
FLUTES = 14  # around the jar


def smooth_union(a, b, k):
    """Compute the minimum of two distances, rounded where they differ by less than k (quadratic blend)."""
    h = np.maximum(k - abs(a - b), 0.0) / k
    return np.minimum(a, b) - 0.25 * h * h * k


def _ball(x, y, z, centre, radii):
    """Approximate the distance from an ellipsoid."""
    (cx, cy, cz), (rx, ry, rz) = centre, radii
    u, v, w = (x - cx) / rx, (y - cy) / ry, (z - cz) / rz
    k = np.sqrt(u * u + v * v + w * w)
    g = np.sqrt((u / rx) ** 2 + (v / ry) ** 2 + (w / rz) ** 2)
    return np.where(g > 1e-9, k * (k - 1.0) / np.maximum(g, 1e-9), -min(radii))


def _limb(x, y, z, a, b, thick_a, thick_b):
    """Compute the distance from a rod with round ends whose thickness changes from a to b."""
    (ax, ay, az), (bx, by, bz) = a, b
    dx, dy, dz = bx - ax, by - ay, bz - az
    t = ((x - ax) * dx + (y - ay) * dy + (z - az) * dz) / (dx * dx + dy * dy + dz * dz)
    t = np.clip(t, 0.0, 1.0)
    px, py, pz = x - ax - t * dx, y - ay - t * dy, z - az - t * dz
    return np.sqrt(px * px + py * py + pz * pz) - (thick_a + t * (thick_b - thick_a))


def _body(x, y, z, r, turn):
    latitude = np.arctan2(y - 58.0, r)
    flute = np.cos(FLUTES * turn)
    window = np.exp(-(((latitude - 0.15) / 0.55) ** 4))
    wide = 71.0 * (1.0 + 0.022 * window * flute)
    # Carved petals rise from the foot: pointed arches, each over two flutes.
    arch = abs(np.sin(0.5 * FLUTES * turn))
    petal = np.clip((-0.30 - 0.42 * (1.0 - arch) - latitude) / 0.10, 0.0, 1.0)
    wide = wide + 1.6 * petal * petal * (3.0 - 2.0 * petal)
    u, v = r / wide, (y - 58.0) / 57.0
    k = (abs(u) ** 2.3 + abs(v) ** 2.3) ** (1.0 / 2.3)
    body = (k - 1.0) * 58.0
    wall = np.maximum(r - 40.0, abs(y - 106.0) - 13.0)
    rim = np.sqrt((r - 40.5) ** 2 + (y - 118.5) ** 2) - 4.2
    body = smooth_union(smooth_union(body, wall, 9.0), rim, 3.0)
    foot = np.maximum(abs(r - 40.0) - 5.0, abs(y - 3.0) - 5.0)
    body = smooth_union(body, foot, 4.0)
    inside = np.sqrt(r * r / 1600.0 + (y + 2.0) ** 2 / 49.0) - 1.0  # hollow under the foot
    return np.maximum(np.maximum(body, -y), -7.0 * inside)


def _animal(x, y, z):
    side = abs(x)
    d = _ball(x, y, z, (0.0, 147.0, -3.0), (13.0, 12.0, 19.0))
    d = smooth_union(d, _ball(side, y, z, (8.5, 142.0, -10.0), (7.0, 9.5, 10.0)), 3.0)
    d = smooth_union(d, _limb(side, y, z, (6.5, 148.0, 9.0), (7.0, 135.0, 14.0), 5.0, 3.8), 3.0)
    d = smooth_union(d, _ball(x, y, z, (0.0, 160.0, 13.0), (9.5, 9.0, 10.5)), 4.0)
    d = smooth_union(d, _ball(x, y, z, (0.0, 156.5, 21.5), (5.0, 4.2, 4.5)), 2.5)
    d = smooth_union(d, _limb(side, y, z, (4.0, 165.0, 10.0), (7.0, 181.0, 1.0), 3.4, 2.2), 2.0)
    return smooth_union(d, _ball(x, y, z, (0.0, 149.0, -22.0), (5.0, 5.0, 4.5)), 2.0)


def part_distances(points: np.ndarray) -> np.ndarray:
    """Approximate signed distances (mm, negative inside) of points (3, ...) from the parts, (6, ...) as in `PARTS`."""
    x, y, z = points
    r, turn = np.hypot(x, z), np.arctan2(z, x)
    dome = _ball(x, y, z, (0.0, 118.0, 0.0), (35.0, 18.0, 35.0))
    step = np.maximum(r - 19.0, abs(y - 134.0) - 3.0)
    lid = smooth_union(np.maximum(dome, 112.0 - y), step, 2.0)
    ring, lift = r - 45.0, y - 105.0
    twist = np.cos(2.0 * np.arctan2(lift, ring) + 40.0 * turn)
    rope = 0.8 * (np.hypot(ring, lift) - 4.6 - 0.8 * twist)
    across, rise = abs(x) - 74.0, y - 78.0
    thick = 5.4 + 0.7 * np.cos(4.0 * np.arctan2(rise, across))
    handles = np.hypot(np.hypot(across, rise) - 18.5, z) - thick
    fruit = _ball(x, y, z, (0.0, 93.0, 60.0), (12.0, 11.0, 12.0))
    fruit = np.minimum(fruit, _ball(x, y, z, (17.0, 84.0, 62.0), (10.0, 9.5, 10.0)))
    fruit = np.minimum(fruit, _ball(x, y, z, (-15.5, 81.0, 64.0), (9.5, 9.0, 9.5)))
    fruit = smooth_union(fruit, _limb(x, y, z, (-24.0, 96.0, 52.0), (22.0, 100.0, 50.0), 2.6, 2.0), 2.0)
    return np.stack([_body(x, y, z, r, turn), lid, rope, handles, fruit, _animal(x, y, z)])


def distance(points: np.ndarray) -> np.ndarray:
    """Compute the signed distance (approximate; exact in sign) of points (3, ...) from the whole object."""
    parts = part_distances(points)
    d = smooth_union(parts[BODY], parts[HANDLES], 5.0)
    d = smooth_union(d, parts[ROPE], 1.5)
    d = smooth_union(d, parts[FRUIT], 2.0)
    return np.minimum(d, smooth_union(parts[LID], parts[ANIMAL], 2.0))


def gradient(points: np.ndarray, step: float) -> np.ndarray:
    """Compute the gradient (3, n) of `distance` at points (3, n) by central differences over 2 step mm."""
    steps = step * np.eye(3)[:, :, None]
    return np.stack([distance(points + along) - distance(points - along) for along in steps]) * 0.5 / step


def settle(points: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Move points (3, n) onto the surface along the gradient; return them and unit normals."""
    for _ in range(rounds):
        slope = gradient(points, 0.05)
        points = points - np.clip(distance(points), -1.0, 1.0) / np.maximum((slope**2).sum(axis=0), 0.04) * slope
    slope = gradient(points, 0.15)
    return points, slope / np.maximum(np.linalg.norm(slope, axis=0), 1e-12)


_COARSE_MM = 5.0
_CREASE = 0.9  # cosine between the gradient and the mean normal of the triangles


@dataclass(frozen=True)
class SimulatedSurface:
    """The simulated surface."""

    vertices: np.ndarray  # (v, 3) float64 mm
    triangles: np.ndarray  # (f, 3) int32, counter-clockwise seen from outside
    normals: np.ndarray  # (v, 3) float64, unit, of the smooth surface
    parts: np.ndarray  # (v, parts) float64, distances from the parts, which decide the material


def make_surface(triangles: int) -> SimulatedSurface:
    """Make the object with about this number of triangles (within some 5 %)."""
    # The number of triangles grows with 1/spacing²; two coarser rounds tell the factor well enough.
    spacing = _COARSE_MM
    for _ in range(2):
        count = len(_march(spacing)[1])
        spacing = min(spacing * (count / triangles) ** 0.5, 8.0)
        if count > triangles / 6:
            break
    vertices, faces = _march(spacing)
    surface = _settle(vertices, faces)
    for _ in range(4):
        surface = _settle(_relax(surface), faces)
    # triangles of hardly any area go, and vertices that no triangle uses
    a, b, c = (surface.vertices[surface.triangles[:, corner]] for corner in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    faces = surface.triangles[area > 1e-9 * spacing * spacing]
    used, faces = np.unique(faces, return_inverse=True)
    return SimulatedSurface(
        surface.vertices[used],
        np.ascontiguousarray(faces.reshape(-1, 3), np.int32),
        surface.normals[used],
        surface.parts[used],
    )


def scan(surface: SimulatedSurface, *, noise_mm: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (v, 3) and triangles as a scanner would deliver them: vertices off along the normal."""
    from nishiki.simulate.randomness import subkey

    random = np.random.default_rng(subkey(seed, "turntable scan"))
    offset = noise_mm * random.standard_normal(len(surface.vertices))
    return surface.vertices + offset[:, None] * surface.normals, surface.triangles


def _march(spacing: float) -> tuple[np.ndarray, np.ndarray]:
    optional("scikit-image")
    from skimage.measure import marching_cubes

    shape = [int(np.ceil((high - low) / spacing)) + 1 for low, high in zip(LOW, HIGH, strict=True)]
    x, y, z = (low + spacing * np.arange(size) for low, size in zip(LOW, shape, strict=True))
    field = np.stack([distance(np.stack(np.meshgrid(a, y, z, indexing="ij"))[:, 0]) for a in x]).astype(np.float32)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(spacing,) * 3, allow_degenerate=False)
    vertices = vertices.astype(np.float64) + LOW
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:  # six times the volume
        faces = faces[:, ::-1]
    return vertices, np.ascontiguousarray(faces, np.int32)


def _settle(vertices: np.ndarray, faces: np.ndarray) -> SimulatedSurface:
    points, normals, parts = np.empty_like(vertices), np.empty_like(vertices), np.empty((len(vertices), len(PARTS)))
    for some in strips(len(points)):
        place, slope = settle(vertices[some].T, 3)
        points[some], normals[some], parts[some] = place.T, slope.T, part_distances(place).T
    # Where two parts meet in a crease the gradient is that of one of them only: there use the triangles'.
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    sums = np.zeros_like(points)
    for corner in range(3):
        for axis in range(3):
            sums[:, axis] += np.bincount(faces[:, corner], cross[:, axis], len(points))
    mean = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)
    crease = np.einsum("ij,ij->i", mean, normals) < _CREASE
    normals[crease] = mean[crease]
    return SimulatedSurface(points, faces, normals, parts)


def _relax(surface: SimulatedSurface) -> np.ndarray:
    """Move vertices half way to the mean of their neighbours, along the surface only: evens out the triangles."""
    count = len(surface.vertices)
    ends = np.concatenate([surface.triangles[:, [a, b]] for a in range(3) for b in range(3) if a != b])
    degree = np.bincount(ends[:, 0], minlength=count)
    mean = (
        np.column_stack([np.bincount(ends[:, 0], surface.vertices[ends[:, 1], axis], count) for axis in range(3)])
        / np.maximum(degree, 1)[:, None]
    )
    move = 0.5 * (mean - surface.vertices)
    return surface.vertices + move - np.einsum("ij,ij->i", move, surface.normals)[:, None] * surface.normals


DISTANCE_MM = 1200.0  # from the camera to the axis
ELEVATION_DEG = 20.0  # the camera looks down on the object
LAMP_MM = (52.0, 44.0, 6.0)  # in the camera's frame: x right, y up, z backwards
LAMP_RADIUS_MM = 14.0
BLUR_PIXELS = 0.7  # standard deviation of the lens's point spread
BETA = (0.395, 0.412, 0.371)  # white board with the second polariser over that without
LEAK = (0.008, 0.010, 0.013)  # share of the mirror reflection that the crossed polariser lets through
WHITE_RATIO = (0.86, 1.0, 0.78)  # what a white gives in each channel, the largest = 1
STRAY = 0.0015  # light scattered inside the lens, of a white's
CLOTH = 0.004  # the black cloth behind the object, of a white's
AIM_MM = (0.0, 86.0, 0.0)  # the point of the axis that the camera looks at
_WIDTH_MM, _HEIGHT_MM = 204.0, 200.0  # what the picture must hold, at the axis
LEAST_TRIANGLES = 3500  # with fewer, thin parts fall apart
MOST_TRIANGLES = 5_000_000  # of the object and of its scan


@dataclass(frozen=True)
class TurntableSettings:
    """Everything that decides the bytes of a simulated turntable capture.

    rows, columns : camera pixels. views : over a full turn. triangles : about how many the object has. samples : points
    a pixel in each direction. directions : rays a vertex into its hemisphere, for light from other parts of the object.
    bounces : 0 to 4. polariser : True for two pictures a view. scan_triangles : about how many the mesh in the capture
    has, None = the object's own. scan_noise_mm : standard deviation of its vertices along the normal.
    """

    rows: int = declare_range(16, 20000, 384)
    columns: int = declare_range(16, 20000, 384)
    views: int = declare_range(2, 3600, 36)
    seed: int = declare_range(0, 2**53, 1)
    triangles: int = declare_range(LEAST_TRIANGLES, MOST_TRIANGLES, 30000)
    samples: int = declare_range(1, 8, 4)
    directions: int = declare_range(16, 4096, 256)
    bounces: int = declare_range(0, 4, 2)
    polariser: bool = True
    scan_triangles: int | None = None
    scan_noise_mm: float = declare_range(0.0, 5.0, 0.02)
    white_boards: int = 8
    camera: CameraSettings = field(
        default_factory=lambda: CameraSettings(full_well=40000.0, read_noise=6.0, white_level=0.5)
    )

    def __post_init__(self):
        check_ranges(
            self,
            ("scan_triangles", self.scan_triangles or LEAST_TRIANGLES, LEAST_TRIANGLES, MOST_TRIANGLES),
            ("channels", self.camera.channels, 3, 3),
        )


PRESETS = {
    "object": {},
    "object-tiny": {
        "rows": 96,
        "columns": 96,
        "views": 12,
        "triangles": 4000,
        "samples": 3,
        "directions": 64,
        "white_boards": 2,
    },
    "object-large": {"rows": 3000, "columns": 4000, "triangles": 250_000, "samples": 2, "directions": 96},
}


@dataclass(frozen=True)
class SimulatedView:
    """One view."""

    name: str
    rotation: np.ndarray  # (3, 3): object to camera (x right, y down, z into the scene)
    centre: np.ndarray  # (3,): the camera, mm
    lamp: np.ndarray  # (3,): the lamp's centre, mm, object's frame
    focal: float  # pixels
    principal: tuple[float, float]  # column, row of the optical axis

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4) projection: homogeneous (column, row) of object points; the top left pixel's centre is (0, 0)."""
        k = np.array([[self.focal, 0.0, self.principal[0]], [0.0, self.focal, self.principal[1]], [0.0, 0.0, 1.0]])
        return k @ np.column_stack([self.rotation, -self.rotation @ self.centre])


def place_views(settings: TurntableSettings) -> tuple[SimulatedView, ...]:
    """List the views in the order of the turn: each turns the object by 360°/views, anticlockwise from above."""
    focal = DISTANCE_MM * min(settings.columns / _WIDTH_MM, settings.rows / _HEIGHT_MM)
    principal = (0.5 * settings.columns - 0.5 + 1.7, 0.5 * settings.rows - 0.5 - 0.9)
    elevation = np.radians(ELEVATION_DEG)
    views = []
    for index in range(settings.views):
        turn = -2.0 * np.pi * index / settings.views
        back = np.array(
            [np.cos(elevation) * np.sin(turn), np.sin(elevation), np.cos(elevation) * np.cos(turn)]
        )  # from the object to the camera
        right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        up = np.cross(back, right)
        centre = np.array(AIM_MM) + DISTANCE_MM * back
        lamp = centre + LAMP_MM[0] * right + LAMP_MM[1] * up + LAMP_MM[2] * back
        views.append(SimulatedView(f"{index:03d}", np.stack([right, -up, -back]), centre, lamp, focal, principal))
    return tuple(views)
