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

from nishiki.photometric.light_selection import sum_lights
from nishiki.threads import over_rows

LIT = 0.3  # of the lower mean of a pixel: darker samples are shadow, whose colour is that of the noise
ERROR = 0.1  # standard deviation E of a sample's error, relative to the pixel's lower mean
FAINT = 0.05  # saturation below which a colour is not told from errors of the white balance
MOST = 0.97  # largest t
NOISE = 6.0  # squared deviations of noise that do not count as gloss: s is that of the samples farthest from grey
CONCENTRATIONS = 2  # times that the less saturated samples are left out
AT_LEAST = 4  # lit samples
SMALLEST = np.float32(1e-37)  # peak that has an inverse in float32
VALUES = 1 << 15  # of a channel at a time


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
    stack = observations.reshape(lights, rows * columns, channels)
    known = np.broadcast_to(valid, observations.shape[:3]).reshape(lights, rows * columns)
    out = np.empty(known.shape, np.float32)

    def weigh(begin: int, end: int, stack: np.ndarray) -> None:
        step = max(2, VALUES // lights)
        for first in range(begin, end, step):
            here = slice(max(min(first, end - 2), 0), min(first + step, end))  # two at least: one is added up in parts
            out[:, here] = _weigh(np.moveaxis(stack[:, here], -1, 0), known[:, here])

    if rows * columns == 1:
        stack, known = stack.repeat(2, axis=1), known.repeat(2, axis=1)
        return _weigh(np.moveaxis(stack, -1, 0), known)[:, :1].reshape(lights, rows, columns)
    over_rows(weigh, rows * columns, stack)
    return out.reshape(lights, rows, columns)


def _weigh(samples: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Intensity (lights, pixels) of samples (channels, lights, pixels), in the module's equations."""
    zero, one, channels = np.float32(0), np.float32(1), np.float32(len(samples))

    with np.errstate(all="ignore"):
        mean = sum(channel / channels for channel in samples)
        lit = valid & (mean > 0) & (mean < np.inf)
        peak = np.where(lit, mean, zero).max(axis=0)
        # sums of any radiometric scale stay in float32
        peak = np.where(peak > 0, np.maximum(peak, SMALLEST), one)
        samples, mean = samples / peak, mean / peak
        level, used = np.where(lit, mean, zero), lit.astype(np.float32)
        # the darker half of each pixel's lit samples; what is far below it is shadow
        low = used * (level <= level.sum(axis=0) / np.maximum(used.sum(axis=0), one))
        lower = sum_lights(level, low) / np.maximum(low.sum(axis=0), one)
        used *= level >= LIT * lower
        lit, count = used > 0, used.sum(axis=0)
        apart = [np.where(lit, channel - mean, zero) for channel in samples]
        colour = np.stack([each.sum(axis=0) for each in apart])
        every = sum(sum_lights(each, each) for each in apart)
        length = np.sqrt(np.square(colour).sum(axis=0))
        colour /= np.where((count >= AT_LEAST) & (length > 1e-12), length, np.float32(np.inf))
        across = sum(each * channel for each, channel in zip(colour, samples, strict=True)) / np.sqrt(channels)
        part, grey, saturation = np.where(lit, across, zero), level * used, np.zeros_like(lower)
        for _ in range(CONCENTRATIONS + 1):
            kept = (part >= saturation * grey).astype(np.float32)
            saturation = np.maximum(
                sum_lights(part, kept) / np.maximum(sum_lights(grey, kept), np.float32(1e-12)), zero
            )
        square = saturation**2
        gloss = np.clip((grey - part / np.where(saturation > 0, saturation, np.float32(np.inf))) / lower, zero, one)
        freedom = (count - one) * max(channels - 2, one)
        noise = np.maximum((every - channels * sum_lights(part, part)) / lower**2 / np.maximum(freedom, one), zero)
        unsure = NOISE * noise * (one + one / square) / channels
        variance = sum_lights(gloss, gloss) / np.maximum(count, one) - unsure
        variance = np.where(saturation > 0, np.maximum(variance, zero), zero)
        share = variance / (variance + noise + ERROR**2) * square / (square + FAINT**2)
        rest = one - np.fmin(share, MOST)
        return (rest * mean + saturation * across) * (peak / (rest + square))
