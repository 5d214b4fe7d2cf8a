"""Simulate a device behind a pseudo-terminal."""

import errno
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

BOOT_S = 0.05
"""Seconds from the opening of the port to the greeting: real boards take one or two."""
TICK_S = 0.002


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
                self.later(BOOT_S, self.restart)
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
        self.say(*self.obey(command))

    def _write(self, data: bytes) -> None:
        if self.master is not None and self.opened:
            with suppress(OSError):  # the program has closed the port
                os.write(self.master, data)
