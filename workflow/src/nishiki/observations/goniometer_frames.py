"""The window that is kept of a goniometer's photographs, its regions, and what the codes say by themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.formats.images import Region
from nishiki.formats.masks import read_labels
from nishiki.formats.problems import Problem, name_some, refuse, warning
from nishiki.observations.frames import FrameReader
from nishiki.observations.reference import DarkField

DARK_WHITE = 0.005  # of full scale: below it the board's quantisation alone is worth a percent


def windowed(reader: FrameReader, capture: GoniometerCapture) -> FrameReader:
    """The reader of the central window of crop_px, or of whole photographs where there are regions."""
    side = max(reader.rows, reader.columns) if capture.regions else capture.settings.goniometer.crop_px
    return replace(reader, region=central((reader.rows, reader.columns), side))


def central(size: tuple[int, int], side: int) -> Region:
    """Row, column, rows and columns of the square of this side, or less where the picture is smaller, in its middle."""
    rows, columns = (min(n, side) for n in size)
    return (size[0] - rows) // 2, (size[1] - columns) // 2, rows, columns


def region_labels(capture: GoniometerCapture, size: tuple[int, int]) -> np.ndarray | None:
    """Label picture (rows, columns) uint16, or None. CaptureError: regions-size, regions-empty, regions-name."""
    if capture.regions is None:
        return None
    block = capture.settings.goniometer
    labels = read_labels(capture.regions, name=block.regions)
    if block.regions_pitch_mm is None and labels.shape != size:
        expected, found = f"{size[0]} x {size[1]} as the frames", f"{labels.shape[0]} x {labels.shape[1]}"
        remedy = "Make it from a photograph along the normal, or give regions_pitch_mm and pixel_pitch_mm"
        what = "size of the regions"
        refuse("regions-size", block.regions, what, expected=expected, found=found, remedy=remedy)
    present = set(np.unique(labels).tolist()) - {0}
    if not present:
        refuse("regions-empty", block.regions, "no pixel has a label", remedy="Labels count from 1")
    lost = [f"{label} ({name})" for name, label in block.region_names.items() if label not in present]
    if lost:
        found = ", ".join(lost)
        what, remedy = "a region that is named has no pixel", "Correct the label picture or goniometer.region_names"
        refuse("regions-name", block.regions, what, found=found, remedy=remedy)
    return labels


def code_problems(frame: Frame, codes: np.ndarray, reader: FrameReader) -> list[Problem]:
    """What the codes of one frame say by themselves. CaptureError: bits-exceeded, not-finite in the whole window."""
    if reader.dtype.kind == "u":
        reader.see(frame, float(codes.max()))
        return []
    broken = int((~np.isfinite(codes)).any(axis=2).sum())
    if broken == codes.shape[0] * codes.shape[1]:
        refuse("not-finite", frame.file, "no sample is finite", remedy="Write the file again")
    what = "NaN or infinite samples are not used"
    return [warning("not-finite", frame.file, what, found=f"{broken} pixels")] if broken else []


def hot_problems(files: list[str], count: int) -> list[Problem]:
    """some-saturated where photographs of the cloth, of so many, have saturated pixels."""
    if not files:
        return []
    what, found = "photographs of the cloth have saturated pixels", f"{len(files)} of {count}: {name_some(files)}"
    remedy = "Photograph them again with a shorter exposure_s beside the longer"
    return [warning("some-saturated", "frames.csv", what, found=found, remedy=remedy)]


def white_level(frame: Frame, codes: np.ndarray, reader: FrameReader, darks: DarkField) -> float:
    """Mean of the board, worst channel, as a fraction of full scale. CaptureError: white-saturated, white-dark."""
    side = reader.capture.settings.goniometer.crop_px
    row, column, rows, columns = central(codes.shape[:2], side)
    middle = codes[row : row + rows, column : column + columns]
    hot = float((middle >= reader.saturated).any(axis=2).mean())
    if hot > 0.01:
        what = "the white board is saturated"
        found = f"{100 * hot:.1f} % of the window"
        remedy = "Expose the board less"
        refuse("white-saturated", frame.file, what, found=found, remedy=remedy)
    linear = (reader.table[middle] if reader.dtype.kind == "u" else middle).astype(np.float64)
    level = np.nanmean(np.where(np.isfinite(linear), linear, np.nan), axis=(0, 1))
    level = level - darks.at(frame.exposure_s).mean(axis=(0, 1))
    least = float(level.min())
    if not least > (DARK_WHITE if reader.dtype.kind == "u" else 0.0):
        what, found = "the white board is too dark", f"{100 * least:.2f} % of full scale"
        expected, remedy = f"above {100 * DARK_WHITE:g} %", "Expose the board longer, or check the dark frames"
        refuse("white-dark", frame.file, what, expected=expected, found=found, remedy=remedy)
    return least
