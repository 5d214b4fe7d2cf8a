"""What every reflection model of a cloth offers, and the geometry that they share.

A BRDF is a frozen dataclass in the cloth's frame: x the weft, y the warp, z the normal; unit vectors away from the
surface.  `evaluate` gives 1 / sr, broadcasts, is finite everywhere and 0 where light or view is not above the horizon.
`as_arrays` and `from_arrays` are inverse to each other and hold numbers only, so that a model is stored without pickle
(`nishiki.brdf.cloth.store`).
"""

from dataclasses import dataclass, fields
from typing import ClassVar, Protocol, Self

import numpy as np


class ClothBrdf(Protocol):
    """The interface."""

    KIND: ClassVar[str]  # a class that is reciprocal by construction says so: RECIPROCAL = True

    @property
    def channels(self) -> int:
        """Number of channels of the values."""

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, 1 / sr: (..., channels) from unit vectors (..., 3) that broadcast against each other."""

    def as_arrays(self) -> dict[str, np.ndarray]:
        """All that the model is, as arrays."""

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Self:
        """The model of `as_arrays`."""


class ArrayFields:
    """`as_arrays` and `from_arrays` of a dataclass whose fields are arrays and numbers."""

    def as_arrays(self) -> dict[str, np.ndarray]:
        """Its fields by name."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Self:
        """The dataclass of these fields; arrays of no dimension become numbers."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: arrays[name].item() if np.ndim(arrays[name]) == 0 else arrays[name] for name in names})


LEAST_COSINE = 1e-9  # of directions above the horizon: nearer ones count as that near, so that quotients stay finite


def off_horizon(directions: np.ndarray) -> np.ndarray:
    """Directions (..., 3) with 0 < z < LEAST_COSINE lifted to it (their length stays 1 to 1e-18); the rest as it is."""
    directions = np.asarray(directions, float)
    low = (directions[..., 2] > 0) & (directions[..., 2] < LEAST_COSINE)
    if not low.any():
        return directions
    lifted = directions.copy()
    lifted[low, 2] = LEAST_COSINE
    return lifted


@dataclass(frozen=True)
class Halves:
    """Light, view and their half vector h in the cloth's frame; arrays of the directions' broadcast shape (...,)."""

    above: np.ndarray  # bool: light and view above the horizon
    cos_i: np.ndarray  # n . light, 1 where not above, so that quotients stay finite
    cos_r: np.ndarray  # n . view, likewise
    h: np.ndarray  # (..., 3) unit, (0, 0, 1) where not above
    cos_d: np.ndarray  # h . light = h . view, 0 .. 1: the incidence on the facet


def halves(incident: np.ndarray, outgoing: np.ndarray) -> Halves:
    """Geometry of unit vectors (..., 3), broadcast against each other."""
    incident, outgoing = np.broadcast_arrays(off_horizon(incident), off_horizon(outgoing))
    above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
    total = np.where(above[..., None], incident + outgoing, (0.0, 0.0, 1.0))
    # |i + o| is at least i_z + o_z > 0: a half vector exists wherever both are above
    length = np.sqrt(np.sum(total * total, axis=-1))
    return Halves(
        above=above,
        cos_i=np.where(above, incident[..., 2], 1.0),
        cos_r=np.where(above, outgoing[..., 2], 1.0),
        h=total / length[..., None],
        cos_d=np.where(above, np.minimum(length / 2, 1.0), 1.0),
    )


def only_above(above: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (..., channels), 0 where `above` (...,) is not."""
    return np.where(above[..., None], values, 0.0)


def azimuth(directions: np.ndarray) -> np.ndarray:
    """Azimuth from x, 0 .. 2 pi, of vectors (..., 3)."""
    directions = np.asarray(directions, float)
    return np.mod(np.arctan2(directions[..., 1], directions[..., 0]), 2 * np.pi)


def polar(directions: np.ndarray) -> np.ndarray:
    """Angle from the normal, 0 .. pi, of vectors (..., 3); by atan2, which keeps its digits near the normal."""
    directions = np.asarray(directions, float)
    return np.arctan2(np.hypot(directions[..., 0], directions[..., 1]), directions[..., 2])
