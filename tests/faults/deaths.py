"""Runs that die: killed groups, killed jobs, jobs without memory, two at a time, a clock that goes back."""

import os
import random
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from arena import Arena
from outcome import Outcome, judged, stage_of


def killed_runs(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """SIGKILL of the whole process group at random moments; each next run goes on from what is left, until one ends.

    Half of the moments are drawn from the time that the run may take; the others lie within the time that one stage
    takes, which is one of those that were struck least so far, so that few kills suffice for every stage.
    """
    left, struck, durations = [], Counter(), arena.durations()
    for count in range(amount):
        if not left:
            shutil.rmtree(arena.results, ignore_errors=True)
        run = arena.start()
        if numbers.random() < 0.5:
            finished = wait(run, numbers.uniform(0.2, max(1.0, 1.2 * arena.seconds * share_missing(arena))))
        else:
            ahead = [*missing(arena), "publish"]
            stage = numbers.choice([name for name in ahead if struck[name] == min(struck[other] for other in ahead)])
            finished = wait_for(run, stage, numbers.uniform(0, durations.get(stage, 1.0)))
        where = "between stages" if finished is None else "after the end"
        if finished is None:
            found = sorted(working(run.pid))
            struck.update(found)
            where = ", ".join(found) or where
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
        left.append((where, standing(arena)))
        print(f"  {count + 1} of {amount} kills, {where}", file=sys.stderr, flush=True)
        if finished is None and count + 1 < amount and numbers.random() > 0.2:
            continue
        told = (arena.folder / "run.log").read_text()
        for number, (place, (sound, torn)) in enumerate(left):
            if number + 1 < len(left):  # the run that was killed next had these before it, too
                present = left[-1][1][0]
                lost = len({name.rsplit("/", 1)[0] for name in sound - present})
                yield Outcome(place, not torn, True, lost, torn)
            else:
                yield judged(arena, place, detected=not torn, sound=sound, told=told)
        left = []


def standing(arena: Arena) -> tuple[set[str], int]:
    """Files that stand in finished artifacts with their bytes, and the number with others."""
    now = arena.digests()
    sound = {name for name, value in now.items() if arena.reference.get(name) == value}
    return sound, len(now) - len(sound)


def missing(arena: Arena) -> list[str]:
    """Stages of the artifacts that a run has yet to make."""
    there = {path.relative_to(arena.results) for path in arena.artifacts()}
    names = (path.relative_to(arena.kept) for path in arena.artifacts(arena.kept))
    return [name.parts[1] for name in names if name not in there]


def share_missing(arena: Arena) -> float:
    """Part of the artifacts that a run has yet to make."""
    return len(missing(arena)) / len(arena.artifacts(arena.kept))


def wait(run, seconds: float) -> int | None:
    """Exit status of a run that ends within some seconds, None where it goes on."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if run.poll() is not None:
            return run.returncode
        time.sleep(0.02)
    return None


def wait_for(run, stage: str, seconds: float) -> int | None:
    """As wait, counted from the moment when a stage is at work."""
    while run.poll() is None and stage not in working(run.pid):
        time.sleep(0.005)
    return wait(run, seconds)


def working(group: int) -> dict[str, int]:
    """Stages that run in a process group, with their processes."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            same = os.getpgid(int(entry.name)) == group
        except (OSError, ProcessLookupError):
            continue
        if same and len(words) > 2 and words[1].endswith("/scripts/stage.py"):
            found[words[2]] = int(entry.name)
    return found


def next_job(run, stage: str, seconds: float) -> int | None:
    """The process of a stage, some seconds after it set to work; None where the run ends before."""
    while run.poll() is None:
        process = working(run.pid).get(stage)
        if process is not None:
            wait(run, seconds)
            return process
        time.sleep(0.005)
    return None


def killed_jobs(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """SIGKILL of one job, as the kernel does when memory runs out: the run must end with an error that names it."""
    for _ in range(amount):
        yield from disturbed(arena, numbers, lambda process: os.kill(process, signal.SIGKILL))


def jobs_without_memory(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """A limit on a job's memory while it works: its next request fails."""

    def limit(process: int) -> None:
        size = int(Path(f"/proc/{process}/statm").read_text().split()[0]) * os.sysconf("SC_PAGESIZE")
        resource.prlimit(process, resource.RLIMIT_AS, (size + 2**20, size + 2**20))

    for _ in range(amount):
        yield from disturbed(arena, numbers, limit)


def disturbed(arena: Arena, numbers: random.Random, strike) -> Iterator[Outcome]:
    """Strike one job of a run from nothing, within a second and a half of its start."""
    shutil.rmtree(arena.results, ignore_errors=True)
    stage = numbers.choice(missing(arena))
    run = arena.start()
    job = next_job(run, stage, numbers.uniform(0, 1.5))
    if job is None:
        return
    try:
        strike(job)
    except (ProcessLookupError, FileNotFoundError):
        pass  # it had just ended
    status = run.wait()
    told = (arena.folder / "run.log").read_text()
    sound, torn = standing(arena)
    survived = status == 0 and not torn and len(sound) == len(arena.reference)
    named = status != 0 and stage in told and not torn
    yield judged(arena, stage, detected=survived or named, sound=sound, told=told)


def two_runs(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """Two runs on the same results: one is told that the other is alive, and nothing is harmed."""
    for _ in range(amount):
        shutil.rmtree(arena.results, ignore_errors=True)
        first = arena.start()
        wait(first, numbers.uniform(0.1, 0.8 * arena.seconds))
        ended = first.poll() is not None
        second = arena.run()
        first.wait()
        one_made_it = ended or (second.returncode != 0 and ("alive" in second.stdout or "running" in second.stdout))
        detected = one_made_it or (second.returncode == 0 and first.returncode == 0)
        yield judged(arena, "run", detected=detected and first.returncode == 0, told=second.stdout)


def clock_backwards(arena: Arena, numbers: random.Random, amount: int) -> Iterator[Outcome]:
    """Times of files that lie in the future or out of order, while one artifact has to be made again."""
    for _ in range(amount):
        arena.restore()
        for folder in arena.artifacts():
            moved = time.time() + numbers.choice([-1, 1]) * numbers.uniform(0, 10 * 86400)
            for path in folder.rglob("*"):
                os.utime(path, (moved, moved))
        victim = numbers.choice(arena.artifacts())
        name = victim.relative_to(arena.results).as_posix()
        shutil.rmtree(victim)
        sound = [file for file in arena.reference if not file.startswith(name + "/")]
        yield judged(arena, stage_of(name), detected=True, sound=sound)


KINDS = {
    "killed run": killed_runs,
    "killed job": killed_jobs,
    "job without memory": jobs_without_memory,
    "two runs": two_runs,
    "clock backwards": clock_backwards,
}
