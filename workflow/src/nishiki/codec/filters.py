"""One level of a wavelet transform as a sparse matrix, from the filters of PyWavelets.

An analysis row is the filter, shifted by two samples; how it goes on beyond the ends is the boundary rule. Written as a
matrix, orthonormal and biorthogonal families, periodic and mirrored ends, and the adjoint that a solver needs are all
the same short loop (`transform.apply_rows`), and the synthesis is the matrix' exact inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from nishiki.errors import UserError

NEGLIGIBLE = 1e-15


@dataclass(frozen=True)
class SparseRows:
    """A square matrix by its rows: `index` (n, k) int32 columns, `weight` (n, k) float64, unused places weight 0."""

    index: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray) -> SparseRows:
        """Keep the entries above 1e-15."""
        kept = np.abs(matrix) > NEGLIGIBLE
        width = max(1, int(kept.sum(axis=1).max()))
        order = np.argsort(~kept, axis=1, kind="stable")[:, :width]
        weight = np.take_along_axis(np.where(kept, matrix, 0.0), order, axis=1)
        return cls(np.ascontiguousarray(order, np.int32), np.ascontiguousarray(weight))

    def weights(self, dtype: np.dtype) -> np.ndarray:
        """The weights in a precision."""
        return self.single if dtype == np.float32 else self.weight.astype(dtype, copy=False)

    @cached_property
    def single(self) -> np.ndarray:
        """The weights in single precision."""
        return self.weight.astype(np.float32)


@lru_cache(maxsize=64)
def filter_bank(wavelet: str) -> tuple[tuple[float, ...], tuple[float, ...], bool]:
    """Low-pass and high-pass analysis filters, and whether the family is orthonormal.

    Raises UserError where PyWavelets knows no discrete wavelet of that name.
    """
    import pywt

    if wavelet not in pywt.wavelist(kind="discrete"):
        raise UserError(
            f"wavelet: expected a discrete wavelet of PyWavelets (haar, db2, sym4, bior4.4, ...), found {wavelet!r}"
        )
    bank = pywt.Wavelet(wavelet)
    return tuple(bank.dec_lo), tuple(bank.dec_hi), bool(bank.orthogonal)


@lru_cache(maxsize=256)
def level_matrix(wavelet: str, length: int, *, mirrored: bool = False) -> np.ndarray:
    """(length, length) float64: rows 0 .. length/2 - 1 the low-pass, the rest the high-pass of one level.

    length: even. Periodic ends: rows as `pywt.dwt(mode="periodization")` orders them. mirrored: the signal goes on by
    reflection about its end samples, which needs symmetric filters of odd length (bior2.2, bior4.4).
    Raises UserError for an odd length or filters that cannot be mirrored.
    """
    if length < 2 or length % 2:
        raise UserError(f"wavelet level: expected an even length, found {length}")
    low, high, _ = filter_bank(wavelet)
    matrix = np.zeros((length, length))
    half = length // 2
    if mirrored:
        for row, taps, offset in ((0, _symmetric(wavelet, low), 0), (half, _symmetric(wavelet, high), 1)):
            reach = len(taps) // 2
            for i in range(half):
                for k, tap in enumerate(taps):
                    matrix[row + i, _reflect(2 * i + offset + k - reach, length)] += tap
        return matrix
    for row, taps in ((0, low), (half, high)):
        for i in range(half):
            for k, tap in enumerate(taps):
                matrix[row + i, (2 * i + len(taps) // 2 - k) % length] += tap
    return matrix


def _symmetric(wavelet: str, taps: tuple[float, ...]) -> np.ndarray:
    kept = np.flatnonzero(np.abs(taps) > NEGLIGIBLE)
    inner = np.array(taps[kept[0] : kept[-1] + 1])
    if len(inner) % 2 == 0 or not np.allclose(inner, inner[::-1]):
        raise UserError(f"mirrored ends need symmetric filters of odd length (bior2.2, bior4.4), found {wavelet!r}")
    return inner


def _reflect(index: int, length: int) -> int:
    period = 2 * (length - 1)
    index %= period
    return period - index if index >= length else index


def levels_of(length: int, most: int) -> int:
    """Levels that `length` allows: as many halvings as are exact, at most `most`."""
    levels = 0
    while levels < most and length % 2 == 0 and length > 1:
        length //= 2
        levels += 1
    return levels


def analysis_matrix(wavelet: str, length: int, levels: int, *, mirrored: bool = False) -> np.ndarray:
    """(length, length) float64: all levels in one matrix, coarsest band first (Mallat's order)."""
    total = np.eye(length)
    for _ in range(levels_of(length, levels)):
        size = length
        total[:size] = level_matrix(wavelet, size, mirrored=mirrored) @ total[:size]
        length //= 2
    return total


def cosine_matrix(length: int) -> np.ndarray:
    """(length, length) float64: the orthonormal discrete cosine transform (DCT-II), lowest frequency first."""
    k, m = np.arange(length)[:, None], np.arange(length)[None, :]
    matrix = np.sqrt(2 / length) * np.cos(np.pi * k * (m + 0.5) / length)
    matrix[0] /= np.sqrt(2)
    return matrix
