"""Registering a run on its results: never beside a live run of the same scene, always behind a dead one."""

import json
import os
import secrets
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nishiki import processes
from nishiki.engine import engine_locks
from nishiki.engine.records import RUNS, Record, here, records, take
from nishiki.errors import UserError

MARK = "NISHIKI_RUN"
"""Environment variable that all processes of a run carry."""
UNFINISHED = "unfinished"
"""Entry of a run's record: scenes that its Snakemake is to look at; all, where there is none."""
PATIENCE_S = 120.0
SHARED = ("sweeps",)
"""Folders of the results that hold what runs make beside their scenes."""


@dataclass
class HeldRun:
    """This run while it is registered. unclean: a run of these scenes was killed before it."""

    path: Path
    descriptor: int
    facts: dict[str, Any]
    unclean: bool
    ended: str = "failed"

    def leave_out_finished(self, unfinished: Iterable[str]) -> None:
        """Note in the record which scenes are left to make: Snakemake builds its graph of these alone."""
        self.facts[UNFINISHED] = sorted(unfinished)
        _write(self.descriptor, self.facts)

    def call(self, command: list[str], environment: dict[str, str], *, keep: tuple[int, ...] = ()) -> int:
        """Run Snakemake as a part of this run and wait for its end; its exit status. keep: descriptors that it gets.

        It gets an interrupt from the terminal by itself. A termination is passed on as an interrupt, which ends its
        jobs in order: Snakemake's own handler takes a lock that the very thread may hold, and then waits for ever.
        """
        passed = (self.descriptor, *keep)
        child = subprocess.Popen(command, env={**environment, MARK: self.facts["id"]}, pass_fds=passed)
        ours = threading.current_thread() is threading.main_thread()
        heeded = signal.getsignal(signal.SIGINT) != signal.SIG_IGN  # a shell starts what stands before & without it
        passed_on = signal.SIGINT if heeded else signal.SIGTERM

        def stop(*_: object) -> None:
            self.ended = "interrupted"
            child.send_signal(passed_on)

        before = signal.signal(signal.SIGTERM, stop) if ours else None
        try:
            while True:
                try:
                    return child.wait()
                except KeyboardInterrupt:
                    self.ended = "interrupted"
        finally:
            if ours:
                signal.signal(signal.SIGTERM, before)


@contextmanager
def registered(
    results: Path, scenes: Iterable[str], *, gone: Iterable[str] = (), tell: Callable[[str], None] = print
) -> Iterator[HeldRun]:
    """Register this run on some scenes of some results, after clearing up behind dead ones.

    results: as the configuration names it; gone: machines of which it is known that nothing runs there any more.
    Whoever uses it sets `ended` to "done" after success. Raises UserError where another run of one of the scenes is
    alive, telling whose it is and since when, or where that cannot be known.
    """
    scenes, gone = set(scenes), set(gone)
    with _one_at_a_time(results):
        found = records(results)
        met = [record for record in found if record.meets(scenes)]
        for record in met:
            _refuse(results, record, scenes, gone)
        alive = {scene for record in found if record.state == "alive" for scene in record.scenes}
        for record in met:
            _clear_up(record, alive, tell)
        _refuse_strange_locks(results, scenes)
        run = _register(results, scenes, unclean=any(record.unclean for record in met))
        for record in met:
            _forget(record, scenes)
    try:
        yield run
    except KeyboardInterrupt:
        run.ended = "interrupted"
        raise
    finally:
        _end(run)


def scenes_to_make(results: Path, scenes: Iterable[str]) -> list[str]:
    """Scenes that the run which this process is a part of has left to make; all of them outside of such a run."""
    name = os.environ.get(MARK, "")
    with suppress(OSError, ValueError, AttributeError, TypeError):
        found = json.loads((results / RUNS / f"{name}.json").read_bytes()).get(UNFINISHED)
        if found is not None:
            chosen = set(found)
            return [scene for scene in scenes if scene in chosen]
    return list(scenes)


def _refuse(results: Path, record: Record, scenes: set[str], gone: set[str]) -> None:
    if record.state == "alive":
        which = sorted(record.scenes & scenes)
        named = ", ".join(which[:5]) + (f" and {len(which) - 5} more" if len(which) > 5 else "")
        left = "" if processes.is_alive(record.facts.get("process", "")) else _left_of(record)
        raise UserError(f"{results}: a run of {named} is alive: {record}{left}. Remedy: wait for its end, or end it")
    if record.state == "elsewhere" and record.host not in gone:
        raise UserError(f"{results}: {record.unknown()}")


def _left_of(record: Record) -> str:
    """Processes of a run whose own process is gone, for whoever wants to end them."""
    left = processes.marked(MARK, record.facts.get("id", ""))
    return f"; that process is gone, its Snakemake and jobs go on: {', '.join(map(str, left))}" if left else ""


@contextmanager
def _one_at_a_time(results: Path) -> Iterator[None]:
    """While inside, no other run registers on these results."""
    try:
        (results / RUNS).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(results / RUNS / "register", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o664)
    except OSError as error:
        raise UserError(f"{results}: cannot be written ({error.strerror}), which a run has to") from None
    try:
        until = time.monotonic() + PATIENCE_S
        while not take(descriptor):
            if time.monotonic() > until:
                raise UserError(f"{results}: another run has been starting for {PATIENCE_S:.0f} s. Remedy: end it")
            time.sleep(0.1)
        yield
    finally:
        os.close(descriptor)


def _register(results: Path, scenes: set[str], *, unclean: bool) -> HeldRun:
    name = f"{processes.host()}-{os.getpid()}-{secrets.token_hex(4)}"
    facts = {
        **here(),
        "id": name,
        "process": processes.identity(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "directory": os.getcwd(),
        "results": str(results),
        "scenes": sorted(scenes),
        "unclean": unclean,
    }
    path = results / RUNS / f"{name}.json"
    half = path.with_suffix(".part")
    try:
        descriptor = os.open(half, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o664)
        take(descriptor)
        _write(descriptor, facts)
        os.rename(half, path)
    except OSError as error:
        half.unlink(missing_ok=True)
        raise UserError(f"{path}: cannot be written ({error.strerror}), which a run has to") from None
    return HeldRun(path, descriptor, facts, unclean)


def _write(descriptor: int, facts: dict[str, Any]) -> None:
    data = json.dumps(facts, indent=1, sort_keys=True).encode() + b"\n"
    os.pwrite(descriptor, data, 0)
    os.ftruncate(descriptor, len(data))
    os.fsync(descriptor)


def _end(run: HeldRun) -> None:
    """Take the record away after success; otherwise note that the run ended by itself."""
    with suppress(OSError):  # a full disk must not hide why the run failed
        if run.ended == "done":
            run.path.unlink(missing_ok=True)
        else:
            _write(run.descriptor, {**run.facts, "ended": run.ended})
    os.close(run.descriptor)


def _forget(record: Record, scenes: set[str]) -> None:
    """Take away a record that this run's own replaces; of a killed run, what concerns other scenes is kept."""
    others = record.scenes - scenes
    if not others or not record.unclean:
        record.path.unlink(missing_ok=True)
        return
    half = record.path.with_suffix(".part")
    half.write_text(json.dumps({**record.facts, "scenes": sorted(others)}, indent=1, sort_keys=True) + "\n")
    os.replace(half, record.path)


def _clear_up(record: Record, alive: set[str], tell: Callable[[str], None]) -> None:
    """End the jobs that a run left behind on this machine, and release the locks of its Snakemake.

    alive: scenes of live runs, whose locks stay.
    """
    if not record.facts:
        return
    _end_orphans(record, tell)
    directory, results = Path(record.facts["directory"]), record.facts["results"]
    mine = record.scenes | set(SHARED)
    named = {lock: engine_locks.scenes_named(lock, results) for lock in engine_locks.lock_files(directory)}
    locks = [lock for lock, scenes in named.items() if scenes & mine and not scenes & alive]
    strangers = engine_locks.engines(directory, MARK) if locks else []
    if strangers:
        what = "a Snakemake that ./nishiki did not start is alive there"
        raise UserError(f"{directory}: {what}: process {strangers[0]}. Remedy: wait for its end")
    for lock in locks:
        lock.unlink(missing_ok=True)
    engine_locks.forget_backups(directory, results, record.scenes - alive)
    if record.state != "ended":
        tell(f"resuming after a run that was killed ({record})")


def _end_orphans(record: Record, tell: Callable[[str], None]) -> None:
    orphans = processes.marked(MARK, record.facts["id"])
    if not orphans:
        return
    tell(f"ending {len(orphans)} processes that a dead run left behind ({record})")
    left = processes.stop(lambda: processes.marked(MARK, record.facts["id"]))
    if left:
        raise UserError(f"processes of a dead run do not end: {', '.join(map(str, left))}. Remedy: end them")


def _refuse_strange_locks(results: Path, scenes: set[str]) -> None:
    directory = Path.cwd()
    locks = [
        lock for lock in engine_locks.lock_files(directory) if engine_locks.scenes_named(lock, str(results)) & scenes
    ]
    if not locks:
        return
    strangers = engine_locks.engines(directory, MARK)
    who = f"by process {strangers[0]}" if strangers else "by a Snakemake that ./nishiki did not start"
    remedy = "Remedy: make sure that it has ended, then ./nishiki run --unlock"
    raise UserError(f"{locks[0]}: these scenes are locked {who}. {remedy}")
