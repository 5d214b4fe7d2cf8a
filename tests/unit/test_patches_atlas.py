"""Atlas and store: every surface point has one place, and what is read there is what the pictures show."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from unit.test_patches_charts import FRONT, UP, around, ball

from nishiki.atlas.atlas import Atlas, build_atlas, pack
from nishiki.atlas.charts import make_charts
from nishiki.atlas.quality import atlas_picture, sampling_density, texels_per_pixel, texels_per_unit
from nishiki.atlas.store import Texels
from nishiki.atlas.surface import (
    nearest_weights,
    object_pixels,
    pixel_places,
    sample_view,
    texel_points,
    texel_triangles,
    touches,
)
from nishiki.atlas.write import Source, TexelsWriter
from nishiki.errors import UserError
from nishiki.formats.stored import channel_bits
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors
from nishiki.geometry.visibility import interpolate, rasterise
from nishiki.stages.texels import OUTPUTS

SIZE = 24


@pytest.fixture(scope="module")
def scene():
    """A bumpy ball, its cameras and its atlas."""
    mesh, cameras = ball(5, noise=0.001), around(8)
    return mesh, cameras, atlas_of(mesh, cameras)


def atlas_of(mesh, cameras, *, size=SIZE, density=1.0) -> Atlas:
    charts = make_charts(mesh, up=UP, front=FRONT, spacing=0.005)
    found = sampling_density(mesh, charts.plane, cameras, percentile=90)
    scale = texels_per_unit(found, charts.plane, charts.chart, texels_per_pixel=density)
    return build_atlas(charts.plane, charts.chart, scale, size=size)


def colour(positions):
    """A smooth colour over space, three channels."""
    x, y, z = np.moveaxis(np.asarray(positions, np.float64), -1, 0)
    return np.stack([0.5 + 0.2 * x + 0.1 * y, 0.4 + 0.2 * z, 0.3 + 0.1 * x * y], axis=-1)


def look_up(grid, s, t):
    """Bilinear, as a renderer does it."""
    top, left = np.minimum(s.astype(int), SIZE - 2), np.minimum(t.astype(int), SIZE - 2)
    u, v = (s - top)[:, None], (t - left)[:, None]
    above = (1 - v) * grid[top, left] + v * grid[top, left + 1]
    return (1 - u) * above + u * ((1 - v) * grid[top + 1, left] + v * grid[top + 1, left + 1])


def test_every_place_leads_back_to_its_point(scene):
    mesh, _, atlas = scene
    rng = np.random.default_rng(1)
    areas = np.linalg.norm(face_vectors(mesh.vertices, mesh.triangles), axis=1)
    triangle = rng.choice(len(areas), 20000, p=areas / areas.sum()).astype(np.int32)
    u, v = np.sort(rng.random((2, 20000)), axis=0)
    barycentric = np.stack([u, v - u], axis=1).astype(np.float32)
    tile, s, t = atlas.locate(triangle, barycentric)
    assert (tile >= 0).all()
    assert min(s.min(), t.min()) >= 0
    assert max(s.max(), t.max()) <= SIZE - 1
    tracemalloc.start()
    many = atlas.locate(np.tile(triangle, 40), np.tile(barycentric, (40, 1)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * sum(values.nbytes for values in many) + (1 << 24)  # the results and a strip of float64 numbers
    np.testing.assert_array_equal(many[1], np.tile(s, 40))
    points = interpolate(mesh.vertices, mesh.triangles, triangle, barycentric)
    triangles = texel_triangles(atlas)
    positions, normals, inside = texel_points(mesh, atlas, triangles, slice(None))
    found = np.empty_like(points)
    for k in np.unique(tile):
        here = tile == k
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            down, right = np.minimum(s[here].astype(int), SIZE - 2), np.minimum(t[here].astype(int), SIZE - 2)
            weight = np.abs(1 - i - (s[here] - down)) * np.abs(1 - j - (t[here] - right))
            assert inside[k, down + i, right + j][weight > 0].all()
        found[here] = look_up(positions[k], s[here], t[here])
    texel = 1 / np.sqrt(atlas.texels_per_unit.prod(axis=1)).mean()
    error = np.linalg.norm(found - points, axis=1) / texel
    assert np.median(error) < 0.02
    assert np.percentile(error, 99) < 0.3
    assert error.max() < 2
    length = np.linalg.norm(normals[inside], axis=-1)
    np.testing.assert_allclose(length, 1, atol=1e-6)
    assert (positions[~inside] == 0).all()


def test_inside_is_what_look_ups_need(scene):
    """Reference: texels within one row and column of densely scattered surface points."""
    _, _, atlas = scene
    rng = np.random.default_rng(2)
    count = 60
    triangle = np.repeat(np.arange(len(atlas.chart), dtype=np.int32), count)
    u, v = np.sort(rng.random((2, len(triangle))), axis=0)
    u[::count], v[::count] = 1, 1  # the corners themselves too
    tile, s, t = atlas.locate(triangle, np.stack([u, v - u], axis=1).astype(np.float32))
    needed = np.zeros((atlas.tiles, SIZE, SIZE), bool)
    down, right = s.astype(int), t.astype(int)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        asked = ((s > down) | (i == 0)) & ((t > right) | (j == 0))
        needed[tile[asked], down[asked] + i, right[asked] + j] = True
    inside = texel_triangles(atlas) >= 0
    assert not (needed & ~inside).any()
    # A shared border belongs to one tile only, but both keep its texels; apart from that little is kept in vain.
    core = inside[:, 1:-1, 1:-1] & ~needed[:, 1:-1, 1:-1]
    assert core.mean() < 0.02
    assert inside.reshape(atlas.tiles, -1).any(axis=1).all()


def test_neighbouring_tiles_share_their_border(scene):
    mesh, _, atlas = scene
    positions, _, inside = texel_points(mesh, atlas, texel_triangles(atlas), slice(None))
    place = {(c, *p): k for k, (c, p) in enumerate(zip(atlas.tile_chart, atlas.tile_place.tolist(), strict=True))}
    met = 0
    for (chart, row, column), k in place.items():
        other = place.get((chart, row, column + 1))
        if other is not None:
            both = inside[k, :, -1] & inside[other, :, 0]
            np.testing.assert_array_equal(inside[k, :, -1], inside[other, :, 0])
            np.testing.assert_allclose(positions[k, :, -1][both], positions[other, :, 0][both], atol=1e-6)
            met += both.sum()
    assert met > 50


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=8, max_size=8))
def test_nearest_point_of_a_triangle(numbers):
    corners, (row, column) = np.array(numbers[:6], np.float32).reshape(3, 2), numbers[6:]
    u, v, square = nearest_weights(corners, row, column)
    corners = corners.astype(float)
    w = 1 - u - v
    assert min(u, v, w) >= -1e-9
    point = u * corners[0] + v * corners[1] + w * corners[2]
    assert np.sum((point - [row, column]) ** 2) == pytest.approx(square, abs=1e-6)
    a, b = np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 41))
    a, b = a[a + b <= 1], b[a + b <= 1]
    every = np.stack([a, b, 1 - a - b], axis=1) @ corners
    assert square <= np.sum((every - [row, column]) ** 2, axis=1).min() + 1e-6


def test_nearest_point_in_a_sliver():
    """Far from the origin of a chart the two products of a narrow triangle's area agree in most digits of float32: with
    weights divided by their difference, points were up to a texel away."""
    rng = np.random.default_rng(0)
    for _ in range(500):
        start, along = rng.uniform(0, 4000, 2), rng.normal(size=2) * rng.uniform(20, 500)
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along) * rng.uniform(0.01, 0.1)
        corners = np.stack([start, start + along, start + rng.uniform(0.2, 0.8) * along + across]).astype(np.float32)
        middle = corners.astype(float).mean(axis=0)
        assert touches(corners, *middle, 1.0, 1.0)
        u, v, square = nearest_weights(corners, *middle)
        assert square < 1e-12
        np.testing.assert_allclose([u, v] @ corners[:2] + (1 - u - v) * corners[2], middle, atol=1e-6)


def test_pixels_by_tile():
    tile = np.array([2, 0, -1, 2, 0], np.int32)
    atlas = SimpleNamespace(tiles=4, locate=lambda *points: (tile, np.arange(5.0), np.arange(5.0)))
    raster = SimpleNamespace(triangle=np.zeros((1, 5), np.int32), barycentric=np.zeros((1, 5, 2)))
    places = pixel_places(atlas, raster, np.ones((1, 5), bool))
    np.testing.assert_array_equal(places.column, [1, 4, 0, 3])
    np.testing.assert_array_equal(places.offsets, [0, 2, 2, 4, 4])


def pictures_of(mesh, camera, raster):
    points = interpolate(mesh.vertices, mesh.triangles, raster.triangle, raster.barycentric)
    return np.where(raster.triangle[..., None] >= 0, colour(points), 0).astype(np.float32)


@pytest.mark.slow
def test_visible_texels_are_those_that_rays_reach(scene):
    """Reference: a ray from each texel's place to the camera, against every triangle."""
    mesh, cameras, atlas = scene
    camera = cameras[1]
    raster = rasterise(mesh, camera)
    usable = object_pixels(mesh, camera, raster, None)
    np.testing.assert_array_equal(usable, raster.triangle >= 0)
    positions, normals, inside = texel_points(mesh, atlas, texel_triangles(atlas), slice(0, None, 6))
    settings = dict(camera=camera, pictures=[pictures_of(mesh, camera, raster)])
    (found,) = sample_view(positions, normals, inside, depth=np.where(usable, raster.depth, np.inf), **settings)
    rng = np.random.default_rng(0)
    chosen = rng.permutation(np.argwhere(inside))[:200]
    points, facing = positions[tuple(chosen.T)].astype(float), normals[tuple(chosen.T)]
    rays = camera.centre - points
    slope = (facing * rays).sum(axis=1) / np.linalg.norm(rays, axis=1)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    free = np.ones(len(points), bool)
    for i, (point, ray) in enumerate(zip(points, rays, strict=True)):
        across = np.cross(ray, c - a)
        volume = (across * (b - a)).sum(axis=1)
        away = np.cross(point - a, b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            v, w = (across * (point - a)).sum(axis=1) / volume, (away @ ray) / volume
            far = ((c - a) * away).sum(axis=1) / volume
        free[i] = not ((v >= 0) & (w >= 0) & (v + w <= 1) & (far > 0.02)).any()
    visible = found.visible[tuple(chosen.T)]
    assert visible.sum() > 40
    assert (free[visible]).all()
    assert visible[free & (slope > 0.4)].mean() > 0.97
    seen = found.visible
    assert np.abs(found.values[seen] - colour(positions[seen])).max() < 0.02
    assert (found.values[~seen] == 0).all()
    (none,) = sample_view(positions, normals, inside, depth=np.full_like(raster.depth, np.inf), **settings)
    assert not none.visible.any()


def write(folder, scene, *, lights=("",), hold_out=()):
    mesh, cameras, atlas = scene
    writer = TexelsWriter(
        folder,
        OUTPUTS,
        mesh,
        atlas,
        cameras,
        Source(lights, ("total",), 3, "linear", True, hold_out),
        stamp={},
    )
    masks = []
    for index, camera in enumerate(cameras):
        view = writer.view(index, None)
        picture = pictures_of(mesh, camera, view.raster)
        valid = np.random.default_rng(index).random(view.shown.shape) > 0.01
        masks.append(valid & view.shown)
        for light in range(len(lights)):
            saturated = ~valid[..., None] & (picture > 0.5) & np.array([False, True, False])
            writer.pictures(view, light, {"total": picture * (1 + light)}, valid, saturated)
    return writer.finish(), masks


@pytest.mark.slow
def test_store_round_trip(scene, tmp_path):
    _, cameras, atlas = scene
    mean, masks = write(tmp_path, scene, lights=("a", "b"), hold_out=("v3",))
    texels = Texels(tmp_path)
    views = len(cameras)
    assert (texels.tiles, texels.size, texels.observations) == (atlas.tiles, SIZE, 2 * views)
    assert texels.components == ("total",)
    assert texels.held_out.tolist() == [k % views == 3 for k in range(2 * views)]
    assert [c.name for c in texels.cameras] == [c.name for c in cameras]
    np.testing.assert_array_equal(texels.atlas.corners, atlas.corners)
    seen_pixels = [np.zeros_like(m) for m in masks]
    errors, bounds = [], 0
    for tile in range(texels.tiles):
        stack, visible = texels.read("total", tile), texels.visible(tile)
        positions, _, inside = texels.geometry(tile)
        assert stack.shape == (2 * views, SIZE, SIZE, 3)
        assert not visible[:, ~inside].any()
        assert not visible[texels.held_out].any()
        saturated = texels.bounds(tile) == channel_bits(3)[1]
        np.testing.assert_array_equal(saturated, texels.bounds(tile) > 0)
        assert not (visible & saturated).any()
        assert (stack[~visible & ~saturated] == 0).all()
        assert not saturated[texels.held_out].any()
        bounds += int(saturated.sum())
        np.testing.assert_allclose(stack[views:], 2 * stack[:views], atol=1e-6)
        truth = np.broadcast_to(colour(positions), stack[:views].shape)
        assert np.abs(stack[:views] - truth)[visible[:views]].max(initial=0) < 0.03
        samples = texels.samples("total", tile)
        for k in range(views):
            here = samples.observation == k
            row, column = samples.row[here], samples.column[here]
            assert not seen_pixels[k][row, column].any()
            seen_pixels[k][row, column] = True
        assert (np.diff(samples.observation) >= 0).all()
        first = samples.observation < views
        predicted = look_up(colour(positions), samples.s[first], samples.t[first])
        errors.append(np.abs(predicted - samples.values[first]).max(axis=1))
    for seen, mask in zip(seen_pixels, masks, strict=True):
        np.testing.assert_array_equal(seen, mask)
    assert bounds > 100
    errors = np.concatenate(errors)
    assert np.percentile(errors, 99) < 0.004
    known = np.isfinite(mean).all(axis=-1)
    assert 0.4 < known.mean() <= 1


def test_reading_in_any_order_gives_the_same(scene, tmp_path):
    write(tmp_path, scene)
    forth, back = Texels(tmp_path), Texels(tmp_path)
    order = range(0, forth.tiles, 9)
    there = [(forth.read("total", k), forth.samples("total", k)) for k in order]
    for (stack, samples), k in zip(there[::-1], list(order)[::-1], strict=True):
        np.testing.assert_array_equal(back.read("total", k), stack)
        again = back.samples("total", k)
        for name in ("observation", "s", "t", "values", "row", "column"):
            np.testing.assert_array_equal(getattr(again, name), getattr(samples, name))


def test_wrong_questions(scene, tmp_path):
    with refused(UserError, "texels.zarr"):
        Texels(tmp_path)
    with pytest.raises(ValueError, match="2 x 2"):
        build_atlas(np.zeros((0, 3, 2)), np.zeros(0, np.int32), np.zeros((0, 2)), size=1)
    nothing = build_atlas(np.zeros((0, 3, 2)), np.zeros(0, np.int32), np.zeros((0, 2)), size=8)
    assert nothing.tiles == 0
    _, _, atlas = scene
    tile, s, t = atlas.locate(np.array([-1], np.int32), np.zeros((1, 2), np.float32))
    assert (tile[0], s[0], t[0]) == (-1, 0, 0)


def test_atlas_file(scene, tmp_path):
    _, _, atlas = scene
    atlas.save(tmp_path / "a.npz")
    again = Atlas.load(tmp_path / "a.npz")
    for name in atlas.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(atlas, name))
    atlas.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_as_many_texels_as_asked(scene):
    mesh, cameras, atlas = scene
    raster = rasterise(mesh, cameras[0])
    dense = atlas_of(mesh, cameras, density=2.0)
    shown = raster.triangle[raster.triangle >= 0]
    one, two = (texels_per_pixel(mesh, a, cameras[0], shown) for a in (atlas, dense))
    assert 0.8 < one < 1.4
    assert two == pytest.approx(2 * one, rel=0.02)


def test_picture_of_the_atlas(scene):
    _, _, atlas = scene
    tiles = np.ones((atlas.tiles, SIZE, SIZE, 3), np.float32)
    picture = atlas_picture(atlas, tiles, width=10**6)
    assert np.isfinite(picture[..., 0]).sum() == atlas.tiles * (SIZE - 1) ** 2
    assert atlas_picture(atlas, tiles, width=100).shape[1] <= 200


def test_no_pixels_outside_the_silhouette(scene):
    mesh, cameras, atlas = scene
    raster = rasterise(mesh, cameras[0])
    silhouette = np.zeros(raster.triangle.shape, bool)
    silhouette[:, :150] = True
    places = pixel_places(atlas, raster, object_pixels(mesh, cameras[0], raster, silhouette))
    assert places.column.max() < 150
    inward = Mesh.of(mesh.vertices, mesh.triangles[:, ::-1])
    assert not object_pixels(inward, cameras[0], rasterise(inward, cameras[0]), None).any()


def test_a_camera_inside_or_beside_the_object_sees_nothing(scene):
    mesh, _, atlas = scene
    beside = Camera("x", np.diag([100.0, 100, 1]), np.eye(3), np.array([50.0, 0, 5]), 20, 20)
    raster = rasterise(mesh, beside)
    assert (raster.triangle < 0).all()
    places = pixel_places(atlas, raster, raster.triangle >= 0)
    assert len(places.row) == 0
    assert places.offsets.tolist() == [0] * (atlas.tiles + 1)


def test_small_charts_share_tiles_but_no_texels():
    mesh, cameras = ball(4, noise=0.03, seed=3), around(6)
    charts = make_charts(mesh, up=UP, front=FRONT, spacing=0.01)
    many = np.ones((charts.chart.max() + 1, 2)) * [[8.0, 6.0]]
    atlas = build_atlas(charts.plane, charts.chart, many, size=32)
    assert 1 <= atlas.tiles <= len(many) / 2
    raster = rasterise(mesh, cameras[0])
    shown = raster.triangle >= 0
    tile, s, t = atlas.locate(raster.triangle[shown], raster.barycentric[shown])
    assert (tile >= 0).all()
    chart, owner = charts.chart[raster.triangle[shown]], {}
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        texels = zip(tile, np.floor(s).astype(int) + i, np.floor(t).astype(int) + j, strict=True)
        for texel, c in zip(texels, chart, strict=True):
            assert owner.setdefault(texel, c) == c


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 20), st.integers(1, 20)), min_size=1, max_size=40))
def test_packed_boxes_are_apart(boxes):
    boxes = np.array(boxes)
    group, origin = pack(boxes, 16)
    tiles = {}
    for k, (rows, columns) in enumerate(boxes):
        if rows > 16 or columns > 16:
            assert (group[k], *origin[k]) == (k, -1, -1)
            continue
        tile = tiles.setdefault(group[k], np.zeros((16, 16), int))
        row, column = origin[k]
        assert tile[row : row + rows, column : column + columns].shape == (rows, columns)
        tile[row : row + rows, column : column + columns] += 1
    assert all(tile.max() == 1 for tile in tiles.values())


def test_channels_from_the_seventh_on_share_a_bit():
    assert channel_bits(1).tolist() == [1]
    assert channel_bits(9).tolist() == [1, 2, 4, 8, 16, 32, 64, 64, 64]
