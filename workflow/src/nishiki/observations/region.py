"""The part of the photographs that is kept: the region of interest, in it the object's mask and its bounding box."""

from __future__ import annotations

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.formats.images import Region
from nishiki.formats.masks import Mask, examine_mask, expect_size, label_problems, read_labels
from nishiki.formats.problems import Problem, refuse
from nishiki.observations.blocks import Edges, blocks_around, edges_between

MANY_REGIONS = 256
MARGIN = 8
"""Least number of pixels that are kept around the object, where the photograph has them: pictures want a rim."""


def region_of(capture: Capture, rows: int, columns: int) -> Region:
    """The region of interest, the whole picture if none; CaptureError (region-outside) if it leaves the picture."""
    region = capture.settings.region_of_interest or (0, 0, rows, columns)
    row, column, height, width = region
    if height < 1 or width < 1 or row + height > rows or column + width > columns:
        what = "region_of_interest leaves the picture or is empty"
        expected = f"within {rows} rows and {columns} columns"
        refuse("region-outside", "capture.yaml", what, expected=expected, found=", ".join(map(str, region)))
    return region


def object_mask(capture: Capture, size: tuple[int, int], region: Region) -> Mask:
    """Read the mask of the object within a region, all of it without a mask file.

    CaptureError: mask-size unless it has the photographs' size (rows, columns), mask-empty, those of reading pictures.
    """
    if capture.mask is None:
        return Mask(np.ones(region[2:], bool), ())
    name = capture.settings.mask
    mask = examine_mask(capture.mask, name=name)
    expect_size(mask.inside, size, name, "mask")
    row, column, rows, columns = region
    inside = mask.inside[row : row + rows, column : column + columns]
    if not inside.any():
        remedy = "Light pixels mark the object; check the mask and the region of interest"
        refuse("mask-empty", name, "mask has no pixels", remedy=remedy)
    return Mask(inside, mask.problems)


def region_numbers(
    capture: Capture, size: tuple[int, int], region: Region
) -> tuple[np.ndarray | None, tuple[Problem, ...]]:
    """Number of the region of each pixel (rows, columns) uint8, from 0 in the order of the labels, and warnings.

    None without a label picture. CaptureError: regions-size, regions-many, those of `read_labels`.
    """
    if capture.regions is None:
        return None, ()
    name = capture.settings.regions
    full_labels = read_labels(capture.regions, name=name)
    expect_size(full_labels, size, name, "regions")
    row, column, rows, columns = region
    labels, index = np.unique(full_labels[row : row + rows, column : column + columns], return_inverse=True)
    if len(labels) > MANY_REGIONS:
        remedy = "Join regions of the same material: each gets its own reflection parameters"
        found, expected = f"{len(labels)} labels", f"at most {MANY_REGIONS}"
        refuse("regions-many", name, "regions", expected=expected, found=found, remedy=remedy)
    return index.reshape(rows, columns).astype(np.uint8), tuple(label_problems(full_labels, name))


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
