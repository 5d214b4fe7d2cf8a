"""Numbers as a reader expects them: digits in groups of three, a true minus, powers of ten in place of an e."""

import math

NARROW_SPACE = "\u202f"
PLAIN = (1e-4, 1e7)
"""Magnitudes that are written out; beyond them a power of ten is easier to read."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plain(value: float, digits: int = 4, *, padded: bool = False) -> str:
    """A finite number with `digits` significant digits.

    padded: keep zeros at the end, which say how exact a measured value is. Whole numbers below 1e7 keep all digits.
    """
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return str(value)
    size = abs(float(f"{value:.{digits}g}"))
    if PLAIN[0] <= size < PLAIN[1]:
        decimals = max(0, digits - 1 - math.floor(math.log10(size)))
        shown = f"{value:,.{decimals}f}"
        if "." in shown and not padded:
            shown = shown.rstrip("0").rstrip(".")
        return shown.replace(",", NARROW_SPACE).replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if "." in mantissa and not padded:
        mantissa = mantissa.rstrip("0").rstrip(".")
    power = power_of_ten(int(exponent))
    return power if mantissa == "1" else f"{mantissa.replace('-', '−')} × {power}"


def power_of_ten(exponent: int) -> str:
    """10 with a raised exponent."""
    return "10" + str(exponent).translate(_RAISED)
