"""What can be wrong with a fitted reflection model; a fit without a flag (0) is a fit to rely on."""

from enum import IntFlag


class FitFlag(IntFlag):
    """Bits of the `flags` of a fit."""

    NO_HIGHLIGHT = 1  # a lobe takes off no more than noise does: strength 0, width NaN
    AT_BOUND = 2  # the half width stands at the end of the range that was searched
    TOO_FEW = 4  # fewer observations than unknowns: strength 0, width NaN
    UNDETERMINED = (
        8  # fewer than two observations within two half widths, or a width known to worse than a factor e^0.5
    )
    NOT_FINITE = 16  # some observations were not finite and were left out
