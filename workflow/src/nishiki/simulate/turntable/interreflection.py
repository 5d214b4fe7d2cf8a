"""Light that reaches a point by way of other parts of the object: what each vertex sees and what it gets from there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.geometry.ray_tree import RayTree, cast
from nishiki.simulate.randomness import subkey
from nishiki.simulate.turntable.materials import describe
from nishiki.simulate.turntable.surface import Surface
from nishiki.threads import over_rows

OFFSET_MM = 0.02  # rays start so far above the surface
_SMOOTHEST = 0.28  # the mirror image of the surroundings is at least so blurred: there are few rays a vertex
_FACE_SAMPLES = 4
_RAYS = 1 << 19  # at a time


@dataclass(frozen=True)
class Surroundings:
    """Per vertex: seen (v, directions) int32, the vertex that each ray meets, -1 = none; toward (directions, 3) unit
    directions about z, cosine-distributed, turned by `spin` (v,) radians; albedo (v, 3); shine (v, 2): roughness, and
    1 for metal; normals (v, 3)."""

    seen: np.ndarray
    toward: np.ndarray
    spin: np.ndarray
    albedo: np.ndarray
    shine: np.ndarray
    normals: np.ndarray


def cosine_directions(count: int) -> np.ndarray:
    """(count, 3) unit directions about z, distributed as the cosine: a sunflower pattern on the disc, lifted."""
    index = np.arange(count) + 0.5
    r, turn = np.sqrt(index / count), index * math.pi * (3.0 - math.sqrt(5.0))
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), np.sqrt(1.0 - r * r)])


def look_around(surface: Surface, tree: RayTree, *, directions: int, seed: int) -> Surroundings:
    """Send rays from every vertex; average the materials about it."""
    count = len(surface.vertices)
    toward = cosine_directions(directions)
    spin = np.random.default_rng(subkey(seed, "turntable directions")).uniform(0.0, 2.0 * math.pi, count)
    seen = np.empty((count, directions), np.int32)
    batch = max(_RAYS // directions, 1)
    for start in range(0, count, batch):
        some = slice(start, min(start + batch, count))
        normals = surface.normals[some]
        rays = np.empty((len(normals), directions, 3))
        over_rows(_spread, len(rays), normals, toward, spin[some], rays)
        origins = np.repeat(surface.vertices[some] + OFFSET_MM * normals, directions, axis=0)
        hits = cast(tree, origins, rays.reshape(-1, 3))
        weights = np.column_stack([1.0 - hits.weights.sum(axis=1), hits.weights])
        corner = surface.triangles[hits.triangle, weights.argmax(axis=1)]
        seen[some] = np.where(hits.triangle >= 0, corner, -1).reshape(-1, directions)
    albedo, shine = _mean_materials(surface, subkey(seed, "turntable paint"))
    return Surroundings(seen, toward, spin, albedo, shine, surface.normals)


@numba.njit(cache=True)
def frame_about(nx, ny, nz):
    """Two unit vectors perpendicular to a unit normal and each other (Duff et al., JCGT 6(1), 2017)."""
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny


@numba.njit(cache=True)
def _turned(toward, d, c, s, n, f):
    """Direction d of the pattern, turned by the angle with cosine c and sine s, in the frame f about the normal n."""
    u, v, w = c * toward[d, 0] - s * toward[d, 1], s * toward[d, 0] + c * toward[d, 1], toward[d, 2]
    return u * f[0] + v * f[3] + w * n[0], u * f[1] + v * f[4] + w * n[1], u * f[2] + v * f[5] + w * n[2]


@numba.njit(cache=True, nogil=True)
def _spread(start, stop, normals, toward, spin, out):
    for p in range(start, stop):
        n = normals[p]
        f = frame_about(n[0], n[1], n[2])
        c, s = math.cos(spin[p]), math.sin(spin[p])
        for d in range(toward.shape[0]):
            out[p, d, 0], out[p, d, 1], out[p, d, 2] = _turned(toward, d, c, s, n, f)


def _mean_materials(surface: Surface, key: int) -> tuple[np.ndarray, np.ndarray]:
    """Albedo (v, 3) and (roughness, share of metal) (v, 2), means over the triangles at each vertex by area."""
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


@numba.njit(cache=True, nogil=True)
def _gather(start, stop, seen, leaving, out):
    share = 1.0 / seen.shape[1]
    for p in range(start, stop):
        r = g = b = 0.0
        for d in range(seen.shape[1]):
            q = seen[p, d]
            if q >= 0:
                r, g, b = r + leaving[q, 0], g + leaving[q, 1], b + leaving[q, 2]
        out[p, 0], out[p, 1], out[p, 2] = r * share, g * share, b * share


def bounced(around: Surroundings, direct: np.ndarray, bounces: int) -> tuple[np.ndarray, np.ndarray]:
    """Indirect irradiance (v, 3), and the radiosity (v, 3) of the vertices under direct (v,) or (v, 3) irradiance.

    `bounces` diffuse reflections: the first by what is lit directly. Facets of metal are taken as dark here.
    """
    direct = np.broadcast_to(direct if np.ndim(direct) == 2 else np.asarray(direct)[:, None], around.albedo.shape)
    indirect = np.zeros(around.albedo.shape)
    for _ in range(bounces):
        leaving, new = around.albedo * (direct + indirect), np.empty_like(indirect)
        over_rows(_gather, len(new), around.seen, leaving, new)
        indirect = new
    return indirect, around.albedo * (direct + indirect)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mirror(start, stop, vertices, normals, seen, toward, spin, shine, radiosity, eye, smoothest, out):
    """Mean radiosity of the surroundings as the facets of each vertex reflect it to the eye (GGX weights)."""
    for p in range(start, stop):
        n = normals[p]
        vx, vy, vz = eye[0] - vertices[p, 0], eye[1] - vertices[p, 1], eye[2] - vertices[p, 2]
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        vx, vy, vz = vx / length, vy / length, vz / length
        out[p, 0] = out[p, 1] = out[p, 2] = 0.0
        if n[0] * vx + n[1] * vy + n[2] * vz <= -0.2:
            continue
        f = frame_about(n[0], n[1], n[2])
        c, s = math.cos(spin[p]), math.sin(spin[p])
        a2 = max(shine[p, 0], smoothest) ** 2
        total = 1e-12
        for d in range(toward.shape[0]):
            lx, ly, lz = _turned(toward, d, c, s, n, f)
            hx, hy, hz = lx + vx, ly + vy, lz + vz
            square = max(hx * hx + hy * hy + hz * hz, 1e-12)
            n_h = n[0] * hx + n[1] * hy + n[2] * hz
            spread = (a2 - 1.0) * n_h * n_h / square + 1.0
            weight = 1.0 / (spread * spread)
            total += weight
            q = seen[p, d]
            if q >= 0:
                for k in range(3):
                    out[p, k] += weight * radiosity[q, k]
        for k in range(3):
            out[p, k] /= total


def mirrored(surface: Surface, around: Surroundings, radiosity: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(v, 3): what facets that reflect all light would show at each vertex towards the eye, of the object itself."""
    out = np.empty(around.albedo.shape)
    over_rows(
        _mirror, len(out), surface.vertices, surface.normals, around.seen, around.toward, around.spin, around.shine,
        radiosity, np.asarray(eye, float), _SMOOTHEST, out,
    )  # fmt: skip
    return out
