"""Hollows that no outline shows: found where no matt point fits the photographs, sunk as deep as these agree."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from nishiki.geometry import hollows
from nishiki.geometry.camera import NO_DISTORTION, look_at
from nishiki.geometry.hollows import ShadingPhotographs, contradicted_regions, sink_hollows
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import interpolate, rasterise

RIM = 0.4
OUTSIDE = [(0.0, -0.6), (0.6, -0.6), (0.7, RIM)]


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


def photographed(body, distortion=NO_DISTORTION):
    """A painted matt body under a lamp beside the camera, from all round and above, through this lens."""
    pictures, silhouettes, cameras = [], [], []
    for turn in 2 * np.pi * np.arange(24) / 24:
        eye = 4 * np.array([np.cos(turn) * np.cos(0.7), np.sin(turn) * np.cos(0.7), np.sin(0.7)])
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
    return ShadingPhotographs.of(pictures, silhouettes, cameras)


def depths_of(mesh, scene):
    return np.stack([rasterise(mesh, camera).depth for camera in scene.cameras])


def filled():
    return turned([*OUTSIDE, (0.0, RIM)])


@pytest.mark.slow
def test_a_hollow_sinks_and_the_rest_stays():
    depth = 0.5
    hollow = turned([*OUTSIDE, (0.62, RIM), (0.4, RIM - 0.8 * depth), (0.0, RIM - depth)])
    hull = filled()
    sunk, figures = sink_hollows(hull, hull, photographed(hollow))
    (figure,) = figures
    assert figure["direction"] == pytest.approx([0, 0, -1], abs=0.05)
    assert figure["depth"] == pytest.approx(depth, rel=0.3)
    assert figure["residual"][1] < 0.7 * figure["residual"][0]
    outside = hull.vertices[:, 2] < RIM - 1e-6
    np.testing.assert_allclose(sunk.vertices[outside], hull.vertices[outside], atol=1e-9)
    middle = np.linalg.norm(hull.vertices[:, :2], axis=1) < 0.3
    top = middle & ~outside
    assert sunk.vertices[top, 2].mean() == pytest.approx(RIM - 0.9 * depth, abs=0.15)
    assert (sunk.triangles == hull.triangles).all()


def residual_of_one_point(scene, depths, point, normal, middle):
    """The robust residual of I = b . l by its definition, view by view."""
    centres = np.array([camera.centre for camera in scene.cameras])
    distance = np.linalg.norm(centres - middle, axis=1).mean()
    shown, towards = [], []
    for camera, picture, depth, centre in zip(scene.cameras, scene.pictures, depths, centres, strict=True):
        light = centre - point
        ((column, row),), (away,) = camera.project(point[None])
        i, j = int(row), int(column)
        around = depth[round(row) - 1 : round(row) + 2, round(column) - 1 : round(column) + 2]
        farthest = around[np.isfinite(around)].max(initial=0)
        hidden = away > farthest + 2.5 * distance / np.sqrt(np.linalg.det(camera.intrinsics))
        if light @ normal < hollows.LEAST_COSINE * np.linalg.norm(light) or hidden:
            continue
        corners = picture[i : i + 2, j : j + 2].astype(float)
        across = (1 - (column - j)) * corners[:, 0] + (column - j) * corners[:, 1]
        shown.append((1 - (row - i)) * across[0] + (row - i) * across[1])
        towards.append(light / np.linalg.norm(light) * (distance / np.linalg.norm(light)) ** 2)
    if len(shown) < hollows.FEWEST_VIEWS:
        return -1
    shown, towards = np.array(shown), np.array(towards)
    variance = (hollows.RELATIVE_ERROR * shown.mean(axis=1)) ** 2 + hollows.ERROR**2
    weight = 1 / variance
    for _ in range(3):
        matrix = towards.T @ np.diag(weight) @ towards
        matrix += 1e-3 * np.trace(matrix) * np.eye(3)
        b = np.linalg.solve(matrix, towards.T @ np.diag(weight) @ shown)
        error = ((shown - np.maximum(towards @ b, 0)) ** 2).mean(axis=1) / variance
        weight = 1 / (variance * (1 + error / 4))
    mean = np.minimum(error, hollows.LARGEST).sum() / max(len(shown) - 3, 1)
    return min(mean, hollows.LARGEST)


def test_residuals_against_their_definition():
    hull, scene = filled(), photographed(turned([*OUTSIDE, (0.62, RIM), (0.0, RIM - 0.5)]))
    depths = depths_of(hull, scene)
    values = scene.residuals(depths, hull.vertices, hull.normals)
    middle = hull.vertices.mean(axis=0)
    places = np.arange(0, len(hull.vertices), 37)
    expected = [
        residual_of_one_point(scene, depths, hull.vertices[k], hull.normals[k].astype(float), middle) for k in places
    ]
    assert -1 in expected
    assert len({round(value, 3) for value in expected}) > 20
    np.testing.assert_allclose(values[places], expected, rtol=1e-4, atol=1e-6)


def test_a_mouth_of_more_than_half_of_the_surface_is_contradicted():
    dish = [(0.0, 0.1), (0.75, 0.1), (0.8, RIM)]
    hull, scene = turned([*dish, (0.0, RIM)]), photographed(turned([*dish, (0.72, RIM), (0.5, 0.15), (0.0, 0.15)]))
    values = scene.residuals(depths_of(hull, scene), hull.vertices, hull.normals)
    mouth = (hull.vertices[:, 2] > RIM - 1e-6) & (np.linalg.norm(hull.vertices[:, :2], axis=1) < 0.5)
    assert np.median(values[values >= 0]) > 7
    (candidates,) = contradicted_regions(hull, scene)
    assert all(candidate[mouth].all() for candidate in candidates)
    assert candidates[0].sum() <= candidates[-1].sum()


def test_a_body_that_is_its_hull_stays():
    hull = filled()
    scene = photographed(hull)
    assert contradicted_regions(hull, scene) == []
    sunk, figures = sink_hollows(hull, hull, scene)
    assert figures == []
    assert sunk is hull


def test_what_few_views_see_is_not_judged():
    hull = filled()
    scene = photographed(hull)
    values = scene.residuals(depths_of(hull, scene), hull.vertices, hull.normals)
    below = hull.normals[:, 2] < -0.5
    assert below.any()
    assert (values[below] == -1).all()


def test_the_distortion_of_the_lens_counts():
    """The picture is bent by up to 8 pixels; a projection without the lens contradicts the body where it is right."""
    hull = filled()
    plain = photographed(hull)
    bent = photographed(hull, (-3.0, 2.0, 0.02, -0.01, 0.0))
    shift = [
        np.abs(one.project(hull.vertices)[0] - other.project(hull.vertices)[0]).max()
        for one, other in zip(plain.cameras, bent.cameras, strict=True)
    ]
    assert max(shift) > 6
    expected, values = (scene.residuals(depths_of(hull, scene), hull.vertices, hull.normals) for scene in (plain, bent))
    seen = (expected >= 0) & (values >= 0)
    assert seen.sum() > 0.98 * np.count_nonzero(expected >= 0)
    assert np.median(values[seen]) == pytest.approx(np.median(expected[seen]), rel=0.1)
    assert np.percentile(values[seen], 90) < 1.2 * np.percentile(expected[seen], 90)
    unbent = replace(bent, cameras=plain.cameras)
    straight = unbent.residuals(depths_of(hull, unbent), hull.vertices, hull.normals)
    assert np.median(straight[straight >= 0]) > 10 * np.median(expected[seen])
    assert contradicted_regions(hull, bent) == []
