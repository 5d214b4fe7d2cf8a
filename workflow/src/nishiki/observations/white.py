"""The white board: how bright the lamp was at each place, and so the gain that makes a perfect white 1 (Tominaga and
Tanaka 2004, eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.formats.problems import CaptureError, Problem, error, refuse, warning
from nishiki.observations.block_kernels import block_levels

TOO_DARK = 0.02  # of full scale: below it noise and rounding are several percent of the board
BAD_SHARE = 0.25  # of a block's samples
MIN_GOOD_BLOCKS = 0.5


@dataclass(frozen=True)
class WhiteField:
    """gain (r, c, channels) float32, NaN where the board cannot be used; relative to the exposure of the board.

    level: median of the board (channels,), fraction of full scale; uniformity: 5th / 95th percentile of the blocks, per
    channel; bad_blocks: share of the needed blocks that cannot be used; problems: what the user should know.
    """

    gain: np.ndarray
    level: np.ndarray
    uniformity: np.ndarray
    bad_blocks: float
    problems: tuple[Problem, ...]


def white_field(
    codes: np.ndarray,
    table: np.ndarray,
    dark: np.ndarray,
    row_edges: np.ndarray,
    column_edges: np.ndarray,
    *,
    cos_theta: np.ndarray | float,
    reflectance: float,
    saturated: float,
    clip: float,
    name: str,
    needed: np.ndarray | None = None,
) -> WhiteField:
    """Gain of one lamp from the board's codes (rows, columns, channels).

    gain = reflectance * cos(theta) / (board - dark): the reciprocal of what a perfect diffuser facing the lamp would
    have given. dark (1 or r, 1 or c, channels) in fractions of full scale; cos_theta: between lamp and board's normal,
    a number or (r, c, 1) where the lamp is near; needed (r, c) bool: blocks that hold part of the object (default all):
    the board need not be larger than the object.
    Raises CaptureError (white-grazing, white-saturated, white-dark) where less than half of the needed board can
    be used.
    """
    if np.min(cos_theta) <= 0.05:
        found = f"cosine {np.min(cos_theta):.3f}"
        refuse("white-grazing", name, "lamp grazes or lies behind the white board", found=found)
    levels, unusable = block_levels(codes, table, row_edges, column_edges, float(saturated), float(clip))
    board = levels - dark
    bright_share = float((codes >= saturated).any(axis=2).mean())
    with np.errstate(invalid="ignore"):
        too_dark = ~(board >= least_level(codes.dtype, board))
        bad = (too_dark | (unusable > BAD_SHARE)).any(axis=2)
    needed = np.ones(bad.shape, bool) if needed is None else needed
    bad_share = float(bad[needed].mean())
    if bad_share > 1 - MIN_GOOD_BLOCKS:
        raise CaptureError(_unusable_board(name, bright_share, board[needed]))
    gain = np.where(bad[:, :, None], np.nan, reflectance * cos_theta / np.where(bad[:, :, None], 1.0, board))
    problems = ()
    if bad_share > 0:
        found = f"{100 * bad_share:.1f} % of the blocks; saturated samples {100 * bright_share:.1f} %"
        remedy = "Samples there are marked as not valid under this light"
        problems = (warning("white-partial", name, "white board is partly unusable", found=found, remedy=remedy),)
    good = board[needed & ~bad]
    low, high = np.percentile(good, [5, 95], axis=0)
    return WhiteField(gain.astype(np.float32), np.median(good, axis=0), low / high, bad_share, problems)


def least_level(dtype: np.dtype, board: np.ndarray) -> float:
    """Level from which a board can be divided by: float samples have no full scale, so relative to their brightest."""
    if np.dtype(dtype).kind == "u":
        return TOO_DARK
    known = board[np.isfinite(board)]
    return max(TOO_DARK * float(known.max(initial=0.0)), float(np.finfo(np.float32).tiny))


def _unusable_board(name: str, bright_share: float, board: np.ndarray) -> Problem:
    """Why the board cannot be used: too bright or too dark."""
    if bright_share > 0.25:
        found = f"{100 * bright_share:.0f} % of its pixels"
        remedy = "Expose the board less (give exposure_s) or use a grey board with its reflectance"
        return error("white-saturated", name, "white board is saturated", found=found, remedy=remedy)
    level = float(np.nanmedian(board)) if np.isfinite(board).any() else 0.0
    found, expected = f"median {100 * level:.2f} % of full scale", f"at least {100 * TOO_DARK:g} %"
    remedy = "Expose the board longer (give exposure_s), or check that it fills the picture"
    return error("white-dark", name, "white board is too dark or uneven", expected=expected, found=found, remedy=remedy)
