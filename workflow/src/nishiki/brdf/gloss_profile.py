"""The gloss of a scene as a profile z(phi): a mixture of lobes, with the errors of the normals undone.

A facet distribution of any tail (GGX, for one) is a mixture of Gaussians of different widths. So the profile is

    z(phi) = sum_k beta_k exp(-ln 2 (phi / gamma_k)^2),   beta_k >= 0     (Tominaga and Tanaka 2004, eq. 11, a sum)

on a fixed ladder of half widths. Normals that are uncertain by sigma along each tangent blur every Gaussian into a
wider one, so that the strengths behind the blur follow from one non-negative least-squares problem (C. L. Lawson and
R. J. Hanson, Solving Least Squares Problems, 1974, ch. 23): no start value, no width to search.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nishiki.brdf.body_shading import body_factor, transmittance
from nishiki.brdf.specular_histogram import SpecularHistogram, SpecularProfile
from nishiki.brdf.torrance_sparrow import GAMMA_PER_SIGMA
from nishiki.errors import UserError

NODES_PER_UNIT = 1024  # of the table of the profile, per unit of chord
NODES = 1450  # up to a chord of sqrt 2 (phi = 90 degrees)
LADDER = np.geomspace(0.01, 0.9, 11)
"""Half widths at half maximum, radians. The narrowest is ten nodes of the table wide."""
PROFILE_ERROR = 0.05  # relative error of a row beside its scatter: the model is not the surface
PEAK_ERROR = 0.01  # likewise, relative to the highest row
FEWEST = 20  # samples of a row
MOST_STEPS = 1000  # of the active set; SciPy stops with an error after 33, which scenes with next to no gloss reach
MUCH = 0.1  # share of the strength with which a lobe at an end of the ladder is told


@dataclass(frozen=True)
class GlossProfile:
    """beta (lobes,) relative to the white reference, gamma (lobes,) radians; F and G are not in it.

    transmission: share (0 to 1) of the loss 1 - T(c) that the body's light suffers at the surface on its way in and
    out, T of `nishiki.brdf.body_shading.transmittance`: 1 below a dielectric, 0 without one;
    unit: what counts as 1 in the observations, where that is not the white reference (noise is relative to it).
    """

    beta: np.ndarray
    gamma: np.ndarray
    refractive_index: float = 1.45
    transmission: float = 1.0
    unit: float = 1.0

    def __post_init__(self):
        good = self.beta.shape == self.gamma.shape and (self.beta >= 0).all() and (self.gamma > 0).all()
        if not (good and self.refractive_index > 1 and 0 <= self.transmission <= 1):
            raise UserError(
                f"gloss: expected as many beta >= 0 as gamma > 0, refractive_index > 1 and transmission from 0 to 1, "
                f"found beta {self.beta}, gamma {self.gamma}, {self.refractive_index} and {self.transmission}"
            )

    def value(self, phi: np.ndarray) -> np.ndarray:
        """z at the angle phi of normal and half vector, radians, any shape."""
        return self._sum(phi, self.beta)

    def slope(self, phi: np.ndarray) -> np.ndarray:
        """-dz / d(chord^2), chord = 2 sin(phi / 2): the slope by the cosine of phi, halved; 0 <= phi < pi."""
        return self._sum(phi, self.beta * np.log(2.0) / self.gamma**2) / np.sinc(np.asarray(phi) / np.pi)

    def _sum(self, phi, factors):
        exponent = (np.asarray(phi, np.float64)[..., None] / self.gamma) ** 2
        with np.errstate(under="ignore"):
            return np.exp2(-exponent) @ factors

    def table(self) -> np.ndarray:
        """(4, NODES) as the kernel reads them, on equal steps: value and slope of z over the chord 2 sin(phi / 2), and
        the body's transmittance, less what `transmission` does not take, with its slope over the cosine."""
        return self._table

    @cached_property
    def _table(self) -> np.ndarray:
        """Made once: lamps that stand near ask for it at every small parcel of the picture."""
        steps = np.arange(NODES) / NODES_PER_UNIT
        phi = 2 * np.arcsin(np.minimum(steps / 2, 1))
        passed = 1 - self.transmission * (1 - transmittance(steps, self.refractive_index))
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
        }

    def ends(self) -> list[str]:
        """In words: where the narrowest or widest lobe of the ladder holds much of the gloss: it may go on beyond."""
        total = float(self.beta.sum())
        widths = {"narrowest": self.gamma.argmin(), "widest": self.gamma.argmax()}
        return [
            f"gloss: the {which} of the lobes on offer ({np.degrees(self.gamma[k]):.2g} degrees) holds "
            f"{100 * self.beta[k] / total:.0f} % of the strength"
            for which, k in widths.items()
            if self.gamma.size > 1 and total > 0 and self.beta[k] >= MUCH * total
        ]


def light_table(directions: np.ndarray, refractive_index: float) -> np.ndarray:
    """(lights, 8) float64: direction, half vector with the view (0, 0, 1), Fresnel reflectance, cos theta_q."""
    from nishiki.brdf.torrance_sparrow import fresnel

    directions = np.asarray(directions, np.float64)
    halves = directions + np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(halves, axis=1)
    if not (length > 1e-6).all():
        raise UserError(f"light {int(np.argmin(length))}: shines against the view, from behind the object; remove it")
    cos_q = np.minimum(length / 2, 1)
    return np.column_stack([directions, halves / length[:, None], fresnel(cos_q, refractive_index), cos_q])


def body_shading(cosine: np.ndarray, normal_z: np.ndarray, gloss: GlossProfile) -> np.ndarray:
    """Shading of the body below a dielectric: cos times the transmittance in and out, relative to frontal."""
    shading = np.clip(cosine, 0, 1)
    for angle in (cosine, normal_z) if gloss.transmission else ():
        shading = shading * (1 - gloss.transmission * (1 - transmittance(angle, gloss.refractive_index)))
    return shading


def specular_samples(observations, directions, normals, reflectance, gloss, *, valid, shading=None):
    """(phi, residual, F G / cos_r) of every lit sample: (lights, ...) each, attenuation 0 where there is none.

    observations (lights, ..., C), normals (..., 3), reflectance (..., C), valid (lights, ...) bool; shading (..., 3 or
    5) of `nishiki.brdf.body_shading`, or None for Lambert's law.
    """
    lights = light_table(directions, gloss.refractive_index)
    normals = np.asarray(normals, np.float64)
    shape = (len(lights),) + (1,) * (normals.ndim - 1)
    cosine = np.moveaxis(normals @ lights[:, :3].T, -1, 0)
    x = np.moveaxis(normals @ lights[:, 3:6].T, -1, 0)
    nz = normals[..., 2]
    across = lights[:, :2].reshape(*shape, 2)
    body = body_shading(cosine, nz, gloss) * body_factor(shading, cosine, x, across)
    residual = observations.mean(axis=-1) - body * np.asarray(reflectance, np.float64).mean(axis=-1)
    fresnel, cos_q = lights[:, 6].reshape(shape), lights[:, 7].reshape(shape)
    usable = valid & (cosine > 0.05) & (nz > 0.5)
    safe = np.where(nz > 0.5, nz, 1)
    groove = 2 * x / cos_q * np.minimum(1, cosine / safe)
    attenuation = np.where(usable, fresnel * np.minimum(1 / safe, groove), 0)
    return np.arccos(np.clip(x, -1, 1)), residual, np.maximum(attenuation, 0)


def predicted_radiance(directions, normals, reflectance, gloss, *, shading=None):
    """Body and gloss (lights, ..., C) of pixels under lamps at `directions`; arguments as in `specular_samples`.

    Gloss at grazing light or view, which no fit uses, is left out.
    """
    black = np.zeros((len(directions), *np.shape(reflectance)))
    phi, below, attenuation = specular_samples(
        black, directions, normals, np.ones_like(reflectance), gloss, valid=True, shading=shading
    )
    return -below[..., None] * reflectance + (gloss.value(phi) * attenuation)[..., None]


def fit_gloss(
    histogram: SpecularHistogram, *, transmission: float = 1.0, ladder: np.ndarray = LADDER, region: int = 0
) -> GlossProfile:
    """The profile that explains a region's specular samples; all beta 0 where nothing positive is left."""
    from scipy.optimize import nnls

    profile = histogram.profile(region=region)
    beta = np.zeros(ladder.size)
    enough = profile.count >= FEWEST
    if enough.any():
        value = profile.value[enough]
        columns = blurred_lobes(profile, ladder)[enough]
        scatter = profile.spread[enough] / np.sqrt(profile.count[enough])
        error = np.sqrt((PROFILE_ERROR * value) ** 2 + (PEAK_ERROR * np.abs(value).max()) ** 2 + scatter**2)
        error = np.maximum(error, np.finfo(np.float64).tiny)
        beta, _ = nnls(columns / error[:, None], value / error, maxiter=MOST_STEPS)
    return GlossProfile(beta, ladder, histogram.refractive_index, transmission, histogram.value_unit)


def blurred_lobes(profile: SpecularProfile, gamma: np.ndarray) -> np.ndarray:
    """(rows, lobes) mean of each lobe of strength 1 in the rows of a profile, blurred by the rows' sigma.

    Directions that scatter by sigma along each tangent turn exp(-phi^2 / 2 s^2) into s^2 / (s^2 + sigma^2)
    exp(-phi^2 / 2 (s^2 + sigma^2)).
    """
    s2 = (np.asarray(gamma) / GAMMA_PER_SIGMA) ** 2
    blurred = s2 + profile.sigma[:, None] ** 2
    with np.errstate(under="ignore"):
        return s2 / blurred * np.exp(-(profile.phi[:, None] ** 2) / (2 * blurred))
