"""How far a capture run is: what is kept, what was repeated and why, and how long the rest will take."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from nishiki.capture.schema_base import Camera
from nishiki.rig.frame_check import Measures
from nishiki.rig.frames_table import PlannedFrame

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
        self.camera = Camera()
        self.last: LastPhotograph | None = None
        self.doing = "The run begins"
        self._began = time.monotonic()
        self._at_first = 0

    def started(self, frames: tuple[PlannedFrame, ...], kept: set[str], camera: Camera) -> None:
        """The run begins, or goes on with the frames that are not kept yet."""
        with self.lock:
            self.frames, self.kept, self.camera = frames, set(kept), camera
            self._began, self._at_first = time.monotonic(), len(kept)

    def photographed(self, frame: PlannedFrame, codes: np.ndarray, measures: Measures) -> None:
        """A photograph was read, before it is known whether it is kept."""
        step = -(-max(codes.shape[:2]) // SEEN_PX)
        with self.lock:
            self.last = LastPhotograph(frame, codes[::step, ::step].copy(), measures)

    def happened(self, event: dict[str, Any]) -> None:
        """A line was added to the journal."""
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
