"""The devices of a rig while frames are taken: opened when they are needed, and anew after one was lost."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from nishiki.errors import UserError
from nishiki.rig.description import RigDescription
from nishiki.rig.device import Exposure, Rig, closed_on_failure
from nishiki.rig.frames_table import PlannedFrame


class OpenedRig:
    """The devices that some frames need.

    Parameters
    ----------
    description : Path
        Of the rig.
    frames : tuple of PlannedFrame
        What is to be taken.
    open_devices : callable
        Opens the devices of a description.
    """

    def __init__(
        self, description: Path, frames: tuple[PlannedFrame, ...], open_devices: Callable[[Path], Rig]
    ) -> None:
        self._description, self._frames, self._open_devices = description, frames, open_devices
        self._rig: Rig | None = None
        self._exposure: tuple[Exposure, Exposure] | None = None  # as asked for, as the camera set it

    def opened(self) -> Rig:
        """The devices, opened and at home. UserError where the rig lacks what a frame needs; DeviceError."""
        if self._rig is None:
            rig = self._open_devices(self._description)
            with closed_on_failure(rig):
                expect_devices(self._frames, rig)
                if any(frame.axes for frame in self._frames):
                    rig.home()
            self._rig, self._exposure = rig, None
        return self._rig

    def close(self) -> None:
        """Close what is open; the next use opens it again."""
        if self._rig is not None:
            self._rig.close()
            self._rig = None

    def set_up(self, frame: PlannedFrame, seconds: float | None) -> float | None:
        """Turn, light and set everything as a frame wants it; the seconds of exposure that the camera has set."""
        rig = self.opened()
        for name, state in frame.polarisers:
            rig.polarisers[name].set(state)
        for name, angle in frame.axes:
            axis = rig.axes[name]
            axis.move_to(reachable_angle(angle, axis.range_deg, f"{frame.file}: axis {name}"))
        if rig.lamps is not None and (frame.lamp is not None or frame.group == "dark"):
            rig.lamps.light(frame.lamp)
        wanted = Exposure(seconds, frame.aperture, frame.iso)
        if self._exposure is None or self._exposure[0] != wanted:
            self._exposure = (wanted, rig.camera.configure(wanted))
        return self._exposure[1].seconds or seconds


def expect_devices(frames: tuple[PlannedFrame, ...], rig: Rig | RigDescription) -> None:
    """UserError where frames need lamps, axes, angles or polarisers that a rig does not have."""
    wanted = {frame.lamp for frame in frames if frame.lamp is not None}
    count = getattr(rig.lamps, "count", math.inf) if rig.lamps is not None else 0
    if wanted and max(wanted) > count:
        raise UserError(f"plan: expected a rig with lamp {max(wanted)}, found {count} lamps in its description")
    for kind, names, devices in (
        ("axis", {name for frame in frames for name, _ in frame.axes}, rig.axes),
        ("polariser", {name for frame in frames for name, _ in frame.polarisers}, rig.polarisers),
    ):
        if missing := sorted(names - set(devices)):
            there = ", ".join(devices) or "none"
            raise UserError(
                f"plan: no {kind} '{missing[0]}' in the rig's description, which has {there}. "
                "Remedy: use one name in both"
            )
    for frame in frames:
        for name, angle in frame.axes:
            limits = getattr(rig.axes[name], "range_deg", None)
            if limits is not None:
                reachable_angle(angle, limits, f"plan: {frame.file}: axis {name}")
        for name, state in frame.polarisers:
            states = getattr(rig.polarisers[name], "states", None)
            if states is not None and state not in states:
                raise UserError(f"plan: {frame.file}: polariser {name} has {', '.join(states)}, not '{state}'")


def reachable_angle(angle: float, limits: tuple[float, float], where: str) -> float:
    """The angle, or the same direction one turn on or back, that lies in the range of an axis."""
    for turned in (angle, angle - 360, angle + 360):
        if limits[0] - 1e-9 <= turned <= limits[1] + 1e-9:
            return turned
    raise UserError(f"{where}: expected {limits[0]:g} to {limits[1]:g} degrees, found {angle:g}")
