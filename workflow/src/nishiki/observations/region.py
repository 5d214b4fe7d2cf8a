"""The part of the photographs that is kept: the region of interest, and in it the bounding box of the object's mask."""

from __future__ import annotations

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.formats.images import Region
from nishiki.formats.problems import CaptureError, error
from nishiki.observations.blocks import Edges, blocks_around, edges_between

MARGIN = 8
"""Least number of pixels that are kept around the object, where the photograph has them: pictures want a rim."""


def region_of(capture: Capture, rows: int, columns: int) -> Region:
    """The region of interest, the whole picture if none; CaptureError (region-outside) if it leaves the picture."""
    region = capture.settings.region_of_interest or (0, 0, rows, columns)
    row, column, height, width = region
    if height < 1 or width < 1 or row + height > rows or column + width > columns:
        what = "region_of_interest leaves the picture or is empty"
        expected = f"within {rows} rows and {columns} columns"
        raise CaptureError(
            error("region-outside", "capture.yaml", what, expected=expected, found=", ".join(map(str, region)))
        )
    return region


def region_around(mask: np.ndarray, region: Region, block: int) -> Region:
    """The part of a region that holds its mask (rows, columns), with a rim of MARGIN pixels and a block."""
    (top, bottom), (left, right) = (blocks_around(mask.any(axis=axis), block, MARGIN) for axis in (1, 0))
    return region[0] + top, region[1] + left, bottom - top, right - left


def window_of(outer: Region, inner: Region) -> tuple[slice, slice]:
    """Rows and columns of a region inside an array of the region around it."""
    row, column = inner[0] - outer[0], inner[1] - outer[1]
    return slice(row, row + inner[2]), slice(column, column + inner[3])


def edges_of(asked: Region, kept: Region, white_block: int) -> Edges:
    """Edges of the blocks of the asked region that lie in the kept one, counted from its corner."""
    inside = window_of(asked, kept)
    return tuple(edges_between(asked[2 + axis], white_block, inside[axis].start, inside[axis].stop) for axis in (0, 1))
