"""The section of a painting's page on shape: normals, their uncertainty, height, and their errors against a truth."""

from typing import Any

import numpy as np

from nishiki.photometric import flags as bits
from nishiki.report.colour_map import heat, sea
from nishiki.report.numbers import figure
from nishiki.report.page import Block, Figure, Figures, Section, Table
from nishiki.report.pictures import (
    Ruler,
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
ROWS_AGAINST_TRUTH = {
    "estimated": "with an estimate",
    "unflagged": "of these without a flag",
    "flagged": "of these with a flag",
    "inside": "whole object, pixels without estimate as flat",
}
NORMALS = (
    "OpenGL convention: red to the right, green upwards, blue towards the camera. A flat surface is even lilac-blue; "
    "blotches of colour that follow the paint instead of the relief would be an error."
)
RELIEF = "the integrated height under a slanting lamp from the upper left; slopes are scaled to be seen."
HEIGHT = (
    "integrated from the normals; level and tilt are free, long waves are the least certain. Pieces that nothing "
    "connects stand each at its own level: how one lies above the other is not known."
)
CALIBRATED = (
    "root mean square angle, from the fit's residuals, from slopes around it that no surface has, and from the tilt; "
    "calibrated on other captures with truth."
)
FORMAL = "one standard deviation, from the residuals of each pixel's fit. It knows of noise, not of a wrong model."
LIGHTS_OF_REFINED = (
    "how many lights the joint fit of normals and gloss believes at each pixel (with more than half of their weight). "
    "It models highlights instead of leaving them out, so that the selection of diffuse lights does not limit it. "
    "Fewer than three give no normal."
)
LIGHTS = (
    "how many lights showed plain diffuse reflection at each pixel. Few lights at highlights and in hollows are right; "
    "fewer than three give no normal."
)


def shape_section(
    normals,
    *,
    widest: int,
    height=None,
    pitch: float | None = None,
    evaluated=None,
    mask: np.ndarray | None = None,
    evaluation: dict[str, Any] | None = None,
    refined: bool = False,
    ruler: Ruler | None = None,
) -> Section:
    """normals, height, evaluated : `Maps` of those stages or None; pitch : of a pixel, mm; evaluation :
    evaluation.json; refined : whether normals and gloss were fitted together."""
    shape = tuple(normals.group["normals"].shape[:2])
    block = block_of(shape[1], widest)
    known = shrink(lambda rows: _known(normals, rows, mask), shape, block) > 0

    def small(name: str, maps=normals) -> np.ndarray:
        values = shrink(lambda rows: maps.read(name, rows), shape, block)
        values[~known] = np.nan
        return values

    calibrated = height is not None and "expected_error" in height
    sigma = np.degrees(small("expected_error", height) if calibrated else small("sigma"))
    error = small("angular_error", evaluated) if evaluated is not None and "angular_error" in evaluated else None
    # one scale for both, so that expected and true errors can be compared
    ends = [np.nanpercentile(v, 98) for v in (sigma, error) if v is not None and np.isfinite(v).any()]
    end = float(max(ends, default=1))
    items = [Figure("Normals", NORMALS, normal_picture(small("normals")), ruler=ruler)]
    if height is not None:
        items += _height(height, shape, block, known, pitch, ruler)
    expected = scalar_picture(sigma, heat(), unit="degrees", low=0.0, high=end)
    items.append(Figure("Expected error of the normals", CALIBRATED if calibrated else FORMAL, expected))
    if error is not None:
        picture = scalar_picture(error, heat(), unit="degrees", low=0.0, high=end)
        items.append(Figure("Angle to the true normals", "compare with the expected error beside it.", picture))
    lights = scalar_picture(small("lights_used"), sea(), unit="lights", digits=3)
    items.append(Figure("Lights used", LIGHTS_OF_REFINED if refined else LIGHTS, lights))
    key = {k: (colour, text) for k, (_, colour, text) in enumerate(CLASSES)}
    flags = class_picture(_flags(normals, shape, block, mask), key)
    items.append(Figure("Flags", "where an estimate is missing or weak.", flags))
    return Section("shape", "Shape", [Figures(items), *_against_truth(evaluation or {})])


def _against_truth(evaluation: dict[str, Any]) -> list[Block]:
    blocks: list[Block] = []
    if angles := evaluation.get("normals"):
        parts = [(label, angles[name]) for name, label in ROWS_AGAINST_TRUTH.items()]
        for part in angles["by_slope"]:
            if part["count"]:
                parts.append((f"true slope {part['from_deg']:g}° to {part['to_deg']:g}°", part))
        rows = [(label, part["mean"], part["median"], part["p90"], part["count"]) for label, part in parts]
        head = ("Pixels", "mean", "median", "90 %", "number")
        blocks.append(Table(head, rows, "lrrrr", "Angle between estimated and true normals, degrees."))
    if (height := evaluation.get("height")) and height["rms"] is not None:
        rms, p90, relief = (figure(1000 * height[name], 3, "µm") for name in ("rms", "p90", "relief_rms"))
        blocks.append(
            f"Height against truth, less a plane: rms {rms}, 90th percentile {p90}; the relief itself has an rms of "
            f"{relief}."
        )
    return blocks


def _known(normals, rows: slice, mask: np.ndarray | None) -> np.ndarray:
    has = (normals.read("flags", rows) & bits.NO_ESTIMATE) == 0
    return (has if mask is None else has & mask[rows]).astype(np.float32)


def _flags(normals, shape: tuple[int, int], block: int, mask: np.ndarray | None) -> np.ndarray:
    """The gravest class of each block of pixels; NaN outside the mask."""
    classes = shrink(lambda rows: _classes(normals.read("flags", rows)), shape, block, worst=True)
    if mask is None:
        return classes
    inside = shrink(lambda rows: mask[rows].astype(np.float32), shape, block) > 0
    return np.where(inside, classes, np.nan)


def _classes(flags: np.ndarray) -> np.ndarray:
    classes = np.zeros(flags.shape, np.float32)
    for rank, (bit, _, _) in enumerate(CLASSES):
        if bit:
            classes[(flags & bit) != 0] = rank
    return classes


def _height(height, shape, block: int, known: np.ndarray, pitch: float | None, ruler: Ruler | None) -> list[Figure]:
    unit = height.attributes("height").get("unit", "")
    values = shrink(lambda rows: height.read("height", rows), shape, block).astype(np.float64)
    values[~known] = np.nan
    step = (pitch or 1.0) * block if unit == "mm" else float(block)
    flat = values - np.nanmin(values) if np.isfinite(values).any() else values
    relief = np.repeat(hillshade(values, step=step)[..., None], 3, axis=-1)
    return [
        Figure("Relief", RELIEF, colour_picture(relief), ruler=ruler),
        Figure("Height", HEIGHT, scalar_picture(flat, sea(), unit=unit, low=0.0), ruler=ruler),
    ]
