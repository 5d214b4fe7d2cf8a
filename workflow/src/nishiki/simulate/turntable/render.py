"""Render a view of the simulated object as light, with the light that reaches a point by way of other parts."""

import math
from dataclasses import dataclass

import numpy as np

from nishiki.geometry.visibility import Hits, RayTree, cast, frames_about, make_tree
from nishiki.simulate.randomness import GOLDEN_RATIO, mix_bits, subkey, uniforms
from nishiki.simulate.reflection import metal_fresnel
from nishiki.simulate.turntable.materials import INDEX, describe, reflect
from nishiki.simulate.turntable.shape import (
    AIM_MM,
    LAMP_RADIUS_MM,
    SimulatedSurface,
    SimulatedView,
    TurntableSettings,
    make_surface,
)
from nishiki.threads import strips

OFFSET_MM = 0.02  # rays start so far above the surface
_SMOOTHEST = 0.28  # the mirror image of the surroundings is at least so blurred: there are few rays a vertex
_FACE_SAMPLES = 4  # of a triangle's mean
_GATHERED_RAYS = 1 << 19  # at a time


@dataclass(frozen=True)
class VertexSurroundings:
    """The surroundings of each vertex."""

    seen: np.ndarray  # (v, directions) int32, the vertex that each ray meets, -1 = none
    toward: np.ndarray  # (directions, 3) unit directions about z, cosine-distributed, turned by `spin` (v,) radians
    spin: np.ndarray
    albedo: np.ndarray  # (v, 3)
    shine: np.ndarray  # (v, 2): roughness, and 1 for metal
    normals: np.ndarray  # (v, 3)


def cosine_directions(count: int) -> np.ndarray:
    """Return unit directions (count, 3) about z, distributed as the cosine: a sunflower pattern on the disc, lifted."""
    index = np.arange(count) + 0.5
    r, turn = np.sqrt(index / count), index * math.pi * (3.0 - math.sqrt(5.0))
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), np.sqrt(1.0 - r * r)])


def look_around(surface: SimulatedSurface, tree: RayTree, *, directions: int, seed: int) -> VertexSurroundings:
    """Send rays from every vertex; average the materials about it."""
    count = len(surface.vertices)
    toward = cosine_directions(directions)
    spin = np.random.default_rng(subkey(seed, "turntable directions")).uniform(0.0, 2.0 * math.pi, count)
    seen = np.empty((count, directions), np.int32)
    batch = max(_GATHERED_RAYS // directions, 1)
    for start in range(0, count, batch):
        some = slice(start, min(start + batch, count))
        normals = surface.normals[some]
        c, s, frames = np.cos(spin[some])[:, None], np.sin(spin[some])[:, None], frames_about(normals)
        u, v = c * toward[:, 0] - s * toward[:, 1], s * toward[:, 0] + c * toward[:, 1]
        rays = u[..., None] * frames[:, None, 0] + v[..., None] * frames[:, None, 1]
        rays += toward[:, 2:] * normals[:, None]
        origins = np.repeat(surface.vertices[some] + OFFSET_MM * normals, directions, axis=0)
        hits = cast(tree, origins, rays.reshape(-1, 3))
        weights = np.column_stack([1.0 - hits.weights.sum(axis=1), hits.weights])
        corner = surface.triangles[hits.triangle, weights.argmax(axis=1)]
        seen[some] = np.where(hits.triangle >= 0, corner, -1).reshape(-1, directions)
    albedo, shine = _mean_materials(surface, subkey(seed, "turntable paint"))
    return VertexSurroundings(seen, toward, spin, albedo, shine, surface.normals)


def _mean_materials(surface: SimulatedSurface, key: int) -> tuple[np.ndarray, np.ndarray]:
    """Average albedo (v, 3) and (roughness, share of metal) (v, 2) over the triangles at each vertex by area."""
    faces = np.zeros((len(surface.triangles), 5))
    random = np.random.default_rng(key)
    for _ in range(_FACE_SAMPLES):
        weights = random.dirichlet((1.0, 1.0, 1.0), len(faces))
        parts, points, normals = (
            np.einsum("fc,fca->fa", weights, values[surface.triangles])
            for values in (surface.parts, surface.vertices, surface.normals)
        )
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        m = describe(parts, points, normals, key=key)
        faces += np.column_stack([m[:, :3], 0.5 * (m[:, 6] + m[:, 7]), m[:, 3] > 0.0]) / _FACE_SAMPLES
    a, b, c = (surface.vertices[surface.triangles[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    sums = np.zeros((len(surface.vertices), 6))
    for corner in range(3):
        for column, values in enumerate([*faces.T, np.ones(len(faces))]):
            sums[:, column] += np.bincount(surface.triangles[:, corner], values * area, len(sums))
    mean = sums[:, :5] / sums[:, 5:]
    return mean[:, :3], mean[:, 3:]


def trace_bounces(around: VertexSurroundings, direct: np.ndarray, bounces: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute indirect irradiance (v, 3) and radiosity (v, 3) of the vertices under direct (v,) or (v, 3) irradiance.

    `bounces` diffuse reflections: the first by what is lit directly. Facets of metal are taken as dark here.
    """
    direct = np.broadcast_to(direct if np.ndim(direct) == 2 else np.asarray(direct)[:, None], around.albedo.shape)
    indirect = np.zeros(around.albedo.shape)
    for _ in range(bounces):
        leaving = np.vstack([around.albedo * (direct + indirect), np.zeros(3)])  # of -1, where a ray meets nothing
        indirect = sum(leaving[met] for met in around.seen.T) * (1.0 / around.seen.shape[1])
    return indirect, around.albedo * (direct + indirect)


def mirror_object(
    surface: SimulatedSurface, around: VertexSurroundings, radiosity: np.ndarray, eye: np.ndarray
) -> np.ndarray:
    """Compute the object's own image (v, 3) in facets that reflect all light, at each vertex towards the eye.

    The mean of the surroundings' radiosity with the weights of GGX facets.
    """
    view = eye - surface.vertices
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    normals, frames = surface.normals, frames_about(surface.normals)
    v_t, v_b, v_n = (np.einsum("ij,ij->i", axis, view) for axis in (frames[:, 0], frames[:, 1], normals))
    c, s = np.cos(around.spin), np.sin(around.spin)
    roughness = np.maximum(around.shine[:, 0], _SMOOTHEST) ** 2
    leaving = np.vstack([radiosity, np.zeros(3)])  # of -1, where a ray meets nothing
    total, light = np.full(len(view), 1e-12), np.zeros(around.albedo.shape)
    for (a, b, up), met in zip(around.toward, around.seen.T, strict=True):
        square = np.maximum(2 + 2 * ((c * a - s * b) * v_t + (s * a + c * b) * v_b + up * v_n), 1e-12)
        weight = ((roughness - 1) * (up + v_n) ** 2 / square + 1) ** -2
        total += weight
        light += weight[:, None] * leaving[met]
    return np.where(v_n[:, None] > -0.2, light / total[:, None], 0.0)


_LAMP_POINTS = 8  # lamp points a vertex, for the light that bounces
_RAYS = 1 << 18  # at a time


@dataclass(frozen=True)
class SimulatedScene:
    """The object, ready to render: its triangles, the tree over them, each vertex's surroundings, its paint's key."""

    surface: SimulatedSurface
    tree: RayTree
    around: VertexSurroundings
    key: int


@dataclass(frozen=True)
class Radiance:
    """Light from the object to the camera, relative to a perfect white at the axis that faces the lamp."""

    # (rows, columns, 3) float32, light that has lost its polarisation (body, bounced light, the object's mirror image
    # in itself)
    diffuse: np.ndarray
    specular: np.ndarray  # likewise, the lamp's mirror reflection
    coverage: np.ndarray  # (rows, columns) float32, share of the pixel that the object fills
    depth: np.ndarray  # mm along the optical axis
    normals: np.ndarray  # (rows, columns, 3), unit, of the smooth surface in the object's frame
    albedo: np.ndarray  # (rows, columns, 3): float32, means over the samples that meet the object, 0 where none does
    part: np.ndarray  # (rows, columns) uint8, of the first sample; 255 = none


@dataclass(frozen=True)
class _RayHits:
    """Places where rays met the object."""

    pixel: np.ndarray  # (n,), its number in the pixel (n,)
    sample: np.ndarray
    numbers: np.ndarray  # (n, 4) in [0, 1)
    points: np.ndarray  # (n, 3)
    normals: np.ndarray  # (n, 3) unit
    rays: np.ndarray  # (n, 3) directions
    depth: np.ndarray  # (n,) distance
    parts: np.ndarray  # (n, parts)
    bounce: np.ndarray  # (n, 3) indirect irradiance
    image: np.ndarray  # (n, 3)


def make_scene(settings: TurntableSettings) -> SimulatedScene:
    """Make the object that the settings describe; the same for any number of threads."""
    surface = make_surface(settings.triangles)
    tree = make_tree(surface.vertices, surface.triangles)
    around = look_around(surface, tree, directions=settings.directions, seed=settings.seed)
    return SimulatedScene(surface, tree, around, subkey(settings.seed, "turntable paint"))


def see(scene: SimulatedScene, view: SimulatedView, settings: TurntableSettings) -> Radiance:
    """Render the light of one view; pixels are means over their area, without blur and noise."""
    indirect, radiosity = trace_bounces(scene.around, irradiance(scene, view), settings.bounces)
    mirror = np.zeros_like(indirect)
    if settings.bounces:
        mirror = mirror_object(scene.surface, scene.around, radiosity, view.centre)
    shape = (settings.rows, settings.columns)
    light = Radiance(
        np.zeros((*shape, 3), np.float32),
        np.zeros((*shape, 3), np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros((*shape, 3), np.float32),
        np.zeros((*shape, 3), np.float32),
        np.full(shape, 255, np.uint8),
    )
    for rows in strips(settings.rows, max(_RAYS // (settings.columns * settings.samples**2), 1)):
        met = _aim(scene, view, settings, rows, np.hstack([indirect, mirror]))
        _collect(met, *_shade(scene, view, settings, met), settings, Radiance(*(a[rows] for a in vars(light).values())))
    return light


def lamp_rays(points: np.ndarray, lamp: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit directions (n, 3) and distances (n,) from points to points of the lamp's facing disc.

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


def reference(view: SimulatedView) -> float:
    """Return the squared distance (mm²) at which the lamp gives irradiance 1: that of the axis."""
    return float(np.sum((view.lamp - np.array(AIM_MM)) ** 2))


def irradiance(scene: SimulatedScene, view: SimulatedView) -> np.ndarray:
    """Compute the lamp's irradiance (v,) on every vertex, with shadows; 1 for a surface at the axis that faces it."""
    surface = scene.surface
    origins, total = surface.vertices + OFFSET_MM * surface.normals, np.zeros(len(surface.vertices))
    for point in range(_LAMP_POINTS):
        a, b = (np.full(len(total), x) for x in ((point + 0.5) / _LAMP_POINTS, point * GOLDEN_RATIO % 1.0))
        rays, distance = lamp_rays(origins, view.lamp, a, b)
        cosine = np.einsum("ij,ij->i", surface.normals, rays)
        facing = np.flatnonzero(cosine > 0.0)
        free = cast(scene.tree, origins[facing], rays[facing], far=distance[facing], any_hit=True).triangle < 0
        lit = facing[free]
        total[lit] += cosine[lit] * reference(view) / distance[lit] ** 2
    return total / _LAMP_POINTS


def _aim(scene, view, settings, rows: slice, vertex_light: np.ndarray) -> _RayHits:
    """Send rays through stratified random places of the pixels of some rows, and find where they meet the object."""
    side, columns = settings.samples, settings.columns
    count = (rows.stop - rows.start) * columns
    pixel, sample = np.divmod(np.arange(count * side * side), side * side)
    # the third number is the same for the whole pixel: it turns the lamp's pattern
    turns = 4 * sample[:, None] * (1, 1, 0, 1) + (4, 5, 1, 6)
    bits = mix_bits(np.uint64(scene.key), rows.start * columns + pixel)
    numbers = uniforms(bits[:, None], turns)
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
    return _RayHits(
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


def _shade(scene, view, settings, met: _RayHits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute diffuse and specular light (n, 3) of every sample to the camera, and its albedo (n, 3)."""
    m = describe(met.parts, met.points, met.normals, key=scene.key)
    # One point of the lamp's disc a sample; together the pixel's samples cover the disc (a sunflower pattern).
    ring = (met.sample + met.numbers[:, 3]) / settings.samples**2
    origins = met.points + OFFSET_MM * met.normals
    rays, distance = lamp_rays(origins, view.lamp, ring, (met.numbers[:, 2] + met.sample * GOLDEN_RATIO) % 1.0)
    facing = np.flatnonzero(np.einsum("ij,ij->i", met.normals, rays) > 0.0)
    free = cast(scene.tree, origins[facing], rays[facing], far=distance[facing], any_hit=True).triangle < 0
    lit = facing[free]
    body, gloss = np.zeros((len(m), 3)), np.zeros((len(m), 3))
    body[lit], gloss[lit] = reflect(m[lit], rays[lit], -met.rays[lit])
    strength = (reference(view) / distance**2)[:, None]
    # Schlick for the surroundings' image too: its light comes from many sides, the exact curve gains nothing.
    cosine = -np.einsum("ij,ij->i", m[:, 9:12], met.rays)[:, None]
    glass = metal_fresnel(cosine, ((INDEX - 1.0) / (INDEX + 1.0)) ** 2)
    shine = np.where(m[:, 3:4] > 0.0, metal_fresnel(cosine, m[:, 3:6]), glass)
    diffuse = body * strength + m[:, :3] * met.bounce * (1.0 - glass) + shine * met.image
    return diffuse, gloss * strength, m[:, :3]


def _collect(met: _RayHits, diffuse, specular, albedo, settings, out: Radiance) -> None:
    """Average over the pixels of some rows, into `out`."""
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
