"""Lambert and one or two lobes fitted to a table of measured spectral reflectances (a gonioreflectometer's).

The BRDF of the model is f = rho_d / pi + sum_l beta_l D_l F G / (pi cos theta_i cos theta_r): P eq. 10 divided by
pi cos theta_i, the light of a white diffuser.  Gloss of a dielectric is neutral: one beta, gamma and refractive index
for all bands, one rho_d a band.

Reflectances span four decades, so the error is measured after a cube root, which weighs light and dark about as the eye
does: e = (w f)^(1/3) - (w f_model)^(1/3) with w = cos theta_i cos theta_r.  The fit minimises that very error by
Levenberg-Marquardt.  Its normal equations have the shape of an arrow (each rho_d meets only the shared parameters), so
that a step costs no more with 31 bands than the evaluation of the model.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.torrance_sparrow import fresnel, half_vector_geometry, masking_over_cos_r
from nishiki.errors import UserError

START_WIDTHS = (0.03, 0.08, 0.2, 0.45)
SECOND_LOBE = 3.0  # the second lobe starts this much wider than the first
_TWO_LN2 = float(2 * np.log(2))
_LOG_LIMITS = {"width": (np.log(1e-3), np.log(3.0)), "strength": (-60.0, 60.0), "contrast": (np.log(0.02), np.log(3.0))}


@dataclass(frozen=True)
class ReflectanceFit:
    """Parameters of the model and how well they describe the table."""

    diffuse: np.ndarray  # (bands,) rho_d, albedo of the Lambert term
    beta: np.ndarray  # (lobes,) strength, relative to the white reference, narrowest lobe first
    gamma: np.ndarray  # (lobes,) half width at half maximum of D, radians
    refractive_index: float
    predicted: np.ndarray  # (samples, bands) BRDF of the fit, 1 / sr
    r2_mean: float  # cube-root cosine-weighted R^2 of the mean over the bands
    r2_bands: float  # the same over all bands, pooled
    iterations: int


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
    lights, views, brdf, *, lobes=2, distribution="torrance_sparrow", refractive_index=None, shared_from="bands"
) -> ReflectanceFit:
    """Fit a table: lights, views (samples, 3) unit directions, z the normal; brdf (samples, bands), 1 / sr.

    lobes: 1 or 2.  distribution: "torrance_sparrow" (Gaussian in phi) or "ggx" (Walter et al., Microfacet models for
    refraction through rough surfaces, 2007; normalised to 1 at phi = 0, with the same F and G).  refractive_index: None
    to fit it (1.02 .. 4), or a value.  shared_from: "bands" (gloss from all bands) or "mean" (gloss from the mean over
    the bands, then only rho_d in each band).  Samples at or behind the horizon, not finite or negative are an error.
    """
    lights, views, brdf = (np.asarray(a, float) for a in (lights, views, brdf))
    _check(lights, views, brdf, lobes, distribution, shared_from)
    lobe = _Lobes(lights, views, lobes, distribution, refractive_index)
    weight = lobe.geometry.cos_i * lobe.geometry.cos_r
    mean = brdf.mean(axis=1, keepdims=True)
    runs = []
    for width in START_WIDTHS:
        theta = lobe.start(width, mean[:, 0])
        runs.append(_levenberg_marquardt(lobe, weight, mean, theta, np.array([np.median(mean)]), shared=True))
    theta, _, _, iterations = min(runs, key=lambda run: run[2])
    diffuse = np.maximum(np.median(brdf, axis=0), 1e-6 * mean.max())
    theta, diffuse, _, more = _levenberg_marquardt(lobe, weight, brdf, theta, diffuse, shared=shared_from == "bands")
    predicted = diffuse + lobe.evaluate(theta)[0][:, None]
    widths, strengths, index = lobe.unpack(theta)
    order = np.argsort(widths)
    return ReflectanceFit(
        diffuse=diffuse * np.pi,
        beta=strengths[order] * np.pi,
        gamma=lobe.half_width(widths[order]),
        refractive_index=index,
        predicted=predicted,
        r2_mean=r2_cube_root(brdf.mean(axis=1), predicted.mean(axis=1), weight),
        r2_bands=r2_cube_root(brdf, predicted, weight),
        iterations=iterations + more,
    )


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
    """The specular part of the table and its derivatives; parameters are logarithms: widths, strengths, n - 1."""

    def __init__(self, lights, views, lobes, distribution, refractive_index):
        self.geometry = g = half_vector_geometry(np.array([0.0, 0.0, 1.0]), lights, views)
        self.bounded = masking_over_cos_r(g.cos_phi, g.cos_i, g.cos_r, g.cos_q) / g.cos_i
        self.lobes, self.ggx, self.index = lobes, distribution == "ggx", refractive_index
        self.tan2 = np.tan(g.phi) ** 2
        self.cos4 = np.cos(g.phi) ** 4
        limits = [_LOG_LIMITS["width"]] * lobes + [_LOG_LIMITS["strength"]] * lobes
        limits += [] if refractive_index else [_LOG_LIMITS["contrast"]]
        self.low, self.high = np.array(limits).T

    def unpack(self, theta):
        index = self.index if self.index else 1 + float(np.exp(theta[-1]))
        return np.exp(theta[: self.lobes]), np.exp(theta[self.lobes : 2 * self.lobes]), index

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
        """Specular BRDF (samples,) and its derivatives (samples, parameters)."""
        widths, strengths, index = self.unpack(theta)
        f = fresnel(self.geometry.cos_q, index)
        columns, total = np.empty((f.size, theta.size)), np.zeros(f.size)
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
        theta = np.concatenate([widths, np.zeros(self.lobes), [] if self.index else [np.log(0.5)]])
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
        model = np.exp(kappa) + specular[:, None]
        cube = np.cbrt(model)
        rest = target - root * cube
        return columns, rest, root / (3 * cube * cube), float(np.sum(rest * rest))

    columns, rest, gain, cost = state(theta, kappa)
    for _ in range(iterations):
        steps += 1
        new = _arrow_step(columns, rest, gain, np.exp(kappa), damping, shared)
        kappa_new = np.clip(kappa + np.clip(new[0], -2, 2), -60, 60)
        theta_new = np.clip(theta + np.clip(new[1], -0.7, 0.7), lobe.low, lobe.high)
        trial = state(theta_new, kappa_new)
        if trial[3] < cost:
            done = cost - trial[3] < 1e-9 * cost
            theta, kappa, (columns, rest, gain, cost) = theta_new, kappa_new, trial
            damping = max(damping / 5, 1e-9)
            if done:
                break
        else:
            damping *= 6
            if damping > 1e8:
                break
    return theta, np.exp(kappa), cost, steps


def _arrow_step(columns, rest, gain, diffuse, damping, shared):
    """Levenberg-Marquardt step of (log diffuse, theta): the bands are eliminated first (Schur complement)."""
    gain2, slope = gain * gain, gain * rest
    head = diffuse**2 * gain2.sum(axis=0) * (1 + damping)
    head = np.maximum(head, 1e-30)
    head_rest = diffuse * slope.sum(axis=0)
    if not shared:
        return head_rest / head, np.zeros(columns.shape[1])
    border = diffuse[:, None] * (gain2.T @ columns)
    block = columns.T @ (gain2.sum(axis=1)[:, None] * columns)
    block += np.diag(damping * np.diag(block) + 1e-30)
    schur = block - border.T @ (border / head[:, None])
    right = columns.T @ slope.sum(axis=1) - border.T @ (head_rest / head)
    theta = np.linalg.lstsq(schur, right, rcond=None)[0]
    return (head_rest - border @ theta) / head, theta
