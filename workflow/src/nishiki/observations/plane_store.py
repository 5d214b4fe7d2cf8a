"""Writing the ingested frames: the camera's own codes, re-tiled, with all that is needed to read them as light."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.capture.frames import Frame
from nishiki.formats.problems import Problem
from nishiki.formats.zarr_store import BandedGroup, chunk_path, write_chunk
from nishiki.observations.blocks import bands_with_object, rows_of_band
from nishiki.observations.corrections import find_corrections
from nishiki.observations.frames import FrameReader
from nishiki.observations.plane import FORMAT, STORE
from nishiki.observations.plane_decode import count_unusable
from nishiki.observations.reference import measure_darks, measure_gains, measure_room
from nishiki.observations.region import chosen, edges_of, object_mask, region_around, region_numbers, window_of
from nishiki.observations.resampling import subtract_room
from nishiki.observations.store_parts import (
    ALL_SATURATED,
    PhotographCounter,
    Settings,
    describe_samples,
    refuse_unusable,
    sample_warnings,
    write_small_arrays,
)


def write_observations(
    capture: Capture, folder: Path | str, *, settings: Settings, progress: Callable[[int, int, str], None] | None = None
) -> dict[str, Any]:
    """Write `frames.zarr` into the folder, which must not hold one; read it with `Observations`.

    progress(done, of, file) is called once a photograph. Two frames at a time are in memory. Raises CaptureError
    (a UserError) for photographs that cannot be used.

    Returns what ingest found. saturated (in any channel), dark (at the lowest code in all channels), not_finite: of the
    pixels inside the mask, one a light (sample and check, in order); region: the part of the photographs that is kept
    (row, column, rows, columns), the bounding box of the mask with a rim; white_level: median of the board as a
    fraction of full scale per light, and white_uniformity: 5th / 95th percentile over the board per light, both of the
    worst channel, empty without a board; defects: hot or dead pixels; coding: how codes became light; corrections: what
    was measured and put right, see `nishiki.observations.corrections`.
    """
    choice = chosen(capture, settings.without)
    capture = choice.capture
    once = sum(len(capture.frames_of(role)) for role in ("dark", "white", "ambient"))
    tick = PhotographCounter(progress, once + 2 * len(capture.observed))
    reader = FrameReader.of(capture, settings.channels, unopened=choice.files)
    asked, size = reader.region, (reader.rows, reader.columns)
    outline = object_mask(capture, size, asked)
    mask = outline.inside.astype(np.uint8)
    if capture.mask is not None:
        reader, mask = cropped(reader, mask, settings.white_block)
    _, _, rows, columns = reader.region
    edges = edges_of(asked, reader.region, settings.white_block)
    darks = measure_darks(reader, edges, tick)
    gains = measure_gains(reader, darks, edges, mask, tick)
    reader = replace(reader, room=measure_room(reader, darks, tick))
    corrections = find_corrections(reader, darks, gains.gain, mask, settings.correct, tick)
    capture, gains = corrections.capture, gains.of(corrections.kept)
    reader = replace(reader, capture=capture, motions=corrections.motions)
    group = BandedGroup.create(Path(folder) / STORE)
    band_rows = rows_of_band(len(capture.observed), rows, columns, len(reader.names), settings.tile_mib)
    counts, problems = _write_frames(Path(folder) / STORE, group, reader, mask, band_rows, settings.compression, tick)
    defect = darks.defect | gains.defect
    arrays = {"mask": mask, "gain": gains.gain / corrections.strengths, "dark": darks.for_frames(capture.observed)}
    labels, label_warnings = region_numbers(capture, size, reader.region)
    if labels is not None:
        arrays["regions"] = labels
    write_small_arrays(group, reader, defect, arrays)
    group.update(**_attributes(capture, reader, settings, band_rows), asked_region=list(asked))
    if corrections.uncertainty:
        group.update(uncertainty=corrections.uncertainty)
    if corrections.ambient.any():
        subtract_room(Path(folder) / STORE, corrections.ambient, corrections.gains)
    doubts = (*capture.warnings, *outline.problems, *label_warnings, *reader.warnings(), *corrections.problems)
    problems = (*doubts, *darks.problems, *gains.problems, *problems)
    inside = int(mask.sum(dtype=np.int64))
    return {
        **describe_samples(reader, counts, inside, problems),
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


def cropped(reader: FrameReader, mask: np.ndarray, white_block: int) -> tuple[FrameReader, np.ndarray]:
    """Crop the reader and the mask (rows, columns) to the bounding box of the mask, with a rim."""
    region = region_around(mask, reader.region, white_block)
    window = window_of(reader.region, region)
    return replace(reader, region=region), np.ascontiguousarray(mask[window])


def _write_frames(
    path: Path,
    group: BandedGroup,
    reader: FrameReader,
    mask: np.ndarray,
    band_rows: int,
    compression: str,
    tick: Callable,
) -> tuple[np.ndarray, list[Problem]]:
    """Every observed frame into its chunks; returns counts (lights, 4) and what was found in the frames.

    Bands of rows without a pixel of the object have no chunk.
    """
    _, _, rows, columns = reader.region
    observed, count = reader.capture.observed, len(reader.names)
    shape, chunk = (len(observed), rows, columns, count), (1, band_rows, columns, count)
    group.create_array("codes", shape, chunk, reader.dtype, compression=compression)
    counts, problems = np.zeros((len(observed), 4), np.int64), []
    bands = bands_with_object(mask, band_rows)
    for j, (frame, codes) in enumerate(reader.read_all(observed)):
        *tally, highest = count_unusable(codes, mask, reader.saturated, reader.clip)
        counts[j] = tally
        problems += frame_problems(frame, counts[j], float(highest), reader)
        for band in bands:
            part = codes[band * band_rows : (band + 1) * band_rows]
            if len(part) < band_rows:  # chunks are whole: the last one is padded
                part = np.concatenate([part, np.zeros((band_rows - len(part), columns, count), codes.dtype)])
            write_chunk(chunk_path(path / "codes", j, band), part, compression=compression)
        tick(frame.file)
    return counts, problems


def frame_problems(frame: Frame, counts: np.ndarray, highest: float, reader: FrameReader) -> list[Problem]:
    """List the problems of one frame's values; CaptureError (bits-exceeded, all-saturated, all-dark) if unusable."""
    saturated, dark, broken, inside = (int(v) for v in counts)
    reader.see(frame, highest)
    limit = ALL_SATURATED * inside
    refuse_unusable(frame, bright=saturated > limit, black=dark > limit, shown="object", leave_out="light")
    return sample_warnings(frame, broken, saturated, inside)


def _attributes(capture: Capture, reader: FrameReader, settings: Settings, band_rows: int) -> dict:
    positions = None
    if capture.settings.lights.kind == "position_mm":
        positions = capture.lights.vectors[[capture.lights.index(f.light) for f in capture.observed]].tolist()
    row, column, _, _ = reader.region
    finite = np.isfinite(reader.saturated)
    linear_top = top = float(reader.saturated)
    if reader.dtype.kind == "u":
        top = min(top, len(reader.table) - 1)
        linear_top = float(reader.table[int(top)])
    return {
        "format": FORMAT,
        "lights": [capture.lights.names[capture.lights.index(f.light)] for f in capture.observed],
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
