"""Write the frames of a plane: the camera's own codes, re-tiled, with all that is needed to read them as light.

The pass that stores the photographs also collects reduced pictures and a few windows. From these follow the movement of
the camera (`nishiki.observations.registration`), then, with the pictures brought together, the strength of each lamp,
the light of the room, lamps that failed and photographs that repeat another one (`nishiki.photometric.consistency`).
Photographs that moved are read again. What was measured before anything was put right is kept beside what was done.

Light of the room is an image of the albedo:

    v_j = rho (s_j max(n . l_j, 0) + a)

v_j: value relative to the white board; s_j: strength of lamp j; a: light of the room relative to a lamp that faces the
object, one number a channel. rho and n follow pixel by pixel from the lit photographs, and rho a is subtracted from the
codes of all.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.capture.frames import Frame
from nishiki.capture.lights import direction_problems
from nishiki.formats.problems import Problem, error_text, name_some, raise_errors, warning
from nishiki.formats.stored import BandedGroup, chunk_path, write_chunk
from nishiki.observations import consistency
from nishiki.observations import frames as reading
from nishiki.observations.linearise import bands_with_object, count_unusable, edges_between, field_rows, rows_of_band
from nishiki.observations.plane import FORMAT, STORE, Observations
from nishiki.observations.reference import measure_darks, measure_gains, measure_room
from nishiki.observations.region import chosen, object_mask, region_around, region_numbers, window_of
from nishiki.observations.registration import Movement
from nishiki.photometric.consistency import (
    LEAST_AMBIENT,
    LEAST_GAIN,
    MOST_AMBIENT,
    SURE,
    Consistency,
    examine_photographs,
    probable_strengths,
    split_course,
)
from nishiki.photometric.lambert_fit import solve_normals

UNEQUAL = 0.06  # deviation of probable log strengths: equal lamps of measured sets of 12 to 96 reached .056
JUMP = 0.08  # deviation of log gains about a linear course over the directions: with it none of 643 selections
# of 5 to 12 equal lamps of six measured sets is taken as unequal
STEEP, COURSE_SHARE = 0.25, 0.75  # deviation of a course from which jumps must be this share of it: gloss on a flat
# object gave courses of .27 to .50 and shares of .28 to .68, unequal lamps of six measured sets courses up to .20
ODD_EXPOSURE = 0.1  # of the brightness that a recorded exposure may be off: cameras round to thirds of a stop
AMBIENT_BIAS = 0.2  # of the estimated light of the room, by which it was off on six measured sets (rms .14)


@dataclass(frozen=True)
class Corrections:
    """Corrections of the photographs."""

    capture: Capture  # the capture without the photographs that are left out
    kept: np.ndarray  # (lights,) int64: numbers of those that remain, among the observed ones
    motions: dict[str, np.ndarray]  # dict of str to (2, 3) float64: by file, see `FrameReader.motions`
    # (lights,) float64: strengths by which the remaining photographs are divided; 1 where nothing significant is known
    gains: np.ndarray
    # (channels,) float64: light of the room to take off, relative to the albedo; 0 where there is none
    ambient: np.ndarray
    # of what is put right, see `nishiki.photometric.expected_error.correction_error`; empty where nothing is
    uncertainty: dict[str, Any] = field(default_factory=dict)
    # what was measured and done, as plain values for the diagnostics
    measured: dict[str, Any] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()  # warnings, one for each kind of correction


def find_corrections(
    reader: reading.FrameReader, reduced: consistency.ReducedPhotographs, wishes: reading.Wishes
) -> Corrections:
    """Measure the photographs of a plane against each other, and decide on corrections; reduced: all observed ones.

    Raises CaptureError: dark-bright; lights-few or lights-coplanar, where too few photographs remain.
    """
    capture, frames = reader.capture, reader.capture.observed
    raise_errors(consistency.dark_problems(reduced.darker))
    judgement = reduced.judge([capture.lights.index(frame.light) for frame in frames])
    if judgement is None:
        motions, channels = dict(reader.motions), len(reader.names)
        return Corrections(capture, np.arange(len(frames)), motions, np.ones(len(frames)), np.zeros(channels))
    registers, lamps = wishes.registration == "auto", judgement.lamps
    own, together = (judgement.values, judgement.before), (judgement.aligned, judgement.consistency)
    values, found = together if registers else own
    problems = consistency.movement_problems(judgement, registers) + consistency.pair_problems(judgement, capture)
    useless, leaves = consistency.useless_photographs(judgement, found), wishes.leave_out == "auto"
    problems += consistency.useless_problems(useless, judgement.names, leaves)
    kept = np.arange(len(frames))
    if useless and leaves:
        kept = np.array([j for j in kept if j not in useless], np.int64)
        samples = [j for j in kept if frames[j].role == "sample"]
        few = direction_problems(judgement.directions[samples], "frames.csv")
        without = f"without the {len(useless)} photographs that are of no use"
        raise_errors(replace(problem, what=f"{problem.what} {without}") for problem in few)
        found = examine_photographs(values[kept], lamps[kept])
    out = {frames[j].file for j in range(len(frames)) if j not in kept}
    left = replace(capture, frames=tuple(f for f in capture.frames if f.file not in out))
    gains, ambient = np.ones(len(kept)), np.zeros(values.shape[3])
    uncertainty: dict[str, Any] = {}
    if found is not None and found.holds(left.directions):
        gains, covariance, notes = _choose_gains(left, found, wishes)
        if covariance is not None:
            uncertainty["gains"] = covariance.tolist()
        problems += notes
        ambient, notes = _choose_ambient(left, found, values[kept], lamps[kept], wishes)
        problems += notes
        if ambient.any():
            uncertainty["ambient"] = float(np.hypot(found.ambient_sigma, AMBIENT_BIAS * ambient.mean()))
    movement = judgement.movement
    motions = {frames[j].file: movement.matrix(int(j)) for j in kept if judgement.moved[j] and registers}
    registered = [frame.light for frame in frames if frame.file in motions]
    for file, stated in reader.motions.items():  # a stated shift is undone first
        motions[file] = motions[file] + stated * (0, 0, 1) if file in motions else stated
    done = {
        "registered": registered,
        "left_out": {frames[j].light: reason for j, (_, reason) in useless.items() if frames[j].file in out},
        "gains": {f.light: float(g) for f, g in zip(left.observed, gains, strict=True) if g != 1},
        "ambient": ambient.tolist() if ambient.any() else [],
    }
    if registered:
        uncertainty["shift_px"] = [float(movement.sigma[j]) if judgement.moved[j] else 0.0 for j in kept]
    measured = {"photographs": _list_measurements(frames, movement, judgement.before), "done": done}
    if (first := judgement.before) is not None:
        measured |= {"ambient": first.ambient, "ambient_sigma": _plain(first.ambient_sigma)}
    return Corrections(left, kept, motions, gains, ambient, uncertainty, measured, tuple(problems))


def _choose_gains(
    capture: Capture, found: Consistency, wishes: reading.Wishes
) -> tuple[np.ndarray, np.ndarray | None, list[Problem]]:
    """Choose lamp strengths where neither boards nor intensities give them; warn of contradicting exposures.

    Gains that rise with the direction of the lamp are like a tilt of the object, and like matter that does not follow
    Lambert's law: on a grey sphere under equal lamps they reach 17 %, and would turn its normals by 7 degrees. Also
    returns the covariance (lights, lights) of the log strengths, None where none are applied.
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
    if capture.frames_of("white") or capture.intensities is not None or len(off) <= 4 or not significant.any():
        return ones, None, problems
    logs, covariance = probable_strengths(found, capture.directions)
    course, jumps = (part.std() for part in split_course(found.gain, capture.directions))
    if logs.std() < UNEQUAL or jumps < max(JUMP, COURSE_SHARE * course if course > STEEP else 0):
        return ones, None, problems
    gains, sigma = np.exp(logs), np.sqrt(np.diag(covariance))
    texts = [f"{f.light} {g:.2f} {error_text(s, 2)}" for f, g, s in zip(frames, gains, gains * sigma, strict=True)]
    said = name_some(texts[j] for j in np.argsort(-np.abs(logs)))
    what, remedy = "the lamps are not equally strong", "Photograph a white board under every lamp"
    if wishes.gains == "never":
        remedy += ", or set ingest.correct.gains: auto"
        return ones, None, [*problems, warning("lamps-unequal", "frames.csv", what, found=said, remedy=remedy)]
    what += "; their strengths are estimated from the photographs"
    return gains, covariance, [*problems, warning("lamps-unequal", "frames.csv", what, found=said, remedy=remedy)]


def _choose_ambient(
    capture: Capture, found: Consistency, values: np.ndarray, lamps: np.ndarray, wishes: reading.Wishes
) -> tuple[np.ndarray, list[Problem]]:
    """Choose the ambient light (channels,) to subtract, relative to the albedo; 0 where it is not significant."""
    none = np.zeros(values.shape[3])
    if not max(LEAST_AMBIENT, SURE * found.ambient_sigma) < found.ambient < MOST_AMBIENT:
        return none, []
    levels = [found.ambient] * len(none)
    for channel in range(len(none) if len(none) > 1 else 0):
        alone = examine_photographs(values[..., channel], lamps)
        if alone is not None and alone.ambient > SURE * alone.ambient_sigma:
            levels[channel] = alone.ambient
    subtracts = wishes.ambient == "auto"
    return np.array(levels) if subtracts else none, consistency.ambient_problems(found, capture, subtracts)


def _list_measurements(
    frames: tuple[Frame, ...], movement: Movement, found: Consistency | None
) -> dict[str, dict[str, Any]]:
    """List measurements of each photograph before corrections, by light, in plain numbers."""
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


def write_observations(
    capture: Capture,
    folder: Path | str,
    *,
    settings: reading.Settings,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Write `frames.zarr` into the folder, which must not hold one; read it with `Observations`.

    progress(done, of, file) is called once a photograph. Two frames at a time are in memory. Raises CaptureError
    (a UserError) for photographs that cannot be used.

    Returns what ingest found. saturated (in any channel), dark (at the lowest code in all channels), not_finite: of the
    pixels inside the mask, one a light (sample and check, in order); region: the part of the photographs that is kept
    (row, column, rows, columns), the bounding box of the mask with a rim; white_level: median of the board as a
    fraction of full scale per light, and white_uniformity: 5th / 95th percentile over the board per light, both of the
    worst channel, empty without a board; defects: hot or dead pixels; coding: how codes became light; corrections: what
    was measured and put right, see `nishiki.observations.plane_store`.
    """
    choice = chosen(capture, settings.without)
    capture = choice.capture
    once = sum(len(capture.frames_of(role)) for role in ("dark", "white", "ambient"))
    tick = reading.PhotographCounter(progress, once + len(capture.observed))
    reader = reading.FrameReader.of(capture, settings.channels, unopened=choice.files)
    asked, size = reader.region, (reader.rows, reader.columns)
    outline = object_mask(capture, size, asked)
    mask = outline.inside.astype(np.uint8)
    if capture.mask is not None:
        region = region_around(mask, reader.region, settings.white_block)
        mask = np.ascontiguousarray(mask[window_of(reader.region, region)])
        reader = replace(reader, region=region)
    _, _, rows, columns = reader.region
    rows_read, columns_read = window_of(asked, reader.region)
    # edges of the blocks of the asked region that lie in the kept one, counted from its corner
    edges = (
        edges_between(asked[2], settings.white_block, rows_read.start, rows_read.stop),
        edges_between(asked[3], settings.white_block, columns_read.start, columns_read.stop),
    )
    darks = measure_darks(reader, edges, tick)
    gains = measure_gains(reader, darks, edges, mask, tick)
    reader = replace(reader, room=measure_room(reader, darks, tick))
    group = BandedGroup.create(Path(folder) / STORE)
    band_rows = rows_of_band(len(capture.observed), rows, columns, len(reader.names), settings.tile_mib)
    reduced = consistency.ReducedPhotographs(reader, darks, mask, gains.gain)
    found: dict[int, tuple] = {}

    def store(number: int, codes: np.ndarray) -> None:
        found[number] = count_unusable(codes, mask, reader.saturated, reader.clip)
        for band in bands_with_object(mask, band_rows):
            part = codes[band * band_rows : (band + 1) * band_rows]
            if len(part) < band_rows:  # chunks are whole: the last one is padded
                part = np.concatenate([part, np.zeros((band_rows - len(part), *part.shape[1:]), codes.dtype)])
            write_chunk(chunk_path(group.folder / "codes", number, band), part, compression=settings.compression)

    for j, (frame, codes) in enumerate(reader.read_all(capture.observed)):
        reduced.add(frame, codes)
        store(j, codes)
        tick(frame.file)
    corrections = find_corrections(reader, reduced, settings.correct)
    capture, gains, before = corrections.capture, gains.of(corrections.kept), reader.motions
    reader = replace(reader, capture=capture, motions=corrections.motions)
    again = {
        j: frame
        for j, frame in enumerate(capture.observed)
        if corrections.kept[j] != j or reader.motions.get(frame.file) is not before.get(frame.file)
    }
    tick.total += len(again)
    for j, (frame, codes) in zip(again, reader.read_all(list(again.values())), strict=True):
        store(j, codes)
        tick(frame.file)
    for j in range(len(corrections.kept), len(found)):
        shutil.rmtree(chunk_path(group.folder / "codes", j, 0).parents[2])
    shape = (len(capture.observed), rows, columns, len(reader.names))
    group.create_array("codes", shape, (1, band_rows, *shape[2:]), reader.dtype, compression=settings.compression)
    counts, problems = np.array([found[j][:4] for j in range(len(capture.observed))], np.int64), []
    for j, frame in enumerate(capture.observed):
        problems += frame_problems(frame, counts[j], float(found[j][4]), reader)
    defect = darks.defect | gains.defect
    gain = gains.gain / corrections.gains.astype(np.float32)[:, None, None, None]
    arrays: dict[str, np.ndarray] = {"mask": mask, "gain": gain, "dark": darks.for_frames(capture.observed)}
    labels, label_warnings = region_numbers(capture, size, reader.region)
    if labels is not None:
        arrays["regions"] = labels
    reading.write_small_arrays(group, reader, defect, arrays)
    group.update(**_attributes(capture, reader, settings, band_rows), asked_region=list(asked))
    if corrections.uncertainty:
        group.update(uncertainty=corrections.uncertainty)
    if corrections.ambient.any():
        subtract_room(Path(folder) / STORE, corrections.ambient, corrections.gains)
    doubts = (*capture.warnings, *outline.problems, *label_warnings, *reader.warnings(), *corrections.problems)
    problems = [*doubts, *darks.problems, *gains.problems, *problems]
    inside = int(mask.sum(dtype=np.int64))
    return {
        **reading.describe_samples(reader, counts, inside, problems),
        "rows": rows,
        "columns": columns,
        "lights": tuple(frame.light for frame in capture.observed),
        "band_rows": band_rows,
        "mask_pixels": inside,
        "region": reader.region,
        "photograph": (reader.rows, reader.columns),
        "white_level": gains.levels,
        "white_uniformity": gains.uniformity,
        "defects": int((defect & (mask > 0)).sum()),
        "corrections": corrections.measured,
    }


def frame_problems(frame: Frame, counts: np.ndarray, highest: float, reader: reading.FrameReader) -> list[Problem]:
    """List the problems of one frame's values; CaptureError (bits-exceeded, all-saturated, all-dark) if unusable."""
    saturated, dark, broken, inside = (int(v) for v in counts)
    reader.see(frame, highest)
    limit = reading.ALL_SATURATED * inside
    reading.refuse_unusable(frame, bright=saturated > limit, black=dark > limit, shown="object", leave_out="light")
    return reading.sample_warnings(frame, broken, saturated, inside)


def _attributes(capture: Capture, reader: reading.FrameReader, settings: reading.Settings, band_rows: int) -> dict:
    places = [capture.lights.index(frame.light) for frame in capture.observed]
    positions = capture.lights.vectors[places].tolist() if capture.settings.lights.kind == "position_mm" else None
    row, column, _, _ = reader.region
    finite = np.isfinite(reader.saturated)
    linear_top = top = float(reader.saturated)
    if reader.dtype.kind == "u":
        top = min(top, len(reader.table) - 1)
        linear_top = float(reader.table[int(top)])
    return {
        "format": FORMAT,
        "lights": [capture.lights.names[place] for place in places],
        "files": [f.file for f in capture.observed],
        "roles": [f.role for f in capture.observed],
        "directions": capture.directions.tolist(),
        "positions_mm": positions,
        "channels": list(reader.names),
        "saturation": linear_top if finite else None,
        "saturation_code": reader.saturated.item() if finite else None,
        "clip_code": reader.clip.item(),
        "pixel_pitch_mm": capture.settings.pixel_pitch_mm,
        "image_shape": [reader.rows, reader.columns],
        "region_of_interest": list(reader.region),
        "image_centre": [(reader.rows - 1) / 2 - row, (reader.columns - 1) / 2 - column],
        "band_rows": band_rows,
        "white_block": settings.white_block,
        "white_board": bool(capture.frames_of("white")),
        "coding": reader.coding.name,
        "to_srgb": None if reader.to_srgb is None else reader.to_srgb.tolist(),
        "compression": settings.compression,
    }


ROUNDS = 4  # of choosing the photographs in which a pixel is lit
LIT = 0.1  # cosine from which it is
VALUES = 1 << 21  # computed at a time


def subtract_room(store: Path, ambient: np.ndarray, strengths: np.ndarray) -> None:
    """Rewrite the codes of `frames.zarr` without the ambient light.

    ambient: (channels,) a of the equation above; strengths: (lights,) s, by which the stored gains are divided.
    """
    observations = Observations(store)
    lamps = strengths[:, None] * observations.directions
    scale = strengths.astype(np.float32)[:, None, None, None]
    compression, (saturated, _) = observations.attributes["compression"], observations.limits
    for number, band in enumerate(observations.bands()):
        if not observations.mask[band].any():
            continue
        codes, start = observations.codes(band)
        values, valid = observations.read(band)
        room = albedo_under_room(values * scale, valid, lamps, ambient) * ambient.astype(np.float32)
        for light, photograph in enumerate(codes):
            gain = field_rows(observations.gain[light] * scale[light], observations.edges, start, start + len(room))
            share = np.divide(room, gain, out=np.zeros_like(room), where=gain > 0)
            part = reading.subtract_light(photograph, share, observations.lut, saturated)
            rest = np.zeros((observations.band_rows - len(part), *part.shape[1:]), part.dtype)
            place = chunk_path(store / "codes", light, number)
            write_chunk(place, np.concatenate([part, rest]), compression=compression)


def albedo_under_room(values: np.ndarray, valid: np.ndarray, lamps: np.ndarray, ambient: np.ndarray) -> np.ndarray:
    """Estimate rho (rows, columns, channels) float32 of the module's equation, 0 where it is not known.

    values (lights, rows, columns, channels) float32, valid (lights, rows, columns) bool; lamps (lights, 3): directions
    times strengths; ambient (channels,) float64.
    """
    lights, rows, columns, channels = values.shape
    flat, known = values.reshape(lights, -1, channels), valid.reshape(lights, -1).astype(np.float32)
    albedo, step = np.zeros((rows * columns, channels), np.float32), max(VALUES // lights, 1)
    level = float(ambient.mean())
    for first in range(0, rows * columns, step):
        part = slice(first, first + step)
        used, seen = known[:, part], flat[:, part]
        grey = seen.mean(axis=2)
        weights, room = used, np.zeros(grey.shape[1])
        for _ in range(ROUNDS):
            normal, _ = solve_normals(weights, grey - room, lamps[:, None])
            length = np.linalg.norm(normal, axis=1) + 1e-12
            cosines = lamps @ (normal / length[:, None]).T
            room = level * length
            lit = used * (cosines > LIT)
            weights = np.where(lit.sum(axis=0) >= 3, lit, used)
        shares = np.maximum(cosines, 0)[:, :, None] + ambient
        lit = weights[:, :, None] * shares
        albedo[part] = (lit * seen).sum(axis=0) / np.maximum((lit * shares).sum(axis=0), 1e-12)
    return np.where(np.isfinite(albedo), np.maximum(albedo, 0), 0).astype(np.float32).reshape(rows, columns, channels)
