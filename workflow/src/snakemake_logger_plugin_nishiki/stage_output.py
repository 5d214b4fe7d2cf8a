"""The standard error of Snakemake and of its local jobs, read line by line, so that it does not break the live line."""

import itertools
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TextIO

SYNC = "\x1cnishiki-read-up-to-here-"
PATIENCE_S = 2.0


class StageOutput:
    """Put a pipe in the place of descriptor 2, and pass on what is written to it.

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
