"""Selection by two fixed thresholds on the mean observation, as published (Tominaga and Tanaka 2004, section 3.2)."""

import numpy as np
from numba import njit, prange

BLOCK = 256  # pixels handled together: the innermost loops run over neighbouring pixels, so that they become SIMD code


@njit(cache=True, parallel=True, error_model="numpy")
def threshold_selection(observations, valid, above, below, usable, highlights, shadows):
    """Mark in `usable` the samples within [below, above] times the pixel's mean over its valid lights.

    observations (lights, pixels) float32; valid (lights, pixels) bool, or (lights, 1) for "the same everywhere";
    usable (lights, pixels) bool, highlights and shadows (pixels,) uint16 are written.
    """
    lights, pixels = observations.shape
    shared = valid.shape[1] == 1
    for block in prange((pixels + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        last = min(first + BLOCK, pixels)
        total = np.zeros(last - first)
        count = np.zeros(last - first)
        for j in range(lights):
            if shared and not valid[j, 0]:
                continue
            for p in range(first, last):
                if shared or valid[j, p]:
                    total[p - first] += observations[j, p]
                    count[p - first] += 1.0
        mean = total / np.maximum(count, 1.0)
        highlights[first:last] = 0
        shadows[first:last] = 0
        for j in range(lights):
            for p in range(first, last):
                known = valid[j, 0] if shared else valid[j, p]
                high = observations[j, p] > above * mean[p - first]
                low = observations[j, p] < below * mean[p - first]
                usable[j, p] = known and not high and not low
                highlights[p] += known and high
                shadows[p] += known and low and not high
