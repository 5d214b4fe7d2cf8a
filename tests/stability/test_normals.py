"""Photometric stereo, diffuse reflectance and height where lights, samples or scales are extreme."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import strategies as st
from stability.cases import case, relative, worst_over
from stability.samples import EXTREME, dome, matt_pixels, same, tilted, turned_cone

from nishiki.brdf.gloss_profile import LADDER, GlossProfile
from nishiki.errors import UserError
from nishiki.photometric.body import diffuse_reflectance
from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag
from nishiki.photometric.gloss import JointSettings, refine_normals
from nishiki.photometric.height import integrate_normals
from nishiki.photometric.light_selection import METHODS, select_diffuse
from nishiki.photometric.solve import SOLVERS, estimate_normals
from nishiki.small_matrices import eigenvalues

ESTIMATES = ("normals", "albedo", "sigma", "condition", "residual")


def exact_solution(lights, values):
    """(normal, albedo) of unweighted least squares in rational arithmetic, from the floats as they are."""
    rows = [[Fraction(float(v)) for v in row] for row in lights]
    right = [Fraction(float(np.float32(v))) for v in values]
    matrix = [[sum(r[i] * r[j] for r in rows) for j in range(3)] for i in range(3)]
    known = [sum(r[i] * y for r, y in zip(rows, right, strict=True)) for i in range(3)]
    for i in range(3):  # Gauss, exact: no pivoting but for zeros
        for j in range(i + 1, 3):
            factor = matrix[j][i] / matrix[i][i]
            matrix[j] = [a - factor * b for a, b in zip(matrix[j], matrix[i], strict=True)]
            known[j] -= factor * known[i]
    found = [Fraction(0)] * 3
    for i in (2, 1, 0):
        found[i] = (known[i] - sum(matrix[i][j] * found[j] for j in range(i + 1, 3))) / matrix[i][i]
    with mpmath.workdps(40):
        vector = [mpmath.mpf(v.numerator) / v.denominator for v in found]
        length = mpmath.sqrt(sum(v * v for v in vector))
        return np.array([float(v / length) for v in vector]), float(length)


def exact_condition(lights):
    """Condition of the normal matrix, singular values in 60 digits."""
    with mpmath.workdps(60):
        sizes = mpmath.svd_r(mpmath.matrix(np.asarray(lights).tolist()), compute_uv=False)
        return float((sizes[0] / sizes[2]) ** 2)


def _condition_error(exponent, turn, count):
    lights = turned_cone(count, 10.0**exponent, turn)
    exact = exact_condition(lights)
    if exact > 1e11:
        return 0.0
    matrix = lights.T @ lights
    least, largest = eigenvalues(*matrix[np.triu_indices(3)])
    return abs(largest / least / exact - 1) / (1e-15 * exact + 1e-15)


@case(
    "Lights in a narrow cone: the condition",
    hazard="two small eigenvalues lie together, where the roots of the cubic keep half of their digits",
    treatment="the smallest eigenvalue is taken across the eigenvector of the largest",
    reference="singular values in mpmath, 60 digits",
    outcome="condition true up to 1e11",
    bound=2,
    unit="roundings (1e-15) times the condition",
)
def test_condition_of_a_narrow_cone():
    return worst_over(_condition_error, st.floats(-5, 0), st.floats(0, 6.28), st.integers(3, 12), examples=150)


def _solution_error(exponent, turn, count):
    lights = turned_cone(count, 10.0**exponent, turn)
    condition = exact_condition(lights)
    if condition > 1e11:
        return 0.0
    normal = np.array([0.2, -0.3, 0.9])
    values = lights @ (normal / np.linalg.norm(normal))
    found = estimate_normals(values.reshape(-1, 1, 1), lights, solver="least_squares", max_condition=1e3)
    exact, albedo = exact_solution(lights, values)
    if ((found.flags[0, 0] & NormalFlag.ILL_CONDITIONED) != 0) != (found.condition[0, 0] > 1e3):
        return np.inf
    if found.flags[0, 0] & NO_ESTIMATE:
        return np.inf
    apart = max(np.abs(found.normals[0, 0] - exact).max(), abs(found.albedo[0, 0] / albedo - 1))
    return apart / (1.2e-7 + 1e-15 * condition)


@case(
    "Lights in a narrow cone: the normal",
    hazard="cofactors lose the condition squared: a normal that turns away from the camera",
    treatment="the inverse is made of pivots (L D L^T): error grows with the condition alone; flagged above a bound",
    reference="rational arithmetic",
    outcome="normal and albedo right, flagged ill_conditioned above max_condition",
    bound=2,
    unit="float32 roundings plus 1e-15 times the condition",
)
def test_normal_of_a_narrow_cone():
    return worst_over(_solution_error, st.floats(-5, 0), st.floats(0, 6.28), st.integers(3, 12), examples=100)


def _coplanar(vectors, weights):
    weights = np.array(weights)
    lights = weights @ np.array(vectors)
    length = np.linalg.norm(lights, axis=1)
    if (length < 1e-3).any():
        return 0
    lights /= length[:, None]
    wrong = 0
    for solver in SOLVERS:
        found = estimate_normals(np.full((len(lights), 1, 1), 0.5), lights, solver=solver)
        wrong += not found.flags[0, 0] & NormalFlag.COPLANAR_LIGHTS
        wrong += not same(found.normals[0, 0], [0, 0, 1]) or found.albedo[0, 0] != 0
    return wrong


@case(
    "Lights in one plane, or all in one direction",
    hazard="singular normal matrix",
    treatment="flagged coplanar_lights: normal (0, 0, 1), albedo 0, sigma a right angle",
    outcome="always flagged, with every solver",
    bound=0,
    unit="wrong outcomes",
)
def test_coplanar_lights():
    number = st.floats(-1, 1)
    vector = st.tuples(number, number, number)
    pair = st.tuples(number, number)
    drawn = worst_over(_coplanar, st.tuples(vector, vector), st.lists(pair, min_size=3, max_size=8), examples=60)
    once = _coplanar([(0.3, 0.2, 0.9), (0, 0, 0)], [(1, 0)] * 12)
    return drawn + once


@case(
    "Three, two, one and no usable lights",
    hazard="fewer equations than unknowns; no residual with three",
    treatment="below three flagged too_few_lights; three flagged no_redundancy with sigma a right angle",
    outcome="every pixel flagged as stated; the neighbours keep their estimate",
    bound=0,
    unit="wrong pixels",
)
def test_few_lights():
    stack, lights, _, _ = matt_pixels(12, 13, 1)
    usable = np.arange(12)[:, None, None] < np.arange(13)[None, None, :]
    wrong = 0
    for solver in SOLVERS:
        found = estimate_normals(stack, lights, usable=usable, solver=solver)
        expected = np.where(
            np.arange(13) < 3, NormalFlag.TOO_FEW_LIGHTS, np.where(np.arange(13) == 3, NormalFlag.NO_REDUNDANCY, 0)
        )
        own = found.flags[0] & ~np.uint8(NormalFlag.FALLBACK | NormalFlag.ILL_CONDITIONED)
        wrong += int((own != expected).sum() + (found.sigma[0, :4] != np.float32(np.pi / 2)).sum())
        wrong += int((found.lights_used[0] != np.arange(13)).sum()) if solver == "least_squares" else 0
    return wrong


@case(
    "Pixels in shadow under every light, and black pixels",
    hazard="0 / 0 in the direction of the normal",
    treatment="flagged no_signal",
    outcome="flagged, finite; the neighbours are the same to the last bit",
    bound=0,
    unit="wrong pixels",
)
def test_no_light_at_all():
    stack, lights, _, _ = matt_pixels(16, 64, 2)
    wrong = 0
    for method in METHODS:
        for solver in SOLVERS:
            lit = select_diffuse(stack, lights, method=method).usable
            plain = estimate_normals(stack, lights, usable=lit, solver=solver)
            dark = stack.copy()
            dark[:, 0, ::5] = 0
            chosen = select_diffuse(dark, lights, method=method)
            found = estimate_normals(dark, lights, usable=chosen.usable, solver=solver)
            black = np.zeros((1, 64), bool)
            black[0, ::5] = True
            wrong += int((((found.flags & NormalFlag.NO_SIGNAL) != 0) != black).sum())
            wrong += int((found.normals != plain.normals)[~black].sum())
    return wrong


@case(
    "Negative observations after the dark frame",
    hazard="clamped to 0 they bias dark pixels; a fit of negative values alone points away",
    treatment="they take part as they are; a normal away from the camera is flagged faces_away",
    reference="rational arithmetic",
    outcome="least squares of the values as they are",
    bound=1e-6,
)
def test_negative_observations():
    rng = np.random.default_rng(3)
    lights = dome(9)
    values = rng.normal(0.001, 0.002, (9, 1, 40)).astype(np.float32)
    values[:, :, -1] = -np.abs(values[:, :, -1])
    found = estimate_normals(values, lights, solver="least_squares")
    worst = 0.0 if found.flags[0, -1] & NormalFlag.FACES_AWAY else np.inf
    for p in range(40):
        normal, albedo = exact_solution(lights, values[:, 0, p])
        worst = max(worst, relative(found.normals[0, p], normal), abs(found.albedo[0, p] / albedo - 1))
    return worst


@case(
    "Usable samples that are not valid",
    hazard="a saturated or missing sample that the selection does not know of enters as 0",
    treatment="what is not valid never enters a fit",
    reference="the fit without those samples",
    outcome="the same result",
    bound=0,
    unit="wrong pixels",
)
def test_usable_but_not_valid():
    stack, lights, _, _ = matt_pixels(20, 50, 4)
    broken = stack.copy()
    valid = np.ones(stack.shape, bool)
    valid[3:5] = False
    broken[3:5] = 7.0
    expected = estimate_normals(broken, lights, usable=valid, valid=valid, solver="lobe")
    found = estimate_normals(broken, lights, usable=np.ones(stack.shape, bool), valid=valid, solver="lobe")
    return int((found.normals != expected.normals).any(axis=-1).sum())


def _anything(seed, share, sizes, count):
    """How many numbers that are not finite, or normals not of unit length, leave the chain for extreme samples."""
    rng = np.random.default_rng(seed)
    lights = dome(count) if seed % 3 else tilted(count, seed, most=3.0)
    stack = (rng.uniform(size=(count, 1, 24)) * 10.0**sizes).astype(np.float32)
    stack = np.where(rng.random(stack.shape) < share, rng.choice(EXTREME, size=stack.shape), stack)
    stack[:, :, 0] = rng.choice(EXTREME, size=count)[:, None]
    valid = rng.random(stack.shape) < 0.9
    bad = 0
    colours = np.stack([stack, stack * np.float32(0.5)], axis=-1)
    for method in METHODS:
        chosen = select_diffuse(stack, lights, method=method, valid=valid)
        bad += int((chosen.usable & ~(valid & np.isfinite(stack))).sum())
        for solver in SOLVERS:
            found = estimate_normals(stack, lights, usable=chosen.usable, valid=valid, solver=solver)
            bad += sum(int((~np.isfinite(getattr(found, name))).sum()) for name in ESTIMATES)
            bad += int((np.abs(np.linalg.norm(found.normals, axis=-1) - 1) > 1e-5).sum())
            bad += int(((found.albedo <= 0) & ((found.flags & NO_ESTIMATE) == 0)).sum())
        for way in ("least_squares", "mean"):
            diffuse = diffuse_reflectance(colours, lights, found.normals, usable=chosen.usable, method=way)
            bad += int((~np.isfinite(diffuse.reflectance)).sum())
    usual = np.where(lights[:, 2:] > -0.99, lights, [0.0, 0.0, 1.0])
    for beta in (0.0, 1.0, 1e6):
        fit = refine_normals(
            colours, usual, normals=found.normals, gloss=GlossProfile(np.full(LADDER.size, beta), LADDER),
            flags=found.flags, valid=chosen.usable, reflectance=diffuse.reflectance,
        )  # fmt: skip
        for name in (*ESTIMATES, "reflectance", "cost"):
            bad += int((~np.isfinite(getattr(fit, name))).sum())
    return bad


@pytest.mark.slow
@case(
    "Samples of any size, NaN and infinity among them",
    hazard="squares and quotients beyond float32; albedos that float32 cannot hold",
    treatment="an albedo outside float32 is flagged no_signal; a lobe or joint fit outside of it falls back, flagged",
    outcome="every number finite, every normal of unit length, nothing invalid chosen",
    bound=0,
    unit="numbers",
)
def test_samples_of_any_size():
    drawn = st.integers(0, 10**6), st.floats(0, 0.5), st.floats(-44, 38), st.integers(1, 20)
    return worst_over(_anything, *drawn, examples=25)


def _chain(stack, lights, method, solver):
    chosen = select_diffuse(stack.mean(axis=-1), lights, method=method)
    found = estimate_normals(stack.mean(axis=-1), lights, usable=chosen.usable, solver=solver)
    return chosen, found, diffuse_reflectance(stack, lights, found.normals, usable=chosen.usable)


def glossy_stack(seed=0, count=16, pixels=200):
    """Observations (lights, 1, pixels, 3) of glossy pixels with noise, and the lights."""
    rng = np.random.default_rng(seed)
    lights, normals = dome(count), tilted(pixels, seed)
    halves = lights + np.array([0, 0, 1])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    angle = np.arccos(np.clip(halves @ normals.T, -1, 1))
    gloss = 0.2 * np.exp(-((angle / 0.1) ** 2))
    stack = np.maximum(lights @ normals.T, 0)[..., None] * rng.uniform(0.05, 0.9, (pixels, 3)) + gloss[..., None]
    return (stack + 0.003 * rng.normal(size=stack.shape)).astype(np.float32)[:, None], lights


@case(
    "Observations times 2^-60 to 2^60 (36 orders of magnitude)",
    hazard="absolute thresholds",
    treatment="everything is relative to the pixel's own level",
    reference="the same at scale 1",
    outcome="the same bits: selection, normals, sigma, condition, flags; albedo and reflectance times the scale",
    bound=0,
    unit="values that differ",
)
def test_equivariance_by_powers_of_two():
    stack, lights = glossy_stack()
    differ = 0
    for method, solver in (("refit", "lobe"), ("threshold", "lobe"), ("trimmed", "least_squares"), ("none", "lobe")):
        chosen, found, diffuse = _chain(stack, lights, method, solver)
        for exponent in (-60, -20, 20, 60):
            scale = np.float32(2.0**exponent)
            other, scaled, reflectance = _chain(stack * scale, lights, method, solver)
            differ += int((other.usable != chosen.usable).sum())
            differ += sum(
                int((getattr(scaled, name) != getattr(found, name)).sum())
                for name in ("normals", "sigma", "condition", "lights_used", "flags")
            )
            differ += int((scaled.albedo != found.albedo * scale).sum())
            differ += int((reflectance.reflectance != diffuse.reflectance * scale).sum())
    return differ


def _powers_of_ten(exponent, seed):
    stack, lights = glossy_stack(seed)
    chosen, found, diffuse = _chain(stack, lights, "refit", "lobe")
    scale = np.float32(10.0**exponent)
    other, scaled, reflectance = _chain(stack * scale, lights, "refit", "lobe")
    kept = (other.usable == chosen.usable).all(axis=(0, 1)) & (scaled.flags == found.flags).all(axis=0)
    kept &= (scaled.lights_used == found.lights_used).all(axis=0)
    if kept.mean() < 0.97:
        return np.inf
    apart = np.linalg.norm(scaled.normals - found.normals, axis=-1)[0, kept].max()
    return max(apart, relative((reflectance.reflectance / scale)[0, kept], diffuse.reflectance[0, kept]))


@case(
    "Observations times 1e-6 to 1e6",
    hazard="roundings decide between samples of nearly equal merit",
    treatment="a rounding may flip the choice of one sample in at most 3 of 100 pixels",
    reference="the same at scale 1",
    outcome="97 of 100 pixels: same choice, normals to the bound (radians), reflectance to the bound",
    bound=5e-4,
    unit="radians, relative",
)
def test_equivariance_by_powers_of_ten():
    return worst_over(_powers_of_ten, st.floats(-6, 6), st.integers(0, 3), examples=12)


def _joint(scale, stack, lights, start):
    gloss = GlossProfile(np.full(LADDER.size, 0.05 * scale), LADDER)
    return refine_normals(
        stack * np.float32(scale), lights, normals=start, gloss=gloss, settings=JointSettings(0.002 * scale)
    )


@case(
    "Joint fit of normals and gloss, all scaled by 2^-60 to 2^60",
    hazard="absolute guards in the normal equations",
    treatment="guards are relative, or far below every weight that can occur",
    reference="the same at scale 1",
    outcome="the same normals, sigma and flags; reflectance times the scale",
    bound=1e-6,
)
def test_equivariance_of_the_joint_fit():
    stack, lights = glossy_stack(1)
    start = tilted(stack.shape[2], 1)[None].astype(np.float32)
    plain = _joint(1.0, stack, lights, start)
    worst = 0.0
    for exponent in (-60, -20, 20, 60):
        scale = 2.0**exponent
        scaled = _joint(scale, stack, lights, start)
        worst = np.inf if (scaled.flags != plain.flags).any() else worst
        worst = max(worst, *(relative(getattr(scaled, n), getattr(plain, n)) for n in ("normals", "sigma", "cost")))
        worst = max(worst, relative(scaled.reflectance / scale, plain.reflectance))
    return worst


@case(
    "Subnormal observations",
    hazard="float32 keeps two digits near 1e-43, and its squares are 0",
    treatment="squares are float64: the rounding of the data is noise like any other, and sigma includes it",
    outcome="the angle to the truth stays below five sigma plus 0.1 degree",
    bound=5,
    unit="sigma",
)
def test_subnormal_observations():
    worst = 0.0
    stack, lights, normals, _ = matt_pixels(40, 60, 5, lowest=0.7)
    for scale in (3e-44, 1e-43, 1e-42, 1e-40, 1e-37):
        with np.errstate(under="ignore"):
            tiny = (stack.astype(np.float64) * scale).astype(np.float32)
        found = estimate_normals(tiny, lights, solver="least_squares")
        known = (found.flags[0] & NO_ESTIMATE) == 0
        angle = np.linalg.norm(found.normals[0] - normals, axis=-1)[known]
        worst = max(worst, float(((angle - 0.002) / np.maximum(found.sigma[0, known], 1e-6)).max()))
    return worst


@case(
    "Residual and sigma of data without noise",
    hazard="products of float32 inside a float64 sum: a floor of 2e-4, and 0 where squares underflow",
    treatment="samples are widened before they are squared",
    reference="least squares in float64 from the residuals themselves",
    outcome="residual and sigma true to the rounding of the samples, at 1e-20 and at 1e20 too",
    bound=1e-7,
    unit="of the albedo",
)
def test_residual_without_noise():
    worst = 0.0
    stack, lights, _, _ = matt_pixels(24, 50, 11)
    usable = stack > 0.02
    for scale in (1e-30, 1e-20, 1.0, 1e20, 1e30):
        values = (stack * np.float64(scale)).astype(np.float32)
        for given in (None, usable):
            found = estimate_normals(values, lights, usable=given, solver="least_squares")
            for p in range(50):
                kept = slice(None) if given is None else given[:, 0, p]
                sample = values[kept, 0, p].astype(np.float64)
                solution = np.linalg.lstsq(lights[kept], sample, rcond=None)[0]
                rest = np.sqrt(np.mean((sample - lights[kept] @ solution) ** 2))
                worst = max(worst, abs(found.residual[0, p] - rest) / np.linalg.norm(solution))
    return worst


@case(
    "float64 observations against float32",
    hazard="the selection and the lobe work in float32",
    treatment="sums are float64; only decisions and the lobe's curvature are float32",
    reference="the truth, noise-free",
    outcome="the angular error of float32 is that of its rounding",
    bound=3e-5,
    unit="radians",
)
def test_single_precision():
    stack, lights, normals, _ = matt_pixels(24, 300, 6)
    worst = 0.0
    for solver in SOLVERS:
        for given in (stack, stack.astype(np.float64)):
            found = estimate_normals(given, lights, usable=stack > 0, solver=solver)
            worst = max(worst, float(np.linalg.norm(found.normals[0] - normals, axis=-1).max()))
    return worst


@case(
    "Lights below the horizon and behind the surface",
    hazard="a lamp that cannot light the pixel pulls its normal",
    treatment="no sample of it is brighter than noise: the re-fit leaves it out as a shadow",
    reference="the truth",
    outcome="never chosen; the normal within the re-fit's noise floor of 0.003",
    bound=3e-3,
    unit="radians",
)
def test_lights_below_the_horizon():
    stack, lights, normals, _ = matt_pixels(20, 100, 7, most=0.5)
    behind = dome(6) * [1, 1, -1]
    more = np.concatenate([stack, np.zeros((6, 1, 100), np.float32)])
    every = np.concatenate([lights, behind])
    chosen = select_diffuse(more, every)
    found = estimate_normals(more, every, usable=chosen.usable, solver="least_squares")
    if (chosen.usable[20:, 0] & (behind @ normals.T < 0)).any():
        return np.inf
    return float(np.linalg.norm(found.normals[0] - normals, axis=-1).max())


@case(
    "Height of one pixel, one row, one valid pixel, a chessboard mask",
    hazard="division by the number of neighbours; a singular system for every part",
    treatment="each part has mean 0; a part of one pixel is 0",
    outcome="finite where valid, parts counted, NaN elsewhere",
    bound=0,
    unit="wrong outcomes",
)
def test_height_of_little():
    wrong = 0
    rng = np.random.default_rng(8)
    normals = tilted(256, 8, most=1.4).reshape(16, 16, 3)
    single, chess = np.zeros((16, 16), bool), np.indices((16, 16)).sum(axis=0) % 2 == 0
    single[4, 7] = True
    for shape in ((1, 1), (1, 7), (7, 1), (2, 2), (16, 16)):
        for method in ("auto", "dct", "weighted"):
            wrong += not np.isfinite(integrate_normals(normals[: shape[0], : shape[1]], method=method).height).all()
    for mask, parts in ((single, 1), (chess, 128), (rng.random((16, 16)) < 0.5, None)):
        found = integrate_normals(normals, valid=mask)
        wrong += not np.array_equal(np.isfinite(found.height), mask)
        wrong += parts is not None and (found.parts != parts or bool(found.height[mask].any()))
    return wrong


@case(
    "Normals that are no unit vectors, or missing",
    hazard="a slope of 1e300; NaN that spreads through the whole surface",
    treatment="such pixels are not valid, as where they are shaded",
    reference="the surface with these pixels masked",
    outcome="the same surface",
    bound=1e-6,
)
def test_height_of_broken_normals():
    normals = tilted(400, 9, most=0.8).reshape(20, 20, 3)
    mask = np.ones((20, 20), bool)
    places = [(3, 4), (9, 9), (15, 2), (0, 0), (19, 5)]
    broken = normals.copy()
    for place, bad in zip(places, ([0, 0, 0], [np.nan] * 3, [1e300, 0, 1], [0, 0, 5], [np.inf, 0, 0]), strict=True):
        broken[place], mask[place] = bad, False
    expected, found = integrate_normals(normals, valid=mask), integrate_normals(broken)
    inside = relative(found.height[mask], expected.height[mask])
    return max(inside, float((found.valid != mask).sum()), float((np.isfinite(found.height) != mask).sum()))


def _height_scale(exponent):
    normals = tilted(600, 10, most=1.2).reshape(20, 30, 3)
    plain, pitch = integrate_normals(normals), 10.0**exponent
    found = integrate_normals(normals, pixel_pitch=pitch)
    return max(relative(found.height / pitch, plain.height), abs(found.gradient_rms / plain.gradient_rms - 1))


@case(
    "Pixel pitch from 1e-12 to 1e12",
    hazard="absolute thresholds of the solver",
    treatment="the stopping rule is relative; a pitch beyond is refused with a remedy",
    reference="the same at pitch 1",
    outcome="heights times the pitch",
    bound=1e-4,
)
def test_height_scale():
    for pitch in (0.0, -1.0, np.nan, np.inf, 1e-13, 1e300):
        try:
            integrate_normals(np.full((3, 3, 3), [0.0, 0.0, 1.0]), pixel_pitch=pitch)
            return np.inf
        except UserError:
            continue
    return worst_over(_height_scale, st.floats(-12, 12), examples=20)


@case(
    "Normals at grazing incidence to the camera",
    hazard="slope 1 / n_z",
    treatment="n_z counts as 0.05 at least: steeper than 87 degrees is integrated as 87",
    outcome="finite; other pixels of a plane stay a plane",
    bound=1e-3,
    unit="of the slope",
)
def test_height_of_grazing_normals():
    normals = np.zeros((24, 24, 3))
    normals[...] = np.array([0.3, 0.0, 1.0]) / np.hypot(0.3, 1.0)
    normals[12, 12] = [1.0, 0.0, 1e-300]
    found = integrate_normals(normals)
    slope = np.diff(found.height.astype(float), axis=1)
    aside = np.ones(slope.shape, bool)
    aside[9:16, 8:16] = False
    return float(np.abs(slope[aside] + 0.3).max()) if np.isfinite(found.height).all() else np.inf
