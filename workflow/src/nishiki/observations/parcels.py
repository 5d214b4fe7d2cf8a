"""Divide bands of rows into parcels of constant lamp directions, and take samples of pixels for decisions."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from nishiki.observations.plane import Observations

TOLERANCE_RAD = np.radians(0.2)
"""Largest difference between a pixel's direction to a near lamp and that of its parcel's centre."""
USUAL_SIDE, LEAST_SIDE, FEW_PARCELS = 8, 2, 2048
"""Least side of a parcel in pixels, as each costs time of its own; but where the tolerance needs less than LEAST_SIDE,
the side with which this many parcels cover the picture, if that is smaller."""


@dataclass(frozen=True)
class Parcel:
    """rows, columns: place inside the band; directions (lights, 3) unit vectors to the lamps."""

    rows: slice
    columns: slice
    directions: np.ndarray
    # (lights,) float32: factor on the observations that removes the lamp's fall-off with the square of the distance
    # where no white board has removed it; 1 otherwise
    scale: np.ndarray
    # (2, 3, 3): error of Lambert's vector, as a factor on it, a row and a column away from the centre
    drift: np.ndarray | None = None

    def scaled(self, observations: np.ndarray) -> np.ndarray:
        """Return observations (lights, ...) as if the lamps were as far from the parcel as from the centre."""
        if (self.scale == 1).all():
            return observations
        return observations * self.scale.reshape(-1, *[1] * (observations.ndim - 1))

    def at_pixels(self, maps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Correct normals (rows, columns, 3), and levels beside them, for the lamps' directions at every pixel.

        To first order in the distance from the centre, and as all lamps together say; under distant lamps nothing.
        """
        if self.drift is None:
            return maps
        down, right = (np.arange(n) - (n - 1) / 2 for n in maps["normals"].shape[:2])
        error = np.multiply.outer(down, self.drift[0])[:, None] + np.multiply.outer(right, self.drift[1])
        vectors = maps["normals"] - np.einsum("rcij,rcj->rci", error, maps["normals"])
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        levels = {name: maps[name] * length for name in ("reflectance",) if name in maps}
        levels |= {name: maps[name] * length[..., 0] for name in ("albedo",) if name in maps}
        return maps | levels | {"normals": vectors / np.maximum(length, 1e-9)}


def parcels(frames: Observations, band: slice, lights: np.ndarray) -> Iterator[Parcel]:
    """Parcels of a band: the whole band for distant lamps, small rectangles for lamps at a position.

    lights: indices (n,). The size follows from the nearest lamp: the direction changes by less than 0.2 degrees from a
    parcel's centre to its corner, except for lamps so near that this takes parcels smaller than USUAL_SIDE.
    """
    rows, columns = band.stop - band.start, frames.shape[1]
    if frames.positions_mm is None:
        yield Parcel(slice(0, rows), slice(0, columns), frames.directions[lights], np.ones(len(lights), np.float32))
        return
    positions = frames.positions_mm[lights]
    reach = 2 * TOLERANCE_RAD * float(positions[:, 2].min()) / np.sqrt(2)
    side, few = int(reach / frames.pixel_pitch_mm), math.ceil(math.sqrt(frames.shape[0] * columns / FEW_PARCELS))
    step = min(USUAL_SIDE, few) if side < LEAST_SIDE else max(USUAL_SIDE, side)
    for top in range(0, rows, step):
        for left in range(0, columns, step):
            area = slice(top, min(top + step, rows)), slice(left, min(left + step, columns))
            centre = point_mm(frames, band.start + _middle(area[0]), _middle(area[1]))
            falls = 0 if frames.white_board else 2  # power of the distance that the observations still hold
            middle, *beside = (
                _towards(positions, centre + frames.pixel_pitch_mm * np.array(step), falls)
                for step in ((0, 0, 0), (0, -1, 0), (1, 0, 0))
            )
            length = np.linalg.norm(middle, axis=1, keepdims=True)
            inverse = np.linalg.pinv(middle / length)
            drift = np.stack([inverse @ ((vectors - middle) / length) for vectors in beside])
            fall_off = (np.linalg.norm(positions, axis=1) ** -falls / length[:, 0]).astype(np.float32)
            yield Parcel(*area, middle / length, fall_off, drift)


def _towards(positions: np.ndarray, place: np.ndarray, falls: int) -> np.ndarray:
    """Vectors (lights, 3) from a place to the lamps, as long as the distance to the power -falls."""
    towards = positions - place
    return towards / np.linalg.norm(towards, axis=1, keepdims=True) ** (1 + falls)


def point_mm(frames: Observations, row: float, column: float) -> np.ndarray:
    """Place of a pixel on the object plane, mm from the image centre, x right, y up, z to the camera."""
    centre_row, centre_column = frames.image_centre
    pitch = frames.pixel_pitch_mm
    return np.array([(column - centre_column) * pitch, (centre_row - row) * pitch, 0.0])


def _middle(area: slice) -> float:
    return (area.start + area.stop - 1) / 2


STRIDE = 3  # pixels
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
        """Select the sampled pixels of an array (rows of the band, columns, ...), as (1, pixels, ...)."""
        area = of_band[self.parcel.rows, self.parcel.columns]
        return area.reshape(-1, *area.shape[2:])[self.places][None]


def sample(
    frames: Observations, lights: np.ndarray, pixels: int, *, channel: Any = "mean", cell: int = 1
) -> Iterator[Piece]:
    """About `pixels` pixels of the object from at most STRIPS strips of rows: the same on every machine.

    The strips lie evenly among the rows that the object reaches; of near lamps' parcels the pixels are taken alike.
    cell: side of squares of pixels of which many are taken or none; under distant lamps one in STRIDE^2 at least.
    """
    rows = np.flatnonzero(frames.mask.any(axis=1))
    if not rows.size:
        return
    count = frames.mask[rows].sum(axis=1)
    height = int(np.clip(np.ceil(4 * pixels / (STRIPS * count.mean())), min(cell, frames.band_rows), frames.band_rows))
    starts = np.linspace(rows[0], max(rows[0], rows[-1] + 1 - height), STRIPS).round().astype(int)
    starts = np.unique(starts // cell * cell)
    strips = [
        slice(int(a), int(min(a + height, b))) for a, b in zip(starts, [*starts[1:], frames.shape[0]], strict=True)
    ]
    inside = sum(int(frames.mask[strip].sum()) for strip in strips)
    most = 1 if cell == 1 or frames.positions_mm is not None else STRIDE
    stride = int(np.clip(np.ceil(np.sqrt(inside / pixels)), 1, most))
    step, seen = max(1, inside // (stride**2 * pixels)), 0
    for strip in strips:
        observations, valid = frames.read(strip, lights=lights, channel=channel)
        mask = frames.mask[strip]
        for parcel in parcels(frames, strip, lights):
            area = np.s_[:, parcel.rows, parcel.columns]
            here = np.flatnonzero(mask[area[1:]])
            chosen = here[(-seen) % step :: step]
            if cell > 1:
                row, column = (place.ravel()[here] for place in np.mgrid[area[1:]])
                row += strip.start
                taken = (row // cell + column // cell) % step == 0
                chosen = here[taken & (row % stride == 0) & (column % stride == 0)]
            seen += here.size
            if chosen.size:
                values = flat(parcel.scaled(observations[area]), chosen)
                yield Piece(parcel, strip, chosen, values, flat(valid[area], chosen))


def flat(array: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Pixels of an array (lights, rows, columns, ...) as (lights, 1, pixels, ...)."""
    return array.reshape(len(array), 1, -1, *array.shape[3:])[:, :, chosen]
