"""From pixels to reflectances: windows, regions seen obliquely, which board, repeats."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nishiki.goniometry.directions import unit
from nishiki.goniometry.readings import (
    TILE,
    ClothPhotograph,
    Regions,
    assign_boards,
    average_repeats,
    axes_of,
    central_window,
    read_all,
    read_window,
    reflectance,
    regions_in_view,
)

NAN = float("nan")


def slow_window(linear, usable):
    """Mean and standard deviation of the mean, tile by tile, pixel by pixel."""
    tiles = {}
    for y in range(linear.shape[0]):
        for x in range(linear.shape[1]):
            if usable[y, x]:
                tiles.setdefault((y // TILE, x // TILE), []).append(linear[y, x].astype(float))
    count = sum(map(len, tiles.values()))
    mean = sum(sum(pixels) for pixels in tiles.values()) / count
    squares = sum((len(p) / count) ** 2 * (sum(p) / len(p) - mean) ** 2 for p in tiles.values())
    return mean, np.sqrt(squares * len(tiles) / (len(tiles) - 1)), count


def test_window_is_the_obvious_mean():
    rng = np.random.default_rng(0)
    linear = rng.uniform(0, 1, (13, 18, 3)).astype(np.float32)
    usable = rng.random((13, 18)) > 0.3
    saturated = rng.random((13, 18)) > 0.9
    found = read_window(linear, usable, saturated)
    mean, noise, count = slow_window(linear, usable)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(found.noise, noise, rtol=1e-12)
    assert found.pixels == count
    assert found.saturated == pytest.approx((saturated & usable).sum() / count)


def test_noise_of_the_mean_is_what_repeats_show():
    """Of independent pixels, and of yarns four pixels wide, for which pixels alone would tell half."""
    rng = np.random.default_rng(1)
    for width in (1, 4):
        means, told = [], []
        for _ in range(300):
            small = rng.standard_normal((32 // width, 32 // width))
            image = 1 + 0.1 * np.kron(small, np.ones((width, width)))[..., None]
            found = read_window(image, np.ones((32, 32), bool), np.zeros((32, 32), bool))
            means.append(found.mean[0])
            told.append(found.noise[0])
        assert np.sqrt(np.mean(np.square(told))) == pytest.approx(np.std(means), rel=0.15)


def test_windows_of_one_pixel_or_none():
    one = np.zeros((5, 5), bool)
    none = read_window(np.ones((5, 5, 2)), one, one)
    assert (none.pixels, none.mean.tolist(), none.noise.tolist()) == (0, [0, 0], [0, 0])
    one[2, 3] = True
    assert read_window(np.ones((5, 5, 2)), one, ~one).mean.tolist() == [1, 1]
    assert central_window((5, 6), 2).sum() == 4
    assert central_window((5, 6), 99).all()
    np.testing.assert_array_equal(np.argwhere(central_window((4, 6), 2)), [[1, 2], [1, 3], [2, 2], [2, 3]])


@given(st.floats(0, 1.5), st.floats(-6, 6), st.sampled_from(["cloth", "arm"]))
def test_picture_axes_are_a_right_handed_frame(theta, phi, upright):
    right, up = axes_of(theta, phi, upright)
    view = unit(theta, phi)
    frame = np.array([right, up, view])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1)
    if upright == "cloth":
        assert up[1] > -1e-12
        assert abs(np.cross(up, view) @ [0, 1, 0]) < 1e-9  # the warp lies in the plane of view and up
    else:
        assert up[2] > -1e-12  # the far side of the cloth is on top
        assert abs(right[2]) < 1e-12


def test_along_the_normal_the_regions_are_as_drawn():
    labels = np.random.default_rng(0).integers(0, 3, (9, 11)).repeat(5, 0).repeat(5, 1)
    seen = regions_in_view(labels, labels.shape, theta_r=0.0, phi_r=2.0, upright="cloth")
    inner = np.array(
        [
            [labels[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] for x in range(labels.shape[1])]
            for y in range(labels.shape[0])
        ],
        dtype=object,
    )
    for y in range(1, 44):
        for x in range(1, 54):
            same = len(np.unique(inner[y, x][[0, 0, 2, 2, 1], [0, 2, 0, 2, 1]])) == 1
            assert seen[y, x] == (labels[y, x] if same else 0)
    assert (seen[0] == 0).all()  # beyond the picture nothing is known


@pytest.mark.slow
@pytest.mark.parametrize("upright", ["cloth", "arm"])
@pytest.mark.parametrize(("theta", "phi"), [(0.5, 0.3), (1.2, 2.1), (1.35, 4.0), (0.9, np.pi / 2), (0.0, 1.0)])
def test_regions_lie_where_rays_meet_the_cloth(theta, phi, upright):
    """Each pixel's ray is followed to the cloth; a blob away from the middle, on a map of another scale."""
    labels = np.zeros((81, 101), np.uint16)
    labels[10:40, 60:95] = 5
    scale, shape = 2.0, (45, 55)
    seen = regions_in_view(labels, shape, theta_r=theta, phi_r=phi, upright=upright, scale=scale)
    right, up = axes_of(theta, phi, upright)
    view = unit(theta, phi)

    def label_at(row, column):
        origin = scale * ((column - 27) * right - (row - 22) * up)
        x, y, z = origin - origin[2] / view[2] * view
        assert abs(z) < 1e-9
        r, c = round(40 - y), round(50 + x)
        return labels[r, c] if 0 <= r < 81 and 0 <= c < 101 else 0

    known = 0
    for row in range(shape[0]):
        for column in range(shape[1]):
            around = {label_at(row + a, column + b) for a, b in ((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))}
            assert seen[row, column] == (around.pop() if len(around) == 1 else 0)
            known += seen[row, column] == 5
    assert known > (30 if theta < 1 else 3)


def test_each_sample_gets_the_board_that_suits_it_best():
    whites = [(0, 0, NAN, NAN), (30, 0, 10, 90), (30, 0, 50, 0), (60, 180, NAN, NAN)]
    samples = [(30, 0, 10, 90), (30, 0, 20, 0), (0, 77, 40, 5), (60, -180, 0, 0), (45, 0, 0, 0), (30, 360, 50.05, 0)]
    found = assign_boards(np.array(samples, float), np.array(whites, float))
    assert [b.rule for b in found] == ["own", "incidence", "incidence", "incidence", "cosine", "own"]
    assert [b.which.tolist() for b in found] == [[1], [1, 2], [0], [3], [0, 1, 2, 3], [2]]
    expected = np.cos(np.radians(45)) / np.cos(np.radians([0, 30, 30, 60]))
    np.testing.assert_allclose(found[4].factors, expected)
    assert (found[1].factors == 1).all()


def test_reflectance_of_a_perfect_white_is_one_over_pi():
    light, noise = np.array([2.0, 0.0]), np.array([0.02, 0.01])
    values, noise = reflectance(light, noise, np.array([2.0, 4.0]), np.array([0.04, 0.0]), np.array([1.0, 0.5]))
    np.testing.assert_allclose(values, [1 / np.pi, 0])
    np.testing.assert_allclose(noise, [np.hypot(0.01, 0.02) / np.pi, 0.01 / 4 * 0.5 / np.pi])
    values, noise = reflectance(np.ones(1), np.ones(1), np.zeros(1), np.ones(1), np.ones(1))
    assert (values[0], noise[0]) == (0, 0)


@given(st.floats(1e-12, 1e12), st.floats(1e-12, 1e12))
def test_reflectance_does_not_depend_on_the_units(light, unit_of_light):
    one = reflectance(np.array([light]), np.array([0.1 * light]), np.array([3.0]), np.array([0.3]), np.array([0.9]))
    other = reflectance(np.array([light * unit_of_light]), np.array([0.1 * light * unit_of_light]),
                        np.array([3.0 * unit_of_light]), np.array([0.3 * unit_of_light]), np.array([0.9]))  # fmt: skip
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_repeats_are_one_measurement_weighted_by_exposure():
    angles = np.array([(0, 0, 30, 0), (0, 90, 30, 360), (0, 0, 0, 45), (0, 0, 30, 0.01), (0, 5, 0, 0)], float)
    values = np.array([[1.0], [4.0], [7.0], [2.0], [9.0]])[:, :, None] * np.ones((1, 2, 1))
    valid = np.array([[1, 1], [1, 0], [1, 0], [1, 1], [1, 0]], bool)
    found = average_repeats(angles, values, 0.1 * values, valid, np.array([1.0, 3.0, 1.0, 1.0, 1.0]))
    np.testing.assert_array_equal(found.rows, [0, 2, 3])
    np.testing.assert_array_equal(found.repeats, [2, 2, 1])
    np.testing.assert_allclose(found.values[..., 0], [[3.25, 1], [8, 0], [2, 2]])
    np.testing.assert_allclose(found.noise[0, 0, 0], np.hypot(0.25 * 0.1, 0.75 * 0.4))
    np.testing.assert_array_equal(found.valid, [[1, 1], [1, 0], [1, 1]])


def photograph(value, *, hot=False, shape=(24, 30)):
    linear = np.broadcast_to(np.asarray(value, np.float32), (*shape, 2))
    return ClothPhotograph(linear, np.full(shape, hot), np.ones(shape, bool))


def test_regions_have_values_of_their_own_and_boards_their_unevenness():
    """Two cloths side by side; the lamp falls off over the picture, and the board shows it where it has the view."""
    labels = np.zeros((24, 30), np.uint16)
    labels[:, :15], labels[:, 15:] = 1, 2
    fall = np.linspace(1, 0.5, 30)[None, :, None] * np.ones((24, 30, 2))
    cloths = np.where(labels[..., None] == 1, 0.2, 0.05)
    samples = np.array([(0.0, 0.0, 0.0, 0.0)])
    shape = {"usable": np.ones((24, 30), bool), "saturated": np.zeros((24, 30), bool)}
    found = read_all(
        lambda i: ClothPhotograph(fall * cloths, **shape),
        lambda i: ClothPhotograph(fall / np.pi, **shape),
        (samples, np.array([(0.0, 0.0, 0.0, 0.0)])),
        white_reflectance=np.array([1.0, 0.5]),
        window_px=4,
        regions=Regions(labels, (1, 2), "cloth", 1.0),
    )
    np.testing.assert_allclose(found.values[0, :, 0], [0.2, 0.05], rtol=1e-6)
    np.testing.assert_allclose(found.values[0, :, 1], [0.1, 0.025], rtol=1e-6)
    assert found.valid.all()
    assert found.rules == {"own": 1, "incidence": 0, "cosine": 0}


def test_saturated_and_dark_readings_are_not_valid():
    angles = np.zeros((4, 4))
    none = np.zeros((24, 30), bool)
    pictures = [photograph([0.2, 0.1]), photograph([0.2, 0.1], hot=True), photograph([0.2, -1e-6])]
    pictures.append(ClothPhotograph(np.ones((24, 30, 2), np.float32), none, none))
    found = read_all(lambda i: pictures[i], lambda i: photograph([0.5, 0.5]), (angles, np.array([(0, 0, NAN, NAN)])),
                     white_reflectance=np.ones(2), window_px=8)  # fmt: skip
    assert found.valid[:, 0].tolist() == [True, False, False, False]
    assert found.pixels[:, 0].tolist() == [64, 64, 64, 0]
    np.testing.assert_allclose(found.values[0, 0], [0.4 / np.pi, 0.2 / np.pi])
    assert (found.values[1:] == 0).all()
    assert found.rules["incidence"] == 4
