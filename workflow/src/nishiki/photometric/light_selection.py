"""Separation by light selection: which lights show each pixel's diffuse reflection alone."""

from collections import namedtuple
from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import numpy as np

from nishiki.errors import UserError
from nishiki.progress import Summarised
from nishiki.threads import over_rows

METHODS = ("refit", "trimmed", "threshold", "none")
VALUES = 1 << 15  # samples of pixels that array code treats together: they stay in the cache


@dataclass(frozen=True, repr=False)
class LightSelection(Summarised):
    """Samples that are taken as diffuse, and the reasons against the others.

    usable (lights, rows, columns) bool; the counts (rows, columns) uint16 are lights per pixel. `invalid` counts the
    samples that arrived unusable (saturated, dark-clipped, not finite); `highlights` and `shadows` those that the
    method rejected as too bright or too dark.
    """

    usable: np.ndarray
    highlights: np.ndarray
    shadows: np.ndarray
    invalid: np.ndarray
    lights_usable: np.ndarray
    method: str


Lamps = namedtuple("Lamps", "directions products sort_all sort_smallest")
"""Lamps: directions (lights, 3), their products (lights, 9) float32; networks that sort all samples, the smallest."""


Selected = namedtuple("Selected", "usable highlights shadows")
"""A selection: usable (lights, pixels) bool; numbers of highlights and shadows (pixels,) uint16 among the others."""


def select_diffuse(
    observations, directions, *, method="refit", valid=None, w1=1.2, w2=0.1, keep=(0.3, 0.7), min_lights=4
):
    """Select per pixel the lights under which it shows diffuse reflection only.

    Parameters
    ----------
    observations : (lights, rows, columns) array_like of float
        Linear intensity relative to the white reference, one channel or the mean of the channels.
    directions : (lights, 3) array_like of float
        Unit vectors to the lights; x right, y up, z towards the camera.
    method : {'refit', 'none', 'threshold', 'trimmed'}, optional
        `refit`: least trimmed squares against Lambert's law, then every sample that agrees with the fit. `none`: every
        valid sample. `threshold`: those between w2 and w1 times the pixel's mean over the lights. `trimmed`: a share of
        the samples in order of brightness.
    valid : (lights, rows, columns) array_like of bool, optional
        False where a sample is saturated, dark-clipped or otherwise unusable. Samples that are not finite never count.
    w1, w2 : float, optional
        Of `threshold`: highlights are brighter than w1 means, shadows darker than w2.
    keep : tuple of float, optional
        Of `trimmed`: least and largest rank that is kept, as shares.
    min_lights : int, optional
        Least number of samples that `refit` and `trimmed` keep where there are so many.

    Returns
    -------
    LightSelection
        `usable` (lights, rows, columns) bool; numbers of highlights, shadows and invalid samples of each pixel.

    Raises
    ------
    nishiki.errors.UserError
        For shapes that do not fit together and settings out of range.

    References
    ----------
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, section 3.2.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> lights = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8], [0, 0, 1]])
    >>> observations = np.broadcast_to(0.5 * lights[:, 2:, None], (5, 2, 3)).copy()
    >>> observations[0, 1, 2] = 3.0  # a highlight
    >>> chosen = nishiki.select_lights(observations, lights)
    >>> chosen.usable[:, 1, 2].tolist()
    [False, True, True, True, True]
    """
    stack, directions = checked_stack(observations, directions)
    shape = (stack.shape[0], *np.shape(observations)[1:])
    known = checked_valid(stack, valid, shape)
    pixels = stack.shape[1]
    usable = np.empty(stack.shape, dtype=np.bool_)
    highlights, shadows = np.zeros(pixels, dtype=np.uint16), np.zeros(pixels, dtype=np.uint16)
    if method == "none":
        usable[...] = known
    elif method == "refit":
        refit(stack, known, directions, min_lights, Selected(usable, highlights, shadows))
    elif method == "threshold":
        if not 0 <= w2 < w1:
            raise UserError(f"light selection by thresholds: expected 0 <= w2 < w1, found w1 = {w1}, w2 = {w2}")
        mean = np.where(known, stack, np.float32(0)).sum(axis=0, dtype=np.float64) / np.maximum(known.sum(axis=0), 1)
        reject(stack, known, w2 * mean, w1 * mean, usable, highlights, shadows)
    elif method == "trimmed":
        low, high = keep
        if not 0 <= low < high <= 1:
            raise UserError(
                f"light selection by rank: expected keep = [low, high] with 0 <= low < high <= 1, found {keep}"
            )
        darkest, brightest = rank_limits(stack, known, low, high, min_lights)
        reject(stack, known, darkest, brightest, usable, highlights, shadows)
    else:
        raise UserError(f"light selection: expected a method of {', '.join(METHODS)}, found {method!r}")
    invalid = np.broadcast_to((~known).sum(axis=0, dtype=np.uint16), pixels)
    return LightSelection(
        usable=usable.reshape(shape),
        highlights=highlights.reshape(shape[1:]),
        shadows=shadows.reshape(shape[1:]),
        invalid=invalid.reshape(shape[1:]),
        lights_usable=usable.sum(axis=0, dtype=np.uint16).reshape(shape[1:]),
        method=method,
    )


def reject(stack, known, least, most, usable, highlights, shadows):
    """Mark the valid samples from `least` to `most` (pixels,), and count those above and below."""
    high, low = known & (stack > most), known & (stack < least)
    usable[...] = known & ~high & ~low
    highlights[:] = high.sum(axis=0)
    shadows[:] = (low & ~high).sum(axis=0)


def rank_limits(stack, known, low, high, at_least):
    """Find the smallest and the largest value (pixels,) of the share low .. high of each pixel's valid samples.

    The share is widened to `at_least` samples, towards the dark side first: highlights mislead more than attached
    shadows do.
    """
    count = np.broadcast_to(known.sum(axis=0), stack.shape[1])
    first, last = np.floor(low * count + 0.5).astype(int), np.floor(high * count + 0.5).astype(int) - 1
    for _ in range(at_least):
        first = first - ((last - first + 1 < at_least) & (first > 0))
        last = last + ((last - first + 1 < at_least) & (last < count - 1))
    values = np.sort(np.where(known, stack, np.float32(np.inf)), axis=0)
    return (np.take_along_axis(values, np.maximum(rank, 0)[None], 0)[0] for rank in (first, last))


@lru_cache(maxsize=64)
def sorting_network(size, smallest=None):
    """List the comparators (n, 2) int32 of Batcher's odd-even merge sort for any number of values.

    smallest: number of values, counted from the smallest, that have to be in their places; default all. Comparators
    that reach none of them are left out.

    A network compares the same places whatever the values are, so that one pass sorts as many pixels as the vector
    unit has lanes. Source: K. E. Batcher, Sorting networks and their applications, AFIPS 1968; for sizes that are no
    power of two, Knuth, The Art of Computer Programming 3, section 5.2.2, algorithm M.
    """
    pairs = []
    span = 1 << max(0, (size - 1).bit_length() - 1)
    p = span
    while p > 0:
        q, r, d = span, 0, p
        while True:
            pairs += [(i, i + d) for i in range(size - d) if i & p == r]
            if q == p:
                break
            d, q, r = q - p, q >> 1, p
        p >>= 1
    needed, kept = set(range(size if smallest is None else smallest)), []
    for pair in reversed(pairs):
        if needed & {*pair}:
            needed |= {*pair}
            kept.append(pair)
    return np.array(kept[::-1], dtype=np.int32).reshape(-1, 2)


def half_vectors(directions):
    """Compute unit vectors (lights, 3) halfway between light and view."""
    halves = directions + np.array([0.0, 0.0, 1.0])
    return halves / np.maximum(np.linalg.norm(halves, axis=1, keepdims=True), 1e-12)


def sum_lights(*factors: np.ndarray) -> np.ndarray:
    """Sum products (lights, pixels) over the lights one by one, so that a pixel does not depend on its neighbours."""
    return np.einsum(",".join(["jp"] * len(factors)) + "->p", *factors)


def direction_products(directions):
    """Compute xx, xy, xz, yy, yz, zz, x, y, z of each direction, as the kernels add them up: (lights, 9)."""
    x, y, z = directions.T
    return np.ascontiguousarray(np.stack([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z], axis=1))


def distinct_sets(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one column of chosen (lights, n) bool for each distinct column, and the number of each column's set."""
    first, member = np.zeros(1, np.int64), np.zeros(chosen.shape[1], np.int64)
    for start in range(0, len(chosen), 32):
        bits = chosen[start : start + 32]
        words = (1 << np.arange(len(bits))) @ bits.astype(np.float64)
        keys = member << 32 | words.astype(np.int64)
        _, first, member = np.unique(keys, return_index=True, return_inverse=True)
    return first, member


def refit(stack, known, directions, min_lights, selected):
    """Run `refit_selection` with the project's constants (docs/stages/separate.md gives their reasons)."""
    from nishiki.lanes import BLOCK, repeat_pixels
    from nishiki.photometric.refit import COVERAGE, refit_selection

    if min_lights < 3:
        raise UserError(f"light selection by re-fit: expected min_lights >= 3, found {min_lights}")
    directions = np.ascontiguousarray(directions, np.float32)
    lights, pixels = stack.shape
    smallest = min(lights, max(min_lights, ceil(COVERAGE * lights)))
    networks = sorting_network(lights), sorting_network(lights, smallest)
    lamps = Lamps(directions, direction_products(directions), *networks)
    if pixels >= BLOCK:
        over_rows(refit_selection, -(-pixels // BLOCK), stack, known, lamps, np.float32(min_lights), selected)
    elif pixels:
        known = known if known.shape[1] == 1 else repeat_pixels(known, BLOCK)
        stack = repeat_pixels(stack, BLOCK)
        block = Selected(np.empty(stack.shape, np.bool_), np.empty(BLOCK, np.uint16), np.empty(BLOCK, np.uint16))
        refit_selection(0, 1, stack, known, lamps, np.float32(min_lights), block)
        for whole, values in zip(selected, block, strict=True):
            whole[...] = values[..., :pixels]


def checked_stack(observations, directions):
    """Check observations, as (lights, pixels) float32, and directions, as (lights, 3) float64; UserError else."""
    stack = np.asarray(observations, dtype=np.float32)
    if stack.ndim != 3:
        raise UserError(
            f"observations: expected three axes (lights, rows, columns), found shape {stack.shape};"
            " give one channel or the mean of the channels"
        )
    directions = np.asarray(directions, dtype=np.float64)
    if directions.shape != (stack.shape[0], 3):
        raise UserError(
            f"light directions: expected shape ({stack.shape[0]}, 3), one for each of the {stack.shape[0]} images,"
            f" found {directions.shape}"
        )
    length = np.linalg.norm(directions, axis=1)
    wrong = np.flatnonzero(~(np.abs(length - 1.0) < 1e-3))
    if wrong.size:
        raise UserError(
            f"light directions: expected unit vectors, found length {length[wrong[0]]:.6g} at light {wrong[0]}"
            f" ({wrong.size} such lights); divide each by its length"
        )
    return np.ascontiguousarray(stack.reshape(stack.shape[0], -1)), np.ascontiguousarray(directions)


def checked_valid(stack, valid, shape):
    """Check the mask of samples that may be used: (lights, pixels), or (lights, 1) where all are."""
    with np.errstate(over="ignore", invalid="ignore"):  # one pass without a mask; overflow only costs the slower way
        finite = bool(np.isfinite(stack.sum(axis=0)).all())
    if valid is None and finite:
        return np.ones((stack.shape[0], 1), dtype=np.bool_)
    if valid is None:
        return np.isfinite(stack)
    valid = np.asarray(valid, dtype=np.bool_)
    if valid.shape != shape:
        raise UserError(f"mask of samples: expected shape {shape} as the observations, found {valid.shape}")
    known = np.ascontiguousarray(valid.reshape(stack.shape))
    return known if finite else known & np.isfinite(stack)


def pack_lights(chosen: np.ndarray) -> np.ndarray:
    """Pack samples (lights, rows, columns) bool as bits (rows, columns, bytes): bit j of byte i is light 8 i + j.

    A light at a time, all pixels at once: packing along the axis of the lights takes twenty times as long.
    """
    planes = np.zeros((-(-len(chosen) // 8), *chosen.shape[1:]), np.uint8)
    for j, light in enumerate(chosen.view(np.uint8)):
        planes[j // 8] |= light << (j % 8)
    return np.moveaxis(planes, 0, -1)


def unpack_lights(packed: np.ndarray, lights: int) -> np.ndarray:
    """Unpack samples (lights, rows, columns) bool from the bits of `pack_lights`."""
    planes = np.ascontiguousarray(np.moveaxis(packed, -1, 0))
    chosen = np.empty((lights, *packed.shape[:-1]), np.uint8)
    for j in range(lights):
        np.right_shift(planes[j // 8], j % 8, out=chosen[j])
        chosen[j] &= 1
    return chosen.view(bool)
