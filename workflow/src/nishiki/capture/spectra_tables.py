"""Curves over wavelength from CSV: camera sensitivities, the lamp's spectrum, patch reflectances."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.formats.problems import CaptureError, error, raise_errors
from nishiki.formats.text_tables import expect_rows, reading, table_rows

FIRST_NM, LAST_NM = 400.0, 700.0


@dataclass(frozen=True)
class Curves:
    """wavelengths_nm (n,) float64 increasing; values (n, curves) float64, >= 0; names: one a curve."""

    names: tuple[str, ...]
    wavelengths_nm: np.ndarray
    values: np.ndarray


def read_curves(path: Path, *, names: tuple[str, ...] | None = None, label: str | None = None) -> Curves:
    """Read wavelength_nm and one column a curve, covering 400-700 nm.

    names: the columns wanted, in this order (None: all). Raises CaptureError with all mistakes: spectra-missing,
    spectra-unreadable, spectra-many, spectra-columns, spectra-not-finite, spectra-negative, spectra-order,
    spectra-range, spectra-zero.
    """
    label = label or path.name
    header, rows = _table(path, label)
    if header[:1] != ["wavelength_nm"] or len(header) < 2:
        expected = "wavelength_nm, then one column a curve"
        raise CaptureError(error("spectra-columns", label, "columns", expected=expected, found=",".join(header)[:80]))
    selected = list(names) if names else header[1:]
    missing = [n for n in selected if n not in header[1:]]
    if missing or len(set(header)) != len(header):
        what = f"no column for {', '.join(missing)}" if missing else "a column appears twice"
        remedy = "Name the columns as camera.channels does"
        raise CaptureError(error("spectra-columns", label, what, found=",".join(header)[:80], remedy=remedy))
    try:
        numbers = np.array([[float(v) for v in row] for row in rows], dtype=np.float64).reshape(-1, len(header))
    except ValueError as e:
        raise CaptureError(error("spectra-unreadable", label, "a value is not a number", found=str(e))) from e
    wavelengths, values = numbers[:, 0], numbers[:, [header.index(n) for n in selected]]
    raise_errors(_mistakes(wavelengths, values, label))
    return Curves(tuple(selected), wavelengths, values)


def _table(path: Path, label: str) -> tuple[list[str], list[list[str]]]:
    with reading(label, "spectra"):
        rows = [cells for _, cells in table_rows(path, label)]
    if not rows:
        raise CaptureError(error("spectra-unreadable", label, "empty file"))
    expect_rows(len(rows[0]), "table_columns", label, "spectra")
    uneven = [i for i, row in enumerate(rows, start=1) if len(row) != len(rows[0])]
    if uneven:
        what = f"row {uneven[0]} has another number of values than the heading"
        raise CaptureError(error("spectra-unreadable", label, what, expected=f"{len(rows[0])} values"))
    return rows[0], rows[1:]


def _mistakes(wavelengths: np.ndarray, values: np.ndarray, label: str) -> list:
    if not (np.isfinite(wavelengths).all() and np.isfinite(values).all()):
        bad = int((~np.isfinite(values)).sum() + (~np.isfinite(wavelengths)).sum())
        return [error("spectra-not-finite", label, f"{bad} values are not finite")]
    problems = []
    if len(wavelengths) > 1 and not (np.diff(wavelengths) > 0).all():
        at = wavelengths[1:][np.diff(wavelengths) <= 0][0]
        problems.append(error("spectra-order", label, "wavelengths do not increase", found=f"at {at:g} nm"))
    if len(wavelengths) < 2 or wavelengths.min() > FIRST_NM or wavelengths.max() < LAST_NM:
        found = f"{wavelengths.min():g}-{wavelengths.max():g} nm" if len(wavelengths) else "no rows"
        expected = f"at least {FIRST_NM:g}-{LAST_NM:g} nm"
        remedy = "Measure or extend the curve; it is not extrapolated"
        what = "wavelength range is too short"
        problems.append(error("spectra-range", label, what, expected=expected, found=found, remedy=remedy))
    if (values < 0).any():
        found = f"{values.min():g}"
        problems.append(error("spectra-negative", label, f"{int((values < 0).sum())} negative values", found=found))
    elif values.size and not (values > 0).any(axis=0).all():
        problems.append(error("spectra-zero", label, "a curve is zero everywhere"))
    return problems
