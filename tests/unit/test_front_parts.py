"""Parts before the rest of an object: cut where photographs show the rest beside them, left alone elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from matt_bodies import photographed, turned

from nishiki.geometry.camera import look_at
from nishiki.geometry.front_parts import edge_distance, find_front_parts, select_border_regions
from nishiki.geometry.hull import VOTES, FrontParts, SilhouetteField, carve
from nishiki.geometry.hull_kernels import cut_slab
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.placement import agreement, outline_of
from nishiki.geometry.surface import shape_of, without_small_parts

DRUM = [(0.0, -0.5), (0.5, -0.5), (0.5, 0.5), (0.0, 0.5)]


def post_and_drum():
    """A painted drum, and before it a post that stands free."""
    post = turned([(0.0, -0.5), (0.07, -0.5), (0.07, 0.4), (0.0, 0.4)])
    drum = turned(DRUM)
    vertices = np.concatenate([drum.vertices, post.vertices + np.array([0.75, 0, 0])])
    return Mesh.of(vertices, np.concatenate([drum.triangles, post.triangles + len(drum.vertices)]))


def widths_of(mesh, height=0.0):
    """Extent across of what stands before x = 0.6, near a height."""
    post = mesh.vertices[(mesh.vertices[:, 0] > 0.6) & (np.abs(mesh.vertices[:, 2] - height) < 0.1)]
    return np.ptp(post[:, 1])


def test_a_post_before_a_drum_becomes_as_thin_as_it_is():
    body = post_and_drum()
    scene = photographed(body, elevation=0.35, size_px=1000)
    hull = carve(list(scene.silhouettes), scene.cameras, cells=96)
    parts = find_front_parts(hull.mesh, scene)
    cut = hull.cut(parts)
    before, after = widths_of(hull.mesh), widths_of(cut.mesh)
    pixel = scene.pixel_at(4.0)
    assert before > 0.14 + 3 * pixel
    assert after == pytest.approx(0.14, abs=2.5 * pixel)
    post = cut.mesh.vertices[(cut.mesh.vertices[:, 0] > 0.6) & (np.abs(cut.mesh.vertices[:, 2]) < 0.1), 1]
    assert 0.5 * (post.min() + post.max()) == pytest.approx(0, abs=0.5 * pixel)
    assert VOTES <= len(parts.cameras) < len(scene.cameras) / 2
    facts = shape_of(without_small_parts(cut.mesh)[0])
    assert (facts.parts, facts.genus) == (2, 0)
    for camera, silhouette in zip(scene.cameras, scene.silhouettes, strict=True):
        assert agreement(outline_of(cut.mesh, camera), silhouette) > 0.97


def test_a_body_without_parts_before_it_stays():
    scene = photographed(turned(DRUM), elevation=0.35, size_px=1000)
    hull = carve(list(scene.silhouettes), scene.cameras, cells=48)
    parts = find_front_parts(hull.mesh, scene)
    assert parts.pixels_beside() == {}
    assert hull.cut(parts) is hull


def test_what_one_view_says_alone_cuts_nothing():
    body = post_and_drum()
    scene = photographed(body, elevation=0.35, size_px=1000)
    hull = carve(list(scene.silhouettes), scene.cameras, cells=48)
    parts = find_front_parts(hull.mesh, scene)
    alone = FrontParts(parts.cameras[:1], parts.distances[:1], parts.depths[:1])
    assert VOTES == 2
    assert hull.cut(alone) is hull


def test_regions_at_the_border_stay_where_they_are_and_specks_go():
    part = np.zeros((20, 20), bool)
    part[3:17, 3:17] = True
    beside = np.zeros_like(part)
    beside[3:17, 3:6] = True
    speckled = beside.copy()
    speckled[10, 12] = True  # a speck
    speckled[8:11, 9:12] = True  # a region within the part
    np.testing.assert_array_equal(select_border_regions(speckled, part), beside)


def test_with_few_views_nothing_is_cut():
    scene = photographed(post_and_drum(), elevation=0.35, size_px=1000)
    few = replace(scene, pictures=scene.pictures[::4], silhouettes=scene.silhouettes[::4], cameras=scene.cameras[::4])
    hull = carve(list(few.silhouettes), few.cameras, cells=48)
    dark = replace(few, pictures=np.zeros_like(few.pictures))
    for shown in (few, dark):
        assert find_front_parts(hull.mesh, shown).pixels_beside() == {}


def test_distance_to_the_edge_against_its_definition():
    part = np.zeros((24, 30), bool)
    part[4:20, 5:25] = True
    beside = part & (np.arange(30) < 9)
    found = edge_distance(beside, part)
    rows, columns = np.indices(part.shape)
    for row, column in ((10, 6), (10, 8), (10, 9), (12, 15)):
        kept, free = ((np.hypot(rows - row, columns - column)[mask]).min() for mask in (part & ~beside, beside))
        expected = 0.5 - kept if beside[row, column] else free - 0.5
        assert found[row, column] == pytest.approx(expected, abs=0.1)


def test_points_are_cut_by_the_second_smallest_distance_before_the_depth():
    """Three views of a cube's grid, each with its own edge: the definition, point by point."""
    eyes = (4, 0, 0), (4, 1, 0), (0, 0.5, 4)
    cameras = [look_at(eye, (0, 0, 0), rows=40, columns=40, field_of_view=0.6) for eye in eyes]
    random = np.random.default_rng(3)
    distances = random.uniform(-4, 4, (3, 40, 40)).astype(np.float32)
    depths = np.full((3, 40, 40), 4.1, np.float32)
    cell, origin, count = 0.05, np.full(3, -0.4), 17
    volume = np.full((count,) * 3, 0.15, np.float32)
    volume[0] = -0.15  # outside the body nothing is cut
    frames, cuts = np.array([[view * 1600, 0, 0, 40, 40, 1, 0] for view in range(3)]), volume.copy()
    field = *SilhouetteField.geometry_of(cameras), frames, distances.ravel()
    cut_slab(field, depths, (tuple(origin), cell), VOTES, 0.15, 0, count, cuts)
    point = np.indices((count,) * 3).reshape(3, -1).T * cell + origin
    values = []
    for camera, distance, depth in zip(cameras, distances, depths, strict=True):
        pixels, away = camera.project(point)
        value = interpolated(distance, pixels) * away / np.sqrt(abs(np.linalg.det(camera.intrinsics)))
        near = np.rint(pixels).astype(int)
        values.append(np.where(away < depth[near[:, 1], near[:, 0]], value, np.inf))
    second = np.sort(values, axis=0)[1].reshape(volume.shape)
    assert (second[1:] < 0).sum() > 100
    assert (second[1:] > 1).any()
    expected = np.where(volume > 0, np.clip(second, -0.15, 0.15), volume)
    np.testing.assert_allclose(cuts, expected, atol=1e-5)


def interpolated(values, pixels):
    column, row = pixels.T
    i, j = row.astype(int), column.astype(int)
    s, t = row - i, column - j
    upper = values[i, j] * (1 - t) + values[i, j + 1] * t
    return upper * (1 - s) + (values[i + 1, j] * (1 - t) + values[i + 1, j + 1] * t) * s
