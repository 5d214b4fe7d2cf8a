"""Simulated devices behind pseudo-terminals and folders: GRBL 1.1, ComXim, home-made dialogues, a camera on USB."""

import re
import time
from collections import deque
from pathlib import Path

from nishiki.simulate.rig.dome import SimulatedDome
from nishiki.simulate.rig.line import SimulatedLine

FAULTS = ("silence", "partial", "halves", "noise", "restart", "unplug")
"""Faults of the next answer: it never comes; only its beginning comes; it comes in two parts; after noise; the
device restarts in place of it; the cable is pulled."""
HALVES_S = 0.1
NOISE = bytes([0xFF, 0x00, 0xFE, 0x13])


class FaultyLine(SimulatedLine):
    """A device whose next answers have faults."""

    def __init__(self, *arguments, **options) -> None:
        self.faults: deque[str] = deque()
        super().__init__(*arguments, **options)

    def _answer(self, command: str) -> None:
        fault = self.faults.popleft() if self.faults else ""
        if not fault:
            super()._answer(command)
            return
        self.received.append(command)
        if fault in ("restart", "unplug"):
            getattr(self, fault)()
            return
        data = "".join(line + self.ending for line in self.obey(command)).encode()
        if fault == "silence":
            return
        if fault in ("partial", "halves"):
            half = max(1, len(data) // 2)
            data, rest = data[:half], data[half:]
            if fault == "halves":
                self.later(HALVES_S, lambda: self._write(rest))
        self._write(NOISE + self.ending.encode() + data if fault == "noise" else data)


class FaultyDome(FaultyLine, SimulatedDome):
    """A dome whose next answers have faults."""


# a controller with GRBL 1.1: start, homing, moves that take time, soft limits, alarms

PULL_OFF = 1.0
"""Units by which an axis leaves its limit switch after homing ($27)."""


class SimulatedGrbl(FaultyLine):
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


# a ComXim turntable: turns that take time, the heartbeat, refusals

HEARTBEAT_S = 0.02


class SimulatedComXim(FaultyLine):
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


# home-made devices


class SimulatedDialogue(FaultyLine):
    """A home-made device that gives set answers.

    Parameters
    ----------
    path : Path
        As of `SimulatedLine`.
    answers : dict of str to str
        The answer to each command; others are answered with `error`.
    greeting : str
        Line that the device sends when it starts.
    """

    def __init__(self, path: Path, answers: dict[str, str], greeting: str = "") -> None:
        self.answers, self.greeting = answers, greeting
        super().__init__(path, restarts_when_opened=bool(greeting))

    def greet(self) -> list[str]:
        return [self.greeting] if self.greeting else []

    def obey(self, command: str) -> list[str]:
        return [self.answers.get(command, f"error: unknown command {command}")]


# pictures for libgphoto2's virtual camera, which appears in a process that starts with VCAMERADIR set

CAPACITY = 1 << 20
"""Bytes of every picture of the virtual camera: it keeps to the length that the file had when the camera was opened."""


class VirtualCamera:
    """The folder of a virtual camera, and the picture that it takes next.

    The camera releases 26 times in one process, then says that its card is full.

    Parameters
    ----------
    folder : Path
        Folder to make; VCAMERADIR names it.
    jpeg : bytes
        The first picture.
    """

    def __init__(self, folder: Path, jpeg: bytes) -> None:
        self.picture = folder / "DCIM" / "100NIKON" / "next.jpg"
        self.picture.parent.mkdir(parents=True)
        self.show(jpeg)

    def show(self, jpeg: bytes) -> None:
        """Put a picture before the lens: a JPEG file, which is filled up with bytes that readers skip."""
        if len(jpeg) > CAPACITY:
            raise ValueError(f"expected a picture of at most {CAPACITY} bytes, found {len(jpeg)}")
        self.picture.write_bytes(jpeg.ljust(CAPACITY, b"\0"))
