"""Disks that are full or cannot be written: a small file system in memory holds the results."""

import contextlib
import random
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from arena import Arena
from outcome import Outcome, stage_of


@contextlib.contextmanager
def small_disk(arena: Arena, kibibytes: int):
    """The results on a file system of this size. PermissionError where mounting is not allowed."""
    shutil.rmtree(arena.results, ignore_errors=True)
    arena.results.mkdir()
    mount(f"-t tmpfs -o size={kibibytes}k tmpfs", arena.results)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(arena.results)], check=False)
        arena.restore()


def mount(arguments: str, folder: Path) -> None:
    """Call mount; PermissionError where it fails."""
    done = subprocess.run(["mount", *arguments.split(), str(folder)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise PermissionError(f"mount is not allowed here: {done.stderr.strip()}")


def sizes(arena: Arena) -> list[tuple[str, int, int]]:
    """Artifacts in the order in which they were made: name, bytes of all before it, its own."""
    folders = sorted(arena.artifacts(arena.kept), key=lambda path: (path / "artifact.json").stat().st_mtime_ns)
    found, before = [], 0
    for folder in folders:
        own = sum(-(-path.stat().st_size // 4096) * 4096 for path in folder.rglob("*") if path.is_file())
        found.append((folder.relative_to(arena.kept).as_posix(), before, own))
        before += own
    return found


def full_disk(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """For nine times `amount` artifacts, a disk on which those made before it stand, with room for a part of it."""
    steps = sizes(arena)
    for name, before, own in numbers.sample(steps, min(len(steps), 9 * amount)):
        room = (before + int(own * numbers.uniform(0, 0.9))) // 1024 + 40
        with small_disk(arena, room):
            for earlier in [step for step, size_before, _ in steps if size_before < before]:
                shutil.copytree(arena.kept / earlier, arena.results / earlier, symlinks=True)
            done = arena.run()
            full = done.returncode != 0
            told = done.stdout.lower()
            named = full and "space" in told and "finished results are kept" in told and "traceback" not in told
            yield after(arena, stage_of(name), named or not full, done, "size=4g")


def after(arena: Arena, where: str, detected: bool, done: subprocess.CompletedProcess, change: str) -> Outcome:
    """Give the disk what it lacked, run again, and compare."""
    first = arena.digests()
    wrong = sum(arena.reference.get(name) != value for name, value in first.items())
    mount(f"-o remount,{change}", arena.results)
    again = arena.run()
    second = arena.digests()
    lost = sum(name not in second for name in first)
    wrong += sum(arena.reference.get(name) != value for name, value in second.items())
    recovered = again.returncode == 0 and len(second) == len(arena.reference) and not wrong
    told = "" if detected and recovered else done.stdout[-2000:] + again.stdout[-2000:]
    return Outcome(where, detected, recovered, lost, wrong, told)


def read_only(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """Results that cannot be written, some artifacts missing: an error that says so, and nothing is harmed."""
    for _ in range(amount):
        with small_disk(arena, 4 << 20):
            shutil.copytree(arena.kept, arena.results, symlinks=True, dirs_exist_ok=True)
            victim = numbers.choice(arena.artifacts())
            shutil.rmtree(victim)
            mount("-o remount,ro", arena.results)
            done = arena.run()
            detected = done.returncode != 0 and "read-only" in done.stdout.lower()
            yield after(arena, victim.parent.name, detected, done, "rw")


KINDS = {"full disk": full_disk, "read-only results": read_only}
