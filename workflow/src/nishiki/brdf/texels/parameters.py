"""What comes out of the fit of a tile; here, so that whoever only reads it loads no compiler."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Parameters:
    """Of one tile: kd, ks (T, T, channels), sigma (T, T) radians, flags (T, T) uint8 of TexelFlag; none is NaN."""

    kd: np.ndarray
    ks: np.ndarray
    sigma: np.ndarray
    flags: np.ndarray
