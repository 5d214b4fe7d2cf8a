"""One intensity a sample that follows the body and not the gloss: channels weighted by each pixel's colour.

By the dichromatic model (S. A. Shafer, Using color to separate reflection components, Color Research and Application
10, 1985) the channels of a sample are a vector m u + g w0: body colour u, and gloss along the white direction w0 =
(1, .., 1) / sqrt C. White gloss of variance G over errors of variance E in every channel has the covariance
E 1 + G w0 w0^T. The linear combination of channels with the least error for a given response to the body is then

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
NOISE times that which noise gives this estimate, N (1 + 1 / s^2) / C. On dark paint noise otherwise passes for gloss.
"""

import numpy as np
from numba import njit

from nishiki.threads import over_rows

LIT = 0.3  # of the lower mean of a pixel: darker samples are shadow, whose colour is that of the noise
ERROR = 0.1  # standard deviation E of a sample's error, relative to the pixel's lower mean
FAINT = 0.05  # saturation below which a colour is not told from errors of the white balance
MOST = 0.97  # largest t
NOISE = 6.0  # squared deviations of noise that do not count as gloss: s is that of the samples farthest from grey
CONCENTRATIONS = 2  # times that the less saturated samples are left out
AT_LEAST = 4  # lit samples
SMALLEST = np.float32(1e-37)  # peak that has an inverse in float32
BLOCK = 64  # pixels at a time


def body_intensity(observations: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Intensity of every sample by which gloss counts least: the mean of the channels where the body is grey.

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
    """Intensities of blocks of pixels of observations (lights, pixels, channels), by the module's equations.

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
            unsure = np.float32(NOISE) * noise * (one + one / square) * per_channel
            variance = max(total[p] / max(count[p], one) - unsure, zero)
            share = variance / (variance + noise + np.float32(ERROR**2)) * square / (square + np.float32(FAINT**2))
            total[p] = one - (min(share, np.float32(MOST)) if saturation[p] > zero else zero)
            other[p] = one / (per_peak[p] * (total[p] + square))
        for j in range(lights):
            for p in range(size):
                out[j, start + p] = (total[p] * mean[j, p] + saturation[p] * across[j, p]) * other[p]
