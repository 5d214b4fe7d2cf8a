"""Define the interface of the devices of a capture rig, the dialogue over a serial line, and who works by hand.

A laboratory adds a device of its own by writing one class with the methods below; no base class is needed. Every device
behind a serial port speaks through `SerialLine`, so that time-outs, partial lines, noise and restarts in the middle are
treated in one place.
"""

import errno
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Protocol

from pydantic import Field

from nishiki.errors import UserError
from nishiki.installation import optional

Baud = Annotated[int, Field(ge=50, le=4_000_000)]
Files = Annotated[int, Field(ge=1, le=2)]
Seconds = Annotated[float, Field(gt=0, le=3600)]
Pause = Annotated[float, Field(ge=0, le=60)]


class DeviceError(UserError):
    """A device did not execute a command.

    The message names the device, what was sent, what came back, and what to do. Repeating the step does not help.
    """


class DeviceLost(DeviceError):
    """A device stopped answering: a cable, sleep, or a reset in the middle of a step.

    Close the rig, open it again, home its axes and repeat the step: nothing is known of its positions.
    """


class Closable(Protocol):
    """A device, or the line to one."""

    def close(self) -> None:
        """Release the device; a second call does nothing."""


@contextmanager
def closed_on_failure(opened: Closable) -> Iterator[None]:
    """Close a device whose first commands fail after opening, so that it can be opened again."""
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


class Camera(Closable, Protocol):
    """A camera that is released by this computer, or whose photographs arrive in a folder."""

    def configure(self, exposure: Exposure) -> Exposure:
        """Set the exposure. Return the camera's nearest steps; None for values that it does not report.

        Raises DeviceError where a setting that was asked for cannot be set, or lies outside the camera's range.
        """

    def photograph(self, folder: Path) -> tuple[Path, ...]:
        """Take one exposure and download into `folder`, which exists.

        Returns the complete files of this exposure under the camera's own names: one, or raw and JPEG, sorted by name.
        """


class Lamps(Closable, Protocol):
    """Lamps of which at most one is on."""

    count: int  # number of lamps

    def light(self, lamp: int | None) -> None:
        """Switch on this lamp alone, numbered from 1; None: all off. Return when the light is steady."""

    def close(self) -> None:
        """Switch all lamps off where the line still works, and release the device; a second call does nothing."""


class Axis(Closable, Protocol):
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


class Polariser(Closable, Protocol):
    """A polariser, or a pair of them, that a motor or a person puts into a state."""

    states: tuple[str, ...]  # its states, named as in the column `polariser` of frames.csv: `off`, `on`, `45`, `0/90`

    def set(self, state: str) -> None:
        """Move the polariser into one of its states.

        Returns when it stands. Raises DeviceError where the device has no such state.
        """


@dataclass(frozen=True)
class Rig(AbstractContextManager["Rig"]):
    """Open devices of a rig."""

    camera: Camera
    lamps: Lamps | None = None  # None where the lamps are not switched by this computer
    # by their names in the rig's description: `turntable`, or the axes of a goniometer
    axes: dict[str, Axis] = field(default_factory=dict)
    polarisers: dict[str, Polariser] = field(default_factory=dict)  # by their names in the rig's description

    def home(self) -> None:
        """Find the reference of every axis, in the order of the description."""
        for axis in self.axes.values():
            axis.home()

    def close(self) -> None:
        """Close every device, the lamps first, even where some no longer answer."""
        for device in (self.lamps, *self.axes.values(), *self.polarisers.values(), self.camera):
            with suppress(DeviceError):  # what cannot be reached any more needs no closing
                if device is not None:
                    device.close()

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
    """Polariser turned by a person.

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
        """Request a state from the operator, unless it was the last one requested."""
        expect_state(self.name, state, self.states)
        if state != self.state:
            self.state = None
            ask_operator(self.name, f"set the polariser to '{state}'")
            self.state = state

    def close(self) -> None:
        """Do nothing: no device is open."""


def expect_state(name: str, state: str, states: tuple[str, ...]) -> None:
    """Raise DeviceError where a polariser has no such state."""
    if state not in states:
        raise DeviceError(
            f"{name}: expected one of the states {', '.join(states)}, found '{state}'. "
            "Remedy: correct the plan, or the states in the description of the rig"
        )


LONGEST_LINE = 4096
"""Bytes without an end of line above which input is noise: no device here sends so long a line."""
WRITE_S = 2.0
"""Seconds that a port may take to accept a line."""
POLL_S = 0.05
"""Seconds between two looks whether something has moved or arrived."""
GREETING_S = 3.0
"""Seconds that an Arduino needs to start after its port was opened."""
ANSWER_S = 5.0
"""Seconds that a device may take to answer a line that moves nothing."""
MOVE_S = 180.0
"""Seconds that homing, a whole turn at the slowest speed, or any other movement may take."""
DELIVERY_S = 60.0
"""Seconds that a camera may take to deliver a photograph beyond the exposure, and a command to release it."""
QUIET_S = 0.3
"""Seconds without a byte after which a greeting is complete, and without an event after which an exposure is."""
SHOWN = 300
"""Longest excerpt of received text in a message, in characters."""


class SerialLine:
    """Open serial port that sends and receives lines.

    Parameters
    ----------
    device : str
        Name of the device in messages.
    port : str
        The serial port, such as /dev/ttyUSB0 or COM3.
    baud : int
        Bits per second.
    ending : str
        End of each line from the device, appended to each line sent to it.
    restart : str
        Regular expression of a line that the device sends when it starts; empty: it sends none. Where one comes after
        the greeting, the device has restarted and DeviceLost is raised.
    ignore : bytes
        Bytes that carry no meaning wherever they appear, such as the heartbeat of a turntable.
    """

    def __init__(
        self, device: str, port: str, baud: int, ending: str = "\n", restart: str = "", ignore: bytes = b""
    ) -> None:
        self.device, self.port, self.baud = device, port, baud
        self.ending, self.ignore = ending.encode(), ignore
        self.restart = re.compile(restart) if restart else None
        self.buffer = b""
        self.sent = ""
        serial = optional("pyserial")
        try:
            self.serial = serial.Serial(port, baud, timeout=0, write_timeout=WRITE_S, exclusive=True)
        except ValueError as error:
            raise DeviceError(f"{device}: {port} at {baud} baud: {error}. Remedy: correct the description") from None
        except Exception as error:  # SerialException, or termios.error, which is no OSError
            raise _open_error(device, port, error) from None

    def close(self) -> None:
        """Close the port; a second call does nothing."""
        with suppress(OSError):  # the port has gone
            self.serial.close()

    def greeting(self, pattern: str, timeout_s: float) -> str:
        """Wait for the line that a device sends when it starts, and for the end of its greeting.

        Parameters
        ----------
        pattern : str
            Regular expression of that line.
        timeout_s : float
            Seconds to wait for it.

        Returns
        -------
        str
            The line; empty where none came in time.
        """
        end = time.monotonic() + timeout_s
        while (line := self._next_line(end)) is not None:
            if re.search(pattern, line):
                self.discard()
                return line
        return ""

    def discard(self) -> None:
        """Discard input until none has arrived for QUIET_S (at most for ten times as long)."""
        start = last = time.monotonic()
        self.buffer = b""
        while time.monotonic() < min(last + QUIET_S, start + 10 * QUIET_S):
            if self._read():
                last = time.monotonic()
            self.buffer = b""

    def send(self, text: str, ending: bool = True) -> None:
        """Send a line. Earlier input is checked for a restart of the device, then discarded.

        Raises DeviceLost where the port has gone or accepts nothing.
        """
        while (line := self._next_line(0)) is not None:
            self._expect_no_restart(line)
        self.buffer = b""
        self.sent = text
        data = text.encode() + (self.ending if ending else b"")
        try:
            self.serial.write(data)
        except OSError as error:  # SerialTimeoutException is one
            raise self._lost(f"cannot be sent ({error})") from None

    def ask(
        self,
        text: str,
        expect: str,
        timeout_s: float,
        refused: str = "",
        explain: Callable[[re.Match[str]], str] | None = None,
        ending: bool = True,
    ) -> re.Match[str]:
        """Send a line and wait for the expected answer; other lines before it count as noise.

        Parameters
        ----------
        text : str
            Line to send.
        expect, refused : str
            Regular expressions of the answer, and of an answer that refuses. They are searched for in each line.
        timeout_s : float
            Seconds to wait for the answer.
        explain : callable, optional
            Function that returns the meaning of a refusal and the remedy, as whole sentences.
        ending : bool
            Whether the line ends as lines do; False for single characters that a device obeys at once.

        Raises
        ------
        DeviceError
            The device refuses.
        DeviceLost
            No answer in time, or the port has gone.
        """
        self.send(text, ending)
        return self.answer(expect, timeout_s, refused, explain)

    def answer(
        self, expect: str, timeout_s: float, refused: str = "", explain: Callable[[re.Match[str]], str] | None = None
    ) -> re.Match[str]:
        """Wait for an answer to the line sent last; parameters and errors as of `ask`.

        The beginning of a line that is not complete in time stays in the buffer.
        """
        lines: list[str] = []
        end = time.monotonic() + timeout_s
        while (line := self._next_line(end)) is not None:
            self._expect_no_restart(line)
            lines.append(line)
            refusal = re.search(refused, line) if refused else None
            if refusal:
                why = explain(refusal) if explain else "Remedy: see the device's manual"
                raise DeviceError(f"{self.device} at {self.port}: sent {self.sent!r}, received {line!r}. {why}")
            match = re.search(expect, line)
            if match:
                return match
        partial = self._text(self.buffer)
        parts = [repr(line) for line in lines] + ([f"{partial!r} without an end of line"] if partial else [])
        received = ", ".join(parts) or "nothing"
        if len(received) > SHOWN:
            received = f"{received[:SHOWN]} ..."
        raise self._lost(f"expected an answer with {expect!r} within {timeout_s:g} s, received {received}")

    def _next_line(self, end: float) -> str | None:
        """Return the next complete line that arrives before a moment of the monotonic clock."""
        while True:
            line, found, rest = self.buffer.partition(self.ending)
            if found:
                self.buffer = rest
                if line.strip():
                    return self._text(line)
                continue
            if len(self.buffer) > LONGEST_LINE:
                self.buffer = self.buffer[-LONGEST_LINE:]
                raise self._lost(f"received {LONGEST_LINE} bytes without an end of line")
            if not self._read():
                if time.monotonic() >= end:
                    return None
                time.sleep(0.005)

    def _read(self) -> bool:
        """Append received bytes to the buffer. Return whether there were any."""
        try:
            data = self.serial.read(LONGEST_LINE)
        except (OSError, TypeError) as error:  # TypeError: pyserial, of a port that was closed meanwhile
            raise self._lost(f"the port has gone ({error})") from None
        if self.ignore:
            data = data.translate(None, self.ignore)
        self.buffer += data
        return bool(data)

    def _expect_no_restart(self, line: str) -> None:
        if self.restart and self.restart.search(line):
            what = f"received {line!r}: the device has restarted in the middle, its positions are not known any more"
            raise self._lost(what)

    def _lost(self, what: str) -> DeviceLost:
        sent = f"sent {self.sent!r}, " if self.sent else ""
        remedy = f"check its power, the cable and the speed ({self.baud} baud), then run the same command again"
        return DeviceLost(f"{self.device} at {self.port}: {sent}{what}. Remedy: {remedy}")

    @staticmethod
    def _text(data: bytes) -> str:
        return data.decode("ascii", "backslashreplace").strip()


def _open_error(device: str, port: str, error: Exception) -> DeviceError:
    """Make the error of a port that does not open, with its remedy."""
    reason = errno.errorcode.get(getattr(error, "errno", None) or 0, "")
    if reason in ("EACCES", "EPERM"):
        remedy = "allow it with 'sudo usermod -aG dialout $USER' and log in again"
        return DeviceError(f"{device}: no permission to open {port}. Remedy: {remedy}")
    if reason in ("EBUSY", "EAGAIN"):
        return DeviceError(f"{device}: {port} is used by another program. Remedy: close that program and run again")
    remedy = "plug it in and switch it on; ./nishiki rig ports lists what is connected"
    return DeviceLost(f"{device}: {port} cannot be opened ({error}). Remedy: {remedy}")
