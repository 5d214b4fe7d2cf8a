"""The body of a surface: an intensity in which gloss counts little, its shading, and the reflectance of each channel.

The intensity weights the channels by each pixel's colour. By the dichromatic model (S. A. Shafer, Using color to
separate reflection components, Color Research and Application 10, 1985) the channels of a sample are a vector
m u + g w0: body colour u, and gloss along the white direction w0 = (1, .., 1) / sqrt C. White gloss of variance G over
errors of variance E in every channel has the covariance E 1 + G w0 w0^T. The linear combination of channels with the
least error for a given response to the body is then

    w = u - t (u . w0) w0,     t = G / (G + E)

(matched filter; the inverse by Sherman and Morrison). On a grey body it is the mean of the channels whatever t is, and
so it is where there is no gloss and little colour; on a dark red body gloss counts (1 - t) / (1 - t (u . w0)^2) times
as much as in the mean, relative to the body, times (u . w0)^2.

With u = (w0 + s e) / sqrt(1 + s^2), e the unit direction of the colour's difference from grey and s its saturation:

    intensity = ((1 - t) mean + s (I . e) / sqrt C) / (1 - t + s^2)

which has the level of the mean of the channels where there is no gloss. e is the direction of the sum of all samples,
for gloss adds nothing across w0. s is what the most saturated samples have, for gloss only takes saturation away.

Neither body nor gloss leaves the plane of w0 and e, so that what the samples show across both is noise: its variance N
of a channel is added to E^2, and gloss counts as such as far as its variance, mean - (I . e) / (s sqrt C), exceeds
UNSURE times that which noise gives this estimate, N (1 + 1 / s^2) / C. On dark paint noise otherwise passes for gloss.

With the normal known, I = c (a + b c + d x^8) (`nishiki.photometric.lobe`) is linear in the terms (a, b, d). Where the
normals come from that intensity, the terms that predict light are fitted to the mean of the channels along those
normals: light is predicted with all of the gloss and with the same normals.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.errors import UserError
from nishiki.lanes import BLOCK
from nishiki.photometric.flags import NO_ESTIMATE, NOISE, NormalFlag
from nishiki.photometric.light_selection import VALUES, half_vectors, sum_lights
from nishiki.photometric.normal_kernels import AT_LEAST, LEAST_FACTOR, PRIOR, WIDTH
from nishiki.threads import over_rows, strips

LIT = 0.3  # of the lower mean of a pixel: darker samples are shadow, whose colour is that of the noise
ERROR = 0.1  # standard deviation E of a sample's error, relative to the pixel's lower mean
FAINT = 0.05  # saturation below which a colour is not told from errors of the white balance
UNSURE = 6.0  # squared deviations of noise that do not count as gloss: s is that of the samples farthest from grey
CONCENTRATIONS = 2  # times that the less saturated samples are left out
SMALLEST = np.finfo(np.float32).tiny  # peak that has an inverse in float32


def body_intensity(observations: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Compute the intensity of every sample in which gloss counts least: the channels' mean where the body is grey.

    Parameters
    ----------
    observations : (lights, rows, columns, channels) float32
        Relative to the white reference, so that gloss has the same value in all channels.
    valid : (lights, rows, columns) bool
        Samples from which the body's colour may be estimated.

    Returns
    -------
    (lights, rows, columns) float32
        In the units of the mean of the channels. A sample in which noise or gloss outweighs the colour can be negative.
    """
    observations = np.asarray(observations, dtype=np.float32)
    lights, rows, columns, channels = observations.shape
    if channels == 1:
        return observations[..., 0].copy()
    stack = np.ascontiguousarray(observations).reshape(lights, rows * columns, channels)
    known = np.ascontiguousarray(np.broadcast_to(valid, observations.shape[:3]), bool).reshape(lights, rows * columns)
    out = np.empty(known.shape, np.float32)
    over_rows(_weigh, -(-rows * columns // BLOCK), stack, known, out)
    return out.reshape(lights, rows, columns)


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(begin, end, observations, valid, out):
    """Compute intensities of blocks of pixels of observations (lights, pixels, channels), by the module's equations.

    The inner loops are over the pixels of a block and have no branches, so that vector instructions can run them.
    """
    lights, pixels, channels = observations.shape
    zero, one, per_channel = np.float32(0), np.float32(1), np.float32(1 / channels)
    mean, across, lit = np.zeros((3, lights, BLOCK), np.float32)
    samples, colour = np.zeros((lights, channels, BLOCK), np.float32), np.zeros((channels, BLOCK), np.float32)
    memory = np.zeros((7, BLOCK), np.float32)
    per_peak, count, total, lower, every, saturation, other = memory
    for block in range(begin, end):
        start = block * BLOCK
        size = min(BLOCK, pixels - start)
        memory[:], colour[:], across[:] = zero, zero, zero
        for j in range(lights):
            for p in range(size):
                value = zero
                for k in range(channels):
                    samples[j, k, p] = observations[j, start + p, k]
                    value += samples[j, k, p] * per_channel
                good = valid[j, start + p] and zero < value < np.float32(np.inf)
                mean[j, p], lit[j, p] = value, one if good else zero
                per_peak[p] = value if good and value > per_peak[p] else per_peak[p]
        for p in range(BLOCK):  # sums of any radiometric scale stay in float32
            per_peak[p] = one / max(per_peak[p], SMALLEST) if per_peak[p] > zero else one
        for j in range(lights):
            for p in range(BLOCK):
                mean[j, p] *= per_peak[p]
                total[p] += mean[j, p] if lit[j, p] > zero else zero
                count[p] += lit[j, p]
        for p in range(BLOCK):
            total[p], count[p] = total[p] / max(count[p], one), zero
        for j in range(lights):  # the darker half of a pixel's lit samples
            for p in range(BLOCK):
                low = lit[j, p] if mean[j, p] <= total[p] else zero
                lower[p] += mean[j, p] if low > zero else zero
                count[p] += low
        for p in range(BLOCK):
            lower[p], count[p] = lower[p] / max(count[p], one), zero
        for j in range(lights):  # what is far below it is shadow
            for p in range(BLOCK):
                lit[j, p] = lit[j, p] if mean[j, p] >= np.float32(LIT) * lower[p] else zero
                count[p] += lit[j, p]
            for k in range(channels):
                for p in range(BLOCK):
                    apart = samples[j, k, p] * per_peak[p] - mean[j, p]
                    apart = apart if lit[j, p] > zero else zero
                    colour[k, p] += apart
                    every[p] += apart * apart
        for p in range(BLOCK):
            length = zero
            for k in range(channels):
                length += colour[k, p] * colour[k, p]
            length = np.sqrt(length)
            known = count[p] >= AT_LEAST and length > np.float32(1e-12)
            for k in range(channels):
                colour[k, p] *= np.float32(np.sqrt(per_channel)) * per_peak[p] / length if known else zero
        for j in range(lights):
            for k in range(channels):
                for p in range(BLOCK):
                    across[j, p] += samples[j, k, p] * colour[k, p]
        for _ in range(CONCENTRATIONS + 1):
            total[:], other[:] = zero, zero
            for j in range(lights):
                for p in range(BLOCK):
                    kept = lit[j, p] if across[j, p] >= saturation[p] * mean[j, p] else zero
                    total[p] += across[j, p] if kept > zero else zero
                    other[p] += mean[j, p] if kept > zero else zero
            for p in range(BLOCK):
                saturation[p] = max(total[p] / max(other[p], np.float32(1e-12)), zero)
        total[:], other[:] = zero, zero
        for j in range(lights):
            for p in range(BLOCK):
                gloss = min(max((mean[j, p] - across[j, p] / saturation[p]) / lower[p], zero), one)
                total[p] += gloss * gloss if lit[j, p] > zero else zero
                other[p] += across[j, p] * across[j, p] if lit[j, p] > zero else zero
        for p in range(BLOCK):
            square = saturation[p] * saturation[p]
            freedom = max((count[p] - one) * np.float32(max(channels - 2, 1)), one)
            noise = max((every[p] - other[p] / per_channel) / (lower[p] * lower[p]) / freedom, zero)
            unsure = np.float32(UNSURE) * noise * (one + one / square) * per_channel
            variance = max(total[p] / max(count[p], one) - unsure, zero)
            share = variance / (variance + noise + np.float32(ERROR**2)) * square / (square + np.float32(FAINT**2))
            total[p] = one - (share if saturation[p] > zero else zero)
            other[p] = one / (per_peak[p] * (total[p] + square))
        for j in range(lights):
            for p in range(size):
                out[j, start + p] = (total[p] * mean[j, p] + saturation[p] * across[j, p]) * other[p]


def shading_of_mean(
    intensity, mean, directions, field, *, usable, valid, least_change: float, noise: float = NOISE
) -> np.ndarray:
    """Fit the body shading along the field's normals to the mean of the channels.

    Parameters
    ----------
    intensity, mean : (lights, rows, columns) float32
        What the normals were fitted to, and the mean of the channels.
    directions : (lights, 3) float64
    field : NormalField
        Of a solver that fits a body shading.
    usable, valid : (lights, rows, columns) bool
        Samples to start from, and those to choose from again, by their residuals.
    least_change : float
        Sum of |intensity - mean| of a pixel, relative to that of |mean|, up to which its shading stays.
    noise : float
        Of the observations, relative to the albedo.

    Returns
    -------
    (rows, columns, 3) float32
        (a, b, d) of `nishiki.brdf.torrance_sparrow`; that of the field without an estimate or a lobe.
    """
    other, stack, start, known = (np.reshape(each, (len(directions), -1)) for each in (intensity, mean, usable, valid))
    normals, shading = field.normals.reshape(-1, 3), field.shading.reshape(-1, 3).copy()
    fitted = (field.flags.ravel() & (NO_ESTIMATE | NormalFlag.FALLBACK)) == 0
    vectors = np.asarray(directions, np.float64), half_vectors(directions)

    def fit(first: int, last: int, stack: np.ndarray) -> None:
        for part in strips(last - first, VALUES // len(stack)):
            here = first + part.start + np.flatnonzero(fitted[first:last][part])
            there = known[:, here] & np.isfinite(stack[:, here])
            values = np.where(there, stack[:, here], 0).astype(np.float64)
            apart = np.abs(np.where(there, other[:, here] - values, 0)).sum(axis=0)
            changed = apart > least_change * np.abs(values).sum(axis=0)
            here, there, values = here[changed], there[:, changed], values[:, changed]
            terms, found = _fitted_terms(values, there & start[:, here], there, normals[here], vectors, noise)
            shading[here[found]] = terms[:, found].T

    over_rows(fit, len(shading), stack)
    return shading.reshape(field.shading.shape)


def _fitted_terms(values, chosen, known, normals, vectors, noise):
    """Return terms (3, pixels), scaled so that the body factor is 1 on average, weighted c^2, and where they hold."""
    columns = [normals[:, k].astype(np.float64) for k in range(3)]
    c, x = (sum(vector[:, k, None] * columns[k] for k in range(3)) for vector in vectors)
    power = np.maximum(x, 1e-3) ** 2
    power *= power
    features, lit = (c, c * c, c * power * power), c > 0
    terms, found = np.zeros((4, values.shape[1])), np.ones(values.shape[1], bool)
    limit: np.ndarray | float = np.inf
    for step in range(2):
        if step > 0:  # within three times the scatter
            rest = values - sum(term * feature for term, feature in zip(terms[:3], features, strict=True))
            chosen = known & (np.abs(rest) <= limit)
        weighted = [np.where(chosen & lit, each, 0) for each in features]
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        sums = [sum_lights(weighted[k], features[m]) for k, m in pairs]
        right = [sum_lights(each, values) for each in weighted]
        solved, limit, good = _solve(sums, right, values, chosen & lit, noise)
        found &= good
        terms = np.where(found, solved, terms)
    with np.errstate(divide="ignore", invalid="ignore"):
        return terms[:3] / terms[3], terms[3] > 0


def _solve(sums, right, values, chosen, noise):
    """Return (a, b, d) and their mean factor, three times the scatter of the samples, and where the terms are a body's.

    The prior is that of `nishiki.photometric.normal_kernels.refine`, with the scatter about Lambert's law.
    """
    (s00, s01, s02, s11, s12, s22), (r0, r1, r2) = sums, right
    kept, squares = chosen.sum(axis=0), sum_lights(values, values, chosen)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
        albedo = r0 / s00
        left = np.maximum(squares - albedo * r0, 0)
        held = PRIOR * kept / 3 + left / (kept * albedo**2) / WIDTH**2
        ridge = 1e-9 * s00
        m00, m11, m22 = s00 + ridge, s11 + held + ridge, s22 + held + ridge
        l1, l2 = s01 / m00, s02 / m00
        d1, m21 = m11 - l1 * s01, s12 - l2 * s01
        k = m21 / d1
        d2, u1 = m22 - l2 * s02 - k * m21, r1 - l1 * r0
        d = (r2 - l2 * r0 - k * u1) / d2
        b = u1 / d1 - k * d
        a = r0 / m00 - l1 * b - l2 * d
        rest = squares - 2 * (a * r0 + b * r1 + d * r2)
        rest += a * (a * s00 + 2 * (b * s01 + d * s02)) + b * (b * s11 + 2 * d * s12) + d * d * s22
        scatter = np.sqrt(np.maximum(rest, 0) / np.where(kept > 4, kept - 3, 1))
        mean = a + (b * s01 + d * s02) / s00
        good = (kept >= AT_LEAST) & (albedo > 0) & (d1 > 0) & (d2 > 0) & (mean > LEAST_FACTOR * albedo)
    return np.stack([a, b, d, mean]), 3 * (scatter + noise * albedo), good


COSINE_FLOOR = 0.02
"""Samples lit at a smaller cosine carry no usable signal and divide by almost nothing: they are left out."""


@dataclass(frozen=True)
class DiffuseReflectance:
    """Diffuse reflectance (rows, columns, channels) float32, perfect white = 1; lights_used (rows, columns) uint16.

    Where no selected light reaches a pixel, or the sums leave float32, the reflectance is 0 and lights_used is 0.
    """

    reflectance: np.ndarray
    lights_used: np.ndarray


def diffuse_reflectance(observations, directions, normals, *, usable, method="least_squares", shading=None):
    """Estimate the reflectance per channel of a surface with known normals and body shading (Lambert's if None).

    observations (lights, rows, columns, channels) float32, perfect white facing the lamp = 1; directions (lights, 3);
    normals (rows, columns, 3); usable (lights, rows, columns) bool; shading (rows, columns, 3) or None, (a, b, d) of
    `nishiki.brdf.torrance_sparrow`.

    method, with the shading s = cos f
        "least_squares": sum(I s) / sum(s^2), the maximum-likelihood weight for equal noise in all lights.
        "mean": mean of I / s over the selected lights (Tominaga and Tanaka 2004, eq. 6), which lets grazing lights
        weigh most.

    Raises UserError on an unknown method or shapes that do not fit. Returns a DiffuseReflectance.
    """
    if method not in ("least_squares", "mean"):
        raise UserError(f"diffuse reflectance: method {method!r} is unknown; known: least_squares, mean")
    lights, rows, columns, channels = observations.shape
    if usable.shape != (lights, rows, columns) or normals.shape != (rows, columns, 3) or len(directions) != lights:
        raise UserError(
            f"diffuse reflectance: observations {observations.shape} do not fit usable {usable.shape}, "
            f"normals {normals.shape} and {len(directions)} directions"
        )
    pixels = rows * columns
    reflectance, used = np.zeros((pixels, channels), np.float32), np.zeros(pixels, np.uint16)
    directions, normals = np.asarray(directions, np.float32), np.asarray(normals, np.float32).reshape(pixels, 3)
    terms = np.zeros((0, 3)) if shading is None else np.reshape(shading, (pixels, 3))
    samples = np.asarray(observations, np.float32).reshape(lights, pixels, channels), usable.reshape(lights, pixels)
    surface = np.ascontiguousarray(normals), np.ascontiguousarray(terms, np.float32)
    over_rows(_fit, pixels, samples, directions, surface, method == "mean", (reflectance, used))
    return DiffuseReflectance(reflectance.reshape(rows, columns, channels), used.reshape(rows, columns))


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(begin, end, samples, directions, surface, mean, out):
    """Add up the lights of each pixel in their order; terms (pixels, 3), or none of them for Lambert's law."""
    (observations, usable), (normals, terms), (reflectance, used) = samples, surface, out
    sums, one = np.empty(observations.shape[2], np.float32), np.float32(1)
    for p in range(begin, end):
        weights, count, known = np.float32(0), 0, True
        sums[:] = np.float32(0)
        for j in range(len(directions)):
            x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
            body = normals[p, 0] * x + normals[p, 1] * y + normals[p, 2] * z
            if not (usable[j, p] and body > COSINE_FLOOR):
                continue
            if len(terms):
                half = (body + normals[p, 2]) / np.sqrt(max(np.float32(2) + np.float32(2) * z, np.float32(1e-12)))
                power = max(half, np.float32(0)) ** 2
                factor = terms[p, 0] + terms[p, 1] * body + terms[p, 2] * (power * power) ** 2
                body *= max(factor, np.float32(0))
                if not body > COSINE_FLOOR:
                    continue
            factor = one / body if mean else body
            weights += factor * body
            count += 1
            for k in range(sums.size):
                sums[k] += observations[j, p, k] * factor
        for k in range(sums.size):
            known = known and weights > 0 and np.isfinite(sums[k] / weights)
        if known:
            reflectance[p], used[p] = sums / weights, count


def mean_of_channels(observations: np.ndarray) -> np.ndarray:
    """Average observations (lights, rows, columns, channels) over the channels: (lights, rows, columns) float32."""
    observations = np.asarray(observations, dtype=np.float32)
    total = sum(observations[..., k] for k in range(observations.shape[-1]))
    return np.asarray(total / np.float32(observations.shape[-1]))
