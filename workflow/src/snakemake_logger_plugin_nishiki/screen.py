"""Lines for the user: on a terminal above one live line, elsewhere plain lines only."""

import os
import time
from contextlib import suppress
from typing import TextIO

from nishiki.errors import printable

CLEAR = "\r\x1b[K"
"""Back to the beginning of the line, and empty it."""
COLUMNS = 80
"""Width of a terminal that does not say its own."""
QUIET_SECONDS = 60.0
"""Without a terminal, the state is told after so long without another line."""


class Screen:
    """Where the lines go. Not thread-safe: the caller holds a lock.

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
