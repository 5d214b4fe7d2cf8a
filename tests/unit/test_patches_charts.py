"""Charts: connected, flat, without folds or overlaps; adjacency; density."""

import numpy as np
import pytest
import trimesh

from nishiki.atlas.adjacency import across_edges, borders, components, smooth_over_triangles, smoothed_vertices, spread
from nishiki.atlas.atlas import build_atlas
from nishiki.atlas.charts import (
    directions_of,
    flatten,
    frame_along,
    make_charts,
    overlapping,
    probe_spacing,
    turning,
    unit_normals,
)
from nishiki.atlas.quality import sampling_density, stretch_percentiles, texels_per_unit
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh

UP, FRONT = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def ball(subdivisions=4, *, bumps=0.1, noise=0.0, seed=0) -> Mesh:
    """A closed surface: a sphere with bumps and noise on its radius."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    d = sphere.vertices
    radius = 1 + bumps * np.sin(5 * d[:, 0]) * np.sin(5 * d[:, 1]) * np.cos(4 * d[:, 2])
    radius = radius + noise * np.random.default_rng(seed).normal(size=len(d))
    return Mesh.of(d * radius[:, None], sphere.faces)


def around(views=12, *, rows=240, columns=320, distance=6.0, lift=0.3) -> list[Camera]:
    """Cameras on a turn about the y axis, looking at the origin."""
    cameras = []
    for angle in 2 * np.pi * np.arange(views) / views:
        centre = distance * np.array([np.sin(angle), lift, np.cos(angle)]) / np.hypot(1, lift)
        ahead = -centre / distance
        right = np.cross(ahead, UP) / np.linalg.norm(np.cross(ahead, UP))
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        k = np.array([[2.6 * rows, 0, columns / 2], [0, 2.6 * rows, rows / 2], [0, 0, 1]])
        cameras.append(Camera(f"v{len(cameras)}", k, rotation, -rotation @ centre, rows, columns))
    return cameras


def signed_areas(plane):
    one, two = plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 0]
    return (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]) / 2


def covered_twice(plane, chart, spacing) -> int:
    """Reference: points of a grid that lie strictly inside more than one triangle of a chart."""
    worst = 0
    for number in range(chart.max() + 1):
        corners = plane[chart == number]
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        probes = [np.arange(a + 0.37 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
        count = np.zeros((len(probes[0]), len(probes[1])), int)
        for t in corners:
            near = [np.flatnonzero((p > t[:, k].min()) & (p < t[:, k].max())) for k, p in enumerate(probes)]
            if not near[0].size or not near[1].size:
                continue
            y, x = np.meshgrid(probes[0][near[0]], probes[1][near[1]], indexing="ij")
            sides = []
            for k in range(3):
                a, b = t[k], t[(k + 1) % 3]
                sides.append((b[0] - a[0]) * (x - a[1]) - (b[1] - a[1]) * (y - a[0]))
            sides = np.array(sides)
            tolerance = 1e-9 * np.abs(sides).max()
            inside = (sides > tolerance).all(axis=0) | (sides < -tolerance).all(axis=0)
            count[np.ix_(*near)] += inside
        worst += int((count > 1).sum())
    return worst


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "most"), [(0.0, 12), (0.01, 12), (0.06, 60)])
def test_a_closed_surface_gives_few_flat_charts(noise, most):
    mesh = ball(noise=noise)
    charts = make_charts(mesh, up=UP, front=FRONT, spacing=0.01)
    count = charts.chart.max() + 1
    assert 6 <= count <= most
    assert (charts.chart >= 0).all()
    assert (signed_areas(charts.plane) > 0).all()
    assert covered_twice(charts.plane, charts.chart, 0.013) == 0
    neighbours = across_edges(mesh.triangles)
    assert components(charts.chart, neighbours).max() + 1 == count
    frames = charts.frames
    np.testing.assert_allclose(np.cross(frames.direction, frames.down), frames.right, atol=1e-12)


def test_charts_stand_upright():
    frame = frame_along(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0]]), up=UP, front=FRONT)
    np.testing.assert_allclose(frame.down, [[0, -1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(frame.right, [[1, 0, 0], [0, 0, -1], [1, 0, 0], [1, 0, 0]], atol=1e-12)


def test_a_spiral_is_split_where_it_covers_itself():
    """A helical ramp: connected, every triangle looks up, yet two turns lie over each other."""
    angle, radius = np.meshgrid(np.linspace(0, 4.4 * np.pi, 120), np.linspace(0.5, 1, 6), indexing="ij")
    points = np.stack([radius * np.cos(angle), 0.02 * angle, -radius * np.sin(angle)], axis=-1)
    index = np.arange(angle.size).reshape(angle.shape)
    a, b, c, d = (v.ravel() for v in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    mesh = Mesh.of(points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    assert mesh.normals[:, 1].min() > 0.9
    charts = make_charts(mesh, up=UP, front=FRONT, spacing=0.01)
    assert charts.overlapped > 0
    assert 2 <= charts.chart.max() + 1 <= 8
    assert covered_twice(charts.plane, charts.chart, 0.013) == 0


def test_overlaps_are_told_and_touching_is_none():
    square = np.array([[[0.0, 0], [0, 1], [1, 1]], [[0, 0], [1, 1], [1, 0]]])
    over = np.array([[[0.2, 0.1], [0.2, 0.8], [0.7, 0.8]]])
    plane = np.concatenate([square, over])
    neighbours = np.array([[-1, -1, 1], [0, -1, -1], [-1, -1, -1]], np.int32)
    areas = np.abs(signed_areas(plane))
    found = overlapping(plane, np.zeros(3, np.int32), neighbours, areas, spacing=0.05)
    np.testing.assert_array_equal(found, [False, False, True])
    apart = overlapping(plane, np.array([0, 0, 1], np.int32), neighbours, areas, spacing=0.05)
    assert not apart.any()


def test_degenerate_triangles_follow_their_neighbours():
    mesh = ball(3)
    a, b, _ = mesh.triangles[5]
    more = np.concatenate([mesh.triangles, [[a, b, b], [a, a, a]]]).astype(np.int32)
    charts = make_charts(Mesh.of(mesh.vertices, more), up=UP, front=FRONT, spacing=0.02)
    assert charts.degenerate == 2
    assert (charts.chart[:-2] >= 0).all()
    assert charts.chart[-1] == -1


def test_neighbours_across_edges():
    corners = np.array([[0, 1, 2], [2, 1, 3], [3, 1, 4], [1, 4, 5], [4, 1, 6]])
    found = across_edges(corners)
    np.testing.assert_array_equal(found[0], [-1, 1, -1])
    np.testing.assert_array_equal(found[1], [0, 2, -1])
    np.testing.assert_array_equal(found[2], [1, -1, -1])  # the edge 1-4 has three triangles
    closed = across_edges(ball(2).triangles)
    assert (closed >= 0).all()
    for i, row in enumerate(closed):
        assert all(i in closed[j] for j in row)


def test_components_spread_and_borders():
    neighbours = np.array([[1, -1, -1], [0, 2, -1], [1, 3, -1], [2, -1, -1], [-1, -1, -1]], np.int32)
    np.testing.assert_array_equal(components(np.array([7, 7, 2, 7, -1]), neighbours), [0, 0, 1, 2, -1])
    np.testing.assert_array_equal(spread(np.array([4, -1, -1, 9, -1]), neighbours), [4, 4, 9, 9, -1])
    lengths = np.array([[2.0, 1, 1], [2, 3, 1], [3, 5, 1], [5, 1, 1], [1, 1, 1]])
    pairs, common = borders(np.array([0, 0, 1, 2, -1]), neighbours, lengths)
    np.testing.assert_array_equal(pairs, [[0, 1], [1, 0], [1, 2], [2, 1]])
    np.testing.assert_allclose(common, [3, 3, 5, 5])


def test_smoothing():
    neighbours = np.array([[1, -1, -1], [0, -1, -1]], np.int32)
    vectors = smooth_over_triangles(np.array([[1.0, 0, 0], [0, 1, 0]]), np.array([3.0, 4.0]), neighbours, rounds=1)
    np.testing.assert_allclose(vectors, [[0.6, 0.8, 0], [0.6, 0.8, 0]])
    points = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [9, 9, 9]])
    moved = smoothed_vertices(points, np.array([[0, 1, 2]], np.int32), rounds=1)
    np.testing.assert_allclose(moved, [[0.5, 0.5, 0], [1, 0.5, 0], [0.5, 1, 0], [9, 9, 9]])


def test_density_is_that_of_the_pictures():
    """A square of 2 x 1 units parallel to the picture at depth 4, focal lengths 100 and 200: 25 x 50 px a unit."""
    mesh = Mesh.of(np.array([[0.0, 0, 4], [0, 1, 4], [2, 1, 4], [2, 0, 4]]), np.array([[0, 1, 2], [0, 2, 3]]))
    k = np.array([[100.0, 0, 10], [0, 200, 10], [0, 0, 1]])
    near = Camera("near", k, np.eye(3), np.zeros(3), 200, 200)
    far = Camera("far", k, np.eye(3), np.array([0, 0, 4.0]), 200, 200)
    behind = Camera("behind", k, np.diag([-1.0, 1, -1]), np.array([0, 0, 8.0]), 200, 200)
    plane = np.stack([mesh.vertices[mesh.triangles][..., 1], mesh.vertices[mesh.triangles][..., 0]], axis=-1)
    chart = np.zeros(2, np.int32)
    for percentile, scale in ((100, 1.0), (50, 0.5)):
        density = sampling_density(mesh, plane, [near, far, behind], percentile=percentile)
        np.testing.assert_allclose(density.pixels, 1250 * scale**2, rtol=1e-6)
        found = texels_per_unit(density, plane, chart, texels_per_pixel=1.5)
        np.testing.assert_allclose(found, [[75 * scale, 37.5 * scale]], rtol=1e-6)
    unseen = sampling_density(mesh, plane, [behind], percentile=90)
    assert (unseen.pixels == 0).all()


def test_turning_and_spacing():
    cameras = around()
    up, front = turning(cameras)
    np.testing.assert_allclose(up, UP, atol=1e-9)
    np.testing.assert_allclose(front, FRONT, atol=1e-9)
    assert probe_spacing(ball(2), cameras, texels_per_pixel=2.0) == pytest.approx(6 / (2.6 * 240) / 4, rel=0.01)


def test_stretch():
    mesh = Mesh.of(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    plane = -mesh.vertices[mesh.triangles][..., [1, 0]] * [1, -1]
    atlas = build_atlas(plane, np.zeros(2, np.int32), np.array([[30.0, 10.0]]), size=8)
    np.testing.assert_allclose(stretch_percentiles(mesh, atlas), 3.0, rtol=1e-4)


def test_an_atlas_follows_from_its_charts():
    """What a renderer is sent of an atlas is enough to make the same one."""
    mesh, cameras = ball(4, noise=0.03), around(5)
    up, front = turning(cameras)
    charts = make_charts(mesh, up=up, front=front, spacing=0.01)
    assert charts.smoothing_rounds > 0
    density = sampling_density(mesh, charts.plane, cameras, percentile=90)
    scale = texels_per_unit(density, charts.plane, charts.chart, texels_per_pixel=1.0)
    atlas = build_atlas(charts.plane, charts.chart, scale, size=32)
    vertices = smoothed_vertices(mesh.vertices, mesh.triangles, rounds=charts.smoothing_rounds)
    frames = frame_along(directions_of(atlas.chart, *unit_normals(mesh, vertices)), up=up, front=front)
    plane = flatten(vertices[mesh.triangles], atlas.chart, frames)
    again = build_atlas(plane, atlas.chart, atlas.texels_per_unit, size=32)
    for name in atlas.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(atlas, name))
