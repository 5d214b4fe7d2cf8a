"""How far a capture run is: what is kept, what was repeated and why, and how long the rest will take."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from nishiki.rig.frame_check import Measures
from nishiki.rig.frames_table import PlannedFrame


class RunState:
    """Follows a run, and is told of everything in it.

    Attributes
    ----------
    frames : tuple of PlannedFrame
    kept : set of str
        Files of the frames that are in the capture.
    repeated : list of dict
        Journal lines of what was taken again, the oldest first.
    """

    def __init__(self) -> None:
        self.frames: tuple[PlannedFrame, ...] = ()
        self.kept: set[str] = set()
        self.repeated: list[dict[str, Any]] = []
        self._began = time.monotonic()
        self._at_first = 0

    def started(self, frames: tuple[PlannedFrame, ...], kept: set[str]) -> None:
        """The run begins, or goes on with the frames that are not kept yet."""
        self.frames, self.kept = frames, set(kept)
        self._began, self._at_first = time.monotonic(), len(kept)

    def photographed(self, frame: PlannedFrame, codes: np.ndarray, measures: Measures) -> None:
        """A photograph was read, before it is known whether it is kept."""

    def happened(self, event: dict[str, Any]) -> None:
        """A line was added to the journal."""
        if event["event"] == "frame":
            self.kept.add(event["file"])
        elif event["event"] in ("rejected", "lost", "missing"):
            self.repeated.append(event)

    def seconds_left(self) -> float:
        """Seconds that the frames that are missing will take: as the plan reckons, in the proportion seen so far."""
        missing = sum(frame.seconds for frame in self.frames if frame.file not in self.kept)
        done = [frame.seconds for frame in self.frames if frame.file in self.kept]
        taken_now = len(self.kept) - self._at_first
        if taken_now <= 0 or not sum(done):
            return missing
        return missing * (time.monotonic() - self._began) / (sum(done) / len(done) * taken_now)
