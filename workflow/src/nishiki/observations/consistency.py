"""The photographs of a plane capture against each other: reduced while they are decoded, then judged together."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.capture.frames import Frame
from nishiki.formats.problems import Problem, error, warning
from nishiki.observations.frames import FrameReader
from nishiki.observations.reference import DarkField, board_cosine
from nishiki.photometric.arrangement import Arrangement, arrange
from nishiki.photometric.consistency import LEAST_AMBIENT, SURE, Consistency, examine_photographs
from nishiki.photometric.near_lamps import NearLamps, measure_width

LONGEST = 256  # pixels of a reduced photograph along its longer side: relief is coarser, texture mostly finer
SUBSAMPLES = 3  # pixels a side that are averaged to one: noise falls to a third, and few are decoded


@dataclass(frozen=True)
class Judgement:
    """What the photographs say of themselves and of their lamps.

    lights: places of the lamps in the lights file; names: of the photographs' files; values (lights, rows, columns):
    reduced photographs, divided by their boards or strengths where there are any; directions (lights, 3) as stated;
    consistency, arrangement: None where nothing can be told; near: what the fall-off of directed lamps without boards
    shows, in widths of these pictures.
    """

    lights: tuple[int, ...]
    names: tuple[str, ...]
    values: np.ndarray
    directions: np.ndarray
    consistency: Consistency | None
    arrangement: Arrangement | None
    near: NearLamps | None = None


@dataclass
class ReducedPhotographs:
    """Photographs and boards reduced frame by frame: grey, linear, per second, NaN where unusable.

    mask (rows, columns): the object; photographs, boards: by place of the lamp, (rows, columns) float32; files: of the
    photographs, by place.
    """

    reader: FrameReader
    darks: DarkField
    mask: np.ndarray
    photographs: dict[int, np.ndarray] = field(default_factory=dict)
    boards: dict[int, np.ndarray] = field(default_factory=dict)
    files: dict[int, str] = field(default_factory=dict)

    def __post_init__(self):
        (top, bottom), (left, right) = (
            (edge[0], edge[-1] + 1) for edge in (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        )
        step = max(1, -(-max(bottom - top, right - left) // LONGEST))
        self.side = min(SUBSAMPLES, step)
        inner = ((np.arange(self.side) + 0.5) * step / self.side).astype(np.int64)
        self.rows, self.columns = (
            (start + np.arange((stop - start) // step)[:, None] * step + inner).ravel()
            for start, stop in ((top, bottom), (left, right))
        )
        self.inside = self.mask[np.ix_(self.rows, self.columns)] != 0

    def add(self, frame: Frame, codes: np.ndarray) -> None:
        """Add the codes (rows, columns, channels) of a white frame or of a photograph of the object."""
        reader, place = self.reader, self.reader.capture.lights.index(frame.light)
        if place is None or frame.role not in ("sample", "check", "white"):
            return
        part = codes[np.ix_(self.rows, self.columns)]
        linear = part if part.dtype.kind == "f" else reader.table[part]
        dark = self.darks.at(frame.exposure_s).mean(axis=(0, 1))
        values = (linear - dark).mean(axis=2) / (frame.exposure or 1.0)
        values[(part >= reader.saturated).any(axis=2) | ~self.inside] = np.nan
        shape = (len(self.rows) // self.side, self.side, len(self.columns) // self.side, self.side)
        reduced = values.reshape(shape).mean(axis=(1, 3)).astype(np.float32)
        if frame.role == "white":
            self.boards[place] = reduced
        else:
            self.photographs[place], self.files[place] = reduced, frame.file

    def judge(self) -> Judgement | None:
        """Compare the photographs with each other; None where there are too few to be compared."""
        capture = self.reader.capture
        places = tuple(sorted(self.photographs))
        if len(places) < 2:
            return None
        values = np.stack([self.photographs[place] for place in places])
        if all(place in self.boards for place in places):
            boards = np.stack([self.boards[place] for place in places])
            cosines = [self._board_cosine(place) for place in places]
            values = values / np.where(boards > 0, boards, np.nan) * np.stack(np.broadcast_arrays(*cosines))
        elif capture.intensities is not None:
            values = values / capture.intensities[list(places)].mean(axis=1)[:, None, None].astype(np.float32)
        lamps = self._lamps(places)
        consistency, arrangement = examine_photographs(values, lamps), arrange(values, lamps)
        names = tuple(self.files[place] for place in places)
        directions = capture.lights.directions[list(places)]
        near = None
        if lamps.ndim == 2 and not self.boards and (arrangement is None or arrangement.as_stated):
            near = measure_width(values, lamps)
        return Judgement(places, names, values, directions, consistency, arrangement, near)

    def _board_cosine(self, place: int) -> np.ndarray:
        """cos(theta_W) at each pixel of the reduced picture, or one for all."""
        edges = tuple(np.append(axis[:: self.side], axis[-1] + 1) for axis in (self.rows, self.columns))
        return np.asarray(board_cosine(self.reader, place, edges), np.float32).reshape(
            (1, 1) if self.reader.capture.settings.lights.kind == "direction" else (len(edges[0]) - 1, -1)
        )

    def _lamps(self, places: tuple[int, ...]) -> np.ndarray:
        """Vectors to the lamps, (lights, 3); of lamps at known positions at each pixel, as long as their light is."""
        capture = self.reader.capture
        if capture.settings.lights.kind != "position_mm":
            return capture.lights.directions[list(places)]
        pitch, (row, column, _, _) = capture.settings.pixel_pitch_mm, self.reader.region
        y, x = (axis.reshape(-1, self.side).mean(axis=1) for axis in (self.rows, self.columns))
        y = -(y + row - (self.reader.rows - 1) / 2) * pitch
        x = (x + column - (self.reader.columns - 1) / 2) * pitch
        positions = capture.lights.vectors[list(places)]
        here = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 0.0), axis=2)
        to_lamp = positions[:, None, None, :] - here
        distance = np.linalg.norm(to_lamp, axis=3, keepdims=True)
        if all(place in self.boards for place in places):
            return to_lamp / distance  # the boards hold the fall-off, and their cosine differs from pixel to pixel
        usual = np.median(np.linalg.norm(positions, axis=1))
        return to_lamp / distance * (usual / distance) ** 2


def judgement_problems(judgement: Judgement | None, capture: Capture) -> list[Problem]:
    """What a user should know of a judgement; errors where the lamps do not belong to their photographs."""
    if judgement is None:
        return []
    problems = [] if judgement.arrangement is None else _arrangement_problems(judgement, capture)
    found = judgement.consistency
    if found is None or any(problem.severity == "error" for problem in problems):
        return problems
    problems += near_problems(judgement.near, capture)
    for j in found.failed:
        what, remedy = "the photograph shows no light of its lamp", "Take this photograph again, or leave it out"
        said = f"{100 * found.gain[j]:.1f} % of the light of the others"
        problems.append(warning("lamp-failed", judgement.names[j], what, found=said, remedy=remedy))
    for i, j in found.repeats:
        what = f"the photograph shows the same lamp as {judgement.names[j]}, although two different lamps are stated"
        problems.append(warning("photograph-repeated", judgement.names[i], what, remedy="Leave this photograph out"))
    if found.ambient > max(LEAST_AMBIENT, SURE * found.ambient_sigma):
        what = "all photographs contain light that does not come from their lamps"
        said = f"{100 * found.ambient:.1f} % of a frontal lamp, standard error {100 * found.ambient_sigma:.1f} %"
        remedy = "Darken the room, or photograph the object once without a lamp (role ambient)"
        problems.append(warning("ambient-light", "frames.csv", what, found=said, remedy=remedy))
    return problems


def near_problems(near: NearLamps | None, capture: Capture) -> list[Problem]:
    """Warn of lamps that are taken to be far, although their light falls off across the photographs."""
    if near is None or not near.matters:
        return []
    what = "the light falls off across the photographs as that of lamps near the object, and far lamps are stated"
    said = (
        f"lamps at {1 / near.width:.2g} ± {near.sigma / near.width**2:.1g} times the width of the object; far lamps "
        f"turn the normals by {near.turn_deg:.1f} degrees and bend a flat object by {100 * near.bow:+.1f} % of it"
    )
    remedy = (
        "Convert the photographs again with --lights-kind position_mm --width-mm WIDTH (of the whole photographs on "
        "the object, in millimetres), or photograph a white board under every lamp"
    )
    return [warning("lamps-near", capture.settings.lights.file, what, found=said, remedy=remedy)]


def _arrangement_problems(judgement: Judgement, capture: Capture) -> list[Problem]:
    """lights-order and lights-axes, as errors with the option of `convert` that mends them."""
    arrangement, file = judgement.arrangement, capture.settings.lights.file
    if arrangement.as_stated:
        if not arrangement.mirror_undecided:
            return []
        what = "the photographs do not show which way the y axis of the lights points"
        said = f"curl of the slopes {100 * arrangement.curl[0]:.0f} %, and as little with y mirrored"
        remedy = "If y counts downwards in that file, or hills appear as hollows, convert again with --lights-axes=x,-y"
        return [warning("lights-axes-undecided", file, what, found=said, remedy=remedy)]
    percent = [100 * value for value in (*arrangement.residual, *arrangement.curl)]
    evidence = (
        f"misfit of the photographs {percent[0]:.1f} % as listed, {percent[1]:.1f} % with the remedy; curl of the "
        f"slopes {percent[2]:.0f} % as listed, {percent[3]:.0f} % with the remedy"
    )
    options, kinds = [], []
    number = tuple(range(len(judgement.lights)))
    if arrangement.order != number:
        order = list(range(len(capture.lights.names)))
        for photograph, lamp in enumerate(arrangement.order):
            order[judgement.lights[photograph]] = judgement.lights[lamp]
        options.append(f"--lights-order={order_text(order)}")
        kinds.append(("lights-order", "the photographs show other lamps than those listed for them"))
    if arrangement.axes != "x,y":
        options.append(f"--lights-axes={arrangement.axes}")
        kinds.append(("lights-axes", "the axes of the lights differ from those of the photographs"))
    remedy = f"Convert the photographs again with {' '.join(options)}, or correct {file}"
    if arrangement.axes != "x,y":
        opposite = ",".join(axis[1:] if axis.startswith("-") else f"-{axis}" for axis in arrangement.axes.split(","))
        remedy += f". If hills then appear as hollows, give --lights-axes={opposite} instead"
    return [error(kind, file, what, found=evidence, remedy=remedy) for kind, what in kinds]


def order_text(order: list[int]) -> str:
    """Write an order of lamps as `--lights-order` reads it."""
    count, number = len(order), list(range(len(order)))
    if order == number[::-1]:
        return "reverse"
    step = order[0] if order[0] <= count // 2 else order[0] - count
    if order == [(i + step) % count for i in number]:
        return f"shift:{step}"
    return ",".join(str(i + 1) for i in order)
