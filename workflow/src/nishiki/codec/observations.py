"""The observation axis of a tile: which views it spans, and the orthonormal transform along them.

A tile is seen from an arc of the turn. Views outside the arc cost nothing: they are not in the block. Gaps inside
it (held-out views, occlusion) are invisible samples, which the solver fills.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from nishiki.codec.filters import analysis_matrix, cosine_matrix, levels_of
from nishiki.errors import UserError


def visible_arc(seen: np.ndarray, *, full_turn: bool) -> tuple[int, int]:
    """First view and number of views of the shortest arc that holds every seen view.

    seen (views,) bool. full_turn: the last view neighbours the first, so that an arc may pass the end. (0, 0) where
    nothing is seen; the lowest start where two arcs are equally short.
    """
    views = len(seen)
    at = np.flatnonzero(seen)
    if not len(at):
        return 0, 0
    if not full_turn:
        return int(at[0]), int(at[-1] - at[0] + 1)
    gaps = np.diff(np.append(at, at[0] + views))
    widest = int(np.argmax(gaps))
    start = int(at[(widest + 1) % len(at)])
    return start, int(views - gaps[widest] + 1)


def arc_views(start: int, length: int, views: int) -> np.ndarray:
    """(length,) int64: the views of an arc, in the order of the turn."""
    return (start + np.arange(length)) % views


@lru_cache(maxsize=512)
def view_matrix(kind: str, length: int) -> np.ndarray:
    """(length, length) float64 orthonormal; rows are basis vectors, lowest frequency first.

    kind: "cosine" (DCT-II), "fourier" (the real Fourier basis, for a whole turn), "none", or the name of an orthonormal
    wavelet: as many levels as `length` allows, an odd coarsest band goes on with a DCT.
    Raises UserError for a biorthogonal wavelet.
    """
    if kind == "none" or length == 1:
        return np.eye(length)
    if kind == "cosine":
        return cosine_matrix(length)
    if kind == "fourier":
        return fourier_matrix(length)
    levels = levels_of(length, 32)
    matrix = analysis_matrix(kind, length, levels)
    if np.abs(matrix @ matrix.T - np.eye(length)).max() > 1e-9:
        raise UserError(f"view_transform: expected an orthonormal family, found {kind!r}")
    coarse = length >> levels
    if coarse > 1:
        matrix[:coarse] = cosine_matrix(coarse) @ matrix[:coarse]
    return matrix


def fourier_matrix(length: int) -> np.ndarray:
    """(length, length) float64: constant, then cosine and sine of each frequency; orthonormal and shift-invariant."""
    m = np.arange(length)
    rows = [np.full(length, np.sqrt(1 / length))]
    for k in range(1, (length + 1) // 2):
        rows += [np.sqrt(2 / length) * np.cos(2 * np.pi * k * m / length)]
        rows += [np.sqrt(2 / length) * np.sin(2 * np.pi * k * m / length)]
    if length % 2 == 0:
        rows.append(np.sqrt(1 / length) * (1.0 - 2.0 * (m % 2)))
    return np.array(rows)
