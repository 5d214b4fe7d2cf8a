"""What comes out of the fit of a tile, and what is said of it; apart, so that who only reads it loads no compiler."""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np


class TexelFlag(IntFlag):
    """Bits of `flags` in parameters.zarr."""

    OUTSIDE = 1  # of the chart: filled, never looked at
    UNSEEN = 2  # no usable observation (hidden, or saturated in every view): K_d too is from the neighbours
    ONCE = 4  # a single usable observation
    NO_HIGHLIGHT = 8  # no highlight of a determined width observed: sigma is the neighbours'
    KS_UNCONSTRAINED = 16  # nor was it looked at near the mirror direction: K_s too is the neighbours'


@dataclass(frozen=True)
class Parameters:
    """Of one tile: kd, ks (T, T, channels), sigma (T, T) radians, flags (T, T) uint8 of TexelFlag; none is NaN."""

    kd: np.ndarray
    ks: np.ndarray
    sigma: np.ndarray
    flags: np.ndarray
