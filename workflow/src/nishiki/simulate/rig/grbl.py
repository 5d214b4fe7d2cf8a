"""A simulated controller with GRBL 1.1: start, homing, moves that take time, soft limits, alarms."""

import re
import time
from pathlib import Path

from nishiki.simulate.rig.line import SimulatedLine

PULL_OFF = 1.0
"""Units by which an axis leaves its limit switch after homing ($27)."""


class SimulatedGrbl(SimulatedLine):
    """A controller of axes X, Y and Z.

    Parameters
    ----------
    path : Path
        As of `SimulatedLine`.
    travel : float
        Largest travel of each axis ($130 to $132), in units; homing ends one pull-off below the upper end, which is 0.
    speed : float
        Units per second.
    restarts_when_opened : bool
        As of `SimulatedLine`.

    Attributes
    ----------
    switch_works : bool
        False: homing ends with ALARM:9.
    door_open : bool
        True: the controller reports the state Door.
    """

    immediate = "?\x18"

    def __init__(
        self, path: Path, travel: float = 800.0, speed: float = 20000.0, restarts_when_opened: bool = True
    ) -> None:
        self.travel, self.speed = travel, speed
        self.switch_works, self.door_open = True, False
        super().__init__(path, restarts_when_opened)

    def greet(self) -> list[str]:
        self.start_position = self.end_position = {"X": -17.0, "Y": -3.0, "Z": -250.0}  # where the motors happen to be
        self.moving_until = self.moving_since = time.monotonic()
        self.locked, self.needs_reset = True, False
        return ["", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]

    @property
    def position(self) -> dict[str, float]:
        """Positions of the axes now."""
        now, start, end = time.monotonic(), self.moving_since, self.moving_until
        share = 1.0 if now >= end else (now - start) / (end - start)
        return {axis: a + share * (self.end_position[axis] - a) for axis, a in self.start_position.items()}

    def obey(self, command: str) -> list[str]:
        if command == "\x18":
            return self.greet()
        if command == "?":
            return [self._status()]
        if self.needs_reset:
            return []  # after a critical alarm nothing is answered before a reset
        if command == "$H":
            if not self.switch_works:
                return ["ALARM:9", *self.greet()]  # it restarts by itself
            self.start_position = self.end_position = dict.fromkeys("XYZ", -PULL_OFF)
            self.locked = False
            return ["ok"]
        if command == "$X":
            self.locked = False
            return ["[MSG:Caution: Unlocked]", "ok"]
        if self.locked:
            return ["error:9"]
        if set(command.split()) <= {"G21", "G90"}:
            return ["ok"]
        move = re.fullmatch(r"G53 G0 ([XYZ])(-?\d+(?:\.\d+)?)", command)
        return self._move(move[1], float(move[2])) if move else ["error:20"]

    def _status(self) -> str:
        state = "Run" if time.monotonic() < self.moving_until else "Idle"
        state = "Alarm" if self.locked else "Door:0" if self.door_open else state
        position = ",".join(f"{value:.3f}" for value in self.position.values())
        return f"<{state}|MPos:{position}|FS:0,0>"

    def _move(self, axis: str, target: float) -> list[str]:
        if not -self.travel <= target <= 0:
            self.locked = self.needs_reset = True
            return ["ALARM:2", "[MSG:Reset to continue]"]
        self.start_position = self.position
        self.end_position = self.start_position | {axis: target}
        self.moving_since = time.monotonic()
        self.moving_until = self.moving_since + abs(target - self.start_position[axis]) / self.speed
        return ["ok"]
