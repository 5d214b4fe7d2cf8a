"""Decimation, distances, smoothing and topology of surfaces."""

import numpy as np
import pytest
import trimesh
from turned_cameras import turn

from nishiki.geometry.mesh import Mesh
from nishiki.geometry.surface import (
    decimate,
    distances,
    fewest_triangles,
    pixels_per_unit,
    point_to_triangle,
    sample,
    shape_of,
    smooth_outline_steps,
    snap,
    without_small_parts,
)


def ball(subdivisions=4, radius=1.0):
    found = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh.of(found.vertices, found.faces)


def brute_distance(points, mesh):
    """Distance to the nearest triangle, every point against every triangle."""
    corners = mesh.vertices[mesh.triangles]
    each = [point_to_triangle(np.repeat(p[None], len(corners), 0), corners).min() for p in points]
    return np.array(each)


def test_distance_to_a_triangle_against_a_dense_sampling():
    rng = np.random.default_rng(0)
    for _ in range(30):
        corners = rng.normal(size=(1, 3, 3))
        point = 2 * rng.normal(size=(1, 3))
        dense, _ = sample(Mesh.of(corners[0], np.array([[0, 1, 2]])), 0.01)
        nearest = np.linalg.norm(dense - point, axis=1).min()
        found = point_to_triangle(point, corners)[0]
        assert found <= nearest + 1e-12
        assert found > nearest - 0.1
    line = np.array([[[0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]])
    assert point_to_triangle(np.array([[3.0, 4.0, 0.0]]), line)[0] == pytest.approx(np.hypot(1, 4))


@pytest.mark.parametrize("triangles", [60, 200, 600])
@pytest.mark.parametrize("spacing", [0.05, 0.2, None])
def test_distance_to_a_mesh_is_the_true_one(triangles, spacing):
    mesh = decimate(ball(3), triangles)
    points = np.random.default_rng(1).normal(size=(300, 3))
    points *= (np.random.default_rng(2).uniform(0.97, 1.03, 300) / np.linalg.norm(points, axis=1))[:, None]
    truth = brute_distance(points, mesh)
    found = distances(points, mesh, spacing=spacing)
    assert (found >= truth - 1e-12).all()
    assert (found - truth).max() < 0.001


@pytest.mark.parametrize("share", [0.5, 0.1, 0.02])
def test_decimated_ball_stays_a_ball(share):
    full = ball()
    target = int(share * len(full.triangles))
    mesh = decimate(full, target)
    facts = shape_of(mesh)
    assert target - 2 <= facts.triangles <= target
    assert facts.watertight
    assert facts.genus == 0
    # A regular mesh of n triangles inscribed in a ball misses a share of about 4 pi / (sqrt(3) 2 n) of the radius.
    assert facts.volume == pytest.approx(shape_of(full).volume, rel=2.5 / np.sqrt(facts.triangles) ** 2 * 4)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 20 / facts.triangles
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", normals, mesh.normals) > 0.9).all()


def test_decimation_keeps_topology_corners_and_borders():
    ring = trimesh.creation.torus(1.0, 0.3, major_sections=80, minor_sections=40)
    facts = shape_of(decimate(Mesh.of(ring.vertices, ring.faces), 400))
    assert facts.watertight
    assert facts.genus == 1
    block = trimesh.creation.box((1.0, 2.0, 3.0)).subdivide().subdivide().subdivide()
    light = decimate(Mesh.of(block.vertices, block.faces), 12)
    assert shape_of(light).volume == pytest.approx(6.0, rel=1e-4)
    assert len(light.triangles) == 12
    x, y = np.meshgrid(np.arange(20.0), np.arange(15.0), indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    number = np.arange(300).reshape(20, 15)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    sheet = Mesh.of(grid, np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]))
    light = decimate(sheet, 20)
    assert shape_of(light).area == pytest.approx(19 * 14, rel=1e-6)
    assert (light.normals[:, 2] > 0.999).all()


def test_decimation_is_deterministic_and_leaves_its_input_alone():
    full = ball(3)
    before = full.vertices.copy(), full.triangles.copy()
    first, second = decimate(full, 100), decimate(full, 100)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.triangles, second.triangles)
    np.testing.assert_array_equal(full.vertices, before[0])
    np.testing.assert_array_equal(full.triangles, before[1])
    assert decimate(full, 10**6) is full
    # Nothing below a tetrahedron, and no crash on the way.
    assert shape_of(decimate(full, 0)).watertight


@pytest.mark.parametrize("limit", [0.3, 1.0])
def test_fewest_triangles_keep_the_deviation_that_they_promise(limit):
    cameras, full = turn(6), ball()
    light = fewest_triangles(full, cameras, deviation_px=limit)
    off = brute_distance(full.vertices[::5], light.mesh) * pixels_per_unit(full.vertices[::5], cameras)
    assert np.percentile(off, 99) <= limit * 1.03
    assert light.deviation_px <= limit
    assert light.deviation_largest_px >= light.deviation_px
    assert len(light.mesh.triangles) < 0.5 * len(full.triangles)
    assert light.before == len(full.triangles)
    coarser = decimate(full, int(0.7 * len(light.mesh.triangles)))
    assert np.percentile(distances(full.vertices, coarser) * pixels_per_unit(full.vertices, cameras), 99) > limit


def test_fewest_triangles_keep_a_thin_ring_round():
    """Half a pixel made a prism of a ring 5 pixels thick, .951 of its volume."""
    found = trimesh.creation.torus(0.8, 0.05, major_sections=300, minor_sections=60)
    full, cameras = Mesh.of(found.vertices, found.faces), turn(6)
    light = fewest_triangles(full, cameras, deviation_px=0.5)
    assert shape_of(light.mesh).volume / shape_of(full).volume > 0.97
    assert len(light.mesh.triangles) < 1000


def test_fewest_triangles_with_a_bound_on_their_number_and_without_a_deviation():
    cameras, full = turn(6), ball()
    assert fewest_triangles(full, cameras, deviation_px=0).mesh is full
    most = fewest_triangles(full, cameras, deviation_px=0, most=500)
    assert len(most.mesh.triangles) == 500
    assert most.deviation_px > 0


def test_pixels_per_unit_is_the_shift_seen_in_the_sharpest_view():
    cameras = turn(8)
    points = np.random.default_rng(4).uniform(-0.5, 0.5, (50, 3))
    found = pixels_per_unit(points, cameras)
    shifts = []
    for camera in cameras:
        for axis in camera.rotation[:2]:
            shifts.append(np.linalg.norm(camera.project(points + 1e-6 * axis)[0] - camera.project(points)[0], axis=1))
    np.testing.assert_allclose(found, np.max(shifts, axis=0) / 1e-6, rtol=1e-4)


def test_smoothing_takes_noise_away_within_its_bound():
    cameras, full = turn(6), ball()
    rng = np.random.default_rng(5)
    noisy = Mesh.of(full.vertices * (1 + 0.004 * rng.normal(size=(len(full.vertices), 1))), full.triangles)
    smooth = smooth_outline_steps(noisy, cameras, most_px=5.0)
    before, after = (np.std(np.linalg.norm(m.vertices, axis=1)) for m in (noisy, smooth))
    assert after < 0.5 * before
    assert shape_of(smooth).volume == pytest.approx(shape_of(full).volume, rel=0.01)
    little = smooth_outline_steps(noisy, cameras, most_px=0.1)
    moved = np.linalg.norm(little.vertices - noisy.vertices, axis=1) * pixels_per_unit(noisy.vertices, cameras)
    assert moved.max() <= 0.1 + 1e-9


def test_snapping_drops_what_vanishes():
    mesh = Mesh.of(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1.01, 0, 0], [1.02, 0.01, 0.0]]), np.array([[0, 1, 2], [1, 3, 4]])
    )
    found = snap(mesh, 0.25)
    assert len(found.triangles) == 1
    assert len(found.vertices) == 3
    np.testing.assert_array_equal(found.vertices % 0.25, 0)


def test_small_parts_go_and_large_ones_stay():
    one, two, dust = ball(2), ball(2, 0.4), ball(1, 0.01)
    vertices = np.concatenate([one.vertices, two.vertices + 3, dust.vertices - 3])
    faces = np.concatenate([one.triangles, two.triangles + len(one.vertices)])
    faces = np.concatenate([faces, dust.triangles + len(one.vertices) + len(two.vertices)])
    kept, gone = without_small_parts(Mesh.of(vertices, faces), smallest=0.05)
    assert gone == 1
    assert shape_of(kept).parts == 2
    assert len(kept.triangles) == len(one.triangles) + len(two.triangles)


def test_shape_of_open_and_crowded_meshes():
    sheet = Mesh.of(np.eye(3), np.array([[0, 1, 2]]))
    facts = shape_of(sheet)
    assert (facts.open_edges, facts.watertight, facts.genus, facts.volume) == (3, False, None, None)
    assert facts.area == pytest.approx(np.sqrt(3) / 2)
    fins = Mesh.of(np.random.default_rng(6).normal(size=(5, 3)), np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert shape_of(fins).crowded_edges == 1
