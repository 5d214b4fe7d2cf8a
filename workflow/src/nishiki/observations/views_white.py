"""White boards of a turntable: those that normalise every view, and those that are kept for each polariser state."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nishiki.capture.turntable import TurntableCapture
from nishiki.formats.problems import Problem
from nishiki.observations.block_kernels import count_outliers
from nishiki.observations.blocks import Edges, grid_of, on_one_grid
from nishiki.observations.frames import FrameReader
from nishiki.observations.linearise import straight_scale
from nishiki.observations.reference import DEAD, DarkField, white_field
from nishiki.observations.store_parts import Tick
from nishiki.observations.views_decode import view_values


@dataclass(frozen=True)
class Whites:
    """Gains of the white boards.

    gain (lights, r, c, channels) float32 at the exposure of the board's light, NaN where the board cannot be used; ones
    (lights, 1, 1, channels) where none normalises. scale: factor of each observed frame for its exposure time; longest:
    `Frame.exposure` to which all are brought, or None; levels: of the boards, worst channel, by light.
    """

    gain: np.ndarray
    scale: tuple[float, ...]
    longest: float | None
    normalised: bool
    levels: tuple[float, ...]
    defect: np.ndarray  # (rows, columns) bool: dead pixels
    problems: tuple[Problem, ...]


def measure_whites(reader: FrameReader[TurntableCapture], darks: DarkField, edges: Edges, tick: Tick) -> Whites:
    """Gain of each light from its white board without polariser, else 1.

    Values are those at the longest exposure of the sample frames; a board brings them to a perfect white.
    """
    capture = reader.capture
    times = [f.exposure for f in capture.observed]
    longest = max((t for t in times if t), default=None)
    scale = tuple(longest / t if longest and t else 1.0 for t in times)
    by_light = {f.light: f for f in capture.frames_of("white") if not f.polariser}
    shape = (reader.rows, reader.columns)
    if not by_light:
        gain = np.ones((len(capture.light_names), 1, 1, len(reader.names)), np.float32)
        return Whites(gain, scale, longest, False, (), np.zeros(shape, bool), ())
    frames = tuple(by_light[name] for name in capture.light_names)
    gains, levels, problems, dead = [], [], [], np.zeros(shape, np.uint8)
    for i, (frame, codes) in enumerate(reader.read_all(frames)):
        dark = darks.at(frame.exposure_s)
        field = white_field(
            codes,
            reader.table,
            dark,
            edges,
            lit=(board_cosine(reader, i), capture.settings.white.reflectance),
            limits=(reader.saturated, reader.clip),
            name=frame.file,
        )
        ratio = frame.exposure / longest if longest else 1.0
        gains.append(field.gain * np.float32(ratio))
        levels.append(float(field.level.min()))
        problems += field.problems
        board = field.level.astype(np.float32) + dark.mean(axis=(0, 1))
        expected = np.broadcast_to(board, (len(edges[0]) - 1, len(edges[1]) - 1, len(board)))
        count_outliers(codes, reader.table, np.ascontiguousarray(expected), *edges, DEAD, np.inf, dead)
        tick(frame.file)
    # a board that does not fill the picture leaves dark surroundings, which are no dead pixels
    known = np.isfinite(np.stack(gains)).all(axis=(0, 3))
    inside = np.repeat(np.repeat(known, np.diff(edges[0]), axis=0), np.diff(edges[1]), axis=1)
    defect = (dead == len(frames)) & inside
    return Whites(np.stack(gains), scale, longest, True, tuple(levels), defect, tuple(problems))


def board_cosine(reader: FrameReader[TurntableCapture], place: int) -> float:
    """cos(theta_W) between lamp and board; 1 where only the lamp's position, or nothing, is known."""
    settings, lights = reader.capture.settings, reader.capture.lights
    if lights is None or settings.lights is None or settings.lights.kind != "direction":
        return 1.0
    direction = lights.directions[lights.index(reader.capture.light_names[place])]
    return float(direction @ np.array(settings.white.normal))


def mean_boards(
    reader: FrameReader[TurntableCapture],
    keys: list[tuple[str, str]],
    darks: DarkField,
    whites: Whites,
    edges: Edges,
    tick: Tick,
) -> Iterator[np.ndarray]:
    """Mean white board (rows, columns, channels) float32 of each (light, polariser state), in the samples' units.

    Saturated samples keep their values: they are the best that is known of the board there.
    """
    rows, columns = reader.rows, reader.columns
    usable, one_code = np.ones((rows, columns), np.uint8), straight_scale(reader.table, reader.dtype)
    for light, state in keys:
        frames = tuple(f for f in reader.capture.frames_of("white") if (f.light, f.polariser) == (light, state))
        total = np.zeros((rows, columns, len(reader.names)), np.float32)
        part, valid = np.empty_like(total), np.empty((rows, columns), bool)
        gain = whites.gain[reader.capture.light_names.index(light)]
        for frame, codes in reader.read_all(frames):
            scale = np.float32(whites.longest / frame.exposure if whites.longest else 1.0)
            fields = on_one_grid(gain * scale, darks.at(frame.exposure_s))
            grid = grid_of(fields[0].shape[:2], (rows, columns), edges)
            view_values(codes, (reader.table, one_code, reader.saturated), fields, grid, usable, part, valid)
            total += part
            tick(frame.file)
        yield total / np.float32(len(frames))
