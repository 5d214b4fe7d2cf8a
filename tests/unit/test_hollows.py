"""Hollows that no outline shows: found where no matt point fits the photographs, sunk as deep as these agree."""

from dataclasses import replace

import numpy as np
import pytest
from matt_bodies import photographed, turned

from nishiki.geometry import hollows
from nishiki.geometry.hollows import Hollow, contradicted_regions, sink_hollows
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import interpolate, rasterise

RIM = 0.4
OUTSIDE = [(0.0, -0.6), (0.6, -0.6), (0.7, RIM)]


def fronts_of(mesh, scene):
    return [rasterise(mesh, camera) for camera in scene.cameras]


def depths_of(mesh, scene):
    return np.stack([front.depth for front in fronts_of(mesh, scene)])


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
    """The contradiction of I = b . l by its definition, view by view."""
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
    variance = (hollows.ERROR * (np.sqrt((shown**2).mean()) + hollows.DARK)) ** 2
    weight = np.ones(len(shown))
    for _ in range(3):
        matrix = towards.T @ np.diag(weight) @ towards
        matrix += 1e-3 * np.trace(matrix) * np.eye(3)
        b = np.linalg.solve(matrix, towards.T @ np.diag(weight) @ shown)
        error = ((shown - np.maximum(towards @ b, 0)) ** 2).mean(axis=1) / variance
        weight = 1 / (1 + 4 * error)
    return min(np.minimum(error, 1).sum() / max(len(shown) - 3, 1), 1)


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
    assert np.median(values[values >= 0]) > 0.5
    regions = contradicted_regions(hull, fronts_of(hull, scene), scene)
    assert any(region[mouth].all() for region in regions)


def test_a_region_is_judged_as_if_the_whole_mesh_were_drawn():
    dish = [*OUTSIDE, (0.62, RIM), (0.4, 0.0), (0.0, -0.1)]
    hull, scene = filled(), photographed(turned(dish))
    fronts = fronts_of(hull, scene)
    layers = [
        (front, rasterise(hull, camera, behind=front.depth))
        for front, camera in zip(fronts, scene.cameras, strict=True)
    ]
    region = contradicted_regions(hull, fronts, scene)[-1]
    hollow = Hollow(hull, region, layers, scene)
    inside, distinct = np.append(region[hull.triangles].all(axis=1), False), set()
    for depth in (0.0, 0.1, hollow.depth):
        sunk = Mesh.of(hull.vertices + hollow.shift(depth), hull.triangles)
        drawn, points, normals = fronts_of(sunk, scene), [], []
        for front, now in list(zip(fronts, drawn, strict=True))[::3]:
            at = np.flatnonzero(inside[front.triangle])[::3]
            triangle, weights = now.triangle.ravel()[at], now.barycentric.reshape(-1, 2)[at]
            for values, out in ((sunk.vertices, points), (sunk.normals, normals)):
                out.append(interpolate(values, sunk.triangles, triangle, weights))
        normal = np.concatenate(normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        values = scene.residuals([front.depth for front in drawn], np.concatenate(points), normal)
        expected = np.where(values < 0, 1, values).mean()
        assert hollow.residual(depth) == pytest.approx(expected, rel=0.05)  # normals of the border
        distinct.add(round(expected, 2))
    assert len(distinct) == 3


def test_a_body_that_is_its_hull_stays():
    hull = filled()
    scene = photographed(hull)
    assert contradicted_regions(hull, fronts_of(hull, scene), scene) == []
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


def test_the_other_views_predict_a_view_left_out():
    body = filled()
    scene = photographed(body)
    seen = np.stack([np.where(np.isfinite(depth), depth, 0) for depth in depths_of(body, scene)]).astype(np.float32)
    place = 7
    front = body.normals @ (scene.cameras[place].centre / 4) > 0.5
    _, predicted = scene.fit(seen, body.vertices[front], body.normals[front], place)
    column, row = np.rint(scene.cameras[place].project(body.vertices[front])[0]).astype(int).T
    error = np.abs(predicted - scene.pictures[place, row, column]).max(axis=1)
    assert np.median(error) < 0.03
    changed = replace(scene, pictures=scene.pictures.copy())
    changed.pictures[place] = 0
    np.testing.assert_array_equal(changed.fit(seen, body.vertices[front], body.normals[front], place)[1], predicted)


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
    assert np.median(straight[straight >= 0]) > 0.5 > 3 * np.median(expected[seen])
    assert contradicted_regions(hull, fronts_of(hull, bent), bent) == []
