"""Torrance-Sparrow and its fits: narrow and wide lobes, grazing directions, missing highlights, extreme scales."""

import json

import mpmath
import numpy as np
from compiled_lobe import specular_scalar
from hypothesis import strategies as st
from point_fits import FitFlag, fit_torrance_sparrow
from published_fits import fit_lobe
from stability.cases import case, powers_of_ten, relative, worst_over
from stability.samples import EXTREME, dome, tilted

from nishiki.brdf.gloss_profile import SpecularHistogram, fit_gloss
from nishiki.brdf.torrance_sparrow import facet_distribution, fresnel, masking_over_cos_r, specular
from nishiki.photometric.gloss import GlossTile
from nishiki.photometric.gloss_scene import fit_scene_gloss
from nishiki.stages.brdf.painting import fit_regions

LOST = FitFlag.NO_HIGHLIGHT | FitFlag.TOO_FEW
GRAZING = st.one_of(st.floats(0, np.pi / 2), powers_of_ten(-12, 0).map(lambda d: np.pi / 2 - d), powers_of_ten(-12, 0))


def _unit(theta, phi):
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def exact_specular(n, light, view, gamma, index):
    """D F G / cos_r in 60 digits from the floats as they are (Tominaga and Tanaka 2004, eq. 10-13)."""
    n, i, o = ([mpmath.mpf(float(v)) for v in d] for d in (n, light, view))

    def dot(a, b):
        return sum(x * y for x, y in zip(a, b, strict=True))

    cos_i, cos_r = dot(n, i), dot(n, o)
    if cos_i <= 0 or cos_r <= 0:
        return mpmath.mpf(0)
    total = [a + b for a, b in zip(i, o, strict=True)]
    length = mpmath.sqrt(dot(total, total))
    cross = [n[1] * total[2] - n[2] * total[1], n[2] * total[0] - n[0] * total[2], n[0] * total[1] - n[1] * total[0]]
    phi = mpmath.atan2(mpmath.sqrt(dot(cross, cross)), dot(n, total))
    c = min(length / 2, 1)
    g = mpmath.sqrt(mpmath.mpf(index) ** 2 - 1 + c * c)
    f = ((g - c) / (g + c)) ** 2 / 2 * (1 + ((c * (g + c) - 1) / (c * (g - c) + 1)) ** 2) if g + c > 0 else 0
    groove = min(1, 2 * dot(n, total) / length * min(cos_r, cos_i) / c)
    return mpmath.exp(-mpmath.log(2) * (phi / mpmath.mpf(gamma)) ** 2) * f * groove / cos_r, phi, length


def _model_error(theta_i, phi_i, theta_r, gamma, contrast):
    n, light, view = np.array([0.0, 0.0, 1.0]), _unit(theta_i, phi_i), _unit(theta_r, np.pi)
    index = 1 + contrast
    with mpmath.workdps(60):
        found = exact_specular(n, light, view, gamma, index)
        if not isinstance(found, tuple):
            return 0.0
        exact, phi, length = found
        # phi is known to a rounding over the length of light + view, and the width magnifies it
        sensitivity = 1 + 2 * float(phi) / gamma**2 / float(length) + 1 / contrast + 1 / min(light[2], view[2], length)
        exact = float(exact)
    if exact < 1e-280 or float(phi) > 7 * gamma:
        return 0.0
    arrays = float(specular(n, light, view, beta=1.0, gamma=gamma, refractive_index=index))
    scalar = specular_scalar(*n, *light, *view, gamma, index)
    return max(abs(arrays / exact - 1), abs(scalar / exact - 1)) / float(sensitivity)


@case(
    "Torrance-Sparrow from 1e-4 to 100 rad wide, down to the horizon, index towards 1",
    hazard="1 / cos_r, acos near 1, g - c where n -> 1, phi / gamma",
    treatment="atan2, sin^2(phi / 2), (n^2 - 1) / (g + c), G / cos_r without its singularity",
    reference="mpmath, 60 digits",
    outcome="array and compiled form exact to rounding",
    bound=2e-13,
    unit="relative, over the sensitivity to the directions",
)
def test_model_against_high_precision():
    drawn = GRAZING, st.floats(-np.pi, np.pi), GRAZING, powers_of_ten(-4, 2), powers_of_ten(-8, 1)
    return worst_over(_model_error, *drawn, examples=300)


@case(
    "float32 directions in the compiled model",
    hazard="cos phi rounded to 6e-8 loses lobes narrower than 1e-3",
    treatment="widened to float64 before anything is subtracted (the compiled float() would keep float32)",
    reference="the array form in float64 of the same numbers",
    outcome="equal but for the length of rounded unit vectors, down to lobes of 1e-4",
    bound=2e-6,
)
def test_model_of_single_precision():
    worst = 0.0
    for gamma in (1e-4, 1e-3, 0.1):
        for n in tilted(40, 0, most=3 * gamma).astype(np.float32):
            light, view = (d.astype(np.float32) for d in (_unit(0.5, 0.3), _unit(0.5, 0.3 + np.pi)))
            found = specular_scalar(*n, *light, *view, np.float32(gamma), 1.5)
            wide = (d.astype(np.float64) for d in (n, light, view))
            exact = float(specular(*wide, beta=1, gamma=float(np.float32(gamma)), refractive_index=1.5))
            worst = max(worst, abs(found - exact) / max(exact, 1e-6))
    return worst


@case(
    "The parts of the model at their ends",
    hazard="gamma -> 0 and infinity, n -> 1 and infinity, cosines of 0 and subnormal",
    treatment="quotients before squares; limits set where 0 / 0",
    outcome="finite, inside 0 .. 1 (G / cos_r: finite)",
    bound=0,
    unit="wrong values",
)
def test_parts_at_their_ends():
    ends = np.array([0.0, 5e-324, 1e-310, 1e-160, 1e-16, 0.5, 1.0])
    phi, gamma = np.meshgrid([0.0, 1e-300, 1e-8, 1.0, np.pi], [5e-324, 1e-300, 1e-8, 1.0, 1e300, np.inf])
    d = facet_distribution(phi, gamma)
    wrong = int((~((d >= 0) & (d <= 1))).sum() + (d[phi == 0] != 1).sum())
    for n in (1.0, 1 + 1e-16, 1 + 1e-12, 1.45, 1e8, 1e150):
        f = fresnel(ends, n)
        wrong += int((~((f >= 0) & (f <= 1 + 1e-12))).sum())
    wrong += int((fresnel(0.0, 1.45) != 1) + (fresnel(ends, 1.0) != 0).sum())
    grid = np.stack(np.meshgrid(ends, ends, ends, ends)).reshape(4, -1)
    with np.errstate(over="ignore"):
        wrong += int(np.isnan(masking_over_cos_r(*grid)).sum())
    return wrong


def lobes(seed, points=60, observations=24, channels=3):
    rng = np.random.default_rng(seed)
    phi = np.abs(rng.normal(size=(points, observations))) * 0.3
    a, q = rng.uniform(0.5, 2, phi.shape), rng.uniform(0, 1, phi.shape)
    gamma = 10.0 ** rng.uniform(-1.5, -0.2, points)
    k = rng.uniform(0.1, 3, (points, 1, channels))
    y = 0.4 * q[..., None] + k * (a * np.exp2(-((phi / gamma[:, None]) ** 2)))[..., None]
    return phi, y, a, q, gamma, k[:, 0]


def _stiff_error(log_beta, log_gamma, seed):
    """Recovered strength and width of a noise-free lobe beside a diffuse term, with no start to choose."""
    beta, gamma = 10.0**log_beta, 10.0**log_gamma
    rng = np.random.default_rng(seed)
    phi = np.sort(np.minimum(np.concatenate([rng.uniform(0, 3 * gamma, 14), rng.uniform(0, 1.5, 6)]), 1.5))[None]
    q = rng.uniform(0.1, 1, phi.shape)
    y = (0.5 * q + beta * np.exp2(-((phi / gamma) ** 2)))[..., None]
    found = fit_torrance_sparrow(phi, y, diffuse=q)
    if found.flags[0] & LOST:
        return np.inf
    return max(
        abs(found.gamma[0] / gamma - 1), abs(found.specular[0, 0] / beta - 1), abs(found.diffuse[0, 0] / 0.5 - 1)
    )


@case(
    "beta from 1e-3 to 1e6 beside gamma from 0.002 to 1",
    hazard="a stiff problem: one parameter changes by 1e-6 while another does by 1e3",
    treatment="variable projection: strengths eliminated, a global search in log gamma",
    reference="the truth, noise-free",
    outcome="recovered from no start at all",
    bound=1e-6,
)
def test_badly_scaled_lobes():
    return worst_over(_stiff_error, st.floats(-3, 6), st.floats(-2.7, 0), st.integers(0, 20), examples=150)


@case(
    "The same by Levenberg-Marquardt, the baseline",
    hazard="the search runs to no width or to an infinite one; 0 times infinity in the derivative",
    treatment="phi / gamma is held where 2^-x is 0; without a finite covariance or width it has not converged",
    reference="the truth, noise-free",
    outcome="finite; 8 of 20 starts do not reach the truth, of which it does not tell at most three",
    bound=3,
    unit="of 20 wrong and called converged",
)
def test_baseline_is_honest():
    wrong = 0
    for start in ((1, 0.1), (1e6, 0.1), (1e-6, 1.0), (164, 0.07), (1, 1e-3)):
        for beta, gamma in ((164, 0.07), (1e-6, 0.07), (1e6, 0.1), (1, 1.5)):
            phi = np.linspace(0, 1.5, 300)
            b, g, _, residual, converged = fit_lobe(
                phi, beta * np.exp2(-((phi / gamma) ** 2)), np.ones(300), start=start
            )
            if not np.isfinite([b, g, residual]).all():
                return np.inf
            wrong += converged and max(abs(b / beta - 1), abs(g / gamma - 1)) > 1e-6
    return wrong


@case(
    "Observations, attenuation and weights times 2^-60 to 2^60",
    hazard="absolute thresholds",
    treatment="columns and observations are scaled to a mean of 1",
    reference="the same at scale 1",
    outcome="the same bits: widths, deviations, flags; strengths times the scale",
    bound=0,
    unit="values that differ",
)
def test_equivariance_of_points():
    differ = 0
    phi, y, a, q, _, _ = lobes(1)
    for real in (np.float32, np.float64):
        p, o, t, d = (m.astype(real) for m in (phi, y, a, q))
        plain = fit_torrance_sparrow(p, o, attenuation=t, diffuse=d)
        for exponent in (-60, -20, 20, 60):
            s = real(2.0**exponent)
            found = fit_torrance_sparrow(p, o * s, attenuation=t, diffuse=d)
            other = fit_torrance_sparrow(p, o, attenuation=t * s, diffuse=d * s, weights=np.full(p.shape, s))
            for each, factor in ((found, s), (other, 1 / s)):
                for name in ("gamma", "sigma_log_gamma", "flags", "lit", "used"):
                    differ += not np.array_equal(getattr(each, name), getattr(plain, name), equal_nan=True)
                differ += int((each.specular != plain.specular * factor).sum())
    return differ


def _anything(seed, sizes, share):
    rng = np.random.default_rng(seed)
    phi, y, a, q, _, _ = lobes(seed, points=20, observations=int(rng.integers(1, 20)), channels=1 + 2 * (seed % 2))
    y = y * 10.0**sizes
    weights = np.abs(rng.choice([0, 1, 1e-30, 1e30, 0.5], phi.shape))
    for each in (phi, a, q, y):
        spoilt = rng.random(each.shape) < share
        each[spoilt] = rng.choice(EXTREME, spoilt.sum())
    wrong = 0
    for real in (np.float32, np.float64):
        with np.errstate(over="ignore", invalid="ignore"):
            p, o, t, d = (m.astype(real) for m in (np.abs(phi), y, np.abs(a), np.abs(q)))
        for w in (None, weights):
            found = fit_torrance_sparrow(p, o, attenuation=t, diffuse=d, weights=w)
            wrong += sum(int((~np.isfinite(getattr(found, n))).sum()) for n in ("specular", "diffuse", "residual"))
            wrong += int((found.specular < 0).sum() + (found.diffuse < 0).sum())
            told = (found.flags & LOST) == 0
            wrong += int((~np.isfinite(found.gamma[told])).sum() + np.isnan(found.sigma_log_gamma[told]).sum())
            wrong += int((~np.isnan(found.gamma[~told])).sum() + np.count_nonzero(found.specular[~told]))
    return wrong


@case(
    "Points with observations, cosines and weights of any size, NaN and infinity among them",
    hazard="sums of squares beyond float32",
    treatment="what is not finite gets no weight; a point whose sums are not finite is flagged not_finite and too_few",
    outcome="finite and not negative; gamma NaN exactly where flagged",
    bound=0,
    unit="wrong values",
)
def test_points_of_any_size():
    return worst_over(_anything, st.integers(0, 10**6), st.floats(-44, 38), st.floats(0, 0.4), examples=40)


@case(
    "Points without a highlight, with too few observations, with zero albedo",
    hazard="a width fitted to noise",
    treatment="a lobe has to pass an F test; flagged no_highlight or too_few: strength 0, gamma NaN",
    reference="the stated flags",
    outcome="flagged; at most 1 in 200 matt points shows a lobe",
    bound=0.005,
    unit="of the points wrong",
)
def test_no_highlight():
    rng = np.random.default_rng(5)
    phi, _, a, q, _, _ = lobes(5, points=1000)
    matt = 0.4 * q[..., None] + 0.01 * rng.normal(size=(*phi.shape, 3))
    found = fit_torrance_sparrow(phi, matt, attenuation=a, diffuse=q)
    wrong = ((found.flags & FitFlag.NO_HIGHLIGHT) == 0).mean()
    black = fit_torrance_sparrow(phi, np.zeros_like(matt), attenuation=a, diffuse=q)
    few = fit_torrance_sparrow(phi[:, :2], matt[:, :2], attenuation=a[:, :2], diffuse=q[:, :2])
    none = fit_torrance_sparrow(phi, np.full_like(matt, np.nan), attenuation=a, diffuse=q)
    sure = (black.flags & FitFlag.NO_HIGHLIGHT).all() and (few.flags & FitFlag.TOO_FEW).all()
    sure = sure and (none.flags & FitFlag.TOO_FEW).all() and not black.diffuse.any() and not none.diffuse.any()
    return float(wrong) if sure else np.inf


def histogram(scale=1.0, unit=1.0, beta=2.0, gamma=0.1):
    rng = np.random.default_rng(1)
    phi = np.abs(rng.normal(size=4000)) * 0.2
    value = scale * (0.04 * beta * np.exp2(-((phi / gamma) ** 2)) + 1e-3 * rng.normal(size=4000))
    return SpecularHistogram.empty(value_unit=unit).add_samples(phi, value, np.full(4000, 0.04), sigma=0.01)


@case(
    "Gloss of a scene in units from 1e-12 to 1e12 of the white reference",
    hazard="cells of the histogram are absolute",
    treatment="cells are in a stated unit of radiance; the fit works in units of the largest value",
    reference="the same at scale 1",
    outcome="strengths times the unit",
    bound=1e-5,
)
def test_scene_scale():
    worst, mixture = 0.0, fit_gloss(histogram())
    for unit in (1e-12, 1e-6, 1e6, 1e12):
        worst = max(worst, relative(fit_gloss(histogram(unit, unit)).beta / unit, mixture.beta))
    return worst


@case(
    "Scene without samples, with one, with values of 0, below 0, NaN, 1e300",
    hazard="mean and quartiles of nothing; a^2 z beyond float64",
    treatment="samples whose products are not finite are left out",
    outcome="beta 0 and a finite gamma, plain JSON without NaN",
    bound=0,
    unit="wrong outcomes",
)
def test_scene_of_nothing():
    phi, ones = np.linspace(0, 1, 500), np.ones(500)
    empty = np.empty(0)
    samples = [
        (empty, empty, empty), (phi[:1], ones[:1], ones[:1]), (phi, 0 * ones, ones), (phi, -ones, ones),
        (phi, np.nan * ones, ones), (phi, 1e300 * ones, 1e-300 * ones), (phi, ones, 1e-300 * ones),
        (phi, ones, 1e200 * ones), (0 * phi, ones, ones), (phi, np.inf * ones, ones), (np.nan * phi, ones, ones),
    ]  # fmt: skip
    wrong = 0
    for sample in samples:
        histogram = SpecularHistogram.empty().add_samples(*sample)
        wrong += bool(fit_gloss(histogram).beta.any())
        json.dumps(fit_regions(histogram), allow_nan=False)
    return wrong


def _tile(scale):
    rng = np.random.default_rng(2)
    lights, normals = dome(12), tilted(150, 2, most=0.4)
    halves = lights + np.array([0, 0, 1])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    angle = np.arccos(np.clip(halves @ normals.T, -1, 1))
    albedo = rng.uniform(0.1, 0.8, (150, 3))
    stack = np.maximum(lights @ normals.T, 0)[..., None] * albedo + (0.1 * np.exp(-((angle / 0.15) ** 2)))[..., None]
    stack = (scale * (stack + 0.002 * rng.normal(size=stack.shape))).astype(np.float32)[:, None]
    flags, sigma = np.zeros((1, 150), np.uint8), np.full((1, 150), 0.01, np.float32)
    reflectance = (scale * albedo).astype(np.float32)[None]
    return GlossTile(
        stack, np.ones(stack.shape[:3], bool), lights, normals[None].astype(np.float32), flags, sigma, reflectance
    )


@case(
    "Gloss of a scene photographed without a white board, in any unit from 1e-12 to 1e12",
    hazard="noise and histogram are stated relative to white, which such a scene does not have",
    treatment="the unit follows from the median reflectance where that is not of the order of a white",
    reference="the same at scale 1",
    outcome="the same decision and profile, times the scale",
    bound=1e-3,
)
def test_gloss_without_white():
    worst = 0.0
    plain = fit_scene_gloss([_tile(1.0)])
    for scale in (1e-12, 1e-6, 1e6, 1e12):
        found = fit_scene_gloss([_tile(scale)])
        worst = worst if found.significant == plain.significant else np.inf
        worst = max(worst, relative(found.profile.beta / scale, plain.profile.beta), abs(found.gain - plain.gain))
    return worst
