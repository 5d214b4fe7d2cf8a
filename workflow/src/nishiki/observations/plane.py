"""The ingested frames of a plane: bands of white-normalised observations, their parcels, and samples of pixels."""

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nishiki.formats.stored import chunk_path, open_made_by, read_chunk, understood
from nishiki.observations.linearise import Edges, StoredArrays, edges_between
from nishiki.threads import in_threads, strips

STORE, FORMAT = "frames.zarr", 1  # name and version of the file; readers refuse others
STRIP_BYTES = 8 << 20
"""Size in bytes of the float32 observations decoded at a time."""


class Observations(StoredArrays):
    """The ingested frames of one capture, opened for reading.

    lights: names; roles: 'sample' | 'check'; directions (lights, 3) float64; positions_mm (lights, 3) or None;
    shape (rows, columns) of the bounding box of the object's mask; channels: names; band_rows; pixel_pitch_mm or None;
    uncertainty: of what ingest put right, see `nishiki.photometric.expected_error.correction_error`;
    to_srgb (3, 3): from the primaries that the photographs state to linear sRGB, None where they state none;
    image_centre (row, column) of the whole picture's centre in these coordinates, the origin of positions_mm.
    """

    def __init__(self, folder: Path | str):
        """Open `frames.zarr`, or the folder that holds it. UserError where it is none."""
        path = Path(folder)
        path = path if path.name.endswith(".zarr") else path / STORE
        group, stored = open_made_by("ingest", path, "ingested frames", FORMAT)
        self.path = path
        with understood(path):
            self._codes = group["codes"]
            self.attributes = stored
            self.lights: tuple[str, ...] = tuple(stored["lights"])
            self.files: tuple[str, ...] = tuple(stored["files"])
            self.roles: tuple[str, ...] = tuple(stored["roles"])
            self.directions = np.array(stored["directions"], np.float64).reshape(-1, 3)
            positions_mm = stored["positions_mm"]
            self.positions_mm = None if positions_mm is None else np.array(positions_mm, np.float64)
            self.channels: tuple[str, ...] = tuple(stored["channels"])
            self.shape: tuple[int, int] = self._codes.shape[1:3]
            self.dtype = self._codes.dtype
            self.band_rows: int = stored["band_rows"]
            self.pixel_pitch_mm: float | None = stored["pixel_pitch_mm"]
            self.image_centre: tuple[float, float] = tuple(stored["image_centre"])
            self.uncertainty: dict = stored.get("uncertainty", {})
            self.white_board: bool = stored["white_board"]
            self.to_srgb: list[list[float]] | None = stored.get("to_srgb")
        self._group = group

    def indices(self, role: Literal["sample", "check"]) -> np.ndarray:
        """List the lights of this role, (n,) int64."""
        return np.flatnonzero([light_role == role for light_role in self.roles])

    def fit_lights(self, hold_out: Collection[str] = ()) -> np.ndarray:
        """List lights for fits, (n,) int64: those of samples, without the names held out."""
        return np.array([j for j in self.indices("sample") if self.lights[j] not in set(hold_out)], np.int64)

    def check_lights(self, hold_out: Collection[str] = ()) -> np.ndarray:
        """List lights that no fit uses, (n,) int64: those of check frames and those held out."""
        return np.setdiff1d(np.arange(len(self.lights)), self.fit_lights(hold_out))

    def bands(self) -> list[slice]:
        """List row slices that cover the picture, each of bounded memory."""
        return list(strips(self.shape[0], self.band_rows))

    @cached_property
    def mask(self) -> np.ndarray:
        """(rows, columns) bool: the object."""
        return np.asarray(self._group["mask"][...]) > 0

    def read(
        self,
        band: slice,
        *,
        lights: np.ndarray | None = None,
        channel: Literal["mean"] | int | None = None,
        columns: slice | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Read observations of some rows: values and validity.

        band: rows (a slice of step 1, from `bands()` or any other); lights: indices, default all; channel: None for
        all, an index, or 'mean' over all; columns: slice, default all. Returns float32 (lights, rows, columns,
        channels), or without the last axis for one channel or the mean, and bool (lights, rows, columns): inside the
        mask, no defect, gain known, finite, saturated in no channel, above the lowest code in at least one of the
        channels read. A perfect white diffuser that faces the lamp has value 1. Values that cannot be formed are 0.
        """
        chosen = np.arange(len(self.lights)) if lights is None else np.asarray(lights, np.int64)
        codes, start = self.codes(band, lights=chosen, columns=columns)
        left = (columns or slice(None)).indices(self.shape[1])[0]
        return self.decode(codes, chosen, start, left, channel)

    def strips(
        self,
        band: slice,
        *,
        lights: np.ndarray,
        channel: Literal["mean"] | None = None,
        work: Callable[[slice, np.ndarray, np.ndarray], Any] = lambda *strip: strip,
    ) -> Iterator[Any]:
        """Yield `work` of each strip of a band, several at a time: its rows in the picture, and what `read` returns.

        The codes of the band are read once. Values of a strip fit the processor's cache, where those of a band fill
        the memory: a band of 8-bit codes becomes five times as large when it is decoded. Lamps at a position have one
        strip, whose parcels begin where the band does.
        """
        codes, start = self.codes(band, lights=lights)
        count, rows, columns, channels = codes.shape
        row_bytes = 4 * count * columns * (channels if channel is None else 1)
        step = rows if self.positions_mm is not None else max(STRIP_BYTES // row_bytes, 1)

        def read_strip(top: int) -> Any:
            part, first = codes[:, top : top + step], start + top
            return work(slice(first, first + part.shape[1]), *self.decode(part, lights, first, channel=channel))

        tops = range(0, rows, step)
        return in_threads(read_strip, tops) if len(tops) > 1 else map(read_strip, tops)

    def decode(
        self,
        codes: np.ndarray,
        chosen: np.ndarray,
        start: int,
        left: int = 0,
        channel: Literal["mean"] | int | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Decode codes of these lights whose first row and column are these into values and validity; see `read`."""
        from nishiki.observations.kernels import decode_codes  # names and masks alone need no compiled code

        rows, width = codes.shape[1:3]
        usable = self._usable[start : start + rows, left : left + width]
        fields = self.gain[chosen], self.dark if len(self.dark) == 1 else self.dark[chosen], usable
        channels = (*self._channel_range(channel), channel is not None)
        values, valid = decode_codes(
            codes, (self.lut, *self.limits), fields, self.edges, corner=(start, left), channels=channels
        )
        return (values if channel is None else values[..., 0]), valid

    def codes(
        self, band: slice, *, lights: np.ndarray | None = None, columns: slice | None = None
    ) -> tuple[np.ndarray, int]:
        """Read the codes (lights, rows, columns, channels) of some rows; return them and the first row's number."""
        chosen = np.arange(len(self.lights)) if lights is None else np.asarray(lights, np.int64)
        start, stop, step = band.indices(self.shape[0])
        left, right, stride = (columns or slice(None)).indices(self.shape[1])
        if step != 1 or stride != 1 or stop <= start or right <= left:
            raise ValueError(f"rows {band} and columns {columns} must be non-empty slices of step 1 in {self.shape}")
        chunk = (self.band_rows, self.shape[1], len(self.channels))
        codes = np.empty((len(chosen), stop - start, right - left, len(self.channels)), self.dtype)
        for number in range(start // self.band_rows, -(-stop // self.band_rows)):
            top = number * self.band_rows
            if not self.mask[top : top + self.band_rows].any():  # ingest keeps no chunk where the object is not
                codes[:, max(top - start, 0) : top + self.band_rows - start] = 0
                continue
            inner = slice(max(start - top, 0), min(stop - top, self.band_rows))
            outer = slice(top + inner.start - start, top + inner.stop - start)
            for j, light in enumerate(chosen):
                path = chunk_path(self.path / "codes", int(light), number)
                stored = read_chunk(path, chunk, self.dtype, compression=self.attributes["compression"])
                codes[j, outer] = stored[inner, left:right]
        return codes, start

    @cached_property
    def edges(self) -> Edges:
        """Edges of the blocks of gain and dark: those of the capture's region, inside the stored part."""
        kept = self.attributes.get("region_of_interest", (0, 0, *self.shape))
        asked = self.attributes.get("asked_region", kept)
        starts = (kept[0] - asked[0], kept[1] - asked[1])
        block = self.attributes["white_block"]
        rows, columns = (
            edges_between(extent, block, start, start + n)
            for extent, start, n in zip(asked[2:], starts, self.shape, strict=True)
        )
        return rows, columns

    @cached_property
    def _usable(self) -> np.ndarray:
        usable = self.mask if self.defect is None else self.mask & ~self.defect
        return usable.astype(np.uint8)

    @property
    def limits(self) -> tuple[np.number, np.number]:
        """Codes at or above, at or below which a sample is unusable, in the codes' own type."""
        top, low = self.attributes["saturation_code"], self.attributes["clip_code"]
        if self.dtype.kind == "u":
            return self.dtype.type(top), self.dtype.type(low)
        return np.float32(np.inf if top is None else top), np.float32(low)

    def _channel_range(self, channel: str | int | None) -> tuple[int, int]:
        count = len(self.channels)
        if channel is None or channel == "mean":
            return 0, count
        if isinstance(channel, str) or not 0 <= channel < count:
            raise ValueError(f"channel {channel!r}: None, 'mean' or 0..{count - 1}")
        return int(channel), int(channel) + 1


TOLERANCE_RAD = np.radians(0.2)
"""Largest difference between a pixel's direction to a near lamp and that of its parcel's centre."""
USUAL_SIDE, LEAST_SIDE, FEW_PARCELS = 8, 2, 2048
"""Least side of a parcel in pixels, as each costs time; but where the tolerance requires less than LEAST_SIDE,
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

    def scale_to_centre(self, observations: np.ndarray) -> np.ndarray:
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
    """Yield parcels of a band: the whole band for distant lamps, small rectangles for lamps at a position.

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
    """Compute vectors (lights, 3) from a place to the lamps, of length distance to the power -falls."""
    towards = positions - place
    return towards / np.linalg.norm(towards, axis=1, keepdims=True) ** (1 + falls)


def point_mm(frames: Observations, row: float, column: float) -> np.ndarray:
    """Compute the place of a pixel on the object plane, mm from the image centre, x right, y up, z to the camera."""
    centre_row, centre_column = frames.image_centre
    pitch = frames.pixel_pitch_mm
    return np.array([(column - centre_column) * pitch, (centre_row - row) * pitch, 0.0])


def _middle(area: slice) -> float:
    return (area.start + area.stop - 1) / 2


STRIDE = 3  # pixels
STRIPS = 16  # rows of the picture that are looked at: bounds the reading where bands are many


@dataclass(frozen=True)
class PixelSample:
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
) -> Iterator[PixelSample]:
    """Yield about `pixels` pixels of the object from at most STRIPS strips of rows: the same on every machine.

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
                values = flat(parcel.scale_to_centre(observations[area]), chosen)
                yield PixelSample(parcel, strip, chosen, values, flat(valid[area], chosen))


def flat(array: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Select pixels of an array (lights, rows, columns, ...) as (lights, 1, pixels, ...)."""
    return array.reshape(len(array), 1, -1, *array.shape[3:])[:, :, chosen]
