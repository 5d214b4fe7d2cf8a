"""Lambert and one or two lobes fitted to a table of measured spectral reflectances (a gonioreflectometer's).

The BRDF of the model is f = rho_d / pi (cos theta_i cos theta_r)^a + sum_l beta_l D_l F G / (pi cos theta_i cos
theta_r): Tominaga and Tanaka (2004), eq. 10 divided by pi cos theta_i, the light of a white diffuser, with the body of
Minnaert (The reciprocity principle in lunar photometry, 1941, eq. 7; his k is a + 1).  Gloss of a dielectric is
neutral: one beta, gamma and refractive index for all bands, one rho_d a band; the exponent a >= 0 is common to the
bands, too, and 0 for Lambert.

Reflectances span four decades, so the error is measured after a cube root, which weighs light and dark about as the eye
does: e = (w f)^(1/3) - (w f_model)^(1/3) with w = cos theta_i cos theta_r.  The fit minimises that very error by
Levenberg-Marquardt from fixed starts, within bounds: a parameter at its bound that pushes outwards is held.  Its normal
equations have the shape of an arrow (each rho_d meets only the shared parameters), so that a step costs no more with 31
bands than the evaluation of the model.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from nishiki.brdf.torrance_sparrow import fresnel, half_vector_geometry, masking_over_cos_r
from nishiki.errors import UserError

START_WIDTHS = (0.03, 0.08, 0.2, 0.45)
SECOND_LOBE = 3.0  # the second lobe starts this much wider than the first
_TWO_LN2 = float(2 * np.log(2))
_LOG_LIMITS = {"width": (np.log(1e-3), np.log(3.0)), "strength": (-60.0, 60.0), "contrast": (np.log(0.3), np.log(1.0))}
_EXPONENT_LIMITS = (0.0, 2.0)  # of the body; not a logarithm, so that Lambert is inside
_AT_BOUND = 1e-6  # of a parameter's range
USUAL_INDEX = 1.45  # of a varnish or binder; none of paint is below 1.3 or above 2 (white lead)
PARTS = 3  # of the incidences, left out in turn


@dataclass(frozen=True)
class ReflectanceFit:
    """Parameters of the model and how well they describe the table."""

    diffuse: np.ndarray  # (bands,) rho_d; the albedo of the body for light along the normal is 2 rho_d / (2 + a)
    body_exponent: float  # a, 0 for Lambert
    beta: np.ndarray  # (lobes,) strength, relative to the white reference, narrowest lobe first
    gamma: np.ndarray  # (lobes,) half width at half maximum of D, radians
    width: np.ndarray  # (lobes,) of D as the distribution defines it: gamma, or the width of GGX
    distribution: str
    refractive_index: float
    predicted: np.ndarray  # (samples, bands) BRDF of the fit, 1 / sr
    r2_mean: float  # cube-root cosine-weighted R^2 of the mean over the bands
    r2_bands: float  # the same over all bands, pooled
    iterations: int
    at_bound: tuple[str, ...]  # parameters that ended at the end of their range, with the bound: the data want more


def directions(theta, phi) -> np.ndarray:
    """Unit vectors (..., 3) from the polar angle from the normal and the azimuth from x, radians."""
    theta, phi = np.asarray(theta, float), np.asarray(phi, float)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def r2_cube_root(measured, predicted, weight) -> float:
    """1 - sum (y - y')^2 / sum (y - mean y)^2 with y = (weight f)^(1/3) over all samples (and bands), pooled.

    measured, predicted: (samples,) or (samples, bands) >= 0; weight: (samples,), cos theta_i cos theta_r.
    """
    weight = np.reshape(weight, (-1,) + (1,) * (np.ndim(measured) - 1))
    y, model = np.cbrt(weight * measured), np.cbrt(weight * predicted)
    return float(1 - np.sum((y - model) ** 2) / np.sum((y - np.mean(y)) ** 2))


def fit_reflectance_table(
    lights,
    views,
    brdf,
    *,
    lobes=2,
    distribution="ggx",
    refractive_index=None,
    body_exponent=None,
    shared_from="bands",
) -> ReflectanceFit:
    """Fit a table: lights, views (samples, 3) unit directions, z the normal; brdf (samples, bands), 1 / sr.

    lobes: 1 or 2.  distribution: "ggx" (Walter et al., Microfacet models for refraction through rough surfaces, 2007;
    normalised to 1 at phi = 0, with the F and G of eq. 12 and 13) or "torrance_sparrow" (Tominaga and Tanaka 2004, eq.
    11, Gaussian in phi).
    refractive_index: None to fit it (1.3 .. 2), or a value.  body_exponent: None to fit it (0 .. 2), or a value, 0 for
    Lambert.  shared_from: "bands" (gloss and exponent from all bands) or "mean" (from the mean over the bands, then
    only rho_d in each band).  Samples at or behind the horizon, not finite or negative are an error.
    """
    lights, views, brdf = (np.asarray(a, float) for a in (lights, views, brdf))
    _check(lights, views, brdf, lobes, distribution, shared_from)
    lobe = _Lobes(lights, views, lobes, distribution, refractive_index, body_exponent)
    weight = lobe.geometry.cos_i * lobe.geometry.cos_r
    mean = brdf.mean(axis=1, keepdims=True)
    runs = []
    for width in START_WIDTHS:
        theta = lobe.start(width, mean[:, 0])
        runs.append(_levenberg_marquardt(lobe, weight, mean, theta, np.array([np.median(mean)]), shared=True))
    theta, _, _, iterations = min(runs, key=lambda run: run[2])
    diffuse = np.maximum(np.median(brdf, axis=0), 1e-6 * mean.max())
    theta, diffuse, _, more = _levenberg_marquardt(lobe, weight, brdf, theta, diffuse, shared=shared_from == "bands")
    predicted = diffuse * lobe.body(theta)[:, None] + lobe.evaluate(theta)[0][:, None]
    widths, strengths, index, exponent = lobe.unpack(theta)
    order = np.argsort(widths)
    return ReflectanceFit(
        diffuse=diffuse * np.pi,
        body_exponent=exponent,
        beta=strengths[order] * np.pi,
        gamma=lobe.half_width(widths[order]),
        width=widths[order],
        distribution=distribution,
        refractive_index=index,
        predicted=predicted,
        r2_mean=r2_cube_root(brdf.mean(axis=1), predicted.mean(axis=1), weight),
        r2_bands=r2_cube_root(brdf, predicted, weight),
        iterations=iterations + more,
        at_bound=lobe.at_bound(theta),
    )


def chosen_by_incidences(lights, views, brdf, *, distribution="ggx") -> tuple[ReflectanceFit, float]:
    """Fit a table with the lobes, index and exponent that predict incidences left out best, and their R^2 of the mean.

    Every third of the angles of incidence is left out in turn (of single samples where there are fewer angles): beside
    those that were measured, two lobes whose index is free may be anything.
    """
    lights, views, brdf = (np.asarray(each, float) for each in (lights, views, brdf))
    angles, number = np.unique(np.round(np.degrees(np.arccos(np.clip(lights[:, 2], -1, 1)))), return_inverse=True)
    part = (number if angles.size >= PARTS else np.arange(len(brdf))) % PARTS
    mean, best = brdf.mean(axis=1, keepdims=True), (-np.inf, {})
    for lobes, index, exponent in itertools.product((1, 2), (USUAL_INDEX, None), (0.0, None)):
        settings = {"lobes": lobes, "refractive_index": index, "body_exponent": exponent, "distribution": distribution}
        predicted = np.empty_like(mean)
        for left_out in (part == k for k in range(PARTS)):
            fit = fit_reflectance_table(lights[~left_out], views[~left_out], mean[~left_out], **settings)
            predicted[left_out] = predict_reflectances(fit, lights[left_out], views[left_out])
        best = max(
            best, (r2_cube_root(mean, predicted, lights[:, 2] * views[:, 2]), settings), key=lambda each: each[0]
        )
    return fit_reflectance_table(lights, views, brdf, **best[1]), best[0]


def predict_reflectances(fit: ReflectanceFit, lights, views) -> np.ndarray:
    """BRDF (samples, bands) of a fit at other directions (samples, 3) above the horizon, 1 / sr."""
    lights, views = np.asarray(lights, float), np.asarray(views, float)
    lobe = _Lobes(lights, views, len(fit.width), fit.distribution, fit.refractive_index, fit.body_exponent)
    theta = np.log(np.concatenate([fit.width, fit.beta / np.pi]))
    return fit.diffuse / np.pi * lobe.body(theta)[:, None] + lobe.evaluate(theta)[0][:, None]


def _check(lights, views, brdf, lobes, distribution, shared_from):
    for name, value, choices in (
        ("lobes", lobes, (1, 2)),
        ("distribution", distribution, ("torrance_sparrow", "ggx")),
        ("shared_from", shared_from, ("bands", "mean")),
    ):
        if value not in choices:
            raise UserError(f"{name}: expected one of {choices}, found {value!r}")
    if brdf.ndim != 2 or lights.shape != (len(brdf), 3) or views.shape != lights.shape:
        found = f"{lights.shape}, {views.shape}, {brdf.shape}"
        raise UserError(f"expected lights (samples, 3), views (samples, 3) and brdf (samples, bands), found {found}")
    bad = ~(np.isfinite(brdf).all(axis=1) & (brdf >= 0).all(axis=1) & (lights[:, 2] > 0) & (views[:, 2] > 0))
    if bad.any():
        rows = np.flatnonzero(bad)
        raise UserError(
            f"expected finite reflectances >= 0 and directions above the horizon, found {rows.size} samples "
            f"otherwise, the first in row {rows[0]}; leave them out"
        )


class _Lobes:
    """The shared part of the model and its derivatives: gloss, and the shape of the body.

    Parameters theta: logarithms of the widths, the strengths and n - 1, then the body's exponent; of the last two, what
    is fitted.
    """

    def __init__(self, lights, views, lobes, distribution, refractive_index, body_exponent):
        self.geometry = g = half_vector_geometry(np.array([0.0, 0.0, 1.0]), lights, views)
        self.bounded = masking_over_cos_r(g.cos_phi, g.cos_i, g.cos_r, g.cos_q) / g.cos_i
        self.lobes, self.ggx, self.index = lobes, distribution == "ggx", refractive_index
        self.exponent = body_exponent
        self.log_cosines = np.log(g.cos_i * g.cos_r)
        self.tan2 = np.tan(g.phi) ** 2
        self.cos4 = np.cos(g.phi) ** 4
        limits = [_LOG_LIMITS["width"]] * lobes + [_LOG_LIMITS["strength"]] * lobes
        limits += [] if refractive_index else [_LOG_LIMITS["contrast"]]
        self.gloss = len(limits)  # parameters of the gloss; the exponent comes behind them
        limits += [_EXPONENT_LIMITS] if body_exponent is None else []
        self.low, self.high = np.array(limits).T

    def unpack(self, theta):
        """Widths, strengths, refractive index and the exponent of the body."""
        index = self.index if self.index else 1 + float(np.exp(theta[2 * self.lobes]))
        exponent = float(theta[-1]) if self.exponent is None else self.exponent
        return np.exp(theta[: self.lobes]), np.exp(theta[self.lobes : 2 * self.lobes]), index, exponent

    def at_bound(self, theta):
        """Names of the parameters at the end of their range, each with the bound; the narrower lobe is number 1."""
        order = np.argsort(np.argsort(theta[: self.lobes])) + 1
        names = [f"gamma {number}" for number in order] + [f"beta {number}" for number in order]
        names += ([] if self.index else ["refractive_index"]) + ["body_exponent"]
        # GGX widths are bounded before they become half widths; both are told in radians.
        bounds = {"gamma": lambda v: float(self.half_width(np.exp([v]))[0]), "beta": lambda v: np.pi * np.exp(v)}
        bounds |= {"refractive_index": lambda v: 1 + np.exp(v), "body_exponent": float}
        near = _AT_BOUND * (self.high - self.low)
        found = []
        for name, value, low, high, close in zip(names, theta, self.low, self.high, near, strict=False):
            if min(value - low, high - value) <= close and not (name == "body_exponent" and value - low <= close):
                bound = bounds[name.split()[0]](low if value - low <= close else high)
                found.append(f"{name} at {bound:.4g}")
        return tuple(found)

    def body(self, theta):
        """(cos theta_i cos theta_r)^a, (samples,)."""
        return np.exp(self.unpack(theta)[3] * self.log_cosines)

    def half_width(self, widths):
        """Half width at half maximum of D; a GGX width w has (cos^2 + sin^2 / w^2)^2 = 2 there."""
        if not self.ggx:
            return widths
        return np.arcsin(np.sqrt(np.clip((np.sqrt(2) - 1) / np.maximum(widths**-2 - 1, 1e-12), 0, 1)))

    def shape(self, width):
        """D and its derivative by log width."""
        if self.ggx:
            ratio = self.tan2 / width**2
            d = 1 / (self.cos4 * (1 + ratio) ** 2)
            return d, 4 * ratio / (1 + ratio) * d
        ratio2 = (self.geometry.phi / width) ** 2
        d = np.exp2(-ratio2)
        return d, _TWO_LN2 * ratio2 * d

    def evaluate(self, theta):
        """Specular BRDF (samples,) and its derivatives (samples, parameters of the gloss)."""
        widths, strengths, index, _ = self.unpack(theta)
        f = fresnel(self.geometry.cos_q, index)
        columns, total = np.empty((f.size, self.gloss)), np.zeros(f.size)
        for k in range(self.lobes):
            d, slope = self.shape(widths[k])
            columns[:, k] = strengths[k] * slope * f * self.bounded
            columns[:, self.lobes + k] = strengths[k] * d * f * self.bounded
            total += columns[:, self.lobes + k]
        if not self.index:
            step = 1e-5 * (index - 1)
            change = fresnel(self.geometry.cos_q, index + step) - fresnel(self.geometry.cos_q, index - step)
            columns[:, -1] = total / f * change / 2e-5
        return total, columns

    def start(self, width, mean):
        """Parameters at a first width: the strength that reaches the largest reflectances, shared by the lobes."""
        widths = np.log(width * SECOND_LOBE ** np.arange(self.lobes))
        rest = ([] if self.index else [np.log(0.5)]) + ([0.0] if self.exponent is None else [])
        theta = np.concatenate([widths, np.zeros(self.lobes), rest])
        total = self.evaluate(theta)[0]
        bright = mean >= np.quantile(mean, 0.98)
        strength = np.log(mean[bright].sum() / max(total[bright].sum(), 1e-30))
        theta[self.lobes : 2 * self.lobes] = strength - np.log(4.0) * np.arange(self.lobes)
        return np.clip(theta, self.low, self.high)


def _levenberg_marquardt(lobe, weight, brdf, theta, diffuse, *, shared, iterations=120):
    """Minimise the cube-root error over diffuse (bands,) and, if shared, theta: (theta, diffuse, cost, steps)."""
    root = np.cbrt(weight)[:, None]
    target = root * np.cbrt(brdf)
    kappa, damping, steps = np.log(diffuse), 1e-3, 0

    def state(theta, kappa):
        specular, columns = lobe.evaluate(theta)
        body = lobe.body(theta)
        model = body[:, None] * np.exp(kappa) + specular[:, None]
        cube = np.cbrt(model)
        rest = target - root * cube
        return columns, body, rest, root / (3 * cube * cube), float(np.sum(rest * rest))

    *now, cost = state(theta, kappa)
    for _ in range(iterations):
        steps += 1
        kappa_step, theta_step = _arrow_step(lobe, *now, np.exp(kappa), theta, damping, shared)
        kappa_new = np.clip(kappa + np.clip(kappa_step, -2, 2), -60, 60)
        theta_new = np.clip(theta + np.clip(theta_step, -0.7, 0.7), lobe.low, lobe.high)
        *trial, trial_cost = state(theta_new, kappa_new)
        if trial_cost < cost:
            done = cost - trial_cost < 1e-9 * cost
            theta, kappa, now, cost = theta_new, kappa_new, trial, trial_cost
            damping = max(damping / 5, 1e-9)
            if done:
                break
        else:
            damping *= 6
            if damping > 1e8:
                break
    return theta, np.exp(kappa), cost, steps


def _arrow_step(lobe, columns, body, rest, gain, diffuse, theta, damping, shared):
    """Levenberg-Marquardt step of (log diffuse, theta): the bands are eliminated first (Schur complement).

    The gloss's columns are common to the bands.  The exponent's is the body times log(cos theta_i cos theta_r), other
    in each band by its diffuse alone, so that it needs the sums of gain^2 times diffuse and diffuse^2 besides.
    """
    gain2, slope = gain * gain, gain * rest
    head = diffuse**2 * (body**2 @ gain2) * (1 + damping)
    head = np.maximum(head, 1e-30)
    head_rest = diffuse * (body @ slope)
    if not shared:
        return head_rest / head, np.zeros(theta.size)
    border = diffuse[:, None] * (gain2.T @ (body[:, None] * columns))
    block = columns.T @ (gain2.sum(axis=1)[:, None] * columns)
    right = columns.T @ slope.sum(axis=1)
    if lobe.exponent is None:
        bent = body * lobe.log_cosines
        mixed = columns.T @ (bent * (gain2 @ diffuse))
        block = np.block([[block, mixed[:, None]], [mixed[None], np.sum(bent**2 * (gain2 @ diffuse**2))]])
        border = np.column_stack([border, diffuse**2 * (gain2.T @ (body * bent))])
        right = np.append(right, np.sum(bent * (slope @ diffuse)))
    block += np.diag(damping * np.diag(block) + 1e-30)
    schur = block - border.T @ (border / head[:, None])
    right = right - border.T @ (head_rest / head)
    free = np.ones(theta.size, bool)
    while True:
        step = np.zeros(theta.size)
        step[free] = np.linalg.lstsq(schur[np.ix_(free, free)], right[free], rcond=None)[0]
        outwards = free & (((theta <= lobe.low) & (step < 0)) | ((theta >= lobe.high) & (step > 0)))
        if not outwards.any():
            return (head_rest - border @ step) / head, step
        free &= ~outwards
