"""Keep compiled kernels by the name of their module, so that copies of the project share them.

It prints a word where they are not there yet.

numba by itself keeps them by the path of the source file. It imports the class below by the name that the environment
variable NUMBA_CACHE_LOCATOR_CLASSES gives.
"""

import sys
import threading
import time
from pathlib import Path

from numba.core import event
from numba.core.caching import UserProvidedCacheLocator

PACKAGE = Path(__file__).resolve().parent
PATIENCE_S = 1.0
"""Seconds of compilation in a process after which a message is printed."""
COMPILING = "nishiki: compiling kernels for their first use, which takes up to two minutes; they are kept"


class ByModule(UserProvidedCacheLocator):
    """A folder of NUMBA_CACHE_DIR for every module of this package; other functions are left to the next class."""

    @classmethod
    def from_function(cls, py_func, py_file):
        """Return the locator of a function of this package; None for others, and where no folder is given."""
        return super().from_function(py_func, py_file) if PACKAGE in Path(py_file).resolve().parents else None

    @classmethod
    def get_suitable_cache_subpath(cls, py_file):
        """Name of the folder: that of the module, `photometric.solve` for example."""
        return ".".join(Path(py_file).resolve().relative_to(PACKAGE).with_suffix("").parts)


class Announcement(event.Listener):
    """Print once in a process, on standard error, that kernels are being compiled, where that takes a while.

    `message` is what it tells; a stage sets its own.
    """

    message = COMPILING

    def __init__(self):
        self._depth, self._started, self._spent = 0, 0.0, 0.0
        self._timer: threading.Timer | None = None

    def on_start(self, event: event.Event) -> None:
        """Begin to wait with the outermost function that is compiled."""
        if self._depth == 0 and self._spent < PATIENCE_S:
            self._started = time.monotonic()
            self._timer = threading.Timer(PATIENCE_S - self._spent, print, [self.message], {"file": sys.stderr})
            self._timer.daemon = True
            self._timer.start()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """End the waiting with the outermost function."""
        self._depth -= 1
        if self._depth == 0 and self._timer:
            self._timer.cancel()
            self._spent += time.monotonic() - self._started


event.register("numba:compile", Announcement())
