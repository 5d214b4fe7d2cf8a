"""Smooth and fill a field over the surface from texels of unequal certainty.

Texels are spread onto the nodes of a cubic lattice in the object's frame (tent weights), each with its precision, and
from there onto lattices twice as wide, up to the whole object.  From coarse to fine, a node's value is the mean of its
own texels and of the coarser field, which counts as much as `coarse` (a precision).  Where texels say much, the field
follows them at the finest scale; where they say nothing, it is the mean of whatever is near, smoothly, across tile and
chart borders.  Cost and memory are linear in the texels, and texels come tile by tile in any order.

(S. J. Gortler, R. Grzeszczuk, R. Szeliski, M. F. Cohen, The lumigraph, SIGGRAPH 1996, section 3.4, with bilinear
push.)
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

_BITS = 21  # of a node along an axis: three fit into 64
_MIDDLE = 1 << (_BITS - 1)


@dataclass(frozen=True)
class Lattice:
    """Cells in space."""

    edge: float  # of the finest lattice's cells, in the object's unit
    # (3,): a place near the object, from which nodes are counted, up to 2^20 each way (farther ones are held at that)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def places(self, positions: np.ndarray) -> np.ndarray:
        """Convert positions (n, 3) to float64 cells from the origin."""
        return (np.asarray(positions, np.float64).reshape(-1, 3) - self.origin) / self.edge


@dataclass(frozen=True)
class Neighbourhood:
    """Texels gathered; size: numbers a texel; parts: from `spread`, in the order in which they are to be added."""

    lattice: Lattice
    size: int
    parts: list

    def mean(self, default: np.ndarray) -> np.ndarray:
        """Average all texels by precision: (size,); default where none has any."""
        total = sum((sums.sum(axis=0) for _, sums in self.parts), np.zeros(1 + self.size))
        return total[1:] / total[0] if total[0] > 0 else np.asarray(default, float)

    def field(self, coarse: float, default: np.ndarray) -> "LatticeField":
        """Smooth the field; coarse: precision of the next coarser lattice; default (size,): where there is no texel."""
        mean = self.mean(default)
        if not any(len(keys) for keys, _ in self.parts):
            return LatticeField(self.lattice, np.zeros(1, np.int64), mean[None].copy(), mean)
        levels = [_merge(*(np.concatenate(part) for part in zip(*self.parts, strict=True)))]
        while len(levels[-1][0]) > 8 and len(levels) < _BITS:
            keys, sums = levels[-1]
            levels.append(_share(_unpack(keys) / 2, sums))
        above, below, values = mean, levels[-1][0], mean[None]
        for number, (keys, sums) in enumerate(reversed(levels)):
            if number:
                above = _looked_up(_unpack(keys) / 2, below, values)
            below, values = keys, (sums[:, 1:] + coarse * above) / (sums[:, :1] + coarse)
        return LatticeField(self.lattice, below, values, mean)


def spread(positions: np.ndarray, values: np.ndarray, precision: np.ndarray, lattice: Lattice) -> tuple:
    """Sum texels at positions (n, 3) with values (n, size) and precision (n,) >= 0 into a part of a Neighbourhood.

    Texels of precision 0 only say where there is surface.
    """
    weight = np.asarray(precision, np.float64)[:, None]
    sums = np.concatenate([weight, weight * np.where(weight > 0, values, 0)], axis=1)
    return _share(lattice.places(positions), sums)


@dataclass(frozen=True)
class LatticeField:
    """Values on the nodes of a lattice (keys sorted): between them, trilinear."""

    lattice: Lattice
    keys: np.ndarray
    values: np.ndarray
    mean: np.ndarray

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Interpolate (n, size) float32 at added positions (n, 3); elsewhere the nearest nodes' mean, or the first."""
        return _looked_up(self.lattice.places(positions), self.keys, self.values).astype(np.float32)


def _share(places: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share sums (n, s) at places (n, 3), in cells, among the nodes around by tent weights; merge them by node."""
    from scipy.sparse import csr_array

    keys, weights = map(np.concatenate, zip(*_nodes_around(places), strict=True))
    there, texel = weights > 0, np.tile(np.arange(len(places)), 8)
    nodes, row = np.unique(keys[there], return_inverse=True)
    shares = csr_array((weights[there], (row, texel[there])), shape=(len(nodes), len(places)))
    return nodes, shares @ sums


def _nodes_around(places: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the eight nodes around places (n, 3) by their keys (n,), with their tent weights (n,)."""
    low = np.floor(places).astype(np.int64)
    share = places - low
    for corner in product((0, 1), repeat=3):
        i, j, k = np.clip(low + corner + _MIDDLE, 0, 2 * _MIDDLE - 1).T
        yield (i << 2 * _BITS) | (j << _BITS) | k, np.prod(np.where(corner, share, 1 - share), axis=1)


def _merge(keys: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    if not keys.size:
        return keys, sums
    first = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]])
    return keys[first], np.add.reduceat(sums[order], first, axis=0)


def _unpack(keys: np.ndarray) -> np.ndarray:
    mask = 2 * _MIDDLE - 1
    return np.stack([keys >> 2 * _BITS, keys >> _BITS & mask, keys & mask], axis=1) - float(_MIDDLE)


def _looked_up(places: np.ndarray, keys: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate values (keys, s) at places (n, 3) among the nodes that are there, or take the first node's."""
    out, total = np.zeros((len(places), values.shape[1])), np.zeros((len(places), 1))
    for corner, weight in _nodes_around(places):
        row = np.minimum(np.searchsorted(keys, corner), len(keys) - 1)
        share = (weight * (keys[row] == corner))[:, None]
        total += share
        out += share * values[row]
    return np.where(total > 0, out / np.where(total > 0, total, 1), values[0])


def fill(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Replace values (rows, columns, n) of texels that are not known (rows, columns) from known ones.

    Known texels stay as they are; where none is known the result is 0.
    """
    if known.all():
        return values.astype(np.float32)
    sums = np.where(known[..., None], values, 0).astype(np.float64)
    return np.where(known[..., None], values, _fill(sums, known.astype(np.float64))).astype(np.float32)


def _fill(sums: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Average the known texels near each: sums (rows, columns, n) already multiplied by weight (rows, columns)."""
    rows, columns = weight.shape
    mean = np.divide(sums, weight[..., None], out=np.zeros_like(sums), where=weight[..., None] > 0)
    if rows <= 1 and columns <= 1:
        return mean
    above = _fill(_halve(sums), _halve(weight[..., None])[..., 0])
    share = np.minimum(weight, 1)[..., None]
    return share * mean + (1 - share) * _double(above, rows, columns)


def _halve(values: np.ndarray) -> np.ndarray:
    rows, columns, _ = values.shape
    even = np.pad(values, ((0, rows % 2), (0, columns % 2), (0, 0)))
    return even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]


def _double(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Double a grid bilinearly to (rows, columns), cell centres on cell centres, ends held."""
    for axis, length in ((0, rows), (1, columns)):
        at = np.clip((np.arange(length) - 0.5) / 2, 0, values.shape[axis] - 1)
        low = np.floor(at).astype(int)
        high = np.minimum(low + 1, values.shape[axis] - 1)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        values = (1 - share) * values.take(low, axis) + share * values.take(high, axis)
    return values
