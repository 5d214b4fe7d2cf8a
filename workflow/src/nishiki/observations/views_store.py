"""Write the views of an object: the camera's codes, with lamps, cameras and boards beside them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.capture.turntable import UNITS_MM, TurntableCapture, estimates_cameras
from nishiki.colour.colour import encode
from nishiki.errors import require
from nishiki.formats.coding import LUMA_WEIGHTS
from nishiki.formats.masks import Mask, examine_mask, expect_size, read_mask
from nishiki.formats.problems import Problem, refuse
from nishiki.formats.stored import BandedGroup
from nishiki.observations import frames as reading
from nishiki.observations.kernels import ANY_CODE, decode_codes
from nishiki.observations.linearise import Edges, count_unusable, picture_edges
from nishiki.observations.reference import DarkField, board_fields, measure_darks
from nishiki.observations.region import chosen
from nishiki.observations.views import FORMAT, STORE


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


def measure_whites(
    reader: reading.FrameReader[TurntableCapture], darks: DarkField, edges: Edges, tick: reading.Tick
) -> Whites:
    """Compute the gain of each light from its white board without polariser, else 1.

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
    frames = [by_light[name] for name in capture.light_names]
    fields, dead = board_fields(reader, frames, darks, edges, tick)
    ratios = [frame.exposure / longest if longest else 1.0 for frame in frames]
    gain = np.stack([field.gain * np.float32(ratio) for field, ratio in zip(fields, ratios, strict=True)])
    # a board that does not fill the picture leaves dark surroundings, which are no dead pixels
    known = np.isfinite(gain).all(axis=(0, 3))
    inside = np.repeat(np.repeat(known, np.diff(edges[0]), axis=0), np.diff(edges[1]), axis=1)
    levels = tuple(float(field.level.min()) for field in fields)
    problems = tuple(problem for field in fields for problem in field.problems)
    return Whites(gain, scale, longest, True, levels, dead & inside, problems)


def attributes_of(
    capture: TurntableCapture,
    reader: reading.FrameReader,
    whites: Whites,
    *,
    white_block: int,
    silhouettes: list[str],
    boards: list[list[str]],
) -> dict:
    """Collect attributes of the store. silhouettes: views that have one; boards: [light, polariser state] of each."""
    block, matrices = capture.settings.turntable, capture.matrices
    finite = np.isfinite(reader.saturated)
    return {
        "format": FORMAT,
        "views": list(capture.views),
        "lights": list(capture.light_names),
        "states": list(capture.states),
        "files": [f.file for f in capture.observed],
        "channels": list(reader.names),
        "shape": [reader.rows, reader.columns],
        "encoding": reader.coding.encoding,
        "full_turn": block.full_turn,
        "unit": block.unit,
        "unit_mm": UNITS_MM[block.unit],
        "background": block.background,
        "height": block.height,
        "estimates_cameras": estimates_cameras(block, capture.views),
        "lamp": lamp_of(capture),
        "scale": list(whites.scale),
        "saturation_code": reader.saturated.item() if finite else None,
        "white_block": white_block,
        "white_board": whites.normalised,
        "boards": boards,
        "silhouettes": silhouettes,
        "calibration": [{"name": f.file, "view": f.view or None} for f in capture.frames_of("board")],
        "board": block.board.model_dump(mode="json") if block.board else None,
        "intrinsics": capture.intrinsics.as_dict() if capture.intrinsics else None,
        "matrices": {view: matrices[view].tolist() for view in capture.views} if matrices else None,
        "distortions": {view: list(capture.distortion_of(view)) for view in capture.views} if matrices else None,
        "geometry": dict(geometry_files(capture)),
        "mesh_placement": list(block.mesh_placement),
    }


def lamp_of(capture: TurntableCapture) -> dict:
    """Return {"kind", "vectors"}: unit directions or positions in mm, one a light in the lights' order, or None."""
    given, lights = capture.settings.lights, capture.lights
    if given is None or lights is None:
        return {"kind": given.kind if given else "unknown", "vectors": None}
    places = [lights.index(name) for name in capture.light_names]
    vectors = lights.vectors if given.kind == "position_mm" else lights.directions
    return {"kind": given.kind, "vectors": vectors[places].tolist()}


def geometry_files(capture: TurntableCapture) -> dict[str, str | list[str] | None]:
    """Name each file of the object's geometry in the artifact, by its key in the block `turntable`."""
    block = capture.settings.turntable
    scans = [f"geometry/scans/{i + 1:03d}_{scan.name}" for i, scan in enumerate(capture.scans)]
    return {
        "cameras": "geometry/cameras.csv" if block.cameras else None,
        "correspondences": "geometry/correspondences.csv" if block.correspondences else None,
        "mesh": f"geometry/mesh{capture.mesh.suffix.lower()}" if capture.mesh else None,
        "scans": scans,
        "calibration": f"geometry/calibration{capture.calibration.suffix}" if capture.calibration else None,
    }


def geometry_sources(capture: TurntableCapture) -> list[tuple[Path, str]]:
    """List each file to copy into the artifact: (file of the capture, name in the artifact)."""
    block = capture.settings.turntable
    files = geometry_files(capture)
    scans = files.pop("scans") or []
    return [
        *((capture.payload / getattr(block, key), place) for key, place in files.items() if isinstance(place, str)),
        *zip(capture.scans, scans, strict=True),
    ]


def write_views(
    capture: TurntableCapture,
    folder: Path | str,
    *,
    settings: reading.Settings,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Write `views.zarr` into the folder, which must not hold one; read it with `Views`.

    progress(done, of, file) is called once a photograph. Two photographs at a time are in memory, and the sum of the
    white boards of one polariser state. Raises CaptureError (a UserError) for photographs that cannot be used.

    Returns what ingest found. saturated (in any channel), dark (at the lowest code in all), not_finite: of the pixels
    inside the silhouette where one is given, else of the picture, one a frame (by light, view, polariser state);
    white_level: median of the board as a fraction of full scale, by light, empty without a normalising board; defects:
    hot or dead pixels.
    """
    choice = chosen(capture, settings.without)
    capture, opened = choice.capture, "photographs" not in choice.skipped
    tick = reading.PhotographCounter(progress, len(capture.frames) - (0 if opened else len(capture.observed)))
    reader = reading.FrameReader.of(capture, settings.channels, unopened=choice.files)
    edges = picture_edges((reader.rows, reader.columns), settings.white_block)
    group = BandedGroup.create(Path(folder) / STORE)
    outlines, doubts = _write_silhouettes(group, capture, reader)
    darks = measure_darks(reader, edges, tick)
    whites = measure_whites(reader, darks, edges, tick)
    counts, problems = _write_codes(group, reader, outlines, tick, opened=opened)
    boards = _write_boards(group, reader, darks, whites, edges, tick)
    _write_calibration(group, reader, tick)
    defect = darks.defect | whites.defect
    arrays = {"gain": whites.gain, "dark": darks.for_frames(capture.observed)}
    reading.write_small_arrays(group, reader, defect, arrays)
    block = settings.white_block
    group.update(**attributes_of(capture, reader, whites, white_block=block, silhouettes=outlines, boards=boards))
    problems = (*capture.warnings, *doubts, *reader.warnings(), *darks.problems, *whites.problems, *problems)
    return {
        **reading.describe_samples(reader, counts, np.maximum(counts[:, 3], 1), problems),
        "rows": reader.rows,
        "columns": reader.columns,
        "views": capture.views,
        "lights": capture.light_names,
        "states": capture.states,
        "white_level": whites.levels,
        "defects": int(defect.sum()),
        "silhouettes": len(outlines),
        "boards": len(boards),
        "calibration_pictures": len(capture.frames_of("board")),
    }


def _write_silhouettes(
    group: BandedGroup, capture: TurntableCapture, reader: reading.FrameReader
) -> tuple[list[str], list[Problem]]:
    """Write the given silhouettes, one chunk a view; return the views that have one, and warnings."""
    named = [(i, view, frame) for i, view in enumerate(capture.views) if (frame := capture.silhouette_of(view))]
    if not named:
        return [], []
    size, problems = (reader.rows, reader.columns), []
    stored = group.create_array(
        "silhouettes", (len(capture.views), *size, 1), (1, *size, 1), np.uint8, compression="zstd"
    )
    for i, _, frame in named:
        outline = read_silhouette(frame, size)
        problems += outline.problems
        stored[i : i + 1] = outline.inside[None, :, :, None]
    return [view for _, view, _ in named], problems


def read_silhouette(frame: Frame, size: tuple[int, int]) -> Mask:
    """Read the silhouette of a view. CaptureError: silhouette-size, silhouette-empty, those of reading pictures."""
    outline = examine_mask(require(frame.silhouette_path), name=frame.silhouette)
    expect_size(outline.inside, size, frame.silhouette, "silhouette")
    if not outline.inside.any():
        remedy = "Light pixels mark the object"
        refuse("silhouette-empty", frame.silhouette, "silhouette has no pixels", remedy=remedy)
    return outline


def _write_codes(
    group: BandedGroup, reader: reading.FrameReader, outlines: list[str], tick: reading.Tick, *, opened: bool
) -> tuple[np.ndarray, list[Problem]]:
    """Write every frame of the object into its chunk; return counts (frames, 4) and problems of the frames.

    opened: False where nothing of the plan looks at them: then the array holds no frame.
    """
    observed = reader.capture.observed
    size = (reader.rows, reader.columns, len(reader.names))
    frames = len(observed) if opened else 0
    stored = group.create_array("codes", (frames, *size), (1, *size), reader.dtype, compression="zstd")
    if not opened:
        return np.zeros((0, 4), np.int64), []
    counts, problems = np.zeros((len(observed), 4), np.int64), []
    full_mask = np.ones(size[:2], np.uint8)
    for i, (frame, codes) in enumerate(reader.read_all(observed)):
        named = reader.capture.silhouette_of(frame.view) if frame.view in outlines else None
        inside = read_mask(named.silhouette_path).astype(np.uint8) if named else full_mask
        *tally, highest = count_unusable(codes, inside, reader.saturated, reader.clip)
        counts[i] = tally
        problems += view_problems(frame, counts[i], float(highest), reader, outlined=named is not None)
        stored[i : i + 1] = codes[None]
        tick(frame.file)
    return counts, problems


def view_problems(
    frame: Frame, counts: np.ndarray, highest: float, reader: reading.FrameReader, *, outlined: bool
) -> list[Problem]:
    """List the problems of one frame's values; CaptureError (bits-exceeded, all-saturated, all-dark) if unusable.

    A bright or black background is no fault, and a crossed polariser may leave little: without a silhouette only a
    picture without any usable sample is refused.
    """
    saturated, dark, broken, inside = (int(v) for v in counts)
    reader.see(frame, highest)
    bright = saturated > (reading.ALL_SATURATED * inside if outlined else inside - 1)
    reading.refuse_unusable(frame, bright=bright, black=dark == inside, shown="picture", leave_out="photograph")
    expected = reader.capture.settings.turntable.background == "bright" and not outlined
    shown = "object" if outlined else "picture"
    return reading.sample_warnings(frame, broken, 0 if expected else saturated, inside, shown=shown)


def _write_boards(
    group: BandedGroup, reader: reading.FrameReader, darks: DarkField, whites: Whites, edges: Edges, tick: reading.Tick
) -> list[list[str]]:
    """Write the mean white board of each light and state, in the samples' units; return [light, state] of each.

    Saturated samples keep their values: they are the best that is known of the board there.
    """
    frames = [f for f in reader.capture.frames_of("white") if f.polariser]
    keys = list(dict.fromkeys((f.light, f.polariser) for f in frames))
    if not keys:
        return []
    size = (reader.rows, reader.columns, len(reader.names))
    stored = group.create_array("boards", (len(keys), *size), (1, *size), np.float32, compression="zstd")
    usable = np.ones(size[:2], np.uint8)
    for i, key in enumerate(keys):
        alike = [f for f in frames if (f.light, f.polariser) == key]
        gain, total = whites.gain[reader.capture.light_names.index(key[0])][None], np.zeros((1, *size), np.float32)
        for frame, codes in reader.read_all(alike):
            scale = np.float32(whites.longest / frame.exposure if whites.longest else 1.0)
            fields = gain * scale, darks.at(frame.exposure_s)[None], usable
            total += decode_codes(codes[None], (reader.table, reader.saturated, ANY_CODE), fields, edges)[0]
            tick(frame.file)
        stored[i : i + 1] = total / np.float32(len(alike))
    return [list(key) for key in keys]


def _write_calibration(group: BandedGroup, reader: reading.FrameReader, tick: reading.Tick) -> None:
    """Write pictures of the calibration board, grey, 8 bits, coded for display so that dark squares stay distinct."""
    frames = reader.capture.frames_of("board")
    if not frames:
        return
    size = (reader.rows, reader.columns, 1)
    stored = group.create_array("calibration", (len(frames), *size), (1, *size), np.uint8, compression="zstd")
    count = len(reader.names)
    weights = LUMA_WEIGHTS if count == 3 else np.full(count, 1 / count)
    for i, (frame, codes) in enumerate(reader.read_all(frames)):
        grey = codes.astype(np.float32) @ (weights / reader.full).astype(np.float32)
        if reader.coding.linear:
            grey = encode(np.nan_to_num(grey), "srgb")
        stored[i : i + 1] = np.rint(255 * np.clip(grey, 0, 1)).astype(np.uint8)[None, :, :, None]
        tick(frame.file)
