"""Costs, screen pictures, films and the figures of an evaluation."""

import json

import numpy as np
import pytest

from nishiki.codec.compact import camera_bytes, chart_bytes, cost_of, lamp_bytes
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import rotation_matrix
from nishiki.render.display import develop, three_channels
from nishiki.render.object.pixels import block_mean, coverage, reduce_blocks
from nishiki.render.object.renderer import places
from nishiki.stages.evaluate.object import (
    AMPLIFIED,
    DECODED,
    INTERPOLATED,
    MODEL,
    compare,
    comparison,
    figures,
    jpeg2000_psnr,
)


def camera(distortion=(0.0,) * 5, *, turned=0.4):
    intrinsics = np.array([[911.0, 0.3, 320.5], [0, 905, 238.25], [0, 0, 1]])
    rotation = rotation_matrix(np.array([0.2, turned, -0.1]))
    return Camera("a", intrinsics, rotation, np.array([0.1, -0.2, 5.0]), 480, 640, distortion)


def square():
    return Mesh.of(np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize(("distortion", "numbers"), [((0.0,) * 5, 11), ((-0.1, 0.02, 1e-3, -1e-3, 0.005), 16)])
def test_cameras_cost_their_numbers(distortion, numbers):
    cameras = [camera(), camera(distortion), camera(turned=3.0)]
    assert camera_bytes(cameras) == 12 + 4 * 3 * numbers


@pytest.mark.slow
def test_charts_cost_by_their_changes():
    order = np.arange(1000)
    one, few = np.zeros(1000, int), np.repeat(np.arange(4), 250)
    many = np.random.default_rng(1).integers(0, 40, 1000)
    assert chart_bytes(one, order) < chart_bytes(few, order) < chart_bytes(many, order)
    assert chart_bytes(one, order) < 40
    assert chart_bytes(np.zeros(0, int), order[:0]) < 10


def test_lamps_cost_their_numbers():
    assert lamp_bytes({"kind": "direction", "vectors": [[0, 0, 1.0]], "harmonics": [], "reference": 0.0}) == 16


def test_costs_add_up():
    cameras = [camera()]
    cost = cost_of(square(), np.zeros(2, np.int32), cameras, {"reference": 0.0}, {"coefficients": 100, "index": 7})
    assert cost.parts["residual_coefficients"] == 100
    assert cost.total == sum(cost.parts.values()) > 107
    assert cost.vertex_shift_px == 0  # corners on whole numbers lie on the grid
    moved = Mesh.of(square().vertices + 0.123456789, square().triangles)
    assert 0 < cost_of(moved, np.zeros(2, np.int32), cameras, {}, {}).vertex_shift_px <= 0.05


def test_coverage_of_half_pixels():
    plain = Camera("p", np.array([[10.0, 0, 19.5], [0, 10, 9.5], [0, 0, 1]]), np.eye(3), np.array([0.0, 0, 2]), 20, 40)
    mesh = Mesh.of(square().vertices * [0.5, 0.5, 1] * [1, -1, 1], square().triangles)  # 5 x 5 pixels
    part = coverage(mesh, plain, samples=4)
    assert np.isclose(part.sum(), 25, atol=0.6)
    assert part.max() == 1
    assert ((part > 0) & (part < 1)).any()


def test_block_means_of_covered_samples_only():
    linear = np.ones((4, 4, 3), np.float32)
    linear[0, 0] = 99
    covered = np.ones((4, 4), bool)
    covered[0, 0] = covered[2:, 2:] = False
    values, part = reduce_blocks(linear, covered, 2)
    np.testing.assert_allclose(part, [[0.75, 1], [1, 0]])
    np.testing.assert_allclose(values, part[..., None] * np.ones(3))
    assert not values[1, 1].any()
    assert block_mean(np.zeros((5, 7, 2), np.float32), 2).shape == (2, 3, 2)


def test_screen_values_are_srgb_over_the_background():
    linear = np.full((1, 3, 3), [0.2145], np.float32)
    covered = np.array([[1.0, 0.0, 0.5]])
    image = develop(linear * covered[..., None], covered, background=0.25)
    assert image.clipped_high == 0
    assert image.pixels[0, 0].tolist() == [128] * 3  # 0.2140 is the linear value of 0.5
    assert image.pixels[0, 1].tolist() == [64] * 3
    bright = develop(linear * 9, np.ones((1, 3)))
    assert (bright.pixels == 255).all()
    assert bright.clipped_high == 1
    assert three_channels(np.ones((2, 2, 5))).shape == (2, 2, 3)


def test_frames_go_once_round_or_there_and_back():
    assert places(3, 2, closed=True) == [(0, 0.0), (0, 0.5), (1, 0.0), (1, 0.5), (2, 0.0), (2, 0.5)]
    back = places(3, 2, closed=False)
    assert back == [(0, 0.0), (0, 0.5), (1, 0.0), (1, 0.5), (1, 1.0), (1, 0.5), (1, 0.0), (0, 0.5)]
    assert places(1, 3, closed=False) == [(0, 0.0)]
    assert places(2, 1, closed=False) == [(0, 0.0), (0, 1.0)]


def rows_of_two_views():
    rng = np.random.default_rng(4)
    photograph = rng.uniform(0.2, 0.8, (40, 40, 3)).astype(np.float32)
    inside = np.zeros((40, 40), bool)
    inside[5:35, 5:35] = True
    covered = inside.copy()
    covered[5, :] = False
    rows = []
    for view, left_out, picture, error in (
        ("0", False, DECODED, 0.01),
        ("0", False, MODEL, 0.1),
        ("1", True, INTERPOLATED, 0.02),
        ("1", True, MODEL, 0.1),
    ):
        rows.append(
            compare(
                photograph + np.float32(error),
                photograph,
                outline=inside,
                covered=covered,
                valid=np.ones_like(inside),
                similarity=True,
                view=view,
                light="",
                left_out=left_out,
                picture=picture,
                against="photograph",
            )
        )
    return rows


def test_figures_keep_captured_and_left_out_views_apart():
    found = figures(rows_of_two_views())
    assert abs(found["captured"]["mean_psnr_db"] - 40) < 1e-3
    assert abs(found["model_alone"]["worst_psnr_db"] - 20) < 1e-3
    assert found["captured"]["uncovered_pixels"] == 30
    assert 0.9 < found["captured"]["mean_similarity"] <= 1
    json.dumps(rows_of_two_views(), allow_nan=False)


def test_comparisons_are_cut_to_the_object():
    y, x = np.mgrid[:50, :60]
    inside = (y - 20) ** 2 + (x - 30) ** 2 < 100
    photograph = np.full((50, 60, 3), 0.5, np.float32)
    rendered = photograph + np.float32(0.02)
    made = comparison(photograph, rendered, photograph, inside, "srgb", 480)
    assert made["photograph"].shape == made["error"].shape == (19, 19, 3)
    assert made["photograph"][9, 9].tolist() == [128] * 3
    assert made["photograph"][0, 0].tolist() == [0] * 3
    assert abs(int(made["error"][9, 9, 0]) - 255 * (0.5 + AMPLIFIED * 0.02)) <= 1
    assert comparison(photograph, rendered, photograph, inside, "srgb", 10)["error"].shape[1] <= 10
    nothing = comparison(photograph, rendered, photograph, np.zeros_like(inside), "linear", 480)
    assert nothing["photograph"].shape == (50, 60, 3)


def test_jpeg_2000_gets_better_with_its_bytes_and_pays_for_no_edge():
    y, x = np.mgrid[:90, :100]
    inside = (y - 40) ** 2 + (x - 50) ** 2 < 900
    waves = 0.5 + 0.2 * np.sin(x / 3)[..., None] * np.cos(y[..., None] / np.array([4, 5, 6]))
    noise = np.random.default_rng(3).normal(0, 0.01, waves.shape)
    photograph = (waves + noise).astype(np.float32)
    found = [jpeg2000_psnr(photograph, inside, size) for size in (600, 1200, 4800)]
    assert found[0] < found[1] - 1 < found[2] - 4
    assert abs(jpeg2000_psnr(np.where(inside[..., None], photograph, 0), inside, 1200) - found[1]) < 1e-6
    assert jpeg2000_psnr(photograph, inside, 20) is None
    assert jpeg2000_psnr(photograph, np.zeros_like(inside), 600) is None
