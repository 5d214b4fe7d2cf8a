"""Snakemake's locks: lists of files in `.snakemake/locks`, which stay there where a run is killed.

A lock file holds the names of the inputs or outputs of one run, a name a line. It does not say whose it is; what it
names does, where our own registry (`nishiki.running_lock`) knows which scenes a run makes.
"""

import os
from collections.abc import Iterable
from pathlib import Path

from nishiki.processes import pids


def lock_files(directory: Path) -> list[Path]:
    """Lock files of the runs that were started in a directory."""
    return sorted((directory / ".snakemake/locks").glob("*.lock"))


def names_any(lock: Path, results: str, scenes: Iterable[str]) -> bool:
    """Whether a lock names anything in these scenes of some results."""
    inside = tuple(f"{results}/{scene}/" for scene in scenes)
    return any(name.startswith(inside) for name in _names(lock))


def _names(lock: Path) -> list[str]:
    try:
        return [line for line in lock.read_text().splitlines() if line.strip()]
    except FileNotFoundError:
        return []


def engines(directory: Path, marks: str) -> list[int]:
    """Processes of Snakemake in a directory that carry no variable `marks`: started by hand, not by `./nishiki`."""
    return [pid for pid in pids() if pid != os.getpid() and _is_engine(pid, directory, marks.encode() + b"=")]


def _is_engine(pid: int, directory: Path, marks: bytes) -> bool:
    process = Path("/proc", str(pid))
    try:
        arguments = (process / "cmdline").read_bytes().split(b"\0")
        named = any(os.path.basename(argument) in (b"snakemake", b"snakemake.py") for argument in arguments[:4])
        if not named or os.readlink(process / "cwd") != str(directory.resolve()):
            return False
        return not any(entry.startswith(marks) for entry in (process / "environ").read_bytes().split(b"\0"))
    except OSError:
        return False
