"""Declare the outputs of a stage: the arrays of its `maps.zarr`."""

import re
from collections.abc import Iterable
from typing import NamedTuple


class Output(NamedTuple):
    """An array of `maps.zarr`, as it is written and as the stage's page shows it."""

    name: str  # NNN: three digits
    dtype: str
    unit: str  # of its values, or what they count; empty of codes
    meaning: str


def output_of(outputs: Iterable[Output], name: str) -> Output:
    """Return the declaration of an array. KeyError where a stage writes one that it does not declare."""
    known = {each.name: each for each in outputs}
    return known[name] if name in known else known[re.sub(r"\d{3}$", "NNN", name)]
