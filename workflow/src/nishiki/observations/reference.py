"""Prepare dark frames and white boards, the offsets and gains of photographs.

A board tells how bright its lamp was at each place, and so the gain that makes a perfect white 1 (Tominaga and Tanaka
2004, eq. 3).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.capture.taking import SAME_EXPOSURE
from nishiki.formats.problems import CaptureError, Problem, error, refuse, warning
from nishiki.observations.frames import FrameReader
from nishiki.observations.kernels import block_levels, count_outliers
from nishiki.observations.linearise import Edges

TOO_DARK = 0.02  # of full scale: below it noise and rounding are several percent of the board
BAD_SHARE = 0.25  # of a block's samples
MIN_GOOD_BLOCKS = 0.5  # share below which a board is refused


@dataclass(frozen=True)
class WhiteField:
    """gain (r, c, channels) float32, NaN where the board is unusable; relative to the exposure of the board."""

    gain: np.ndarray
    level: np.ndarray  # median of the board (channels,), fraction of full scale
    uniformity: np.ndarray  # 5th / 95th percentile of the blocks, per channel
    bad_blocks: float  # share of the needed blocks that cannot be used
    problems: tuple[Problem, ...]  # what the user should know


def white_field(
    codes: np.ndarray,
    table: np.ndarray,
    dark: np.ndarray,
    edges: Edges,
    *,
    lit: tuple[np.ndarray | float, float],
    limits: tuple[Any, Any],
    name: str,
    needed: np.ndarray | None = None,
) -> WhiteField:
    """Measure the gain of one lamp from the board's codes (rows, columns, channels).

    gain = reflectance * cos(theta) / (board - dark): the reciprocal of what a perfect diffuser facing the lamp would
    have given. dark (1 or r, 1 or c, channels) in fractions of full scale; lit: cosine between lamp and board's normal,
    a number or (r, c, 1) where the lamp is near, and reflectance; limits: codes that are saturated, or tell only of
    darkness; needed (r, c) bool: blocks that hold part of the object (default all):
    the board need not be larger than the object.
    Raises CaptureError (white-grazing, white-saturated, white-dark) where less than half of the needed board can
    be used.
    """
    (cos_theta, reflectance), (saturated, clip) = lit, limits
    if np.min(cos_theta) <= 0.05:
        found = f"cosine {np.min(cos_theta):.3f}"
        refuse("white-grazing", name, "lamp grazes or lies behind the white board", found=found)
    levels, unusable = block_levels(codes, table, *edges, float(saturated), float(clip))
    board = levels - dark
    bright_share = float((codes >= saturated).any(axis=2).mean())
    least = TOO_DARK
    if codes.dtype.kind != "u":  # float samples have no full scale: relative to their brightest
        brightest = float(board[np.isfinite(board)].max(initial=0.0))
        least = max(TOO_DARK * brightest, float(np.finfo(np.float32).tiny))
    with np.errstate(invalid="ignore"):
        too_dark = ~(board >= least)
        bad = (too_dark | (unusable > BAD_SHARE)).any(axis=2)
    needed = np.ones(bad.shape, bool) if needed is None else needed
    bad_share = float(bad[needed].mean())
    if bad_share > 1 - MIN_GOOD_BLOCKS:
        raise CaptureError(_unusable_board(name, bright_share, board[needed]))
    gain = np.where(bad[:, :, None], np.nan, reflectance * cos_theta / np.where(bad[:, :, None], 1.0, board))
    problems = ()
    if bad_share > 0:
        found = f"{100 * bad_share:.1f} % of the blocks; saturated samples {100 * bright_share:.1f} %"
        remedy = "Samples there are marked as not valid under this light"
        problems = (warning("white-partial", name, "white board is partly unusable", found=found, remedy=remedy),)
    good = board[needed & ~bad]
    low, high = np.percentile(good, [5, 95], axis=0)
    return WhiteField(gain.astype(np.float32), np.median(good, axis=0), low / high, bad_share, problems)


def _unusable_board(name: str, bright_share: float, board: np.ndarray) -> Problem:
    """Make the error of an unusable board: too bright or too dark."""
    if bright_share > 0.25:
        found = f"{100 * bright_share:.0f} % of its pixels"
        remedy = "Expose the board less (give exposure_s) or use a grey board with its reflectance"
        return error("white-saturated", name, "white board is saturated", found=found, remedy=remedy)
    level = float(np.nanmedian(board)) if np.isfinite(board).any() else 0.0
    found, expected = f"median {100 * level:.2f} % of full scale", f"at least {100 * TOO_DARK:g} %"
    remedy = "Expose the board longer (give exposure_s), or check that it fills the picture"
    return error("white-dark", name, "white board is too dark or uneven", expected=expected, found=found, remedy=remedy)


HOT = 0.02  # of full scale above its block in the dark; see `hot_limit` for samples without a full scale
DEAD = 0.1  # of its block's level on the white board


@dataclass(frozen=True)
class DarkField:
    """Dark level by exposure: levels[i] (r, c, channels) or (1, 1, channels) float32 for exposures_s[i] (None: any)."""

    exposures_s: tuple[float | None, ...]
    levels: tuple[np.ndarray, ...]
    defect: np.ndarray  # (rows, columns) bool: hot pixels
    problems: tuple[Problem, ...]

    def at(self, exposure_s: float | None) -> np.ndarray:
        """Return the level whose exposure is nearest (in ratio); the only one where exposures are not given."""
        if exposure_s is None or self.exposures_s[0] is None:
            return self.levels[0]
        ratios = [abs(np.log(level_exposure / exposure_s)) for level_exposure in self.exposures_s]
        return self.levels[int(np.argmin(ratios))]

    def for_frames(self, frames: tuple[Frame, ...]) -> np.ndarray:
        """Return dark levels (lights, r, c, channels) float32, or one light's where it is the same for all."""
        levels = [self.at(frame.exposure_s) for frame in frames]
        if all(level is levels[0] for level in levels):
            levels = levels[:1]
        shape = np.broadcast_shapes(*(level.shape for level in levels))
        return np.stack([np.broadcast_to(level, shape) for level in levels]).astype(np.float32)


@dataclass(frozen=True)
class Gains:
    """gain (lights, r, c, channels) float32 of the observed frames; levels and uniformity of the boards, worst channel.

    defect (rows, columns) bool: dead pixels.
    """

    gain: np.ndarray
    levels: tuple[float, ...]
    uniformity: tuple[float, ...]
    defect: np.ndarray
    problems: tuple[Problem, ...]

    def of(self, kept: np.ndarray) -> "Gains":
        """Select the frames of these numbers."""
        levels, uniformity = (tuple(some[j] for j in kept) if some else () for some in (self.levels, self.uniformity))
        return replace(self, gain=self.gain[kept], levels=levels, uniformity=uniformity)


def measure_darks(reader: FrameReader, edges: Edges, tick: Callable[[str], None]) -> DarkField:
    """Average the dark frames of each exposure; camera.black_level where there are none."""
    frames = reader.capture.frames_of("dark")
    shape = reader.region[2:]
    if not frames:
        level = np.full((1, 1, len(reader.names)), reader.black, np.float32)
        return DarkField((None,), (level,), np.zeros(shape, bool), ())
    sums: dict[float | None, list] = {}
    hot, limit = np.zeros(shape, np.uint16), hot_limit(reader, edges)
    for frame, codes in reader.read_all(frames):
        level, _ = block_levels(codes, reader.table, *edges, np.inf, -np.inf)
        count_outliers(codes, reader.table, level, *edges, -np.inf, limit, hot)
        entry = sums.setdefault(frame.exposure_s, [np.zeros(level.shape), 0])
        entry[0] += level
        entry[1] += 1
        tick(frame.file)
    exposures = tuple(sums)
    step = 1.0 / reader.full if reader.dtype.kind == "u" else 0.0
    levels = []
    for total, count in sums.values():
        level = (total / count).astype(np.float32)
        low, high = np.percentile(level, [1, 99], axis=(0, 1))
        if ((high - low) < step).all():  # one value a channel: reading is then twice as fast
            level = level.mean(axis=(0, 1), keepdims=True)
        levels.append(level)
    problems = _dark_problems(reader, exposures)
    return DarkField(exposures, tuple(levels), hot > len(frames) // 2, problems)


def measure_room(reader: FrameReader, darks: DarkField, tick: Callable[[str], None]) -> np.ndarray | None:
    """Average the photographs of ambient light.

    Returns (rows, columns, channels) float16 linear light at exposure 1 (see `Frame.exposure`), of which half a per
    mille is lost in that type; None where there are no such photographs.
    """
    import cv2

    frames = reader.capture.frames_of("ambient")
    total = None
    for frame, codes in reader.read_all(frames):
        light = codes.astype(np.float32) if codes.dtype.kind == "f" else reader.table[codes]
        level = darks.at(frame.exposure_s)
        light -= level if level.shape[:2] == (1, 1) else cv2.resize(level, codes.shape[1::-1]).reshape(codes.shape)
        light = np.nan_to_num(np.maximum(light, 0)) / np.float32((frame.exposure or 1) * len(frames))
        total = light if total is None else total + light
        tick(frame.file)
    return None if total is None else total.astype(np.float16)


def hot_limit(reader: FrameReader, edges: Edges) -> float:
    """Compute the linear value above its block from which a dark pixel is hot: HOT of full scale, at any bit depth.

    Float samples have a full scale only where the capture says from which value they are saturated; else the brightest
    block of the first white board, or of the first photograph of the object, stands for it.
    """
    if reader.dtype.kind == "u":
        return HOT
    if np.isfinite(reader.saturated):
        return HOT * float(reader.saturated)
    codes = reader.read((reader.capture.frames_of("white") or reader.capture.observed)[0])
    levels, _ = block_levels(codes, reader.table, *edges, np.inf, -np.inf)
    brightest = float(np.max(levels, initial=0, where=np.isfinite(levels)))
    return HOT * brightest if brightest > 0 else np.inf


def _dark_problems(reader: FrameReader, exposures: tuple[float | None, ...]) -> tuple[Problem, ...]:
    if None in exposures:
        return ()
    lit = {f.exposure_s for f in reader.capture.frames if f.role in ("sample", "check", "white") and f.exposure_s}
    far = [t for t in sorted(lit) if all(abs(t / dark_exposure - 1) > SAME_EXPOSURE for dark_exposure in exposures)]
    if not far:
        return ()
    found = f"exposures {', '.join(f'{t:g} s' for t in far[:4])}"
    remedy = "The nearest in time was used; photograph dark frames at every exposure time"
    return (warning("dark-exposure", "frames.csv", "no dark frame of the same exposure", found=found, remedy=remedy),)


def measure_gains(
    reader: FrameReader, darks: DarkField, edges: Edges, mask: np.ndarray, tick: Callable[[str], None]
) -> Gains:
    """Compute the gain of each observed frame: from its board, else the lights' intensities, else from exposure."""
    capture, shape = reader.capture, reader.region[2:]
    observed = capture.observed
    if not capture.frames_of("white"):
        longest = max((f.exposure for f in observed if f.exposure), default=1.0)
        scale = np.array([longest / (f.exposure or longest) for f in observed])[:, None]
        places = [capture.lights.index(f.light) for f in observed]
        stored = capture.intensities[places] if capture.intensities is not None else np.ones((1, len(reader.stored)))
        gain = np.broadcast_to(scale / (stored @ reader.weights.T), (len(observed), len(reader.names)))
        return Gains(gain[:, None, None, :].astype(np.float32), (), (), np.zeros(shape, bool), ())
    by_light = {capture.lights.find(white.light): white for white in capture.frames_of("white")}
    whites = [by_light[capture.lights.find(frame.light)] for frame in observed]
    fields, dead = board_fields(reader, whites, darks, edges, tick, mask)
    ratios = [(white.exposure or 1.0) / (f.exposure or 1.0) for white, f in zip(whites, observed, strict=True)]
    gain = np.stack([field.gain * np.float32(ratio) for field, ratio in zip(fields, ratios, strict=True)])
    levels, uniformity = (
        tuple(float(getattr(field, name).min()) for field in fields) for name in ("level", "uniformity")
    )
    return Gains(gain, levels, uniformity, dead, tuple(problem for field in fields for problem in field.problems))


def board_fields(
    reader: FrameReader,
    whites: Sequence[Frame],
    darks: DarkField,
    edges: Edges,
    tick: Callable[[str], None],
    mask: np.ndarray | None = None,
) -> tuple[list[WhiteField], np.ndarray]:
    """Measure the gain of each white frame, and find the pixels (rows, columns) that are dead: dark on all boards.

    CaptureError where a board cannot be used.
    """
    fields, counts = [], np.zeros(reader.region[2:], np.uint16)
    for frame, codes in reader.read_all(whites):
        field = board_field(reader, frame, codes, darks, edges, mask)
        board = field.level.astype(np.float32) + darks.at(frame.exposure_s).mean(axis=(0, 1))
        expected = np.broadcast_to(board, (len(edges[0]) - 1, len(edges[1]) - 1, len(board)))
        count_outliers(codes, reader.table, np.ascontiguousarray(expected), *edges, DEAD, np.inf, counts)
        fields.append(field)
        tick(frame.file)
    return fields, counts == len(whites)


def board_field(
    reader: FrameReader, frame: Frame, codes: np.ndarray, darks: DarkField, edges: Edges, mask: np.ndarray | None
) -> WhiteField:
    """Measure the gain of one white frame over the mask (rows, columns), or all. CaptureError where it is unusable."""
    needed = None
    if mask is not None:
        rows = np.add.reduceat(mask, edges[0][:-1], axis=0, dtype=np.int64)
        needed = np.add.reduceat(rows, edges[1][:-1], axis=1) > 0
    cosine = board_cosine(reader, frame.light, edges)
    return white_field(
        codes, reader.table, darks.at(frame.exposure_s), edges,
        lit=(cosine, reader.capture.settings.white.reflectance), limits=(reader.saturated, reader.clip),
        name=frame.file, needed=needed,
    )  # fmt: skip


def board_cosine(reader: FrameReader, light: str, edges: Edges) -> np.ndarray | float:
    """Compute cos(theta_W): one number for a distant lamp, (r, c, 1) at the block centres for a lamp at a position.

    1 for lamps of a turntable of which no direction is known.
    """
    settings, lights = reader.capture.settings, reader.capture.lights
    normal = np.array(settings.white.normal)
    if settings.lights is not None and settings.lights.kind == "direction" and lights is not None:
        return float(lights.directions[lights.index(light)] @ normal)
    if reader.capture.geometry != "plane":
        return 1.0
    row, column, _, _ = reader.region
    centres = [(e[:-1] + e[1:] - 1) / 2 for e in edges]
    here = points_mm(reader, centres[0] + row, centres[1] + column)
    to_lamp = lights.vectors[lights.index(light)] - here
    return ((to_lamp @ normal) / np.linalg.norm(to_lamp, axis=-1))[..., None]


def points_mm(reader: FrameReader, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Compute points (r, c, 3) of the object plane at rows and columns of the photograph, from its middle."""
    x = (columns - (reader.columns - 1) / 2) * reader.capture.settings.pixel_pitch_mm
    y = ((reader.rows - 1) / 2 - rows) * reader.capture.settings.pixel_pitch_mm
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 0.0), axis=2)
