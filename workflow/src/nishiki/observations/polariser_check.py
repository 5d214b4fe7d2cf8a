"""Compare the opened photographs of a turntable with the statements of its capture: sizes, boards, polarisers."""

from collections import Counter
from collections.abc import Callable

import numpy as np

from nishiki.capture.frames import Frame, parse_state
from nishiki.capture.turntable import TurntableCapture
from nishiki.errors import UserError, require
from nishiki.formats.masks import read_mask
from nishiki.formats.problems import CaptureError, Problem, error, name_some, warning
from nishiki.observations.frames import FrameReader, Tick, attempt, examine_frames
from nishiki.observations.linearise import CHECK_BLOCK, count_unusable, picture_edges
from nishiki.observations.reference import measure_darks
from nishiki.observations.turntable_coherence import DisplayPictures, capture_problems
from nishiki.observations.views_store import measure_whites, read_silhouette, view_problems
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
