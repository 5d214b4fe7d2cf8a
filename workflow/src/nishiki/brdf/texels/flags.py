"""What is said of a texel's parameters; 0: all of them come from its own observations."""

from enum import IntFlag


class TexelFlag(IntFlag):
    """Bits of `flags` in parameters.zarr."""

    OUTSIDE = 1  # of the chart: filled, never looked at
    UNSEEN = 2  # no usable observation (hidden, or saturated in every view): K_d too is from the neighbours
    ONCE = 4  # a single usable observation
    NO_HIGHLIGHT = 8  # no highlight of a determined width observed: sigma is the neighbours'
    KS_UNCONSTRAINED = 16  # nor was it looked at near the mirror direction: K_s too is the neighbours'
