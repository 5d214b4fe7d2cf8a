"""What a photograph should look like beside those that are kept: a lamp that failed shows at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nishiki.rig.frame_check import Measures, expected_level, reasons_against
from nishiki.rig.frames_table import PlannedFrame
from nishiki.rig.plan import ReadPlan, frame_distance, incidence_cosines

COMPARED = {"dome": 4, "turntable": 2, "goniometer": 2}
"""Neighbours that a frame is compared with."""


@dataclass(frozen=True)
class KeptFrame:
    """A frame that is kept: what was measured in it, and its exposure in seconds where that is known."""

    frame: PlannedFrame
    measures: Measures
    exposure_s: float | None

    @property
    def rate(self) -> float:
        """Level for one second of exposure."""
        return self.measures.level / (self.exposure_s or 1.0)


class Neighbours:
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
        self,
        frame: PlannedFrame,
        measures: Measures,
        exposure_s: float | None,
        kept: Mapping[str, Mapping[str, Any]],
    ) -> list[str]:
        """Why a photograph cannot be kept, by itself and beside those that are (kept: their events)."""
        known = {
            file: KeptFrame(self._by_file[file], Measures(**event["measures"]), event["exposure_s"])
            for file, event in kept.items()
            if file in self._by_file
        }
        objects = [one.measures for one in known.values() if one.frame.group == "object" and one.measures.sharpness]
        return reasons_against(
            frame.group,
            measures,
            self._plan.settings.checks,
            first=next((one.measures for one in known.values()), None),
            reference_sharpness=objects[0].sharpness if objects else None,
            expected=self._expected(frame, known, exposure_s),
            exposure_s=exposure_s,
        )

    def _expected(
        self, frame: PlannedFrame, known: dict[str, KeptFrame], exposure_s: float | None
    ) -> tuple[float, float] | None:
        """Level that a frame should have by its neighbours, and the factor by which it may differ."""
        settings = self._plan.settings
        if frame.group == "dark" or settings.checks.brightness is None:
            return None
        near = [(frame_distance(self._plan, frame, one.frame), file) for file, one in known.items()]
        near = sorted(pair for pair in near if math.isfinite(pair[0]))[: COMPARED[settings.kind]]
        boards = {known[file].frame.light: file for file in known if file.startswith("white/")} if frame.light else {}
        lights = {frame.light, *(known[file].frame.light for _, file in near)}
        use_boards = frame.group == "object" and lights <= set(boards)

        def reference(file: str) -> float:
            """What the brightness of a frame is proportional to: its board's, or the cosine of its lamp's angle."""
            if not use_boards:
                return self.references[file]
            return known[boards[self._by_file[file].light]].rate

        pairs = [(reference(file), known[file].rate) for _, file in near]
        pairs = [(value, rate) for value, rate in pairs if value > 0 and rate > 0]
        if not pairs:
            return None
        return expected_level(reference(frame.file), pairs) * (exposure_s or 1.0), settings.checks.brightness
