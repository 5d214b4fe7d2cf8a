"""Declare what a stage writes: the arrays of its store."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple


class Output(NamedTuple):
    """An array of a store, as it is written and as the stage's page shows it."""

    name: str  # NNN: three digits; COMPONENT: a word
    dtype: str
    unit: str  # of its values, or what they count; empty of codes
    meaning: str
    axes: str = ""  # where they follow the capture: names of the axes, a number where the length is fixed

    @property
    def attributes(self) -> dict[str, Any]:
        """What is stored beside the values."""
        return {name: text for name, text in (("unit", self.unit), ("meaning", self.meaning)) if text}


def output_of(outputs: Iterable[Output], name: str) -> Output:
    """Return the declaration of an array. KeyError where a stage writes one that it does not declare."""
    for output in outputs:
        if re.fullmatch(output.name.replace("NNN", r"\d{3}").replace("COMPONENT", r"\w+"), name):
            return output
    raise KeyError(name)


def convert_to_declared(outputs: Iterable[Output], arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Give arrays their declared types. KeyError where one is not declared, ValueError where axes disagree.

    Axes of one name have one length in all arrays.
    """
    outputs, lengths, out = tuple(outputs), dict[str, int](), {}
    for name, values in arrays.items():
        declared = output_of(outputs, name)
        axes = declared.axes.split()
        pairs = zip(axes, values.shape, strict=False)
        found = tuple(lengths.setdefault(axis, int(axis) if axis.isdigit() else n) for axis, n in pairs)
        if len(axes) != values.ndim or found != values.shape:
            raise ValueError(f"array {name} of shape {values.shape}: expected the axes {axes}, of lengths {lengths}")
        out[name] = values.astype(declared.dtype, copy=False)
    return out
