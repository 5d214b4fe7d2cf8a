"""Predictions against photographs: classes, PSNR, colour differences, levels, tables."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.brdf.torrance_sparrow import MIRROR, specular
from nishiki.colour.colour import delta_e_2000, illuminant, srgb_encode, white_xyz, xyz_from_spectra, xyz_to_lab
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights
from nishiki.colour.training import synthetic_reflectances
from nishiki.errors import UserError
from nishiki.evaluate.camera_colour import assumed_colour, fitted_colour
from nishiki.evaluate.relighting import (
    DIFFUSE,
    FADGI,
    HIGHLIGHT,
    ISO_19264,
    OUTSIDE,
    SHADOW,
    LightComparison,
    PreviewPair,
    classify,
    difference_of,
    error_figures,
    level_of,
    stated_levels,
    truth_difference,
)
from nishiki.evaluate.tables import COLUMNS, headlines, rows_of
from nishiki.render.plane.scene import Gloss, Light
from nishiki.render.plane.shade import PlaneMaps, cast_shadows
from nishiki.stages.painting_maps import channel_colour, light_of, lower_light, predict_light, spectral_colour


def _sensitivities(count=3):
    centres = np.linspace(610, 450, count)
    return np.exp(-0.5 * ((WAVELENGTHS_NM - centres[:, None]) / 35.0) ** 2)


def test_classes_by_share_and_light():
    diffuse = np.array([0.5, 0.5, 0.5, 0.0, 0.5])
    specular = np.array([0.0, 0.06, 0.06, 0.0, 0.02])
    lit = np.array([1.0, 1.0, 0.2, 1.0, 1.0])
    inside = np.array([True, True, True, True, False])
    assert classify(diffuse, specular, lit, inside=inside).tolist() == [DIFFUSE, HIGHLIGHT, SHADOW, DIFFUSE, OUTSIDE]


def test_class_of_unknown_light_is_shadow_not_diffuse():
    nan = np.array([np.nan])
    assert classify(np.ones(1), np.zeros(1), nan, inside=np.ones(1, bool)).tolist() == [SHADOW]


def _error(predicted, observed):
    """Sums over two pictures (rows, columns, channels), and the map of differences."""
    colour = assumed_colour(predicted.shape[-1])
    classes = np.ones(predicted.shape[:2], np.uint8)
    de00 = np.full(classes.shape, np.nan, np.float32)
    return difference_of(predicted, observed, colour.matrix, colour.white, classes, de00)[1], de00


def test_psnr_known_value_and_bands_add_up():
    predicted, observed = np.full((10, 2, 3), 0.6, np.float32), np.full((10, 2, 3), 0.5, np.float32)
    whole, half = _error(predicted, observed)[0], _error(predicted[:5], observed[:5])[0]
    error = error_figures(whole)
    assert error["psnr_linear_db"] == pytest.approx(20.0, abs=1e-5)
    assert 2 * half == pytest.approx(whole)
    expected = srgb_encode(0.6) - srgb_encode(0.5)
    assert error["psnr_coded_db"] == pytest.approx(-20 * np.log10(expected), abs=1e-5)
    assert error["bias"] == pytest.approx(0.1, rel=1e-6)


def test_psnr_of_nothing_and_of_equal_pictures_is_not_a_number_made_up():
    assert set(error_figures(np.zeros(4)).values()) == {None}
    same = error_figures(_error(np.ones((2, 2, 3)), np.ones((2, 2, 3)))[0])
    assert same["psnr_linear_db"] is None


@given(st.integers(0, 2**32 - 1), st.floats(-6, 3), st.sampled_from([1, 3, 5]))
@settings(deadline=None, max_examples=60)
def test_the_compiled_difference_equals_the_formula_of_arrays(seed, exponent, channels):
    random = np.random.default_rng(seed)
    first, second = (10.0**exponent * random.normal(0.5, 0.5, (2, 4, 6, channels))).astype(np.float32)
    first[0, 0], second[0, 1], first[1, 1] = 0.0, 0.0, second[1, 1]
    sums, de00 = _error(first, second)
    colour = assumed_colour(channels)
    expected = delta_e_2000(colour.lab(first), colour.lab(second))
    assert de00 == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert sums[2] == pytest.approx(np.sum((srgb_encode(first.astype(float)) - srgb_encode(second.astype(float))) ** 2))
    assert sums[1] == pytest.approx(np.sum((first.astype(float) - second) ** 2))


def test_the_difference_is_the_same_for_any_number_of_threads(monkeypatch):
    random = np.random.default_rng(4)
    first, second = random.random((2, 37, 11, 3)).astype(np.float32)
    found = []
    for count in (1, 2, 5):
        monkeypatch.setattr("nishiki.threads.threads", lambda count=count: count)
        found.append(_error(first, second)[0].tobytes())
    assert len(set(found)) == 1


@pytest.mark.parametrize("channels", [1, 3, 6])
def test_fitted_colour_keeps_white_and_beats_no_map(channels):
    lamp = illuminant("A")
    training = synthetic_reflectances(400)
    colour = fitted_colour(training, lamp, _sensitivities(channels))
    assert colour.xyz(np.ones(channels)) == pytest.approx(white_xyz(lamp), abs=1e-12)
    assert colour.lab(np.ones(channels)) == pytest.approx([100, 0, 0], abs=1e-9)
    responses = training @ channel_weights(lamp, _sensitivities(channels)).T
    error = colour.xyz(responses) - xyz_from_spectra(lamp, training)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(colour.rmse)
    assert colour.rmse < {1: 0.2, 3: 0.02, 6: 0.01}[channels]


def test_assumed_colour_says_so():
    assert "guess" in assumed_colour(3).how
    assert assumed_colour(3).lab(np.ones(3)) == pytest.approx([100, 0, 0], abs=1e-9)
    grey = assumed_colour(1)
    assert grey.lab(np.array([[0.18], [1.0]]))[:, 1:] == pytest.approx(0, abs=1e-9)
    with refused(UserError, "0", by="assumed_colour"):
        assumed_colour(0)


def _plane(shape=(6, 8)):
    normals = np.zeros((*shape, 3), np.float32)
    normals[..., 2] = 1
    reflectance = np.random.default_rng(1).random((*shape, 3)).astype(np.float32)
    return normals, reflectance


def test_prediction_of_a_matte_plane_is_lambert():
    normals, reflectance = _plane()
    direction = np.array([0.6, 0.0, 0.8])
    band = predict_light(PlaneMaps(normals, reflectance), Light(direction=tuple(direction)))
    assert band.channels == pytest.approx(0.8 * reflectance, rel=1e-6)
    assert band.specular.max() < 1e-6
    assert (band.lit == 1).all()


def test_prediction_splits_off_the_gloss():
    normals, reflectance = _plane()
    gloss = Gloss(beta=[[2.0]], gamma=[[0.1]], refractive_index=[1.5])
    model = PlaneMaps(normals, reflectance, gloss)
    band = predict_light(model, Light(direction=(0, 0, 1)))
    assert (band.lit == 1).all()
    # at the mirror direction D = G = 1 and F = ((n - 1) / (n + 1))^2
    assert band.specular == pytest.approx(2.0 * 0.04, rel=1e-4)
    assert band.channels == pytest.approx(reflectance + 0.08, rel=1e-4)


def test_prediction_casts_the_shadow_of_a_wall():
    normals, reflectance = _plane()
    height = np.zeros((6, 8), np.float32)
    height[:, 5] = 2.0
    direction = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)  # from the right at 45 degrees: two pixels in shadow
    light = Light(direction=tuple(direction))
    shadows = cast_shadows(height, [light], pitch=1.0)
    band = predict_light(PlaneMaps(normals, reflectance), light, visibility=shadows)
    assert band.lit[2].tolist() == [1, 1, 1, band.lit[2, 3], 0, 1, 1, 1]
    assert (band.channels[:, 4] == 0).all()
    assert band.channels[:, 1] == pytest.approx(reflectance[:, 1] / np.sqrt(2), rel=1e-5)


def test_prediction_of_a_facet_that_faces_away_is_dark():
    normals, reflectance = _plane()
    normals[...] = (0.8, 0.0, 0.6)
    band = predict_light(PlaneMaps(normals, reflectance), Light(direction=(-0.96, 0.0, 0.28)))
    assert (band.channels == 0).all()
    assert (band.lit == 0).all()


@pytest.mark.parametrize("white_board", [True, False])
def test_prediction_of_a_near_lamp_is_pixel_by_pixel(white_board):
    normals, reflectance = _plane()
    normals[...] = np.random.default_rng(3).normal(size=normals.shape) * 0.2 + (0, 0, 1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    position, centre = np.array([10.0, -5.0, 30.0]), np.array([2.0, 1.0, 0.0])
    light = light_of(np.zeros(3), position, centre=centre, white_board=white_board)
    found = predict_light(PlaneMaps(normals, reflectance), light, pitch=0.5)
    for i in range(6):
        for j in range(8):
            place = centre + 0.5 * np.array([j - 3.5, 2.5 - i, 0.0])
            towards = position - place
            distance = np.linalg.norm(towards)
            strength = 1.0 if white_board else position @ position / distance**2
            expected = reflectance[i, j] * max(normals[i, j] @ towards / distance, 0) * strength
            assert found.channels[i, j] == pytest.approx(expected, rel=1e-5)
    assert found.diffuse == pytest.approx(found.channels.mean(axis=-1), rel=1e-5)


def _comparison(observed, predicted, **changes):
    shape = observed.shape[:2]
    options = {
        "usable": np.ones(shape, bool),
        "known": np.ones(shape, bool),
        "inside": np.ones(shape, bool),
        "classes": np.ones(shape, np.uint8),
    } | changes
    comparison = LightComparison.of(shape, assumed_colour(3))
    for start in range(0, shape[0], 4):
        rows = slice(start, start + 4)
        parts = {name: values[rows] for name, values in options.items()}
        comparison.add(rows, predicted[rows], observed[rows], **parts)
    return comparison


@pytest.mark.parametrize("falloff", [False, True])
def test_bands_under_a_near_lamp_are_those_of_the_whole(falloff):
    rng = np.random.default_rng(2)
    normals = rng.normal(0, 0.2, (30, 20, 3)) + np.array([0, 0, 1])
    normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)
    model = PlaneMaps(normals, rng.uniform(0.1, 0.9, normals.shape).astype(np.float32))
    light = Light(position_mm=(4.0, -3.0, 12.0), falloff=falloff, intensity=1.5)
    visibility = rng.uniform(size=(1, 30, 20)).astype(np.float32)
    whole = predict_light(model, light, visibility=visibility, pitch=0.5)
    for rows in (slice(0, 11), slice(11, 30)):
        below = (rows.start + rows.stop - 1) / 2 - 14.5
        maps = model._replace(normals=normals[rows], coefficients=model.coefficients[rows])
        found = predict_light(maps, lower_light(light, 0.5 * below), visibility=visibility[:, rows], pitch=0.5)
        np.testing.assert_allclose(found.channels, whole.channels[rows], rtol=1e-5, atol=1e-7)


def test_comparison_counts_what_it_leaves_out():
    random = np.random.default_rng(2)
    observed = random.random((10, 7, 3)).astype(np.float32)
    predicted = observed + np.float32(0.01)
    usable, known, inside = (np.ones((10, 7), bool) for _ in range(3))
    usable[0, :2], known[1, :3], inside[2, :4] = False, False, False
    usable[2, 0] = False  # outside: not counted again
    predicted[9, 6] = np.nan
    score = _comparison(observed, predicted, usable=usable, known=known, inside=inside).score()
    assert score["excluded"] == {"saturated_or_clipped": 2, "no_estimate": 3, "not_finite": 1}
    assert score["de00"]["count"] == 70 - 4 - 2 - 3 - 1
    assert score["psnr_linear_db"] == pytest.approx(40.0, abs=1e-3)


def test_comparison_against_the_obvious_loop_by_class():
    random = np.random.default_rng(6)
    observed, predicted = random.random((2, 9, 5, 3)).astype(np.float32)
    classes = random.integers(1, 4, (9, 5)).astype(np.uint8)
    comparison = _comparison(observed, predicted, classes=classes)
    score = comparison.score()
    colour = assumed_colour(3)
    for label, name in ((1, "diffuse"), (2, "highlight"), (3, "shadow")):
        pairs = [(predicted[i, j], observed[i, j]) for i in range(9) for j in range(5) if classes[i, j] == label]
        de00 = [float(delta_e_2000(colour.lab(a), colour.lab(b))) for a, b in pairs]
        mse = np.mean([(a.astype(float) - b) ** 2 for a, b in pairs])
        part = score["by_class"][name]
        assert part["de00"]["mean"] == pytest.approx(np.mean(de00), rel=1e-6)
        assert part["psnr_linear_db"] == pytest.approx(-10 * np.log10(mse), rel=1e-9)
    assert comparison.sums[:, 0].sum() == 9 * 5 * 3
    assert score["de00"]["p90"] == pytest.approx(np.percentile(comparison.de00_map, 90), rel=1e-6)


def test_truth_difference_is_that_of_xyz():
    lamp = illuminant("D65")
    white = white_xyz(lamp)
    spectra = synthetic_reflectances(12).reshape(3, 4, 61)
    xyz = xyz_from_spectra(lamp, spectra)
    classes = np.ones((3, 4), np.uint8)
    classes[0, 0] = 0
    total, by_class = truth_difference(xyz, 0.9 * xyz, white, classes=classes)
    expected = delta_e_2000(xyz_to_lab(xyz, white), xyz_to_lab(0.9 * xyz, white))
    assert total.mean == pytest.approx(expected.ravel()[1:].mean(), rel=1e-5)
    assert total.count == 11
    assert by_class["shadow"].mean is None


def test_scene_colour_from_spectra_equals_that_of_the_spectra():
    lamp = illuminant("A")
    random = np.random.default_rng(8)
    basis, coefficients = random.random((4, 61)), random.random((6, 8, 4)).astype(np.float32)
    normals, reflectance = _plane()
    gloss = Gloss(beta=[[1.0]], gamma=[[0.2]], refractive_index=[1.5])
    direction = np.array([0.0, 0.6, 0.8])
    band = predict_light(PlaneMaps(normals, reflectance, gloss), Light(direction=tuple(direction)))
    found = spectral_colour(lamp, basis).xyz(band, coefficients)
    expected = 0.8 * xyz_from_spectra(lamp, coefficients @ basis) + band.specular[..., None] * white_xyz(lamp)
    assert found == pytest.approx(expected, rel=1e-5)
    camera = assumed_colour(3)
    assert channel_colour(camera).xyz(band, None) == pytest.approx(camera.xyz(band.channels), rel=1e-5)


@pytest.mark.parametrize(
    ("mean", "p90", "fadgi", "iso"),
    [
        (1.99, 3.99, "4 stars", "A"),
        (2.0, 3.0, "3 stars", "A"),
        (1.0, 8.0, "2 stars", "A"),
        (4.0, 9.0, "2 stars", "A"),
        (4.01, 9.0, "2 stars", "B"),
        (6.4, 40.0, "1 star", "none"),
        (7.0, 8.0, "none", "none"),
    ],
)
def test_levels_at_their_limits(mean, p90, fadgi, iso):
    parts = [{"de00": {"mean": mean, "p90": p90}, "lights": []}]
    assert stated_levels(parts) == {"fadgi": fadgi, "iso_19264": iso}


@pytest.mark.parametrize("parts", [[], [{"de00": {"mean": None, "p90": None}, "lights": []}]])
def test_without_a_measurement_no_level_is_stated_and_none_is_missed(parts):
    stated = stated_levels(parts)
    assert stated.keys() == {"fadgi", "iso_19264"}
    assert not {level.name for level in (*FADGI, *ISO_19264)} & set(stated.values())
    assert "none" not in stated.values()


def test_levels_never_improve_with_the_error():
    for scheme in (FADGI, ISO_19264):
        names = [level.name for level in scheme] + ["none"]
        ranks = [names.index(level_of(mean, 2 * mean, scheme)) for mean in np.linspace(0, 8, 200)]
        assert ranks == sorted(ranks)


def _evaluation():
    random = np.random.default_rng(9)
    observed, predicted = random.random((2, 4, 5, 3)).astype(np.float32)
    score = _comparison(observed, predicted).score()
    light = {"name": "east", "index": 3, "role": "check", **score}
    empty = {"count": 0, "mean": None, "median": None, "p90": None, "worst": None, "dropped": 0}
    normals = {name: empty for name in ("inside", "estimated", "unflagged", "flagged")} | {"by_slope": []}
    return {"lights": [light], "overall": {"de00": score["de00"], "levels": stated_levels([])}, "normals": normals}


def test_table_has_a_row_for_every_figure_and_empty_values_stay_empty():
    rows = rows_of(_evaluation())
    assert all(tuple(row) == COLUMNS for row in rows)
    of_light = [row for row in rows if row["subject"] == "light east"]
    assert {row["pixels_of"] for row in of_light} == {"all", "diffuse", "highlight", "shadow"}
    assert all(row["value"] == "" for row in rows if row["subject"] == "normals")


def test_headlines_name_each_light():
    found = headlines(_evaluation())
    assert found["relighting_psnr_db"].keys() == {"east"}
    assert found["normals_mean_deg"] is None


def test_preview_is_the_block_mean_in_linear_light():
    random = np.random.default_rng(11)
    predicted, observed = random.random((2, 10, 13, 3)).astype(np.float32)
    inside = random.random((10, 13)) < 0.8
    inside[0:3, 0:3] = False
    pair = PreviewPair((10, 13), assumed_colour(3), columns=5)
    for start in range(0, 10, 4):
        rows = slice(start, start + 4)
        pair.add(rows, predicted[rows], observed[rows], inside=inside[rows])
    found = pair.arrays()
    assert pair.block == 3
    assert found["predicted"].shape == (4, 5, 3)
    for i in range(4):
        for j in range(5):
            block = inside[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
            assert found["inside"][i, j] == block.any()
            for name, picture in (("predicted", predicted), ("observed", observed)):
                values = picture[3 * i : 3 * i + 3, 3 * j : 3 * j + 3][block]
                expected = values.mean(axis=0) if len(values) else np.zeros(3)
                assert found[name][i, j] == pytest.approx(expected, abs=1e-3)


def test_a_metal_mirrors_in_the_colour_of_its_reflectance():
    """Beside a paint: no body, the lobe in every channel times the reflectance, and none of it counts as specular."""
    random = np.random.default_rng(5)
    normals = random.normal([0, 0, 1], 0.15, (4, 6, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    reflectance = random.uniform(0.1, 0.9, (4, 6, 3)).astype(np.float32)
    labels = np.zeros((4, 6), np.uint8)
    labels[:, 3:] = 1
    lamp, up = np.array([0.36, 0.48, 0.8]), np.array([0.0, 0.0, 1.0])
    gloss = Gloss(beta=[[0.5], [6.0]], gamma=[[0.2], [0.15]], refractive_index=[1.5, MIRROR])
    model = PlaneMaps(normals.astype(np.float32), reflectance, gloss, labels=labels)
    band = predict_light(model, Light(direction=tuple(lamp)))
    lobe = specular(normals, lamp, up, beta=6.0, gamma=0.15, refractive_index=MIRROR)
    metal = labels == 1
    np.testing.assert_allclose(band.channels[metal], (lobe[..., None] * reflectance)[metal], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(band.body[metal], lobe[metal], rtol=1e-4, atol=1e-6)
    assert np.allclose(band.specular[metal], 0, atol=1e-5)
    assert (band.specular[~metal] > 0).any()
    assert (band.lit == 1).all()
    np.testing.assert_allclose(band.body[~metal], (normals @ lamp)[~metal], rtol=1e-5)
