"""The rasteriser against one ray a pixel, its edge rule, and its extremes."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import interpolate, rasterise


def camera(rows=60, columns=80, *, focal=70.0, distance=4.0, distortion=(0.0,) * 5) -> Camera:
    """Looks along +z at the origin from `distance` away."""
    intrinsics = np.array([[focal, 0.3, columns / 2 - 0.37], [0, focal * 1.05, rows / 2 - 0.21], [0, 0, 1]])
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    return Camera("a", intrinsics, turn, np.array([0.05, -0.02, distance]), rows, columns, distortion)


def bumpy(steps=18, seed=0) -> Mesh:
    """A closed, star-shaped surface with irregular triangles."""
    rng = np.random.default_rng(seed)
    theta, phi = np.meshgrid(np.linspace(0, np.pi, steps), np.arange(2 * steps) * np.pi / steps, indexing="ij")
    directions = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)], axis=-1)
    radius = 1 + 0.15 * rng.random(theta.shape)
    radius[0], radius[-1] = radius[0, 0], radius[-1, 0]
    index = np.arange(theta.size).reshape(theta.shape)
    here, down = index[:-1], index[1:]
    right, across = np.roll(here, -1, axis=1), np.roll(down, -1, axis=1)
    corners = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((here, down, across), (here, across, right))])
    return Mesh.of((directions * radius[..., None]).reshape(-1, 3), corners)


def nearest_by_rays(mesh: Mesh, view: Camera):
    """Reference: every pixel's ray against every triangle (T. Moeller, B. Trumbore, 1997); triangle, weights, depth."""
    row, column = np.mgrid[: view.rows, : view.columns]
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(view.intrinsics).T @ view.rotation
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    found = np.full(len(rays), -1), np.zeros((len(rays), 2)), np.full(len(rays), np.inf)
    clearance = np.full(len(rays), np.inf)
    for index in range(len(a)):
        ab, ac, start = b[index] - a[index], c[index] - a[index], view.centre - a[index]
        across = np.cross(rays, ac)
        volume = across @ ab
        with np.errstate(divide="ignore", invalid="ignore"):
            v = (across @ start) / volume
            w = (rays @ np.cross(start, ab)) / volume
            depth = (np.cross(start, ab) @ ac) / volume
        inside = np.nan_to_num(np.minimum(np.minimum(v, w), 1 - v - w), nan=-1.0)
        clearance = np.minimum(clearance, np.abs(inside))
        hit = (inside >= 0) & (depth > 0) & (depth < found[2])
        found[0][hit], found[2][hit] = index, depth[hit]
        found[1][hit] = np.column_stack([1 - v - w, v])[hit]
    shape = (view.rows, view.columns)
    return found[0].reshape(shape), found[1].reshape(*shape, 2), found[2].reshape(shape), clearance.reshape(shape)


def test_agrees_with_rays():
    mesh, view = bumpy(), camera()
    raster = rasterise(mesh, view)
    triangle, weights, depth, clearance = nearest_by_rays(mesh, view)
    clear = clearance > 1e-9
    assert (triangle >= 0).sum() > 1000
    np.testing.assert_array_equal(raster.triangle[clear], triangle[clear])
    assert clear.mean() > 0.999
    hit = clear & (triangle >= 0)
    np.testing.assert_allclose(raster.barycentric[hit], weights[hit], atol=1e-5)
    np.testing.assert_allclose(raster.depth[hit], depth[hit], rtol=1e-6)
    assert np.isinf(raster.depth[raster.triangle < 0]).all()
    points = interpolate(mesh.vertices, mesh.triangles, raster.triangle, raster.barycentric)
    back, _ = view.project(points[hit])
    np.testing.assert_allclose(back, np.argwhere(hit)[:, ::-1], atol=1e-4)


def test_bands_of_rows_change_nothing():
    mesh, view = bumpy(), camera()
    whole = rasterise(mesh, view)
    for rows in ((0, 17), (17, 60), (33, 33)):
        band = rasterise(mesh, view, rows=rows)
        assert band.first_row == rows[0]
        for name in ("triangle", "barycentric", "depth"):
            np.testing.assert_array_equal(getattr(band, name), getattr(whole, name)[slice(*rows)])
    with pytest.raises(ValueError, match="rows 5 to 61"):
        rasterise(mesh, view, rows=(5, 61))


def flat(points, corners, *, rows=12, columns=12) -> tuple[Mesh, Camera]:
    """Points given in pixels, at depth 1, through an identity camera."""
    view = Camera("flat", np.eye(3), np.eye(3), np.zeros(3), rows, columns)
    vertices = np.column_stack([points, np.ones(len(points))])
    return Mesh(vertices, np.array(corners, np.int32), np.zeros((len(points), 3), np.float32)), view


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_fan_covers_every_pixel_exactly_once(seed, lattice):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(3, 9))
    jitter = 0.2 if count == 3 else 0.3  # neighbours less than half a turn apart: triangles of a fan do not overlap
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-jitter, jitter, count)) / count
    ring = 4.5 + 4 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.vstack([[[4.5, 4.5]], ring])
    if lattice:  # corners on pixel centres: every tie of the edge rule occurs
        points = np.round(points)
    corners = [(0, 1 + k, 1 + (k + 1) % count) for k in range(count)]
    corners = [tuple(np.roll(t, rng.integers(3))[:: rng.choice([-1, 1])]) for t in corners]
    covers = []
    for t in corners:
        mesh, view = flat(points, [t])
        covers.append(rasterise(mesh, view).triangle >= 0)
    together = np.sum(covers, axis=0)
    assert together.max() <= 1
    mesh, view = flat(points, corners)
    np.testing.assert_array_equal(rasterise(mesh, view).triangle >= 0, together == 1)
    row, column = np.mgrid[:12, :12]
    outline = points[1:]
    ahead = np.roll(outline, -1, axis=0) - outline
    side = ahead[:, 0, None, None] * (row - outline[:, 1, None, None]) - ahead[:, 1, None, None] * (
        column - outline[:, 0, None, None]
    )
    assert (together[(side > 1e-9).all(axis=0)] == 1).all()
    assert (together[(side < -1e-9).any(axis=0)] == 0).all() or lattice


def test_two_triangles_of_a_square_share_its_diagonal_once():
    mesh, view = flat(np.array([[1.0, 1], [9, 1], [9, 9], [1, 9]]), [(0, 1, 2), (0, 2, 3)])
    assert (rasterise(mesh, view).triangle >= 0).sum() == 64


def test_useless_triangles_show_nowhere():
    points = np.array([[1.0, 1], [9, 1], [5, 1], [5, 9], [np.nan, 3], [1e300, 2], [-1e300, 1e300]])
    mesh, view = flat(points, [(0, 1, 2), (0, 0, 3), (0, 1, 4)])
    with np.errstate(all="ignore"):
        raster = rasterise(mesh, view)
    assert (raster.triangle == -1).all()
    assert (raster.barycentric == 0).all()
    mesh, view = flat(points, [(0, 1, 5), (0, 5, 6)])
    huge = rasterise(mesh, view)
    assert np.isfinite(huge.barycentric).all()


def test_triangles_at_or_behind_the_camera_show_nowhere():
    points = np.array([[0, 0, 1.0], [5, 0, 1], [0, 5, 0], [0, 5, -1], [0, 5, 1]])
    mesh = Mesh.of(points, np.array([(0, 1, 2), (0, 1, 3), (0, 1, 4)]))
    raster = rasterise(mesh, Camera("a", np.eye(3), np.eye(3), np.zeros(3), 8, 8))
    assert set(np.unique(raster.triangle)) == {-1, 2}


def test_distortion_moves_the_corners():
    view = camera(distortion=(0.2, -0.05, 0.01, -0.02, 0.0))
    mesh = bumpy()
    raster = rasterise(mesh, view)
    points = interpolate(mesh.vertices, mesh.triangles, raster.triangle, raster.barycentric)
    hit = raster.triangle >= 0
    back, _ = view.project(points[hit])
    assert np.abs(back - np.argwhere(hit)[:, ::-1]).max() < 0.2
    straight = rasterise(mesh, camera())
    assert (straight.triangle != raster.triangle).mean() > 0.03


def test_interpolated_pictures_take_little_more_than_their_own_memory():
    rng = np.random.default_rng(0)
    triangle, weights = rng.integers(-1, 50, (800, 800)), np.full((800, 800, 2), 1 / 3, np.float32)
    corners, attributes = rng.integers(0, 30, (50, 3)), rng.normal(size=(30, 3))
    tracemalloc.start()
    values = interpolate(attributes, corners, triangle, weights)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * values.nbytes + (1 << 23)
    expected = np.where((triangle >= 0)[..., None], attributes[corners].mean(axis=1)[triangle], 0)
    np.testing.assert_allclose(values, expected, atol=1e-6)
    assert not interpolate(attributes, corners[:0], np.full((2, 2), -1), weights[:2, :2]).any()
