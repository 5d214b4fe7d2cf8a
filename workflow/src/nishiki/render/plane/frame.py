"""Render one picture of a plane scene: samples of the maps, cast shadows, shading, and the mean over each pixel.

Ray casting to a rectangle in space is a homography, for a pinhole camera as for the frontal view: one 3 x 3 matrix
takes (column, row, 1) of the screen to the plane, another takes the plane to the maps. The relief moves no pixel
sideways (no parallax) and hides nothing from an oblique eye; it acts through the normals and through cast shadows.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.artifacts.maps import shrink
from nishiki.errors import require
from nishiki.render.plane import shade
from nishiki.render.plane.kernel import BACKGROUND, TURNED_AWAY, UNUSABLE
from nishiki.render.plane.scene import Ambient, Light, PlaneScene, View


def screen_to_plane(view: View, scene: PlaneScene) -> np.ndarray:
    """Compute (3, 3): (column, row, 1) of the screen to (x, y, 1) w on the plane z = 0; w > 0 for hits in front.

    Without an eye the painting is fitted into the screen, square pixels, centred.
    """
    rows, columns = screen_shape(view, scene)
    if view.eye_mm is None:
        step = scene.pitch * max(scene.shape[0] / rows, scene.shape[1] / columns)
        return np.array([[step, 0, -step * (columns - 1) / 2], [0, -step, step * (rows - 1) / 2], [0, 0, 1.0]])
    eye, camera = np.asarray(view.eye_mm, np.float64), view.camera()
    ray = camera.rotation.T @ np.linalg.inv(camera.intrinsics)  # directions of rays, linear in (column, row, 1)
    # eye + t ray meets z = 0 at t = -eye_z / ray_z: multiply by -ray_z, which is positive where t is
    return np.stack([eye[2] * ray[0] - eye[0] * ray[2], eye[2] * ray[1] - eye[1] * ray[2], -ray[2]])


def screen_shape(view: View, scene: PlaneScene) -> tuple[int, int]:
    """Return (rows, columns) of the picture."""
    return scene.shape if view.rows is None else (view.rows, require(view.columns))


def footprint(to_map: np.ndarray, first: int, last: int, columns: int, shape: tuple[int, int]) -> tuple[float, float]:
    """Compute the largest steps on the maps, in their pixels, between neighbouring screen rows and columns.

    Over the screen rows first .. last - 1, where the painting is in sight; (0, 0) where it is not.  No step is longer
    than the painting: towards the horizon the steps grow without bound.
    """
    column, row = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(first, last, dtype=np.float64))
    x, y, w = (to_map[i, 0] * column + to_map[i, 1] * row + to_map[i, 2] for i in range(3))
    ahead = w > 0
    w = np.where(ahead, w, 1.0)
    x, y = x / w, y / w
    by_column = np.hypot((to_map[0, 0] - x * to_map[2, 0]) / w, (to_map[1, 0] - y * to_map[2, 0]) / w)
    by_row = np.hypot((to_map[0, 1] - x * to_map[2, 1]) / w, (to_map[1, 1] - y * to_map[2, 1]) / w)
    longest = np.hypot(*shape)
    by_column, by_row = np.minimum(by_column, longest), np.minimum(by_row, longest)
    margin = by_column + by_row  # the pixel may touch the painting though its centre does not
    outside = np.maximum(np.maximum(-x, x - shape[1] + 1), np.maximum(-y, y - shape[0] + 1))
    seen = ahead & (outside <= margin + 0.5)
    if not seen.any():
        return 0.0, 0.0
    return float(by_row[seen].max()), float(by_column[seen].max())


@dataclass(frozen=True)
class MapSamples:
    """Maps at the samples of a band of the screen."""

    normals: np.ndarray  # (h, w, 3) float32, unit length or 0
    coefficients: np.ndarray  # (h, w, K) float32
    shading: np.ndarray | None  # (h, w, 3 or 5) float32
    labels: np.ndarray | None  # (h, w) uint8, of the nearest pixel
    visibility: np.ndarray | None  # (lights, h, w) float32
    inside: np.ndarray  # (h, w) bool


def sample_maps(
    scene: PlaneScene, visibility: np.ndarray | None, to_map: np.ndarray, shape: tuple, extent: tuple
) -> MapSamples:
    """Sample bilinearly at to_map . (column, row, 1), normals renormalised: the shading comes after.

    extent: (rows, columns) of the painting in pixels of the maps, where averaging in blocks rounded their number up.
    A missing normal among the four neighbours is left out; where half of the weight is missing, so is the sample.
    """
    height, width = shape
    lights = 0 if visibility is None else len(visibility)
    normals = np.empty((height, width, 3), np.float32)
    coefficients = np.empty((height, width, scene.coefficients.shape[2]), np.float32)
    terms = (0, 0, 0) if scene.shading is None else (height, width, scene.shading.shape[2])
    shading = np.empty(terms, np.float32)
    labels = np.empty((height, width) if scene.labels is not None else (0, 0), np.uint8)
    visible = np.empty((lights, height, width), np.float32)
    inside = np.empty((height, width), np.bool_)
    maps = (
        np.ascontiguousarray(scene.normals, np.float32),
        np.ascontiguousarray(scene.coefficients, np.float32),
        np.zeros((0, 0, 0), np.float32) if scene.shading is None else np.ascontiguousarray(scene.shading, np.float32),
        np.zeros((0, 0), np.uint8) if scene.labels is None else np.ascontiguousarray(scene.labels),
        np.zeros((0, 0, 0), np.float32) if visibility is None else np.ascontiguousarray(visibility, np.float32),
    )
    out = normals, coefficients, shading, labels, visible, inside
    _sample(maps, to_map, (float(extent[0]), float(extent[1])), out)
    return MapSamples(
        normals,
        coefficients,
        None if scene.shading is None else shading,
        None if scene.labels is None else labels,
        None if visibility is None else visible,
        inside,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(maps, to_map, extent, out):
    (maps_n, maps_c, maps_s, maps_l, maps_v), (high, wide) = maps, extent
    normals, coefficients, shading, labels, visible, inside = out
    rows, columns = maps_n.shape[:2]
    for i in range(inside.shape[0]):
        for j in range(inside.shape[1]):
            w = to_map[2, 0] * j + to_map[2, 1] * i + to_map[2, 2]
            x = (to_map[0, 0] * j + to_map[0, 1] * i + to_map[0, 2]) / w
            y = (to_map[1, 0] * j + to_map[1, 1] * i + to_map[1, 2]) / w
            on = w > 0.0 and -0.5 <= x < wide - 0.5 and -0.5 <= y < high - 0.5
            inside[i, j] = on
            if not on:
                normals[i, j, :] = 0.0
                coefficients[i, j, :] = 0.0
                if shading.shape[0] > 0:
                    shading[i, j, :] = 0.0
                visible[:, i, j] = 0.0
                if labels.shape[0] > 0:
                    labels[i, j] = 0
                continue
            x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
            c0, r0 = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
            c1, r1 = min(c0 + 1, columns - 1), min(r0 + 1, rows - 1)
            fx, fy = x - c0, y - r0
            nx, ny, nz, known = 0.0, 0.0, 0.0, 0.0
            coefficients[i, j, :] = 0.0
            if shading.shape[0] > 0:
                shading[i, j, :] = 0.0
            for k in range(4):
                r, c = r1 if k >= 2 else r0, c1 if k % 2 == 1 else c0
                weight = (fy if k >= 2 else 1.0 - fy) * (fx if k % 2 == 1 else 1.0 - fx)
                if weight == 0.0:
                    continue
                px, py, pz = maps_n[r, c, 0], maps_n[r, c, 1], maps_n[r, c, 2]
                if abs(px * px + py * py + pz * pz - 1.0) < 0.02:
                    nx, ny, nz, known = nx + weight * px, ny + weight * py, nz + weight * pz, known + weight
                for m in range(coefficients.shape[2]):
                    coefficients[i, j, m] += np.float32(weight) * maps_c[r, c, m]
                if shading.shape[0] > 0:
                    for m in range(shading.shape[2]):
                        shading[i, j, m] += np.float32(weight) * maps_s[r, c, m]
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            scale = 1.0 / length if known > 0.5 and length > 0.0 else 0.0
            normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = nx * scale, ny * scale, nz * scale
            if labels.shape[0] > 0:
                labels[i, j] = maps_l[r1 if fy >= 0.5 else r0, c1 if fx >= 0.5 else c0]
            for m in range(visible.shape[0]):
                upper = maps_v[m, r0, c0] + (maps_v[m, r0, c1] - maps_v[m, r0, c0]) * fx
                lower = maps_v[m, r1, c0] + (maps_v[m, r1, c1] - maps_v[m, r1, c0]) * fx
                visible[m, i, j] = upper + (lower - upper) * fy


_SAMPLES_AT_ONCE = 1 << 19  # bounds the memory of a band of the screen


@dataclass(frozen=True)
class Rendering:
    """A picture and its facts."""

    xyz: np.ndarray  # (rows, columns, 3) float32, linear, Y = 1 for a perfect white that faces a lamp of intensity 1
    # (rows, columns) uint8, bits of `nishiki.render.plane.kernel`; a pixel made of several samples carries
    # NORMAL_MISSING, COLOUR_MISSING and OVERFLOW only if no sample of it is usable, TURNED_AWAY if any sample is
    flags: np.ndarray
    # (rows, columns) float32, share of the pixel inside the painting; the rest is black
    coverage: np.ndarray
    white_xyz: np.ndarray  # (3,) of a perfect white under the first light (or the ambient light): what an eye adapts to
    samples_per_pixel: int  # most samples that any pixel rests on
    reduction: int  # factor by which the maps were averaged before sampling; 1: not


def render(
    scene: PlaneScene,
    lights: list[Light],
    view: View | None = None,
    *,
    ambient: Ambient | None = None,
    visibility: np.ndarray | None = None,
    samples: tuple[int, int] = (2, 1024),
) -> Rendering:
    """Draw `scene` under `lights` from `view` (default: frontal, a screen pixel for a pixel of the maps).

    Black is where the ray misses the painting; without a height there are no shadows. visibility: of `cast_shadows`,
    computed before, e.g. for a sequence of views. A pixel of a screen that is not the maps is the mean of shaded
    samples, as many across and down as the pixel is steps long on the maps, so that no pixel of the maps is jumped
    over; at least the first of `samples` along each side. Where that would be more than the second in all, the
    maps are averaged first (`reduction`); averaged normals shade like a smoother surface.
    """
    view = View() if view is None else view
    ambient = Ambient() if ambient is None else ambient
    if visibility is None and scene.height is not None and lights:
        visibility = shade.cast_shadows(scene.height, lights, pitch=scene.pitch)
    groups = shade.colour_groups(scene, lights, ambient)
    white = groups.whites[groups.of_light[0] if lights else groups.ambient]
    if view.eye_mm is None and screen_shape(view, scene) == scene.shape:  # the pixels of the maps
        shading = shade.shade_xyz(scene, lights, ambient=ambient, visibility=visibility)
        coverage = np.ones(scene.shape, np.float32)
        return Rendering(shading.values, shading.flags, coverage, white, 1, 1)
    plane = screen_to_plane(view, scene)
    rows, columns = screen_shape(view, scene)
    to_map = np.linalg.inv(shade.pixel_to_plane(scene.pitch, scene.shape)) @ plane
    steps = [footprint(to_map, k, min(k + 16, rows), columns, scene.shape) for k in range(0, rows, 16)]
    (least, most), reduction = samples, 1
    while max(_count(step, reduction) for step in steps) > most and reduction < max(scene.shape):
        reduction *= 2
    maps, seen = reduce_maps(scene, visibility, reduction)
    shrink = np.array([[1 / reduction, 0, 0.5 / reduction - 0.5], [0, 1 / reduction, 0.5 / reduction - 0.5], [0, 0, 1]])
    eye = shade.FRONTAL_EYE if view.eye_mm is None else np.append(np.asarray(view.eye_mm, np.float64), 1.0)
    painter = _Painter(maps, seen, lights, groups, ambient.level, plane, shrink @ to_map, eye,
        (scene.shape[0] / reduction, scene.shape[1] / reduction))  # fmt: skip
    xyz = np.empty((rows, columns, 3), np.float32)
    flags, coverage = np.empty((rows, columns), np.uint8), np.empty((rows, columns), np.float32)
    largest, first = 1, 0
    while first < rows:
        last, across, down = painter.band(first, xyz.shape, least, most)
        inside, shading = painter.paint(first, last, columns, across, down)
        xyz[first:last], flags[first:last], coverage[first:last] = _resolve(shading, inside, across, down)
        largest, first = max(largest, across * down), last
    return Rendering(xyz, flags, coverage, white, largest, reduction)


def _count(step: tuple[float, float], reduction: int) -> float:
    return np.prod([max(1, np.ceil(s / reduction - 1e-6)) for s in step])


@dataclass(frozen=True)
class _Painter:
    """Common data of all bands of the screen."""

    maps: PlaneScene
    visibility: np.ndarray | None
    lights: list
    groups: shade.ColourGroups
    ambient_level: float
    plane: np.ndarray
    to_map: np.ndarray
    eye: np.ndarray
    extent: tuple  # (rows, columns) of the painting in pixels of the maps

    def band(self, first: int, shape: tuple, minimum: int, maximum: int) -> tuple[int, int, int]:
        """Choose (end of the band, samples across, samples down) for a band that begins at screen row `first`."""
        rows, columns = shape[:2]
        height = min(16, rows - first)
        while True:
            by_row, by_column = footprint(self.to_map, first, first + height, columns, self.maps.shape)
            across = max(minimum, int(np.ceil(by_column - 1e-6)))
            down = min(max(minimum, int(np.ceil(by_row - 1e-6))), max(1, maximum // across))
            if by_row == by_column == 0:
                across = down = 1  # the painting is out of sight
            if height == 1 or height * columns * across * down <= _SAMPLES_AT_ONCE:
                return first + height, across, down
            height = max(1, height // 2)

    def paint(self, first: int, last: int, columns: int, across: int, down: int):
        """Draw maps and shading at across x down samples a pixel of the screen rows first .. last - 1."""
        to_screen = np.array([[1 / across, 0, 0.5 / across - 0.5], [0, 1 / down, first + 0.5 / down - 0.5], [0, 0, 1]])
        shape = ((last - first) * down, columns * across)
        samples = sample_maps(self.maps, self.visibility, self.to_map @ to_screen, shape, self.extent)
        shading = shade.shade_channels(
            shade.PlaneMaps(
                samples.normals, samples.coefficients, self.maps.gloss, samples.shading, None, samples.labels
            ),
            self.lights,
            groups=self.groups,
            visibility=samples.visibility,
            plane=self.plane @ to_screen,
            eye=self.eye,
            ambient_level=self.ambient_level,
        )
        return samples.inside, shading


def reduce_maps(scene: PlaneScene, visibility: np.ndarray | None, factor: int):
    """Average the maps over blocks of factor x factor pixels (labels: of the block's middle), and the visibility."""
    if factor == 1:
        return scene, visibility
    known = np.abs(np.sum(np.square(scene.normals, dtype=np.float64), axis=2) - 1) < 0.02

    def means(values: np.ndarray) -> np.ndarray:
        return shrink(lambda rows: values[rows], values.shape, factor)

    normals = means(np.where(known[..., None], scene.normals, 0))
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    coefficients = means(scene.coefficients)
    shading = None if scene.shading is None else means(scene.shading)
    numbers = scene.labels
    labels = None if numbers is None else shrink(lambda rows: numbers[rows], numbers.shape, factor, "middle")
    reduced = dataclasses.replace(
        scene,
        normals=normals,
        coefficients=coefficients,
        shading=shading,
        slopes=None,
        labels=labels,
        height=None,
        pitch=scene.pitch * factor,
    )
    if visibility is not None:
        visibility = np.stack([means(v) for v in visibility])
    return reduced, visibility


def _resolve(
    shading: shade.PixelShading, inside: np.ndarray, across: int, down: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average the samples of each pixel; unusable samples (missing normal or colour, overflow) are omitted.

    Returns XYZ (rows, columns, 3), flags and coverage (rows, columns) of the pixels, each down x across samples.
    """

    def samples(values: np.ndarray) -> np.ndarray:
        rows, columns = inside.shape
        return values.reshape(rows // down, down, columns // across, across, *values.shape[2:])

    usable = inside & (shading.flags & UNUSABLE == 0)
    on, count = (np.sum(samples(chosen), axis=(1, 3)) for chosen in (inside, usable))
    share = on / (across * down)
    sums = np.sum(samples(np.where(usable[..., None], shading.values, 0)), axis=(1, 3), dtype=np.float64)
    xyz = sums * (share / np.maximum(count, 1))[..., None]
    marks = np.bitwise_or.reduce(samples(np.where(inside, shading.flags, 0)), axis=(1, 3))
    marks = np.where(count > 0, marks & TURNED_AWAY, marks)
    return xyz, np.where(on > 0, marks, BACKGROUND), share
