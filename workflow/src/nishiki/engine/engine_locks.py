"""Snakemake's locks: lists of files in `.snakemake/locks`, which stay there where a run is killed.

A lock file holds the names of the inputs or outputs of one run, a name a line. It does not say whose it is; what it
names does, where our own registry (`nishiki.engine.running_lock`) knows which scenes a run makes.
"""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from nishiki.processes import pids


def lock_files(directory: Path) -> list[Path]:
    """Lock files of the runs that were started in a directory."""
    return sorted((directory / ".snakemake/locks").glob("*.lock"))


def scenes_named(lock: Path, results: str) -> set[str]:
    """Scenes of some results in which anything lies that a lock names."""
    inside = f"{results}/"
    try:
        names = lock.read_text().splitlines()
    except FileNotFoundError:
        return set()
    return {name.removeprefix(inside).split("/", 1)[0] for name in names if name.startswith(inside)}


def forget_backups(directory: Path, results: str, scenes: Iterable[str]) -> None:
    """Remove what Snakemake had put by of a scene's manifests, to restore them where a job fails.

    Where the run was killed they stay there, and would come back when a job of a later run fails.
    """
    backups = directory / ".snakemake/backups" / results.lstrip("/")
    if backups.is_dir():
        for scene in scenes:
            shutil.rmtree(backups / scene, ignore_errors=True)


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
