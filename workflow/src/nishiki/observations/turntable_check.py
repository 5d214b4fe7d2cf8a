"""What only opening the photographs of a turntable shows: sizes, damage, saturation, silhouettes, white boards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.capture.turntable import TurntableCapture
from nishiki.formats.masks import read_mask
from nishiki.formats.problems import CaptureError, Problem, warning
from nishiki.observations.blocks import block_edges
from nishiki.observations.frames import FrameReader
from nishiki.observations.plane_decode import count_unusable
from nishiki.observations.polariser_check import PolariserLevels
from nishiki.observations.reference import measure_darks
from nishiki.observations.store_parts import RepeatedFiles, as_errors
from nishiki.observations.turntable_coherence import Pictures, capture_problems
from nishiki.observations.views_store import read_silhouette, view_problems
from nishiki.observations.views_white import measure_whites

CHECK_BLOCK = 16
Tick = Callable[[str], None]


def listed_files(capture: TurntableCapture) -> set[str]:
    """Every file that the capture's tables name."""
    settings = capture.settings
    named = [settings.lights.file if settings.lights else None, settings.camera.sensitivities, settings.illuminant]
    named += [file for _, file in settings.turntable.files]
    named += [name for frame in capture.frames for name in (frame.file, frame.silhouette)]
    return {Path(name).as_posix() for name in (*named, "capture.yaml", "frames.csv") if name}


def silhouette_problems(capture: TurntableCapture, size: tuple[int, int]) -> list[Problem]:
    """Silhouettes: readable, of the frames' size, not empty, not the whole picture, in agreement with the cameras."""
    problems: list[Problem] = []
    given: dict[str, np.ndarray] = {}
    for view in capture.views:
        frame = capture.silhouette_of(view)
        if frame is None:
            continue
        try:
            outline = read_silhouette(frame, size)
            given[view] = outline.inside
            problems += outline.problems
            if outline.inside.all():
                what, remedy = "silhouette covers the whole picture", "Light pixels mark the object, dark ones all else"
                problems.append(warning("silhouette-full", frame.silhouette, what, remedy=remedy))
        except CaptureError as e:
            problems += e.problems
    return problems + capture_problems(capture, given, *size)


def turntable_content_problems(capture: TurntableCapture, tick: Tick) -> list[Problem]:
    """What only decoding shows; every photograph is decoded once."""
    try:
        reader = FrameReader.of(capture, "all", prove=False)  # the whole seal is verified apart
    except CaptureError as e:
        return list(e.problems)
    problems = _reference_problems(reader, tick)
    repeated, pictures, levels = RepeatedFiles(), Pictures(capture), PolariserLevels(reader)
    for frame in capture.frames:
        if frame.role != "dark":
            problems += repeated.add(frame)
        if frame.role in ("sample", "board") or (frame.role == "white" and frame.polariser):
            problems += _frame_problems(reader, frame, pictures, levels)
            tick(frame.file)
    problems += levels.problems() + pictures.problems(reader.rows, reader.columns)
    return reader.warnings() + problems


def _reference_problems(reader: FrameReader, tick: Tick) -> list[Problem]:
    """Dark frames and normalising white boards."""
    edges = tuple(block_edges(n, CHECK_BLOCK) for n in (reader.rows, reader.columns))
    try:
        darks = measure_darks(reader, edges, tick)
        whites = measure_whites(reader, darks, edges, tick).problems if _complete(reader.capture) else ()
        return [*darks.problems, *whites]
    except CaptureError as e:
        return list(e.problems)


def _complete(capture: TurntableCapture) -> bool:
    """Whether white boards and exposures are there for every light, or none; if not, it is reported already."""
    lit = [f for f in capture.frames if f.role in ("sample", "white")]
    plain = {f.light for f in lit if f.role == "white" and not f.polariser}
    timed = sum(f.exposure is not None for f in lit)
    return timed in (0, len(lit)) and (not plain or plain >= set(capture.light_names))


def _frame_problems(reader: FrameReader, frame: Frame, pictures: Pictures, levels: PolariserLevels) -> list[Problem]:
    try:
        codes = reader.read(frame)
        if frame.role == "board":
            return []
        if frame.role == "sample":
            pictures.add(frame.view, codes, reader)
        named = reader.capture.silhouette_of(frame.view) if frame.role == "sample" else None
        inside = _outline(named, codes.shape[:2])
        levels.add(frame, codes, inside)
        *counts, highest = count_unusable(codes, inside, reader.saturated, reader.clip)
        problems = view_problems(frame, np.array(counts), float(highest), reader, outlined=named is not None)
    except CaptureError as e:
        return list(e.problems)
    return as_errors(problems)


def _outline(frame: Frame | None, size: tuple[int, int]) -> np.ndarray:
    """Silhouette (rows, columns) uint8; all ones where there is none that can be used (which is reported apart)."""
    try:
        outline = read_mask(frame.silhouette_path, name=frame.silhouette) if frame else None
    except CaptureError:
        outline = None
    return outline.astype(np.uint8) if outline is not None and outline.shape == size else np.ones(size, np.uint8)
