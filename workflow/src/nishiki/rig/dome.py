"""Domes of light-emitting diodes that speak the protocol `<3,n>`: commands between angle brackets at 9600 baud.

`<3,n>` lights one diode alone, `<0>` none, `<6>` releases a camera on the dome's shutter cable. `<5,ms>` runs through
all diodes and releases at each: it is not used, since such a run can neither be checked frame by frame nor continued.
The dome's computer answers in words, and lights all diodes when it starts.
"""

from __future__ import annotations

import time

from nishiki.rig.device import DeviceError, closed_on_failure
from nishiki.rig.serial_line import SerialLine

GREETING = "RTI-Dome in"
GREETING_S = 3.0
"""Seconds that an Arduino needs to start after its port was opened."""
ANSWER_S = 3.0


class BracketDome:
    """A dome with the protocol `<3,n>`.

    Parameters
    ----------
    name : str
        Name in messages.
    port : str
        Serial port.
    count : int
        Number of lamps.
    first : int
        The number that the dome gives to lamp 1.
    settle_s : float
        Seconds from the answer until the light is steady.
    baud : int
        Bits per second.
    """

    def __init__(
        self, name: str, port: str, count: int, first: int = 0, settle_s: float = 0.2, baud: int = 9600
    ) -> None:
        self.name, self.count, self.first, self.settle_s = name, count, first, settle_s
        self.line = SerialLine(name, port, baud, restart=GREETING)
        with closed_on_failure(self.line):
            self.line.greeting(GREETING, GREETING_S)  # a board that does not restart when opened sends none
            self.light(None)

    def light(self, lamp: int | None) -> None:
        """Light one lamp, numbered from 1, or none."""
        if lamp is None:
            self._ask("<0>", "All lights turned off")
        else:
            expect_lamp(self.name, lamp, self.count)
            number = lamp - 1 + self.first
            self._ask(f"<3,{number}>", rf"Single LED turned on, number: {number}\b")
        time.sleep(self.settle_s)

    def release(self) -> None:
        """Release the camera on the dome's shutter cable."""
        self._ask("<6>", "Shutter triggered")

    def close(self) -> None:
        """Switch the lamps off and close the line; a second call does nothing."""
        if self.line.serial.is_open:
            try:
                self._ask("<0>", "All lights turned off")
            except DeviceError:
                pass  # it has gone
            self.line.close()

    def _ask(self, command: str, expect: str) -> None:
        self.line.ask(command, expect, ANSWER_S, "INCORRECT FUNCTION CALL", _explain)


def _explain(refusal: object) -> str:
    return "The dome does not know the command. Remedy: check that its program has the commands <0>, <3,n> and <6>"


def expect_lamp(name: str, lamp: int, count: int) -> None:
    """Raise DeviceError where there is no such lamp."""
    if not 1 <= lamp <= count:
        raise DeviceError(
            f"{name}: expected a lamp from 1 to {count}, found {lamp}. "
            "Remedy: correct the plan, or the number of lamps in the description of the rig"
        )
