"""Fitted parameters that ended at the end of their range: such a value is the range's, not the object's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

NAME = "at_bounds"
"""Any stage lists such parameters in words under this name, at any depth of its diagnostics."""


def at_bounds(diagnostics: Mapping[str, Any]) -> list[str]:
    """Parameters at a bound, each with the block of the diagnostics that it belongs to."""
    names = []
    for name, value in diagnostics.items():
        if name == NAME:
            names += [str(each) for each in value]
        elif isinstance(value, Mapping):
            names += [f"{name}: {each}" for each in at_bounds(value)]
    return names


def at_end(value: float, low: float, high: float, *, near: float = 1e-4) -> str:
    """ "lower" | "upper": the end of its range at which a fitted value stands, within this share of it; else ""."""
    margin = near * (high - low)
    return "lower" if value <= low + margin else "upper" if value >= high - margin else ""
