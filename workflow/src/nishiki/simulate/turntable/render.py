"""A view of the object as light: rays through every pixel, the lamp's shadow, gloss, body and bounced light."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from nishiki.geometry.ray_tree import Hits, RayTree, cast, make_tree
from nishiki.simulate.randomness import hash_uint, subkey, uniform
from nishiki.simulate.reflection import metal_fresnel
from nishiki.simulate.turntable.interreflection import OFFSET_MM, Surroundings, bounced, look_around, mirrored
from nishiki.simulate.turntable.materials import INDEX, describe, reflected
from nishiki.simulate.turntable.settings import AIM_MM, LAMP_RADIUS_MM, TurntableSettings, Viewpoint
from nishiki.simulate.turntable.surface import Surface, make_surface
from nishiki.threads import over_rows

_LAMP_POINTS = 8  # lamp points a vertex, for the light that bounces
_RAYS = 1 << 18  # at a time
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class SimulatedScene:
    """The object, ready to be seen: its triangles, the tree over them, what every vertex sees, the key of its paint."""

    surface: Surface
    tree: RayTree
    around: Surroundings
    key: int


@dataclass(frozen=True)
class Light:
    """What comes from the object to the camera, relative to a perfect white at the axis that faces the lamp.

    diffuse : (rows, columns, 3) float32, light that has lost its polarisation (body, bounced light, the object's mirror
    image in itself). specular : likewise, the lamp's mirror reflection. coverage : (rows, columns) float32, share of
    the pixel that the object fills. depth : mm along the optical axis; normals : (rows, columns, 3), unit, of the
    smooth surface in the object's frame; albedo : (rows, columns, 3): float32, means over the samples that meet the
    object, 0 where none does. part : (rows, columns) uint8, of the first sample; 255 = none.
    """

    diffuse: np.ndarray
    specular: np.ndarray
    coverage: np.ndarray
    depth: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray
    part: np.ndarray


@dataclass(frozen=True)
class _Points:
    """Where rays met the object: pixel (n,), its number in the pixel (n,), numbers (n, 4) in [0, 1), points, unit
    normals, directions of the rays (n, 3), distance (n,), parts (n, parts), indirect irradiance and image (n, 3)."""

    pixel: np.ndarray
    sample: np.ndarray
    numbers: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    rays: np.ndarray
    depth: np.ndarray
    parts: np.ndarray
    bounce: np.ndarray
    image: np.ndarray


def make_scene(settings: TurntableSettings) -> SimulatedScene:
    """The object that the settings describe; the same for any number of threads."""
    surface = make_surface(settings.triangles)
    tree = make_tree(surface.vertices, surface.triangles)
    around = look_around(surface, tree, directions=settings.directions, seed=settings.seed)
    return SimulatedScene(surface, tree, around, subkey(settings.seed, "turntable paint"))


def see(scene: SimulatedScene, view: Viewpoint, settings: TurntableSettings) -> Light:
    """The light of one view; pixels are means over their area, without blur and noise."""
    indirect, radiosity = bounced(scene.around, irradiance(scene, view), settings.bounces)
    mirror = np.zeros_like(indirect)
    if settings.bounces:
        mirror = mirrored(scene.surface, scene.around, radiosity, view.centre)
    shape = (settings.rows, settings.columns)
    light = Light(
        *(np.zeros((*shape, 3), np.float32) for _ in range(2)),
        *(np.zeros(shape, np.float32) for _ in range(2)),
        *(np.zeros((*shape, 3), np.float32) for _ in range(2)),
        np.full(shape, 255, np.uint8),
    )
    band = max(_RAYS // (settings.columns * settings.samples**2), 1)
    for start in range(0, settings.rows, band):
        rows = slice(start, min(start + band, settings.rows))
        met = _aim(scene, view, settings, rows, np.hstack([indirect, mirror]))
        _collect(met, *_shade(scene, view, settings, met), settings, Light(*(a[rows] for a in vars(light).values())))
    return light


def lamp_rays(points: np.ndarray, lamp: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (n, 3) and distances (n,) from points to points of the lamp's disc, which faces them.

    a, b in [0, 1) choose the point: share of the disc's area inside its radius, and the angle as a share of a turn.
    """
    to_lamp = lamp - points
    straight = to_lamp / np.linalg.norm(to_lamp, axis=1, keepdims=True)
    # Two directions across the light: any pair will do, for the disc is round.
    u = np.column_stack([straight[:, 2], np.zeros(len(points)), -straight[:, 0]])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    w = np.cross(straight, u)
    r, turn = LAMP_RADIUS_MM * np.sqrt(a), 2.0 * np.pi * b
    rays = to_lamp + (r * np.cos(turn))[:, None] * u + (r * np.sin(turn))[:, None] * w
    distance = np.linalg.norm(rays, axis=1)
    return rays / distance[:, None], distance


def reference(view: Viewpoint) -> float:
    """Squared distance (mm²) at which the lamp gives irradiance 1: that of the axis."""
    return float(np.sum((view.lamp - np.array(AIM_MM)) ** 2))


def irradiance(scene: SimulatedScene, view: Viewpoint) -> np.ndarray:
    """Irradiance (v,) of every vertex by the lamp, with shadows; 1 for a surface at the axis that faces it."""
    surface = scene.surface
    origins, total = surface.vertices + OFFSET_MM * surface.normals, np.zeros(len(surface.vertices))
    for point in range(_LAMP_POINTS):
        a, b = (np.full(len(total), x) for x in ((point + 0.5) / _LAMP_POINTS, point * _GOLDEN % 1.0))
        rays, distance = lamp_rays(origins, view.lamp, a, b)
        cosine = np.einsum("ij,ij->i", surface.normals, rays)
        facing = np.flatnonzero(cosine > 0.0)
        free = cast(scene.tree, origins[facing], rays[facing], far=distance[facing], any_hit=True).triangle < 0
        lit = facing[free]
        total[lit] += cosine[lit] * reference(view) / distance[lit] ** 2
    return total / _LAMP_POINTS


@numba.njit(cache=True, nogil=True)
def _numbers(start, stop, key, first, samples, out):
    for pixel in range(start, stop):
        bits = hash_uint(np.uint64(key), np.uint64(first + pixel))
        for sample in range(samples):
            out[pixel, sample, 0] = uniform(bits, np.uint64(4 * sample + 4))
            out[pixel, sample, 1] = uniform(bits, np.uint64(4 * sample + 5))
            out[pixel, sample, 2] = uniform(bits, np.uint64(1))  # the same for the pixel: it turns the lamp's pattern
            out[pixel, sample, 3] = uniform(bits, np.uint64(4 * sample + 6))


def _aim(scene, view, settings, rows: slice, vertex_light: np.ndarray) -> _Points:
    """Rays through stratified random places of the pixels of some rows, and where they meet the object."""
    side, columns = settings.samples, settings.columns
    count = (rows.stop - rows.start) * columns
    numbers = np.empty((count, side * side, 4))
    over_rows(_numbers, count, np.uint64(scene.key), rows.start * columns, side * side, numbers)
    pixel, sample = np.divmod(np.arange(count * side * side), side * side)
    numbers = numbers.reshape(-1, 4)
    u = pixel % columns - 0.5 + (sample % side + numbers[:, 0]) / side
    v = rows.start + pixel // columns - 0.5 + (sample // side + numbers[:, 1]) / side
    u, v = ((a - middle) / view.focal for a, middle in zip((u, v), view.principal, strict=True))
    right, down, into = view.rotation
    rays = u[:, None] * right + v[:, None] * down + into
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits = cast(scene.tree, view.centre, rays)
    met = np.flatnonzero(hits.triangle >= 0)
    hits = Hits(hits.triangle[met], hits.distance[met], hits.weights[met])
    rays = rays[met]
    corners = scene.surface.triangles[hits.triangle]
    weights = np.column_stack([1.0 - hits.weights.sum(axis=1), hits.weights])
    values = np.hstack([scene.surface.normals, scene.surface.parts, vertex_light])
    mixed = sum(weights[:, corner, None] * values[corners[:, corner]] for corner in range(3))
    return _Points(
        pixel[met],
        sample[met],
        numbers[met],
        view.centre + hits.distance[:, None] * rays,
        mixed[:, :3] / np.linalg.norm(mixed[:, :3], axis=1, keepdims=True),
        rays,
        hits.distance * np.einsum("ij,j->i", rays, into),
        mixed[:, 3:-6],
        mixed[:, -6:-3],
        mixed[:, -3:],
    )


def _shade(scene, view, settings, met: _Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Diffuse and specular light (n, 3) of every sample to the camera, and its albedo (n, 3)."""
    m = describe(met.parts, met.points, met.normals, key=scene.key)
    # One point of the lamp's disc a sample; together the pixel's samples cover the disc (a sunflower pattern).
    ring = (met.sample + met.numbers[:, 3]) / settings.samples**2
    origins = met.points + OFFSET_MM * met.normals
    rays, distance = lamp_rays(origins, view.lamp, ring, (met.numbers[:, 2] + met.sample * _GOLDEN) % 1.0)
    facing = np.flatnonzero(np.einsum("ij,ij->i", met.normals, rays) > 0.0)
    free = cast(scene.tree, origins[facing], rays[facing], far=distance[facing], any_hit=True).triangle < 0
    lit = facing[free]
    body, gloss = np.zeros((len(m), 3)), np.zeros((len(m), 3))
    body[lit], gloss[lit] = reflected(m[lit], rays[lit], -met.rays[lit])
    strength = (reference(view) / distance**2)[:, None]
    # Schlick for the surroundings' image too: its light comes from many sides, the exact curve gains nothing.
    cosine = -np.einsum("ij,ij->i", m[:, 9:12], met.rays)[:, None]
    glass = metal_fresnel(cosine, ((INDEX - 1.0) / (INDEX + 1.0)) ** 2)
    shine = np.where(m[:, 3:4] > 0.0, metal_fresnel(cosine, m[:, 3:6]), glass)
    diffuse = body * strength + m[:, :3] * met.bounce * (1.0 - glass) + shine * met.image
    return diffuse, gloss * strength, m[:, :3]


def _collect(met: _Points, diffuse, specular, albedo, settings, out: Light) -> None:
    """Means over the pixels of some rows, into `out`."""
    shape = out.coverage.shape
    count = np.bincount(met.pixel, minlength=out.coverage.size)

    def total(values):
        columns = values.T if values.ndim > 1 else values[None]
        sums = [np.bincount(met.pixel, column, out.coverage.size) for column in columns]
        return np.stack(sums, axis=-1).reshape(*shape, *values.shape[1:])

    count = count.reshape(shape)
    some = np.maximum(count, 1)
    out.coverage[:] = count / settings.samples**2
    out.diffuse[:] = total(diffuse) / settings.samples**2
    out.specular[:] = total(specular) / settings.samples**2
    out.albedo[:] = total(albedo) / some[..., None]
    out.depth[:] = total(met.depth) / some
    normals = total(met.normals)
    out.normals[:] = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    pixels, first = np.unique(met.pixel, return_index=True)
    out.part.reshape(-1)[pixels] = met.parts[first].argmin(axis=1)
