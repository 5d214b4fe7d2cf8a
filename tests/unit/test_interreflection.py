"""Light that a concave object throws on itself: against the closed form of a bowl, and where it is left out."""

from types import SimpleNamespace

import numpy as np
import pytest

from nishiki.photometric.interreflection import form_factors
from nishiki.photometric.solve import estimate_normals
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.normals.parcel import mean_of_channels
from nishiki.stages.normals.run import Thrown, find_thrown_light, read_facets

RIM_DEG = 50.0  # slope of the bowl at its rim
REFLECTANCE = np.array([0.8, 0.6, 0.7])


def bowl(size: int, hollow: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Normals (size, size, 3) of a spherical bowl, or of the dome it is a cast of, and the pixels inside its rim."""
    x = (np.arange(size) - (size - 1) / 2) / (size / 2)
    across, up = np.meshgrid(x, -x)
    sine = np.sin(np.radians(RIM_DEG)) * np.hypot(across, up)
    inside = np.hypot(across, up) < 0.98
    towards = -1 if hollow else 1
    turn = towards * np.sin(np.radians(RIM_DEG))
    normals = np.stack([turn * across, turn * up, np.sqrt(np.maximum(1 - sine**2, 0.1))], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True), inside


def lamps() -> np.ndarray:
    """Directions (17, 3) that reach every place of the bowl: none is lower than its rim is steep."""
    azimuth, rings = np.arange(8) * np.pi / 4, []
    for polar in np.radians([20, 38]):
        rings.append(
            np.stack([np.sin(polar) * np.cos(azimuth + polar), np.sin(polar) * np.sin(azimuth + polar)], axis=1)
        )
    flat = np.concatenate([np.zeros((1, 2)), *rings])
    return np.column_stack([flat, np.sqrt(1 - np.square(flat).sum(axis=1))])


def photographed(size: int, *, hollow: bool = True, level: float = 1.0, white_board: bool = True) -> SimpleNamespace:
    """Photographs of the bowl, in closed form, with the members of `Observations` that are looked at.

    All places of a sphere throw the same share of their light on each other, whatever their distance, so that thrown
    light is even: s rho E / (1 - s rho), E the mean light of the lamp over the bowl and s the bowl's part of a sphere.
    """
    normals, inside = bowl(size, hollow)
    directions = lamps()
    direct = np.maximum(np.einsum("rcx,jx->jrc", normals, directions), 0)[..., None]
    share = (1 - np.cos(np.radians(RIM_DEG))) / 2 if hollow else 0.0
    area = 1 / normals[inside][:, 2]
    even = (direct[:, inside, 0] @ area / area.sum())[:, None, None, None]
    radiance = level * REFLECTANCE * (direct + share * REFLECTANCE * even / (1 - share * REFLECTANCE))
    valid = np.broadcast_to(inside, radiance.shape[:3])
    return SimpleNamespace(
        shape=(size, size),
        channels=("red", "green", "blue"),
        positions_mm=None,
        white_board=white_board,
        directions=directions,
        truth=normals,
        inside=inside,
        values=radiance.astype(np.float32),
        bands=lambda: [slice(0, size // 2), slice(size // 2, size)],
        codes=lambda rows, lights: (radiance[lights, rows], rows.start),
        decode=lambda codes, lights, row: (codes.astype(np.float32), valid[lights, row : row + codes.shape[1]]),
    )


def mean_angle(frames: SimpleNamespace, observations: np.ndarray) -> float:
    """Mean error, degrees, of least-squares normals inside the rim."""
    valid = np.broadcast_to(frames.inside, observations.shape[:3])
    field = estimate_normals(
        mean_of_channels(observations), frames.directions, usable=valid, valid=valid, solver="least_squares"
    )
    cosine = (field.normals * frames.truth).sum(axis=-1)[frames.inside]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


def test_a_bowl_throws_the_part_of_a_sphere_that_it_is_on_itself():
    normals, inside = bowl(40)
    received = form_factors(normals, inside).sum(axis=1)
    expected = (1 - np.cos(np.radians(RIM_DEG))) / 2
    assert np.median(received) == pytest.approx(expected, rel=0.06)
    assert received.std() < 0.12 * expected


def test_form_factors_are_symmetric_by_area():
    normals, inside = bowl(16)
    factors = form_factors(normals, inside).toarray()
    area = 1 / normals[inside][:, 2]
    given = area[:, None] * factors
    assert np.allclose(given, given.T, rtol=1e-3, atol=1e-5 * given.max())


def test_nothing_passes_through_a_wall():
    normals = np.zeros((1, 21, 3))
    normals[0, :, 2] = 1
    normals[0, 5:8] = np.array([-0.97, 0, 0.243])  # up ...
    normals[0, 13:16] = np.array([0.97, 0, 0.243])  # ... and down again: two floors with a block between them
    normals[0, 2:4], normals[0, 17:19] = np.array([0.6, 0, 0.8]), np.array([-0.6, 0, 0.8])
    factors = form_factors(np.repeat(normals, 3, axis=0), np.ones((3, 21), bool)).toarray().reshape(3, 21, 3, 21)
    assert factors[1, 2:4, 1, 5:8].max() > 0  # the slope before the block sees its side
    assert factors[1, 2:4, :, 15:].max() == 0


@pytest.mark.parametrize(("size", "white_board", "level"), [(96, True, 1.0), (40, False, 0.3)])
def test_normals_of_a_bowl_are_right_without_the_light_it_throws(size, white_board, level):
    """Facets of several pixels in the large picture, of one in the small one."""
    frames = photographed(size, white_board=white_board, level=level)
    thrown, decision = find_thrown_light(frames, np.arange(17), NormalsSettings())
    assert decision.measured > 0.05
    direct = thrown.taken_off(frames.values, slice(0, size))
    before, after = mean_angle(frames, frames.values), mean_angle(frames, direct)
    assert before > 2
    assert after < (0.25 if white_board else 0.6) * before
    rows = slice(size // 2 - 8, size // 2 + 3)
    strip = thrown.taken_off(frames.values[:, rows], rows)
    assert np.array_equal(strip, direct[:, rows])  # bands change no byte


def test_a_dome_throws_no_light_on_itself():
    thrown, decision = find_thrown_light(photographed(96, hollow=False), np.arange(17), NormalsSettings())
    assert thrown is None
    assert decision.measured < 1e-3


def test_few_lamps_and_settings_leave_it_out():
    frames = photographed(48)
    assert find_thrown_light(frames, np.arange(6), NormalsSettings())[0] is None
    for chosen in ({"interreflection": "none"}, {"solver": "least_squares"}):
        assert find_thrown_light(frames, np.arange(17), NormalsSettings(**chosen)) == (None, None)


def test_lamps_that_give_no_normals_throw_no_light():
    thrown, decision = find_thrown_light(photographed(48), np.arange(2), NormalsSettings())
    assert thrown is None
    assert decision.measured == 0


def test_a_lamp_without_samples_decides_nothing():
    frames = photographed(32)
    whole = frames.decode

    def decoded(codes: np.ndarray, lights: np.ndarray, row: int) -> tuple[np.ndarray, np.ndarray]:
        values, valid = whole(codes, lights, row)
        return values, valid & (lights != 3)[:, None, None]

    frames.decode = decoded
    assert find_thrown_light(frames, np.arange(17), NormalsSettings())[0] is not None


def test_shares_lie_on_the_middles_of_facets_in_wide_pictures():
    size, shape = 1000, (2500, 40_000)
    ramp = np.arange(40, dtype=np.float32) / 1000
    shares = np.broadcast_to(ramp[:, None], (3, 40, 1))
    edges = [np.append(np.arange(0, n, size), n) for n in shape]
    left = Thrown(shares, tuple(edges)).taken_off(np.ones((1, 4, shape[1], 1), np.float32), slice(1498, 1502))
    middle = 1 - ramp[20]
    assert left[0, :, 20_499:20_501, 0] == pytest.approx(middle, abs=1e-5)
    assert left[0, :, 21_000, 0] == pytest.approx(middle - 0.0005, abs=1e-5)


def test_facets_average_what_is_valid():
    frames = photographed(30)
    facets = read_facets(frames, np.arange(3), 7, NormalsSettings())
    assert facets.observations.shape == (3, 5, 5, 3)
    row, columns = 1 * 7 + 3, slice(14, 21)
    expected = frames.values[:3, row, columns].mean(axis=1)
    assert np.allclose(facets.observations[:, 1, 2], expected, rtol=1e-6)
    assert not facets.valid[:, 0, 0].any()
