"""Compare the photographs of a plane capture: reduced while they are decoded, then judged together.

The check of a capture and ingest measure the same by the same: the movement of the camera
(`nishiki.observations.registration`), and with the photographs brought together what each says of its lamp
(`nishiki.photometric.consistency`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from nishiki.capture.folder import MIRROR_BALLS, Capture
from nishiki.capture.frames import Frame
from nishiki.errors import require
from nishiki.formats.problems import Problem, error, error_text, name_some, warning
from nishiki.observations.frames import FrameReader
from nishiki.observations.reference import DarkField, board_cosine, points_mm
from nishiki.observations.registration import MARGIN, Movement, Window, align_window, choose_places, measure_movement
from nishiki.photometric.arrangement import EXCHANGED, Arrangement, arrange, name_heights, turn_by_half
from nishiki.photometric.board_pairs import ALONE, BoardPairs, pair_boards
from nishiki.photometric.consistency import (
    LEAST_AMBIENT,
    SURE,
    Consistency,
    NearLamps,
    examine_photographs,
    measure_width,
    probable_strengths,
)
from nishiki.photometric.curves import find_coded

LONGEST = 256  # pixels of a reduced photograph along its longer side: relief is coarser, texture mostly finer
CELLS = 3  # a side, of a reduced pixel, whose codes are averaged before they are decoded: a curve is straight over them
INSIDE = 0.95  # of a reduced pixel that must show the object
LEAST_MISFIT = 0.02  # of a photograph that repeats another one: an even object looks alike under many lamps
DARKER, UNLIKE = 1 / 255, 0.2  # of full scale and of the dark level, by which a sample must lie below that level to
# count as darker: a code of 8 bits, and the drift of warm sensors
MOST_DARKER = 0.05  # share of such samples in a photograph, which noise does not reach
LEAST_IMPROVEMENT = 0.07  # of the misfit that undoing a movement takes away: 0.11 and more for shifts of 1.2 pixels of
# the measured sets, 0.055 on the fossil, whose low lamps shift the texture of its relief


@dataclass(frozen=True)
class Judgement:
    """Evidence of the photographs on themselves and on their lamps."""

    lights: tuple[int, ...]  # places of the lamps in the lights file
    names: tuple[str, ...]  # files of the photographs
    # (lights, rows, columns, channels) float32: reduced photographs, divided by their boards or strengths where there
    # are any; NaN where saturated or outside of the object
    values: np.ndarray
    # (lights, 3) or (lights, rows, columns, 3) float64: vectors to the lamps, see `examine_photographs`
    lamps: np.ndarray
    directions: np.ndarray  # (lights, 3) float64: unit vectors to the lamps as stated
    movement: Movement  # of the camera between the photographs
    # (lights,) bool: photographs that moved so that the others explain them better once the movement is undone
    moved: np.ndarray
    aligned: np.ndarray  # (lights, rows, columns, channels) float32: `values` with that movement undone
    # before, consistency: what each photograph shows as it is, and with the movement undone; None where nothing can be
    # told
    before: Consistency | None
    consistency: Consistency | None
    # (lights, rows, columns) float32 or None: the white boards at equal exposure; None where a photograph has none
    boards: np.ndarray | None

    @cached_property
    def grey(self) -> np.ndarray:
        """(lights, rows, columns): mean of the channels, with the movement undone."""
        return self.aligned.mean(axis=3)

    @cached_property
    def coded(self) -> np.ndarray:
        """(lights,) bool: photographs that were saved with another tone curve than the others."""
        coded = find_coded(self.grey, self.lamps)
        return np.zeros(len(self.lights), bool) if coded is None else coded

    @cached_property
    def arrangement(self) -> Arrangement | None:
        """Order and axes of the lamps that fit the photographs best; None where undetermined."""
        return arrange(self.grey, self.lamps)

    @cached_property
    def pairs(self) -> BoardPairs | None:
        """Boards that belong to the photographs; None where there are none, or where undetermined."""
        pairs = None if self.boards is None else pair_boards(self.grey, self.boards, self.lamps)
        found = self.consistency
        if self.boards is None or pairs is not None or found is None or not found.holds(self.directions, but_one=True):
            return pairs
        logs, covariance = probable_strengths(found, self.directions)  # one board far off hides the order of all
        excess = np.abs(logs) - np.maximum(ALONE, SURE * np.sqrt(np.diag(covariance)))
        return BoardPairs(np.arange(len(logs)), logs, logs, (excess > 0) & (excess == excess.max()))

    @cached_property
    def near(self) -> NearLamps | None:
        """Distance of directed lamps by the fall-off of their light, in widths of these pictures; None: unknown."""
        if self.lamps.ndim > 2 or self.boards is not None:
            return None
        found = self.arrangement
        if found is not None and (found.rearranged or found.unexplained):
            return None
        return measure_width(self.grey, self.lamps)


@dataclass
class ReducedPhotographs:
    """Photographs and boards reduced frame by frame to linear light, and windows at full resolution."""

    reader: FrameReader
    darks: DarkField
    mask: np.ndarray  # (rows, columns): the object
    # (lights, r, c, channels): of the observed frames, see `nishiki.observations.reference.Gains`; without it boards
    # and intensities are divided by here
    gain: np.ndarray | None = None
    # photographs, boards: by place of the lamp, (rows, columns, channels) float32, NaN where saturated
    photographs: dict[int, np.ndarray] = field(default_factory=dict)
    boards: dict[int, np.ndarray] = field(default_factory=dict)
    windows: dict[int, list[np.ndarray]] = field(default_factory=dict)  # windows, files: of the photographs
    files: dict[int, str] = field(default_factory=dict)
    darker: dict[str, float] = field(default_factory=dict)  # by file, share of the samples below the dark level

    def __post_init__(self):
        import cv2

        edges = [np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0)]
        self.step = max(1, -(-max(edge[-1] + 1 - edge[0] for edge in edges) // LONGEST))
        self.shape = tuple(int(edge[-1] + 1 - edge[0]) // self.step for edge in edges)
        (top, *_), (left, *_) = edges
        rows, columns = (n * self.step for n in self.shape)
        self.part = slice(top, top + rows), slice(left, left + columns)
        covered = cv2.resize(self.mask[self.part].astype(np.float32), self.shape[::-1], interpolation=cv2.INTER_AREA)
        self.inside = covered >= INSIDE
        self.places: list[tuple[slice, slice]] | None = [] if self.step == 1 else None

    def add(self, frame: Frame, codes: np.ndarray) -> None:
        """Add the codes (rows, columns, channels) of a white frame or of a photograph of the object."""
        place = self.reader.capture.lights.find(frame.light)
        if place is None or frame.role not in ("sample", "check", "white"):
            return
        dark = self.darks.at(frame.exposure_s).mean(axis=(0, 1))
        values = self._reduce(codes[self.part]) - dark
        if frame.role == "white":
            self.boards[place] = values / (frame.exposure or 1.0)
            return
        if dark.any():  # full scale of floats is that of the photograph: noise about 0 in any unit is no dark level
            least = DARKER * np.nanmax(values, initial=1.0)
            self.darker[frame.file] = float(np.mean(values < -np.maximum(UNLIKE * dark, least)))
        if self.places is None:
            self.places = choose_places(np.nan_to_num(values.mean(axis=2)), self.inside, self.step, self.part)
        if self.gain is None:
            values /= frame.exposure or 1.0
        else:
            values *= self._spread(self.gain[len(self.photographs)])
        self.photographs[place], self.files[place] = values, frame.file
        self.windows[place] = [self._linear(codes[part]).mean(axis=2).astype(np.float16) for part in self.places]

    def _linear(self, codes: np.ndarray) -> np.ndarray:
        return codes.astype(np.float32) if codes.dtype.kind == "f" else self.reader.table[codes]

    def _reduce(self, codes: np.ndarray) -> np.ndarray:
        """Compute linear light (rows, columns, channels) of the mean of each block, NaN where a pixel is saturated."""
        import cv2

        (rows, columns), cells = self.shape, min(CELLS, self.step)
        highest = codes.reshape(rows, self.step, -1).max(axis=1).reshape(rows, columns, -1).max(axis=2)
        if self.step > cells:
            codes = cv2.resize(codes, (columns * cells, rows * cells), interpolation=cv2.INTER_AREA)
        values = self._linear(codes).reshape(rows, cells, columns, cells, -1).mean(axis=(1, 3), dtype=np.float32)
        values[highest >= self.reader.saturated] = np.nan
        return values

    def _spread(self, gain: np.ndarray) -> np.ndarray:
        """Interpolate a gain (r, c, channels) to the pixels of the reduced picture, or return the common one."""
        import cv2

        if gain.shape[:2] == (1, 1):
            return gain
        rows, columns = (n // self.step for n in self.mask.shape)
        whole = cv2.resize(gain, (columns, rows)).reshape(rows, columns, -1)
        top, left = (part.start // self.step for part in self.part)
        return whole[top : top + self.shape[0], left : left + self.shape[1]]

    def judge(self, places: Sequence[int] | None = None) -> Judgement | None:
        """Compare the photographs under these lamps with each other, in the lamps' order.

        None where there are too few, and of pictures rendered from a relightable image: the lamps are those that it was
        rendered under, and its smooth shadows would pass for light of the room. The photographs are brought together
        where they moved, and where each is then better predicted from the others.
        """
        capture = self.reader.capture
        places = tuple(sorted(self.photographs) if places is None else places)
        if len(places) < 2 or capture.settings.rendered_from:
            return None
        values, directions = np.stack([self.photographs[i] for i in places]), capture.lights.directions[list(places)]
        movement = self._movement(values, places, directions)
        values[:, ~self.inside] = np.nan
        values, lamps = self._divide(values, places), self._lamps(places)
        before = consistency = examine_photographs(values, lamps)
        moved, aligned = movement.moved, values
        if moved.any():
            each = np.moveaxis(values, 3, 0)
            channels = [align_window(self._whole(some), movement, replicate=False)[0] for some in each]
            together = np.where(self.inside[:, :, None], np.stack(channels, axis=3), np.float32(np.nan))
            after = examine_photographs(together, lamps)
            # Highlights of a mirror move with the lamp: where nothing can be predicted, nothing is concluded.
            residuals = [np.nansum(one.residual) for one in (before, after) if one is not None]
            if len(residuals) == 2 and residuals[1] < (1 - LEAST_IMPROVEMENT) * residuals[0]:
                aligned, consistency = together, after
            else:
                moved = np.zeros(len(places), bool)
        boards = self._levels_of_boards(places) if self._all_boards(places) else None
        seen = values, lamps, directions, movement, moved, aligned, before, consistency, boards
        return Judgement(places, tuple(self.files[i] for i in places), *seen)

    def _movement(self, values: np.ndarray, places: tuple[int, ...], directions: np.ndarray) -> Movement:
        """Measure the movement of the camera."""
        windows = []
        for k, (rows, columns) in enumerate(self.places or []):
            pictures = [self.windows[i][k] for i in places]
            corner = np.array([columns.start, rows.start], float)
            windows.append(Window(pictures, self.mask[rows, columns] != 0, corner, np.ones(2), MARGIN))
        grey = values.mean(axis=3)
        brightest = np.nanmax(grey, axis=(1, 2), keepdims=True, initial=0)  # saturated pixels are as bright as any
        return measure_movement(self._whole(np.where(np.isnan(grey), brightest, grey)), windows, directions)

    def _whole(self, pictures: np.ndarray) -> Window:
        corner = np.array([part.start for part in self.part[::-1]]) + (self.step - 1) / 2
        return Window(list(pictures), self.inside, corner, np.full(2, float(self.step)))

    def _divide(self, values: np.ndarray, places: tuple[int, ...]) -> np.ndarray:
        """Divide the values by their boards or by the strengths of the lamps, unless their gains include these."""
        capture = self.reader.capture
        if self.gain is not None:
            return values
        if self._all_boards(places):
            boards = np.stack([self.boards[i] for i in places])
            cosines = np.stack([np.broadcast_to(self._board_cosine(i), boards.shape[1:]) for i in places])
            return (values / np.where(boards > 0, boards, np.nan) * cosines).astype(np.float32)
        if capture.intensities is None:
            return values
        strengths = capture.intensities[list(places)] @ self.reader.weights.T
        return values / strengths[:, None, None, :].astype(np.float32)

    def _levels_of_boards(self, places: tuple[int, ...]) -> np.ndarray:
        """Return the boards (lights, rows, columns) at equal exposure; from the gains where these were made of them."""
        if self.gain is None:
            return np.stack([self.boards[i].mean(axis=2) for i in places])
        boards = []
        for frame, gain in zip(self.reader.capture.observed, self.gain, strict=True):
            place = self.reader.capture.lights.find(frame.light)
            level = self._board_cosine(place) / (frame.exposure or 1.0) / self._spread(gain)
            boards.append(np.broadcast_to(level.mean(axis=2), self.shape))
        return np.stack(boards)

    def _all_boards(self, places: tuple[int, ...]) -> bool:
        if self.gain is None:
            return set(places) <= set(self.boards)
        return bool(self.reader.capture.frames_of("white"))

    def _board_cosine(self, place: int) -> np.ndarray | float:
        """Compute cos(theta_W) at each pixel of the reduced picture, or one for all."""
        edges = tuple(part.start + self.step * np.arange(n + 1) for part, n in zip(self.part, self.shape, strict=True))
        return board_cosine(self.reader, self.reader.capture.lights.names[place], edges)

    def _lamps(self, places: tuple[int, ...]) -> np.ndarray:
        """Compute lamp vectors (lights, 3), scaled by their light; for known positions at each pixel."""
        capture = self.reader.capture
        if capture.settings.lights.kind != "position_mm":
            return capture.lights.directions[list(places)]
        rows, columns = (
            part.start + self.step * np.arange(n) + (self.step - 1) / 2 + corner
            for part, n, corner in zip(self.part, self.shape, self.reader.region, strict=False)
        )
        positions = capture.lights.vectors[list(places)]
        to_lamp = positions[:, None, None, :] - points_mm(self.reader, rows, columns)
        distance = np.linalg.norm(to_lamp, axis=3, keepdims=True)
        if self._all_boards(places):
            return to_lamp / distance  # the boards hold the fall-off, and their cosine differs from pixel to pixel
        usual = np.median(np.linalg.norm(positions, axis=1))
        return to_lamp / distance * (usual / distance) ** 2


def dark_problems(darker: dict[str, float]) -> list[Problem]:
    """Refuse dark frames or a black level above the darkest parts of photographs; darker: see `ReducedPhotographs`."""
    file = max(darker, key=lambda name: darker[name], default="")
    if not darker or np.median(list(darker.values())) < MOST_DARKER:  # a single one may be black
        return []
    what = f"{100 * darker[file]:.0f} % of the photograph is darker than the dark frames or camera.black_level"
    remedy = "Photograph dark frames with the lens capped, or leave them out; correct camera.black_level if set"
    return [error("dark-bright", file, what, remedy=remedy)]


def movement_problems(judgement: Judgement, registers: bool | None = None) -> list[Problem]:
    """Warn of camera movement. registers: whether photographs are moved back; None where ingest decides that."""
    moved, movement = judgement.moved, judgement.movement
    if not moved.any():
        return []
    far = int(np.argmax(np.where(moved, movement.largest, 0)))
    x, y = movement.shift[far]
    listed = name_some(name for name, each in zip(judgement.names, moved, strict=True) if each)
    found = f"{moved.sum()} of {len(moved)} ({listed}), {judgement.names[far]} most: {x:+.1f}, {y:+.1f} pixels"
    if movement.turn.any():
        found += f", turned by {np.degrees(movement.turn[far]):.2f} degrees"
    what, remedy = "the camera moved between the photographs", "Fasten the camera and the object more firmly"
    if registers is False:
        remedy = "Set ingest.correct.registration: auto to move them back"
    else:
        what += "; ingest moves them back" if registers is None else "; they are moved back"
        remedy += ". To leave them as they are, set ingest.correct.registration: never"
    return [warning("camera-moved", judgement.names[far], what, found=found, remedy=remedy)]


def judgement_problems(judgement: Judgement | None, capture: Capture) -> list[Problem]:
    """List problems of a judgement for the user; errors where the lamps do not match their photographs."""
    if judgement is None:
        return []
    problems = movement_problems(judgement) + pair_problems(judgement, capture)
    if judgement.coded.any():  # such photographs contradict any list of lamps
        problems += curve_problems(judgement)
    elif judgement.arrangement is not None:
        problems += _arrangement_problems(judgement, judgement.arrangement, capture)
    found = judgement.consistency
    if found is None or any(problem.severity == "error" for problem in problems):
        return problems
    problems += near_problems(judgement.near, capture)
    problems += useless_problems(useless_photographs(judgement, found), judgement.names)
    return problems + ambient_problems(found, capture)


def curve_problems(judgement: Judgement) -> list[Problem]:
    """Warn of photographs that were saved with another tone curve than the others."""
    names = [name for name, coded in zip(judgement.names, judgement.coded, strict=True) if coded]
    what = "photographs were saved with another tone curve than the others: decoded, they suit these far better"
    found = f"{len(names)} of {len(judgement.names)} ({name_some(names)})"
    remedy = (
        "Export all photographs in one go, with one setting, and convert them again; where the room's light burned "
        "during some of them, leave these out"
    )
    return [warning("curves-differ", names[0], what, found=found, remedy=remedy)]


def pair_problems(judgement: Judgement, capture: Capture) -> list[Problem]:
    """Warn of white boards that belong to other photographs, and of photographs that match no board."""
    pairs, problems = judgement.pairs, []
    if pairs is None:
        return []
    names = [capture.lights.names[i] for i in judgement.lights]
    boards = [require(capture.white_of(name)).file for name in names]
    moved = np.flatnonzero(pairs.board != np.arange(len(names)))
    if len(moved):
        listed = name_some(f"{boards[pairs.board[j]]} for light {names[j]}" for j in moved)
        was, would = (100 * np.expm1(np.abs(level[moved]).mean()) for level in (pairs.before, pairs.after))
        what = "white boards do not belong to their photographs: other boards fit better"
        said = f"{listed}; mean misfit {was:.0f} % as listed, {would:.0f} % then"
        remedy = "Compare the boards with the photographs and correct the column light of the white frames"
        problems.append(warning("white-exchanged", "frames.csv", what, found=said, remedy=remedy))
    for j in np.flatnonzero(pairs.alone):
        factor, than = np.exp(abs(pairs.before[j])), "brighter" if pairs.before[j] > 0 else "darker"
        what = f"photograph is {factor:.1f} times {than} than expected from its white board and the other photographs"
        remedy = "Check exposure, lamp and board of this light"
        problems.append(warning("white-disagrees", judgement.names[j], what, found=boards[j], remedy=remedy))
    return problems


def useless_photographs(judgement: Judgement, found: Consistency | None) -> dict[int, tuple[str, str]]:
    """Select unusable photographs, by number: the kind of the problem, and the reason."""
    if found is None:
        return {}
    useless = dict.fromkeys(found.failed, ("lamp-failed", "its lamp did not burn"))
    for worse, other in found.repeats:
        if worse not in useless and other not in useless and found.residual[worse] > LEAST_MISFIT:
            useless[worse] = ("photograph-repeated", f"it shows the lamp of {judgement.names[other]}")
    for j, angle in found.find_strangers(judgement.directions).items():
        reason = f"the others contradict it, and its light seems to come from {angle:.0f} degrees off its lamp"
        useless.setdefault(j, ("photograph-contradicts", reason))
    for j, level in found.find_lit(judgement.directions).items():
        error_of_level = error_text(100 * found.offset_sigma[j], 1)
        reason = f"it holds light of the room, {100 * level:.1f} {error_of_level} % of a frontal lamp, that others lack"
        useless.setdefault(j, ("room-light-differs", reason))
    return useless


def useless_problems(
    useless: dict[int, tuple[str, str]], names: Sequence[str], leaves: bool | None = None
) -> list[Problem]:
    """Warn of unusable photographs; leaves: whether they are omitted, None where ingest decides that."""
    done = {True: "is left out", False: "is of no use", None: "is of no use; ingest leaves it out"}[leaves]
    remedy = "Photograph it again" + (", or set ingest.correct.leave_out: auto" if leaves is False else "")
    return [
        warning(kind, names[j], f"the photograph {done}: {reason}", remedy=remedy)
        for j, (kind, reason) in sorted(useless.items())
    ]


def ambient_problems(found: Consistency, capture: Capture, subtracts: bool | None = None) -> list[Problem]:
    """Warn of ambient light; subtracts: whether it is subtracted, None where ingest decides that."""
    if found.ambient <= max(LEAST_AMBIENT, SURE * found.ambient_sigma):
        return []
    more, than = ("more ", " than those without a lamp") if capture.frames_of("ambient") else ("", "")
    what = f"the photographs contain {more}light of the room{than}"
    if subtracts is not False:
        what += "; its estimate is subtracted" if subtracts else "; ingest subtracts its estimate"
    said = f"{100 * found.ambient:.1f} {error_text(100 * found.ambient_sigma, 1)} % of a lamp that faces the object"
    remedy = "Darken the room, or photograph the object once without a lamp (role ambient)"
    return [warning("room-light", "frames.csv", what, found=said, remedy=remedy)]


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


def _arrangement_problems(judgement: Judgement, arrangement: Arrangement, capture: Capture) -> list[Problem]:
    """Make lights-order and lights-axes, as errors with the option of `convert` that corrects them.

    Warn of axes that are not decided, and of heights, which may be right where the colour changes with the slope.
    """
    file, axes = capture.settings.lights.file, arrangement.axes
    decided = capture.settings.lights.axes_confirmed or (capture.payload / MIRROR_BALLS).exists()
    confirmed = "where the file is right, with --lights-axes=x,y, or set lights.axes_confirmed: true in capture.yaml"
    if arrangement.unexplained:
        what = "the photographs contradict the list of lamps, and no order of the lamps was found that explains them"
        found = f"misfit of the photographs {100 * arrangement.residual[0]:.1f} %"
        remedy = f"Compare {file} with the photographs (check --open shows them), or measure the lamps on mirror balls"
        return [error("lights-order", file, what, found=found, remedy=remedy)]
    percent = [100 * value for value in (*arrangement.residual, *arrangement.curl)]
    problems = []
    if arrangement.as_stated and arrangement.mirror_undecided and not decided:
        what = "the photographs do not show which way the y axis of the lights points"
        said = f"curl of the slopes {percent[2]:.0f} %, and as little with y mirrored"
        remedy = (
            "If y counts downwards in that file, or hills appear as hollows, convert again with --lights-axes=x,-y; "
            f"{confirmed}"
        )
        problems.append(warning("lights-axes-undecided", file, what, found=said, remedy=remedy))
    if arrangement.height != 1 and not decided:
        what = "heights of the lamps do not suit their other coordinates, or the object's colour changes with its slope"
        said = f"the albedo is far more even with heights multiplied by {arrangement.height:.3g} ± 20 %"
        remedy = (
            "If z was listed in another unit, or elevations are wrong, convert again with the same options and "
            f"--lights-axes={name_heights(axes, arrangement.height)}; {confirmed}"
        )
        problems.append(warning("lights-heights-undecided", file, what, found=said, remedy=remedy))
    if not arrangement.rearranged:
        return problems
    evidence = (
        f"misfit of the photographs {percent[0]:.1f} % as listed, {percent[1]:.1f} % with the remedy; curl of the "
        f"slopes {percent[2]:.0f} % as listed, {percent[3]:.0f} % with the remedy"
    )
    kinds, options, opposite = [], [], ""
    if arrangement.order != tuple(range(len(judgement.lights))):
        order = list(range(len(capture.lights.names)))
        for photograph, lamp in enumerate(arrangement.order):
            order[judgement.lights[photograph]] = judgement.lights[lamp]
        options.append(f"--lights-order={order_text(order)}")
        kinds.append(("lights-order", "the photographs show other lamps than those listed for them"))
    if axes != "x,y":
        options.append(f"--lights-axes={axes}")
        kinds.append(("lights-axes", "the axes of the lights differ from those of the photographs"))
        if axes != EXCHANGED:
            opposite = f". If hills then appear as hollows, give --lights-axes={turn_by_half(axes)} instead"
            if arrangement.height != 1:
                scaled = name_heights(axes, arrangement.height)
                opposite += f"; if z was listed in another unit, --lights-axes={scaled}"
    remedy = f"Convert the photographs again with {' '.join(options)}, or correct {file}{opposite}"
    return problems + [error(kind, file, what, found=evidence, remedy=remedy) for kind, what in kinds]


def order_text(order: list[int]) -> str:
    """Write an order of lamps in the syntax of `--lights-order`."""
    count, step = len(order), order[0]
    if order == list(range(count))[::-1]:
        return "reverse"
    if order == [(i + step) % count for i in range(count)]:
        return f"shift:{step if step <= count // 2 else step - count}"
    return ",".join(str(i + 1) for i in order)
