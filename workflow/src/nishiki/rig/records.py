"""Measure each photograph of a capture run as it is taken, and write what the run leaves behind: journal and tables.

Light failures show in the brightness: on a flat diffuse surface it follows the cosine of the lamp's angle (over the
squared distance), and lamps that stand beside each other light the object alike. Movement shows in the sharpness: the
ratio of the finest detail to detail twice as coarse, which hardly depends on the contrast.
"""

import json
import math
import os
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.capture.folder import examine
from nishiki.capture.frames import ANGLE_COLUMNS
from nishiki.capture.schema import FORMAT, CameraResponse
from nishiki.capture.taking import channel_names, choose_encoding, lights_text, settings_text, table_text
from nishiki.colour.colour import decode
from nishiki.errors import UserError
from nishiki.formats.files import flush, name_fault, put_file
from nishiki.formats.picture_files import ImageHeader
from nishiki.formats.problems import CaptureError
from nishiki.observations.linearise import full_scale, saturation_code
from nishiki.rig.frames_table import PlannedFrame
from nishiki.rig.plan import GEOMETRIES, DomePlan, ReadPlan, TurntablePlan, frame_distance, incidence_cosines

SIDE_PX = 1024  # of the pixels that are measured, of the window whose sharpness is, and of the copy that is shown
NO_LIGHT = 0.002  # of full scale, above the black level
DARK_LEVEL = 0.05  # of full scale: a dark frame above saw light
EXPOSURE_TOLERANCE = 0.15  # relative: EXIF rounds to the steps of the camera's dial


@dataclass(frozen=True)
class Measures:
    """Measurements of a photograph."""

    rows: int  # rows, columns, channels: its size
    columns: int
    channels: int
    sample: str  # type of its codes: uint8, uint16, float32
    level: float  # mean of all channels above the black level, of full scale
    saturated: float  # saturated, dark: shares of the pixels with a saturated channel, and without light in any
    dark: float
    peak: float  # code, of full scale, that one pixel of a thousand exceeds
    sharpness: float | None  # ratio of the energies of fine and coarser detail; None where there is none
    exposure_s: float | None  # as EXIF tells


def measure(codes: np.ndarray, camera: CameraResponse, exposure_s: float | None) -> Measures:
    """Measure codes (rows, columns, channels) of a camera; `exposure_s` comes from EXIF."""
    step = max(1, min(codes.shape[:2]) // SIDE_PX)
    codes_measured = codes[::step, ::step]
    light = light_of(codes_measured, camera)
    limit = saturation_code(codes.dtype, camera.saturation, camera.bits)
    return Measures(
        rows=codes.shape[0],
        columns=codes.shape[1],
        channels=codes.shape[2],
        sample=str(codes.dtype),
        level=float(light.mean()),
        saturated=float((codes_measured >= limit).any(axis=2).mean()),
        dark=float((light < NO_LIGHT).all(axis=2).mean()),
        peak=float(np.quantile(light.max(axis=2), 0.999)),
        sharpness=sharpness(codes),
        exposure_s=exposure_s,
    )


def light_of(codes: np.ndarray, camera: CameraResponse) -> np.ndarray:
    """Compute light above the black level, of full scale; encoding `file` counts as sRGB for 8 bits, else linear."""
    scale, stated = full_scale(codes.dtype, camera.bits), "srgb" if codes.dtype == np.uint8 else "linear"
    encoding = stated if camera.encoding == "file" else camera.encoding
    return decode(codes / scale, encoding) - decode(np.array(camera.black_level / scale), encoding)


def sharpness(codes: np.ndarray) -> float | None:
    """Compute the variance of the Laplacian in the middle over that at half size; None without detail."""
    import cv2

    top, left = (max(0, (size - SIDE_PX) // 2) for size in codes.shape[:2])
    grey = codes[top : top + SIDE_PX, left : left + SIDE_PX].astype(np.float32).mean(axis=2)
    if min(grey.shape) < 8:
        return None
    half = cv2.resize(grey, (grey.shape[1] // 2, grey.shape[0] // 2), interpolation=cv2.INTER_AREA)
    fine, coarse = (float(cv2.Laplacian(picture, cv2.CV_32F).var()) for picture in (grey, half))
    return fine / coarse if coarse > 0 else None


def _size(measures: Measures) -> str:
    size = f"{measures.rows} x {measures.columns} pixels"
    return f"{size} with {measures.channels} channels of {measures.sample}"


COMPARED = {"dome": 4, "turntable": 2, "goniometer": 2}
"""Number of neighbours for comparison with a frame."""


@dataclass(frozen=True)
class KeptFrame:
    """Accepted frame: its measurements, and its exposure in seconds where known."""

    frame: PlannedFrame
    measures: Measures
    exposure_s: float | None

    @property
    def rate(self) -> float:
        """Level for one second of exposure."""
        return self.measures.level / (self.exposure_s or 1.0)


class FrameNeighbours:
    """The frames of a plan, for comparison with each other.

    Attributes
    ----------
    references : dict
        By file, what the brightness of a frame is proportional to; see `incidence_cosines`.
    """

    def __init__(self, plan: ReadPlan, frames: tuple[PlannedFrame, ...]) -> None:
        self._plan, self._by_file = plan, {frame.file: frame for frame in frames}
        self.references = incidence_cosines(plan, frames)

    def reasons_against(
        self, frame: PlannedFrame, measures: Measures, exposure_s: float | None, kept: Mapping[str, Mapping[str, Any]]
    ) -> list[str]:
        """List reasons to reject a photograph, by itself and beside accepted ones (kept: their events)."""
        known = {
            file: KeptFrame(self._by_file[file], Measures(**event["measures"]), event["exposure_s"])
            for file, event in kept.items()
            if file in self._by_file
        }
        checks, reasons, size = self._plan.settings.checks, [], _size(measures)
        wanted = next((_size(one.measures) for one in known.values()), size)
        if size != wanted:
            reasons.append(f"expected {wanted} as the first frame, found {size}: set the camera as it was")
        if exposure_s and measures.exposure_s and abs(measures.exposure_s / exposure_s - 1) > EXPOSURE_TOLERANCE:
            found = f"EXIF tells an exposure of {measures.exposure_s:g} s, not {exposure_s:g} s"
            reasons.append(f"{found}: set the camera to M")
        if frame.group == "dark":
            if measures.level > DARK_LEVEL:
                found = f"a dark frame of {measures.level:.0%} of full scale"
                reasons.append(f"{found}: close the lens, or darken the room")
            return reasons
        most = checks.white_saturated if frame.group == "white" else checks.saturated
        if most is not None and measures.saturated > most:
            found = f"{measures.saturated:.1%} of the pixels are saturated, at most {most:.1%} may be"
            reasons.append(f"{found}: expose shorter")
        if checks.dark is not None and measures.dark > checks.dark:
            reasons.append(f"{measures.dark:.1%} of the pixels have no light: check that the lamp shines")
        sharp = [one.measures.sharpness for one in known.values() if one.frame.group == "object"]
        if frame.group == "object" and checks.sharpness is not None and measures.sharpness is not None and any(sharp):
            relative = measures.sharpness / next(filter(None, sharp))
            if relative < checks.sharpness:
                reasons.append(f"sharpness is {relative:.2f} of the first frame's: check that nothing moves")
        expected, factor = self._predict_level(frame, known, exposure_s), checks.brightness
        if expected and factor and not 1 / factor <= (ratio := max(measures.level, 0.0) / expected) <= factor:
            found = f"brightness is {ratio:.2g} of what its neighbours lead to expect (1/{factor:g} to {factor:g})"
            reasons.append(f"{found}: check this lamp, or the frames before")
        return reasons

    def _predict_level(
        self, frame: PlannedFrame, known: dict[str, KeptFrame], exposure_s: float | None
    ) -> float | None:
        """Predict the level of a frame from its neighbours; None without any."""
        near = [(frame_distance(self._plan, frame, one.frame), file) for file, one in known.items()]
        near = sorted(pair for pair in near if math.isfinite(pair[0]))[: COMPARED[self._plan.settings.kind]]
        boards = {known[file].frame.light: file for file in known if file.startswith("white/")} if frame.light else {}
        lights = {frame.light, *(known[file].frame.light for _, file in near)}
        use_boards = frame.group == "object" and lights <= set(boards)

        def reference(file: str) -> float:
            """Return the expected relative brightness of a frame: its board's, or the cosine of its lamp's angle."""
            if not use_boards:
                return self.references[file]
            return known[boards[self._by_file[file].light]].rate

        pairs = [(reference(file), known[file].rate) for _, file in near]
        pairs = [(value, rate) for value, rate in pairs if value > 0 and rate > 0]
        if not pairs:
            return None
        brighter = float(np.median([level / known for known, level in pairs]))
        return reference(frame.file) * brighter * (exposure_s or 1.0)


class Journal:
    """Append-only file of events.

    A line that was cut off by a kill or a full disk is left as it is, and not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, event: str, **facts: Any) -> dict[str, Any]:
        """Append an event and flush it to the disk. Return the line's content."""
        line = {"time": datetime.now().astimezone().isoformat(timespec="milliseconds"), "event": event, **facts}
        is_new = not self.path.exists()
        with self.path.open("a+b") as file:
            if file.seek(0, os.SEEK_END):
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":
                    file.write(b"\n")
            file.write(json.dumps(line, ensure_ascii=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        if is_new:
            flush(self.path.parent)
        return line

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield all complete events, in their order."""
        if not self.path.exists():
            return
        for line in self.path.read_bytes().split(b"\n"):
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event:
                yield event


REPEATED = ("rejected", "lost", "missing")
"""Events after which a frame is taken again."""


@dataclass(frozen=True)
class LastPhotograph:
    """Last photograph, reduced to the size for display. codes: (rows, columns, channels)."""

    frame: PlannedFrame
    codes: np.ndarray
    measures: Measures


class RunState:
    """State of a run; another thread may read it under `lock`.

    Attributes
    ----------
    frames : tuple of PlannedFrame
    kept : set of str
        Files of the frames that are in the capture.
    repeated : list of dict
        Journal lines of what was taken again, the oldest first.
    camera : Camera
        How codes become light.
    last : LastPhotograph or None
    doing : str
        Present action.
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.frames: tuple[PlannedFrame, ...] = ()
        self.kept: set[str] = set()
        self.repeated: list[dict[str, Any]] = []
        self.camera = CameraResponse()
        self.last: LastPhotograph | None = None
        self.doing = "The run begins"
        self._began = time.monotonic()
        self._at_first = 0

    def record_start(self, frames: tuple[PlannedFrame, ...], kept: set[str], camera: CameraResponse) -> None:
        """Record the start of a run, or its continuation with the remaining frames."""
        with self.lock:
            self.frames, self.kept, self.camera = frames, set(kept), camera
            self._began, self._at_first = time.monotonic(), len(kept)

    def record_photograph(self, frame: PlannedFrame, codes: np.ndarray, measures: Measures) -> None:
        """Record a photograph before it is accepted or rejected."""
        step = -(-max(codes.shape[:2]) // SIDE_PX)
        with self.lock:
            self.last = LastPhotograph(frame, codes[::step, ::step].copy(), measures)

    def record_event(self, event: dict[str, Any]) -> None:
        """Record a line that was added to the journal."""
        kind, file = event["event"], event.get("file", "")
        with self.lock:
            if kind == "frame":
                self.kept.add(file)
            elif kind in REPEATED:
                self.repeated.append(event)
            self.doing = {
                "frame": f"{file} is kept",
                "rejected": f"{file} is taken again",
                "lost": f"{file}: a device did not answer, it is opened again",
                "request": f"Waiting for a person: {event.get('request')}",
                "subject": "Taking photographs",
                "exposure": f"Exposure of the {event.get('group')}: {event.get('exposure_s')} s",
                "stop": f"Stopped: {event.get('message')}",
                "checked": "Checked; the capture is sealed now",
                "sealed": "Complete, checked and sealed",
            }.get(kind, self.doing)

    def seconds_left(self) -> float:
        """Estimate the seconds for the missing frames: the plan's estimate, scaled by the progress so far."""
        missing = sum(frame.seconds for frame in self.frames if frame.file not in self.kept)
        done = [frame.seconds for frame in self.frames if frame.file in self.kept]
        taken_now = len(self.kept) - self._at_first
        if taken_now <= 0 or not sum(done):
            return missing
        return missing * (time.monotonic() - self._began) / (sum(done) / len(done) * taken_now)


def why(event: dict[str, Any]) -> str:
    """Return why a frame is taken again, from one of the events `REPEATED`."""
    return "; ".join(event.get("reasons", [])) or event.get("message") or "its file is gone, or changed"


def capture_settings(plan: ReadPlan, header: ImageHeader | None = None) -> dict[str, Any]:
    """Collect keys of capture.yaml: those of the plan, derived ones, and those of a photograph, if any."""
    settings = plan.settings
    camera = dict(settings.capture.get("camera") or {})
    if header is not None:
        camera.setdefault("channels", list(channel_names(header)))
        camera.setdefault("encoding", choose_encoding(header, None, "")[0])
    values = {"format": FORMAT, "geometry": GEOMETRIES[settings.kind], **settings.capture, "camera": camera}
    if isinstance(settings, DomePlan):
        values["lights"] = {**(values.get("lights") or {}), "file": "lights.lp", "kind": settings.lights_kind}
    if isinstance(settings, TurntablePlan) and settings.turn_deg == 360 and settings.steps > 1:
        values["turntable"] = {"full_turn": True, **(values.get("turntable") or {})}
    return values


def write_tables(
    folder: Path,
    plan: ReadPlan,
    frames: tuple[PlannedFrame, ...],
    exposures: Mapping[str, float],
    header: ImageHeader | None = None,
) -> None:
    """Write capture.yaml, frames.csv and lights.lp into `folder`, and copy the files that the plan's `capture` names.

    exposures : mapping of str to float
        Seconds of each frame by its file. The column `exposure_s` is written where all lit frames have one.
    """
    values = capture_settings(plan, header)
    put_file(folder / "capture.yaml", settings_text(values))
    columns = {
        "dome": ["file", "role", "light"],
        "turntable": ["file", "role", "view", "light", "polariser"],
        "goniometer": ["file", "role", *ANGLE_COLUMNS],
    }[plan.settings.kind]
    if all(frame.file in exposures for frame in frames if frame.group != "dark"):
        columns.append("exposure_s")
    rows = [columns]
    for frame in frames:
        cells = {key: getattr(frame, key, "") for key in columns} | dict(
            zip(ANGLE_COLUMNS, frame.angles_deg, strict=False)
        )
        cells["exposure_s"] = exposures.get(frame.file, "")
        rows.append([f"{cells[key]:.10g}" if isinstance(cells[key], float) else cells[key] for key in columns])
    put_file(folder / "frames.csv", table_text(rows))
    if plan.lights is not None:
        put_file(folder / "lights.lp", lights_text(plan.lights.names, plan.lights.vectors))
    for name in _texts(plan.settings.capture):
        source = plan.folder / name
        if not name_fault(name) and source.is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            put_file(target, source.read_bytes())


def refuse_unusable_settings(folder: Path) -> None:
    """Raise UserError with every mistake of the tables in `folder`; its frames are not taken yet."""
    _, problems = examine(folder)
    later = [p for p in problems if p.kind == "image-missing" and p.file.startswith("frames.csv row")]
    errors = [p for p in problems if p.severity == "error" and p not in later]
    if errors:
        raise UserError(f"plan: {CaptureError(errors)}\nRemedy: correct the plan's block 'capture', or its lights")


def _texts(value: Any) -> Iterator[str]:
    """Yield every text in a block of settings."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)
