"""Choose the part of a capture to read: region of interest, mask, and the files of a plan."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.capture.frames import BaseCapture, Frame
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.seal import payload_files
from nishiki.capture.turntable import TurntableCapture
from nishiki.errors import require
from nishiki.formats.images import Region
from nishiki.formats.masks import Mask, examine_mask, expect_size, label_problems, read_labels
from nishiki.formats.problems import Problem, refuse
from nishiki.goniometry.table import NORMAL_DEG
from nishiki.observations.linearise import blocks_around

MANY_REGIONS = np.iinfo(np.uint8).max + 1
MARGIN = 8
"""Least rim around the object in pixels, where the photograph has them: pictures need a rim."""


def region_of(capture: BaseCapture, rows: int, columns: int) -> Region:
    """Return the region of interest, the whole picture if none; CaptureError (region-outside) if it exceeds that."""
    region = capture.settings.region_of_interest or (0, 0, rows, columns)
    row, column, height, width = region
    if height < 1 or width < 1 or row + height > rows or column + width > columns:
        what = "region_of_interest leaves the picture or is empty"
        expected = f"within {rows} rows and {columns} columns"
        refuse("region-outside", "capture.yaml", what, expected=expected, found=", ".join(map(str, region)))
    return region


def object_mask(capture: Capture, size: tuple[int, int], region: Region) -> Mask:
    """Read the mask of the object within a region, all of it without a mask file.

    CaptureError: mask-size unless it has the photographs' size (rows, columns), mask-empty, those of reading pictures.
    """
    if capture.mask is None:
        return Mask(np.ones(region[2:], bool), ())
    name = require(capture.settings.mask)
    mask = examine_mask(capture.mask, name=name)
    expect_size(mask.inside, size, name, "mask")
    row, column, rows, columns = region
    inside = mask.inside[row : row + rows, column : column + columns]
    if not inside.any():
        remedy = "Light pixels mark the object; check the mask and the region of interest"
        refuse("mask-empty", name, "mask has no pixels", remedy=remedy)
    return Mask(inside, mask.problems)


def region_numbers(
    capture: Capture, size: tuple[int, int], region: Region
) -> tuple[np.ndarray | None, tuple[Problem, ...]]:
    """Return each pixel's region (rows, columns) uint8, from 0 in the order of the labels, and warnings.

    None without a label picture. CaptureError: regions-size, regions-many, those of `read_labels`.
    """
    if capture.regions is None:
        return None, ()
    name = require(capture.settings.regions)
    full_labels = read_labels(capture.regions, name=name)
    expect_size(full_labels, size, name, "regions")
    row, column, rows, columns = region
    labels, index = np.unique(full_labels[row : row + rows, column : column + columns], return_inverse=True)
    if len(labels) > MANY_REGIONS:
        remedy = "Join regions of the same material: each gets its own reflection parameters"
        found, expected = f"{len(labels)} labels", f"at most {MANY_REGIONS}"
        refuse("regions-many", name, "regions", expected=expected, found=found, remedy=remedy)
    return index.reshape(rows, columns).astype(np.uint8), tuple(label_problems(full_labels, name))


def region_around(mask: np.ndarray, region: Region, block: int) -> Region:
    """Bound the part of a region that holds its mask (rows, columns), with a rim of MARGIN pixels and a block."""
    (top, bottom), (left, right) = (blocks_around(np.any(mask, axis=axis), block, MARGIN) for axis in (1, 0))
    return region[0] + top, region[1] + left, bottom - top, right - left


def window_of(outer: Region, inner: Region) -> tuple[slice, slice]:
    """Return rows and columns of a region inside an array of the region around it."""
    row, column = inner[0] - outer[0], inner[1] - outer[1]
    return slice(row, row + inner[2]), slice(column, column + inner[3])


AnyCapture = Capture | TurntableCapture | GoniometerCapture
SomeCapture = TypeVar("SomeCapture", bound=BaseCapture)
LIGHT = "light "
"""Prefix of a light's name in a list of omitted parts: the photograph under that light."""


@dataclass(frozen=True)
class RegionChoice(Generic[SomeCapture]):
    """capture: without the files that are not needed; skipped: those files, by their part."""

    capture: SomeCapture
    skipped: dict[str, tuple[str, ...]]

    @property
    def files(self) -> frozenset[str]:
        """All files that are not read."""
        return frozenset(name for names in self.skipped.values() for name in names)


def chosen(capture: SomeCapture, without: Collection[str] = ()) -> RegionChoice[SomeCapture]:
    """Remove these parts from the capture, and photographs taken only for them.

    without: names of parts (see `nishiki.engine.plan`), or 'light NAME'. White boards and dark frames that
    belong to no photograph that is left are left out with them.
    """
    reduce = {"plane": _choose_plane, "turntable": _choose_turntable, "goniometer": _choose_goniometer}[
        capture.geometry
    ]
    return reduce(capture, set(without))


def _choose_plane(capture: Capture, without: set[str]) -> RegionChoice[Capture]:
    dropped = {"flat": set(capture.frames_of("flat"))}
    dropped["check"] = set(capture.frames_of("check")) if "check" in without else set()
    dropped["held out"] = {f for f in capture.frames_of("sample") if LIGHT + f.light in without}
    left = [f for f in capture.observed if not any(f in some for some in dropped.values())]
    places = {capture.lights.find(f.light) for f in left}
    dropped["white"] = {f for f in capture.frames_of("white") if capture.lights.find(f.light) not in places}
    return _remove_dropped(capture, dropped)


def _choose_turntable(capture: TurntableCapture, without: set[str]) -> RegionChoice[TurntableCapture]:
    dropped: dict[str, set[Frame]] = {}
    samples, whites = capture.frames_of("sample"), capture.frames_of("white")
    states = capture.states
    if "states" in without:
        states = states[:1]
        dropped["states"] = {f for f in samples if f.polariser not in states}
    if "white_states" in without:
        dropped["white_states"] = {f for f in whites if f.polariser}
    if "calibration" in without:
        dropped["calibration"] = set(capture.frames_of("board"))
    if "photographs" in without:
        # The frames stay listed: views, lights and exposure times are known from them without opening any.
        dropped["white"] = {f for f in whites if not f.polariser}
        dropped["dark"] = set(capture.frames_of("dark"))
    choice = _remove_dropped(capture, dropped)
    kept, skipped = replace(choice.capture, states=states), dict(choice.skipped)
    if "photographs" in without:
        skipped["photographs"] = tuple(f.file for f in kept.observed)
    if "silhouettes" in without:
        outlines = tuple(dict.fromkeys(f.silhouette for f in capture.frames if f.silhouette))
        skipped["silhouettes"] = outlines
        kept = replace(kept, frames=tuple(replace(f, silhouette="", silhouette_path=None) for f in kept.frames))
    if "mesh" in without and capture.mesh:
        skipped["mesh"], kept = (require(capture.settings.turntable.mesh),), replace(kept, mesh=None)
    if "scans" in without and capture.scans:
        skipped["scans"], kept = capture.settings.turntable.scans, replace(kept, scans=())
    return RegionChoice(kept, {part: files for part, files in skipped.items() if files})


def _choose_goniometer(capture: GoniometerCapture, without: set[str]) -> RegionChoice[GoniometerCapture]:
    if capture.table is not None or "oblique" not in without:
        return RegionChoice(capture, {})
    from nishiki.goniometry.readings import assign_boards

    samples, whites = capture.observed, capture.frames_of("white")
    left = [f for f in samples if f.angles_deg[0] < NORMAL_DEG]
    boards = assign_boards(_angles(left), _angles(whites))
    used = {int(i) for board in boards for i in board.which}
    dropped = {"oblique": set(samples) - set(left), "white": {f for i, f in enumerate(whites) if i not in used}}
    return _remove_dropped(capture, dropped)


def _angles(frames: Iterable[Frame]) -> np.ndarray:
    """Return angles (n, 4) in degrees, NaN where not given."""
    rows = [[np.nan if a is None else a for a in f.angles_deg] for f in frames]
    return np.array(rows, np.float64).reshape(-1, 4)


def _remove_dropped(capture: SomeCapture, dropped: dict[str, set[Frame]]) -> RegionChoice[SomeCapture]:
    """Remove dropped frames, and dark frames of exposure times that then no frame has."""
    gone = set().union(*dropped.values()) if dropped else set()
    if any(f.role in ("sample", "check", "white") for f in gone):
        left = [f for f in capture.frames if f not in gone]
        dropped = {**dropped, "dark": dropped.get("dark", set()) | unneeded_darks(left)}
        gone |= dropped["dark"]
    frames = tuple(f for f in capture.frames if f not in gone)
    files = {
        part: tuple(name for f in capture.frames if f in some for name in f.names) for part, some in dropped.items()
    }
    return RegionChoice(replace(capture, frames=frames), {part: names for part, names in files.items() if names})


def unneeded_darks(frames: Iterable[Frame]) -> set[Frame]:
    """Select dark frames whose exposure time is not the nearest, in ratio, to any lit frame's (see DarkField.at)."""
    frames = list(frames)
    darks = [f for f in frames if f.role == "dark"]
    lit = {f.exposure_s for f in frames if f.role in ("sample", "check", "white", "ambient")}
    times = tuple(dict.fromkeys(f.exposure_s for f in darks))
    if not times or None in times or None in lit or not lit:
        return set()
    needed = {min(times, key=lambda dark_time: abs(np.log(dark_time / time))) for time in lit}
    return {f for f in darks if f.exposure_s not in needed}


ROLES = {
    "sample": "photographs of the object",
    "check": "photographs under check lights",
    "white": "white boards",
    "dark": "dark frames",
    "ambient": "photographs without lamp",
    "flat": "flat frames",
    "board": "pictures of the calibration board",
}
OTHERS = "tables, spectra, masks"


def usage_of(capture: AnyCapture, *, without: Collection[str], channels: str) -> dict[str, Any]:
    """List the files that ingest reads with these settings (see `stages/ingest/__init__.py`), without decoding.

    files: by kind, only kinds that the capture has, and their total: how many are read, of how many, and their bytes.
    channels: read, of. Bytes are sizes of files: each photograph is read once to be proven against the seal and once to
    be decoded.
    """
    kinds = {Path(name).as_posix(): ROLES[f.role] for f in capture.frames for name in f.names}
    kinds |= {Path(f.silhouette).as_posix(): "silhouettes" for f in capture.frames if getattr(f, "silhouette", "")}
    if isinstance(capture, TurntableCapture):
        block = capture.settings.turntable
        kinds |= {Path(scan).as_posix(): "range scans" for scan in block.scans}
        kinds |= {Path(block.mesh).as_posix(): "mesh file"} if block.mesh else {}
    unopened = {Path(name).as_posix() for name in chosen(capture, without).files}
    counts = {what: np.zeros(4, int) for what in (*ROLES.values(), "silhouettes", "range scans", "mesh file", OTHERS)}
    for path in payload_files(capture.payload):
        name, size = path.relative_to(capture.payload).as_posix(), path.stat().st_size
        is_read = name not in unopened
        counts[kinds.get(name, OTHERS)] += (is_read, 1, size * is_read, size)
    counts["files"] = np.sum(list(counts.values()), axis=0)
    named = [(what, count) for what, count in counts.items() if count[1]]
    columns = ("read", "of", "bytes_read", "bytes_of")
    *files, total = ({"what": what, **dict(zip(columns, count.tolist(), strict=True))} for what, count in named)
    stored = len(capture.channels if isinstance(capture, GoniometerCapture) else capture.settings.camera.channels)
    kept = stored if channels in ("auto", "all") else 1
    return {"files": files, "total": total, "channels": (kept, stored)}
