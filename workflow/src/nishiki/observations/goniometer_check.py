"""What only looking at a goniometer's data shows: photographs' sizes, damage, saturation, boards and regions; whether a
table's values can be those of a surface."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.formats.masks import label_problems
from nishiki.formats.problems import CaptureError, Problem, error, warning
from nishiki.goniometry.coverage import FEWEST_PAIRS, forward_shine, reciprocity, turned_views, typical_albedo
from nishiki.goniometry.directions import unit
from nishiki.observations.blocks import block_edges
from nishiki.observations.frames import FrameReader
from nishiki.observations.goniometer_frames import code_problems, hot_problems, region_labels, white_level, windowed
from nishiki.observations.reference import DarkField, measure_darks
from nishiki.observations.store_parts import RepeatedFiles, as_errors

CHECK_BLOCK = 16
Tick = Callable[[str], None]
DISAGREE = 0.2  # sound tables gave at most .13, simulated cloths .06, wrong ones .35 and more
AGREE = 1 / 3  # of the disagreement is left by the reading that is right
MOST_ALBEDO = 1.1  # some room for the gaps between the views
FORWARD = 0.3  # correlation with the half vector; sound surfaces gave .67 to 1, turned by half a turn at most .26
BACKWARD = 0.4  # by which the correlation with the half vector grows where the views are turned by half a turn


def goniometer_files(capture: GoniometerCapture) -> set[str]:
    """Every file that the capture's tables name."""
    settings = capture.settings
    named = ["capture.yaml", "" if capture.table else "frames.csv", settings.camera.sensitivities, settings.illuminant]
    named += [*(file for _, file in settings.goniometer.files), *(f.file for f in capture.frames)]
    return {Path(name).as_posix() for name in named if name}


def look_at_windows(capture: GoniometerCapture, size: tuple[int, int], contents: bool, tick: Tick) -> list[Problem]:
    """Compare regions with the frames' size; with `contents`, decode every photograph."""
    problems: list[Problem] = []
    try:
        labels = region_labels(capture, size)
        problems += label_problems(labels, capture.settings.goniometer.regions) if labels is not None else []
    except CaptureError as e:
        problems += e.problems
    return problems + (_content_problems(capture, tick) if contents else [])


def _content_problems(capture: GoniometerCapture, tick: Tick) -> list[Problem]:
    """What only decoding shows; every photograph is decoded once."""
    try:
        reader = windowed(FrameReader.of(capture, "all", prove=False), capture)  # the whole seal is verified apart
        edges = tuple(block_edges(n, CHECK_BLOCK) for n in reader.region[2:])
        darks = measure_darks(reader, edges, tick)
    except CaptureError as e:
        return list(e.problems)
    problems = list(darks.problems)
    repeated = RepeatedFiles()
    hot: list[str] = []
    for frame in capture.frames:
        if frame.role == "dark":
            continue
        problems += repeated.add(frame)
        problems += _frame_problems(reader, frame, darks, hot)
        tick(frame.file)
    return reader.warnings() + problems + hot_problems(hot, len(capture.observed))


def _frame_problems(reader: FrameReader, frame: Frame, darks: DarkField, hot: list[str]) -> list[Problem]:
    try:
        codes = reader.read(frame)
        problems = code_problems(frame, codes, reader)
        if frame.role == "white":
            white_level(frame, codes, reader, darks)
        elif (codes >= reader.saturated).any():
            hot.append(frame.file)
    except CaptureError as e:
        return list(e.problems)
    return as_errors(problems)


def table_problems(capture: GoniometerCapture) -> list[Problem]:
    """Whether a table's values can be those of a surface: energy, reciprocity, the side on which it shines.

    A reading that makes the reciprocal pairs agree is an error's remedy. Once goniometer.values or azimuths is given,
    what the table says stands, and a violation is a warning.
    """
    block, table = capture.settings.goniometer, capture.table
    rows = (np.isfinite(table.values) & (table.values > 0)).all(axis=1)
    light, view = (unit(*np.radians(each[rows]).T) for each in (table.incident_deg, table.outgoing_deg))
    values, given = table.values[rows], block.model_fields_set & {"values", "azimuths"}
    tell = warning if given else error
    problems = []
    albedo = typical_albedo(light, view, values, block.symmetry)
    if albedo is not None and albedo > MOST_ALBEDO:
        factor, option = (
            (np.pi, "radiance_factor") if albedo <= np.pi * MOST_ALBEDO else (100 * np.pi, "radiance_factor_percent")
        )
        what, expected = "the surface would send back more light than it gets", f"a share of at most {MOST_ALBEDO:g}"
        remedy = _remedy("values", option) if albedo / factor <= MOST_ALBEDO else "Give the BRDF, in 1/sr"
        problems.append(
            tell("reflectance-energy", block.table, what, expected=expected, found=f"{albedo:.3g}", remedy=remedy)
        )
    apart, pairs = reciprocity(light, view, values, block.symmetry)
    shine = forward_shine(light, view, values)
    mirrored = turned_views(light, view, np.pi)
    if apart is not None and pairs >= FEWEST_PAIRS and apart > DISAGREE:
        readings = {
            ("values", "brdf_cos_view"): (view, values / view[:, 2:]),
            ("values", "brdf_cos_light"): (view, values / light[:, 2:]),
            ("azimuths", "mirror"): (mirrored, values),
            ("azimuths", "lamp"): (turned_views(light, view, 0.0), values),
        }
        left = {key: reciprocity(light, *reading, block.symmetry) for key, reading in readings.items()}
        fitting = [key for key, (rest, count) in left.items() if count >= FEWEST_PAIRS and rest < AGREE * apart]
        # both azimuths make symmetric pairs agree: surfaces shine away from the lamp
        fitting.sort(key=lambda key: -(forward_shine(light, *readings[key]) or 0.0))
        what, expected = "light and view exchanged give other values", f"pairs that agree within {DISAGREE:.0%}"
        found = f"{pairs} pairs {np.expm1(apart):.0%} apart"
        if fitting:
            key, option = min(fitting, key=lambda key: (key[0] != "values", fitting.index(key)))
            found += f", {np.expm1(left[key, option][0]):.1%} with {key} {option}"
            problems.append(
                tell("reciprocity", block.table, what, expected=expected, found=found, remedy=_remedy(key, option))
            )
        else:
            remedy = "Check what the columns hold, and from where the angles are counted"
            problems.append(warning("reciprocity", block.table, what, expected=expected, found=found, remedy=remedy))
    elif shine is not None and shine < FORWARD and (forward_shine(light, mirrored, values) or 0.0) > shine + BACKWARD:
        what = "the surface would shine towards the lamp, not away from it"
        remedy = f"If it does not: {_remedy('azimuths', 'mirror')}"
        problems.append(warning("shine-backward", block.table, what, found=f"correlation {shine:.2f}", remedy=remedy))
    return problems


def _remedy(key: str, option: str) -> str:
    now = "brdf" if key == "values" else "cloth"
    return f"Convert the table with --{key} {option} (or set goniometer.{key}); with --{key} {now} if it is right"
