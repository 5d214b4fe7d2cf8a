"""Colorimetry against colour-science and against published values."""

import warnings

import numpy as np
import pytest
from refusals import refused

from nishiki.colour import colour as own
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.errors import UserError

# Sharma, Wu, Dalal 2005, table 1: pairs that exercise each branch (L, a, b, L, a, b, CIEDE2000).
SHARMA = np.array(
    [
        [50.0, 2.6772, -79.7751, 50.0, 0.0, -82.7485, 2.0425],
        [50.0, -1.3802, -84.2814, 50.0, 0.0, -82.7485, 1.0000],
        [50.0, 0.0, 0.0, 50.0, -1.0, 2.0, 2.3669],
        [50.0, 2.49, -0.001, 50.0, -2.49, 0.0009, 7.1792],
        [50.0, 2.49, -0.001, 50.0, -2.49, 0.0011, 7.2195],
        [50.0, -0.001, 2.49, 50.0, 0.0009, -2.49, 4.8045],
        [50.0, -0.001, 2.49, 50.0, 0.0011, -2.49, 4.7461],
        [50.0, 2.5, 0.0, 50.0, 0.0, -2.5, 4.3065],
        [50.0, 2.5, 0.0, 73.0, 25.0, -18.0, 27.1492],
        [50.0, 2.5, 0.0, 58.0, 24.0, 15.0, 19.4535],
        [60.2574, -34.0099, 36.2677, 60.4626, -34.1751, 39.4387, 1.2644],
        [22.7233, 20.0904, -46.6940, 23.0331, 14.9730, -42.5619, 2.0373],
        [90.9257, -0.5406, -0.9208, 88.6381, -0.8985, -0.7239, 1.5381],
        [2.0776, 0.0795, -1.1350, 0.9033, -0.0636, -0.5514, 0.9082],
    ]
)


@pytest.fixture(scope="module")
def library():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


def test_tables_equal_the_library(library):
    shape = library.SpectralShape(400, 700, 5)
    cmfs = library.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    np.testing.assert_allclose(own.cie_1931_cmfs().T, cmfs.values, atol=1e-11)
    for name in ("A", "D50", "D65", "FL2", "FL7", "FL11", "LED-B1", "LED-B3", "LED-B5"):
        expected = library.SDS_ILLUMINANTS[name].copy().align(shape).values
        np.testing.assert_allclose(own.illuminant(name), expected, rtol=2e-5)
    np.testing.assert_array_equal(own.illuminant("f11"), own.illuminant("FL11"))
    with pytest.raises(UserError, match="found 'D99'"):
        own.illuminant("D99")


def test_colour_difference_equals_published_pairs_and_the_library(library):
    found = own.delta_e_2000(SHARMA[:, :3], SHARMA[:, 3:6])
    np.testing.assert_allclose(found, SHARMA[:, 6], atol=5e-5)
    np.testing.assert_allclose(own.delta_e_2000(SHARMA[:, 3:6], SHARMA[:, :3]), found, atol=1e-12)
    rng = np.random.default_rng(0)
    first = np.column_stack([rng.uniform(0, 100, 20000), rng.uniform(-120, 120, (20000, 2))])
    second = first + rng.standard_normal(first.shape) * rng.choice([0.01, 1.0, 40.0], (20000, 1))
    expected = library.delta_E(first, second, method="CIE 2000")
    np.testing.assert_allclose(own.delta_e_2000(first, second), expected, atol=1e-10)
    assert np.all(own.delta_e_2000(first, first) == 0.0)


def test_lab_and_srgb_equal_the_library(library):
    rng = np.random.default_rng(1)
    xyz = rng.uniform(0, 1.2, (50, 7, 3)) ** 3
    white = own.white_xyz(own.illuminant("D65"))
    expected = library.XYZ_to_Lab(xyz, library.XYZ_to_xy(white))
    np.testing.assert_allclose(own.xyz_to_lab(xyz, white), expected, atol=1e-10)
    linear = own.xyz_to_srgb_linear(xyz)
    derived = library.models.RGB_COLOURSPACE_sRGB.copy()
    derived.use_derived_matrix_XYZ_to_RGB = True
    np.testing.assert_allclose(linear, xyz @ derived.matrix_XYZ_to_RGB.T, atol=1e-9)
    clipped = np.clip(linear, 0, 1)
    np.testing.assert_allclose(own.srgb_encode(linear), library.models.eotf_inverse_sRGB(clipped), atol=1e-4)


@pytest.mark.parametrize("name", ["A", "D50", "D65", "E", "FL2", "FL11"])
def test_perfect_white_has_unit_luminance_and_is_display_white(name):
    lamp = own.illuminant(name)
    white = own.white_xyz(lamp)
    assert white[1] == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(own.xyz_to_lab(white, white), [100.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(own.xyz_to_srgb_linear(white, white=white), 1.0, atol=1e-12)


def test_colour_matrix_of_coefficients_equals_61_bands():
    rng = np.random.default_rng(2)
    basis, sigma = rng.standard_normal((8, 61)), rng.standard_normal((100, 8))
    lamp = own.illuminant("FL11")
    cmfs = own.cie_1931_cmfs()
    expected = np.zeros((100, 3))
    for band in range(WAVELENGTHS_NM.size):
        expected += (sigma @ basis)[:, band, None] * lamp[band] * cmfs[:, band]
    expected /= np.sum(lamp * cmfs[1])
    np.testing.assert_allclose(sigma @ own.xyz_matrix(lamp, basis).T, expected, rtol=1e-11, atol=1e-12)


def test_extremes_stay_finite():
    white = own.white_xyz(own.illuminant("D65"))
    lab = own.xyz_to_lab(np.array([[0.0, 0, 0], [-1, -1, -1], [1e12, 1e12, 1e12], [1e-300, 0, 0]]), white)
    assert np.isfinite(lab).all()
    assert np.isfinite(own.delta_e_2000(lab, lab[::-1])).all()
    encoded = own.srgb_encode(np.array([np.nan, np.inf, -np.inf, -1.0, 0.5, 2.0]))
    assert np.all((encoded >= 0) & (encoded <= 1))
    assert own.srgb_encode(np.float64(0.18)) == pytest.approx(0.46135612, abs=1e-7)
    with refused(UserError, by="xyz_matrix"):
        own.xyz_matrix(np.zeros(61), np.ones((1, 61)))
