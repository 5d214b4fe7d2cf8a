"""Evenly spread choices of directions, the same on every machine."""

import numpy as np

from nishiki.errors import UserError


def spread_order(directions: np.ndarray) -> np.ndarray:
    """All directions in an order whose every beginning is evenly spread, (n,) int64.

    directions (n, 3), unit or positions of any length. The first is the one nearest to their mean; each further one is
    the farthest from those before it, the earlier of equals (T. F. Gonzalez, Clustering to minimize the maximum
    intercluster distance, Theor. Comput. Sci. 38, 1985: no set of as many covers the others within half the distance).
    So a choice of more contains every choice of fewer.
    """
    directions = np.asarray(directions, np.float64)
    if directions.ndim != 2 or not np.isfinite(directions).all():
        raise UserError(f"directions: expected finite (n, 3), found an array {directions.shape}")
    count = len(directions)
    order = np.empty(count, np.int64)
    if not count:
        return order
    order[0] = np.argmin(_squares(directions, directions.mean(axis=0)))
    nearest = _squares(directions, directions[order[0]])
    ordered = np.zeros(count, bool)
    ordered[order[0]] = True
    for k in range(1, count):
        order[k] = np.argmax(np.where(ordered, -1.0, nearest))
        ordered[order[k]] = True
        nearest = np.minimum(nearest, _squares(directions, directions[order[k]]))
    return order


def _squares(directions: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Squared distances to a point, rounded: sums in another order must not change who is the farthest."""
    return np.round(np.sum((directions - point) ** 2, axis=1), 12)
