"""A simulated ComXim turntable: turns that take time, the heartbeat, refusals."""

import re
from pathlib import Path

from nishiki.simulate.rig.line import SimulatedLine

HEARTBEAT_S = 0.02


class SimulatedComXim(SimulatedLine):
    """A turntable.

    Parameters
    ----------
    path : Path
        As of `SimulatedLine`.
    command : str
        How its firmware spells the command that turns it.
    speed : float
        Degrees per second.

    Attributes
    ----------
    angle : float
        Where the table is, in degrees, from where it stood when it was switched on. The cable does not supply it.
    """

    ending = ";"

    def __init__(self, path: Path, command: str = "TRUNSINGLE", speed: float = 20000.0) -> None:
        self.command, self.speed = command, speed
        self.angle = self.zero = 0.0
        super().__init__(path, restarts_when_opened=False)
        self.later(HEARTBEAT_S, self._beat)

    def obey(self, command: str) -> list[str]:
        if command == "CT()":
            return ["CR+OK"]
        if command == "CT+SETZERO()":
            self.zero = self.angle
            return ["CR+OK"]
        if command == "CT+TOZERO()":
            return self._turn(self.zero - self.angle) if self.angle != self.zero else ["CR+OK"]
        turn = re.fullmatch(rf"CT\+{self.command}\(([01]),(\d+(?:\.\d+)?)\)", command)
        if turn:
            return self._turn(float(turn[2]) * (1 if turn[1] == "0" else -1))
        return ["CR+ERR=12"]

    def _turn(self, degrees: float) -> list[str]:
        def arrive() -> None:
            self.angle += degrees
            self.say("CR+EVENT=TB_PAUSE", "CR+EVENT=TB_END")

        self.later(abs(degrees) / self.speed, arrive)
        return ["CR+OK"]

    def _beat(self) -> None:
        self._write(b"#")
        self.later(HEARTBEAT_S, self._beat)
