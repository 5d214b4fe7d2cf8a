"""Writing the ingested frames: the camera's own codes, re-tiled, with all that is needed to read them as light."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.capture.frames import Frame
from nishiki.formats.problems import Problem
from nishiki.formats.stored import BandedGroup, chunk_path, write_chunk
from nishiki.observations.blocks import bands_with_object, edges_between, rows_of_band
from nishiki.observations.consistency import ReducedPhotographs
from nishiki.observations.corrections import find_corrections
from nishiki.observations.frames import FrameReader
from nishiki.observations.linearise import count_unusable
from nishiki.observations.plane import FORMAT, STORE
from nishiki.observations.reference import measure_darks, measure_gains, measure_room
from nishiki.observations.region import chosen, object_mask, region_around, region_numbers, window_of
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
    tick = PhotographCounter(progress, once + len(capture.observed))
    reader = FrameReader.of(capture, settings.channels, unopened=choice.files)
    asked, size = reader.region, (reader.rows, reader.columns)
    outline = object_mask(capture, size, asked)
    mask = outline.inside.astype(np.uint8)
    if capture.mask is not None:
        reader, mask = cropped(reader, mask, settings.white_block)
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
    reduced = ReducedPhotographs(reader, darks, mask, gains.gain)
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
    problems = [*doubts, *darks.problems, *gains.problems, *problems]
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
