"""Gather the gloss of a scene as a profile z(phi) and fit it with a mixture of lobes.

For observations I' = rho_d cos theta_i + beta D F G / cos theta_r the value z is beta D(phi), whatever the light, the
albedo and the tilt.  The histogram sorts the samples by phi (rows) and by z (columns) and keeps sums in each cell, so
that tiles can be added in any order, histograms merged, and gross outliers (shadows, interreflection, dust) still be
told apart afterwards.  A sample's weight is a^2, a = F G / cos theta_r: a least-squares fit to the rows is then a
least-squares fit to the radiances.

A facet distribution of any tail (GGX, for one) is a mixture of Gaussians of different widths. So the profile is

    z(phi) = sum_k beta_k exp(-ln 2 (phi / gamma_k)^2),   beta_k >= 0     (Tominaga and Tanaka 2004, eq. 11, a sum)

on a fixed ladder of half widths. Normals that are uncertain by sigma along each tangent blur every Gaussian into a
wider one, so that the strengths behind the blur follow from one non-negative least-squares problem (C. L. Lawson and
R. J. Hanson, Solving Least Squares Problems, 1974, ch. 23): no start value, no width to search.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from nishiki.brdf.torrance_sparrow import GAMMA_PER_SIGMA, body_factor, transmittance
from nishiki.errors import UserError

PHI_UNIT = 5e-4  # rows are equally spaced in asinh(phi / PHI_UNIT): linear below it, 3.4 % wide above
ROWS = 258
_ROW_STEP = float(np.arcsinh(0.5 * np.pi / PHI_UNIT) / ROWS)
DECADES, PER_DECADE = 6, 24  # columns cover |z| / value_unit from 1e-6 to 1e6, either sign, and what is smaller
_SIDE = 2 * DECADES * PER_DECADE
COLUMNS = 2 * _SIDE + 1
TYPICAL = 0.3  # reflectance
LEVELS = (0.003, 30.0)  # median reflectances that are taken as relative to a white board
# Sums of a row beside its cells
PHI2, SIGMA2, COUNT, ATTENUATION = range(4)


@dataclass(frozen=True)
class SpecularProfile:
    """Mean lobe value over phi, rows without a sample left out; arrays (rows,)."""

    phi: np.ndarray  # root mean square angle(normal, half vector) of the row's samples, radians
    value: np.ndarray  # mean z, relative to the white reference
    weight: np.ndarray  # sum of a^2 over the samples used
    count: np.ndarray  # samples, outliers included
    spread: np.ndarray  # weighted standard deviation of z within the row
    sigma: np.ndarray  # root mean square angular deviation of the normals (per tangent axis), radians
    rejected: np.ndarray  # weight of the outliers, as a part of the row's weight


@dataclass(frozen=True)
class SpecularHistogram:
    """Sums over samples; `add_samples` returns a new histogram."""

    weights: np.ndarray  # (regions, ROWS, COLUMNS) sum of a^2
    values: np.ndarray  # (regions, ROWS, COLUMNS) sum of a^2 z
    rows: np.ndarray  # (regions, ROWS, 4) sums of a^2 phi^2, a^2 sigma^2, 1, a^2
    refractive_index: float
    value_unit: float

    @classmethod
    def empty(cls, *, regions=1, refractive_index=1.45, value_unit=1.0) -> "SpecularHistogram":
        """Make a histogram of no samples.  value_unit: unit for finding outliers (radiance of the white reference)."""
        if not (refractive_index > 1 and value_unit > 0):
            values = f"{refractive_index}, {value_unit}"
            raise UserError(
                f"expected refractive_index > 1 and value_unit > 0, found {values}: no gloss without contrast"
            )
        cells = (regions, ROWS, COLUMNS)
        return cls(np.zeros(cells), np.zeros(cells), np.zeros((regions, ROWS, 4)), refractive_index, value_unit)

    def add_samples(self, phi, residual, attenuation, *, sigma=0.0, region=0) -> "SpecularHistogram":
        """Add samples of one region: phi (radians, 0 .. pi / 2), residual = I' - diffuse, attenuation = F G / cos_r.

        All of one shape, sigma (radians) broadcast to it.  Samples that are not finite or have attenuation <= 0 are
        left out.
        """
        phi, residual, attenuation, sigma = np.broadcast_arrays(phi, residual, attenuation, sigma)
        flat = (np.ascontiguousarray(each, np.float64).ravel() for each in (phi, residual, attenuation, sigma))
        phi, residual, attenuation, sigma = flat
        new = replace(self, weights=self.weights.copy(), values=self.values.copy(), rows=self.rows.copy())
        # without those that are no number and those whose a^2 or a^2 z leaves float64
        with np.errstate(all="ignore"):
            w, z = attenuation**2, residual / attenuation
            good = np.isfinite(phi + sigma + w * z + w) & (attenuation > 0) & (w > 0)
        phi, sigma, w, z = (each[good] for each in (phi, sigma, w, z))
        row = np.minimum((np.arcsinh(np.abs(phi) / PHI_UNIT) / _ROW_STEP).astype(int), ROWS - 1)
        size = np.abs(z) / self.value_unit
        place = np.floor((np.log10(np.where(size > 0, size, 1)) + DECADES) * PER_DECADE) + 1
        column = _SIDE + np.where(size > 0, np.sign(z) * np.clip(place, 0, _SIDE), 0).astype(int)
        cell, cells = row * COLUMNS + column, ROWS * COLUMNS
        new.weights[region] += np.bincount(cell, w, cells).reshape(ROWS, COLUMNS)
        new.values[region] += np.bincount(cell, w * z, cells).reshape(ROWS, COLUMNS)
        for k, each in ((PHI2, w * phi**2), (SIGMA2, w * sigma**2), (COUNT, None), (ATTENUATION, w)):
            new.rows[region][:, k] += np.bincount(row, each, ROWS)
        return new

    def profile(self, *, region=0, reject=6.0) -> SpecularProfile:
        """Average z for each phi, without values further than `reject` quartile ranges from the row's quartiles.

        reject = infinity keeps all.  The fence is wide on purpose: noisy normals make z skew within a row, and their
        mean, not their median, is what the errors-in-variables fit needs.
        """
        rows = self.rows[region]
        seen = rows[:, ATTENUATION] > 0
        w, wz, sums = self.weights[region][seen], self.values[region][seen], rows[seen]
        centre = wz / np.where(w > 0, w, 1)
        total = sums[:, ATTENUATION]
        cumulative = np.cumsum(w, axis=1)
        index = np.arange(len(w))

        def quantile(q):
            return centre[index, np.argmax(cumulative >= q * cumulative[:, -1:], axis=1)]

        low, high = quantile(0.25), quantile(0.75)
        # a cell is 10 % wide: the fence is never narrower than that
        width = np.maximum(high - low, 0.1 * np.maximum(abs(low), abs(high)))
        with np.errstate(invalid="ignore"):
            kept = (centre >= (low - reject * width)[:, None]) & (centre <= (high + reject * width)[:, None])
        if np.isinf(reject):
            kept = np.ones_like(kept)
        w_kept = np.where(kept, w, 0)
        used = w_kept.sum(axis=1)
        mean = np.where(kept, wz, 0).sum(axis=1) / used
        variance = (w_kept * (centre - mean[:, None]) ** 2).sum(axis=1) / used
        return SpecularProfile(
            phi=np.sqrt(sums[:, PHI2] / total),
            value=mean,
            weight=used,
            count=sums[:, COUNT].astype(np.int64),
            spread=np.sqrt(variance),
            sigma=np.sqrt(sums[:, SIGMA2] / total),
            rejected=1 - used / total,
        )


def unit_of(reflectances: Sequence[np.ndarray]) -> float:
    """Choose the `value_unit` of a scene, so that the unit of the observations does not matter.

    1, the white reference, where the median of its reflectances is of that order; else (no white board) a power of ten.

    reflectances: arrays of any shape, relative to the white reference if there is one; values <= 0 do not count.
    """
    levels = np.concatenate([np.ravel(level[level > 0]) for level in reflectances]) if reflectances else np.empty(0)
    level = float(np.median(levels)) if levels.size else TYPICAL
    return 1.0 if LEVELS[0] <= level <= LEVELS[1] else float(10.0 ** np.round(np.log10(level / TYPICAL)))


NODES_PER_UNIT = 1024  # of the table of the profile, per unit of chord
NODES = int(np.sqrt(2) * NODES_PER_UNIT) + 2  # up to a chord of sqrt 2 (phi = 90 degrees)
LADDER = np.geomspace(0.01, 0.9, 11)
"""Half widths at half maximum, radians. The narrowest is ten nodes of the table wide."""
PROFILE_ERROR = 0.05  # relative error of a row beside its scatter: the model is not the surface
PEAK_ERROR = 0.01  # likewise, relative to the highest row
FEWEST = 20  # samples of a row
MOST_STEPS = 1000  # of the active set; SciPy stops with an error after 33, which scenes with next to no gloss reach
MUCH = 0.1  # share of the strength with which a lobe at an end of the ladder is told
EVIDENCE = 4.0  # fall of the squared error, in those of a row, from which the narrowest of the lobes is believed


@dataclass(frozen=True, eq=False)  # compared and hashed by identity
class GlossProfile:
    """A gloss profile: beta (lobes,) relative to the white reference, gamma (lobes,) radians, without F and G.

    A metal has refractive_index MIRROR and no body; its reflectance is that of the mirror, so that its facets' strength
    is one.

    transmission: share (0 to 1) of the loss 1 - T(c) that the body's light suffers at the surface on its way in and
    out, T of `nishiki.brdf.torrance_sparrow.transmittance`: 1 below a dielectric, 0 without one;
    unit: what counts as 1 in the observations, where that is not the white reference (noise is relative to it);
    colour: (channels,) reflectance of a metal along the normal, None of a dielectric.
    """

    beta: np.ndarray
    gamma: np.ndarray
    refractive_index: float = 1.45
    transmission: float = 1.0
    unit: float = 1.0
    colour: np.ndarray | None = None

    def __post_init__(self):
        good = self.beta.shape == self.gamma.shape and (self.beta >= 0).all() and (self.gamma > 0).all()
        if not (good and self.refractive_index > 1 and 0 <= self.transmission <= 1):
            raise UserError(
                f"gloss: expected as many beta >= 0 as gamma > 0, refractive_index > 1 and transmission from 0 to 1, "
                f"found beta {self.beta}, gamma {self.gamma}, {self.refractive_index} and {self.transmission}"
            )

    def value(self, phi: np.ndarray) -> np.ndarray:
        """Compute z at the angle phi of normal and half vector, radians, any shape."""
        return self._sum(phi, self.beta)

    def slope(self, phi: np.ndarray) -> np.ndarray:
        """Compute -dz / d(chord^2), chord = 2 sin(phi / 2): the slope by the cosine of phi, halved; 0 <= phi < pi."""
        return self._sum(phi, self.beta * np.log(2.0) / self.gamma**2) / np.sinc(np.asarray(phi) / np.pi)

    def _sum(self, phi, factors):
        exponent = (np.asarray(phi, np.float64)[..., None] / self.gamma) ** 2
        with np.errstate(under="ignore"):
            return np.exp2(-exponent) @ factors

    def with_strengths(self, beta: np.ndarray) -> "GlossProfile":
        """Return the gloss with other strengths; those of a metal go into its colour, up to the reflectance of white.

        A surface that reflects all light from facets of distribution D, the integral of D cos phi being one, has
        z = pi D / 4.
        """
        if self.colour is None or not beta.any():
            return replace(self, beta=beta)
        total = min(4 * float(beta @ self.gamma**2) / np.log(2), self.unit / float(self.colour.max()))
        return replace(self, beta=beta / total, colour=self.colour * total)

    def bare(self) -> "GlossProfile":
        """Return the body without a gloss or a surface."""
        index = self.refractive_index if self.colour is None else 1.45
        return GlossProfile(np.zeros(self.gamma.size), self.gamma, index, 0.0, self.unit)

    def balance(self, observations: np.ndarray) -> np.ndarray:
        """Return light (..., channels) relative to a metal's colour, in which its gloss is white."""
        return observations if self.colour is None else observations / self.colour.astype(np.float32)

    def wider(self, steps: int) -> "GlossProfile":
        """Return the gloss with every lobe so many steps of the ladder wider, its power kept."""
        places = np.clip(np.arange(self.gamma.size) + steps, 0, self.gamma.size - 1)
        beta = np.bincount(places, self.beta * (self.gamma / self.gamma[places]) ** 2, self.gamma.size)
        return replace(self, beta=beta)

    def table(self) -> np.ndarray:
        """Tabulate (4, NODES) for the kernel, on equal steps.

        Value and slope of z over the chord 2 sin(phi / 2), and the body's transmittance, less what `transmission` does
        not take, with its slope over the cosine.
        """
        return self._table

    @cached_property
    def _table(self) -> np.ndarray:
        """The kernel's table, made once: near lamps read it at every small parcel of the picture."""
        steps = np.arange(NODES) / NODES_PER_UNIT
        phi = 2 * np.arcsin(np.minimum(steps / 2, 1))
        passed = body_shading(np.ones(NODES), steps, self)
        return np.stack([self.value(phi), self.slope(phi), passed, np.gradient(passed, 1 / NODES_PER_UNIT)])

    @property
    def described(self) -> dict:
        """Plain numbers for a list of results; lobes of no strength left out."""
        there = self.beta > 0
        return {
            "gloss_beta": self.beta[there].tolist(),
            "gloss_gamma_deg": np.degrees(self.gamma[there]).tolist(),
            "gloss_transmission": self.transmission,
            "at_bounds": self.ends(),
            **({} if self.colour is None else {"gloss_colour": self.colour.tolist()}),
        }

    def ends(self) -> list[str]:
        """Describe where the narrowest or widest lobe of the ladder holds much of the gloss, which may go on beyond."""
        total = float(self.beta.sum())
        widths = {"narrowest": self.gamma.argmin(), "widest": self.gamma.argmax()}
        return [
            f"gloss: the {which} of the lobes on offer ({np.degrees(self.gamma[k]):.2g} degrees) holds "
            f"{100 * self.beta[k] / total:.0f} % of the strength"
            for which, k in widths.items()
            if self.gamma.size > 1 and total > 0 and self.beta[k] >= MUCH * total
        ]


def light_table(directions: np.ndarray, refractive_index: float) -> np.ndarray:
    """Tabulate direction, half vector with view (0, 0, 1), Fresnel reflectance, cos theta_q: (lights, 8) float64."""
    from nishiki.brdf.torrance_sparrow import fresnel

    directions = np.asarray(directions, np.float64)
    halves = directions + np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(halves, axis=1)
    if not (length > 1e-6).all():
        raise UserError(f"light {int(np.argmin(length))}: shines against the view, from behind the object; remove it")
    cos_q = np.minimum(length / 2, 1)
    return np.column_stack([directions, halves / length[:, None], fresnel(cos_q, refractive_index), cos_q])


def body_shading(cosine: np.ndarray, normal_z: np.ndarray, gloss: GlossProfile) -> np.ndarray:
    """Compute a body's shading below a dielectric: cos times transmittance both ways, relative to frontal; metal: 0."""
    shading = np.clip(cosine, 0, 1) * (gloss.colour is None)
    for angle in (cosine, normal_z) if gloss.transmission else ():
        shading = shading * (1 - gloss.transmission * (1 - transmittance(angle, gloss.refractive_index)))
    return shading


def specular_samples(observations, directions, normals, reflectance, gloss, *, valid, shading=None):
    """Compute (phi, residual, F G / cos_r) of every lit sample: (lights, ...) each, attenuation 0 where there is none.

    observations (lights, ..., C), normals (..., 3), reflectance (..., C), valid (lights, ...) bool; shading (..., 3 or
    5) of `nishiki.brdf.torrance_sparrow`, or None for Lambert's law.
    """
    lights = light_table(directions, gloss.refractive_index)
    normals = np.asarray(normals, np.float64)
    shape = (len(lights),) + (1,) * (normals.ndim - 1)
    cosine = np.moveaxis(normals @ lights[:, :3].T, -1, 0)
    x = np.moveaxis(normals @ lights[:, 3:6].T, -1, 0)
    nz = normals[..., 2]
    across = lights[:, :2].reshape(*shape, 2)
    body = body_shading(cosine, nz, gloss) * body_factor(shading, cosine, x, across)
    residual = gloss.balance(observations).mean(axis=-1) - body * np.asarray(reflectance, np.float64).mean(axis=-1)
    fresnel, cos_q = lights[:, 6].reshape(shape), lights[:, 7].reshape(shape)
    usable = valid & (cosine > 0.05) & (nz > 0.5)
    safe = np.where(nz > 0.5, nz, 1)
    groove = 2 * x / cos_q * np.minimum(1, cosine / safe)
    attenuation = np.where(usable, fresnel * np.minimum(1 / safe, groove), 0)
    return np.arccos(np.clip(x, -1, 1)), residual, np.maximum(attenuation, 0)


def predicted_radiance(directions, normals, reflectance, gloss, *, shading=None):
    """Predict body and gloss (lights, ..., C) of pixels under lamps at `directions`; arguments of `specular_samples`.

    Gloss at grazing light or view, which no fit uses, is left out.
    """
    black = np.zeros((len(directions), *np.shape(reflectance)))
    phi, below, attenuation = specular_samples(
        black, directions, normals, np.ones_like(reflectance), gloss, valid=True, shading=shading
    )
    shine = (gloss.value(phi) * attenuation)[..., None]
    return shine * reflectance if gloss.colour is not None else shine - below[..., None] * reflectance


def fit_gloss(
    histogram: SpecularHistogram, *, transmission: float = 1.0, ladder: np.ndarray = LADDER, region: int = 0
) -> GlossProfile:
    """Fit the profile that explains a region's specular samples; all beta 0 where nothing positive is left.

    ladder : (lobes,) half widths, radians, rising. The narrowest is left out where it holds much of the strength: a
    lobe at the bound is no fit.
    """
    from scipy.optimize import nnls

    profile = histogram.profile(region=region)
    beta = np.zeros(ladder.size)
    enough = profile.count >= FEWEST
    if enough.sum() > 1:  # one angle tells no width
        value = profile.value[enough]
        columns = blurred_lobes(profile, ladder)[enough]
        scatter = profile.spread[enough] / np.sqrt(profile.count[enough])
        error = np.sqrt((PROFILE_ERROR * value) ** 2 + (PEAK_ERROR * np.abs(value).max()) ** 2 + scatter**2)
        error = np.maximum(error, np.finfo(np.float64).tiny)
        columns = columns / error[:, None]
        for end in ladder.argsort():  # a few samples beside the mirror direction look like the narrowest lobe
            beta, rest = nnls(columns, value / error, maxiter=MOST_STEPS)
            fewer = np.delete(columns, end, axis=1)
            without = nnls(fewer, value / error, maxiter=MOST_STEPS)[1]
            believed = without**2 - rest**2 > EVIDENCE * max(rest**2 / enough.sum(), 1)
            if believed and beta[0] <= MUCH * beta.sum():
                break
            columns[:, end] = 0
        else:
            beta = np.zeros(ladder.size)
    return GlossProfile(beta, ladder, histogram.refractive_index, transmission, histogram.value_unit)


def blurred_lobes(profile: SpecularProfile, gamma: np.ndarray) -> np.ndarray:
    """Average each lobe of strength 1 over the rows of a profile, blurred by the rows' sigma: (rows, lobes)."""
    return scattered_lobes(gamma, profile.phi, profile.sigma**2)


def scattered_lobes(gamma: np.ndarray, phi: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Evaluate lobes (..., lobes) of strength 1 at angles phi (...,) of half vectors that scatter by a variance (...,).

    Directions that scatter by sigma along each tangent turn exp(-phi^2 / 2 s^2) into s^2 / (s^2 + sigma^2)
    exp(-phi^2 / 2 (s^2 + sigma^2)).
    """
    s2 = (np.asarray(gamma) / GAMMA_PER_SIGMA) ** 2
    blurred = s2 + np.asarray(variance)[..., None]
    with np.errstate(under="ignore"):
        return s2 / blurred * np.exp(-(phi[..., None] ** 2) / (2 * blurred))
