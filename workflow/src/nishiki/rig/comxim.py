"""Turntables of ComXim, over USB or a serial adapter.

A command is `CT+NAME(values);`, an answer `CR+OK;` or `CR+ERR=N;`, and a turn ends with `CR+EVENT=TB_END;`. Between
them the table may send the heartbeat `#`. It turns by angles, not to them, and has no switch at zero: its zero is where
it stood when it was switched on. So the angle is counted here, and lost with the connection.
"""

from __future__ import annotations

import math
import re

from nishiki.rig.device import DeviceError, closed_on_failure
from nishiki.rig.grbl import not_homed
from nishiki.rig.operator import ask_operator
from nishiki.rig.serial_line import SerialLine

ANSWER_S = 3.0
TURN_S = 180.0
"""Seconds that a whole turn may take at the slowest speed."""
STEP_DEG = 0.01
"""Angles are sent with two decimals, and counted as they were sent."""


class ComXimTurntable:
    """A ComXim turntable as an axis.

    Parameters
    ----------
    name : str
        Name in messages.
    port : str
        Serial port.
    baud : int
        Bits per second.
    command : {"TRUNSINGLE", "TURNSINGLE"}
        How the table's firmware spells the command that turns it.
    reference : {"operator", "table"}
        How its zero is found: a person turns it to its mark; or it returns to the zero that it keeps while switched on.
    """

    def __init__(
        self, name: str, port: str, baud: int = 115200, command: str = "TRUNSINGLE", reference: str = "operator"
    ) -> None:
        self.name, self.command, self.reference = name, command, reference
        self.angle: float | None = None
        self.range_deg = (0.0, 360.0)
        self.line = SerialLine(name, port, baud, ending=";", ignore=b"#")
        with closed_on_failure(self.line):
            # Opening the port can reach the table as noise, which it answers with CR+ERR: either answer shows that it
            # is there.
            self.line.ask("CT()", r"CR\+(OK|ERR)", ANSWER_S)
            self.line.discard()

    def home(self) -> None:
        """Find the zero; see `reference`."""
        self.angle = None
        if self.reference == "operator":
            ask_operator(self.name, "turn the table by hand to its zero mark")
            self._ask("CT+SETZERO()")
        else:
            # A table that stands at zero already acknowledges TOZERO and never says that it ended: it is moved first.
            self._turn(1.0)
            self._ask("CT+TOZERO()")
            self.line.answer(r"CR\+EVENT=TB_END", TURN_S, r"CR\+ERR=(\d+)", self._explain)
        self.angle = 0.0

    def move_to(self, degrees: float) -> None:
        """Turn the shorter way to an angle, and return when the table stands."""
        if not math.isfinite(degrees):
            raise DeviceError(f"{self.name}: expected an angle in degrees, found {degrees}. Remedy: correct the plan")
        if self.angle is None:
            raise not_homed(self.name)
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
        self._ask(f"CT+{self.command}({direction},{abs(degrees):.2f})".replace(".00)", ")"))
        self.line.answer(r"CR\+EVENT=TB_END", TURN_S, r"CR\+ERR=(\d+)", self._explain)

    def _ask(self, text: str) -> None:
        self.line.ask(text, r"CR\+OK", ANSWER_S, r"CR\+ERR=(\d+)", self._explain)

    def _explain(self, refusal: re.Match[str]) -> str:
        other = "TURNSINGLE" if self.command == "TRUNSINGLE" else "TRUNSINGLE"
        return (
            f"The table refuses the command. Remedy: write 'command: {other}' into its description if its firmware "
            "spells it so; otherwise switch the table off and on and run again"
        )
