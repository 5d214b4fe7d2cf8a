"""Every photograph against its prediction from the others: faults are measured, sound sets are silent."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from lit_relief import degrees, dome, photographs

from nishiki.capture.lights import read_lights
from nishiki.formats.problems import error_text
from nishiki.photometric.consistency import LEAST_AMBIENT, examine_photographs, measure_width
from nishiki.photometric.lambert_fit import solve_normals


@pytest.mark.parametrize("options", [{}, {"gloss": 0.5}, {"albedo": (0.01, 0.03)}])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_sound_set_says_nothing(options, seed):
    directions = dome()
    result = examine_photographs(photographs(directions, seed=seed, **options), directions)
    assert (result.failed, result.repeats) == ((), ())
    assert np.abs(result.gain - 1).max() < 0.08
    assert degrees(result.direction, directions).max() < 4
    assert result.ambient < 0.03


def test_gains_are_measured_with_their_errors():
    directions, gains = dome(), np.ones(12)
    gains[[0, 3, 4, 9]] = 2.0, 0.5, 0.5, 2.0
    result = examine_photographs(photographs(directions) * gains[:, None, None], directions)
    np.testing.assert_allclose(result.gain, gains, rtol=0.05)
    assert (result.gain_sigma < 0.05).all()
    assert degrees(result.direction, directions).max() < 4.5


def test_gains_of_a_flat_object_have_large_errors():
    """A tilt of the object and lamps that grow stronger to one side are then the same."""
    directions = dome()
    flat, hilly = (examine_photographs(photographs(directions, steep=s), directions) for s in (0.02, 6.0))
    assert flat.gain_sigma.max() > 8 * hilly.gain_sigma.max()


@pytest.mark.parametrize("room", [0.05, 0.15, 0.3])
@pytest.mark.parametrize("gloss", [0.0, 0.1])
def test_room_light_is_measured(room, gloss):
    directions = dome()
    values = photographs(directions, gloss=gloss)
    colour = np.random.default_rng(1000).uniform(0.2, 0.8, (6, 8)).repeat(10, axis=0).repeat(10, axis=1)
    result = examine_photographs(values + room * colour, directions)
    # the first term of the law leaves 0.83 of the albedo
    assert result.ambient == pytest.approx(room / 0.83, rel=0.15, abs=0.01)
    assert result.ambient > 5 * result.ambient_sigma


@pytest.mark.slow
@pytest.mark.parametrize("rings", [((9, 40), (6, 60), (3, 75)), ((8, 30), (8, 60)), ((12, 45),)])
@pytest.mark.parametrize("steep", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("gloss", [0.0, 0.3])
def test_no_room_light_is_found_on_shallow_reliefs(rings, steep, gloss):
    """Without shadows, an even object under room light and one without look alike."""
    directions = dome(rings)
    result = examine_photographs(photographs(directions, steep=steep, gloss=gloss), directions)
    assert result.ambient <= max(LEAST_AMBIENT, 5 * result.ambient_sigma)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cat", "horse"])
def test_room_light_in_measured_photographs(data, name):
    """A share of their albedo is added to all photographs; that of least squares is .94 of the fitted one."""
    folder = data / f"uw_{name}"
    lights = read_lights(folder / "lights.lp").directions
    mask = cv2.imread(str(folder / f"{name}.mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    files = [str(folder / f"{name}.{j}.png") for j in range(12)]
    values = np.array([cv2.imread(file, cv2.IMREAD_GRAYSCALE) / 255 for file in files])
    values = np.where(mask, values, np.nan)[:, ::3, ::3]
    assert examine_photographs(values, lights).ambient < LEAST_AMBIENT
    albedo = np.linalg.norm(np.einsum("kj,jrc->krc", np.linalg.pinv(lights), values), axis=0)
    for room in (0.15, 0.3):
        result = examine_photographs(values + room * albedo, lights)
        assert result.ambient == pytest.approx(0.94 * room, rel=0.25)
        assert result.ambient > 5 * result.ambient_sigma


def test_pixels_that_few_lamps_light_have_finite_normals():
    lamps = np.array([[0, 0.6, 0.8], [0.6, 0, 0.8], [0, 0, 1]])[:, None]
    lit = np.arange(3)[:, None] < np.arange(4)  # by none, one, two and all of them
    normals, inverses = solve_normals(np.where(lit, 4.0, 0.0), np.full(lit.shape, 0.5), lamps)
    assert np.isfinite(normals).all()
    assert np.isfinite(inverses).all()
    assert (normals[~lit.any(axis=0)] == 0).all()


def test_a_dark_photograph_and_a_repeated_one_are_named():
    directions = dome()
    values = photographs(directions)
    values[5] = 0.001 * values[6]
    values[8] = values[7] + np.random.default_rng(3).normal(0, 1, values[7].shape) * 0.001
    result = examine_photographs(values, directions)
    assert result.failed == (5,)
    assert result.repeats == ((8, 7),)


def test_a_lamp_elsewhere_is_measured():
    directions = dome()
    values = photographs(directions)
    stated = directions.copy()
    stated[2] = directions[9]
    result = examine_photographs(values, stated)
    assert degrees(result.direction[2], directions[2]) < 6
    assert degrees(result.direction[9], directions[9]) < 4


def test_a_photograph_turned_by_half_is_accused_where_the_law_holds():
    directions = dome()
    values = photographs(directions)
    assert examine_photographs(values, directions).find_strangers(directions) == {}
    values[4] = values[4, ::-1, ::-1]
    result = examine_photographs(values, directions)
    assert set(result.find_strangers(directions)) == {4}
    badly = replace(result, residual=result.residual * 0.07 / np.nanmedian(result.residual))
    assert badly.holds(directions)
    assert badly.find_strangers(directions) == {}


@pytest.mark.parametrize(("gloss", "seed"), [(0.3, 0), (0.5, 1)])
def test_strengths_are_not_concluded_from_a_flat_glossy_object(gloss, seed):
    directions = dome(((6, 15), (6, 40), (6, 70)))
    result = examine_photographs(photographs(directions, steep=0.02, gloss=gloss, seed=seed), directions)
    assert np.nanmedian(result.residual) < 0.1
    assert not result.holds(directions)


def test_too_little_to_predict_is_not_judged():
    directions = dome()
    values = photographs(directions)
    assert examine_photographs(values[:3], directions[:3]) is None
    assert examine_photographs(values * np.nan, directions) is None


def test_metal_shows_neither_near_nor_failed_lamps():
    y, x = np.mgrid[-1:1:48j, -1:1:64j]
    motif = np.maximum(np.sin(9 * x + y) * np.cos(8 * y), 0) ** 2  # most of it is flat, as a coin is
    slope = motif * np.sin(5 * x + 3 * y), motif * np.cos(6 * y - 4 * x)
    normal = np.stack([*slope, np.ones_like(x)], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    azimuth, elevation = np.radians(np.arange(24) * 45 + 11), np.radians(np.repeat([30, 50, 70], 8))
    directions = np.column_stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)])
    directions = np.column_stack([directions, np.sin(elevation)])
    halves = np.add(directions, (0, 0, 1))
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    cosines = np.einsum("rcx,jx->jrc", normal, halves)
    values = np.exp(-((1 - cosines**2) / cosines**2) / 0.22**2) / cosines**4  # Beckmann's facets, no diffuse light
    result = examine_photographs(values, directions)
    assert result.gain.min() < 0.1
    assert result.failed == ()
    assert not result.holds(directions)
    near = measure_width(values, directions)
    assert near is None or not near.is_certain
    assert examine_photographs(np.where(np.arange(24) == 5, 1e-4, values.T).T, directions).failed == (5,)


@pytest.mark.parametrize(
    ("sigma", "decimals", "text"),
    [(0.31, 1, "± 0.3"), (0.0004, 3, "± < 0.001"), (0.04, 1, "± < 0.1"), (0.06, 1, "± 0.1"), (0.0, 2, "± < 0.01")],
)
def test_no_error_is_written_as_zero(sigma, decimals, text):
    assert error_text(sigma, decimals) == text
