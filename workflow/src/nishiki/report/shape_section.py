"""The part of the page on shape: normals, their uncertainty, height, and their errors where truth is known."""

from typing import Any

import numpy as np

from nishiki.photometric import flags as bits
from nishiki.report.colour_map import heat, sea
from nishiki.report.pictures import (
    block_of,
    class_picture,
    colour_picture,
    hillshade,
    normal_picture,
    scalar_picture,
    shrink,
)

# From harmless to grave: later ones win where a block of pixels has several.
CLASSES = (
    (0, "#b9d1b3", "no flag"),
    (bits.FALLBACK, "#cfc08a", "simple estimate stands"),
    (bits.NO_REDUNDANCY, "#e3b04b", "as many lights as unknowns"),
    (bits.ILL_CONDITIONED | bits.FACES_AWAY, "#d9772f", "ill-conditioned, or faces away"),
    (bits.NO_ESTIMATE, "#9c2a2a", "no estimate"),
)


def shape_section(
    normals, *, widest: int, height=None, pitch: float | None = None, evaluated=None, mask: np.ndarray | None = None
) -> dict[str, Any]:
    """Content of the section. normals, height, evaluated : `Maps` of those stages or None; pitch : of a pixel, mm."""
    shape = tuple(normals.group["normals"].shape[:2])
    block = block_of(shape[1], widest)
    known = shrink(lambda rows: _known(normals, rows, mask), shape, block) > 0

    def small(name: str, maps=normals) -> np.ndarray:
        values = shrink(lambda rows: maps.read(name, rows), shape, block)
        values[~known] = np.nan
        return values

    classes = shrink(lambda rows: _classes(normals.read("flags", rows)), shape, block, worst=True)
    if mask is not None:
        inside = shrink(lambda rows: mask[rows].astype(np.float32), shape, block) > 0
        classes = np.where(inside, classes, np.nan)
    calibrated = height is not None and "expected_error" in height
    sigma = np.degrees(small("expected_error", height) if calibrated else small("sigma"))
    error = small("angular_error", evaluated) if evaluated is not None and "angular_error" in evaluated else None
    # one scale for both, so that expected and true errors can be compared
    end = max(
        (float(np.nanpercentile(v, 98)) for v in (sigma, error) if v is not None and np.isfinite(v).any()), default=1
    )
    content = {
        "normals": normal_picture(small("normals")),
        "sigma": scalar_picture(sigma, heat(), unit="degrees", low=0.0, high=end),
        "calibrated": calibrated,
        "lights_used": scalar_picture(small("lights_used"), sea(), unit="lights", digits=3),
        "flags": class_picture(classes, {k: (colour, text) for k, (_, colour, text) in enumerate(CLASSES)}),
        "relief": None,
        "height": None,
        "angular_error": None if error is None else scalar_picture(error, heat(), unit="degrees", low=0.0, high=end),
    }
    if height is not None:
        content |= _height(height, shape, block, known, pitch)
    return content


def _known(normals, rows: slice, mask: np.ndarray | None) -> np.ndarray:
    has = (normals.read("flags", rows) & bits.NO_ESTIMATE) == 0
    return (has if mask is None else has & mask[rows]).astype(np.float32)


def _classes(flags: np.ndarray) -> np.ndarray:
    found = np.zeros(flags.shape, np.float32)
    for rank, (bit, _, _) in enumerate(CLASSES):
        if bit:
            found[(flags & bit) != 0] = rank
    return found


def _height(height, shape, block: int, known: np.ndarray, pitch: float | None) -> dict[str, Any]:
    unit = height.attributes("height").get("unit", "")
    values = shrink(lambda rows: height.read("height", rows), shape, block).astype(np.float64)
    values[~known] = np.nan
    step = (pitch or 1.0) * block if unit == "mm" else float(block)
    flat = values - np.nanmin(values) if np.isfinite(values).any() else values
    relief = np.repeat(hillshade(values, step=step)[..., None], 3, axis=-1)
    return {"relief": colour_picture(relief), "height": scalar_picture(flat, sea(), unit=unit, low=0.0)}
