"""A simulated painting under a dome, the software of the camera above it, and the person who attends.

The dome releases the camera on its shutter cable; the photograph under the lamp that shines then appears in the folder
of the camera's software. Programs reach it all through a serial port, a folder and a terminal, as with a real dome.

A device stands behind a pseudo-terminal, with its answers and the faults of a serial line.
"""

import csv
import errno
import os
import select
import shutil
import subprocess
import sys
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path

import yaml

from nishiki.errors import UserError

FAULTS = ("silence", "partial", "halves", "noise", "restart", "unplug")
"""Faults of the next answer: it never comes; only its beginning comes; it comes in two parts; after noise; the
device restarts in place of it; the cable is pulled."""
PAUSE_S = 0.05
"""Seconds from the opening of the port to the greeting, between heartbeats, and between the halves of an answer: real
boards take one or two to start."""
TICK_S = 0.002
NOISE = bytes([0xFF, 0x00, 0xFE, 0x13])


class SimulatedLine(threading.Thread):
    """One device at its end of a serial line.

    Parameters
    ----------
    path : Path
        A link that stands for the port; it leads to another pseudo-terminal after the cable was plugged in again.
    restarts_when_opened : bool
        Whether it restarts when its port is opened, as most Arduinos do.
    """

    ending = "\n"
    immediate = ""
    """Characters that the device obeys at once, without an end of line."""

    def __init__(self, path: Path, restarts_when_opened: bool = True) -> None:
        super().__init__(daemon=True)
        self.path, self.restarts_when_opened = path, restarts_when_opened
        self.faults: deque[str] = deque()
        self.received: list[str] = []
        self.events: list[tuple[float, Callable[[], None]]] = []
        self.guard = threading.RLock()
        self.master: int | None = None
        self.opened = self.stopped = False
        self.buffer = ""
        self.plug()
        self.start()

    def greet(self) -> list[str]:
        """Start anew; return the greeting."""
        return []

    def obey(self, command: str) -> list[str]:
        """Obey one command; return its answers."""
        raise NotImplementedError

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something after a time, unless the device restarts before."""
        self.events.append((time.monotonic() + seconds, action))

    def say(self, *lines: str) -> None:
        """Send lines."""
        self._write("".join(line + self.ending for line in lines).encode())

    def restart(self) -> None:
        """Restart the device, as a brown-out of its supply does."""
        with self.guard:
            self.events, self.buffer = [], ""
            self.say(*self.greet())

    def unplug(self) -> None:
        """Pull the cable."""
        with self.guard:
            if self.master is not None:
                os.close(self.master)
                self.master, self.opened = None, False
                self.path.unlink(missing_ok=True)
                self.events, self.buffer = [], ""

    def plug(self) -> None:
        """Plug the cable in; the device starts."""
        with self.guard:
            self.unplug()
            self.master, slave = os.openpty()
            tty.setraw(slave)
            self.path.unlink(missing_ok=True)  # what a killed simulation left
            self.path.symlink_to(os.ttyname(slave))
            os.close(slave)
            self.greet()

    def stop(self) -> None:
        """End the simulation."""
        self.stopped = True
        self.join(timeout=5)
        self.unplug()

    def __enter__(self) -> "SimulatedLine":
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def run(self) -> None:
        """Serve the line until `stop`."""
        while not self.stopped:
            with self.guard:
                self._serve()
            time.sleep(TICK_S)

    def _serve(self) -> None:
        if self.master is None:
            return
        poll = select.poll()
        poll.register(self.master, select.POLLIN)
        state = dict(poll.poll(0)).get(self.master, 0)
        if state & select.POLLHUP and not state & select.POLLIN:
            self.opened = False  # no program has the port open
            return
        if not self.opened:
            self.opened = True
            if self.restarts_when_opened:
                self.later(PAUSE_S, self.restart)
        if state & select.POLLIN:
            try:
                self._take(os.read(self.master, 4096).decode("ascii", "replace"))
            except OSError as error:
                if error.errno != errno.EIO:
                    raise
        for event in [event for event in self.events if event[0] <= time.monotonic()]:
            if event in self.events:  # not where an earlier one restarted the device
                self.events.remove(event)
                event[1]()

    def _take(self, text: str) -> None:
        for character in text:
            if character in self.immediate:
                self._answer(character)
                continue
            self.buffer += character
            if self.ends(self.buffer):
                command, self.buffer = self.buffer, ""
                if command.strip():
                    self._answer(command.strip().removesuffix(self.ending))

    def ends(self, text: str) -> bool:
        """Check whether a command is complete."""
        return text.endswith(self.ending)

    def _answer(self, command: str) -> None:
        self.received.append(command)
        fault = self.faults.popleft() if self.faults else ""
        if fault == "restart":
            self.restart()
            return
        if fault == "unplug":
            self.unplug()
            return
        data = "".join(line + self.ending for line in self.obey(command)).encode()
        if fault == "silence":
            return
        if fault in ("partial", "halves"):
            half = max(1, len(data) // 2)
            data, rest = data[:half], data[half:]
            if fault == "halves":
                self.later(PAUSE_S, lambda: self._write(rest))
        self._write(NOISE + self.ending.encode() + data if fault == "noise" else data)

    def _write(self, data: bytes) -> None:
        if self.master is not None and self.opened:
            try:
                os.write(self.master, data)
            except OSError:
                pass  # the program has closed the port


SUBJECTS = {"white board": "white", "lens cap on": "dark", "lens cap off": "object", "object": "object"}
"""Subjects before the lens after a request that contains these words; the first match counts."""
REQUEST_ENDS = "press Enter "
"""End of every request to a person."""


class SimulatedDome(SimulatedLine):
    """A dome of light-emitting diodes.

    Parameters
    ----------
    path : Path
        As of `SimulatedLine`.
    count : int
        Number of diodes; the first has the number 0.
    on_shutter : callable, optional
        Action of the camera on the shutter cable, given the diodes that are lit.
    on_light : callable, optional
        Function that is called when the lit diodes have changed, before the dome answers.

    Attributes
    ----------
    lit : set of int
        The diodes that shine.
    dead : set of int
        Diodes that have failed: the dome says that they shine, and they do not.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        on_shutter: Callable[[set[int]], None] | None = None,
        on_light: Callable[[set[int]], None] | None = None,
    ) -> None:
        self.count, self.on_shutter, self.on_light = count, on_shutter, on_light
        self.lit: set[int] = set()
        self.dead: set[int] = set()
        super().__init__(path)

    def greet(self) -> list[str]:
        self.lit = set(range(self.count))  # all diodes shine when it starts
        return ["<UV Turned off.>", "<All lights turned on.>", "====", "RTI-Dome intialized", "Software Version: 1.0"]

    def ends(self, text: str) -> bool:
        return text.endswith(">")

    def obey(self, command: str) -> list[str]:
        name, _, value = command.strip("<>").partition(",")
        off = ["<UV Turned off.>", "<All lights turned off.>"]
        if name == "0":
            self._light(set())
            return off
        if name == "3" and value.isdigit():
            number = int(value)
            self._light({number} if number < self.count else set())
            return [*off, f"<Single LED turned on, number: {number}, row: {number // 8}, column: {number % 8}>"]
        if name == "6":
            if self.on_shutter is not None:
                self.on_shutter(self.lit - self.dead)
            return ["<Shutter triggered.>"]
        return [f"<INCORRECT FUNCTION CALL: {name}>"]

    def _light(self, diodes: set[int]) -> None:
        self.lit = diodes
        if self.on_light is not None:
            self.on_light(diodes - self.dead)


class PaintingBench:
    """A dome with a camera on its shutter cable, over a painting that was photographed by hand before.

    Parameters
    ----------
    capture : Path
        Simulated capture of a painting: one lamp lights each photograph.
    folder : Path
        Folder to make: `dome` is the serial port, `camera` is where the camera's software saves.

    Attributes
    ----------
    lamps : tuple of str
        Names of the lamps, in the order of the dome.
    checks : tuple of str
        Lamps that are kept for evaluation.
    subject : {"object", "white", "dark"}
        Object before the lens: the painting, a white board in its place, or the lens cap.
    """

    def __init__(self, capture: Path, folder: Path) -> None:
        source = data_of(capture)
        with (source / "frames.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        self.photographs = {
            ("white" if row["role"] == "white" else "object", row["light"]): source / row["file"]
            for row in rows
            if row["role"] != "dark"
        }
        self.darks = [source / row["file"] for row in rows if row["role"] == "dark"]
        self.lamps = tuple(row["light"] for row in rows if row["role"] in ("sample", "check"))
        self.checks = tuple(row["light"] for row in rows if row["role"] == "check")
        self.subject = "object"
        self.darks_taken = 0
        self.saved_in = folder / "camera"
        self.saved_in.mkdir(parents=True, exist_ok=True)
        self.taken = len(list(self.saved_in.iterdir()))  # a camera goes on counting
        self.dome = SimulatedDome(folder / "dome", len(self.lamps), self.expose)

    def photograph(self, lit: set[int]) -> Path:
        """Simulate the camera: a photograph of the capture by hand."""
        if self.subject == "dark" or not lit:
            return self.darks[self.darks_taken % len(self.darks)]
        if len(lit) > 1:
            raise ValueError(f"expected one lamp that shines, found {len(lit)}: no such photograph was simulated")
        return self.photographs[self.subject, self.lamps[min(lit)]]

    def expose(self, lit: set[int]) -> None:
        """Photograph the subject before the lens; the camera's software saves it."""
        source = self.photograph(lit)
        self.darks_taken += source in self.darks
        self.taken += 1
        draft = self.saved_in / f".DSC_{self.taken:04d}{source.suffix}"
        shutil.copyfile(source, draft)
        draft.rename(draft.with_name(draft.name[1:]))

    def obey(self, request: str) -> None:
        """Put the requested subject before the lens. UserError where the request names nothing known."""
        words = [words for words in SUBJECTS if words in request]
        if not words:
            raise UserError(f"the simulated operator does not understand {request!r}")
        self.subject = SUBJECTS[words[0]]

    def close(self) -> None:
        """End the simulation."""
        self.dome.stop()


def data_of(capture: Path) -> Path:
    """Return the folder of a capture's files: `data` once it is sealed."""
    return capture / "data" if (capture / "data").is_dir() else capture


def write_rig(bench: PaintingBench, by_hand: Path, folder: Path) -> tuple[Path, Path]:
    """Write the description of the bench and a plan that takes the photographs of the capture by hand.

    Returns
    -------
    tuple of Path
        rig.yaml and plan.yaml, in `folder`.
    """
    source = data_of(by_hand)
    capture = yaml.safe_load((source / "capture.yaml").read_text())
    lights = capture["lights"]
    for key in ("format", "geometry", "lights"):
        del capture[key]  # these follow from the plan
    shutil.copyfile(source / lights["file"], folder / lights["file"])
    if (source / "spectra").is_dir():
        shutil.copytree(source / "spectra", folder / "spectra", dirs_exist_ok=True)
    port = str((folder / "dome").absolute())
    rig = {
        "camera": {"kind": "folder", "folder": "camera", "release": "lamps", "complete_s": 0.1},
        "lamps": {"kind": "dome", "port": port, "count": len(bench.lamps), "settle_s": 0.0},
    }
    plan = {
        "kind": "dome",
        "lights": lights["file"],
        "lights_kind": lights["kind"],
        "suffix": bench.darks[0].suffix[1:],
        "white": {"when": "before"},
        "dark": {"when": "after", "frames": len(bench.darks)},
        "checks_for": list(bench.checks),
        "capture": capture,
    }
    paths = folder / "rig.yaml", folder / "plan.yaml"
    for path, values in zip(paths, (rig, plan), strict=True):
        path.write_text(yaml.safe_dump(values, sort_keys=False))
    return paths


def run_at_terminal(command: list[str], obey: Callable[[str], None], **options: object) -> int:
    """Run a program at a terminal where a simulated person answers its requests; its output goes to standard error.

    Parameters
    ----------
    command : list of str
        The program.
    obey : callable
        Does what the last line asks; then Enter is pressed.
    **options
        Further arguments of `subprocess.Popen`.

    Returns
    -------
    int
        Exit status of the program.
    """
    master, slave = os.openpty()
    try:
        program = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, **options)
        os.close(slave)
        line = ""
        while True:
            if not select.select([master], [], [], 0.1)[0]:
                if program.poll() is not None:
                    break
                continue
            try:
                text = os.read(master, 4096).decode(errors="replace")
            except OSError:  # the program has ended
                break
            print(text, end="", file=sys.stderr, flush=True)
            line = (line + text).rpartition("\n")[2]
            if line.endswith(REQUEST_ENDS):
                obey(line)
                line = ""
                os.write(master, b"\n")
        return program.wait()
    finally:
        os.close(master)
