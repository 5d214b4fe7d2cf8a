"""What only opening the photographs of a goniometer shows: sizes, damage, saturation, white boards, regions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nishiki.capture.frames import Frame
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.seal import sha256_of
from nishiki.formats.masks import label_problems
from nishiki.formats.problems import CaptureError, Problem, error, warning
from nishiki.observations.blocks import block_edges
from nishiki.observations.frames import FrameReader
from nishiki.observations.goniometer_frames import code_problems, region_labels, white_level, windowed
from nishiki.observations.reference import DarkField, measure_darks

CHECK_BLOCK = 16
MOST_NAMED = 5  # saturated photographs that are named
Tick = Callable[[str], None]


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
    digests: dict[str, str] = {}
    hot: list[str] = []
    for frame in capture.frames:
        if frame.role == "dark":
            continue
        digest = sha256_of(frame.path)
        if digest in digests:
            what = f"is the same file as {digests[digest]}"
            problems.append(warning("image-repeated", frame.file, what, remedy="Check the names of the photographs"))
        digests.setdefault(digest, frame.file)
        problems += _frame_problems(reader, frame, darks, hot)
        tick(frame.file)
    if hot:
        what, more = "photographs of the cloth have saturated pixels", " ..." if len(hot) > MOST_NAMED else ""
        found = f"{len(hot)} of {len(capture.observed)}: {', '.join(hot[:MOST_NAMED])}{more}"
        remedy = "Photograph them again with a shorter exposure_s beside the longer"
        problems.append(warning("some-saturated", "frames.csv", what, found=found, remedy=remedy))
    return reader.warnings() + problems


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
    return [error(p.kind, p.file, p.what, found=p.found) if p.kind == "not-finite" else p for p in problems]
