"""Evaluate the Torrance-Sparrow reflection model: arrays, compiled scalars, and the body's shading beside the lobe.

Tominaga and Tanaka (2004, eq. 10-13) write the reflected light of an illuminant of unit irradiance as

    Y = rho_d cos(theta_i) + beta D F G / cos(theta_r),      D = exp(-ln 2 (phi / gamma)^2)

with phi the angle between the surface normal and the half vector, gamma the half width at half maximum of D, F the
exact Fresnel reflectance of a dielectric and G the masking of V-shaped grooves.  Miyazaki et al. (2007, eq. 8) drop F
and G:

    I_s = K_s / cos(theta_r) exp(-phi^2 / (2 sigma^2)),      gamma = sigma sqrt(2 ln 2).

Everything here is relative to the white reference: a perfect white diffuser that faces the lamp has the value 1.  The
array functions are the readable form and the reference of the compiled ones, of single numbers or of lanes
(`nishiki.lanes`), in float64. Those allocate nothing, call no library function, and are inlined by the compiler into
the loop that calls them; they check no bounds: gamma > 0 and refractive_index >= 1 are the caller's to ensure.

The body shading of a pixel is Lambert's cosine with the fall-off and the gloss skirt that the solver `lobe` fitted:

    E_k = rho_k c f,    f = max(a + b c + d x^8, 0),    c = max(n . l, 0),    x = max(n . h, 0)

h is the half vector of light and view. The map `shading` (rows, columns, 3) holds (a, b, d) of every pixel, scaled so
that f is 1 on average over the samples of the fit, weighted by c^2: rho_k stays about the reflectance of Lambert's law.
Lambert's law is (1, 0, 0). Where surroundings shade a pixel from one side, the map has two terms more, (a, b, d, e_x,
e_y), and e_x l_x + e_y l_y, the light's direction across the view, is added to the sum
(`nishiki.photometric.relighting`). Model: Shi, Tan, Matsushita and Ikeuchi (2014), with other terms
(`nishiki.photometric.lobe`).
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.errors import UserError
from nishiki.lanes import choose, root

GAMMA_PER_SIGMA = float(np.sqrt(2.0 * np.log(2.0)))
MIRROR = 1e4
"""Refractive index of a metal: its facets reflect all light, in the colour of `reflectance`; it has no body."""


@dataclass(frozen=True)
class HalfVectorGeometry:
    """Angles of one lamp and one view at a surface: arrays of the directions' broadcast shape less its last axis."""

    phi: np.ndarray  # angle(normal, half vector), radians, 0 .. pi
    cos_phi: np.ndarray  # n . h
    cos_i: np.ndarray  # n . light, negative behind the surface
    cos_r: np.ndarray  # n . view, negative behind the surface
    cos_q: np.ndarray  # view . h = light . h, 0 .. 1: the incidence on the facet


def half_vector_geometry(normals, lights, views) -> HalfVectorGeometry:
    """Compute the angles of the model from unit directions of shape (..., 3) that broadcast against each other.

    phi is atan2(|n x h|, n . h): acos(n . h) keeps no digit below 1e-8 rad.  cos_q is half the length of light + view,
    which needs no difference of nearly equal numbers.  Where light = -view there is no half
    vector: phi is pi / 2 and cos_q 0 there (the model is 0 there for every normal).
    """
    normals, lights, views = (np.asarray(a) for a in (normals, lights, views))
    total = lights + views
    length = np.sqrt(np.sum(total * total, axis=-1))
    along = np.sum(normals * total, axis=-1)
    across = np.sqrt(np.sum(np.cross(normals, total) ** 2, axis=-1))
    exists = length > 0
    phi = np.where(exists, np.arctan2(across, along), np.asarray(np.pi / 2, dtype=length.dtype))
    return HalfVectorGeometry(
        phi=phi,
        cos_phi=along / np.where(exists, length, 1),
        cos_i=np.sum(normals * lights, axis=-1),
        cos_r=np.sum(normals * views, axis=-1),
        cos_q=np.minimum(length / 2, 1),
    )


def facet_distribution(phi, gamma) -> np.ndarray:
    """Compute D = exp(-ln 2 (phi / gamma)^2), 1 at phi = 0 and 1/2 at phi = gamma (Tominaga and Tanaka 2004, eq. 11).

    phi and gamma in radians, broadcast against each other; gamma > 0 and may be infinite (D = 1).  The quotient is
    formed before the square, so that no width underflows.
    """
    if not np.all(np.asarray(gamma) > 0):
        raise UserError(
            f"gamma: expected a half width above 0 rad, found {np.min(gamma)}; use a narrow lobe instead of 0"
        )
    with np.errstate(over="ignore", under="ignore"):
        return np.exp2(-((np.asarray(phi) / gamma) ** 2))


def fresnel(cos_theta, refractive_index) -> np.ndarray:
    """Compute the Fresnel reflectance of a smooth dielectric for unpolarised light.

    Parameters
    ----------
    cos_theta : (...,) array_like of float
        Cosine of the angle of incidence on the facet, 0 to 1.
    refractive_index : float or array_like that broadcasts
        Relative to air, 1 or more.

    Returns
    -------
    (...,) float ndarray
        Share of the light that is reflected, 0 to 1: 1 at grazing incidence for an index above 1, and 0 everywhere
        for an index of 1.

    Raises
    ------
    nishiki.errors.UserError
        For an index below 1.

    Notes
    -----
    With c = cos_theta and g = sqrt((n - 1)(n + 1) + c^2) the textbook's g - c is (n^2 - 1) / (g + c), so that neither
    n -> 1 nor c -> 0 loses digits:  F = 1/2 (d / s)^2 (1 + ((c s - 1) / (c d + 1))^2), s = g + c, d = (n^2 - 1) / s.
    The limit c -> 0 at n = 1 exactly is 0 / 0; it is set to 0.

    References
    ----------
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, eq. 12.

    Examples
    --------
    Varnish at normal incidence reflects ((n - 1) / (n + 1))^2:

    >>> import nishiki
    >>> round(float(nishiki.fresnel(1.0, 1.5)), 6)
    0.04
    >>> float(nishiki.fresnel(0.0, 1.5))
    1.0
    """
    c, n = np.asarray(cos_theta), refractive_index
    if not np.all(np.asarray(n) >= 1):
        raise UserError(f"refractive_index: expected n >= 1, found {np.min(n)}; give it relative to air")
    contrast = (n - 1) * (n + 1)
    s = np.sqrt(contrast + c * c) + c
    s_safe = np.where(s > 0, s, 1)
    d = contrast / s_safe
    parallel = (c * s - 1) / (c * d + 1)
    return np.where(s > 0, (d / s_safe) ** 2 * (1 + parallel * parallel) / 2, 0)


def masking_over_cos_r(cos_phi, cos_i, cos_r, cos_q) -> np.ndarray:
    """Compute G / cos_r without its 1 / cos_r singularity: min(1 / cos_r, 2 cos phi min(1, cos_i / cos_r) / cos_q).

    At grazing view (cos_r -> 0 at fixed cos_i) G is proportional to cos_r, so that the quotient tends to
    2 cos phi / cos_q.  0 where light or view is behind the surface.
    """
    cos_i, cos_r = np.asarray(cos_i), np.asarray(cos_r)
    lit = (cos_i > 0) & (cos_r > 0) & (np.asarray(cos_q) > 0)
    cos_r = np.where(lit, cos_r, 1)
    groove = 2 * np.asarray(cos_phi) * np.minimum(1, cos_i / cos_r) / np.where(lit, cos_q, 1)
    with np.errstate(
        over="ignore"
    ):  # 1 / cos_r may be infinite for a subnormal cos_r; the minimum takes the other branch
        return np.where(lit, np.maximum(np.minimum(1 / cos_r, groove), 0), 0)


def attenuation(geometry: HalfVectorGeometry, refractive_index) -> np.ndarray:
    """Compute F G / cos_r: the specular term without beta D, as fits need it (Tominaga and Tanaka 2004, eq. 10)."""
    g = geometry
    return fresnel(g.cos_q, refractive_index) * masking_over_cos_r(g.cos_phi, g.cos_i, g.cos_r, g.cos_q)


def specular(normals, lights, views, *, beta, gamma, refractive_index) -> np.ndarray:
    """Compute the Torrance-Sparrow model's specular term, beta D F G / cos(theta_r), relative to the white reference.

    D is the distribution of facets, F the Fresnel reflectance and G the masking of V-shaped grooves. The whole model
    adds rho cos(theta_i), with the diffuse reflectance rho.

    Parameters
    ----------
    normals, lights, views : (..., 3) array_like of float
        Unit vectors away from the surface, which broadcast against each other.
    beta : float or (...,) array_like
        Strength of the term, 0 or more, without unit.
    gamma : float or (...,) array_like
        Half width at half maximum of the facets' angles, radians, above 0.
    refractive_index : float or (...,) array_like
        Relative to air, 1 or more.

    Returns
    -------
    (...,) float ndarray
        1 is a perfect white diffuser that faces the lamp; 0 where light or view is not above the surface.

    Raises
    ------
    nishiki.errors.UserError
        For a gamma that is not above 0, and an index below 1.

    See Also
    --------
    fresnel : The reflectance F.

    References
    ----------
    K. E. Torrance and E. M. Sparrow (1967), Theory for off-specular reflection from roughened surfaces.
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, eq. 10 to 13.

    Examples
    --------
    Light and view along the normal, where D and G are 1 and F is 0.04:

    >>> import numpy as np
    >>> import nishiki
    >>> up = np.array([0.0, 0.0, 1.0])
    >>> round(float(nishiki.torrance_sparrow(up, up, up, beta=2.0, gamma=0.1, refractive_index=1.5)), 6)
    0.08

    Across the lobe the value falls to half where the half vector is gamma off the normal:

    >>> light = np.array([np.sin(0.2), 0.0, np.cos(0.2)])
    >>> values = nishiki.torrance_sparrow(up, np.stack([up, light]), up, beta=2.0, gamma=0.1, refractive_index=1.5)
    >>> values.shape
    (2,)
    >>> round(float(values[1] / values[0]), 2)
    0.5
    """
    geometry = half_vector_geometry(normals, lights, views)
    return beta * facet_distribution(geometry.phi, gamma) * attenuation(geometry, refractive_index)


# Chebyshev interpolant in y of 4 asin(sqrt y)^2 / y on 0 .. 1/2, relative error 2.2e-15: phi^2 = y * polynomial(y) with
# y = sin(phi / 2)^2.  It replaces atan2 (four times slower) and keeps full relative accuracy as phi -> 0.
_PHI_SQUARED = (
    4.000000000000005, 1.3333333333267587, 0.7111111123682597, 0.45714276231185713, 0.3250831164332901,
    0.24618257690874587, 0.19625960148637764, 0.1438696148314901, 0.2514441746387976, -0.5556335558766249,
    2.8864815084578845, -8.476775858093276, 19.258781271350873, -30.50231077668275, 33.05124433607288,
    -21.7341795331, 6.833702363961254,
)  # fmt: skip


@njit(cache=True, error_model="numpy")
def phi_squared(sin2_half):
    """Compute the squared angle from y = sin(phi / 2)^2, 0 <= y <= 1/2 (phi <= pi / 2); relative error below 1e-14."""
    c = _PHI_SQUARED
    y = sin2_half
    y2 = y * y
    y4 = y2 * y2
    # four short chains in y^4 instead of one long one: the processor works on them side by side
    p0 = c[0] + y4 * (c[4] + y4 * (c[8] + y4 * (c[12] + y4 * c[16])))
    p1 = c[1] + y4 * (c[5] + y4 * (c[9] + y4 * c[13]))
    p2 = c[2] + y4 * (c[6] + y4 * (c[10] + y4 * c[14]))
    p3 = c[3] + y4 * (c[7] + y4 * (c[11] + y4 * c[15]))
    return y * ((p0 + y * p1) + y2 * (p2 + y * p3))


@njit(cache=True, error_model="numpy")
def fresnel_scalar(cos_theta, refractive_index):
    """Compute the reflectance of a dielectric; see `torrance_sparrow.fresnel`."""
    contrast = (refractive_index - 1.0) * (refractive_index + 1.0)
    s = root(contrast + cos_theta * cos_theta) + cos_theta
    d = contrast / s
    ratio, parallel = d / s, (cos_theta * s - 1.0) / (cos_theta * d + 1.0)
    return choose(s > 0.0, 0.5 * ratio * ratio * (1.0 + parallel * parallel), 0.0)


_EXPONENTIAL = tuple(1.0 / math.factorial(k) for k in range(13, -1, -1))


@njit(cache=True, nogil=True, error_model="numpy")
def exp2_negative(e):
    """Compute 2^-e for 0 <= e <= 60, relative error below 4e-12, below 4e-14 for e < 40.

    Of lanes too, for which there is no library: for t = e ln 2 / 64 <= 0.65 the Taylor series of exp(-t) to t^13, then
    six squarings.
    """
    t = e * (-math.log(2.0) / 64.0)
    p = t * _EXPONENTIAL[0] + _EXPONENTIAL[1]
    for coefficient in _EXPONENTIAL[2:]:
        p = p * t + coefficient
    for _ in range(6):
        p = p * p
    return p


LAMBERT = (1.0, 0.0, 0.0)


def transmittance(cosine: np.ndarray, refractive_index: float) -> np.ndarray:
    """Compute the transmittance of a smooth dielectric surface relative to normal incidence: (1 - F(c)) / (1 - F(1)).

    The body of a varnished paint is lit through its surface and seen through it: its shading is c T(c) T(n . v), and
    its reflectance is that of light and view along the normal (B. Walter et al., EGSR 2007; F: Tominaga and Tanaka
    2004, eq. 12). The path of the light that the surface reflects back into the body does not depend on either angle.

    Parameters
    ----------
    cosine : (...,) float, of light or view and the normal, clipped to 0 ... 1.
    refractive_index : float, above 1.

    Returns
    -------
    (...,) float, 0 at grazing to 1 at normal incidence.
    """
    return (1 - fresnel(np.clip(cosine, 0, 1), refractive_index)) / (1 - fresnel(1.0, refractive_index))


def body_factor(
    shading: np.ndarray | None, cosine: np.ndarray, half_cosine: np.ndarray, across: np.ndarray | None = None
) -> np.ndarray | float:
    """Compute the factor f of the body's shading, by which Lambert's cosine is multiplied.

    Parameters
    ----------
    shading : (..., 3) float, (a, b, d) of each pixel, (..., 5), (a, b, d, e_x, e_y), or None for Lambert's law.
    cosine, half_cosine : (..., ) float, n . l and n . h, broadcast against the pixels.
    across : (..., 2) float, (l_x, l_y) of the unit vector to the light; for five terms.

    Returns
    -------
    (...,) float, zero or more; 1 where `shading` is None.
    """
    if shading is None:
        return 1.0
    a, b, d, *e = np.moveaxis(np.asarray(shading), -1, 0)
    factor = a + b * np.maximum(cosine, 0) + d * np.maximum(half_cosine, 0) ** 8
    if e:
        if across is None:
            raise ValueError("shading of five terms needs the directions across")
        factor = factor + e[0] * across[..., 0] + e[1] * across[..., 1]
    return np.maximum(factor, 0)
