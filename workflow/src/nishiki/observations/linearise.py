"""From stored codes to linear light, by curves and by fields on coarse grids; whether the camera is linear."""

from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np

from nishiki.formats.coding import TransferCurve
from nishiki.threads import strips

DEFAULT_SATURATION = 0.995  # of full scale


def full_scale(dtype: np.dtype, bits: int | None) -> float:
    """Return the largest code: 2^bits - 1, by default of the sample's own 8 or 16 bits; 1 for float samples."""
    if np.dtype(dtype).kind == "f":
        return 1.0
    return float((1 << (bits or 8 * np.dtype(dtype).itemsize)) - 1)


def code_table(dtype: np.dtype, curve: TransferCurve, bits: int | None = None) -> np.ndarray:
    """Compute the linear value of each code, as a fraction of full scale: (256,) or (65536,) float32."""
    codes = np.arange(np.iinfo(dtype).max + 1) / full_scale(dtype, bits)
    return curve.decode(codes).astype(np.float32)


class StoredArrays:
    """Arrays that ingest stores beside the codes of photographs, of any geometry, each read at its first use."""

    _group: Any
    dtype: np.dtype  # of the codes

    @cached_property
    def lut(self) -> np.ndarray:
        """Linear value by code; two zeros for float samples."""
        return np.asarray(self._group["lut"][...]) if self.dtype.kind == "u" else np.zeros(2, np.float32)

    @cached_property
    def gain(self) -> np.ndarray:
        """(lights, r, c, channels) float32 on block centres; NaN where the white board is unusable."""
        return np.asarray(self._group["gain"][...])

    @cached_property
    def dark(self) -> np.ndarray:
        """(frames or 1, r or 1, c or 1, channels) float32, fraction of full scale."""
        return np.asarray(self._group["dark"][...])

    @cached_property
    def defect(self) -> np.ndarray | None:
        """(rows, columns) bool: hot and dead pixels, or None without any."""
        return np.asarray(self._group["defect"][...]) > 0 if "defect" in self._group else None

    @cached_property
    def regions(self) -> np.ndarray | None:
        """(rows, columns) label of the region of each pixel, or None for a capture without regions."""
        return np.asarray(self._group["regions"][...]) if "regions" in self._group else None


def saturation_code(dtype: np.dtype, fraction: float | None, bits: int | None = None) -> np.number:
    """Return the smallest code of a saturated sample, in the codes' own type.

    fraction: of full scale; None: 0.995, and for float samples, which have no full scale of their own, never.
    """
    if np.dtype(dtype).kind == "f":
        return np.float32(np.inf if fraction is None else fraction)
    return np.dtype(dtype).type(np.ceil((fraction or DEFAULT_SATURATION) * full_scale(dtype, bits)))


def count_unusable(
    codes: np.ndarray, usable: np.ndarray, saturated: np.number, clip: np.number
) -> tuple[int, int, int, int, float]:
    """Count pixels of one frame inside the mask: saturated in any channel, at the clip in all, not finite; in all.

    codes (rows, columns, channels); usable (rows, columns) uint8; saturated, clip: in the codes' own type.
    Returns these four counts and the largest code (of the whole frame).
    """
    inside, brightest = usable != 0, reduce(np.fmax, np.moveaxis(codes, 2, 0))
    broken = codes.dtype.kind == "f" and inside & ~np.isfinite(codes).all(axis=2)
    kinds = (inside & (brightest >= saturated), inside & (brightest <= clip), broken, inside)
    hot, cold, bad, within = (int(np.count_nonzero(kind)) for kind in kinds)
    return hot, cold, bad, within, float(brightest.max())


def to_luma(codes: np.ndarray, saturated: np.number, full: float, weights: np.ndarray, rounding: float) -> np.ndarray:
    """Compute luma (rows, columns, 1) of codes (rows, columns, channels) in their own type; `full` if one is saturated.

    A mean would hide that one channel was clipped, so such pixels are given a code that counts as saturated.
    rounding: 0.5 for integer codes, 0.0 for float.
    """
    out = np.empty((*codes.shape[:2], 1), codes.dtype)
    for band in strips(len(codes)):
        channels = np.moveaxis(codes[band], 2, 0)
        luma = sum((weight * channel for weight, channel in zip(weights, channels, strict=True)), rounding)
        out[band, :, 0] = np.where(reduce(np.fmax, channels) >= saturated, full, luma)
    return out


@dataclass(frozen=True)
class Linearity:
    """Straight line through patch values: value = slope * reflectance + intercept."""

    slope: float
    intercept: float
    r_squared: float  # share of the variance that the line explains
    worst_deviation: float  # largest distance from the line as a fraction of the largest value
    worst_patch: int  # its index


def check_linearity(values: np.ndarray, reflectances: np.ndarray) -> Linearity:
    """Fit patch values (patches,) to their known reflectances, both linear (Tominaga and Tanaka 2004, section 2).

    Ordinary least squares. ValueError for fewer than 3 patches, values that are not finite, or equal reflectances.
    """
    values, reflectances = np.asarray(values, np.float64), np.asarray(reflectances, np.float64)
    if values.shape != reflectances.shape or values.ndim != 1 or len(values) < 3:
        raise ValueError(f"3 or more patches with a reflectance each are needed, found {values.shape}")
    if not (np.isfinite(values).all() and np.isfinite(reflectances).all()):
        raise ValueError("patch values and reflectances must be finite")
    centred = reflectances - reflectances.mean()
    spread = float(centred @ centred)
    if spread <= 1e-12 * max(1.0, float(reflectances @ reflectances)):
        raise ValueError("the patches all have the same reflectance")
    slope = float(centred @ values) / spread
    intercept = float(values.mean() - slope * reflectances.mean())
    residual = values - (slope * reflectances + intercept)
    total = float(((values - values.mean()) ** 2).sum())
    r_squared = 1.0 - float(residual @ residual) / total if total > 0 else 0.0
    worst = int(np.argmax(np.abs(residual)))
    scale = float(np.abs(values).max()) or 1.0
    return Linearity(slope, intercept, r_squared, float(abs(residual[worst])) / scale, worst)


Edges = tuple[np.ndarray, np.ndarray]
CHECK_BLOCK = 16  # pixels, of the boards that a check looks at; `ingest.white_block` by default


def block_edges(length: int, block: int) -> np.ndarray:
    """Compute edges (blocks + 1,) int64 of blocks of nearly `block` pixels that cover `length` pixels exactly."""
    count = max(1, round(length / block))
    return np.arange(count + 1, dtype=np.int64) * length // count


def edges_between(length: int, block: int, start: int, stop: int) -> np.ndarray:
    """Select the edges of the blocks of `length` pixels in start..stop, themselves edges, counted from start.

    A field on the blocks of a crop then has the values, and the interpolation, of the same blocks of the whole.
    """
    edges = block_edges(length, block)
    return edges[(edges >= start) & (edges <= stop)] - start


def blocks_around(inside: np.ndarray, block: int, margin: int) -> tuple[int, int]:
    """Return start and stop, at edges of blocks, of the set places (length,) bool, at least one, with a rim.

    `margin` pixels or more and one further block on each side, so that a field that is interpolated between the centres
    of blocks has both its neighbours wherever `inside` is set.
    """
    set_at, edges = np.flatnonzero(inside), block_edges(len(inside), block)
    first = np.searchsorted(edges, max(set_at[0] - margin, 0), side="right") - 2
    last = np.searchsorted(edges, min(set_at[-1] + 1 + margin, len(inside)), side="left") + 1
    return int(edges[max(first, 0)]), int(edges[min(last, len(edges) - 1)])


def positions(edges: np.ndarray, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """Locate pixels start..stop between block centres: lower node (n,) int64, weight of the next (n,) float32.

    Beyond the outer centres the field is extrapolated (weights below 0 or above 1, by half a block at most).
    """
    centres = (edges[:-1] + edges[1:] - 1) / 2.0
    pixels = np.arange(start, stop)
    if len(centres) == 1:
        return np.zeros(len(pixels), np.int64), np.zeros(len(pixels), np.float32)
    lower = np.clip(np.searchsorted(centres, pixels, side="right") - 1, 0, len(centres) - 2)
    weight = (pixels - centres[lower]) / (centres[lower + 1] - centres[lower])
    return lower.astype(np.int64), weight.astype(np.float32)


def cells(edges: np.ndarray, start: int, stop: int) -> np.ndarray:
    """List the first pixel, from start, of each cell between neighbouring block centres, then the last cell's end.

    Cell c lies between the centres of blocks c and c + 1; the outer ones reach to the border. (cells + 1,) int64, with
    as many cells as blocks less one, but at least one; cells outside start..stop are empty.
    """
    centres = (edges[:-1] + edges[1:] - 1) / 2.0
    inner = np.ceil(centres[1:-1]).astype(np.int64)
    return np.clip(np.concatenate([[start], inner, [stop]]), start, stop) - start


def field_rows(field: np.ndarray, edges: Edges, start: int, stop: int) -> np.ndarray:
    """Interpolate a field on blocks (r, c, channels) to (rows, columns, channels) in rows start..stop of a picture."""
    if field.shape[:2] == (1, 1):
        return np.broadcast_to(field, (stop - start, int(edges[1][-1]), field.shape[2]))
    (above, down), (left, right) = positions(edges[0], start, stop), positions(edges[1], 0, int(edges[1][-1]))
    below, beyond = (np.minimum(n + 1, size - 1) for n, size in zip((above, left), field.shape, strict=False))
    field = field[above] + down[:, None, None] * (field[below] - field[above])
    return field[:, left] + right[:, None] * (field[:, beyond] - field[:, left])


def on_one_grid(gain: np.ndarray, dark: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Broadcast gain and dark level (..., r, c, channels) as float32 to one grid of blocks, contiguous.

    A field that has the grid's shape is returned as it is: through `broadcast_to` it would become read-only, and
    kernels would be compiled once more for it.
    """
    shape = np.broadcast_shapes(gain.shape, dark.shape)
    gain, dark = (field if field.shape == shape else np.broadcast_to(field, shape) for field in (gain, dark))
    return np.ascontiguousarray(gain, np.float32), np.ascontiguousarray(dark, np.float32)


def picture_edges(shape: tuple[int, int], block: int) -> Edges:
    """Compute the edges of the blocks of a picture."""
    return block_edges(shape[0], block), block_edges(shape[1], block)


def rows_of_band(lights: int, rows: int, columns: int, channels: int, tile_mib: int) -> int:
    """Compute the rows of a band whose float32 observations fit into tile_mib MiB: a multiple of 8, at least 8."""
    fit = (tile_mib << 20) // max(1, lights * columns * channels * 4)
    return int(min(max(8, fit // 8 * 8), -(-rows // 8) * 8))


def bands_with_object(mask: np.ndarray, band_rows: int) -> tuple[int, ...]:
    """List numbers of bands in which the mask (rows, columns) has a pixel; others are neither stored nor read."""
    starts = range(0, len(mask), band_rows)
    return tuple(number for number, start in enumerate(starts) if mask[start : start + band_rows].any())
