"""Turn dataclasses into plain values for JSON or into arrays for NPZ by their fields, and back."""

from dataclasses import fields, is_dataclass
from typing import Any, Self

import numpy as np


def plain(value: Any) -> Any:
    """Return a value as JSON holds it: dataclasses as dictionaries, arrays and tuples as lists."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def tuples(value: Any) -> Any:
    """Return a value with tuples in place of lists, at any depth."""
    return tuple(tuples(each) for each in value) if isinstance(value, list | tuple) else value


class PlainFields:
    """Offer a dataclass of numbers, words, tuples and float64 arrays as plain values."""

    def as_dict(self) -> dict[str, Any]:
        """Return its fields by name, for JSON."""
        return plain(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Restore what `as_dict` returned; keys beyond the fields are ignored."""
        names = {field.name: field.type for field in fields(cls)}  # type: ignore[arg-type]
        return cls(
            **{
                name: np.array(values[name], np.float64) if kind is np.ndarray else tuples(values[name])
                for name, kind in names.items()
            }
        )


class ArrayFields:
    """Offer a dataclass whose fields are arrays, numbers and words as arrays."""

    def as_arrays(self) -> dict[str, np.ndarray]:
        """Return its fields by name."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_arrays(cls, arrays: Any) -> Self:
        """Restore what `as_arrays` returned, from any mapping; arrays of no dimension become numbers or words."""
        values = {field.name: np.asarray(arrays[field.name]) for field in fields(cls)}  # type: ignore[arg-type]
        return cls(**{name: value if value.ndim else value.item() for name, value in values.items()})
