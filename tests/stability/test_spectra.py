"""Spectra and colour where camera and lamp tell little, responses are extreme, or units are."""

import mpmath
import numpy as np
import pytest
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over
from stability.samples import EXTREME

from nishiki.colour.colour import (
    adaptation_matrix,
    delta_e_2000,
    illuminant,
    srgb_encode,
    white_xyz,
    xyz_matrix,
    xyz_to_lab,
    xyz_to_srgb_linear,
)
from nishiki.colour.estimate import METHODS, estimate_spectra, fit_estimator
from nishiki.colour.fitting import condition_number, paper_map, wiener_map
from nishiki.colour.kernels import SpectralFlag
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights, principal_basis
from nishiki.colour.training import synthetic_reflectances
from nishiki.errors import UserError

CAMERA = np.exp(-(((WAVELENGTHS_NM[None] - np.array([[610.0], [540.0], [460.0]])) / 40) ** 2))
TRAINING = synthetic_reflectances(240)
EQUAL = np.ones(61)


def lamp(centre, width=0.5, floor=0.0):
    """A narrow-band lamp, with some of its power spread over all bands."""
    return np.exp(-(((WAVELENGTHS_NM - centre) / width) ** 2)) + floor


def _condition_error(floor, width):
    """cond(H) of the paper's three bases against singular values in 50 digits, over what rounding allows."""
    weights = channel_weights(lamp(540, width, floor), CAMERA)
    vectors = principal_basis(TRAINING, 3)
    found = condition_number(weights, TRAINING, 3)
    with mpmath.workdps(50):
        system = mpmath.matrix(weights.tolist()) * mpmath.matrix(vectors.tolist()).T
        sizes = mpmath.svd_r(system, compute_uv=False)
        exact = float(sizes[0] / sizes[2])
    return abs(found / exact - 1) / (1e-14 + 1e-15 * exact) if exact < 1e14 else float(not found > 1e12)


@pytest.mark.slow
@case(
    "Condition of camera and lamp, narrow-band lamps included",
    hazard="cond(H) -> infinity",
    treatment="from singular values; reported, and beyond a limit of the stage the run stops with a remedy",
    reference="singular values in mpmath, 50 digits",
    outcome="true to rounding; beyond 1e12 called so",
    bound=50,
    unit="roundings (1e-15) times the condition",
)
def test_condition():
    return worst_over(_condition_error, powers_of_ten(-16, 0), st.floats(0.5, 60), examples=60)


@case(
    "Single line as a lamp: the paper's inverse",
    hazard="H cannot be inverted: coefficients of 1e16",
    treatment="singular values below the largest / 1e6 are left out and every pixel is flagged ill_conditioned",
    reference="pseudoinverse of the kept part",
    outcome="flagged; coefficients no larger than the limit allows",
    bound=0,
    unit="wrong outcomes",
)
def test_paper_with_a_line():
    wrong = 0
    for floor in (0.0, 1e-12, 1e-9, 1e-6, 1e-2):
        estimator = fit_estimator(TRAINING, lamp(540, 0.5, floor), CAMERA, method="paper")
        found = estimate_spectra(np.full((4, 3), 0.3), estimator)
        wrong += ((found.flags & SpectralFlag.ILL_CONDITIONED) != 0).all() != (estimator.condition > 1e6)
        wrong += not np.isfinite(found.coefficients).all() or np.abs(estimator.linear).max() > 1e7
    return int(wrong)


@pytest.mark.slow
@case(
    "Estimated error under narrow-band lamps",
    hazard="an estimate without information that looks like a measurement",
    treatment="Wiener and the local method fall back to what the training set says; sigma says how little that is",
    reference="the true spectra of the training set",
    outcome="the error is not larger than the predicted one by more than the bound",
    bound=1.6,
    unit="true over predicted error",
)
def test_sigma_with_a_line():
    worst = 0.0
    for method in ("wiener", "local"):
        for light in (EQUAL, lamp(540), lamp(540) + lamp(610), lamp(540, 0.5, 1e-9), lamp(540, 5)):
            estimator = fit_estimator(TRAINING, light, CAMERA, method=method, white_width=0.0)
            found = estimate_spectra(TRAINING @ channel_weights(light, CAMERA).T, estimator)
            true = np.sqrt(np.mean((found.spectra() - TRAINING) ** 2))
            worst = max(worst, true / np.sqrt(np.mean(found.sigma.astype(float) ** 2)))
    return worst


@pytest.mark.slow
@case(
    "Perfect white and black under every lamp and method",
    hazard="bookkeeping of the white board; 0 / 0 in the dark",
    treatment="the white anchor; no constant term",
    outcome="S = 1 and S = 0 exactly",
    bound=1e-6,
    unit="of reflectance",
)
def test_white_and_black():
    worst = 0.0
    for method in METHODS:
        for light in (EQUAL, illuminant("A"), lamp(540), lamp(460, 5), lamp(540, 0.5, 1e-6)):
            estimator = fit_estimator(TRAINING, light, CAMERA, method=method)
            spectra = estimate_spectra(np.array([[1.0] * 3, [0.0] * 3, [1e-45] * 3]), estimator).spectra()
            worst = max(worst, np.abs(spectra[0] - 1).max(), np.abs(spectra[1:]).max())
    return worst


def _unit_error(of_lamp, of_camera):
    plain = channel_weights(illuminant("A"), CAMERA)
    found = channel_weights(illuminant("A") * of_lamp, CAMERA * of_camera)
    colour = xyz_matrix(illuminant("A") * of_lamp, np.eye(61)) / xyz_matrix(illuminant("A"), np.eye(61)).max()
    exact = xyz_matrix(illuminant("A"), np.eye(61)) / xyz_matrix(illuminant("A"), np.eye(61)).max()
    return max(relative(found, plain), relative(colour, exact))


@case(
    "Lamp and camera tables in units from 1e-290 to 1e290",
    hazard="products leave float64",
    treatment="curves are brought to a largest value of 1",
    reference="the same at scale 1",
    outcome="the same weights and colour matrices",
    bound=1e-13,
)
def test_units_of_tables():
    return worst_over(_unit_error, powers_of_ten(-290, 290), powers_of_ten(-290, 290), examples=100)


def _anything(seed, method):
    rng = np.random.default_rng(seed)
    estimator = ESTIMATORS[method]
    responses = rng.choice(EXTREME, (200, 3))
    some = rng.random(responses.shape) < 0.5
    responses = np.where(some, rng.uniform(0, 1, responses.shape) * 10.0 ** rng.uniform(-44, 38), responses)
    with np.errstate(over="ignore"):
        responses = responses.astype(np.float32 if seed % 2 else np.float64)
        single = responses.astype(np.float32)
    found = estimate_spectra(responses, estimator)
    wrong = int((~np.isfinite(found.coefficients)).sum() + (~np.isfinite(found.sigma)).sum())
    wrong += int((~np.isfinite(found.spectra())).sum())
    lost = (found.flags & SpectralFlag.NOT_FINITE) != 0
    wrong += int(np.count_nonzero(found.coefficients[lost]) + (~lost & ~np.isfinite(single).all(axis=1)).sum())
    negative = (single < 0).any(axis=1) & ~lost
    return wrong + int((negative != (((found.flags & SpectralFlag.NEGATIVE_RESPONSE) != 0) & ~lost)).sum())


ESTIMATORS = {method: fit_estimator(TRAINING, EQUAL, CAMERA, method=method) for method in METHODS}


@case(
    "Responses of any size, negative, NaN, infinite",
    hazard="square roots of negative values, overflow of a linear map",
    treatment="flagged not_finite with coefficients 0; negative ones go through the linear part, flagged",
    outcome="finite; flagged exactly where it has to be",
    bound=0,
    unit="wrong values",
)
def test_responses_of_any_size():
    return worst_over(_anything, st.integers(0, 10**6), st.sampled_from(METHODS), examples=40)


def _linear_error(exponent, seed):
    """Without a white anchor, coefficients times a scale are those of the scaled response."""
    rng = np.random.default_rng(seed)
    worst = 0.0
    responses = rng.uniform(0, 1, (20, 3)).astype(np.float32)
    for method in ("paper", "wiener"):
        estimator = LINEAR[method]
        plain = estimate_spectra(responses, estimator).coefficients.astype(np.float64)
        scale = np.float32(10.0**exponent)
        found = estimate_spectra(responses * scale, estimator).coefficients / np.float64(scale)
        worst = max(worst, relative(found, plain))
    return worst


LINEAR = {method: fit_estimator(TRAINING, EQUAL, CAMERA, method=method, white_width=0.0) for method in METHODS[:2]}


@case(
    "Linear estimators under responses times 1e-30 to 1e30",
    hazard="absolute thresholds",
    treatment="a linear map; the white anchor and the local correction alone know what a white is",
    reference="the same at scale 1",
    outcome="coefficients times the scale",
    bound=1e-6,
)
def test_equivariance_of_linear_estimators():
    return worst_over(_linear_error, st.floats(-30, 30), st.integers(0, 5), examples=40)


@case(
    "Compiled estimator in float32 against float64",
    hazard="coefficients of 1e4 and more times responses rounded to 6e-8",
    treatment="maps are float64; only responses and results are float32; noise covers the rest",
    reference="the matrices in 40 digits",
    outcome="the linear part exact to the rounding of its result",
    bound=3e-7,
)
def test_single_precision():
    worst = 0.0
    rng = np.random.default_rng(1)
    responses = rng.uniform(0, 1, (12, 3)).astype(np.float32)
    for light in (EQUAL, lamp(540, 0.5, 1e-4), lamp(460, 5)):
        weights = channel_weights(light, CAMERA)
        for method, exact in (
            ("paper", lambda w: paper_map(w, principal_basis(TRAINING, 3), condition_limit=1e6)[0]),
            ("wiener", lambda w: wiener_map(w, TRAINING, noise=0.0)),
        ):
            estimator = fit_estimator(TRAINING, light, CAMERA, method=method, noise=0.0, white_width=0.0)
            found = estimate_spectra(responses, estimator).coefficients
            with mpmath.workdps(40):
                true = mpmath.matrix(responses.astype(float).tolist()) * mpmath.matrix(estimator.linear.T.tolist())
                worst = max(worst, relative(found, np.array(true.tolist(), float)))
            assert np.isfinite(exact(weights)).all()
    return worst


@case(
    "Lamps and cameras that tell nothing at all",
    hazard="0 / 0 in the white normalisation",
    treatment="refused by channel, with a remedy",
    outcome="exit status 2",
    bound=0,
    unit="that passed",
)
def test_nothing_to_see():
    dark = CAMERA.copy()
    dark[1] = 0.0
    passed = 0
    hopeless = (
        (np.zeros(61), CAMERA), (EQUAL, dark), (EQUAL, -CAMERA), (-EQUAL, CAMERA), (np.full(61, np.nan), CAMERA),
        (EQUAL, CAMERA * np.inf), (lamp(400, 0.1) * (WAVELENGTHS_NM < 402), CAMERA * (WAVELENGTHS_NM > 410)),
    )  # fmt: skip
    for light, camera in hopeless:
        try:
            with np.errstate(invalid="ignore"):
                channel_weights(light, camera)
            passed += 1
        except UserError:
            continue
    return passed


@case(
    "Pictures under a lamp of one line",
    hazard="Bradford's cone responses of its white are negative or 0: colours invert",
    treatment="where a response is below 1 % of the display's, luminance alone is adapted",
    outcome="finite; a brighter surface is never darker in any channel that the lamp excites",
    bound=0,
    unit="wrong lamps",
)
def test_adaptation():
    wrong = 0
    target = white_xyz(illuminant("D65"))
    for centre in range(400, 701, 5):
        for floor in (0.0, 1e-3, 1e-1):
            white = white_xyz(lamp(centre, 0.5, floor))
            matrix = adaptation_matrix(white, target)
            seen = matrix @ white
            wrong += not np.isfinite(matrix).all() or not abs(seen[1] / target[1] - 1) < 1e-9
            shown = xyz_to_srgb_linear(np.array([0.5 * white, white]), white=white)
            wrong += not np.isfinite(shown).all() or not shown[1].max() > shown[0].max() > 0
            display = xyz_to_srgb_linear(target * 1.0)
            wrong += not (np.isfinite(display).all())
    return wrong


@case(
    "Adaptation from usual lamps",
    hazard="none: the guard must not touch them",
    treatment="as published",
    reference="the Bradford matrix written out",
    outcome="their white becomes the display's",
    bound=1e-12,
)
def test_usual_adaptation():
    worst = 0.0
    for source in ("A", "D50", "D65", "E", "FL2", "FL7", "FL11"):
        white, target = white_xyz(illuminant(source)), white_xyz(illuminant("D65"))
        worst = max(worst, relative(adaptation_matrix(white, target) @ white, target))
    return worst


@case(
    "Colours of XYZ that is 0, negative, huge, NaN",
    hazard="cube roots and powers of what is not positive",
    treatment="the linear branch below (6/29)^3; display values are clipped, NaN becomes 0",
    outcome="finite Lab, difference 0 with itself and symmetric; display in 0 .. 1",
    bound=1e-9,
    unit="of the difference",
)
def test_extreme_colours():
    white = white_xyz(illuminant("D65"))
    values = np.array([0, -0.0, 5e-324, 1e-300, 1e-12, -1e-12, 0.3, 1, -1, 1e3, 1e6, -1e6])
    xyz = np.stack(np.meshgrid(values, values, values), axis=-1).reshape(-1, 3)
    lab = xyz_to_lab(xyz, white)
    there, back = delta_e_2000(lab[:-1], lab[1:]), delta_e_2000(lab[1:], lab[:-1])
    same = delta_e_2000(lab, lab)
    shown = srgb_encode(np.concatenate([values, [np.nan, np.inf, -np.inf, 1e308, -1e308]]))
    if not (np.isfinite(lab).all() and np.isfinite(there).all() and ((shown >= 0) & (shown <= 1)).all()):
        return np.inf
    return max(float(same.max()), float((np.abs(there - back) / np.maximum(there, 1)).max()))
