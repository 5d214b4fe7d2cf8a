"""A goniometer's data checked, written and read: the window of every photograph as codes, or the given table.

Checked are sizes, saturation, boards and regions of photographs; energy and symmetry of tables.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture.frames import Frame, inside
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.seal import expect_sealed, sealed_digests
from nishiki.errors import UserError, require
from nishiki.formats.files import read_json
from nishiki.formats.images import Region
from nishiki.formats.masks import label_problems, read_labels
from nishiki.formats.problems import CaptureError, Problem, error, group_problems, name_some, refuse, warning
from nishiki.formats.stored import BandedGroup, load_arrays, open_group, understood
from nishiki.goniometry.directions import Symmetry, unit
from nishiki.goniometry.hemisphere import FEWEST_PAIRS, forward_shine, reciprocity, turned_views, typical_albedo
from nishiki.goniometry.readings import ClothPhotograph
from nishiki.observations.frames import (
    FrameReader,
    PhotographCounter,
    Settings,
    Tick,
    attempt,
    examine_frames,
    write_small_arrays,
)
from nishiki.observations.linearise import CHECK_BLOCK, StoredArrays, block_edges, picture_edges, positions
from nishiki.observations.reference import DarkField, measure_darks
from nishiki.observations.region import chosen

DARK_WHITE = 0.005  # of full scale: below it the board's quantisation alone is worth a percent


def restrict_to_window(
    reader: FrameReader[GoniometerCapture], capture: GoniometerCapture
) -> FrameReader[GoniometerCapture]:
    """Restrict the reader to the central window of crop_px; where there are regions it reads whole photographs."""
    side = max(reader.rows, reader.columns) if capture.regions else capture.settings.goniometer.crop_px
    return replace(reader, region=central((reader.rows, reader.columns), side))


def central(size: tuple[int, int], side: int) -> Region:
    """Return row, column, rows and columns of the central square of this side, or less in a smaller picture."""
    rows, columns = (min(n, side) for n in size)
    return (size[0] - rows) // 2, (size[1] - columns) // 2, rows, columns


def region_labels(capture: GoniometerCapture, size: tuple[int, int]) -> np.ndarray | None:
    """Read a label picture (rows, columns) uint16, or None. CaptureError: regions-size, regions-empty, regions-name."""
    if capture.regions is None:
        return None
    block = capture.settings.goniometer
    name = require(block.regions)
    labels = read_labels(capture.regions, name=name)
    if block.regions_pitch_mm is None and labels.shape != size:
        expected, found = f"{size[0]} x {size[1]} as the frames", f"{labels.shape[0]} x {labels.shape[1]}"
        remedy = "Make it from a photograph along the normal, or give regions_pitch_mm and pixel_pitch_mm"
        what = "size of the regions"
        refuse("regions-size", name, what, expected=expected, found=found, remedy=remedy)
    present = set(np.unique(labels).tolist()) - {0}
    if not present:
        refuse("regions-empty", name, "no pixel has a label", remedy="Labels count from 1")
    lost = [f"{label} ({region})" for region, label in block.region_names.items() if label not in present]
    if lost:
        found = ", ".join(lost)
        what, remedy = "a region that is named has no pixel", "Correct the label picture or goniometer.region_names"
        refuse("regions-name", name, what, found=found, remedy=remedy)
    return labels


def code_problems(frame: Frame, codes: np.ndarray, reader: FrameReader) -> list[Problem]:
    """List the problems of one frame's codes. CaptureError: bits-exceeded, not-finite in the whole window."""
    if reader.dtype.kind == "u":
        reader.see(frame, float(codes.max()))
        return []
    broken = int((~np.isfinite(codes)).any(axis=2).sum())
    if broken == codes.shape[0] * codes.shape[1]:
        refuse("not-finite", frame.file, "no sample is finite", remedy="Write the file again")
    what = "NaN or infinite samples are not used"
    return [warning("not-finite", frame.file, what, found=f"{broken} pixels")] if broken else []


def hot_problems(files: list[str], count: int) -> list[Problem]:
    """Warn (some-saturated) where photographs of the cloth, out of `count`, have saturated pixels."""
    if not files:
        return []
    what, found = "photographs of the cloth have saturated pixels", f"{len(files)} of {count}: {name_some(files)}"
    remedy = "Photograph them again with a shorter exposure_s beside the longer"
    return [warning("some-saturated", "frames.csv", what, found=found, remedy=remedy)]


def white_level(frame: Frame, codes: np.ndarray, reader: FrameReader[GoniometerCapture], darks: DarkField) -> float:
    """Compute the board's mean, worst channel, relative to full scale. CaptureError: white-saturated, white-dark."""
    side = reader.capture.settings.goniometer.crop_px
    row, column, rows, columns = central(codes.shape[:2], side)
    middle = codes[row : row + rows, column : column + columns]
    hot = float((middle >= reader.saturated).any(axis=2).mean())
    if hot > 0.01:
        what = "the white board is saturated"
        found = f"{100 * hot:.1f} % of the window"
        remedy = "Expose the board less"
        refuse("white-saturated", frame.file, what, found=found, remedy=remedy)
    linear = (reader.table[middle] if reader.dtype.kind == "u" else middle).astype(np.float64)
    level = np.nanmean(np.where(np.isfinite(linear), linear, np.nan), axis=(0, 1))
    level = level - darks.at(frame.exposure_s).mean(axis=(0, 1))
    least = float(level.min())
    if not least > (DARK_WHITE if reader.dtype.kind == "u" else 0.0):
        what, found = "the white board is too dark", f"{100 * least:.2f} % of full scale"
        expected, remedy = f"above {100 * DARK_WHITE:g} %", "Expose the board longer, or check the dark frames"
        refuse("white-dark", frame.file, what, expected=expected, found=found, remedy=remedy)
    return least


DISAGREE = 0.2  # sound tables gave at most .13, simulated cloths .06, wrong ones .35 and more
AGREE = 1 / 3  # of the disagreement is left by the reading that is right
MOST_ALBEDO = 1.1  # some room for the gaps between the views
FORWARD = 0.3  # correlation with the half vector; sound surfaces gave .67 to 1, turned by half a turn at most .26
BACKWARD = 0.4  # by which the correlation with the half vector grows where the views are turned by half a turn


def look_at_windows(capture: GoniometerCapture, size: tuple[int, int], contents: bool, tick: Tick) -> list[Problem]:
    """Compare regions with the frames' size; with `contents`, decode every photograph."""
    problems: list[Problem] = []
    try:
        labels = region_labels(capture, size)
        problems += label_problems(labels, require(capture.settings.goniometer.regions)) if labels is not None else []
    except CaptureError as e:
        problems += e.problems
    return problems + (attempt(lambda: _content_problems(capture, tick)) if contents else [])


def _content_problems(capture: GoniometerCapture, tick: Tick) -> list[Problem]:
    """Find problems that only decoding reveals; every photograph is decoded once."""
    # the whole seal is verified apart
    reader = restrict_to_window(FrameReader.of(capture, "all", prove=False), capture)
    edges = picture_edges(reader.region[2:], CHECK_BLOCK)
    darks = measure_darks(reader, edges, tick)
    hot: list[str] = []

    def look(frame: Frame, decode: Callable[[], np.ndarray]) -> list[Problem]:
        codes = decode()
        problems = code_problems(frame, codes, reader)
        if frame.role == "white":
            white_level(frame, codes, reader, darks)
        elif (codes >= reader.saturated).any():
            hot.append(frame.file)
        return problems

    found = examine_frames(reader, [frame for frame in capture.frames if frame.role != "dark"], look, tick)
    return [*reader.warnings(), *darks.problems, *found, *hot_problems(hot, len(capture.observed))]


def table_problems(capture: GoniometerCapture) -> list[Problem]:
    """Check a table's values against physics: energy, reciprocity, the side of reflection.

    A reading that makes the reciprocal pairs agree is an error's remedy. Once goniometer.values or azimuths is given,
    what the table says stands, and a violation is a warning.
    """
    block, table, file = capture.settings.goniometer, require(capture.table), capture.settings.goniometer.table or ""
    rows = (np.isfinite(table.values) & (table.values > 0)).all(axis=1)
    light, view = (unit(*np.radians(each[rows]).T) for each in (table.incident_deg, table.outgoing_deg))
    values, given = table.values[rows], block.model_fields_set & {"values", "azimuths"}
    tell = warning if given else error
    symmetry = "quarter" if block.symmetry == "unknown" else block.symmetry
    problems = []
    albedo = typical_albedo(light, view, values, symmetry)
    if albedo is not None and albedo > MOST_ALBEDO:
        factor, option = (
            (np.pi, "radiance_factor") if albedo <= np.pi * MOST_ALBEDO else (100 * np.pi, "radiance_factor_percent")
        )
        what, expected = "the surface would send back more light than it gets", f"a share of at most {MOST_ALBEDO:g}"
        remedy = _remedy("values", option) if albedo / factor <= MOST_ALBEDO else "Give the BRDF, in 1/sr"
        problems.append(tell("reflectance-energy", file, what, expected=expected, found=f"{albedo:.3g}", remedy=remedy))
    apart, pairs = reciprocity(light, view, values, symmetry)
    shine = forward_shine(light, view, values)
    mirrored = turned_views(light, view, np.pi)
    if apart is not None and pairs >= FEWEST_PAIRS and apart > DISAGREE:
        readings = {
            ("values", "brdf_cos_view"): (view, values / view[:, 2:]),
            ("values", "brdf_cos_light"): (view, values / light[:, 2:]),
            ("azimuths", "mirror"): (mirrored, values),
            ("azimuths", "lamp"): (turned_views(light, view, 0.0), values),
        }
        left = {key: reciprocity(light, *reading, symmetry) for key, reading in readings.items()}
        fitting = [key for key, (rest, count) in left.items() if count >= FEWEST_PAIRS and rest < AGREE * apart]
        # both azimuths make symmetric pairs agree: surfaces shine away from the lamp
        fitting.sort(key=lambda key: -(forward_shine(light, *readings[key]) or 0.0))
        what, expected = "light and view exchanged give other values", f"pairs that agree within {DISAGREE:.0%}"
        found = f"{pairs} pairs {np.expm1(apart):.0%} apart"
        if fitting:
            key, option = min(fitting, key=lambda key: (key[0] != "values", fitting.index(key)))
            found += f", {np.expm1(left[key, option][0] or 0.0):.1%} with {key} {option}"
            problems.append(
                tell("reciprocity", file, what, expected=expected, found=found, remedy=_remedy(key, option))
            )
        # where two mirror planes are only assumed, pairs without mirror images have to disagree as well
        elif block.symmetry != "unknown" or (reciprocity(light, view, values, "none")[0] or 0.0) > DISAGREE:
            remedy = "Check what the columns hold, and from where the angles are counted"
            problems.append(warning("reciprocity", file, what, expected=expected, found=found, remedy=remedy))
    elif shine is not None and shine < FORWARD and (forward_shine(light, mirrored, values) or 0.0) > shine + BACKWARD:
        what = "the surface would shine towards the lamp, not away from it"
        remedy = f"If it does not: {_remedy('azimuths', 'mirror')}"
        problems.append(warning("shine-backward", file, what, found=f"correlation {shine:.2f}", remedy=remedy))
    return problems


def _remedy(key: str, option: str) -> str:
    now = "brdf" if key == "values" else "cloth"
    return f"Convert the table with --{key} {option} (or set goniometer.{key}); with --{key} {now} if it is right"


@dataclass(frozen=True)
class MeasuredShot:
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
                (row["role"], MeasuredShot(row["file"], tuple(row["angles_deg"]), row["exposure_s"], i))
                for i, row in enumerate(stored["frames"])
            ]
            self.samples: tuple[MeasuredShot, ...] = tuple(shot for role, shot in shots if role == "sample")
            self.whites: tuple[MeasuredShot, ...] = tuple(shot for role, shot in shots if role == "white")
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

    def read(self, shot: MeasuredShot) -> ClothPhotograph:
        """Read one photograph's window. UserError where the store is damaged."""
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
        return ClothPhotograph(np.where(finite[..., None], linear, np.float32(0)), saturated & finite, usable)

    def _read_block(self, number: int) -> np.ndarray:
        depth = self.attributes["frames_a_chunk"]
        return self._group["codes"][number * depth : (number + 1) * depth]

    def _dark_level(self, place: int) -> np.ndarray:
        """Interpolate the dark level over the window, bilinear between the centres of its blocks."""
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
    reader = restrict_to_window(FrameReader.of(capture, settings.channels, unopened=choice.files), capture)
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
    """Describe the frames and the decoding of their codes."""
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
    """Write goniometer.json."""
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
    """Copy the table unchanged; every file of a sealed capture is verified first."""
    digests, table = sealed_digests(capture.root), require(capture.table)
    for name in sorted(digests):
        expect_sealed(inside(capture.payload, name, "manifest-sha256.txt"), name, digests)
    np.savez(folder / TABLE, incident_deg=table.incident_deg, outgoing_deg=table.outgoing_deg, values=table.values)
    write_names(folder, capture, {"kind": "table", "channels": list(table.channels), "frames": []})
    return {
        "kind": "table",
        "channels": table.channels,
        "measurements": len(table.values),
        **{"whites": 0, "rows": 1, "columns": 1, "saturated": 0},
        "dark": int((table.values <= 0).any(axis=1).sum()),
        "white_level": (),
        "defects": 0,
        "warnings": tuple(map(str, group_problems(capture.warnings))),
        "coding": "",
    }
