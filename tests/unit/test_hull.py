"""The visual hull against analytic silhouettes and a point-by-point reference."""

from dataclasses import astuple

import numpy as np
import pytest
from refusals import refused
from turned_cameras import COLUMNS, ROWS, box, enlarged, sphere, torus, turn

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera
from nishiki.geometry.hull import bounding_box, carve, field_of, signed_distance
from nishiki.geometry.hull_kernels import FAR, at_point
from nishiki.geometry.surface import shape_of


def in_all(points, masks, cameras, misses=0):
    """The obvious reference: points whose nearest pixel is inside in all views but `misses`."""
    out = np.zeros(len(points), int)
    for mask, camera in zip(masks, cameras, strict=True):
        pixels, depth = camera.project(points)
        column, row = np.round(pixels).astype(int).T
        inside = (depth > 0) & (row >= 0) & (column >= 0) & (row < camera.rows) & (column < camera.columns)
        out += ~(inside & mask[row.clip(0, camera.rows - 1), column.clip(0, camera.columns - 1)])
    return out <= misses


@pytest.mark.slow
@pytest.mark.parametrize("body", [sphere, box, torus])
@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.2, 0.05, 0.002, -0.001, 0.0)])
def test_field_agrees_with_points_asked_one_by_one(body, distortion):
    ideal = turn()
    cameras = turn(distortion=distortion)
    # Masks of the bent lens: any masks do, as reference and field look them up through the same camera.
    masks = [body(camera) for camera in ideal]
    points = np.random.default_rng(1).uniform(-1, 1, (20000, 3))
    for misses in (0, 1, 2):
        field = astuple(field_of(masks, cameras))
        value = np.array(
            [
                at_point(field, np.arange(len(field[0])), len(field[0]), tuple(p), misses, FAR, np.empty(misses + 1))
                for p in points
            ]
        )
        expected = in_all(points, masks, cameras, misses)
        pixel = 5.0 / 260
        clear = np.abs(value) > 1.2 * pixel
        assert clear.mean() > 0.8
        assert ((value > 0) == expected)[clear].all()


@pytest.mark.slow
@pytest.mark.parametrize("cells", [24, 50])
@pytest.mark.parametrize("body", [sphere, box])
def test_carved_volume_is_that_of_the_reference(body, cells):
    cameras = turn()
    masks = [body(camera) for camera in cameras]
    finer = [enlarged(camera, 4) for camera in cameras]
    hull = carve(masks, cameras, cells=cells)
    facts = shape_of(hull.mesh)
    assert facts.watertight
    points = np.random.default_rng(2).uniform(hull.box[0], hull.box[1], (200_000, 3))
    inside = in_all(points, [body(camera) for camera in finer], finer)
    volume = inside.mean() * np.prod(hull.box[1] - hull.box[0])
    assert facts.volume == pytest.approx(volume, rel=0.03 if cells == 24 else 0.015)


@pytest.mark.slow
def test_volume_converges_with_the_grid_and_cubes_decided_at_once_change_nothing(monkeypatch):
    cameras = turn()
    masks = [sphere(camera) for camera in cameras]
    volumes = [shape_of(carve(masks, cameras, cells=cells).mesh).volume for cells in (16, 32, 64, 128)]
    steps = np.abs(np.diff(volumes))
    assert steps[1] < steps[0]
    assert steps[2] < steps[1]
    assert steps[2] < 0.005 * volumes[-1]
    quick = carve(masks, cameras, cells=40).mesh
    monkeypatch.setattr("nishiki.geometry.hull.BLOCK", 1)
    slow = carve(masks, cameras, cells=40).mesh
    np.testing.assert_array_equal(quick.triangles.shape, slow.triangles.shape)
    np.testing.assert_allclose(quick.vertices, slow.vertices, atol=1e-6)


def test_many_views_of_a_sphere_give_the_sphere():
    cameras = turn(40, elevation=0.0) + turn(20, elevation=0.9)
    masks = [sphere(camera) for camera in cameras]
    hull = carve(masks, cameras, cells=64)
    distance = np.linalg.norm(hull.mesh.vertices - [0.1, -0.05, 0.08], axis=1)
    # A pixel is 0.019 here; tops and bottoms, which no view sees edge-on, stand out.
    assert np.median(np.abs(distance - 0.7)) < 0.006
    assert distance.min() > 0.7 - 0.02


def test_torus_keeps_its_hole_and_faces_outwards():
    cameras = turn(elevation=0.9)
    hull = carve([torus(camera) for camera in cameras], cameras, cells=60)
    facts = shape_of(hull.mesh)
    assert facts.genus == 1
    assert facts.volume > 0
    middle = hull.mesh.vertices[:, :2].mean(axis=0)
    radius = np.linalg.norm(hull.mesh.vertices[:, :2] - middle, axis=1)
    outer = radius > radius.max() * 0.98
    outwards = np.einsum("ij,ij->i", hull.mesh.normals[outer, :2], hull.mesh.vertices[outer, :2] - middle)
    assert (outwards > 0).all()


@pytest.mark.slow
def test_one_wrong_mask_is_forgiven_where_a_miss_is_allowed():
    cameras = turn()
    masks = [sphere(camera) for camera in cameras]
    whole = shape_of(carve(masks, cameras, cells=40).mesh).volume
    masks[4] = masks[4] & (np.arange(COLUMNS) > COLUMNS / 2)
    assert shape_of(carve(masks, cameras, cells=40).mesh).volume < 0.7 * whole
    forgiven = shape_of(carve(masks, cameras, cells=40, misses=1).mesh)
    assert forgiven.volume == pytest.approx(whole, rel=0.15)
    assert forgiven.volume > whole * 0.98
    masks[8] = masks[8] & (np.arange(ROWS) > ROWS / 2)[:, None]
    assert shape_of(carve(masks, cameras, cells=40, misses=2).mesh).volume > whole * 0.98


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (-0.15, 0.02, 0.001, -0.001, 0.0)])
def test_box_holds_every_point_inside_all_silhouettes(distortion):
    cameras = turn(distortion=distortion)
    masks = [box(camera) for camera in turn()]
    found = bounding_box(masks, cameras)
    points = np.random.default_rng(3).uniform(-1.5, 1.5, (100_000, 3))
    inside = points[in_all(points, masks, cameras)]
    assert (inside >= found[0]).all()
    assert (inside <= found[1]).all()
    assert (np.ptp(inside, axis=0) > 0.8 * (found[1] - found[0])).all()


def test_the_box_that_forgives_a_view_holds_the_boxes_without_each():
    cameras = turn()
    masks = [box(camera) for camera in cameras]
    others = [[k for k in range(len(cameras)) if k != left] for left in range(len(cameras))]
    boxes = np.array([bounding_box([masks[k] for k in each], [cameras[k] for k in each]) for each in others])
    expected = [boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)]
    np.testing.assert_allclose(bounding_box(masks, cameras, misses=1), expected, atol=1e-9)
    assert np.ptp(boxes, axis=0).max() > 1e-3


def test_box_follows_the_unit_and_the_place_of_the_world():
    cameras = turn()
    masks = [box(camera) for camera in cameras]
    found = bounding_box(masks, cameras)
    scale, shift = 1e4, np.array([3e5, -2e5, 1e5])
    moved = [
        Camera(c.name, c.intrinsics, c.rotation, scale * c.translation - c.rotation @ shift, ROWS, COLUMNS)
        for c in cameras
    ]
    np.testing.assert_allclose(bounding_box(masks, moved), scale * found + shift, atol=1e-4 * scale)


def test_silhouette_cut_by_the_picture_does_not_cut_the_body():
    cameras = turn()
    masks = [sphere(camera) for camera in cameras]
    whole = shape_of(carve(masks, cameras, cells=40).mesh).volume
    camera = cameras[3]
    # The same view, photographed with its left half missing.
    cut = COLUMNS // 2
    matrix = camera.intrinsics.copy()
    matrix[0, 2] -= cut
    cameras[3] = Camera("cut", matrix, camera.rotation, camera.translation, ROWS, COLUMNS - cut)
    masks[3] = masks[3][:, cut:]
    assert shape_of(carve(masks, cameras, cells=40).mesh).volume == pytest.approx(whole, rel=0.05)


def test_signed_distance_of_a_half_plane_and_of_masks_without_outline():
    mask = np.zeros((40, 50), bool)
    mask[:, 20:] = True
    expected = np.arange(50) - 19.5
    np.testing.assert_allclose(signed_distance(mask)[:, 4:-4], np.tile(expected[4:-4], (40, 1)), atol=0.06)
    for value in (False, True):
        found = signed_distance(np.full((9, 9), value))
        assert np.isfinite(found).all()
        assert ((found > 0) == value).all()


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_signed_distance_follows_the_cover_of_a_pixel(share):
    cover = np.zeros((40, 50), np.uint8)
    cover[:, 20], cover[:, 21:] = round(255 * share), 255
    expected = np.arange(50) - 20.5 + share
    np.testing.assert_allclose(signed_distance(cover)[:, 4:-4], np.tile(expected[4:-4], (40, 1)), atol=0.2)


def test_a_thin_ring_is_carved_as_thick_as_it_is_from_covers():
    """A ring of 5 pixels: masks of whole pixels make it thinner, since the hull keeps the least of all views."""
    import cv2

    cameras, area = turn(), cv2.INTER_AREA
    closer = [enlarged(camera, 3) for camera in cameras]
    fine = [torus(camera, small=0.045) for camera in closer]
    covers = [np.round(255 * cv2.resize(each.astype(np.float32), (COLUMNS, ROWS), interpolation=area)) for each in fine]
    covers = [cover.astype(np.uint8) for cover in covers]
    whole = [cover > 127 for cover in covers]
    true, found, less = (
        shape_of(carve(masks, views, cells=192).mesh)
        for masks, views in ((fine, closer), (covers, cameras), (whole, cameras))
    )
    assert (true.genus, found.genus) == (1, 1)
    assert found.volume / true.volume == pytest.approx(1.01, abs=0.02)
    assert less.volume / true.volume < 0.96


def test_bad_silhouettes_are_reported():
    cameras = turn(4)
    masks = [sphere(camera) for camera in cameras]
    with refused(UserError, "1", by="_expect_two"):
        field_of([masks[0], None, None, None], cameras)
    with pytest.raises(UserError, match=r"'v2'.*empty"):
        carve([masks[0], masks[1], np.zeros_like(masks[2]), masks[3]], cameras, cells=16)
    with refused(UserError, "120", "160"):
        field_of([masks[0], masks[1][:-1], masks[2], masks[3]], cameras)
    apart = [np.zeros_like(mask) for mask in masks]
    for index, mask in enumerate(apart):
        mask[(5 if index % 2 else 100) :, :][:10, 20:30] = True
    with refused(UserError, by="_solve_extent"):
        carve(apart, cameras, cells=16)


@pytest.mark.slow
@pytest.mark.data
def test_dinosaur_from_its_silhouettes(data):
    import cv2
    from scipy.io import loadmat

    from nishiki.geometry.camera import cameras_of_matrices
    from nishiki.geometry.placement import agreement, outline_of
    from nishiki.geometry.silhouettes import segment

    folder = data / "oxford_dino"
    matrices = loadmat(folder / "dino_Ps.mat")["P"].ravel()
    chosen = range(0, 36, 4)
    half = np.diag([0.5, 0.5, 1.0])
    half[:2, 2] = -0.25  # the centre of the first pixel of half the size lies between two of the old ones
    given = cameras_of_matrices({f"{i:03d}": half @ matrices[i] for i in chosen}, rows=288, columns=360)
    masks = []
    for i in chosen:
        picture = cv2.imread(str(folder / f"viff.{i:03d}.png"))[..., ::-1]
        found = segment(np.ascontiguousarray(cv2.resize(picture, (360, 288), interpolation=cv2.INTER_AREA)))
        assert found.separation > 2
        masks.append(found.mask)
    hull = carve(masks, list(given.cameras), cells=128)
    iou = [agreement(outline_of(hull.mesh, c), mask) for c, mask in zip(given.cameras, masks, strict=True)]
    assert min(iou) > 0.95
    assert np.mean(iou) > 0.97
