"""Orthonormal separable transform of a tile over (u, v, observation), perfectly invertible at the tile's boundaries
(Miyazaki et al. 2007, section 4.1).

Coefficients lie as the samples do, (channel, light, view, row, column): planes in Mallat's order (coarsest band in a
corner), the observation axis by frequency. The basis vectors have unit length, also those of the biorthogonal families
(their gains are divided out), so that one quantiser step means the same error everywhere. For an orthonormal family the
inverse is the transpose and the energy of what is left out is the error (Parseval).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit

from nishiki.codec.filters import SparseRows, filter_bank, level_matrix, levels_of


@dataclass(frozen=True)
class Axis:
    """One axis of a plane transform: per level, finest first, analysis, synthesis and adjoint synthesis by rows;
    smooth, detail: (length, length >> level + 1) float64, the basis vectors of the low and the high band."""

    length: int
    analysis: tuple[SparseRows, ...]
    synthesis: tuple[SparseRows, ...]
    adjoint: tuple[SparseRows, ...]
    smooth: tuple[np.ndarray, ...]
    detail: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class Plane:
    """The transform of planes of (rows, columns) texels.

    gains (rows, columns) float64: lengths of the basis planes before they are brought to 1; bound: largest singular
    value of the synthesis, squared.
    """

    down: Axis
    across: Axis
    levels: int
    gains: np.ndarray
    bound: float
    orthonormal: bool

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.down.length, self.across.length


@lru_cache(maxsize=64)
def plane_transform(wavelet: str, rows: int, columns: int, levels: int, *, mirrored: bool = False) -> Plane:
    """The transform of planes of some size; fewer levels than asked where a side cannot be halved so often."""
    levels = min(levels_of(rows, levels), levels_of(columns, levels))
    orthonormal = filter_bank(wavelet)[2] and not mirrored
    down, across = (_axis(wavelet, n, levels, orthonormal=orthonormal, mirrored=mirrored) for n in (rows, columns))
    plane = Plane(down, across, levels, np.ones((rows, columns)), 1.0, orthonormal)
    if orthonormal:
        return plane
    gains = np.sqrt(squared_lengths(plane, np.ones((1, rows, columns)))[0])
    plane = replace(plane, gains=gains)
    return replace(plane, bound=_largest_gain(plane))


@lru_cache(maxsize=64)
def _axis(wavelet: str, length: int, levels: int, *, orthonormal: bool, mirrored: bool) -> Axis:
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
    return Axis(length, *(tuple(part) for part in (analysis, synthesis, adjoint, smooth, detail)))


def squared_lengths(plane: Plane, weight: np.ndarray) -> np.ndarray:
    """(n, rows, columns) float64: for every basis plane s before normalising, the sum of weight * s**2.

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


def _largest_gain(plane: Plane) -> float:
    """Power iteration on synthesis and adjoint, with one per cent on top; the start vector is fixed."""
    transform = Block(plane, np.eye(1), np.eye(1))
    vector = np.random.default_rng(0).standard_normal((1, 1, 1, *plane.shape))
    norm = 1.0
    for _ in range(60):
        vector = transform.adjoint(transform.inverse(vector / np.linalg.norm(vector)))
        norm = float(np.linalg.norm(vector))
    return 1.01 * norm


@njit(cache=True, nogil=True, error_model="numpy")
def apply_rows(index, weight, source, target, rows, columns):
    """target[i, :columns] = sum over k of weight[i, k] source[index[i, k], :columns]: one level along the first
    axis."""
    for i in range(rows):
        out = target[i]
        first, row = weight[i, 0], source[index[i, 0]]
        for j in range(columns):
            out[j] = first * row[j]
        for k in range(1, index.shape[1]):
            factor = weight[i, k]
            if factor != 0:
                row = source[index[i, k]]
                for j in range(columns):
                    out[j] += factor * row[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _transpose(source, target, rows, columns):
    for i in range(rows):
        for j in range(columns):
            target[j, i] = source[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def plane_level(planes, down_index, down_weight, across_index, across_weight, scratch):
    """One level of all planes (n, rows, columns), in place, on the corner that the level covers.

    scratch (2, side, side), side the longer of rows and columns. Planes that are all zero there stay so.
    """
    first, second = scratch[0], scratch[1]
    rows, columns = down_index.shape[0], across_index.shape[0]
    for n in range(planes.shape[0]):
        plane = planes[n]
        empty = True
        for i in range(rows):
            for j in range(columns):
                if plane[i, j] != 0:
                    empty = False
                    break
            if not empty:
                break
        if empty:
            continue
        apply_rows(down_index, down_weight, plane, first, rows, columns)
        _transpose(first, second, rows, columns)
        apply_rows(across_index, across_weight, second, first, columns, rows)
        _transpose(first, plane, columns, rows)


@njit(cache=True, nogil=True, error_model="numpy")
def apply_axis(matrix, source, target):
    """target[o, k, :] = sum over m of matrix[k, m] source[o, m, :], skipping sources that are all zero."""
    outer, length, inner = source.shape
    filled = np.empty(length, np.bool_)
    for o in range(outer):
        for m in range(length):
            row = source[o, m]
            filled[m] = False
            for j in range(inner):
                if row[j] != 0:
                    filled[m] = True
                    break
        for k in range(matrix.shape[0]):
            out = target[o, k]
            out[:] = 0
            for m in range(length):
                factor = matrix[k, m]
                if factor != 0 and filled[m]:
                    row = source[o, m]
                    for j in range(inner):
                        out[j] += factor * row[j]


def _levels(planes: np.ndarray, plane: Plane, kind: str) -> None:
    """All levels in place; kind: analysis and adjoint go from the finest level on, synthesis from the coarsest."""
    side = max(plane.shape)
    scratch = np.empty((2, side, side), planes.dtype)
    down, across = getattr(plane.down, kind), getattr(plane.across, kind)
    levels = range(plane.levels - 1, -1, -1) if kind == "synthesis" else range(plane.levels)
    for level in levels:
        parts = (down[level], across[level])
        arguments = [a for part in parts for a in (part.index, part.weight.astype(planes.dtype))]
        plane_level(planes, *arguments, scratch)


def along(matrix: np.ndarray, values: np.ndarray, axis: int) -> np.ndarray:
    """`matrix` (k, m) applied along one axis of an array; the result has k entries there."""
    if matrix.shape[0] == matrix.shape[1] == 1 and matrix[0, 0] == 1:
        return values
    shape = values.shape
    source = np.ascontiguousarray(values).reshape(int(np.prod(shape[:axis])), shape[axis], -1)
    target = np.empty((source.shape[0], matrix.shape[0], source.shape[2]), values.dtype)
    apply_axis(np.ascontiguousarray(matrix, values.dtype), source, target)
    return target.reshape(*shape[:axis], matrix.shape[0], *shape[axis + 1 :])


@dataclass(frozen=True)
class Block:
    """Transform of a tile's block (channels, lights, views, rows, columns): orthonormal matrices of the light and view
    axes (rows are basis vectors) and the transform of the planes."""

    plane: Plane
    views: np.ndarray
    lights: np.ndarray

    def forward(self, values: np.ndarray) -> np.ndarray:
        """Coefficients of samples (channels, lights, views, rows, columns), float32 or float64."""
        out = np.array(along(self.lights, along(self.views, values, 2), 1), copy=True)
        planes = out.reshape(-1, *out.shape[-2:])
        _levels(planes, self.plane, "analysis")
        return out if self.plane.orthonormal else out * self._gains(out.dtype)

    def inverse(self, coefficients: np.ndarray) -> np.ndarray:
        """Samples of coefficients."""
        out = np.array(coefficients, copy=True)
        if not self.plane.orthonormal:
            out /= self._gains(out.dtype)
        _levels(out.reshape(-1, *out.shape[-2:]), self.plane, "synthesis")
        return along(self.views.T, along(self.lights.T, out, 1), 2)

    def adjoint(self, values: np.ndarray) -> np.ndarray:
        """Transpose of `inverse`: the gradient with respect to the coefficients; `forward` where orthonormal."""
        out = np.array(along(self.lights, along(self.views, values, 2), 1), copy=True)
        _levels(out.reshape(-1, *out.shape[-2:]), self.plane, "adjoint")
        return out if self.plane.orthonormal else out / self._gains(out.dtype)

    def bound(self) -> float:
        """Largest singular value of `inverse`, squared: 1 where orthonormal."""
        return self.plane.bound

    def _gains(self, dtype) -> np.ndarray:
        return self.plane.gains.astype(dtype)
