"""Numbers as a reader expects them: digits in groups of three, a true minus, powers of ten in place of an e."""

import math

NARROW_SPACE = "\u202f"
PLAIN = (1e-4, 1e7)
"""Magnitudes that are written out; beyond them a power of ten is easier to read."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plain(value: float, digits: int = 4, *, padded: bool = False) -> str:
    """Return a finite number with `digits` significant digits.

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
    power = "10" + str(int(exponent)).translate(_RAISED)
    return power if mantissa == "1" else f"{mantissa.replace('-', '−')} × {power}"


def figure(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Return a measured figure as text: `digits` significant ones, a dash where there is none."""
    if value is None:
        return "–"
    if isinstance(value, int):
        digits = max(digits, len(str(abs(value))))
    shown = plain(value, digits, padded=not isinstance(value, int))
    return f"{shown}{NARROW_SPACE}{unit}" if unit else shown


def percent(value: float | None) -> str:
    """Return a share in per cent, to a hundredth."""
    if value is None:
        return "–"
    if 0 < value < 0.01:
        return "< 0.01\u202f%"
    return f"{value:.2f}\u202f%" if value else "0"


def signed(share: float | None) -> str:
    """Return a share in per cent with its sign, to a tenth."""
    if share is None:
        return "–"
    tenths = round(1000 * share)
    return f"{tenths / 10:+.1f}\u202f%".replace("-", "−") if tenths else "0\u202f%"


def degrees(value: float | None) -> str:
    """Return an angle to a degree, with a true minus and without a negative zero."""
    return "–" if value is None else f"{round(value):d}°".replace("-", "−")
