"""Declare what a stage writes: the arrays of its store."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple


class Output(NamedTuple):
    """An array of a store, as it is written and as the stage's page shows it."""

    name: str  # NNN: three digits
    dtype: str
    unit: str  # of its values, or what they count; empty of codes
    meaning: str

    @property
    def attributes(self) -> dict[str, Any]:
        """What is stored beside the values."""
        return {name: text for name, text in (("unit", self.unit), ("meaning", self.meaning)) if text}


def output_of(outputs: Iterable[Output], name: str) -> Output:
    """Return the declaration of an array. KeyError where a stage writes one that it does not declare."""
    known = {each.name: each for each in outputs}
    return known[name] if name in known else known[re.sub(r"\d{3}$", "NNN", name)]
