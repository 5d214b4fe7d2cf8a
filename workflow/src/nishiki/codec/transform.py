"""Transform a tile over (u, v, observation) by orthonormal wavelets, perfectly invertible at any size.

An analysis row is the filter, shifted by two samples; how it goes on beyond the ends is the boundary rule. Written as a
matrix, orthonormal and biorthogonal families, periodic and mirrored ends, and the adjoint that a solver needs are all
the same short loop (`transform.apply_rows`), and the synthesis is the matrix' exact inverse.

Coefficients lie as the samples do, (channel, light, view, row, column): planes in Mallat's order (coarsest band in a
corner), the observation axis by frequency. The basis vectors have unit length, also those of the biorthogonal families
(their gains are divided out), so that one quantiser step means the same error everywhere. For an orthonormal family the
inverse is the transpose and the energy of what is left out is the error (Parseval).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numba import njit

from nishiki.errors import UserError
from nishiki.lanes import LANES, load, splat, store

NEGLIGIBLE = 1e-15  # rounding of weights near 1


@dataclass(frozen=True)
class SparseRows:
    """The square matrix of each level by its rows, half as many from level to level.

    index (levels, n, k) int32 columns; weight (levels, n, k) float64, unused places weight 0.
    """

    index: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, matrices: Sequence[np.ndarray]) -> "SparseRows":
        """Keep the entries above 1e-15."""
        kept = [np.abs(matrix) > NEGLIGIBLE for matrix in matrices]
        width = max([1, *(int(some.sum(axis=1).max()) for some in kept)])
        index = np.zeros((len(matrices), len(matrices[0]) if matrices else 0, width), np.int32)
        weight = np.zeros(index.shape)
        for level, (matrix, some) in enumerate(zip(matrices, kept, strict=True)):
            order = np.argsort(~some, axis=1, kind="stable")[:, :width]
            part = level, slice(len(matrix)), slice(order.shape[1])
            index[part], weight[part] = order, np.take_along_axis(np.where(some, matrix, 0.0), order, axis=1)
        return cls(index, weight)

    @cached_property
    def single(self) -> np.ndarray:
        """The weights in single precision."""
        return self.weight.astype(np.float32)

    def rows(self, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Return index and weights in a precision."""
        return self.index, self.single if dtype == np.float32 else self.weight.astype(dtype, copy=False)


@lru_cache(maxsize=64)
def family(wavelet: str):
    """Return a family of filters. UserError where PyWavelets knows no discrete wavelet of that name."""
    import pywt

    if wavelet not in pywt.wavelist(kind="discrete"):
        raise UserError(f"wavelet: expected a discrete one of PyWavelets (haar, db2, sym4, ...), found {wavelet!r}")
    return pywt.Wavelet(wavelet)


@lru_cache(maxsize=256)
def level_matrix(wavelet: str, length: int, *, mirrored: bool = False) -> np.ndarray:
    """Make the matrix (length, length) float64 of one level: rows 0 .. length/2 - 1 low-pass, the rest high-pass.

    length: even. Periodic ends, or mirrored: the signal goes on by reflection about its end samples, which symmetric
    filters of odd length (bior2.2, bior4.4) invert. Raises UserError for an odd length.
    """
    import pywt

    if length < 2 or length % 2:
        raise UserError(f"wavelet level: expected an even length, found {length}")
    bands = pywt.dwt(np.eye(length), family(wavelet), mode="reflect" if mirrored else "periodization", axis=0)
    first = (len(bands[0]) - length // 2) // 2
    return np.concatenate([band[first : first + length // 2] for band in bands])


def levels_of(length: int, most: int) -> int:
    """Count the levels that `length` allows: as many halvings as are exact, at most `most`."""
    levels = 0
    while levels < most and length % 2 == 0 and length > 1:
        length //= 2
        levels += 1
    return levels


def analysis_matrix(wavelet: str, length: int, levels: int, *, mirrored: bool = False) -> np.ndarray:
    """Make one matrix (length, length) float64 of all levels, coarsest band first (Mallat's order)."""
    total = np.eye(length)
    for _ in range(levels_of(length, levels)):
        size = length
        total[:size] = level_matrix(wavelet, size, mirrored=mirrored) @ total[:size]
        length //= 2
    return total


def cosine_matrix(length: int) -> np.ndarray:
    """Make the orthonormal discrete cosine transform (DCT-II) (length, length) float64, lowest frequency first."""
    k, m = np.arange(length)[:, None], np.arange(length)[None, :]
    matrix = np.sqrt(2 / length) * np.cos(np.pi * k * (m + 0.5) / length)
    matrix[0] /= np.sqrt(2)
    return matrix


@dataclass(frozen=True)
class AxisTransform:
    """The transform of planes along one axis.

    by levels, finest first, analysis, synthesis and adjoint synthesis by rows; smooth, detail: (length, length >> level
    + 1) float64, the basis vectors of the low and the high band.
    """

    length: int
    analysis: SparseRows
    synthesis: SparseRows
    adjoint: SparseRows
    smooth: tuple[np.ndarray, ...]
    detail: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class PlaneTransform:
    """The transform of planes of (rows, columns) texels."""

    down: AxisTransform
    across: AxisTransform
    levels: int
    gains: np.ndarray  # (rows, columns) float64: lengths of the basis planes before they are brought to 1
    orthonormal: bool

    @cached_property
    def bound(self) -> float:
        """Largest singular value of the synthesis, squared: 1, or by power iteration from a fixed vector, plus 1 %."""
        transform, norm = Block(self, np.eye(1), np.eye(1)), 1.0
        vector = np.random.default_rng(0).standard_normal((1, 1, 1, *self.shape))
        for _ in range(0 if self.orthonormal else 60):
            vector = transform.adjoint(transform.inverse(vector / np.linalg.norm(vector)))
            norm = 1.01 * float(np.linalg.norm(vector))
        return norm

    @cached_property
    def single(self) -> np.ndarray:
        """The gains as float32."""
        return self.gains.astype(np.float32)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.down.length, self.across.length


@lru_cache(maxsize=64)
def plane_transform(wavelet: str, rows: int, columns: int, levels: int, *, mirrored: bool = False) -> PlaneTransform:
    """Plan the transform of planes of some size, with fewer levels where a side cannot be halved so often."""
    levels = min(levels_of(rows, levels), levels_of(columns, levels))
    orthonormal = family(wavelet).orthogonal and not mirrored
    down, across = (_axis(wavelet, n, levels, orthonormal=orthonormal, mirrored=mirrored) for n in (rows, columns))
    plane = PlaneTransform(down, across, levels, np.ones((rows, columns)), orthonormal)
    if orthonormal:
        return plane
    return replace(plane, gains=np.sqrt(squared_lengths(plane, np.ones((1, rows, columns)))[0]))


@lru_cache(maxsize=64)
def _axis(wavelet: str, length: int, levels: int, *, orthonormal: bool, mirrored: bool) -> AxisTransform:
    forth, back, smooth, detail, so_far = [], [], [], [], np.eye(length)
    for level in range(levels):
        matrix = level_matrix(wavelet, length >> level, mirrored=mirrored)
        inverse = matrix.T if orthonormal else np.linalg.inv(matrix)
        inverse = np.where(np.abs(inverse) < 1e-14, 0.0, inverse)
        forth.append(matrix)
        back.append(inverse)
        half = length >> level + 1
        detail.append(so_far @ inverse[:, half:])
        so_far = so_far @ inverse[:, :half]
        smooth.append(so_far)
    adjoint = SparseRows.of([inverse.T for inverse in back])
    return AxisTransform(length, SparseRows.of(forth), SparseRows.of(back), adjoint, tuple(smooth), tuple(detail))


def squared_lengths(plane: PlaneTransform, weight: np.ndarray) -> np.ndarray:
    """Sum weight * s**2 for every basis plane s before normalising: (n, rows, columns) float64.

    With the density of pixels as weight this estimates the curvature of the error in each coefficient.
    """
    out = np.array(weight, np.float64)
    for level in range(plane.levels):
        parts = [(axis.smooth[level] ** 2, axis.detail[level] ** 2) for axis in (plane.down, plane.across)]
        (low, high), (left, right) = parts
        h, w = low.shape[1], left.shape[1]
        rows_low, rows_high = low.T @ weight, high.T @ weight
        out[:, :h, :w] = rows_low @ left
        out[:, :h, w : 2 * w] = rows_low @ right
        out[:, h : 2 * h, :w] = rows_high @ left
        out[:, h : 2 * h, w : 2 * w] = rows_high @ right
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def apply_rows(index, weight, rows, source, target, part, filled, needed):
    """Set target[i < rows, j] to the sum over k, in order, of weight[i, k] source[index[i, k], j]; j: a part of places.

    The part (first, stop) is done in whole LANES, beyond its end where need be. filled (rows of source,), needed (rows
    of target,) bool: sources that are all zero are left out, targets that are not needed become zero.
    """
    zero = weight.dtype.type(0)
    places, factors = np.zeros(index.shape[1], np.int64), np.zeros(index.shape[1], weight.dtype)
    for i in range(rows):
        count = 0
        if needed[i]:
            for k in range(index.shape[1]):
                if weight[i, k] != 0 and filled[index[i, k]]:
                    places[count], factors[count] = index[i, k], weight[i, k]
                    count += 1
        for start in range(part[0], part[1], LANES):
            total = splat(zero)
            for k in range(count):
                total += load(source, (places[k], start)) * factors[k]
            store(target, (i, start), total)


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(values, rows, columns):
    """Mark the rows and columns (bool) of a corner that are not all zero; return whether there is any."""
    columns[:] = False
    for i in range(len(rows)):
        row = values[i]
        some = 0
        for j in range(len(columns)):
            some |= row[j] != 0
        rows[i] = some != 0
        if some:
            for j in range(len(columns)):
                columns[j] |= row[j] != 0
    return rows.any()


@njit(cache=True, nogil=True, error_model="numpy")
def _copy(source, target, rows, columns):
    for i in range(rows):
        values, copy = source[i], target[i]
        for j in range(columns):
            copy[j] = values[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _transpose(source, target, rows, columns):
    for i in range(0, rows, 8):  # of so many rows together the compiler makes vector code
        for j in range(columns):
            row = target[j]
            for k in range(8):
                row[i + k] = source[i + k, j]


@njit(cache=True, nogil=True, error_model="numpy")
def plane_levels(planes, backwards, down, across, scratch):
    """Transform all planes (n, rows, columns) in place, each level the corner that it covers.

    backwards: from the coarsest level on; down, across: index and weights of `SparseRows`; scratch: of `_levels`.
    Planes that are all zero stay so.
    """
    first, second, levels = scratch[0], scratch[1], len(down[0])
    every = np.ones(len(first), np.bool_)
    for n in range(planes.shape[0]):
        plane = planes[n]
        for count in range(levels):
            level = levels - 1 - count if backwards else count
            rows, columns = planes.shape[1] >> level, planes.shape[2] >> level
            rows_filled, columns_filled = np.empty(rows, np.bool_), np.empty(columns, np.bool_)
            if not _mark(plane, rows_filled, columns_filled):
                continue
            _copy(plane, second, rows, columns)
            part = 0, columns
            apply_rows(down[0][level], down[1][level], rows, second, first, part, rows_filled, every)
            _transpose(first, second, rows, columns)
            part = 0, rows
            apply_rows(across[0][level], across[1][level], columns, second, first, part, columns_filled, every)
            _transpose(first, second, columns, rows)
            _copy(second, plane, rows, columns)


STRIP = 512  # columns of which as many rows as there are views fit into the first-level cache


@njit(cache=True, nogil=True, error_model="numpy")
def apply_axis(matrix, source, target, needed):
    """Set target[o, k, :] to the sum over m of matrix[k, m] source[o, m, :]; zero where needed (outer, k) is False.

    As many numbers a row as a multiple of LANES.
    """
    outer, length, inner = source.shape
    index = np.empty(matrix.shape, np.int32)
    for m in range(length):
        index[:, m] = m
    filled = np.empty(length, np.bool_)
    for o in range(outer):
        for m in range(length):
            row = source[o, m]
            filled[m] = False
            for j in range(inner):
                if row[j] != 0:
                    filled[m] = True
                    break
        for start in range(0, inner, STRIP):
            part = start, min(start + STRIP, inner)
            apply_rows(index, matrix, len(matrix), source[o], target[o], part, filled, needed[o])


def _levels(planes: np.ndarray, plane: PlaneTransform, kind: str) -> None:
    """Transform all levels in place; kind: analysis, adjoint go from the finest level, synthesis from the coarsest."""
    side = -(-max(plane.shape) // LANES) * LANES
    scratch = np.empty((2, side, side), planes.dtype)
    down, across = (getattr(axis, kind).rows(planes.dtype) for axis in (plane.down, plane.across))
    plane_levels(planes, kind == "synthesis", down, across, scratch)


def along(matrix: np.ndarray, values: np.ndarray, axis: int, needed: np.ndarray | None = None) -> np.ndarray:
    """Apply `matrix` (k, m) along one axis of an array; the result has k entries there.

    needed: of the result's shape up to that axis, bool: entries that are wanted; the others become zero.
    """
    if matrix.shape[0] == matrix.shape[1] == 1 and matrix[0, 0] == 1:
        return values
    shape = values.shape
    source = np.ascontiguousarray(values).reshape(int(np.prod(shape[:axis])), shape[axis], -1)
    inner = source.shape[2]
    source = np.pad(source, ((0, 0), (0, 0), (0, -inner % LANES))) if inner % LANES else source
    target = np.empty((source.shape[0], matrix.shape[0], source.shape[2]), values.dtype)
    wanted = np.ones(target.shape[:2], bool) if needed is None else needed.reshape(target.shape[:2])
    apply_axis(np.ascontiguousarray(matrix, values.dtype), source, target, wanted)
    return np.ascontiguousarray(target[..., :inner]).reshape(*shape[:axis], matrix.shape[0], *shape[axis + 1 :])


@dataclass(frozen=True)
class Block:
    """The transform of a tile's block (channels, lights, views, rows, columns).

    It holds orthonormal matrices of the light and view axes (rows are basis vectors) and the transform of the planes.
    """

    plane: PlaneTransform
    views: np.ndarray
    lights: np.ndarray

    def forward(self, values: np.ndarray) -> np.ndarray:
        """Compute coefficients of samples (channels, lights, views, rows, columns), float32 or float64."""
        out = np.array(along(self.lights, along(self.views, values, 2), 1), copy=True)
        _levels(out.reshape(-1, *out.shape[-2:]), self.plane, "analysis")
        return out if self.plane.orthonormal else out * self._gains(out.dtype)

    def inverse(self, coefficients: np.ndarray) -> np.ndarray:
        """Compute samples from coefficients."""
        orthonormal = self.plane.orthonormal
        out = coefficients.copy() if orthonormal else coefficients / self._gains(coefficients.dtype)
        _levels(out.reshape(-1, *out.shape[-2:]), self.plane, "synthesis")
        return along(self.views.T, along(self.lights.T, out, 1), 2)

    def adjoint(self, values: np.ndarray, planes: np.ndarray | None = None) -> np.ndarray:
        """Apply the transpose of `inverse`: the gradient by the coefficients; `forward` where orthonormal.

        planes (channels, lights, views) bool: those that are wanted; the others become zero.
        """
        needed = views = None
        if planes is not None:
            needed = planes.any(axis=2)
            views = np.repeat(planes.any(axis=1, keepdims=True), values.shape[1], axis=1)
        turned = along(self.lights, along(self.views, values, 2, views), 1, needed)
        out = np.array(turned, copy=True) if np.shares_memory(turned, values) else turned
        _levels(out.reshape(-1, *out.shape[-2:]), self.plane, "adjoint")
        if not self.plane.orthonormal:
            out /= self._gains(out.dtype)
        return out

    def _gains(self, dtype: np.dtype) -> np.ndarray:
        return self.plane.single if dtype == np.float32 else self.plane.gains.astype(dtype)
