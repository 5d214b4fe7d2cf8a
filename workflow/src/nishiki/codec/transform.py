"""Transform a tile over (u, v, observation) by orthonormal wavelets, perfectly invertible at any size.

An analysis row is the filter, shifted by two samples; how it goes on beyond the ends is the boundary rule. Written as a
matrix, orthonormal and biorthogonal families, periodic and mirrored ends, and the adjoint that a solver needs are all
the same short loop (`transform.apply_rows`), and the synthesis is the matrix' exact inverse.

Coefficients lie as the samples do, (channel, light, view, row, column): planes in Mallat's order (coarsest band in a
corner), the observation axis by frequency. The basis vectors have unit length, also those of the biorthogonal families
(their gains are divided out), so that one quantiser step means the same error everywhere. For an orthonormal family the
inverse is the transpose and the energy of what is left out is the error (Parseval).
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numba import njit

from nishiki.errors import UserError

NEGLIGIBLE = 1e-15  # rounding of weights near 1


@dataclass(frozen=True)
class SparseRows:
    """A square matrix by its rows: `index` (n, k) int32 columns, `weight` (n, k) float64, unused places weight 0."""

    index: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray) -> "SparseRows":
        """Keep the entries above 1e-15."""
        kept = np.abs(matrix) > NEGLIGIBLE
        width = max(1, int(kept.sum(axis=1).max()))
        order = np.argsort(~kept, axis=1, kind="stable")[:, :width]
        weight = np.take_along_axis(np.where(kept, matrix, 0.0), order, axis=1)
        return cls(np.ascontiguousarray(order, np.int32), np.ascontiguousarray(weight))

    def weights(self, dtype: np.dtype) -> np.ndarray:
        """Return the weights in a precision."""
        return self.single if dtype == np.float32 else self.weight.astype(dtype, copy=False)

    @cached_property
    def single(self) -> np.ndarray:
        """The weights in single precision."""
        return self.weight.astype(np.float32)


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

    per level, finest first, analysis, synthesis and adjoint synthesis by rows; smooth, detail: (length, length >> level
    + 1) float64, the basis vectors of the low and the high band.
    """

    length: int
    analysis: tuple[SparseRows, ...]
    synthesis: tuple[SparseRows, ...]
    adjoint: tuple[SparseRows, ...]
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
        """Largest singular value of the synthesis, squared."""
        return 1.0 if self.orthonormal else _largest_gain(self)

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
    analysis, synthesis, adjoint, smooth, detail, so_far = [], [], [], [], [], np.eye(length)
    for level in range(levels):
        matrix = level_matrix(wavelet, length >> level, mirrored=mirrored)
        inverse = matrix.T if orthonormal else np.linalg.inv(matrix)
        inverse = np.where(np.abs(inverse) < 1e-14, 0.0, inverse)
        analysis.append(SparseRows.of(matrix))
        synthesis.append(SparseRows.of(inverse))
        adjoint.append(SparseRows.of(inverse.T))
        half = length >> level + 1
        detail.append(so_far @ inverse[:, half:])
        so_far = so_far @ inverse[:, :half]
        smooth.append(so_far)
    return AxisTransform(length, *(tuple(part) for part in (analysis, synthesis, adjoint, smooth, detail)))


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


def _largest_gain(plane: PlaneTransform) -> float:
    """Estimate the largest gain by power iteration on synthesis and adjoint, plus one per cent, from a fixed vector."""
    transform = Block(plane, np.eye(1), np.eye(1))
    vector = np.random.default_rng(0).standard_normal((1, 1, 1, *plane.shape))
    norm = 1.0
    for _ in range(60):
        vector = transform.adjoint(transform.inverse(vector / np.linalg.norm(vector)))
        norm = float(np.linalg.norm(vector))
    return 1.01 * norm


@njit(cache=True, nogil=True, error_model="numpy")
def apply_rows(index, weight, source, target, rows, columns, filled, needed):
    """Set target[i, :columns] to the sum over k of weight[i, k] source[index[i, k], :columns]: one level, first axis.

    filled (rows of source,), needed (rows,) bool: sources that are all zero are left out, targets that are not needed
    become zero. Four terms are added at a time, in their order: one read and write of the target for each four.
    """
    width = (index.shape[1] + 3) // 4 * 4
    places, factors = np.zeros(width, np.int64), np.zeros(width, source.dtype)
    for i in range(rows):
        out = target[i]
        count = 0
        if needed[i]:
            for k in range(index.shape[1]):
                if weight[i, k] != 0 and filled[index[i, k]]:
                    places[count], factors[count] = index[i, k], weight[i, k]
                    count += 1
        if count == 0:
            for j in range(columns):
                out[j] = 0
            continue
        while count % 4 != 0:
            places[count], factors[count] = places[0], 0
            count += 1
        for k in range(0, count, 4):
            a, b, c, d = source[places[k]], source[places[k + 1]], source[places[k + 2]], source[places[k + 3]]
            fa, fb, fc, fd = factors[k], factors[k + 1], factors[k + 2], factors[k + 3]
            if k == 0:
                for j in range(columns):
                    out[j] = fa * a[j] + fb * b[j] + fc * c[j] + fd * d[j]
            else:
                for j in range(columns):
                    out[j] = out[j] + fa * a[j] + fb * b[j] + fc * c[j] + fd * d[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _transpose(source, target, rows, columns):
    for i in range(rows):
        for j in range(columns):
            target[j, i] = source[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_filled(values, rows, columns, filled):
    """Mark the rows that are not all zero; return whether there is any."""
    some = False
    for i in range(rows):
        filled[i] = False
        for j in range(columns):
            if values[i, j] != 0:
                filled[i] = some = True
                break
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_needed(chosen, rows, columns, rows_needed, columns_needed):
    """Mark the rows and columns that hold the next level's corner or any chosen coefficient."""
    rows_needed[: rows // 2], rows_needed[rows // 2 : rows] = True, False
    columns_needed[: columns // 2], columns_needed[columns // 2 : columns] = True, False
    for i in range(rows):
        for j in range(columns):
            if chosen[i, j]:
                rows_needed[i] = columns_needed[j] = True


@njit(cache=True, nogil=True, error_model="numpy")
def plane_level(planes, chosen, down_index, down_weight, across_index, across_weight, scratch):
    """Transform all planes (n, rows, columns) by one level, in place, on the corner that the level covers.

    chosen (n, rows, columns) uint8: an analysis need only be right there; without entries (0, 0, 0) everywhere.
    scratch (2, side, side), side the longer of rows and columns. Planes that are all zero stay so.
    """
    first, second = scratch[0], scratch[1]
    rows, columns = down_index.shape[0], across_index.shape[0]
    filled = np.empty(max(rows, columns), np.bool_)
    rows_needed, columns_needed = np.ones(rows, np.bool_), np.ones(columns, np.bool_)
    for n in range(planes.shape[0]):
        plane = planes[n]
        if not _mark_filled(plane, rows, columns, filled):
            continue
        if chosen.shape[0] > 0:
            _mark_needed(chosen[n], rows, columns, rows_needed, columns_needed)
        apply_rows(down_index, down_weight, plane, first, rows, columns, filled, rows_needed)
        _transpose(first, second, rows, columns)
        _mark_filled(second, columns, rows, filled)
        apply_rows(across_index, across_weight, second, first, columns, rows, filled, columns_needed)
        _transpose(first, plane, columns, rows)


@njit(cache=True, nogil=True, error_model="numpy")
def apply_axis(matrix, source, target, needed):
    """Set target[o, k, :] to the sum over m of matrix[k, m] source[o, m, :]; zero where needed (outer, k) is False."""
    outer, length, inner = source.shape
    index = np.empty(matrix.shape, np.int32)
    for m in range(length):
        index[:, m] = m
    filled = np.empty(length, np.bool_)
    for o in range(outer):
        _mark_filled(source[o], length, inner, filled)
        apply_rows(index, matrix, source[o], target[o], matrix.shape[0], inner, filled, needed[o])


EVERYWHERE = np.empty((0, 0, 0), np.uint8)


def _levels(planes: np.ndarray, plane: PlaneTransform, kind: str, chosen: np.ndarray = EVERYWHERE) -> None:
    """Transform all levels in place; kind: analysis, adjoint go from the finest level, synthesis from the coarsest."""
    side = max(plane.shape)
    scratch = np.empty((2, side, side), planes.dtype)
    down, across = getattr(plane.down, kind), getattr(plane.across, kind)
    levels = range(plane.levels - 1, -1, -1) if kind == "synthesis" else range(plane.levels)
    for level in levels:
        rows, columns = (down[level].weights(planes.dtype), across[level].weights(planes.dtype))
        plane_level(planes, chosen, down[level].index, rows, across[level].index, columns, scratch)


def along(matrix: np.ndarray, values: np.ndarray, axis: int, needed: np.ndarray | None = None) -> np.ndarray:
    """Apply `matrix` (k, m) along one axis of an array; the result has k entries there.

    needed: of the result's shape up to that axis, bool: entries that are wanted; the others become zero.
    """
    if matrix.shape[0] == matrix.shape[1] == 1 and matrix[0, 0] == 1:
        return values
    shape = values.shape
    source = np.ascontiguousarray(values).reshape(int(np.prod(shape[:axis])), shape[axis], -1)
    target = np.empty((source.shape[0], matrix.shape[0], source.shape[2]), values.dtype)
    wanted = np.ones(target.shape[:2], bool) if needed is None else needed.reshape(target.shape[:2])
    apply_axis(np.ascontiguousarray(matrix, values.dtype), source, target, wanted)
    return target.reshape(*shape[:axis], matrix.shape[0], *shape[axis + 1 :])


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
        planes = out.reshape(-1, *out.shape[-2:])
        _levels(planes, self.plane, "analysis")
        return out if self.plane.orthonormal else out * self._gains(out.dtype)

    def inverse(self, coefficients: np.ndarray) -> np.ndarray:
        """Compute samples from coefficients."""
        orthonormal = self.plane.orthonormal
        out = coefficients.copy() if orthonormal else coefficients / self._gains(coefficients.dtype)
        _levels(out.reshape(-1, *out.shape[-2:]), self.plane, "synthesis")
        return along(self.views.T, along(self.lights.T, out, 1), 2)

    def adjoint(self, values: np.ndarray, chosen: np.ndarray | None = None) -> np.ndarray:
        """Apply the transpose of `inverse`: the gradient by the coefficients; `forward` where orthonormal.

        chosen: of the coefficients' shape, uint8: the result is right where it is not zero, and finite elsewhere.
        """
        if chosen is None:
            turned = along(self.lights, along(self.views, values, 2), 1)
        else:
            needed = chosen.any(axis=(3, 4))
            views = np.repeat(needed.any(axis=1, keepdims=True), values.shape[1], axis=1)
            turned = along(self.lights, along(self.views, values, 2, views), 1, needed.any(axis=2))
        out = np.array(turned, copy=True) if np.shares_memory(turned, values) else turned
        planes = out.reshape(-1, *out.shape[-2:])
        _levels(planes, self.plane, "adjoint", EVERYWHERE if chosen is None else chosen.reshape(planes.shape))
        if not self.plane.orthonormal:
            out /= self._gains(out.dtype)
        return out

    def bound(self) -> float:
        """Return the largest singular value of `inverse`, squared: 1 where orthonormal."""
        return self.plane.bound

    def _gains(self, dtype) -> np.ndarray:
        return self.plane.gains.astype(dtype)
