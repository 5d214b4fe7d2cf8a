"""Which files of a capture a scene needs: the photographs that no stage of the plan looks at are not opened."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.capture.folder import Capture
from nishiki.capture.frames import Frame
from nishiki.capture.goniometer import NORMAL_DEG, GoniometerCapture
from nishiki.capture.turntable import TurntableCapture

AnyCapture = Capture | TurntableCapture | GoniometerCapture
LIGHT = "light "
"""Before a light's name among the parts that are left out: the photograph under that light."""


@dataclass(frozen=True)
class Choice:
    """capture: without the files that are not needed; skipped: those files, by what they are."""

    capture: AnyCapture
    skipped: dict[str, tuple[str, ...]]

    @property
    def files(self) -> frozenset[str]:
        """All files that are not opened."""
        return frozenset(name for names in self.skipped.values() for name in names)


def chosen(capture: AnyCapture, without: Collection[str] = ()) -> Choice:
    """The capture without these parts, and without what was photographed for their sake alone.

    without: names of parts (see `nishiki.engine.plan`), or 'light NAME'. White boards and dark frames that
    belong to no photograph that is left are left out with them.
    """
    if isinstance(capture, TurntableCapture):
        return _of_turntable(capture, set(without))
    if isinstance(capture, GoniometerCapture):
        return _of_goniometer(capture, set(without))
    return _of_plane(capture, set(without))


def _of_plane(capture: Capture, without: set[str]) -> Choice:
    dropped = {"flat": set(capture.frames_of("flat"))}
    dropped["check"] = set(capture.frames_of("check")) if "check" in without else set()
    dropped["held out"] = {f for f in capture.frames_of("sample") if LIGHT + f.light in without}
    left = [f for f in capture.observed if not any(f in some for some in dropped.values())]
    places = {capture.lights.index(f.light) for f in left}
    dropped["white"] = {f for f in capture.frames_of("white") if capture.lights.index(f.light) not in places}
    return _reduced(capture, dropped)


def _of_turntable(capture: TurntableCapture, without: set[str]) -> Choice:
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
    choice = _reduced(capture, dropped)
    kept, skipped = replace(choice.capture, states=states), dict(choice.skipped)
    if "photographs" in without:
        skipped["photographs"] = tuple(f.file for f in kept.observed)
    if "silhouettes" in without:
        outlines = tuple(dict.fromkeys(f.silhouette for f in capture.frames if f.silhouette))
        skipped["silhouettes"] = outlines
        kept = replace(kept, frames=tuple(replace(f, silhouette="", silhouette_path=None) for f in kept.frames))
    if "mesh" in without and capture.mesh:
        skipped["mesh"], kept = (capture.settings.turntable.mesh,), replace(kept, mesh=None)
    if "scans" in without and capture.scans:
        skipped["scans"], kept = capture.settings.turntable.scans, replace(kept, scans=())
    return Choice(kept, {part: files for part, files in skipped.items() if files})


def _of_goniometer(capture: GoniometerCapture, without: set[str]) -> Choice:
    if capture.table is not None or "oblique" not in without:
        return Choice(capture, {})
    from nishiki.goniometry.readings import assign_boards

    samples, whites = capture.observed, capture.frames_of("white")
    left = [f for f in samples if f.angles_deg[0] < NORMAL_DEG]
    boards = assign_boards(_angles(left), _angles(whites))
    used = {int(i) for board in boards for i in board.which}
    dropped = {"oblique": set(samples) - set(left), "white": {f for i, f in enumerate(whites) if i not in used}}
    return _reduced(capture, dropped)


def _angles(frames: Iterable[Frame]) -> np.ndarray:
    """(n, 4) degrees, NaN where not given."""
    rows = [[np.nan if a is None else a for a in f.angles_deg] for f in frames]
    return np.array(rows, np.float64).reshape(-1, 4)


def _reduced(capture: AnyCapture, dropped: dict[str, set[Frame]]) -> Choice:
    """The capture without the dropped frames, and without the dark frames of exposure times that nothing has then."""
    gone = set().union(*dropped.values()) if dropped else set()
    if any(f.role in ("sample", "check", "white") for f in gone):
        left = [f for f in capture.frames if f not in gone]
        dropped = {**dropped, "dark": dropped.get("dark", set()) | unneeded_darks(left)}
        gone |= dropped["dark"]
    frames = tuple(f for f in capture.frames if f not in gone)
    files = {
        part: tuple(name for f in capture.frames if f in some for name in f.names) for part, some in dropped.items()
    }
    return Choice(replace(capture, frames=frames), {part: names for part, names in files.items() if names})


def unneeded_darks(frames: Iterable[Frame]) -> set[Frame]:
    """Dark frames whose exposure time is not the nearest, in ratio, to that of any lit frame (see DarkField.at)."""
    frames = list(frames)
    darks = [f for f in frames if f.role == "dark"]
    lit = {f.exposure_s for f in frames if f.role in ("sample", "check", "white", "ambient")}
    times = tuple(dict.fromkeys(f.exposure_s for f in darks))
    if not times or None in times or None in lit or not lit:
        return set()
    needed = {min(times, key=lambda dark_time: abs(np.log(dark_time / time))) for time in lit}
    return {f for f in darks if f.exposure_s not in needed}
