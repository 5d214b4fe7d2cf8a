"""Everything wrong with a capture, in one pass."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from nishiki.capture.folder import Capture, examine
from nishiki.capture.frames import Frame
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.seal import payload_files, sha256_of, verify_seal
from nishiki.capture.turntable import TurntableCapture
from nishiki.formats.files import Refused, walk
from nishiki.formats.image_header import ImageHeader
from nishiki.formats.image_headers import read_header
from nishiki.formats.images import expect_channels, read_labels, read_mask
from nishiki.formats.problems import CaptureError, Problem, error, warning
from nishiki.formats.text_tables import refusal
from nishiki.observations.blocks import block_edges
from nishiki.observations.frames import FrameReader
from nishiki.observations.goniometer_check import goniometer_files, look_at_windows
from nishiki.observations.pairs_check import PairLevels
from nishiki.observations.plane_decode import count_unusable
from nishiki.observations.plane_store import frame_problems
from nishiki.observations.reference import DarkField, board_field, measure_darks
from nishiki.observations.region import region_of
from nishiki.observations.turntable_check import listed_files, silhouette_problems, turntable_content_problems

SAME_DIRECTION = np.cos(np.radians(0.1))
CHECK_BLOCK = 16


def check_capture(
    root: Path | str, *, level: Literal["quick", "full"] = "quick", progress: Callable[[str], None] | None = None
) -> list[Problem]:
    """All problems of a capture folder, errors first; an empty list means that nothing was found.

    quick: tables, headers of all photographs, mask. full: also decodes every photograph (damage, saturation, white
    boards, samples that are not finite) and compares every digest of a sealed capture.
    """
    root = Path(root)
    capture, problems = examine(root)
    problems = list(problems)
    if (root / "bagit.txt").is_file():
        problems += _attempt(lambda: verify_seal(root, digests=level == "full"))
    elif root.is_dir():
        problems += _attempt(lambda: _strange_entries(root))
    if capture is not None:
        problems += _unlisted(capture)
        headers = {}
        problems += _header_problems(capture, headers)
        looks = {"turntable": _look_round, "goniometer": look_at_windows}
        look = looks.get(capture.geometry, _look_at_plane)
        problems += look(capture, headers, level == "full", progress or (lambda file: None))
    distinct = list(dict.fromkeys(problems))
    return sorted(distinct, key=lambda p: p.severity != "error")


def _look_at_plane(capture: Capture, headers: dict, contents: bool, tick: Callable[[str], None]) -> list[Problem]:
    problems = _same_directions(capture) + _strength_problems(capture) + _mask_problems(capture, headers)
    return problems + (_content_problems(capture, tick) if contents else [])


def _look_round(capture: TurntableCapture, headers: dict, contents: bool, tick: Callable[[str], None]) -> list[Problem]:
    if not capture.frames_of("sample"):
        return []  # reported already; there is nothing to compare with
    problems = silhouette_problems(capture, headers)
    return problems + (turntable_content_problems(capture, tick) if contents else [])


def _strange_entries(root: Path) -> list[Problem]:
    """Links that lead out, pipes, devices and names that could not be sealed."""
    payload_files(root)
    return []


def _attempt(work: Callable[[], list[Problem]]) -> list[Problem]:
    try:
        return work()
    except CaptureError as e:
        return list(e.problems)
    except Refused as e:
        return [refusal(e, "file-refused")]


def _listed(capture: Capture | TurntableCapture | GoniometerCapture) -> set[str]:
    """Every file that the capture's tables name."""
    if capture.geometry == "goniometer":
        return goniometer_files(capture)
    if capture.geometry == "turntable":
        return listed_files(capture)
    settings = capture.settings
    named = [settings.lights.file, settings.lights.intensities, settings.camera.sensitivities, settings.illuminant]
    named += [
        settings.rendered_from,
        settings.mask,
        settings.regions,
        "capture.yaml",
        "frames.csv",
        *(f.file for f in capture.frames),
    ]
    if settings.rendered_from and "/" in settings.rendered_from:  # a folder of relight: info.json stands for its planes
        folder = Path(settings.rendered_from).parent
        named += [f"{folder.as_posix()}/{name}" for name, entry in walk(capture.payload / folder) if entry.is_file()]
    return {Path(name).as_posix() for name in named if name}


def _unlisted(capture: Capture | TurntableCapture | GoniometerCapture) -> list[Problem]:
    """Files in the payload that nothing names: harmless, but perhaps a forgotten photograph."""
    payload = capture.payload
    files = (name for name, entry in walk(payload) if entry.is_file())
    tag_files = {"bagit.txt", "bag-info.txt", "manifest-sha256.txt", "tagmanifest-sha256.txt"}
    remedy = "List it in frames.csv, or move it out of the capture"
    extra = sorted(set(files) - _listed(capture) - tag_files)
    return [warning("file-unlisted", name, "no table names this file", remedy=remedy) for name in extra]


def _same_directions(capture: Capture) -> list[Problem]:
    directions = capture.lights.directions
    cosines = np.triu(directions @ directions.T, 1)
    pairs = np.argwhere(cosines > SAME_DIRECTION)
    names = capture.lights.names
    what = "lights {} and {} have the same direction"
    file = capture.settings.lights.file
    return [warning("light-same", file, what.format(names[i], names[j])) for i, j in pairs]


def _strength_problems(capture: Capture) -> list[Problem]:
    if capture.frames_of("white") or capture.intensities is not None:
        return []
    what = (
        "neither white boards nor lights.intensities: every lamp is taken to shine alike, and evenly over the picture"
    )
    remedy = "Photograph a white board under every lamp; without, unequal lamps tilt the normals and tint the colours"
    return [warning("strengths-unknown", "capture.yaml", what, remedy=remedy)]


def _header_problems(
    capture: Capture | TurntableCapture | GoniometerCapture, headers: dict[str, ImageHeader]
) -> list[Problem]:
    """Sizes, depths and channels of all photographs against the first that can be read."""
    problems: list[Problem] = []
    for frame in capture.frames:
        try:
            header = read_header(frame.path, name=frame.file)
            headers[frame.file] = header
            expect_channels(header, capture.settings.camera.channels, frame.file)
        except CaptureError as e:
            problems += e.problems
    if not headers:
        return problems
    first = next((f.file for f in capture.observed if f.file in headers), next(iter(headers)))
    size, sample = (headers[first].rows, headers[first].columns), headers[first].sample
    for file, header in headers.items():
        if (header.rows, header.columns) != size:
            expected, found = f"{size[0]} x {size[1]} as {first}", f"{header.rows} x {header.columns}"
            what, remedy = (
                "size differs",
                "Develop all photographs alike, without rotation, or leave this one out",
            )
            problems.append(error("image-size", file, what, expected=expected, found=found, remedy=remedy))
        if header.sample != sample:
            expected = f"{sample} as {first}"
            what, found, remedy = "depth differs", header.sample, "Develop all photographs alike, or leave this one out"
            problems.append(error("image-depth", file, what, expected=expected, found=found, remedy=remedy))
    bits, held = capture.settings.camera.bits, {"uint8": 8, "uint16": 16}.get(sample, 16)
    if bits and bits > held:
        problems.append(
            error("bits-differ", "capture.yaml camera.bits", "bits", expected=f"at most {held}", found=f"{bits}")
        )
    return problems + _attempt(lambda: _region_problems(capture, size))


def _region_problems(capture: Capture, size: tuple[int, int]) -> list[Problem]:
    region_of(capture, *size)
    return []


def _mask_problems(capture: Capture, headers: dict[str, ImageHeader]) -> list[Problem]:
    """Mask and regions: readable, of the frames' size, not empty."""
    first = next((headers[f.file] for f in capture.observed if f.file in headers), None)
    if first is None:
        return []

    def compare(shape: tuple[int, int], name: str, kind: str) -> list[Problem]:
        if shape == (first.rows, first.columns):
            return []
        expected, found = f"{first.rows} x {first.columns} as the frames", f"{shape[0]} x {shape[1]}"
        return [error(f"{kind}-size", name, f"size of the {kind}", expected=expected, found=found)]

    def check_mask() -> list[Problem]:
        mask = read_mask(capture.mask, name=capture.settings.mask)
        sized = compare(mask.shape, capture.settings.mask, "mask")
        if not sized:
            row, column, rows, columns = region_of(capture, *mask.shape)
            mask = mask[row : row + rows, column : column + columns]
        remedy = "Non-zero pixels mark the object; check the mask and the region of interest"
        empty = [error("mask-empty", capture.settings.mask, "mask has no pixels", remedy=remedy)]
        return sized + ([] if mask.any() else empty)

    def check_regions() -> list[Problem]:
        labels = read_labels(capture.regions, name=capture.settings.regions)
        return compare(labels.shape, capture.settings.regions, "regions")

    problems = _attempt(check_mask) if capture.mask else []
    return problems + (_attempt(check_regions) if capture.regions else [])


def _content_problems(capture: Capture, tick: Callable[[str], None]) -> list[Problem]:
    """What only decoding shows."""
    try:
        reader = FrameReader.of(capture, "all", prove=False)  # the whole seal is verified apart
    except CaptureError as e:
        return list(e.problems)
    _, _, rows, columns = reader.region
    edges = block_edges(rows, CHECK_BLOCK), block_edges(columns, CHECK_BLOCK)
    darks, problems = _darks(reader, edges, tick)
    try:
        mask = read_mask(capture.mask, region=reader.region) if capture.mask else np.ones((rows, columns), bool)
    except CaptureError:
        mask = np.ones((rows, columns), bool)  # reported already
    usable = (
        mask.astype(np.uint8) if mask.shape == (rows, columns) and mask.any() else np.ones((rows, columns), np.uint8)
    )
    pairs, digests = PairLevels(reader, darks, usable), {}
    for frame in capture.frames:
        if frame.role == "dark":
            continue
        problems += _attempt(lambda frame=frame: _frame_content(reader, frame, usable, darks, edges, pairs))
        digest = sha256_of(frame.path)
        if digest in digests:
            what = f"is the same file as {digests[digest]}"
            problems.append(warning("image-repeated", frame.file, what, remedy="Check the names of the photographs"))
        digests.setdefault(digest, frame.file)
        tick(frame.file)
    return reader.warnings() + problems + pairs.problems()


def _darks(reader: FrameReader, edges: tuple, tick: Callable[[str], None]) -> tuple[DarkField, list[Problem]]:
    """The dark level, or a black level of 0 and the reason where dark frames cannot be read."""
    try:
        darks = measure_darks(reader, edges, tick)
        return darks, list(darks.problems)
    except CaptureError as e:
        level = np.zeros((1, 1, len(reader.names)), np.float32)
        return DarkField((None,), (level,), np.zeros(reader.region[2:], bool), ()), list(e.problems)


def _frame_content(
    reader: FrameReader, frame: Frame, usable: np.ndarray, darks: DarkField, edges: tuple, pairs: PairLevels
) -> list[Problem]:
    codes = reader.read(frame)
    if frame.role in ("sample", "check", "white") and reader.capture.lights.index(frame.light) is not None:
        pairs.add(frame, codes)
    if frame.role == "white":
        return list(board_field(reader, frame, codes, darks, edges, usable).problems)
    if frame.role == "flat":
        return []
    *counts, highest = count_unusable(codes, usable, reader.saturated, reader.clip)
    problems = frame_problems(frame, np.array(counts), float(highest), reader)
    severe = {"not-finite"}
    return [error(p.kind, p.file, p.what, found=p.found) if p.kind in severe else p for p in problems]


def failed(problems: list[Problem]) -> bool:
    """Whether the capture cannot be used."""
    return any(p.severity == "error" for p in problems)
