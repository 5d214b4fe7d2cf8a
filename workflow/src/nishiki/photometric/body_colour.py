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
CHUNK = 32  # blocks that share one set of work arrays
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
    zero = np.float32(0.0)
    blocks = (pixels + BLOCK - 1) // BLOCK
    for chunk in prange((blocks + CHUNK - 1) // CHUNK):
        planes = np.zeros((lights, channels, BLOCK), np.float32)
        mean, level = np.zeros((lights, BLOCK), np.float32), np.zeros((lights, BLOCK), np.float32)
        across, lit = np.zeros((lights, BLOCK), np.float32), np.zeros((lights, BLOCK), np.float32)
        colour = np.zeros((channels, BLOCK), np.float32)
        peak, lower = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
        saturation, t = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
        for block in range(chunk * CHUNK, min((chunk + 1) * CHUNK, blocks)):
            start = block * BLOCK
            width = min(BLOCK, pixels - start)
            lit[:] = zero
            peak[:] = zero
            for j in range(lights):
                _load_light(
                    observations[j, start : start + width], valid[j, start : start + width], planes[j], mean[j], lit[j],
                    peak,
                )  # fmt: skip
            for p in range(BLOCK):  # values relative to the largest: sums of any radiometric scale stay in float32
                peak[p] = peak[p] if peak[p] > zero else np.float32(1.0)
            for j in range(lights):
                _divide(mean[j], peak, level[j])
            _leave_out_shadow(level, lit, lower)
            _body_colour(planes, mean, peak, lit, colour)
            _project(planes, colour, across)
            _body_saturation(mean, level, across, lit, peak, saturation)
            _gloss_share(mean, across, lit, peak, lower, saturation, t)
            for j in range(lights):
                _combine(mean[j], across[j], saturation, t, out[j, start : start + width])


@njit(cache=True, error_model="numpy")
def _load_light(samples, valid, planes, mean, lit, peak):
    """Channels (channels, BLOCK) and mean of one light of a block; which pixels it lights; the largest mean so far."""
    zero, one = np.float32(0.0), np.float32(1.0)
    channels = len(planes)
    per_channel = np.float32(1.0 / channels)
    width = len(valid)
    if channels == 3:  # a distance between neighbours that the compiler knows: SIMD code
        flat, red, green, blue = samples.reshape(-1), planes[0], planes[1], planes[2]
        for p in range(width):
            a, b, c = flat[3 * p], flat[3 * p + 1], flat[3 * p + 2]
            red[p], green[p], blue[p] = a, b, c
            mean[p] = a * per_channel + b * per_channel + c * per_channel
    else:
        for p in range(width):
            total = zero
            for k in range(channels):
                planes[k, p] = samples[p, k]
                total += samples[p, k] * per_channel
            mean[p] = total
    for p in range(width):
        value = mean[p]
        good = valid[p] & (value > zero) & (value < np.float32(np.inf))
        lit[p] = one if good else zero
        peak[p] = value if good & (value > peak[p]) else peak[p]


@njit(cache=True, error_model="numpy")
def _divide(values, by, out):
    for p in range(len(values)):
        out[p] = values[p] / by[p]


@njit(cache=True, error_model="numpy")
def _leave_out_shadow(level, lit, lower):
    """Mean of the darker half of each pixel's lit samples (`lower`); those far below it count as shadow."""
    zero, one = np.float32(0.0), np.float32(1.0)
    total, count, darker = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    for j in range(len(level)):
        row, light = level[j], lit[j]
        for p in range(len(row)):
            total[p] += row[p] if light[p] > zero else zero
            count[p] += light[p]
    for p in range(BLOCK):
        total[p] = total[p] / max(count[p], one)
        lower[p] = zero
    for j in range(len(level)):
        row, light = level[j], lit[j]
        for p in range(len(row)):
            low = (light[p] > zero) & (row[p] <= total[p])
            lower[p] += row[p] if low else zero
            darker[p] += one if low else zero
    for p in range(BLOCK):
        lower[p] = lower[p] / max(darker[p], one)
    for j in range(len(level)):
        row, light = level[j], lit[j]
        for p in range(len(row)):
            light[p] = light[p] if row[p] >= np.float32(LIT) * lower[p] else zero


@njit(cache=True, error_model="numpy")
def _body_colour(planes, mean, peak, lit, colour):
    """Unit direction (channels, BLOCK) of the sum of the samples' differences from grey; 0 where it is not known."""
    zero = np.float32(0.0)
    count = np.zeros(BLOCK, np.float32)
    colour[:] = zero
    for j in range(len(mean)):
        grey, light = mean[j], lit[j]
        for p in range(len(light)):
            count[p] += light[p]
        for k in range(len(colour)):
            row, total = planes[j, k], colour[k]
            for p in range(len(row)):
                total[p] += (row[p] - grey[p]) / peak[p] if light[p] > zero else zero
    for p in range(BLOCK):
        length = zero
        for k in range(len(colour)):
            length += colour[k, p] * colour[k, p]
        length = np.sqrt(length)
        known = count[p] >= np.float32(AT_LEAST) and length > np.float32(1e-12)
        for k in range(len(colour)):
            colour[k, p] = colour[k, p] / length if known else zero


@njit(cache=True, error_model="numpy")
def _project(planes, colour, across):
    """Part of every sample along the body's colour, so that across / mean is the saturation."""
    root = np.float32(np.sqrt(len(colour)))
    for j in range(len(across)):
        row = across[j]
        row[:] = np.float32(0.0)
        for k in range(len(colour)):
            values, direction = planes[j, k], colour[k]
            for p in range(len(row)):
                row[p] += values[p] * direction[p]
        for p in range(len(row)):
            row[p] = row[p] / root


@njit(cache=True, error_model="numpy")
def _body_saturation(mean, level, across, lit, peak, saturation):
    """Saturation of the most saturated samples: gloss only takes it away."""
    zero, few = np.float32(0.0), np.float32(1e-12)
    least, total, weight = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    for _ in range(CONCENTRATIONS + 1):
        total[:] = zero
        weight[:] = zero
        for j in range(len(mean)):
            grey, row, part, light = mean[j], level[j], across[j], lit[j]
            for p in range(len(row)):
                kept = (light[p] > zero) & (part[p] >= least[p] * grey[p])
                total[p] += part[p] / peak[p] if kept else zero
                weight[p] += row[p] if kept else zero
        for p in range(BLOCK):
            saturation[p] = max(total[p] / max(weight[p], few), zero)
            least[p] = saturation[p]


@njit(cache=True, error_model="numpy")
def _gloss_share(mean, across, lit, peak, lower, saturation, t):
    """t of every pixel, from the variance of its gloss relative to its level, and its saturation."""
    zero, one = np.float32(0.0), np.float32(1.0)
    total, count = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    for j in range(len(mean)):
        grey, part, light = mean[j], across[j], lit[j]
        for p in range(len(grey)):
            coloured = saturation[p] > zero
            gloss = (grey[p] - part[p] / (saturation[p] if coloured else one)) / (peak[p] * lower[p])
            gloss = gloss if gloss > zero else zero
            gloss = gloss if gloss < one else one
            use = (light[p] > zero) & coloured
            total[p] += gloss * gloss if use else zero
            count[p] += one if use else zero
    for p in range(BLOCK):
        variance, square = total[p] / max(count[p], one), saturation[p] * saturation[p]
        share = variance / (variance + np.float32(ERROR * ERROR)) * (square / (square + np.float32(FAINT * FAINT)))
        t[p] = min(share, np.float32(MOST))


@njit(cache=True, error_model="numpy")
def _combine(mean, across, saturation, t, out):
    """Intensity of one light's samples."""
    one = np.float32(1.0)
    for p in range(len(out)):
        s = saturation[p]
        out[p] = ((one - t[p]) * mean[p] + s * across[p]) / (one - t[p] + s * s)
