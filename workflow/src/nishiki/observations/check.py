"""Find all problems of a capture in one pass.

Opened photographs of a turntable are compared with the statements of its capture: sizes, boards, polarisers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from nishiki.capture.folder import MIRROR_BALLS, Capture, examine
from nishiki.capture.frames import LIT_ROLES, Frame, parse_state
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.lights import SAME_DEG
from nishiki.capture.mosaic import MosaicCapture, within
from nishiki.capture.seal import payload_files, verify_seal
from nishiki.capture.taking import compare_exposures
from nishiki.capture.turntable import TurntableCapture
from nishiki.errors import UserError, require
from nishiki.formats.coding import Coding
from nishiki.formats.files import walk
from nishiki.formats.images import expect_channels, read_header
from nishiki.formats.masks import read_mask
from nishiki.formats.picture_files import ImageHeader
from nishiki.formats.problems import CaptureError, Problem, error, name_some, warning
from nishiki.observations.consistency import Judgement, ReducedPhotographs, dark_problems, judgement_problems
from nishiki.observations.frames import FrameReader, Tick, attempt, examine_frames, unusable_coding
from nishiki.observations.goniometer_store import look_at_windows, table_problems
from nishiki.observations.linearise import CHECK_BLOCK, block_edges, count_unusable, picture_edges
from nishiki.observations.plane_store import frame_problems
from nishiki.observations.reference import DarkField, board_field, measure_darks
from nishiki.observations.region import AnyCapture, object_mask, region_numbers, region_of
from nishiki.observations.turntable_coherence import DisplayPictures, capture_problems
from nishiki.observations.views_store import measure_whites, read_silhouette, view_problems
from nishiki.photometric.lambert_fit import FEWEST_LAMPS
from nishiki.polarisation.polarisation import LIT
from nishiki.polarisation.polariser_states import equal_steps, sums_of
from nishiki.polarisation.series import SeriesOrder, find_order, remove_nuisance, series_design

SIDE = 96
"""Longer side in pixels of the averaged photographs, at which noise is negligible."""
EXCHANGED = 1.02
"""Ratio of crossed to parallel light from which the states count as exchanged. Off and on give 0.3 to 0.5,
angles 0.2 to 0.99, light never more than 1; a lamp that varies between photographs adds 1 %."""
RETARDERS, MOST_NAMED = 25, 6  # terms of a series of retarders; views and photographs that a message names


class PolariserLevels:
    """Small linear pictures of each polariser state of every view, and of the white boards."""

    def __init__(self, reader: FrameReader[TurntableCapture]):
        self.reader, self.pictures = reader, {}
        self.files: dict[tuple[str, str, str], dict[str, str]] = {}
        self.compared = len(reader.capture.states) > 1

    def add(self, frame: Frame, codes: np.ndarray, inside: np.ndarray) -> None:
        """Add a photograph: codes (rows, columns, channels), its object (rows, columns) uint8."""
        if not self.compared or not frame.polariser:
            return
        import cv2

        step = max(1, max(codes.shape[:2]) // (4 * SIDE))
        some = codes[::step, ::step]
        linear = self.reader.table[some] if codes.dtype.kind == "u" else some
        linear = (linear.mean(axis=2) - self.reader.black) * inside[::step, ::step] / (frame.exposure or 1.0)
        factor = min(1.0, SIDE / max(linear.shape))
        size = tuple(max(1, round(n * factor)) for n in linear.shape[::-1])
        small = cv2.resize(np.nan_to_num(linear).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        key = frame.role, frame.light, frame.view
        self.pictures.setdefault(key, {})[frame.polariser] = small
        self.files.setdefault(key, {})[frame.polariser] = frame.file

    def problems(self) -> list[Problem]:
        """List states that contradict the photographs: exchanged parallel and crossed ones, angles in another order."""
        return self._darker_parallel() + self._other_orders()

    def _other_orders(self) -> list[Problem]:
        """Make an error for each order of angles that fits the photographs of some views, unlike the stated one."""
        found: list[tuple[tuple[str, str, str], SeriesOrder]] = []
        for key, pictures in self.pictures.items():
            angles = np.array([angles for state in pictures if (angles := parse_state(state).angles_deg)])
            if key[0] != "sample" or len(angles) != len(pictures):
                continue
            angles = np.stack([equal_steps(column) for column in angles.T], axis=1)
            design = series_design(angles)
            if angles.shape[1] == 2 and self.reader.capture.calibration is not None and design.shape[1] < RETARDERS:
                continue  # the stage knows by the calibration what so few states tell
            order = find_order(remove_nuisance(np.stack(list(pictures.values())).astype(np.float64)), design)
            if order is not None and not order.as_stated:
                found.append((key, order))
        problems = []
        while found:
            orders = Counter((tuple(self.pictures[key]), each) for key, order in found for each in order.all)
            (states, commonest), _ = orders.most_common(1)[0]
            views = [(key, order) for key, order in found if commonest in order.all]
            found = [each for each in found if each not in views]
            problems.append(self._order_problem(states, commonest, views))
        return problems

    def _order_problem(
        self, states: tuple[str, ...], commonest: tuple[int, ...], views: list[tuple[tuple[str, str, str], SeriesOrder]]
    ) -> Problem:
        """Make the error of views whose photographs fit one other order."""
        key, order = max(views, key=lambda each: each[1].unexplained)
        files = self.files[key]
        moved = [f"{files[states[k]]}: {states[i]}" for i, k in enumerate(commonest) if i != k]
        remedy = f"State in the column polariser of frames.csv what they show ({name_some(moved)})"
        if len(moved) == 2:
            alike = set.intersection(*(set(each.all) for _, each in views)) - {commonest}
            places = [np.flatnonzero(np.array(each) != range(len(states))) for each in (commonest, *sorted(alike))]
            exchanges = ", or ".join(" and ".join(states[i] for i in pair) for pair in places[:MOST_NAMED])
            remedy = f"Exchange the states {exchanges} in the column polariser of frames.csv"
        if key[2]:
            remedy += f" for the views {name_some(dict.fromkeys(view for (_, _, view), _ in views))}"
        what = f"the photographs of {len(moved)} of {len(states)} polariser states do not follow their angles"
        shares = f"{100 * order.unexplained:.2g} % of the variation left, {100 * order.corrected:.2g} % with the remedy"
        return error("states-exchanged", "frames.csv", what, expected="polarisers' law", found=shares, remedy=remedy)

    def _darker_parallel(self) -> list[Problem]:
        """Make one error that names the views, or the white boards, that are brighter in the crossed state."""
        ratios = {key: _crossed_over_parallel(pictures) for key, pictures in self.pictures.items()}
        odd = {key: ratio for key, ratio in ratios.items() if ratio is not None and ratio > EXCHANGED}
        if not odd:
            return []
        samples = [view for role, _, view in odd if role == "sample"]
        frames = ["white boards"] if len(samples) < len(odd) else []
        if samples:
            all_odd = len(samples) == sum(role == "sample" for role, _, _ in ratios)
            frames.insert(0, "object" if all_odd else "views " + ", ".join(dict.fromkeys(samples)))
        what = "the crossed polariser state is brighter than the parallel one, which light cannot be"
        found = f"{max(odd.values()):.2f} times as bright at most"
        remedy = "Exchange off and on (or parallel and crossed angles) in the column polariser of frames.csv for "
        remedy += f"the {' and the '.join(frames)}; or check exposure_s, where exposures differ between the states"
        return [error("polarisers-exchanged", "frames.csv", what, expected="never", found=found, remedy=remedy)]


def _crossed_over_parallel(pictures: dict[str, np.ndarray]) -> float | None:
    """Compute the ratio of crossed to parallel light over the object; None for states of other kinds."""
    try:
        sums = sums_of(tuple(pictures))
    except UserError:
        return None
    if sums.method not in ("circular", "crossed", "pairs"):
        return None
    parallel, crossed = np.tensordot(sums.weights, np.stack(list(pictures.values())), axes=1)
    total = parallel + crossed
    lit = total > LIT * np.percentile(total, 99)
    bright = float(parallel[lit].sum())
    return float(crossed[lit].sum()) / bright if bright > 0 else None


def silhouette_problems(capture: TurntableCapture, size: tuple[int, int]) -> list[Problem]:
    """Check silhouettes: readable, of the frames' size, neither empty nor full, in agreement with the cameras."""
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
    """Find problems that only decoding reveals."""
    reader = FrameReader.of(capture, "all", prove=False)  # the whole seal is verified apart
    problems = attempt(lambda: _reference_problems(reader, tick))
    pictures, levels = DisplayPictures(capture), PolariserLevels(reader)

    def look(frame: Frame, decode: Callable[[], np.ndarray]) -> list[Problem]:
        codes = decode()
        if frame.role not in ("sample", "white") or (frame.role == "white" and not frame.polariser):
            return []
        named = capture.silhouette_of(frame.view) if frame.role == "sample" else None
        if frame.role == "sample":
            pictures.add(frame.view, codes, reader)
        size = codes.shape[:2]  # all ones where no silhouette is usable, which is reported apart
        try:
            outline = read_mask(require(named.silhouette_path), name=named.silhouette) if named else None
        except CaptureError:
            outline = None
        inside = outline.astype(np.uint8) if outline is not None and outline.shape == size else np.ones(size, np.uint8)
        levels.add(frame, codes, inside)
        *counts, highest = count_unusable(codes, inside, reader.saturated, reader.clip)
        return view_problems(frame, np.array(counts), float(highest), reader, outlined=named is not None)

    problems += examine_frames(reader, [frame for frame in capture.frames if frame.role != "dark"], look, tick)
    return reader.warnings() + problems + levels.problems() + pictures.problems(reader.rows, reader.columns)


def _reference_problems(reader: FrameReader[TurntableCapture], tick: Tick) -> list[Problem]:
    """List problems of dark frames and normalising white boards."""
    edges = picture_edges((reader.rows, reader.columns), CHECK_BLOCK)
    darks = measure_darks(reader, edges, tick)
    # white boards and exposures are there for every light, or for none; if not, it is reported already
    lit = [f for f in reader.capture.frames if f.role in ("sample", "white")]
    plain = {f.light for f in lit if f.role == "white" and not f.polariser}
    timed = sum(f.exposure is not None for f in lit)
    complete = timed in (0, len(lit)) and (not plain or plain >= set(reader.capture.light_names))
    whites = measure_whites(reader, darks, edges, tick).problems if complete else ()
    return [*darks.problems, *whites]


def check_capture(
    root: Path | str,
    *,
    level: Literal["quick", "full"] = "quick",
    progress: Callable[[str], None] | None = None,
    judged: Callable[[Judgement], None] = lambda judgement: None,
) -> list[Problem]:
    """List all problems of a capture folder, errors first; an empty list means that nothing was found.

    quick: tables, headers of all photographs, mask. full: also decodes every photograph (damage, saturation, white
    boards, samples that are not finite), compares every digest of a sealed capture, and the photographs of a plane with
    each other: judged(judgement) is called with what they show.
    """
    root = Path(root)
    capture, problems = examine(root)
    if isinstance(capture, MosaicCapture):
        fields = ((field, check_capture(field.path, level=level, progress=progress)) for field in capture.fields)
        problems += [problem for field, found in fields for problem in within(field, found)]
        return sorted(dict.fromkeys(problems), key=lambda p: p.severity != "error")
    problems = list(problems)
    if (root / "bagit.txt").is_file():
        problems += attempt(lambda: verify_seal(root, digests=level == "full"))
    elif root.is_dir():
        problems += attempt(lambda: (payload_files(root), [])[1])  # links that lead out, devices, unusable names
    if capture is not None:
        problems += _warn_of_unlisted(capture)
        remarks, sound, size = _header_problems(capture)
        problems += remarks
        if isinstance(capture, GoniometerCapture) and capture.table is not None:
            problems += table_problems(capture)
        if size is not None and sound.observed:
            contents, tick = level == "full", progress or (lambda file: None)
            if isinstance(sound, TurntableCapture):
                problems += silhouette_problems(sound, size)
                problems += attempt(lambda: turntable_content_problems(sound, tick)) if contents else []
            elif isinstance(sound, GoniometerCapture):
                problems += look_at_windows(sound, size, contents, tick)
            else:
                problems += _same_directions(sound) + _strength_problems(sound) + _mask_problems(sound, size)
                problems += attempt(lambda: _content_problems(sound, judged, tick)) if contents else []
    distinct = list(dict.fromkeys(problems))
    return sorted(distinct, key=lambda p: p.severity != "error")


def _warn_of_unlisted(capture: AnyCapture) -> list[Problem]:
    """Warn of files in the payload that no table names: harmless, but perhaps a forgotten photograph."""
    settings = capture.settings
    named = [settings.camera.sensitivities, settings.illuminant, "capture.yaml"]
    named += [name for frame in capture.frames for name in frame.names]
    if isinstance(capture, GoniometerCapture):
        named += ["" if capture.table else "frames.csv", *(file for _, file in capture.settings.goniometer.files)]
    elif isinstance(capture, TurntableCapture):
        lights, turntable = capture.settings.lights, capture.settings.turntable
        named += [lights.file if lights else None, "frames.csv", *(file for _, file in turntable.files)]
        named += [frame.silhouette for frame in capture.frames]
    else:
        plane = capture.settings
        named += [plane.lights.file, plane.lights.intensities, plane.rendered_from, plane.mask, plane.regions]
        named += ["frames.csv", MIRROR_BALLS]
        if plane.rendered_from and "/" in plane.rendered_from:  # a folder of relight: info.json stands for its planes
            folder = Path(plane.rendered_from).parent
            files = (name for name, entry in walk(capture.payload / folder) if entry.is_file())
            named += [f"{folder.as_posix()}/{name}" for name in files]
    listed = {Path(name).as_posix() for name in named if name}
    tag_files = {"bagit.txt", "bag-info.txt", "manifest-sha256.txt", "tagmanifest-sha256.txt"}
    remedy = "List it in frames.csv, or move it out of the capture"
    extra = sorted({name for name, entry in walk(capture.payload) if entry.is_file()} - listed - tag_files)
    return [warning("file-unlisted", name, "no table names this file", remedy=remedy) for name in extra]


def _same_directions(capture: Capture) -> list[Problem]:
    directions = capture.lights.directions
    cosines = np.triu(directions @ directions.T, 1)
    pairs = np.argwhere(cosines > np.cos(np.radians(SAME_DEG)))
    names = capture.lights.names
    what = "lights {} and {} have the same direction"
    file = capture.settings.lights.file
    return [warning("light-same", file, what.format(names[i], names[j])) for i, j in pairs]


def _strength_problems(capture: Capture) -> list[Problem]:
    if capture.frames_of("white") or capture.intensities is not None:
        return []
    what = "neither white boards nor lights.intensities: every lamp is taken to shine alike, and evenly"
    remedy = "Photograph a white board under every lamp; without, unequal lamps tilt the normals and tint the colours"
    return [warning("strengths-unknown", "capture.yaml", what, remedy=remedy)]


def _header_problems(capture: AnyCapture) -> tuple[list[Problem], AnyCapture, tuple[int, int] | None]:
    """Compare size, depth, channels and format of each photograph with those of most of them.

    Returns problems, the capture without the photographs that differ, and the size of the others (rows, columns), None
    where no photograph can be read.
    """
    problems: list[Problem] = []
    headers: dict[str, ImageHeader] = {}
    for channels, file, path in (part for frame in capture.frames for part in frame.parts):
        try:
            headers[file] = read_header(path, name=file)
            expect_channels(headers[file], channels or capture.settings.camera.channels, file)
        except CaptureError as e:
            problems += e.problems
    if not headers:
        return problems, capture, None
    shown = {name for frame in capture.observed for name in frame.names}
    sizes = {file: f"{header.rows} x {header.columns}" for file, header in headers.items()}
    problems += _exceptions(sizes, "image-size", "size differs", "Develop all photographs alike, without rotation")
    problems = [_warn_of_rotation(problem, headers) for problem in problems]
    depths: dict[str, str] = {file: header.sample for file, header in headers.items()}
    problems += _exceptions(depths, "image-depth", "depth differs", "Develop all photographs alike")
    kinds: dict[str, str] = {file: header.kind for file, header in headers.items() if file in shown}
    severe = {p.file for p in problems}
    odd = _exceptions(kinds, "image-format", "format differs", "Export all photographs by one program")
    problems += [replace(p, severity="warning") for p in odd if p.file not in severe]
    problems += _coding_problems(headers, capture.settings.camera.encoding) + _exposure_problems(capture, headers)
    severe |= {p.file for p in problems if p.severity == "error"}
    usual = next((h for file, h in headers.items() if file not in severe), next(iter(headers.values())))
    bits, held = capture.settings.camera.bits, {"uint8": 8, "uint16": 16}.get(usual.sample, 16)
    if bits and bits > held:
        place = "capture.yaml camera.bits"
        problems.append(error("bits-differ", place, "bits", expected=f"at most {held}", found=f"{bits}"))
    size = usual.rows, usual.columns
    if isinstance(capture, Capture):
        problems += attempt(lambda: (region_of(capture, *size), [])[1])
    sound = tuple(f for f in capture.frames if all(name in headers and name not in severe for name in f.names))
    return problems, replace(capture, frames=sound), size


def _warn_of_rotation(problem: Problem, headers: dict[str, ImageHeader]) -> Problem:
    """Warn that a photograph with exchanged rows and columns was rotated."""
    header = headers.get(problem.file)
    if problem.kind != "image-size" or not header or f"{header.columns} x {header.rows}" not in problem.expected:
        return problem
    remedy = "Turn it back, or export it again without rotation: orientation tags are not applied, turned pixels are"
    return replace(problem, what="size differs: the photograph was turned by a quarter", remedy=remedy)


def _coding_problems(headers: dict[str, ImageHeader], encoding: str) -> list[Problem]:
    """List photographs of unusual codings, unusable or overruled statements, and orientations."""
    problems: list[Problem] = []
    distinct: list[Coding] = []
    names, overruled = {}, []
    for file, header in headers.items():
        stated, used = header.choose_coding("file"), header.choose_coding(encoding)
        alike = next((each for each in distinct if each == stated or not each.differs_from(stated)), stated)
        distinct += [alike] if alike not in distinct else []
        names[file] = alike.name
        overruled += [file] if header.coding and header.coding.curve.differs_from(used.curve) else []
        if stated.fault and encoding == "file":
            problems.append(unusable_coding(stated, file))
    if encoding == "file" or len(overruled) < len(headers):
        problems += _exceptions(names, "coding-differs", "coding differs", "Develop all photographs alike")
    else:
        what, remedy = "the files state another coding", "Set camera.encoding: file to decode them by what they state"
        said = {"expected": f"{encoding}, as camera.encoding states", "found": names[overruled[0]]}
        problems.append(warning("encoding-overruled", overruled[0], what, **said, remedy=remedy))
    turns = {file: header.exif.orientation for file, header in headers.items()}
    usual = Counter(turns.values()).most_common(1)[0][0]
    odd = [file for file, turn in turns.items() if turn != usual]
    if odd:
        what = "orientation tags differ: they are not applied, pixels are taken as the camera wrote them"
        found = f"{len(odd)} of {len(turns)} photographs, such as this one with {turns[odd[0]]} in place of {usual}"
        problems.append(warning("orientation-differs", odd[0], what, found=found))
    return problems


def _exposure_problems(capture: AnyCapture, headers: dict[str, ImageHeader]) -> list[Problem]:
    """Warn where the files record differing exposures, frames.csv states none, and no board was exposed alike."""
    lit = [f for f in capture.frames if f.role in (*LIT_ROLES, "ambient") and f.file in headers]
    if not lit or any(f.exposure is not None or f.bands for f in lit):
        return []
    recorded = {f.file: headers[f.file].exif for f in lit}
    boards = {f.light: recorded[f.file] for f in lit if f.role == "white" and not f.polariser}
    samples = [f for f in lit if f.role in ("sample", "check")]
    alike = [f.light in boards and not compare_exposures([recorded[f.file], boards[f.light]])[0] for f in samples]
    if boards and all(alike):
        return []
    said, unknown = compare_exposures(list(recorded.values()))
    if not said:
        return []
    what, found = "the files record differing exposures, and frames.csv states none", ", ".join(said.values())
    remedy = f"Give the {'columns' if len(said) > 1 else 'column'} {', '.join(said)} in frames.csv"
    remedy += ", or write the capture again with convert" if not unknown else f"; {lit[unknown[0]].file} records none"
    return [warning("exposure-differs", "frames.csv", what, found=found, remedy=remedy)]


def _exceptions(values: dict[str, str], kind: str, what: str, remedy: str) -> list[Problem]:
    """List files whose value differs from that of most files."""
    counts = Counter(values.values())
    usual, count = counts.most_common(1)[0] if counts else ("", 0)
    like = next((file for file, value in values.items() if value == usual), "")
    expected = f"{usual} as {count} of {len(values)}, such as {like}"
    remedy = f"{remedy}, or leave this one out"
    odd = {file: value for file, value in values.items() if value != usual}
    return [error(kind, file, what, expected=expected, found=value, remedy=remedy) for file, value in odd.items()]


def _mask_problems(capture: Capture, size: tuple[int, int]) -> list[Problem]:
    """Check mask and regions: readable, of the frames' size, not empty, with unambiguous values and shape."""
    try:
        region = region_of(capture, *size)
    except CaptureError:
        return []  # reported already
    problems = attempt(lambda: object_mask(capture, size, region).problems)
    return problems + attempt(lambda: region_numbers(capture, size, region)[1])


def _content_problems(
    capture: Capture, judged: Callable[[Judgement], None], tick: Callable[[str], None]
) -> list[Problem]:
    """Find problems that only decoding reveals."""
    reader = FrameReader.of(capture, "all", prove=False)  # the whole seal is verified apart
    _, _, rows, columns = reader.region
    edges = block_edges(rows, CHECK_BLOCK), block_edges(columns, CHECK_BLOCK)
    darks, problems = _darks(reader, edges, tick)
    try:
        usable = object_mask(capture, (reader.rows, reader.columns), reader.region).inside.astype(np.uint8)
    except CaptureError:
        usable = np.ones((rows, columns), np.uint8)  # reported already
    reduced = ReducedPhotographs(reader, darks, usable)

    def look(frame: Frame, decode: Callable[[], np.ndarray]) -> list[Problem]:
        codes = decode()
        if frame.role in ("sample", "check", "white") and capture.lights.find(frame.light) is not None:
            reduced.add(frame, codes)
        if frame.role == "white":
            return list(board_field(reader, frame, codes, darks, edges, usable).problems)
        if frame.role in ("flat", "ambient"):
            return []
        *counts, highest = count_unusable(codes, usable, reader.saturated, reader.clip)
        return frame_problems(frame, np.array(counts), float(highest), reader)

    found = examine_frames(reader, [frame for frame in capture.frames if frame.role != "dark"], look, tick)
    spared = len(capture.frames_of("sample")) > FEWEST_LAMPS  # ingest leaves black photographs out
    problems += [replace(p, severity="warning") if spared and p.kind == "all-dark" else p for p in found]
    tick("photographs against each other")
    judgement = reduced.judge()
    if judgement is not None:
        judged(judgement)
    return reader.warnings() + problems + dark_problems(reduced.darker) + judgement_problems(judgement, capture)


def _darks(reader: FrameReader, edges: tuple, tick: Callable[[str], None]) -> tuple[DarkField, list[Problem]]:
    """Measure the dark level; 0 and the reason where dark frames cannot be read."""
    try:
        darks = measure_darks(reader, edges, tick)
        return darks, list(darks.problems)
    except CaptureError as e:
        level = np.zeros((1, 1, len(reader.names)), np.float32)
        return DarkField((None,), (level,), np.zeros(reader.region[2:], bool), ()), list(e.problems)
