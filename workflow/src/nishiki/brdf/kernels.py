"""Compiled scalar forms of the Torrance-Sparrow model, for renderers and fits that loop over pixels.

They compute in float64 whatever they are given, allocate nothing, call no library function, and are inlined by
the compiler into the loop that calls them.  `nishiki.brdf.torrance_sparrow` holds the array forms that they are proven
against.  Bounds are not checked here: gamma > 0 and refractive_index >= 1 are the caller's to ensure.
"""

import numpy as np
from numba import njit

# Chebyshev interpolant in y of 4 asin(sqrt y)^2 / y on 0 .. 1/2, relative error 2.2e-15: phi^2 = y * polynomial(y) with
# y = sin(phi / 2)^2.  It replaces atan2 (four times slower) and keeps full relative accuracy as phi -> 0.
_PHI_SQUARED = (
    4.000000000000005,
    1.3333333333267587,
    0.7111111123682597,
    0.45714276231185713,
    0.3250831164332901,
    0.24618257690874587,
    0.19625960148637764,
    0.1438696148314901,
    0.2514441746387976,
    -0.5556335558766249,
    2.8864815084578845,
    -8.476775858093276,
    19.258781271350873,
    -30.50231077668275,
    33.05124433607288,
    -21.7341795331,
    6.833702363961254,
)


@njit(cache=True, error_model="numpy")
def phi_squared(sin2_half):
    """Squared angle from y = sin(phi / 2)^2, 0 <= y <= 1/2 (phi up to a right angle); relative error below 1e-14."""
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
    """Reflectance of a dielectric; see `torrance_sparrow.fresnel`."""
    contrast = (refractive_index - 1.0) * (refractive_index + 1.0)
    s = np.sqrt(contrast + cos_theta * cos_theta) + cos_theta
    if s <= 0.0:
        return 0.0
    d = contrast / s
    parallel = (cos_theta * s - 1.0) / (cos_theta * d + 1.0)
    return 0.5 * (d / s) ** 2 * (1.0 + parallel * parallel)


@njit(cache=True, error_model="numpy")
def masking_over_cos_r_scalar(cos_phi, cos_i, cos_r, cos_q):
    """G / cos_r for cos_i, cos_r, cos_q > 0; see `torrance_sparrow.masking_over_cos_r`."""
    groove = 2.0 * cos_phi / cos_q
    if cos_i < cos_r:
        groove *= cos_i / cos_r
    return max(0.0, min(1.0 / cos_r, groove))
