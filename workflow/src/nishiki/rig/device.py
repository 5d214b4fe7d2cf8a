"""Define the interface of the devices of a capture rig, and the person who works them by hand.

A laboratory adds a device of its own by writing one class with the methods below; no base class is needed.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Protocol

from pydantic import Field

from nishiki.errors import UserError

Baud = Annotated[int, Field(ge=50, le=4_000_000)]
Files = Annotated[int, Field(ge=1, le=2)]
Seconds = Annotated[float, Field(gt=0, le=3600)]
Pause = Annotated[float, Field(ge=0, le=60)]


class DeviceError(UserError):
    """A device did not do what it was asked.

    The message names the device, what was sent, what came back, and what to do. Repeating the step does not help.
    """


class DeviceLost(DeviceError):
    """A device does not answer any more: a cable, sleep, or a reset in the middle of a step.

    Close the rig, open it again, home its axes and repeat the step: nothing is known of its positions.
    """


class Closable(Protocol):
    """A device, or the line to one."""

    def close(self) -> None:
        """Let it go; a second call does nothing."""


@contextmanager
def closed_on_failure(opened: Closable) -> Iterator[None]:
    """Close what was just opened where its first commands fail, so that it can be opened again."""
    try:
        yield
    except BaseException:
        opened.close()
        raise


@dataclass(frozen=True)
class Exposure:
    """Settings of a photograph; None leaves the camera's own."""

    seconds: float | None = None  # exposure time in seconds
    aperture: float | None = None  # f-number
    iso: int | None = None  # sensitivity


class Camera(Protocol):
    """A camera that is released by this computer, or whose photographs arrive in a folder."""

    def configure(self, exposure: Exposure) -> Exposure:
        """Set the exposure. Returns what the camera took, its nearest steps; None for what it does not tell.

        Raises DeviceError where a setting that was asked for cannot be set, or lies outside the camera's range.
        """

    def photograph(self, folder: Path) -> tuple[Path, ...]:
        """Expose once and download into `folder`, which exists.

        Returns the complete files of this exposure under the camera's own names: one, or raw and JPEG, sorted by name.
        """

    def close(self) -> None:
        """Release the camera; a second call does nothing."""


class Lamps(Protocol):
    """Lamps of which at most one shines."""

    count: int  # number of lamps

    def light(self, lamp: int | None) -> None:
        """Light this lamp alone, numbered from 1; None: all off. Returns when the light is steady."""

    def close(self) -> None:
        """Switch all lamps off where the line still works, and release the device; a second call does nothing."""


class Axis(Protocol):
    """A turning axis: a turntable, or one arm of a goniometer.

    One that goes along a line has an attribute `straight`, which is True, and counts millimetres.
    """

    range_deg: tuple[float, float]  # smallest and largest angle, in degrees

    def home(self) -> None:
        """Find the axis's reference, after which its position is known. Needed once after opening."""

    def move_to(self, degrees: float) -> None:
        """Turn to this angle and return when the axis stands still there.

        Raises DeviceError where the axis was not homed since it was opened, or the angle is outside its range.
        """

    def close(self) -> None:
        """Release the device; a second call does nothing."""


class Polariser(Protocol):
    """A polariser, or a pair of them, that a motor or a person puts into a state."""

    states: tuple[str, ...]  # its states, named as in the column `polariser` of frames.csv: `off`, `on`, `45`, `0/90`

    def set(self, state: str) -> None:
        """Put it into one of its states.

        Returns when it stands. Raises DeviceError where the device has no such state.
        """

    def close(self) -> None:
        """Release the device; a second call does nothing."""


@dataclass(frozen=True)
class Rig:
    """The devices of a rig, open."""

    camera: Camera
    lamps: Lamps | None = None  # None where the lamps are not switched by this computer
    # by their names in the rig's description: `turntable`, or the axes of a goniometer
    axes: dict[str, Axis] = field(default_factory=dict)
    polarisers: dict[str, Polariser] = field(default_factory=dict)  # by their names in the rig's description

    def home(self) -> None:
        """Home every axis, in the order of the description."""
        for axis in self.axes.values():
            axis.home()

    def close(self) -> None:
        """Close every device, the lamps first, even where some no longer answer."""
        for device in (self.lamps, *self.axes.values(), *self.polarisers.values(), self.camera):
            try:
                if device is not None:
                    device.close()
            except DeviceError:
                pass  # what cannot be reached any more needs no closing

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def ask_operator(device: str, request: str) -> None:
    """Ask the person at the terminal to do something, and wait until they press Enter.

    Raises DeviceError where the program has no terminal to ask on.
    """
    if not sys.stdin.isatty():
        raise DeviceError(
            f"{device}: {request}: nobody can be asked, since the program runs without a terminal. "
            "Remedy: run it in a terminal, or name a device in the rig's description that does this by itself"
        )
    print(f"{device}: {request}, then press Enter ", end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        raise DeviceError(f"{device}: {request}: the terminal was closed. Remedy: run the same command again")


class PromptedPolariser:
    """A polariser that a person turns.

    Parameters
    ----------
    name : str
        Name in messages.
    states : tuple of str
        The states that it has, named as in frames.csv.
    """

    def __init__(self, name: str, states: tuple[str, ...]) -> None:
        self.name, self.states = name, states
        self.state: str | None = None

    def set(self, state: str) -> None:
        """Ask for a state, unless it was the last that was asked for."""
        expect_state(self.name, state, self.states)
        if state != self.state:
            self.state = None
            ask_operator(self.name, f"set the polariser to '{state}'")
            self.state = state

    def close(self) -> None:
        """Nothing is held."""


def expect_state(name: str, state: str, states: tuple[str, ...]) -> None:
    """Raise DeviceError where a polariser has no such state."""
    if state not in states:
        raise DeviceError(
            f"{name}: expected one of the states {', '.join(states)}, found '{state}'. "
            "Remedy: correct the plan, or the states in the description of the rig"
        )
