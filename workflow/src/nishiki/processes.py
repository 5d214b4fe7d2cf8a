"""Identify a process by host, number and start time, so that a number used again is not mistaken.

Process numbers are given out again, after a restart of the machine to quite other programs. Number and start (in clock
ticks since the machine started) together name one process; neither depends on the time of day.
"""

import os
import platform
import re
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

START_FIELD = 22  # of /proc/<pid>/stat, counted from one
AFTER_NAME = 3  # first field after the name, which may hold spaces and brackets


@cache
def host() -> str:
    """Name of this machine, made of letters, digits and hyphens."""
    return re.sub(r"[^A-Za-z0-9-]", "-", platform.node()) or "unnamed"


def boot() -> str:
    """Name that this machine's kernel gave itself when it started; empty where it has none."""
    return _text(Path("/proc/sys/kernel/random/boot_id"))


def machine() -> str:
    """Name that this machine keeps over restarts; empty where it has none, as in many containers."""
    return _text(Path("/etc/machine-id"))


def namespace() -> str:
    """Name of the set of processes that this one can see; another one inside another container."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def start_ticks(pid: int) -> int | None:
    """Return when a process started, in clock ticks since the machine did; None where there is no such process."""
    try:
        fields = Path("/proc", str(pid), "stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return None
    return int(fields[START_FIELD - AFTER_NAME]) if fields[0] not in (b"Z", b"X") else None


def identity(pid: int | None = None) -> str:
    """Return `<pid>-<start ticks>` of a process, of this one by default."""
    pid = os.getpid() if pid is None else pid
    return f"{pid}-{start_ticks(pid)}"


def is_alive(name: str) -> bool:
    """Return whether the process of this identity lives on this machine; a bare number is taken as any start."""
    pid, _, ticks = name.partition("-")
    if not pid.isdigit():
        return False
    started = start_ticks(int(pid))
    return started is not None and (not ticks or ticks == str(started))


def owner() -> str:
    """Return `<host>.<identity>` of this process, as it stands in the names of unfinished folders."""
    return f"{host()}.{identity()}"


def owner_of(name: str) -> tuple[str, str]:
    """Parse host (may be empty) and identity of an unfinished folder's name, `.<what>.<host>.<identity>.<suffix>`."""
    parts = name.split(".")
    named = len(parts) > 4 and not re.fullmatch(r"[0-9a-f]{12}|old|current", parts[-3])
    return parts[-3] if named else "", parts[-2] if len(parts) > 2 else ""


def find_marked(variable: str, value: str) -> list[int]:
    """List the user's processes on this machine that were started with an environment variable of this value.

    Whatever a process starts inherits its environment: children are found even where their parents are gone.
    """
    entry = f"{variable}={value}".encode()
    matching = [pid for pid in pids() if pid != os.getpid() and entry in _words(pid, "environ")]
    return [pid for pid in matching if start_ticks(pid) is not None]


def pids() -> list[int]:
    """List the numbers of all processes that this one can see."""
    return [int(name) for name in os.listdir("/proc") if name.isdigit()]


def runs(pid: int, script: str) -> bool:
    """Return whether a process was started with a script of this name."""
    return any(Path(os.fsdecode(word)).name == script for word in _words(pid, "cmdline"))


def _words(pid: int, which: str) -> list[bytes]:
    try:
        return Path("/proc", str(pid), which).read_bytes().split(b"\0")
    except OSError:
        return []


def stop(find: Callable[[], list[int]], *, patience_s: float = 5.0) -> list[int]:
    """End the processes that `find` names, and those that it names afterwards; whichever are left at the end."""
    for number, seconds in ((signal.SIGTERM, patience_s), (signal.SIGKILL, patience_s)):
        until = time.monotonic() + seconds
        while (running := find()) and time.monotonic() < until:
            for pid in running:
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, number)
            time.sleep(0.1)
        if not running:
            return []
    return find()


def interrupt_when_terminated() -> None:
    """Treat a termination of this process as an interrupt, once: whatever arrives later finds it ending already.

    Raises KeyboardInterrupt in the main thread at the first SIGTERM or SIGINT; an ignored SIGINT stays ignored.
    """

    def interrupt(*_: object) -> None:
        for number in heeded:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    heeded = [number for number in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(number) != signal.SIG_IGN]
    for number in heeded:
        signal.signal(number, interrupt)
