"""What the photographs of a plane show about each other, and what is put right before they are stored.

One pass over the photographs collects reduced pictures and a few windows. From these follow the movement of the camera
(`nishiki.observations.registration`), then, with the pictures brought together, the strength of each lamp, the light of
the room, lamps that failed and photographs that repeat another one (`nishiki.photometric.consistency`). What was
measured before anything was put right is kept beside what was done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.capture.frames import Frame
from nishiki.capture.lights import direction_problems
from nishiki.formats.problems import Problem, raise_errors, warning
from nishiki.observations.frames import FrameReader
from nishiki.observations.reference import DarkField
from nishiki.observations.registration import MARGIN, Movement, Window, align_window, choose_places, measure_movement
from nishiki.photometric.consistency import LARGEST_MISFIT, LEAST_AMBIENT, SURE, Consistency, examine_photographs

COARSE = 384  # pixels of the longer side of a reduced picture
BAND = 64  # rows of a reduced picture that are made at a time
LEAST_GAIN = 0.02  # of a lamp's strength that is put right: less turns normals by a tenth of a degree
UNEQUAL = 0.08  # spread of log strengths about a linear course over the directions, as no equal lamps have shown
MOST_AMBIENT = 0.5  # of a lamp: more cannot be told from an even object
ODD_EXPOSURE = 0.1  # of the brightness that a recorded exposure may be off: cameras round to thirds of a stop
LARGE_MOVEMENT = 1.5  # pixels, from which a movement is believed where the photographs cannot be predicted
LEAST_IMPROVEMENT = 0.07  # of the misfit that undoing a movement takes away: 0.11 and more for shifts of 1.2 pixels of
# the measured sets, 0.055 on the fossil, whose low lamps shift the texture of its relief
LEAST_MISFIT = 0.02  # of a photograph that repeats another one: an even object looks alike under many lamps
MOST_NAMED = 8

Choice = Literal["auto", "never"]


class Wishes(Protocol):
    """Which corrections a user allows, see `nishiki.stages.ingest.Correct`."""

    registration: Choice
    ambient: Choice
    gains: Choice
    leave_out: Choice


@dataclass(frozen=True)
class Corrections:
    """What is put right.

    Attributes
    ----------
    capture : Capture
        The capture without the photographs that are left out.
    kept : (lights,) int64
        Numbers of those that remain, among the observed ones.
    motions : dict of str to (2, 3) float64
        By file, see `FrameReader.motions`.
    gains : (lights,) float64
        Strengths by which the remaining photographs are divided; 1 where nothing significant is known.
    ambient : (channels,) float64
        Light of the room to take off, relative to the albedo; 0 where there is none.
    measured : dict
        What was measured and done, as plain values for the diagnostics.
    problems : tuple of Problem
        Warnings, one for each kind of correction.
    """

    capture: Capture
    kept: np.ndarray
    motions: dict[str, np.ndarray]
    gains: np.ndarray
    ambient: np.ndarray
    measured: dict[str, Any] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()

    @property
    def strengths(self) -> np.ndarray:
        """(lights, 1, 1, 1) float32: the gains in the shape of those of the boards."""
        return self.gains.astype(np.float32)[:, None, None, None]


class Survey:
    """Reduced pictures of all photographs, as values relative to the white board, and windows at full resolution."""

    def __init__(self, reader: FrameReader, darks: DarkField, gain: np.ndarray, mask: np.ndarray):
        """gain: (lights, r, c, channels) of the observed frames, see `nishiki.observations.reference.Gains`."""
        self.reader, self.darks, self.gain, self.mask = reader, darks, gain, mask != 0
        self.factor = max(1, -(-max(mask.shape) // COARSE))
        rows, columns = (n // self.factor for n in mask.shape)
        blocks = self.mask[: rows * self.factor, : columns * self.factor]
        self.inside = blocks.reshape(rows, self.factor, columns, self.factor).mean(axis=(1, 3)) > 0.5
        self.places: list[tuple[slice, slice]] | None = [] if self.factor == 1 else None
        self.pictures: list[np.ndarray] = []
        self.windows: list[list[np.ndarray]] = []

    def add(self, frame: Frame, codes: np.ndarray) -> None:
        """Add the codes (rows, columns, channels) of the next observed frame."""
        import cv2

        factor, (rows, columns), gain = self.factor, self.inside.shape, self.gain[len(self.pictures)]
        values = np.empty((rows, columns, codes.shape[2]), np.float32)
        for top in range(0, rows, BAND):
            part = codes[top * factor : min(top + BAND, rows) * factor, : columns * factor]
            linear, hot = self._linear(part), (part >= self.reader.saturated).any(axis=2).astype(np.float32)
            if factor > 1:
                size = (columns, len(part) // factor)
                linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA).reshape(*size[::-1], -1)
                hot = cv2.resize(hot, size, interpolation=cv2.INTER_AREA)
            values[top : top + BAND] = linear
            values[top : top + BAND][hot > 0] = np.nan
        values -= self.darks.at(frame.exposure_s).mean(axis=(0, 1))
        if gain.shape[:2] != (1, 1):
            gain = cv2.resize(gain, (columns, rows)).reshape(rows, columns, -1)
        values = values * gain
        self.pictures.append(values.astype(np.float16 if factor > 1 else np.float32))
        if self.places is None:
            self.places = choose_places(np.nan_to_num(values.mean(axis=2)), self.inside, factor)
        self.windows.append([self._linear(codes[place]).mean(axis=2).astype(np.float16) for place in self.places])

    def _linear(self, codes: np.ndarray) -> np.ndarray:
        return codes.astype(np.float32) if codes.dtype.kind == "f" else self.reader.table[codes]

    def movement(self, directions: np.ndarray) -> Movement:
        """Measure the movement of the camera."""
        windows = []
        for i, (rows, columns) in enumerate(self.places or []):
            pictures = np.stack([found[i] for found in self.windows]).astype(np.float32)
            corner = np.array([columns.start, rows.start], float)
            windows.append(Window(pictures, self.mask[rows, columns], corner, np.ones(2), MARGIN))
        self.windows.clear()
        grey = np.stack([picture.mean(axis=2, dtype=np.float32) for picture in self.pictures])
        brightest = np.nanmax(grey, axis=(1, 2), keepdims=True, initial=0)  # saturated pixels are as bright as any
        return measure_movement(self._whole(np.where(np.isnan(grey), brightest, grey)), windows, directions)

    @property
    def values(self) -> np.ndarray:
        """(lights, rows, columns, channels) float32, NaN where saturated or outside of the object."""
        return np.where(self.inside[:, :, None], np.stack(self.pictures), np.float32(np.nan)).astype(np.float32)

    def aligned(self, movement: Movement) -> np.ndarray:
        """The values, brought to the first photograph."""
        values = np.moveaxis(self.values, 3, 0)
        channels = [align_window(self._whole(pictures), movement, replicate=False)[0] for pictures in values]
        return np.where(self.inside[:, :, None], np.stack(channels, axis=3), np.float32(np.nan))

    def _whole(self, pictures: np.ndarray) -> Window:
        return Window(pictures, self.inside, np.full(2, (self.factor - 1) / 2), np.full(2, float(self.factor)))


def find_corrections(
    reader: FrameReader,
    darks: DarkField,
    gain: np.ndarray,
    mask: np.ndarray,
    wishes: Wishes,
    tick: Callable[[str], None],
) -> Corrections:
    """Measure the photographs of a plane against each other, and decide what is put right.

    Parameters
    ----------
    reader : FrameReader
    darks : DarkField
    gain : (lights, r, c, channels) float32
        Of the observed frames, see `nishiki.observations.reference.Gains`.
    mask : (rows, columns) uint8
    wishes : Wishes
    tick : callable
        Called with the file of each photograph.

    Returns
    -------
    Corrections

    Raises
    ------
    CaptureError
        lights-few or lights-coplanar, where too few photographs remain.
    """
    capture, survey = reader.capture, Survey(reader, darks, gain, mask)
    frames, directions = capture.observed, capture.directions
    for frame, codes in reader.read_all(frames):
        survey.add(frame, codes)
        tick(frame.file)
    movement, values = survey.movement(directions), survey.values
    first = found = examine_photographs(values, directions)
    moved = movement.moved if movement.significant.any() else np.zeros(len(frames), bool)
    if moved.any():
        aligned = survey.aligned(movement)
        found = examine_photographs(aligned, directions)
        if not _supported(movement, first, found):
            moved[:] = False
        if moved.any() and wishes.registration == "auto":
            values = aligned
        else:
            found = first
    problems = _movement_problems(frames, movement, moved, wishes)
    reasons = _reasons_to_leave_out(frames, found)
    problems += _left_out_problems(frames, reasons, wishes)
    kept = np.arange(len(frames))
    if reasons and wishes.leave_out == "auto":
        kept = np.array([j for j in kept if j not in reasons], np.int64)
        samples = [j for j in kept if frames[j].role == "sample"]
        few = direction_problems(directions[samples], "frames.csv")
        without = f"without the {len(reasons)} photographs that are of no use"
        raise_errors(replace(problem, what=f"{problem.what} {without}") for problem in few)
        found = examine_photographs(values[kept], directions[kept])
    out = {frames[j].file for j in range(len(frames)) if j not in kept}
    left = replace(capture, frames=tuple(f for f in capture.frames if f.file not in out))
    gains, ambient = np.ones(len(kept)), np.zeros(values.shape[3])
    if found is not None and np.nanmedian(found.residual) < LARGEST_MISFIT:
        gains, notes = _choose_gains(left, found, wishes)
        problems += notes
        ambient, notes = _choose_ambient(left, found, values[kept], directions[kept], wishes)
        problems += notes
    motions = {frames[j].file: movement.matrix(j) for j in kept if moved[j] and wishes.registration == "auto"}
    registered = [frame.light for frame in frames if frame.file in motions]
    for file, stated in reader.motions.items():  # a stated shift is undone first
        motions[file] = motions[file] + stated * (0, 0, 1) if file in motions else stated
    done = {
        "registered": registered,
        "left_out": {frames[j].light: reason for j, reason in reasons.items() if frames[j].file in out},
        "gains": {f.light: float(g) for f, g in zip(left.observed, gains, strict=True) if g != 1},
        "ambient": ambient.tolist() if ambient.any() else [],
    }
    measured = {"photographs": _measured(frames, movement, first), "done": done}
    if first is not None:
        measured |= {"ambient": first.ambient, "ambient_sigma": _plain(first.ambient_sigma)}
    return Corrections(left, kept, motions, gains, ambient, measured, tuple(problems))


def _supported(movement: Movement, before: Consistency | None, after: Consistency | None) -> bool:
    """Whether the photographs predict each other better once the movement is undone."""
    if before is None or after is None:
        return movement.largest[movement.significant].max() > LARGE_MOVEMENT
    return bool(np.nansum(after.residual) < (1 - LEAST_IMPROVEMENT) * np.nansum(before.residual))


def _movement_problems(frames: tuple[Frame, ...], movement: Movement, moved: np.ndarray, wishes: Wishes):
    """The warning that the camera moved; none where it did not."""
    if not moved.any():
        return []
    far = int(np.argmax(np.where(moved, movement.largest, 0)))
    x, y = movement.shift[far]
    found = f"{moved.sum()} of {len(frames)} photographs moved, {frames[far].file} most: {x:+.1f}, {y:+.1f} pixels"
    if movement.turn.any():
        found += f", turned by {np.degrees(movement.turn[far]):.2f} degrees"
    if wishes.registration == "auto":
        what = "the camera moved between the photographs; they are moved back"
        remedy = "Fasten the camera and the object more firmly"
    else:
        what = "the camera moved between the photographs"
        remedy = "Set ingest.correct.registration: auto to move them back"
    return [warning("camera-moved", frames[far].file, what, found=found, remedy=remedy)]


def _reasons_to_leave_out(frames: tuple[Frame, ...], found: Consistency | None) -> dict[int, str]:
    """Photographs of no use, by number, and why."""
    if found is None:
        return {}
    reasons = dict.fromkeys(found.failed, "its lamp did not burn")
    for worse, other in found.repeats:
        if worse not in reasons and other not in reasons and found.residual[worse] > LEAST_MISFIT:
            reasons[worse] = f"it repeats the photograph of light {frames[other].light}"
    return reasons


def _left_out_problems(frames: tuple[Frame, ...], reasons: dict[int, str], wishes: Wishes) -> list[Problem]:
    leaves = wishes.leave_out == "auto"
    remedy = "Photograph it again" if leaves else "Photograph it again, or set ingest.correct.leave_out: auto"
    kinds = {True: "photograph-repeated", False: "lamp-failed"}
    return [
        warning(
            kinds["repeats" in reason],
            frames[j].file,
            f"the photograph of light {frames[j].light} is {'left out' if leaves else 'of no use'}: {reason}",
            remedy=remedy,
        )
        for j, reason in sorted(reasons.items())
    ]


def _choose_gains(capture: Capture, found: Consistency, wishes: Wishes) -> tuple[np.ndarray, list[Problem]]:
    """Strengths to divide by where neither boards nor intensities tell them, and what recorded exposures hide.

    Strengths that rise with the direction of the lamp are like a tilt of the object, and like matter that does not
    follow Lambert's law: they alone are no evidence. On a grey sphere under equal lamps they reach 17 %, and would turn
    its normals by 7 degrees.
    """
    frames, ones = capture.observed, np.ones(len(found.gain))
    off = np.abs(found.gain - 1)
    significant = off > np.maximum(LEAST_GAIN, SURE * found.gain_sigma)
    problems = []
    times = [f.exposure for f in frames if f.exposure is not None]
    odd = significant & (off > ODD_EXPOSURE)
    if times and max(times) > min(times) and odd.any():
        j = int(np.argmax(np.where(odd, off, 0)))
        what = "the brightness of photographs does not match their recorded exposures"
        said = f"{odd.sum()} of {len(frames)} photographs, {frames[j].file} most, by {100 * (found.gain[j] - 1):+.0f} %"
        remedy = "Check the columns exposure_s, f_number and iso of frames.csv"
        problems.append(warning("exposure-disagrees", "frames.csv", what, found=said, remedy=remedy))
    if capture.frames_of("white") or capture.intensities is not None or not significant.any():
        return ones, problems
    course = np.column_stack([np.ones(len(off)), capture.directions])
    uneven = np.log(found.gain) - course @ np.linalg.lstsq(course, np.log(found.gain), rcond=None)[0]
    if len(off) <= course.shape[1] or uneven.std() < UNEQUAL:
        return ones, problems
    gains = np.where(significant, found.gain, 1.0)
    names = [f"{frames[j].light} {found.gain[j]:.2f} ± {found.gain_sigma[j]:.2f}" for j in np.flatnonzero(significant)]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    remedy = "Photograph a white board under every lamp"
    if wishes.gains == "never":
        gains, what, remedy = ones, "the lamps are not equally strong", f"{remedy}, or set ingest.correct.gains: auto"
    else:
        what = "the lamps are not equally strong; their strengths are estimated from the photographs"
    said = f"{', '.join(names[:MOST_NAMED])}{more}"
    return gains, [*problems, warning("lamps-unequal", "frames.csv", what, found=said, remedy=remedy)]


def _choose_ambient(
    capture: Capture, found: Consistency, values: np.ndarray, directions: np.ndarray, wishes: Wishes
) -> tuple[np.ndarray, list[Problem]]:
    """Light of the room (channels,) to take off, relative to the albedo; 0 where it is not significant."""
    none = np.zeros(values.shape[3])
    if not max(LEAST_AMBIENT, SURE * found.ambient_sigma) < found.ambient < MOST_AMBIENT:
        return none, []
    levels = [found.ambient] * len(none)
    for channel in range(len(none) if len(none) > 1 else 0):
        alone = examine_photographs(values[..., channel], directions)
        if alone is not None and alone.ambient > SURE * alone.ambient_sigma:
            levels[channel] = alone.ambient
    said = f"{100 * found.ambient:.1f} ± {100 * found.ambient_sigma:.1f} % of a lamp that faces the object"
    remedy = "Darken the room, or photograph the object once without a lamp (role ambient)"
    what = "the photographs contain light of the room"
    if capture.frames_of("ambient"):
        what = "the photographs contain more light of the room than those without a lamp"
    if wishes.ambient == "auto":
        what += "; its estimate is subtracted"
    problem = warning("room-light", "frames.csv", what, found=said, remedy=remedy)
    return np.array(levels) if wishes.ambient == "auto" else none, [problem]


def _measured(frames: tuple[Frame, ...], movement: Movement, found: Consistency | None) -> dict[str, dict[str, Any]]:
    """What each photograph showed before anything was put right, by light, in plain numbers."""
    table: dict[str, dict[str, Any]] = {}
    for j, frame in enumerate(frames):
        row = {
            "shift_px": movement.shift[j].tolist(),
            "shift_sigma_px": _plain(movement.sigma[j]),
            "turn_deg": float(np.degrees(movement.turn[j])),
            "scale": 1 + float(movement.scale[j]),
        }
        if found is not None:
            for name in ("residual", "gain", "gain_sigma", "offset", "offset_sigma", "direction_sigma_deg"):
                row[name] = _plain(getattr(found, name)[j])
            row["direction"] = [_plain(v) for v in found.direction[j]]
        table[frame.light] = row
    return table


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
