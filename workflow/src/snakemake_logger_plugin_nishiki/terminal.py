"""Write lines for the user, on a terminal above one live line, and read what jobs write to standard error."""

import itertools
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TextIO

from nishiki.errors import printable

CLEAR = "\r\x1b[K"
"""Return to the beginning of the line, and clear it."""
COLUMNS = 80
"""Width of a terminal that does not report one, in characters."""
QUIET_SECONDS = 60.0
"""Seconds without another line after which the state is printed where there is no terminal."""


class Screen:
    """Output of lines. Not thread-safe: the caller holds a lock.

    Parameters
    ----------
    stream : text stream
        Standard error.
    """

    def __init__(self, stream: TextIO):
        self.stream = stream
        self.live = stream.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        self._shown = ""
        self._last = time.monotonic()

    def tell(self, text: str) -> None:
        """Print lines that stay."""
        text = "\n".join(printable(line) for line in text.split("\n"))
        self._write((CLEAR if self._shown else "") + text + "\n")
        self._shown = ""
        self._last = time.monotonic()

    def show(self, state: str) -> None:
        """Renew the live line; without a terminal, print the state where nothing was printed for a while."""
        state = printable(state)
        if not self.live:
            if time.monotonic() - self._last >= QUIET_SECONDS:
                self.tell(state)
            return
        state = state[: self.width]
        if state != self._shown:
            self._write(CLEAR + state)
            self._shown = state

    def close(self) -> None:
        """Take the live line away."""
        if self._shown:
            self._write(CLEAR)
            self._shown = ""

    @property
    def width(self) -> int:
        """Characters that fit the live line; without a terminal as many as there are."""
        if not self.live:
            return 1000
        with suppress(OSError, ValueError):
            return (os.get_terminal_size(self.stream.fileno()).columns or COLUMNS) - 1
        return COLUMNS - 1

    def _write(self, text: str) -> None:
        with suppress(OSError, ValueError):  # a terminal that is gone must not stop the run
            self.stream.write(text)
            self.stream.flush()


SYNC = "\x1cnishiki-read-up-to-here-"
PATIENCE_S = 2.0


class StageOutput:
    """Replace descriptor 2 by a pipe, and pass on the lines that are written to it.

    Jobs inherit the descriptor. Once this process is gone, a job that still writes gets a broken pipe; the next run
    would end it anyway.

    Parameters
    ----------
    take : callable
        Called with each line, in a thread of its own.
    """

    def __init__(self, take: Callable[[str], None]):
        self._take = take
        self._saved = os.dup(2)
        reading, writing = os.pipe()
        os.dup2(writing, 2)
        os.close(writing)
        self._numbers = itertools.count()
        self._awaited: dict[str, threading.Event] = {}
        self._open = True
        self._thread = threading.Thread(target=self._read, args=(reading,), daemon=True, name="stage output")
        self._thread.start()

    def terminal(self) -> TextIO:
        """Return the earlier standard error."""
        return open(os.dup(self._saved), "w", encoding="utf-8", errors="backslashreplace", closefd=True)

    def catch_up(self) -> None:
        """Return when everything that ended jobs have written is read."""
        if not self._open:
            return
        mark, read = f"{SYNC}{next(self._numbers)}", threading.Event()
        self._awaited[mark] = read
        with suppress(OSError):
            os.write(2, f"\n{mark}\n".encode())
            read.wait(PATIENCE_S)

    def close(self) -> None:
        """Put the descriptor back; a job that outlives this process may still hold the pipe."""
        if self._open:
            self.catch_up()
            self._open = False
            os.dup2(self._saved, 2)
            self._thread.join(PATIENCE_S / 4)

    def _read(self, descriptor: int) -> None:
        with open(descriptor, encoding="utf-8", errors="backslashreplace", newline=None) as lines:
            for line in lines:
                text = line.rstrip()
                read = self._awaited.pop(text, None)
                if read:
                    read.set()
                elif text:
                    with suppress(Exception):  # were the pipe no longer read, the jobs would wait for ever
                        self._take(text)
