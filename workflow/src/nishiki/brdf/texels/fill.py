"""Fill what is unknown in a tile smoothly, so that it costs next to nothing to code: pull and push over a pyramid.

(S. J. Gortler, R. Grzeszczuk, R. Szeliski, M. F. Cohen, The lumigraph, SIGGRAPH 1996, section 3.4, with bilinear
push.)
"""

import numpy as np


def fill(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """values (rows, columns, n) with every texel that is not known (rows, columns) replaced from known ones.

    Known texels stay as they are; where none is known the result is 0.
    """
    if known.all():
        return values.astype(np.float32)
    sums = np.where(known[..., None], values, 0).astype(np.float64)
    return np.where(known[..., None], values, _filled(sums, known.astype(np.float64))).astype(np.float32)


def _filled(sums: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Mean of the known texels near each: sums (rows, columns, n) already multiplied by weight (rows, columns)."""
    rows, columns = weight.shape
    mean = np.divide(sums, weight[..., None], out=np.zeros_like(sums), where=weight[..., None] > 0)
    if rows <= 1 and columns <= 1:
        return mean
    above = _filled(_halved(sums), _halved(weight[..., None])[..., 0])
    share = np.minimum(weight, 1)[..., None]
    return share * mean + (1 - share) * _doubled(above, rows, columns)


def _halved(values: np.ndarray) -> np.ndarray:
    rows, columns, _ = values.shape
    even = np.pad(values, ((0, rows % 2), (0, columns % 2), (0, 0)))
    return even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]


def _doubled(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Bilinear, cell centres on cell centres, ends held."""
    for axis, length in ((0, rows), (1, columns)):
        at = np.clip((np.arange(length) - 0.5) / 2, 0, values.shape[axis] - 1)
        low = np.floor(at).astype(int)
        high = np.minimum(low + 1, values.shape[axis] - 1)
        share = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        values = (1 - share) * values.take(low, axis) + share * values.take(high, axis)
    return values
