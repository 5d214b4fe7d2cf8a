"""The points behind a picture's samples in the cloth's own frame: where the eye is, where a lamp is, and its shadow."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import face_vectors
from nishiki.geometry.visibility import GOLDEN_ANGLE, Raster, cast, frames_about
from nishiki.render.cloth.scene import ClothScene, Lamp

LEAST_COSINE = 0.02
"""Interpolated normals that turn away from the eye are bent back until the eye is this far above the horizon."""
LIFT = 2e-4
"""Shadow rays start this far above the surface, in extents of the scene, so that no triangle shades itself."""


@dataclass(frozen=True)
class Fragments:
    """Points that a picture shows, in the order of the picture."""

    pixel: np.ndarray  # (n,) int64 in the band
    # (n,) int64: that of the pixel in the picture times a_pixel, the samples a pixel has, plus that of the sample in
    # its pixel
    number: np.ndarray
    triangle: np.ndarray  # (n,) int32
    weights: np.ndarray  # (n, 2) float32 of its corners 0 and 1
    material: np.ndarray  # (n,)
    back: np.ndarray  # (n,) bool: seen from behind
    place: np.ndarray  # (n, 3) float64
    frame: np.ndarray  # (n, 3, 3): weft, warp, normal, turned to the eye
    outgoing: np.ndarray  # (n, 3): the eye in this frame
    stands: np.ndarray  # (n,): the sample whose BRDF value serves for this one, itself included
    bent: int  # how many normals were turned
    a_pixel: int


@dataclass(frozen=True)
class IncidentLight:
    """A lamp at n points.

    incident (n, 3) in the cloth's frame; strength (n,): cosine times fall-off times visibility; before (n,): the same
    without shadows.
    """

    incident: np.ndarray
    strength: np.ndarray
    before: np.ndarray


def gather(scene: ClothScene, raster: Raster, camera: Camera, supersampling: int, *, within: float = 0.0) -> Fragments:
    """Gather the points behind a band of a picture's samples and their frames.

    within: radians; samples of a pixel, of one material and side, share a BRDF value with one whose normal and weft are
    this near. 0: each has its own.
    """
    rows, columns = np.nonzero(raster.triangle >= 0)
    triangle = raster.triangle[rows, columns]
    weights = raster.barycentric[rows, columns]
    across = camera.columns // supersampling
    pixel = (rows // supersampling) * across + columns // supersampling
    count, a_pixel = len(triangle), supersampling**2
    place, frame, outgoing, back, bent = _frames(scene, triangle, weights, camera.centre)
    inside = (rows % supersampling) * supersampling + columns % supersampling
    number = ((rows + raster.first_row) // supersampling * np.int64(across) + columns // supersampling) * a_pixel
    number += inside
    material = scene.material[triangle]
    stands = np.arange(count)
    if within > 0 and count:
        groups = pixel * 2 * (int(material.max()) + 1) + 2 * material + back
        _share(np.argsort(groups, kind="stable"), groups, frame, np.cos(within), stands)
    return Fragments(
        pixel, number, triangle, weights, material, back, place, frame, outgoing, stands, int(bent.sum()), a_pixel
    )


def lit(scene: ClothScene, samples: Fragments, lamp: Lamp, shadows: bool) -> IncidentLight:
    """Compute what reaches the samples from a lamp."""
    near, reach, level = lamp.place is not None, np.full(len(samples.pixel), 2 * scene.scale), np.ones(())
    if near:
        towards, reach = _unit(np.asarray(lamp.place, np.float64) - samples.place)
        level = lamp.distance / np.maximum(reach, 1e-9)
    else:
        towards = np.broadcast_to(_unit(np.asarray(lamp.direction, np.float64))[0], samples.place.shape)
    incident = np.einsum("nam,nm->na", samples.frame, towards)
    before = level**2 * np.maximum(incident[:, 2], 0)
    strength = before.copy()
    some = np.flatnonzero(before > 0) if shadows else np.arange(0)
    if len(some):
        number, towards = samples.number[some], towards[some]
        off = disc_point(*np.divmod(number, samples.a_pixel), samples.a_pixel) * np.tan(lamp.radius)
        off *= np.broadcast_to(level, len(strength))[some, None]
        rays = towards + np.einsum("na,nam->nm", off, frames_about(towards))
        origins = samples.place[some] + LIFT * scene.scale * samples.frame[some, 2]
        hits = cast(scene.tree, origins, rays, far=reach[some], any_hit=True)
        strength[some[hits.triangle >= 0]] = 0
    return IncidentLight(incident, strength, before)


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide vectors (..., 3) by their lengths (...); return both."""
    lengths = np.linalg.norm(vectors, axis=-1)
    return vectors / np.maximum(lengths, 1e-300)[..., None], lengths


def _frames(scene: ClothScene, triangle: np.ndarray, weights: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, ...]:
    """See `Fragments`: place, frame, outgoing and back, and which normals were bent.

    The frame is turned to the eye: seen from behind, normal and weft change sign, not the warp.
    """
    mesh, (u, v) = scene.mesh, weights.astype(np.float64).T
    shares, corners = np.stack([u, v, 1 - u - v], axis=1), mesh.triangles[triangle]
    place, n, t = (
        np.einsum("nk,nkm->nm", shares, values[corners]) for values in (mesh.vertices, mesh.normals, scene.weft)
    )
    face, view = face_vectors(mesh.vertices, mesh.triangles)[triangle], _unit(eye - place)[0]
    n, lengths = _unit(n)
    # normals of the corners that cancel, or turn their back on their triangle
    wrong = (lengths < 1e-9) | (np.einsum("nm,nm->n", n, face) < 0)
    n[wrong] = _unit(face[wrong])[0]
    back = np.einsum("nm,nm->n", face, view) < 0
    n[back], t[back] = -n[back], -t[back]
    facing = np.einsum("nm,nm->n", n, view)
    bent = facing < LEAST_COSINE
    n[bent] = _unit(n[bent] + (LEAST_COSINE - facing[bent])[:, None] * view[bent])[0]
    t, lengths = _unit(t - np.einsum("nm,nm->n", t, n)[:, None] * n)
    along = lengths < 1e-9  # a weft along the normal: any direction across it
    t[along] = frames_about(n[along])[:, 0]
    frame = np.stack([t, np.cross(n, t), n], axis=1)
    return place, frame, np.einsum("nam,nm->na", frame, view), back, bent


@njit(cache=True, nogil=True, error_model="numpy")
def _share(order, groups, frame, cosine, stands):
    """Let the first sample of a group stand for those with normal and weft within the cosine, middle ones first."""
    first = 0
    while first < len(order):
        last = first + 1
        while last < len(order) and groups[order[last]] == groups[order[first]]:
            last += 1
        count = last - first
        for step in range(count):
            # from the middle outwards: m, m + 1, m - 1, m + 2, ..
            reach = (step + 1) // 2
            here = order[first + (count // 2 + (reach if step % 2 == 1 else -reach)) % count]
            stands[here] = here
            for before in range(step):
                reach = (before + 1) // 2
                other = order[first + (count // 2 + (reach if before % 2 == 1 else -reach)) % count]
                if stands[other] != other:
                    continue
                normal, weft = 0.0, 0.0
                for m in range(3):
                    normal += frame[here, 2, m] * frame[other, 2, m]
                    weft += frame[here, 0, m] * frame[other, 0, m]
                if normal >= cosine and weft >= cosine:
                    stands[here] = other
                    break
        first = last


def disc_point(pixel: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
    """Return the points (..., 2) of the unit disc for samples `index` of the `count` of pixels (...), int64.

    A spiral of equal areas, turned at random from pixel to pixel by a hash of its number, so that the samples of each
    pixel cover the disc evenly.
    """
    h = (pixel + 1).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
    h = h ^ (h >> np.uint64(32))
    shift, spin = (((h >> np.uint64(bits)) & np.uint64(0xFFFFFF)) / 2.0**24 for bits in (0, 24))
    radius, angle = np.sqrt((index + shift) / count), GOLDEN_ANGLE * index + 2.0 * np.pi * spin
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
