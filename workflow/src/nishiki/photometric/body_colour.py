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
"""

import numpy as np
from numba import njit, prange

BLOCK = 32
LIT = 0.3  # of the lower mean of a pixel: darker samples are shadow, whose colour is that of the noise
ERROR = 0.1  # standard deviation E of a sample's error, relative to the pixel's lower mean
FAINT = 0.05  # saturation below which a colour is not told from errors of the white balance
MOST = 0.97  # largest t
CONCENTRATIONS = 2  # times that the less saturated samples are left out
AT_LEAST = 4  # lit samples


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
    out = np.empty((lights, rows, columns), dtype=np.float32)
    if channels == 1:
        out[...] = observations[..., 0]
        return out
    _weigh(
        np.ascontiguousarray(observations).reshape(lights, rows * columns, channels),
        np.ascontiguousarray(np.broadcast_to(valid, out.shape)).reshape(lights, rows * columns),
        out.reshape(lights, rows * columns),
    )
    return out


@njit(cache=True, parallel=True, error_model="numpy")
def _weigh(observations, valid, out):
    lights, pixels, channels = observations.shape
    f, zero, one = np.float32, np.float32(0.0), np.float32(1.0)
    per_channel, root = f(1.0 / channels), f(np.sqrt(channels))
    blocks = (pixels + BLOCK - 1) // BLOCK
    for block in prange(blocks):
        start = block * BLOCK
        width = min(BLOCK, pixels - start)
        mean, across = np.empty((lights, BLOCK), np.float32), np.empty((lights, BLOCK), np.float32)
        lit = np.empty((lights, BLOCK), np.float32)
        colour = np.zeros((channels, BLOCK), np.float32)
        peak, total, count = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
        lower, least = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
        saturation, t = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
        for j in range(lights):
            for p in range(width):
                level = zero
                for k in range(channels):
                    level += observations[j, start + p, k] * per_channel
                good = valid[j, start + p] and level > zero and level < f(np.inf)
                mean[j, p] = level
                lit[j, p] = one if good else zero
                peak[p] = max(peak[p], level) if good else peak[p]
        for p in range(width):  # values relative to the largest: sums of any radiometric scale stay in float32
            peak[p] = peak[p] if peak[p] > zero else one
        for j in range(lights):
            for p in range(width):
                total[p] += mean[j, p] / peak[p] if lit[j, p] > zero else zero
                count[p] += lit[j, p]
        for p in range(width):
            total[p], count[p] = total[p] / max(count[p], one), zero
        for j in range(lights):
            for p in range(width):
                low = lit[j, p] > zero and mean[j, p] / peak[p] <= total[p]
                lower[p] += mean[j, p] / peak[p] if low else zero
                count[p] += one if low else zero
        for p in range(width):
            lower[p], count[p] = lower[p] / max(count[p], one), zero
        for j in range(lights):
            for p in range(width):
                lit[j, p] = lit[j, p] if mean[j, p] / peak[p] >= f(LIT) * lower[p] else zero
                count[p] += lit[j, p]
                if lit[j, p] > zero:
                    for k in range(channels):
                        colour[k, p] += (observations[j, start + p, k] - mean[j, p]) / peak[p]
        for p in range(width):
            length = zero
            for k in range(channels):
                length += colour[k, p] * colour[k, p]
            length = np.sqrt(length)
            known = count[p] >= f(AT_LEAST) and length > f(1e-12)
            for k in range(channels):
                colour[k, p] = colour[k, p] / length if known else zero
        for j in range(lights):
            for p in range(width):
                value = zero
                for k in range(channels):
                    value += observations[j, start + p, k] * colour[k, p]
                across[j, p] = value / root  # so that across / mean is the saturation
        for _ in range(CONCENTRATIONS + 1):
            total[:] = zero
            count[:] = zero
            for j in range(lights):
                for p in range(width):
                    kept = lit[j, p] > zero and across[j, p] >= least[p] * mean[j, p]
                    total[p] += across[j, p] / peak[p] if kept else zero
                    count[p] += mean[j, p] / peak[p] if kept else zero
            for p in range(width):
                saturation[p] = max(total[p] / max(count[p], f(1e-12)), zero)
                least[p] = saturation[p]
        total[:] = zero
        count[:] = zero
        for j in range(lights):
            for p in range(width):
                if lit[j, p] > zero and saturation[p] > zero:
                    gloss = (mean[j, p] - across[j, p] / saturation[p]) / (peak[p] * lower[p])
                    gloss = min(max(gloss, zero), one)
                    total[p] += gloss * gloss
                    count[p] += one
        for p in range(width):
            variance, square = total[p] / max(count[p], one), saturation[p] * saturation[p]
            share = variance / (variance + f(ERROR * ERROR)) * (square / (square + f(FAINT * FAINT)))
            t[p] = min(share, f(MOST))
        for j in range(lights):
            for p in range(width):
                s = saturation[p]
                weighted = (one - t[p]) * mean[j, p] + s * across[j, p]
                out[j, start + p] = weighted / (one - t[p] + s * s)
