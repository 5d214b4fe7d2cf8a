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

from nishiki.lanes import LANES, choose, load, load_three, planes, repeated, root, splat, store
from nishiki.threads import over_rows

LIT = 0.3  # of the lower mean of a pixel: darker samples are shadow, whose colour is that of the noise
ERROR = 0.1  # standard deviation E of a sample's error, relative to the pixel's lower mean
FAINT = 0.05  # saturation below which a colour is not told from errors of the white balance
MOST = 0.97  # largest t
NOISE = 6.0  # squared deviations of noise that do not count as gloss: s is that of the samples farthest from grey
CONCENTRATIONS = 2  # times that the less saturated samples are left out
AT_LEAST = 4  # lit samples
SMALLEST = np.float32(1e-37)  # peak that has an inverse in float32


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
    stack = np.ascontiguousarray(observations).reshape(lights, rows * columns, channels)
    known = np.require(np.broadcast_to(valid, out.shape), bool, ["C", "W"]).reshape(lights, rows * columns)
    if rows * columns >= LANES:
        over_rows(_weigh, -(-rows * columns // LANES), stack, known, out.reshape(lights, rows * columns))
    elif out.size:
        block = np.empty((lights, LANES), np.float32)
        _weigh(0, 1, repeated(stack, LANES), repeated(known, LANES), block)
        out.reshape(lights, rows * columns)[...] = block[:, : rows * columns]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(begin, end, observations, valid, out):
    lights, pixels, channels = observations.shape
    memory, row = planes(lights * channels + channels + 3 * lights, np.int64(LANES)), lights * channels + channels
    samples, colour = memory[: lights * channels], memory[lights * channels : row]
    mean, across, lit = memory[row : row + lights], memory[row + lights : row + 2 * lights], memory[row + 2 * lights :]
    for block in range(begin, end):
        start = min(block * LANES, pixels - LANES)  # the last block overlaps: its pixels get the same twice
        peak = _load_block(observations, valid, start, samples, mean, lit)
        lower = _leave_out_shadow(mean, lit)
        square = _body_colour(samples, mean, lit, colour)
        _project(samples, colour, across)
        saturation = _body_saturation(mean, across, lit)
        t = _gloss_share(mean, across, lit, lower, saturation, square, channels)
        # the intensity of a sample, in the units of the observations
        rest = splat(np.float32(1.0)) - t
        unit = peak / (rest + saturation * saturation)
        of_mean, of_colour = rest * unit, saturation * unit
        for j in range(lights):
            store(out, (j, start), of_mean * load(mean, (j, 0)) + of_colour * load(across, (j, 0)))


@njit(cache=True, error_model="numpy")
def _load_block(observations, valid, start, samples, mean, lit):
    """Channels (lights * channels, LANES) and mean of a block, relative to the largest mean, which is returned.

    lit: 1 for samples that are valid and neither black nor infinite. Sums of any radiometric scale stay in float32.
    """
    lights, _, channels = observations.shape
    zero, one, most = np.float32(0.0), np.float32(1.0), np.float32(np.inf)
    per_channel = np.float32(1.0 / channels)
    peak = splat(zero)
    for j in range(lights):
        if channels == 3:
            red, green, blue = load_three(observations, j, start)
            store(samples, (3 * j, 0), red)
            store(samples, (3 * j + 1, 0), green)
            store(samples, (3 * j + 2, 0), blue)
            value = red * per_channel + green * per_channel + blue * per_channel
        else:
            value = splat(zero)
            for k in range(channels):
                for p in range(LANES):
                    samples[channels * j + k, p] = observations[j, start + p, k]
                value += load(samples, (channels * j + k, 0)) * per_channel
        good = load(valid, (j, start)) & (value > zero) & (value < most)
        store(mean, (j, 0), value)
        store(lit, (j, 0), choose(good, one, zero))
        peak = choose(good & (value > peak), value, peak)
    peak = choose(peak > zero, choose(peak > SMALLEST, peak, SMALLEST), one)
    per_peak = splat(one) / peak
    for j in range(lights):
        store(mean, (j, 0), load(mean, (j, 0)) * per_peak)
        for k in range(channels * j, channels * (j + 1)):
            store(samples, (k, 0), load(samples, (k, 0)) * per_peak)
    return peak


@njit(cache=True, error_model="numpy")
def _leave_out_shadow(mean, lit):
    """Mean of the darker half of each pixel's lit samples; those far below it count as shadow."""
    zero, one = np.float32(0.0), np.float32(1.0)
    total = count = lower = darker = splat(zero)
    for j in range(len(mean)):
        light = load(lit, (j, 0))
        total += choose(light > zero, load(mean, (j, 0)), zero)
        count += light
    middle = total / choose(count > one, count, one)
    for j in range(len(mean)):
        value = load(mean, (j, 0))
        low = (load(lit, (j, 0)) > zero) & (value <= middle)
        lower += choose(low, value, zero)
        darker += choose(low, one, zero)
    lower = lower / choose(darker > one, darker, one)
    least = lower * np.float32(LIT)
    for j in range(len(mean)):
        store(lit, (j, 0), choose(load(mean, (j, 0)) >= least, load(lit, (j, 0)), zero))
    return lower


@njit(cache=True, error_model="numpy")
def _body_colour(samples, mean, lit, colour):
    """Estimate the unit direction (channels, LANES) from grey, 0 where unknown; return the sum of the squares."""
    zero, one = np.float32(0.0), np.float32(1.0)
    channels, square, count, every = len(colour), splat(zero), splat(zero), splat(zero)
    for k in range(channels):
        total = splat(zero)
        for j in range(len(mean)):
            difference = load(samples, (channels * j + k, 0)) - load(mean, (j, 0))
            difference = choose(load(lit, (j, 0)) > zero, difference, zero)
            total += difference
            every += difference * difference
        store(colour, (k, 0), total)
        square += total * total
    for j in range(len(mean)):
        count += load(lit, (j, 0))
    length = root(square)
    known = (count >= np.float32(AT_LEAST)) & (length > np.float32(1e-12))
    length = choose(known, length, one)
    for k in range(channels):
        store(colour, (k, 0), choose(known, load(colour, (k, 0)) / length, zero))
    return every


@njit(cache=True, error_model="numpy")
def _project(samples, colour, across):
    """Part of every sample along the body's colour, so that across / mean is the saturation."""
    channels = len(colour)
    per_root = np.float32(1.0 / np.sqrt(channels))
    for j in range(len(across)):
        part = splat(np.float32(0.0))
        for k in range(channels):
            part += load(samples, (channels * j + k, 0)) * load(colour, (k, 0))
        store(across, (j, 0), part * per_root)


@njit(cache=True, error_model="numpy")
def _body_saturation(mean, across, lit):
    """Saturation of the most saturated samples: gloss only takes it away."""
    zero, few = np.float32(0.0), np.float32(1e-12)
    saturation = splat(zero)
    for _ in range(CONCENTRATIONS + 1):
        total = weight = splat(zero)
        for j in range(len(mean)):
            grey, part = load(mean, (j, 0)), load(across, (j, 0))
            kept = (load(lit, (j, 0)) > zero) & (part >= saturation * grey)
            total += choose(kept, part, zero)
            weight += choose(kept, grey, zero)
        saturation = total / choose(weight > few, weight, few)
        saturation = choose(saturation > zero, saturation, zero)
    return saturation


@njit(cache=True, error_model="numpy")
def _gloss_share(mean, across, lit, lower, saturation, every, channels):
    """t of every pixel, from the variances of its gloss and noise relative to its level, and its saturation.

    every: sum of the squares of the samples' differences from grey.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    coloured = saturation > zero
    per_saturation = splat(one) / choose(coloured, saturation, one)
    per_lower = splat(one) / lower
    total = count = along = splat(zero)
    for j in range(len(mean)):
        gloss = (load(mean, (j, 0)) - load(across, (j, 0)) * per_saturation) * per_lower
        gloss = choose(gloss > zero, gloss, zero)
        gloss = choose(gloss < one, gloss, one)
        use = (load(lit, (j, 0)) > zero) & coloured
        total += choose(use, gloss * gloss, zero)
        along += choose(use, load(across, (j, 0)) * load(across, (j, 0)), zero)
        count += choose(use, one, zero)
    number, square = np.float32(channels), saturation * saturation
    freedom = (count - one) * np.float32(max(channels - 2, 1))
    noise = (every - number * along) * per_lower * per_lower / choose(freedom > one, freedom, one)
    noise = choose(noise > zero, noise, zero)
    unsure = np.float32(NOISE) * noise * (one + per_saturation * per_saturation) / number
    variance = total / choose(count > one, count, one) - unsure
    variance = choose(variance > zero, variance, zero)
    error = noise + np.float32(ERROR * ERROR)
    share = variance / (variance + error) * (square / (square + np.float32(FAINT * FAINT)))
    return choose(share < np.float32(MOST), share, np.float32(MOST))
