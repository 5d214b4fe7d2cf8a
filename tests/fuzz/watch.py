"""What a reader may not do while it reads: write, start programs, load code, run for long, take much memory."""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Callable

from nishiki.errors import UserError

SECONDS = 10.0
MEGABYTES = 400
"""More than the bounds of `LOWERED` allow any reader, with the libraries' own buffers."""
LOWERED = {
    "image_pixels": 1 << 20,
    "image_bytes": 1 << 23,
    "matlab_bytes": 1 << 20,
    "store_chunk_bytes": 1 << 20,
    "store_array_bytes": 1 << 22,
    "arrays_bytes": 1 << 22,
    "memory_bytes": 1 << 24,
}
"""Bounds while fuzzing: so low that what is past them shows in a small process, as a bomb would in a large one."""
_EVENTS = {
    "os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "os.chmod", "os.chown",
    "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.putenv", "subprocess.Popen", "pickle.find_class",
    "socket.connect", "ctypes.dlopen", "shutil.rmtree", "shutil.copyfile",
}  # fmt: skip
DECODER = "nishiki.formats.picture_process"  # the one program that a reader starts: it has limits of its own
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_state = {"reading": False, "hooked": False, "seen": ""}


class Misbehaviour(Exception):
    """A reader did what no reader may do."""


def lower_bounds() -> None:
    """Set NISHIKI_BOUNDS to `LOWERED` for this process."""
    os.environ["NISHIKI_BOUNDS"] = ",".join(f"{name}={value}" for name, value in LOWERED.items())


def watched(read: Callable[[bytes], None], data: bytes) -> str:
    """Run a reader on data: 'read', or 'refused' where it raised UserError. Anything else it does is raised."""
    if not _state["hooked"]:
        sys.dont_write_bytecode = True  # of modules that a reader imports when it first needs them
        sys.addaudithook(_hook)
        _state["hooked"] = True
    before, start = _peak_megabytes(), time.process_time()
    _state.update(reading=True, seen="")
    try:
        read(data)
        outcome = "read"
    except UserError as error:
        str(error).encode()  # a message that cannot be printed is no message
        outcome = "refused"
    finally:
        _state["reading"] = False
    if _state["seen"]:
        raise Misbehaviour(_state["seen"])
    if _peak_megabytes() - before > MEGABYTES:
        raise Misbehaviour(f"took {_peak_megabytes() - before:.0f} MB")
    if time.process_time() - start > SECONDS:
        raise Misbehaviour(f"took {time.process_time() - start:.0f} s")
    return outcome


def paused(work: Callable, *args):
    """Do what belongs to the test and not to the reader (writing the reader's file)."""
    reading, _state["reading"] = _state["reading"], False
    try:
        return work(*args)
    finally:
        _state["reading"] = reading


def _peak_megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _hook(event: str, args: tuple) -> None:
    if not _state["reading"] or (event == "subprocess.Popen" and any(DECODER in word for word in args[1])):
        return
    writes = event == "open" and args[0] != os.devnull and isinstance(args[2], int) and args[2] & _WRITING
    if event in _EVENTS or writes:
        _state["seen"] = _state["seen"] or f"{event} {str(args[:2])[:200]}"
