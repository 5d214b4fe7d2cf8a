"""Reading the ingested frames: bands of white-normalised observations, with what may not be used marked."""

from collections.abc import Callable, Collection, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nishiki.formats.stored import chunk_path, open_made_by, read_chunk, understood
from nishiki.observations.linearise import Edges, StoredArrays, edges_between
from nishiki.threads import in_threads, strips

STORE, FORMAT = "frames.zarr", 1  # name and version of the file; readers refuse others
STRIP_BYTES = 8 << 20
"""Of float32 observations that are decoded at a time."""


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
        """Which lights have this role, (n,) int64."""
        return np.flatnonzero([light_role == role for light_role in self.roles])

    def fit_lights(self, hold_out: Collection[str] = ()) -> np.ndarray:
        """Lights that fits may use, (n,) int64: those of samples, without the names held out."""
        return np.array([j for j in self.indices("sample") if self.lights[j] not in set(hold_out)], np.int64)

    def check_lights(self, hold_out: Collection[str] = ()) -> np.ndarray:
        """Lights that no fit has seen, (n,) int64: those of check frames and those held out."""
        return np.setdiff1d(np.arange(len(self.lights)), self.fit_lights(hold_out))

    def bands(self) -> list[slice]:
        """Row slices that cover the picture, each of bounded memory."""
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
        """Observations of some rows: values and validity.

        band: rows (a slice of step 1, from `bands()` or any other); lights: indices, default all; channel: None for
        all, an index, or 'mean' over all; columns: slice, default all. Returns float32 (lights, rows, columns,
        channels), or without the last axis for one channel or the mean, and bool (lights, rows, columns): inside the
        mask, no defect, gain known, finite, saturated in no channel, above the lowest code in at least one of the
        channels read. A perfect white diffuser that faces the lamp has value 1. Values that cannot be formed are 0.
        """
        chosen = np.arange(len(self.lights)) if lights is None else np.asarray(lights, np.int64)
        codes, start = self.codes(band, lights=chosen, columns=columns)
        left = (columns or slice(None)).indices(self.shape[1])[0]
        return self.decoded(codes, chosen, start, left, channel)

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

        def of_strip(top: int) -> Any:
            part, first = codes[:, top : top + step], start + top
            return work(slice(first, first + part.shape[1]), *self.decoded(part, lights, first, channel=channel))

        tops = range(0, rows, step)
        return in_threads(of_strip, tops) if len(tops) > 1 else map(of_strip, tops)

    def decoded(
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
        """Read the codes (lights, rows, columns, channels) of some rows, and return the first row's number."""
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
        """Edges of the blocks of gain and dark: those of the region that the capture asks for, inside what is kept."""
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
