"""Write and read what a goniometer measured: the window of every photograph as codes, or the given table."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture.frames import Frame, inside
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.seal import expect_sealed, sealed_digests
from nishiki.errors import UserError, require
from nishiki.formats.files import read_json
from nishiki.formats.masks import label_problems
from nishiki.formats.problems import Problem, group_problems
from nishiki.formats.stored import BandedGroup, load_arrays, open_group, understood
from nishiki.goniometry.directions import Symmetry
from nishiki.goniometry.readings import Photograph
from nishiki.observations.blocks import block_edges, picture_edges, positions
from nishiki.observations.frames import FrameReader
from nishiki.observations.goniometer_check import code_problems, hot_problems, region_labels, white_level, windowed
from nishiki.observations.linearise import StoredArrays
from nishiki.observations.reference import DarkField, measure_darks
from nishiki.observations.region import chosen
from nishiki.observations.store_parts import PhotographCounter, Settings, write_small_arrays


@dataclass(frozen=True)
class Shot:
    """A frame: theta_i, phi_i, theta_r, phi_r, None where not given; exposure_s or None; place: number in the store."""

    file: str
    angles_deg: tuple[float | None, ...]
    exposure_s: float | None
    place: int


class Measurements(StoredArrays):
    """The ingested measurements of one capture, opened for reading.

    kind: 'photographs' or 'table'; channels: names; samples, whites: the photographs (none of a table); symmetry,
    weave, threads_per_cm: as the capture states; attributes: everything stored.
    """

    def __init__(self, folder: Path | str):
        """Open the artifact of ingest. UserError where it holds no measurements of a goniometer."""
        self.folder = Path(folder)
        try:
            stored = read_json(self.folder / NAMES)
        except UserError as e:
            raise UserError(f"{self.folder}: no ingested measurements of a goniometer here; run ingest first") from e
        if stored.get("format") != FORMAT:
            version = stored.get("format")
            raise UserError(f"{self.folder}: measurements of format {version}, expected {FORMAT}; run ingest again")
        self.attributes: dict = stored
        with understood(self.folder / NAMES):
            self.kind: str = stored["kind"]
            self.channels: tuple[str, ...] = tuple(stored["channels"])
            self.dtype = np.dtype(stored.get("dtype"))  # none of a table
            self.symmetry: Symmetry = stored["symmetry"]
            self.weave: str = stored["weave"]
            self.threads_per_cm: list[float] | None = stored.get("threads_per_cm")
            shots = [
                (row["role"], Shot(row["file"], tuple(row["angles_deg"]), row["exposure_s"], i))
                for i, row in enumerate(stored["frames"])
            ]
            self.samples: tuple[Shot, ...] = tuple(shot for role, shot in shots if role == "sample")
            self.whites: tuple[Shot, ...] = tuple(shot for role, shot in shots if role == "white")
        self._block = lru_cache(maxsize=2)(self._read_block)
        self._dark = lru_cache(maxsize=8)(self._dark_level)

    @cached_property
    def table(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """incident_deg, outgoing_deg (n, 2) and values (n, channels) of a given table."""
        stored = load_arrays(self.folder / TABLE)
        return stored["incident_deg"], stored["outgoing_deg"], stored["values"]

    @cached_property
    def white_reflectance(self) -> np.ndarray:
        """(channels,) float64."""
        return np.array(self.attributes["white_reflectance"])

    def read(self, shot: Shot) -> Photograph:
        """One photograph's window. UserError where the store is damaged."""
        depth = self.attributes["frames_a_chunk"]
        codes = self._block(shot.place // depth)[shot.place % depth]
        linear = self.lut[codes] if codes.dtype.kind == "u" else codes
        linear = linear - self._dark(self.attributes["frames"][shot.place]["dark"])
        if shot.exposure_s is not None:
            linear = linear / np.float32(shot.exposure_s)
        finite = np.isfinite(linear).all(axis=2)
        limit = self.attributes["saturation_code"]
        saturated = (codes >= limit).any(axis=2) if limit is not None else np.zeros(codes.shape[:2], bool)
        usable = finite if self.defect is None else finite & ~self.defect
        return Photograph(np.where(finite[..., None], linear, np.float32(0)), saturated & finite, usable)

    def _read_block(self, number: int) -> np.ndarray:
        depth = self.attributes["frames_a_chunk"]
        return self._group["codes"][number * depth : (number + 1) * depth]

    def _dark_level(self, place: int) -> np.ndarray:
        """Dark level over the window, bilinear between the centres of its blocks."""
        level = self._group["dark"][place]
        for axis, length in enumerate(self.attributes["shape"]):
            if level.shape[axis] > 1:
                lower, weight = positions(block_edges(length, self.attributes["white_block"]), 0, length)
                weight = weight.reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
                level = np.take(level, lower, axis) * (1 - weight) + np.take(level, lower + 1, axis) * weight
        return level.astype(np.float32)

    @cached_property
    def _group(self):
        try:
            return open_group(self.folder / STORE)
        except FileNotFoundError as e:
            raise UserError(f"{self.folder}: {STORE} is missing; run ingest again") from e


STORE, NAMES, TABLE = "goniometer.zarr", "goniometer.json", "table.npz"
FORMAT = 1  # of the file; readers refuse others
CHUNK_BYTES = 4 << 20


def write_goniometer(
    capture: GoniometerCapture,
    folder: Path | str,
    *,
    settings: Settings,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Write `goniometer.json` with `goniometer.zarr` or `table.npz`; read them with `Measurements`.

    progress(done, of, file) is called once a photograph. Raises CaptureError (a UserError) for photographs that cannot
    be used.

    Returns what ingest found. kind: photographs or table; measurements, whites: how many; rows, columns: kept of each
    photograph; saturated, dark: photographs of the cloth with a saturated pixel, or without light, in the window kept;
    white_level: mean of the boards as a fraction of full scale, least and greatest; defects: hot pixels.
    """
    folder = Path(folder)
    if capture.table is not None:
        return _write_table(capture, folder)
    choice = chosen(capture, settings.without)
    capture = choice.capture
    tick = PhotographCounter(progress, len(capture.frames))
    reader = windowed(FrameReader.of(capture, settings.channels, unopened=choice.files), capture)
    edges = picture_edges(reader.region[2:], settings.white_block)
    labels = region_labels(capture, (reader.rows, reader.columns))
    darks = measure_darks(reader, edges, tick)
    frames = (*capture.observed, *capture.frames_of("white"))
    group = BandedGroup.create(folder / STORE)
    size, kind = (*reader.region[2:], len(reader.names)), reader.dtype
    depth = max(1, min(len(frames), CHUNK_BYTES // (int(np.prod(size)) * kind.itemsize)))
    stored = group.create_array("codes", (len(frames), *size), (depth, *size), kind, compression="zstd")
    found: list[Problem] = []
    white_levels, hot, cold, block = [], [], 0, np.empty((depth, *size), kind)
    for i, (frame, codes) in enumerate(reader.read_all(frames)):
        block[i % depth] = codes
        found += code_problems(frame, codes, reader)
        if frame.role == "white":
            white_levels.append(white_level(frame, codes, reader, darks))
        else:
            hot += [frame.file] * bool((codes >= reader.saturated).any())
            cold += bool((codes <= reader.clip).all())
        if i % depth == depth - 1 or i == len(frames) - 1:
            stored[i - i % depth : i + 1] = block[: i % depth + 1]
        tick(frame.file)
    found += hot_problems(hot, len(frames) - len(white_levels))
    shape = np.broadcast_shapes(*(level.shape for level in darks.levels))
    levels = np.stack([np.broadcast_to(level, shape) for level in darks.levels]).astype(np.float32)
    arrays = {"dark": levels} if labels is None else {"dark": levels, "regions": labels}
    write_small_arrays(group, reader, darks.defect, arrays)
    block_px = settings.white_block
    names = _describe_frames(capture, reader, frames, darks) | {"frames_a_chunk": depth, "white_block": block_px}
    write_names(folder, capture, names)
    doubts = label_problems(labels, require(capture.settings.goniometer.regions)) if labels is not None else []
    problems = (*capture.warnings, *doubts, *reader.warnings(), *darks.problems, *found)
    return {
        "kind": "photographs",
        "channels": reader.names,
        "measurements": len(capture.observed),
        "whites": len(frames) - len(capture.observed),
        "rows": reader.region[2],
        "columns": reader.region[3],
        "saturated": len(hot),
        "dark": cold,
        "white_level": (min(white_levels), max(white_levels)),
        "defects": int(darks.defect.sum()),
        "warnings": tuple(map(str, group_problems(problems))),
        "coding": reader.coding.name,
    }


def _describe_frames(
    capture: GoniometerCapture, reader: FrameReader, frames: tuple[Frame, ...], darks: DarkField
) -> dict[str, Any]:
    """Describe the frames, and how to read their codes."""
    block, finite = capture.settings.goniometer, np.isfinite(reader.saturated)
    places = [next(i for i, level in enumerate(darks.levels) if level is darks.at(f.exposure_s)) for f in frames]
    rows = [
        {"file": f.file, "role": f.role, "angles_deg": list(f.angles_deg), "exposure_s": f.exposure_s, "dark": place}
        for f, place in zip(frames, places, strict=True)
    ]
    camera = {
        "shape": list(reader.region[2:]),
        "dtype": str(reader.dtype),
        "saturation_code": reader.saturated.item() if finite else None,
        "white_reflectance": (reader.weights @ np.array(capture.settings.white_reflectance)).tolist(),
    }
    regions = {
        "region_names": {str(label): name for name, label in block.region_names.items()},
        "regions_pitch_mm": block.regions_pitch_mm,
        "pixel_pitch_mm": block.pixel_pitch_mm,
        "upright": block.upright,
    }
    return {"kind": "photographs", "channels": list(reader.names), "frames": rows, **camera, **regions}


def write_names(folder: Path, capture: GoniometerCapture, more: dict) -> None:
    """goniometer.json."""
    block = capture.settings.goniometer
    names = {
        "format": FORMAT,
        "symmetry": block.symmetry,
        "weave": block.weave,
        "threads_per_cm": block.threads_per_cm,
        "title": capture.settings.title,
        **more,
    }
    (folder / NAMES).write_text(json.dumps(names, indent=1, sort_keys=True, allow_nan=False) + "\n")


def _write_table(capture: GoniometerCapture, folder: Path) -> dict[str, Any]:
    """Write the table as it was given; every file of a sealed capture is proven first."""
    digests, table = sealed_digests(capture.root), require(capture.table)
    for name in sorted(digests):
        expect_sealed(inside(capture.payload, name, "manifest-sha256.txt"), name, digests)
    np.savez(folder / TABLE, incident_deg=table.incident_deg, outgoing_deg=table.outgoing_deg, values=table.values)
    write_names(folder, capture, {"kind": "table", "channels": list(table.channels), "frames": []})
    return {
        "kind": "table",
        "channels": table.channels,
        "measurements": len(table.values),
        "whites": 0,
        "rows": 1,
        "columns": 1,
        "saturated": 0,
        "dark": int((table.values <= 0).any(axis=1).sum()),
        "white_level": (),
        "defects": 0,
        "warnings": tuple(map(str, group_problems(capture.warnings))),
        "coding": "",
    }
