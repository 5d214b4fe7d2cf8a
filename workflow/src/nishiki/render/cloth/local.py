"""The points behind a picture's samples in the cloth's own frame: where the eye is, where a lamp is, and its shadow."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import face_vectors
from nishiki.geometry.visibility import GOLDEN_ANGLE, Raster, blocked
from nishiki.render.cloth.scene import ClothScene, Lamp
from nishiki.threads import over_rows

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
    place, outgoing = np.empty((count, 3)), np.empty((count, 3))
    frame, back, bent = np.empty((count, 3, 3)), np.empty(count, np.bool_), np.zeros(count, np.bool_)
    mesh, eye = scene.mesh, np.ascontiguousarray(camera.centre)
    corners, normals = np.ascontiguousarray(mesh.triangles), np.ascontiguousarray(mesh.normals, np.float64)
    surface = (mesh.vertices, normals, scene.weft, corners, face_vectors(mesh.vertices, corners))
    points, out = (triangle, weights), (place, frame, outgoing, back, bent)
    if count:
        over_rows(lambda a, b: _frames(surface, points, eye, a, b, out), count)
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
    count = len(samples.pixel)
    incident, strength, before = np.empty((count, 3)), np.empty(count), np.empty(count)
    near = lamp.place is not None
    given = np.asarray(lamp.place if near else lamp.direction, np.float64)
    source = given if near else given / np.linalg.norm(given)
    tree, lift = scene.tree, LIFT * scene.scale
    if count:
        over_rows(
            lambda a, b: _lit(
                (tree.boxes, tree.triangles), (samples.place, samples.frame, samples.number, samples.a_pixel),
                (source, near, lamp.distance, np.tan(lamp.radius)), (2 * scene.scale, lift, shadows), a, b,
                (incident, strength, before),
            ),
            count,
        )  # fmt: skip
    return IncidentLight(incident, strength, before)


@njit(cache=True, nogil=True, error_model="numpy")
def _unit(v):
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if length > 1e-300:
        v /= length
    return length


@njit(cache=True, nogil=True, error_model="numpy")
def _frames(surface, points, eye, first, last, out):
    """See `gather`. The frame is turned to the eye: seen from behind, normal and weft change sign, not the warp."""
    (vertices, normals, wefts, corners, faces), (triangle, weights) = surface, points
    (place, frame, outgoing, back, bent), n, t, view = out, np.empty(3), np.empty(3), np.empty(3)
    for k in range(first, last):
        a, b, c = corners[triangle[k], 0], corners[triangle[k], 1], corners[triangle[k], 2]
        u, v = np.float64(weights[k, 0]), np.float64(weights[k, 1])
        w = 1.0 - u - v
        for m in range(3):
            place[k, m] = u * vertices[a, m] + v * vertices[b, m] + w * vertices[c, m]
            n[m] = u * normals[a, m] + v * normals[b, m] + w * normals[c, m]
            t[m] = u * wefts[a, m] + v * wefts[b, m] + w * wefts[c, m]
            view[m] = eye[m] - place[k, m]
        _unit(view)
        gx, gy, gz = faces[triangle[k], 0], faces[triangle[k], 1], faces[triangle[k], 2]
        if _unit(n) < 1e-9 or n[0] * gx + n[1] * gy + n[2] * gz < 0.0:
            n[0], n[1], n[2] = gx, gy, gz  # normals of the corners that cancel, or turn their back on their triangle
            _unit(n)
        back[k] = gx * view[0] + gy * view[1] + gz * view[2] < 0.0
        side = -1.0 if back[k] else 1.0
        for m in range(3):
            n[m] *= side
            t[m] *= side
        facing = n[0] * view[0] + n[1] * view[1] + n[2] * view[2]
        if facing < LEAST_COSINE:
            for m in range(3):
                n[m] += (LEAST_COSINE - facing) * view[m]
            _unit(n)
            bent[k] = True
        along = t[0] * n[0] + t[1] * n[1] + t[2] * n[2]
        for m in range(3):
            t[m] -= along * n[m]
        if _unit(t) < 1e-9:  # a weft along the normal: any direction across it
            m = 0 if abs(n[0]) < 0.6 else 1
            for axis in range(3):
                t[axis] = (1.0 if axis == m else 0.0) - n[m] * n[axis]
            _unit(t)
        for m in range(3):
            frame[k, 0, m], frame[k, 2, m] = t[m], n[m]
        frame[k, 1, 0] = n[1] * t[2] - n[2] * t[1]
        frame[k, 1, 1] = n[2] * t[0] - n[0] * t[2]
        frame[k, 1, 2] = n[0] * t[1] - n[1] * t[0]
        for m in range(3):
            outgoing[k, m] = frame[k, m, 0] * view[0] + frame[k, m, 1] * view[1] + frame[k, m, 2] * view[2]


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


@njit(cache=True, nogil=True, error_model="numpy")
def disc_point(pixel, index, count):
    """Return the point of the unit disc for sample `index` of the `count` of a pixel.

    A spiral of equal areas, turned at random from pixel to pixel by a hash of its number, so that the samples of each
    pixel cover the disc evenly.
    """
    h = np.uint64(pixel + 1) * np.uint64(0x9E3779B97F4A7C15)
    h ^= h >> np.uint64(32)
    h *= np.uint64(0xD6E8FEB86659FD93)
    h ^= h >> np.uint64(32)
    shift = np.float64(h & np.uint64(0xFFFFFF)) / 16777216.0
    spin = np.float64((h >> np.uint64(24)) & np.uint64(0xFFFFFF)) / 16777216.0
    radius = np.sqrt((index + shift) / count)
    angle = GOLDEN_ANGLE * index + 2.0 * np.pi * spin
    return radius * np.cos(angle), radius * np.sin(angle)


@njit(cache=True, nogil=True, error_model="numpy")
def _lit(tree, samples, lamp, rays, first, last, out):
    """See `lit`. lamp: unit vector or place, near or not, distance, tangent of its angular radius."""
    (boxes, triangles), (place, frame, number, count), (source, near, distance, spread) = tree, samples, lamp
    (far, lift, shadows), (incident, strength, before) = rays, out
    stack = np.empty(64, np.int32)
    d = np.empty(3)
    for k in range(first, last):
        level, reach = 1.0, far
        for m in range(3):
            d[m] = source[m] - place[k, m] if near else source[m]
        if near:
            reach = _unit(d)
            level = (distance / max(reach, 1e-9)) ** 2
        for m in range(3):
            incident[k, m] = frame[k, m, 0] * d[0] + frame[k, m, 1] * d[1] + frame[k, m, 2] * d[2]
        strength[k] = before[k] = level * max(incident[k, 2], 0.0)
        if not shadows or before[k] <= 0.0:
            continue
        x, y = disc_point(number[k] // count, number[k] % count, count)
        radius = spread * (distance / max(reach, 1e-9) if near else 1.0)
        x, y = radius * x, radius * y
        # Two axes across the direction (J. R. Frisvad 2012 in the form without a pole at z = 1).
        sign = 1.0 if d[2] >= 0.0 else -1.0
        p = -1.0 / (sign + d[2])
        q = d[0] * d[1] * p
        rx = d[0] + x * (1.0 + sign * d[0] * d[0] * p) + y * q
        ry = d[1] + x * sign * q + y * (sign + d[1] * d[1] * p)
        rz = d[2] - x * sign * d[0] - y * d[1]
        ox = place[k, 0] + lift * frame[k, 2, 0]
        oy = place[k, 1] + lift * frame[k, 2, 1]
        oz = place[k, 2] + lift * frame[k, 2, 2]
        if blocked((boxes, triangles, stack), (ox, oy, oz), (rx, ry, rz), reach):
            strength[k] = 0.0
