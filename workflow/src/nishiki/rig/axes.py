"""Drive the axes of a rig: turntables and goniometer arms behind GRBL 1.1, and ComXim turntables.

GRBL counts in its own units, which $100 to $102 tie to motor steps; a description says how many make a
degree. Positions are machine coordinates, relative to where homing ended: they need no work offset, and none that
another program has left behind can shift them. A controller that has restarted or raised an alarm has lost its
position, and no axis moves before it is homed again.

ComXim: a command is `CT+NAME(values);`, an answer `CR+OK;` or `CR+ERR=N;`, and a turn ends with `CR+EVENT=TB_END;`.
Between them the table may send the heartbeat `#`. It turns by angles, not to them, and has no switch at zero: its zero
is where it stood when it was switched on. So the angle is counted here, and lost with the connection.
"""

import math
import re
import time
from typing import Literal

from pydantic import Field, model_validator

from nishiki.artifacts.declaration import Closed
from nishiki.rig import device

GREETING = r"^Grbl"
TOO_OLD = r"^Grbl 0\."
"""Greeting of releases before 1.1, whose status reports have another form."""
RESET = "\x18"
"""Ctrl-X: restarts the controller at once."""
STANDS_WITHIN = 0.02
"""Tolerance of a reached position in the controller's units: it reports three decimals of whole steps."""

ERRORS = {
    5: "Homing is switched off. Remedy: connect limit switches and set $22=1",
    8: "The controller was not idle. Remedy: wait until it stands and run again",
    9: "The controller is locked after an alarm or a start. Remedy: run again; homing unlocks it",
    10: "Soft limits need homing. Remedy: set $22=1",
    13: "The safety door is open. Remedy: close it and run again",
    15: "The target is beyond the axis's travel. Remedy: correct range_deg of the axis, or $130 to $132",
    20: "The controller does not know this command. Remedy: check that it runs GRBL 1.1 and has this axis",
}
"""Meaning and remedy of each `error:N` that a rig can cause."""
ALARMS = {
    1: "A limit switch was hit and the position is lost. Remedy: free the axis by hand, find what it hit, run again",
    2: "The target is beyond the soft limits. Remedy: correct range_deg of the axis, or $130 to $132, and run again",
    3: "A reset stopped the movement and the position is lost. Remedy: run again; the axes are homed first",
    6: "A reset stopped the homing. Remedy: run again",
    7: "The safety door was opened while homing. Remedy: close it and run again",
    8: "Homing did not leave the limit switch. Remedy: raise the pull-off $27, check the switch's wiring, run again",
    9: "Homing did not reach a limit switch. Remedy: check the switch and its wiring, $23 (direction), $130 to $132",
}
"""Meaning and remedy of each `ALARM:N` that a rig can cause."""
STATES = {
    "Hold": "It is paused. Remedy: release the pause button and run again",
    "Door": "The safety door is open. Remedy: close it and run again",
    "Check": "It only checks commands. Remedy: send $C to end that mode, then run again",
    "Sleep": "It sleeps. Remedy: switch it off and on, then run again",
}
"""Controller states without movement, and the remedy of each."""


class Grbl:
    """GRBL controller, which several axes may share.

    Parameters
    ----------
    name : str
        Name in messages.
    port : str
        Serial port.
    baud : int
        Bits per second.
    """

    def __init__(self, name: str, port: str, baud: int = 115200) -> None:
        self.device, self.port = name, port
        self.line = device.SerialLine(name, port, baud, restart=GREETING)
        self.home_position: dict[str, float] = {}
        self.alarmed = False
        with device.closed_on_failure(self.line):
            # Most boards restart when their port is opened; one that is reached by USB itself does not.
            greeting = self.line.greeting(GREETING, device.GREETING_S) or self._restart()
            if re.search(TOO_OLD, greeting):
                raise self._failure(f"expected GRBL 1.1 or newer, found {greeting!r}. Remedy: install GRBL 1.1")

    @property
    def homed(self) -> bool:
        """Return whether the positions of the axes are known."""
        return bool(self.home_position)

    def home(self) -> None:
        """Move every axis to its limit switch and record its position. Done once after a start or an alarm."""
        if self.homed:
            return
        if self.alarmed:
            self._restart()
        self._command("$H", device.MOVE_S)
        self._command("G21 G90", device.ANSWER_S)
        _, position = self._wait_until_idle(time.monotonic() + device.MOVE_S)
        self.home_position = position

    def move(self, letter: str, target: float) -> None:
        """Turn one axis to a machine coordinate; return when the controller stands still there."""
        word = f"{letter}{target:.3f}"
        end = time.monotonic() + device.MOVE_S
        self._command(f"G53 G0 {word}", device.MOVE_S)
        while True:
            _, position = self._wait_until_idle(end)
            if abs(position[letter] - target) <= STANDS_WITHIN:
                return
            from scipy.constants import inch  # in metres

            found = f"sent 'G53 G0 {word}', axis {letter} stands at {position[letter]:.4f}, expected {target:.3f}"
            if abs(position[letter] * 1e3 * inch - target) <= STANDS_WITHIN:
                raise self._failure(f"{found}, which is the same in inches. Remedy: set $13=0 and run again")
            if time.monotonic() > end:
                remedy = "check what holds it, then run again; the axes are homed first"
                raise self._failure(f"{found} after {device.MOVE_S:g} s. Remedy: {remedy}")
            time.sleep(device.POLL_S)

    def close(self) -> None:
        """Close the line; a second call does nothing."""
        self.home_position = {}
        self.line.close()

    def _restart(self) -> str:
        """Reset the controller and return its greeting."""
        self.line.discard()  # after some alarms it restarts by itself, and its greeting is still to be read
        self.line.send(RESET, ending=False)
        greeting = self.line.greeting(GREETING, device.GREETING_S)
        if not greeting:
            raise device.DeviceLost(
                f"{self.device} at {self.port}: sent Ctrl-X, received no greeting of GRBL within {device.GREETING_S:g} "
                f"s. Remedy: check its power, and the port and speed ({self.line.baud} baud) with ./nishiki rig ports"
            )
        self.home_position, self.alarmed = {}, False
        return greeting

    def _command(self, text: str, timeout_s: float) -> None:
        self._asking(text, r"^ok$", timeout_s)

    def _asking(self, text: str, expect: str, timeout_s: float, ending: bool = True) -> re.Match[str]:
        """Send one command and return its answer; any error leaves the positions unknown."""
        try:
            return self.line.ask(text, expect, timeout_s, r"^(error|ALARM):(\d+)", self._explain, ending)
        except device.DeviceError:
            self.home_position = {}
            raise

    def _explain(self, refusal: re.Match[str]) -> str:
        number = int(refusal[2])
        if refusal[1] == "ALARM":
            self.alarmed = True
            return ALARMS.get(number, f"Remedy: look up alarm {number} of GRBL 1.1")
        return ERRORS.get(number, f"Remedy: look up error {number} of GRBL 1.1")

    def _wait_until_idle(self, end: float) -> tuple[str, dict[str, float]]:
        """Wait until the controller stands still; return its state and position."""
        while True:
            state, position = self._status()
            if state == "Idle":
                return state, position
            self.alarmed = self.alarmed or state == "Alarm"
            if state == "Alarm" or state in STATES:
                raise self._failure(f"sent '?', received the state {state}. {STATES.get(state, ERRORS[9])}")
            if time.monotonic() > end:
                remedy = "check what holds the axis, and its greatest speed ($110 to $112)"
                raise self._failure(f"still in state {state} after the time for this movement. Remedy: {remedy}")
            time.sleep(device.POLL_S)

    def _status(self) -> tuple[str, dict[str, float]]:
        match = self._asking("?", r"^<([A-Za-z]+)(?::\d+)?\|(.*)>$", device.ANSWER_S, ending=False)
        position = re.search(r"MPos:(-?\d+\.?\d*(?:,-?\d+\.?\d*)*)(?:\||$)", match[2])
        if position is None:
            raise self._failure(f"sent '?', received {match[0]!r} without a machine position. Remedy: set $10=1")
        return match[1], dict(zip("XYZABC", map(float, position[1].split(",")), strict=False))

    def _failure(self, what: str) -> device.DeviceError:
        """Make the error of a controller whose positions became unknown."""
        self.home_position = {}
        return device.DeviceError(f"{self.device} at {self.port}: {what}")


class GrblSettings(Closed):
    """An axis of a controller with GRBL 1.1; axes with the same port share the controller."""

    kind: Literal["grbl"]
    port: str = Field(description="serial port")
    axis: Literal["X", "Y", "Z", "A", "B", "C"] = Field(description="letter of the axis")
    units_per_degree: float = Field(
        1.0, description="units of the controller for a degree (straight: a millimetre); negative: the other way"
    )
    home_deg: float = Field(0.0, description="angle (straight: millimetres) at which homing ends")
    range_deg: tuple[float, float] = Field((0.0, 360.0), description="smallest and largest angle or millimetre")
    straight: bool = Field(False, description="goes along a line, and counts millimetres instead of degrees")
    baud: device.Baud = Field(115200, description="bits per second")

    @model_validator(mode="after")
    def _possible(self) -> "GrblSettings":
        if self.units_per_degree == 0:
            raise ValueError("units_per_degree must not be 0")
        if not self.range_deg[0] < self.range_deg[1]:
            raise ValueError("range_deg must begin with the smaller angle")
        return self


class GrblAxis:
    """Axis of a GRBL controller, which other axes may share."""

    def __init__(self, name: str, controller: Grbl, settings: GrblSettings) -> None:
        self.name, self.controller, self.settings = name, controller, settings
        self.range_deg, self.straight = settings.range_deg, settings.straight

    def home(self) -> None:
        """Find the reference of all axes of the controller, unless it is known."""
        self.controller.home()
        if self.settings.axis not in self.controller.home_position:
            axes = ", ".join(self.controller.home_position)
            raise device.DeviceError(f"{self.name}: the controller has no axis {self.settings.axis}; it has {axes}")

    def move_to(self, degrees: float) -> None:
        """Turn to an angle and return when the axis stands."""
        expect_in_range(self.name, degrees, self.range_deg)
        if not self.controller.homed:
            raise not_homed_error(self.name)
        settings, start = self.settings, self.controller.home_position[self.settings.axis]
        self.controller.move(settings.axis, start + (degrees - settings.home_deg) * settings.units_per_degree)

    def close(self) -> None:
        """Close the controller, with all of its axes."""
        self.controller.close()


def expect_in_range(name: str, degrees: float, range_deg: tuple[float, float]) -> None:
    """Raise DeviceError where an angle is outside the range of an axis (or is not a number)."""
    low, high = range_deg
    if not low <= degrees <= high:
        raise device.DeviceError(
            f"{name}: expected an angle from {low:g} to {high:g} degrees, found {degrees:g}. "
            "Remedy: correct the plan, or range_deg in the description of the rig"
        )


def not_homed_error(name: str) -> device.DeviceError:
    """Return the error of a move of an axis whose position is unknown."""
    return device.DeviceError(f"{name}: its position is not known since it was opened or failed. Remedy: home it first")


STEP_DEG = 0.01
"""Resolution of angles, which are sent and counted with two decimals."""


class ComXimSettings(Closed):
    """A ComXim turntable."""

    kind: Literal["comxim"]
    port: str = Field(description="serial port")
    baud: device.Baud = Field(115200, description="bits per second")
    command: Literal["TRUNSINGLE", "TURNSINGLE"] = Field("TRUNSINGLE", description="how its firmware spells a turn")
    reference: Literal["operator", "table"] = Field(
        "operator", description="zero: a person turns the table to its mark; or the table's own, while it has power"
    )


class ComXimTurntable:
    """A ComXim turntable as an axis."""

    def __init__(self, name: str, settings: ComXimSettings) -> None:
        self.name, self.settings = name, settings
        self.angle: float | None = None
        self.range_deg = (0.0, 360.0)
        self.line = device.SerialLine(name, settings.port, settings.baud, ending=";", ignore=b"#")
        with device.closed_on_failure(self.line):
            # Opening the port can reach the table as noise, which it answers with CR+ERR: either answer shows that it
            # is there.
            self.line.ask("CT()", r"CR\+(OK|ERR)", device.ANSWER_S)
            self.line.discard()

    def home(self) -> None:
        """Find the zero; see the setting `reference`."""
        self.angle = None
        if self.settings.reference == "operator":
            device.ask_operator(self.name, "turn the table by hand to its zero mark")
            self._ask("CT+SETZERO()")
        else:
            # A table that stands at zero already acknowledges TOZERO and never says that it ended: it is moved first.
            self._turn(1.0)
            self._turn_by("CT+TOZERO()")
        self.angle = 0.0

    def move_to(self, degrees: float) -> None:
        """Turn the shorter way to an angle, and return when the table stands."""
        if not math.isfinite(degrees):
            raise device.DeviceError(
                f"{self.name}: expected an angle in degrees, found {degrees}. Remedy: correct the plan"
            )
        if self.angle is None:
            raise not_homed_error(self.name)
        angle, self.angle = self.angle, None  # unknown while it turns
        steps = round(((degrees - angle + 180.0) % 360.0 - 180.0) / STEP_DEG)
        if steps:
            self._turn(steps * STEP_DEG)
        self.angle = (angle + steps * STEP_DEG) % 360.0

    def close(self) -> None:
        """Close the line; a second call does nothing."""
        self.angle = None
        self.line.close()

    def _turn(self, degrees: float) -> None:
        direction = 0 if degrees > 0 else 1
        self._turn_by(f"CT+{self.settings.command}({direction},{abs(degrees):.2f})".replace(".00)", ")"))

    def _turn_by(self, text: str) -> None:
        self._ask(text)
        self.line.answer(r"CR\+EVENT=TB_END", device.MOVE_S, r"CR\+ERR=(\d+)", self._explain)

    def _ask(self, text: str) -> None:
        self.line.ask(text, r"CR\+OK", device.ANSWER_S, r"CR\+ERR=(\d+)", self._explain)

    def _explain(self, refusal: re.Match[str]) -> str:
        other = "TURNSINGLE" if self.settings.command == "TRUNSINGLE" else "TRUNSINGLE"
        return (
            f"The table refuses the command. Remedy: write 'command: {other}' into its description if its firmware "
            "spells it so; otherwise switch the table off and on and run again"
        )
