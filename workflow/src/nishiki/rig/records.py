"""Write what a capture run leaves behind: its journal, its progress, and the tables of the capture."""

import json
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
from nishiki.errors import UserError
from nishiki.formats.files import flush, name_fault, put_file
from nishiki.formats.picture_files import ImageHeader
from nishiki.formats.problems import CaptureError
from nishiki.rig.frame_check import Measures
from nishiki.rig.frames_table import PlannedFrame
from nishiki.rig.plan import GEOMETRIES, DomePlan, ReadPlan, TurntablePlan


class Journal:
    """An append-only file of events.

    A line that was cut off by a kill or a full disk is left as it is, and not read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, event: str, **facts: Any) -> dict[str, Any]:
        """Append an event; it is on the disk when this returns. Returns the line's content."""
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
        """All complete events, in their order."""
        if not self.path.exists():
            return
        for line in self.path.read_bytes().split(b"\n"):
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event:
                yield event


SEEN_PX = 900
"""Longest side of the copy of the last photograph that is held."""
REPEATED = ("rejected", "lost", "missing")
"""Events after which a frame is taken again."""


@dataclass(frozen=True)
class LastPhotograph:
    """The last photograph, thinned to a size that can be shown. codes: (rows, columns, channels)."""

    frame: PlannedFrame
    codes: np.ndarray
    measures: Measures


class RunState:
    """Follows a run; another thread may read it under `lock`.

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
        What goes on.
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

    def started(self, frames: tuple[PlannedFrame, ...], kept: set[str], camera: CameraResponse) -> None:
        """Record the start of a run, or its continuation with the remaining frames."""
        with self.lock:
            self.frames, self.kept, self.camera = frames, set(kept), camera
            self._began, self._at_first = time.monotonic(), len(kept)

    def photographed(self, frame: PlannedFrame, codes: np.ndarray, measures: Measures) -> None:
        """Record a photograph that was read, before it is accepted or rejected."""
        step = -(-max(codes.shape[:2]) // SEEN_PX)
        with self.lock:
            self.last = LastPhotograph(frame, codes[::step, ::step].copy(), measures)

    def happened(self, event: dict[str, Any]) -> None:
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
        """Seconds that the frames that are missing will take: as the plan reckons, in the proportion seen so far."""
        missing = sum(frame.seconds for frame in self.frames if frame.file not in self.kept)
        done = [frame.seconds for frame in self.frames if frame.file in self.kept]
        taken_now = len(self.kept) - self._at_first
        if taken_now <= 0 or not sum(done):
            return missing
        return missing * (time.monotonic() - self._began) / (sum(done) / len(done) * taken_now)


def why(event: dict[str, Any]) -> str:
    """Why a frame is taken again, of one of the events `REPEATED`."""
    return "; ".join(event.get("reasons", [])) or event.get("message") or "its file is gone, or changed"


FULL_TURN_DEG = 360.0


def capture_settings(plan: ReadPlan, header: ImageHeader | None = None) -> dict[str, Any]:
    """Keys of capture.yaml: those of the plan, and what follows from it and from a photograph, once there is one."""
    settings = plan.settings
    camera = dict(settings.capture.get("camera") or {})
    if header is not None:
        camera.setdefault("channels", list(channel_names(header)))
        camera.setdefault("encoding", choose_encoding(header, None, "")[0])
    values = {"format": FORMAT, "geometry": GEOMETRIES[settings.kind], **settings.capture, "camera": camera}
    if isinstance(settings, DomePlan):
        values["lights"] = {**(values.get("lights") or {}), "file": "lights.lp", "kind": settings.lights_kind}
    if isinstance(settings, TurntablePlan) and settings.turn_deg == FULL_TURN_DEG and settings.steps > 1:
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
    put_file(folder / "frames.csv", _frames_csv(plan, frames, exposures))
    if plan.lights is not None:
        put_file(folder / "lights.lp", lights_text(plan.lights.names, plan.lights.vectors))
    for name in _texts(plan.settings.capture):
        source = plan.folder / name
        if not name_fault(name) and source.is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            put_file(target, source.read_bytes())


def refuse_unusable_settings(folder: Path) -> None:
    """UserError with every mistake of the tables in `folder`, which hold frames that are not taken yet."""
    _, problems = examine(folder)
    later = [p for p in problems if p.kind == "image-missing" and p.file.startswith("frames.csv row")]
    errors = [p for p in problems if p.severity == "error" and p not in later]
    if errors:
        raise UserError(f"plan: {CaptureError(errors)}\nRemedy: correct the plan's block 'capture', or its lights")


def _frames_csv(plan: ReadPlan, frames: tuple[PlannedFrame, ...], exposures: Mapping[str, float]) -> str:
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
    return table_text(rows)


def _texts(value: Any) -> Iterator[str]:
    """Every text in a block of settings."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)
