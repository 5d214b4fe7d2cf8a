"""Painted matt bodies and their photographs from all round."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from nishiki.geometry.camera import NO_DISTORTION, look_at
from nishiki.geometry.hollows import ShadingPhotographs
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import interpolate, rasterise


def turned(profile, spacing=0.036, columns=64):
    """Closed body of revolution about z from points (radius, z) of its profile, axis to axis."""
    corners = np.array(profile)
    rows = [
        a + (b - a) * np.linspace(0, 1, max(2, int(np.linalg.norm(b - a) / spacing)), endpoint=False)[:, None]
        for a, b in pairwise(corners)
    ]
    radius, z = np.concatenate(rows)[1:].T
    angle = 2 * np.pi * np.arange(columns) / columns
    ring = np.stack(
        [np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(z, np.ones(columns))], axis=-1
    )
    vertices = np.concatenate([ring.reshape(-1, 3), [[0, 0, corners[0][1]], [0, 0, corners[-1][1]]]])
    a, b = np.arange(columns), np.roll(np.arange(columns), -1)
    bands = [
        np.concatenate([np.stack([a, b, b + columns], 1), np.stack([a, b + columns, a + columns], 1)]) + k * columns
        for k in range(len(radius) - 1)
    ]
    last = (len(radius) - 1) * columns
    ends = [np.stack([np.full(columns, len(vertices) - 2), b, a], 1)]
    ends.append(np.stack([np.full(columns, len(vertices) - 1), last + a, last + b], 1))
    return Mesh.of(vertices, np.concatenate([*bands, *ends]))


def photographed(body, distortion=NO_DISTORTION, *, elevation=0.7, size_px=100):
    """A painted matt body under a lamp beside the camera, from all round and above (radians), through this lens."""
    pictures, silhouettes, cameras = [], [], []
    for turn in 2 * np.pi * np.arange(24) / 24:
        eye = 4 * np.array([np.cos(turn) * np.cos(elevation), np.sin(turn) * np.cos(elevation), np.sin(elevation)])
        camera = look_at(eye, (0, 0, 0), rows=128, columns=128, field_of_view=0.5, up=(0, 0, 1))
        camera = replace(camera, distortion=distortion)
        raster = rasterise(body, camera)
        points, normals = (
            interpolate(v, body.triangles, raster.triangle, raster.barycentric) for v in (body.vertices, body.normals)
        )
        paint = 0.5 + 0.2 * np.cos(11 * points) + 0.2 * np.cos(17 * points[..., [1, 2, 0]] + 1)
        lamp = eye + 0.2 * camera.rotation[0] - points
        lamp /= np.linalg.norm(lamp, axis=-1, keepdims=True)
        pictures.append((paint * np.maximum((normals * lamp).sum(-1), 0)[..., None]).astype(np.float32))
        silhouettes.append(raster.triangle >= 0)
        pictures[-1][~silhouettes[-1]] = 0
        cameras.append(camera)
    return ShadingPhotographs.of(pictures, silhouettes, cameras, size_px=size_px)
