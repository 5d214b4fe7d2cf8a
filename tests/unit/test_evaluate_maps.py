"""Errors of normals, height and reflectance against truth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_from_spectra, xyz_to_lab
from nishiki.errors import UserError
from nishiki.evaluate.maps import Pool, angular_error_deg, height_error, normal_errors, reflectance_errors, summarise
from nishiki.photometric.flags import NormalFlag
from nishiki.stages.evaluate.painting import truth_from


def _rotated(angle):
    return np.array([np.sin(angle), 0.0, np.cos(angle)])


def test_summary_known_values():
    found = summarise(np.arange(11.0))
    assert (found.count, found.mean, found.median, found.p90, found.worst) == (11, 5.0, 5.0, 9.0, 10.0)


def test_summary_of_nothing_and_of_nan():
    assert summarise(np.zeros(0)).mean is None
    found = summarise(np.array([1.0, np.nan, np.inf, 3.0]))
    assert (found.count, found.mean, found.dropped) == (2, 2.0, 2)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.floats(0.01, 40))
def test_pooled_figures_are_those_of_all_values_together(seed, maps, scale):
    random = np.random.default_rng(seed)
    parts = [scale * random.gamma(2.0, size=random.integers(20, 400)).astype(np.float32) for _ in range(maps)]
    pool = Pool()
    for part in parts:
        pool.add(np.concatenate([part, [np.nan]]))
    values, found = np.concatenate(parts), pool.summary()
    assert (found.count, found.worst) == (values.size, float(values.max()))
    assert found.mean == pytest.approx(values.mean(dtype=np.float64), rel=1e-6)
    for percent, figure in ((50, found.median), (90, found.p90)):
        low, high = (np.percentile(values, percent, method=method) for method in ("lower", "higher"))
        assert min(low, 200) - 0.006 <= figure <= min(high, 200) + 0.006


def test_a_pool_of_nothing_has_no_figures():
    pool = Pool()
    pool.add(np.full(3, np.nan))
    assert pool.summary().mean is None


@given(st.floats(-7.0, 0.4971), st.floats(-30, 30))
def test_angular_error_is_exact_for_all_angles_and_scales(exponent, scale):
    # angles from 1e-7 rad to pi, vectors of any length: the arccos form is wrong by 100 % at 1e-8
    angle = 10.0**exponent
    found = angular_error_deg(_rotated(0.3) * 10.0**scale, _rotated(0.3 + angle))
    assert found == pytest.approx(np.degrees(angle), rel=2e-7 + 4e-16 / angle)


def test_angular_error_of_opposite_and_unknown_directions():
    z = np.array([0.0, 0.0, 1.0])
    assert angular_error_deg(z, -z) == pytest.approx(180.0)
    assert np.isnan(angular_error_deg(np.zeros(3), z))
    assert np.isnan(angular_error_deg(np.array([np.nan, 0, 1]), z))


def _field():
    truth = np.zeros((4, 5, 3), np.float32)
    truth[...] = _rotated(np.radians(25.0))
    truth[0] = 0.0  # not known
    estimate = truth.copy()
    estimate[1:] = _rotated(np.radians(27.0))
    estimate[1, 0] = (0, 0, 1)
    flags = np.zeros((4, 5), np.uint8)
    flags[1, 0] = NormalFlag.TOO_FEW_LIGHTS
    flags[1, 1] = NormalFlag.ILL_CONDITIONED
    return estimate, truth, flags


def test_normal_errors_tell_apart_what_is_inside_estimated_and_flagged():
    estimate, truth, flags = _field()
    found = normal_errors(estimate, truth, flags=flags)
    assert np.isnan(found.map_deg[0]).all()
    assert (found.inside.count, found.estimated.count, found.unflagged.count, found.flagged.count) == (15, 14, 13, 1)
    assert found.no_estimate == 1
    assert found.estimated.mean == pytest.approx(2.0, abs=1e-4)
    assert found.inside.worst == pytest.approx(25.0, abs=1e-4)
    assert found.by_slope[(20.0, 30.0)].count == 14
    assert sum(part.count for part in found.by_slope.values()) == 14


def test_normal_errors_keep_to_the_mask():
    estimate, truth, flags = _field()
    mask = np.zeros((4, 5), bool)
    mask[2, 2:4] = True
    assert normal_errors(estimate, truth, flags=flags, mask=mask).inside.count == 2


def test_normal_errors_refuse_another_size():
    estimate, truth, flags = _field()
    with refused(UserError, "(3, 5, 3)"):
        normal_errors(estimate, truth[:3], flags=flags)


def test_height_error_ignores_level_and_tilt_only():
    random = np.random.default_rng(3)
    truth = random.normal(size=(30, 40)).astype(np.float32)
    rows, columns = np.mgrid[:30, :40]
    found = height_error(truth + 5 + 0.1 * rows - 0.2 * columns, truth, pixels=np.ones((30, 40), bool), pitch=0.5)
    assert found.rms < 1e-6
    assert found.tilt_deg == pytest.approx(np.degrees(np.arctan(np.hypot(0.1, 0.2) / 0.5)), rel=1e-5)
    ripple = 0.3 * np.where((rows + columns) % 2, 1, -1)
    found = height_error(truth + ripple, truth, pixels=np.ones((30, 40), bool))
    assert found.rms == pytest.approx(0.3, rel=1e-5)


def test_height_error_against_an_explicit_plane_fit():
    random = np.random.default_rng(4)
    truth, estimate = random.normal(size=(2, 21, 17))
    pixels = random.random((21, 17)) < 0.4
    rows, columns = np.nonzero(pixels)
    design = np.column_stack([np.ones(rows.size), rows, columns])
    difference = (estimate - truth)[pixels]
    rest = difference - design @ np.linalg.lstsq(design, difference, rcond=None)[0]
    found = height_error(estimate, truth, pixels=pixels)
    assert found.rms == pytest.approx(np.sqrt(np.mean(rest**2)), rel=1e-12)
    assert found.pixels == rows.size


def test_height_error_of_a_line_of_pixels_and_of_none():
    pixels = np.zeros((5, 5), bool)
    pixels[2] = True
    found = height_error(np.arange(25.0).reshape(5, 5), np.zeros((5, 5)), pixels=pixels)
    assert found.rms == pytest.approx(0.0, abs=1e-12)
    assert height_error(np.zeros((5, 5)), np.zeros((5, 5)), pixels=np.zeros((5, 5), bool)).rms is None


def _spectral_case():
    random = np.random.default_rng(5)
    basis = np.linalg.qr(random.normal(size=(61, 4)))[0].T
    spectra = np.clip(random.random((6, 61)).cumsum(axis=1) / 61, 0, 1)
    paints = random.integers(0, 6, (7, 9, 4)).astype(np.uint8)
    coefficients = (0.3 * random.normal(size=(7, 9, 4)) + spectra[paints].mean(axis=2) @ basis.T).astype(np.float32)
    return coefficients, basis, paints, spectra


def test_reflectance_errors_against_the_obvious_loop():
    coefficients, basis, paints, spectra = _spectral_case()
    pixels = np.ones((7, 9), bool)
    pixels[3, 4] = False
    found = reflectance_errors(coefficients, basis, paints, spectra, pixels=pixels, regions=paints[..., 0])
    lamp = illuminant("D65")
    white = white_xyz(lamp)
    rmse, de00 = [], []
    for i in range(7):
        for j in range(9):
            if pixels[i, j]:
                estimate = coefficients[i, j].astype(float) @ basis
                true = np.mean([spectra[label] for label in paints[i, j]], axis=0)
                rmse.append(np.sqrt(np.mean((estimate - true) ** 2)))
                labs = [xyz_to_lab(xyz_from_spectra(lamp, s), white) for s in (estimate, true)]
                de00.append(float(delta_e_2000(*labs)))
    assert found.rmse.mean == pytest.approx(np.mean(rmse), rel=1e-6)
    assert found.de00["D65"].mean == pytest.approx(np.mean(de00), rel=1e-5)
    assert np.isnan(found.de00_map[3, 4])
    assert set(found.de00) == {"D65", "A", "FL11"}
    assert sum(region["pixels"] for region in found.regions) == 62


def test_reflectance_regions_hold_mean_spectra():
    coefficients, basis, paints, spectra = _spectral_case()
    pixels = np.ones((7, 9), bool)
    found = reflectance_errors(coefficients, basis, paints, spectra, pixels=pixels, regions=np.zeros((7, 9), int))
    (region,) = found.regions
    assert region["truth"] == pytest.approx(spectra[paints].mean(axis=(0, 1, 2)), abs=1e-5)
    assert region["estimate"] == pytest.approx(coefficients.mean(axis=(0, 1)) @ basis, abs=2e-5)


def test_reflectance_refuses_labels_without_a_spectrum():
    coefficients, basis, paints, spectra = _spectral_case()
    with refused(UserError, "0", "4", by="reflectance_errors"):
        reflectance_errors(coefficients, basis, paints, spectra[:5], pixels=np.ones((7, 9), bool))


def test_truth_is_cropped_to_the_region_of_interest():
    normals = np.arange(10 * 12 * 3, dtype=float).reshape(10, 12, 3)
    found = truth_from({"normals": normals}, shape=(4, 5), region=(2, 3, 4, 5))
    assert np.array_equal(found.normals, normals[2:6, 3:8])
    assert found.spectra is None
    assert found.check("any") is None
    of_interest = truth_from({"normals": normals[1:8, 2:10]}, shape=(4, 5), region=(2, 3, 4, 5), asked=(1, 2, 7, 8))
    assert np.array_equal(of_interest.normals, normals[2:6, 3:8])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [({"normals": np.zeros((3, 3, 3))}, "4 x 5"), ({"other": np.zeros(3)}, "normals")],
)
def test_truth_that_does_not_fit_is_refused(arrays, message):
    with pytest.raises(UserError, match=message):
        truth_from(arrays, shape=(4, 5), region=(0, 0, 4, 5))


def test_equivalent_width_of_ggx_is_where_its_facet_distribution_halves():
    alpha = np.array([0.0, 0.11, 0.42], np.float32)
    truth = truth_from({"normals": np.zeros((2, 2, 3)), "roughness": alpha}, shape=(2, 2))
    least, _, largest = truth.equivalent_gamma()
    for gamma, width in ((least, 0.11), (largest, 0.42)):
        assert (width**2 / (width**2 + np.tan(gamma) ** 2)) ** 2 == pytest.approx(0.5, rel=1e-6)
