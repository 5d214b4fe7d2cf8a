"""Check a goniometer's data: sizes, saturation, boards and regions of photographs; energy and symmetry of tables."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.errors import require
from nishiki.formats.images import Region
from nishiki.formats.masks import label_problems, read_labels
from nishiki.formats.problems import CaptureError, Problem, error, name_some, refuse, warning
from nishiki.goniometry.directions import unit
from nishiki.goniometry.hemisphere import FEWEST_PAIRS, forward_shine, reciprocity, turned_views, typical_albedo
from nishiki.observations.blocks import CHECK_BLOCK, picture_edges
from nishiki.observations.frames import FrameReader
from nishiki.observations.reference import DarkField, measure_darks
from nishiki.observations.store_parts import Tick, examine_frames

DARK_WHITE = 0.005  # of full scale: below it the board's quantisation alone is worth a percent


def windowed(reader: FrameReader[GoniometerCapture], capture: GoniometerCapture) -> FrameReader[GoniometerCapture]:
    """Restrict the reader to the central window of crop_px; where there are regions it reads whole photographs."""
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
    name = require(block.regions)
    labels = read_labels(capture.regions, name=name)
    if block.regions_pitch_mm is None and labels.shape != size:
        expected, found = f"{size[0]} x {size[1]} as the frames", f"{labels.shape[0]} x {labels.shape[1]}"
        remedy = "Make it from a photograph along the normal, or give regions_pitch_mm and pixel_pitch_mm"
        what = "size of the regions"
        refuse("regions-size", name, what, expected=expected, found=found, remedy=remedy)
    present = set(np.unique(labels).tolist()) - {0}
    if not present:
        refuse("regions-empty", name, "no pixel has a label", remedy="Labels count from 1")
    lost = [f"{label} ({region})" for region, label in block.region_names.items() if label not in present]
    if lost:
        found = ", ".join(lost)
        what, remedy = "a region that is named has no pixel", "Correct the label picture or goniometer.region_names"
        refuse("regions-name", name, what, found=found, remedy=remedy)
    return labels


def code_problems(frame: Frame, codes: np.ndarray, reader: FrameReader) -> list[Problem]:
    """List the problems of one frame's codes. CaptureError: bits-exceeded, not-finite in the whole window."""
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


def white_level(frame: Frame, codes: np.ndarray, reader: FrameReader[GoniometerCapture], darks: DarkField) -> float:
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


DISAGREE = 0.2  # sound tables gave at most .13, simulated cloths .06, wrong ones .35 and more
AGREE = 1 / 3  # of the disagreement is left by the reading that is right
MOST_ALBEDO = 1.1  # some room for the gaps between the views
FORWARD = 0.3  # correlation with the half vector; sound surfaces gave .67 to 1, turned by half a turn at most .26
BACKWARD = 0.4  # by which the correlation with the half vector grows where the views are turned by half a turn


def look_at_windows(capture: GoniometerCapture, size: tuple[int, int], contents: bool, tick: Tick) -> list[Problem]:
    """Compare regions with the frames' size; with `contents`, decode every photograph."""
    problems: list[Problem] = []
    try:
        labels = region_labels(capture, size)
        problems += label_problems(labels, require(capture.settings.goniometer.regions)) if labels is not None else []
    except CaptureError as e:
        problems += e.problems
    return problems + (_content_problems(capture, tick) if contents else [])


def _content_problems(capture: GoniometerCapture, tick: Tick) -> list[Problem]:
    """Find what only decoding shows; every photograph is decoded once."""
    try:
        reader = windowed(FrameReader.of(capture, "all", prove=False), capture)  # the whole seal is verified apart
        edges = picture_edges(reader.region[2:], CHECK_BLOCK)
        darks = measure_darks(reader, edges, tick)
    except CaptureError as e:
        return list(e.problems)
    hot: list[str] = []

    def look(frame: Frame, decode: Callable[[], np.ndarray]) -> list[Problem]:
        codes = decode()
        problems = code_problems(frame, codes, reader)
        if frame.role == "white":
            white_level(frame, codes, reader, darks)
        elif (codes >= reader.saturated).any():
            hot.append(frame.file)
        return problems

    found = examine_frames(reader, [frame for frame in capture.frames if frame.role != "dark"], look, tick)
    return [*reader.warnings(), *darks.problems, *found, *hot_problems(hot, len(capture.observed))]


def table_problems(capture: GoniometerCapture) -> list[Problem]:
    """Whether a table's values can be those of a surface: energy, reciprocity, the side on which it shines.

    A reading that makes the reciprocal pairs agree is an error's remedy. Once goniometer.values or azimuths is given,
    what the table says stands, and a violation is a warning.
    """
    block, table, file = capture.settings.goniometer, require(capture.table), capture.settings.goniometer.table or ""
    rows = (np.isfinite(table.values) & (table.values > 0)).all(axis=1)
    light, view = (unit(*np.radians(each[rows]).T) for each in (table.incident_deg, table.outgoing_deg))
    values, given = table.values[rows], block.model_fields_set & {"values", "azimuths"}
    tell = warning if given else error
    symmetry = "quarter" if block.symmetry == "unknown" else block.symmetry
    problems = []
    albedo = typical_albedo(light, view, values, symmetry)
    if albedo is not None and albedo > MOST_ALBEDO:
        factor, option = (
            (np.pi, "radiance_factor") if albedo <= np.pi * MOST_ALBEDO else (100 * np.pi, "radiance_factor_percent")
        )
        what, expected = "the surface would send back more light than it gets", f"a share of at most {MOST_ALBEDO:g}"
        remedy = _remedy("values", option) if albedo / factor <= MOST_ALBEDO else "Give the BRDF, in 1/sr"
        problems.append(tell("reflectance-energy", file, what, expected=expected, found=f"{albedo:.3g}", remedy=remedy))
    apart, pairs = reciprocity(light, view, values, symmetry)
    shine = forward_shine(light, view, values)
    mirrored = turned_views(light, view, np.pi)
    if apart is not None and pairs >= FEWEST_PAIRS and apart > DISAGREE:
        readings = {
            ("values", "brdf_cos_view"): (view, values / view[:, 2:]),
            ("values", "brdf_cos_light"): (view, values / light[:, 2:]),
            ("azimuths", "mirror"): (mirrored, values),
            ("azimuths", "lamp"): (turned_views(light, view, 0.0), values),
        }
        left = {key: reciprocity(light, *reading, symmetry) for key, reading in readings.items()}
        fitting = [key for key, (rest, count) in left.items() if count >= FEWEST_PAIRS and rest < AGREE * apart]
        # both azimuths make symmetric pairs agree: surfaces shine away from the lamp
        fitting.sort(key=lambda key: -(forward_shine(light, *readings[key]) or 0.0))
        what, expected = "light and view exchanged give other values", f"pairs that agree within {DISAGREE:.0%}"
        found = f"{pairs} pairs {np.expm1(apart):.0%} apart"
        if fitting:
            key, option = min(fitting, key=lambda key: (key[0] != "values", fitting.index(key)))
            found += f", {np.expm1(left[key, option][0] or 0.0):.1%} with {key} {option}"
            problems.append(
                tell("reciprocity", file, what, expected=expected, found=found, remedy=_remedy(key, option))
            )
        # where two mirror planes are only assumed, pairs without mirror images have to disagree as well
        elif block.symmetry != "unknown" or (reciprocity(light, view, values, "none")[0] or 0.0) > DISAGREE:
            remedy = "Check what the columns hold, and from where the angles are counted"
            problems.append(warning("reciprocity", file, what, expected=expected, found=found, remedy=remedy))
    elif shine is not None and shine < FORWARD and (forward_shine(light, mirrored, values) or 0.0) > shine + BACKWARD:
        what = "the surface would shine towards the lamp, not away from it"
        remedy = f"If it does not: {_remedy('azimuths', 'mirror')}"
        problems.append(warning("shine-backward", file, what, found=f"correlation {shine:.2f}", remedy=remedy))
    return problems


def _remedy(key: str, option: str) -> str:
    now = "brdf" if key == "values" else "cloth"
    return f"Convert the table with --{key} {option} (or set goniometer.{key}); with --{key} {now} if it is right"
