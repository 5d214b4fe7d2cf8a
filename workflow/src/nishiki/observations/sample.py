"""A small sample of a plane scene's pixels, spread over the picture, for decisions before the whole is read."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nishiki.observations.parcels import Parcel, parcels
from nishiki.observations.plane import Observations

STRIPS = 16  # rows of the picture that are looked at: bounds the reading where bands are many


@dataclass(frozen=True)
class Piece:
    """Sampled pixels under one set of directions.

    parcel; band (rows of the picture) and places (pixels,) in its parcel, flat; observations (lights, 1, pixels), or
    with channels; valid (lights, 1, pixels) bool.
    """

    parcel: Parcel
    band: slice
    places: np.ndarray
    observations: np.ndarray
    valid: np.ndarray

    def of(self, of_band: np.ndarray) -> np.ndarray:
        """The sampled pixels of an array (rows of the band, columns, ...), as (1, pixels, ...)."""
        area = of_band[self.parcel.rows, self.parcel.columns]
        return area.reshape(-1, *area.shape[2:])[self.places][None]


def sample(frames: Observations, lights: np.ndarray, pixels: int, *, channel: str | None = "mean") -> Iterator[Piece]:
    """About `pixels` pixels of the object from at most STRIPS strips of rows: the same on every machine.

    The strips lie evenly among the rows that the object reaches; of near lamps' parcels the pixels are taken alike.
    """
    rows = np.flatnonzero(frames.mask.any(axis=1))
    if not rows.size:
        return
    count = frames.mask[rows].sum(axis=1)
    height = int(np.clip(np.ceil(4 * pixels / (STRIPS * count.mean())), 1, frames.band_rows))
    starts = np.unique(np.linspace(rows[0], max(rows[0], rows[-1] + 1 - height), STRIPS).round().astype(int))
    strips = [
        slice(int(a), int(min(a + height, b))) for a, b in zip(starts, [*starts[1:], frames.shape[0]], strict=True)
    ]
    inside = sum(int(frames.mask[strip].sum()) for strip in strips)
    step, seen = max(1, inside // pixels), 0
    for strip in strips:
        observations, valid = frames.read(strip, lights=lights, channel=channel)
        mask = frames.mask[strip]
        for parcel in parcels(frames, strip, lights):
            area = np.s_[:, parcel.rows, parcel.columns]
            here = np.flatnonzero(mask[area[1:]])
            chosen = here[(-seen) % step :: step]
            seen += here.size
            if chosen.size:
                scale = parcel.scale.reshape(-1, *[1] * (observations.ndim - 1))
                values = flat(observations[area] * scale, chosen)
                yield Piece(parcel, strip, chosen, values, flat(valid[area], chosen))


def flat(array: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Pixels of an array (lights, rows, columns, ...) as (lights, 1, pixels, ...)."""
    return array.reshape(len(array), 1, -1, *array.shape[3:])[:, :, chosen]
