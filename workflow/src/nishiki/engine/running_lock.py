"""Register runs on results, so that no two make one scene at a time, and recover after a killed run.

Every run keeps a record in `<results>/.runs/` under an exclusive flock(2), which its Snakemake inherits: the kernel
gives the lock free when both have ended, however they ended. So a record whose lock can be taken, and that was written
on this machine, belongs to a dead run: that is proof, and no clock is asked. The record of another machine proves
nothing here. One lock serves all scenes of a run: a lock a scene would need as many open files.
"""

import fcntl
import getpass
import json
import os
import secrets
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nishiki import processes
from nishiki.errors import UserError

RUNS = ".runs"
MARK = "NISHIKI_RUN"
"""Environment variable that all processes of a run carry."""
UNFINISHED = "unfinished"
"""Entry of a run's record: scenes that its Snakemake makes; all, where the entry is missing."""
PATIENCE_S = 2.0
"""Time that an interrupted run's jobs have to end in order."""
LARGEST = 2**24
"""Bytes of the largest record that is read; the names of a hundred thousand scenes have a tenth of that."""


@dataclass(frozen=True)
class RunRecord:
    """The record of a run, and its state.

    alive; dead: killed, which is certain; ended: by itself, without success; elsewhere: cannot be told from here.
    """

    path: Path
    facts: dict[str, Any]
    state: Literal["alive", "dead", "ended", "elsewhere"]

    @property
    def scenes(self) -> set[str]:
        """Scenes that it makes."""
        return set(self.facts.get("scenes", ()))

    @property
    def host(self) -> str:
        """Machine that it was started on; empty where the record cannot be read."""
        return str(self.facts.get("host", ""))

    @property
    def unclean(self) -> bool:
        """Return whether files may be torn: it was killed, or ended while clearing up after one that was."""
        return self.state != "ended" or bool(self.facts.get("unclean"))

    def __str__(self) -> str:
        facts = {"process": "?", "host": "?", "user": "?", "started": "?", **self.facts}
        pid = str(facts["process"]).split("-")[0]
        return f"process {pid} on {facts['host']}, user {facts['user']}, since {facts['started']}"

    def meets(self, scenes: set[str]) -> bool:
        """Return whether it makes any of these scenes; one whose record cannot be read may make all."""
        return not self.facts or bool(self.scenes & scenes)

    def describe_unknown(self) -> str:
        """Describe a run whose state this machine cannot determine, and the remedy."""
        if not self.facts:
            return f"an unreadable record of a run. Remedy: make sure that no run is alive, then delete {self.path}"
        who = f"user {self.facts.get('user')} on {self.host}" if self.host == processes.host() else f"on {self.host}"
        return (
            f"a run did not finish, and this machine cannot check whether it is alive: {self}. Remedy: run again as "
            f"{who}; or, if none of its processes can be alive, ./nishiki run --host-is-gone {self.host}"
        )


def records(results: Path) -> list[RunRecord]:
    """List the runs registered on some results, with their state; changes nothing."""
    examined = (_examine(path) for path in sorted((results / RUNS).glob("*.json")))
    return [record for record in examined if record is not None]


def refuse_while_running(results: Path, what: str) -> None:
    """Raise a UserError where a run is alive on these results, or may be; `what`: the action that is refused."""
    for record in records(results):
        if record.state == "alive":
            raise UserError(f"{results}: {what}: a run is alive: {record}. Remedy: wait for its end")
        if record.state == "elsewhere":
            raise UserError(f"{results}: {what}: {record.describe_unknown()}")


def scenes_to_make(results: Path, scenes: Iterable[str]) -> list[str]:
    """Return the scenes that the run of this process has left to make; all of them outside of a run."""
    with suppress(OSError, ValueError, AttributeError, TypeError):
        unfinished = json.loads((results / RUNS / f"{os.environ.get(MARK, '')}.json").read_bytes()).get(UNFINISHED)
        if unfinished is not None:
            chosen = set(unfinished)
            return [scene for scene in scenes if scene in chosen]
    return list(scenes)


@dataclass
class HeldRun:
    """This run while it is registered. unclean: a run of these scenes was killed before it."""

    path: Path
    descriptor: int
    facts: dict[str, Any]
    unclean: bool
    ended: str = "failed"

    def record_unfinished(self, unfinished: Iterable[str]) -> None:
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
            child.send_signal(passed_on)
            raise KeyboardInterrupt

        before = signal.signal(signal.SIGTERM, stop) if ours else None
        interrupts = 0
        try:
            while True:
                try:
                    if interrupts:
                        self._end_jobs(child, everything=interrupts > 1)
                    return child.wait()
                except KeyboardInterrupt:
                    self.ended = "interrupted"
                    interrupts += 1
        finally:
            if ours:
                signal.signal(signal.SIGTERM, before)

    def _end_jobs(self, child: subprocess.Popen[bytes], *, everything: bool) -> None:
        """End the jobs of this machine that an interrupt has not ended in PATIENCE_S; everything: Snakemake too, now.

        A job that compiles or is inside a kernel heeds no interrupt before it returns, and one that reaches Python
        inside a finaliser is lost. A cluster's jobs are left to Snakemake, which cancels them.
        """
        with suppress(subprocess.TimeoutExpired):
            child.wait(0 if everything else PATIENCE_S)
            return
        self.facts["unclean"] = True

        def list_remaining() -> list[int]:
            child.poll()  # what has ended is no process any more
            pids = processes.find_marked(MARK, self.facts["id"])
            return pids if everything else [pid for pid in pids if processes.runs(pid, "stage.py")]

        processes.stop(list_remaining, patience_s=1.0)


@contextmanager
def register_run(
    results: Path, scenes: Iterable[str], *, gone: Iterable[str] = (), tell: Callable[[str], None] = print
) -> Iterator[HeldRun]:
    """Register this run on some scenes of some results, after clearing up after dead ones.

    results: as the configuration names it; gone: machines of which it is known that nothing runs there any more.
    Whoever uses it sets `ended` to "done" after success. Raises UserError where another run of one of the scenes is
    alive, telling whose it is and since when, or where that cannot be known.
    """
    scenes, gone = set(scenes), set(gone)
    with _one_at_a_time(results):
        every = records(results)
        met = [record for record in every if record.meets(scenes)]
        for record in met:
            _refuse(results, record, scenes, gone)
        alive = {scene for record in every if record.state == "alive" for scene in record.scenes}
        for record in met:
            _clear_up(record, alive, tell)
        run = _register(results, scenes, unclean=any(record.unclean for record in met))
        for record in met:  # this run's own replaces them; of a killed run, what concerns other scenes is kept
            others = record.scenes - scenes
            if not others or not record.unclean:
                record.path.unlink(missing_ok=True)
                continue
            half = record.path.with_suffix(".part")
            half.write_text(json.dumps({**record.facts, "scenes": sorted(others)}, indent=1, sort_keys=True) + "\n")
            os.replace(half, record.path)
    try:
        yield run
    except KeyboardInterrupt:
        run.ended = "interrupted"
        raise
    finally:
        with suppress(OSError):  # a full disk must not hide why the run failed
            if run.ended == "done":
                run.path.unlink(missing_ok=True)
            else:  # the record tells that the run ended by itself
                _write(run.descriptor, {**run.facts, "ended": run.ended})
        os.close(run.descriptor)


@contextmanager
def _one_at_a_time(results: Path) -> Iterator[None]:
    """Hold other runs back from registering on these results until this one has."""
    try:
        (results / RUNS).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(results / RUNS / "register", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o664)
    except OSError as error:
        raise UserError(f"{results}: cannot be written ({error.strerror}), but a run must write there") from None
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _refuse(results: Path, record: RunRecord, scenes: set[str], gone: set[str]) -> None:
    if record.state == "alive":
        which = sorted(record.scenes & scenes)
        named = ", ".join(which[:5]) + (f" and {len(which) - 5} more" if len(which) > 5 else "")
        left = ""
        if not processes.is_alive(record.facts.get("process", "")):
            pids = ", ".join(map(str, processes.find_marked(MARK, record.facts.get("id", ""))))
            left = f"; that process has ended, its Snakemake and jobs continue: {pids}"
        raise UserError(f"{results}: a run of {named} is alive: {record}{left}. Remedy: wait for its end, or end it")
    if record.state == "elsewhere" and record.host not in gone:
        raise UserError(f"{results}: {record.describe_unknown()}")


def _clear_up(record: RunRecord, alive: set[str], tell: Callable[[str], None]) -> None:
    """End the jobs that a run left on this machine, and remove what Snakemake had put by of its manifests.

    Snakemake puts manifests by to restore them where a job fails; after a kill they would come back when a job of a
    later run fails. alive: scenes of live runs, whose files stay.
    """
    if not record.facts:
        return
    orphans = processes.find_marked(MARK, record.facts["id"])
    if orphans:
        tell(f"ending {len(orphans)} processes left by a run that was killed ({record})")
        left = processes.stop(lambda: processes.find_marked(MARK, record.facts["id"]))
        if left:
            raise UserError(f"processes left by a killed run do not end: {', '.join(map(str, left))}. Remedy: end them")
    backups = Path(record.facts["directory"], ".snakemake/backups", record.facts["results"].lstrip("/"))
    for scene in record.scenes - alive if backups.is_dir() else ():
        shutil.rmtree(backups / scene, ignore_errors=True)
    if record.state != "ended":
        tell(f"resuming after a run that was killed ({record})")


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
        _is_free(descriptor, fcntl.LOCK_EX)
        _write(descriptor, facts)
        os.rename(half, path)
    except OSError as error:
        half.unlink(missing_ok=True)
        raise UserError(f"{path}: cannot be written ({error.strerror}), but a run must write there") from None
    return HeldRun(path, descriptor, facts, unclean)


def _write(descriptor: int, facts: dict[str, Any]) -> None:
    data = json.dumps(facts, indent=1, sort_keys=True).encode() + b"\n"
    os.pwrite(descriptor, data, 0)
    os.ftruncate(descriptor, len(data))
    os.fsync(descriptor)


def _is_free(descriptor: int, kind: int) -> bool:
    """Take the lock of an open file without waiting; False where another process has it.

    True as well on a file system that has no locks: there the process numbers in the records decide.
    """
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def _examine(path: Path) -> RunRecord | None:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    except OSError:
        return RunRecord(path, {}, "elsewhere")
    try:
        facts = _parse(os.pread(descriptor, LARGEST, 0))
        # Shared: two that look at the same time do not take each other for the run.
        return RunRecord(path, facts, _state(facts) if _is_free(descriptor, fcntl.LOCK_SH) else "alive")
    finally:
        os.close(descriptor)


def _parse(data: bytes) -> dict[str, Any]:
    with suppress(ValueError, RecursionError):
        facts = json.loads(data)
        texts = ("id", "host", "process", "directory", "results")
        if isinstance(facts, dict) and all(isinstance(facts.get(name), str) for name in texts):
            scenes = facts.get("scenes")
            if isinstance(scenes, list) and all(isinstance(name, str) for name in scenes):
                return facts
    return {}


def _state(facts: dict[str, Any]) -> Literal["alive", "dead", "ended", "elsewhere"]:
    """Return the state of a run whose lock is free."""
    if not facts:
        return "elsewhere"
    if facts.get("ended"):
        return "ended"
    now = here()
    if facts.get("boot") == now["boot"] and now["boot"]:
        # Its processes are seen, and can be ended, from the same container and by the same user or root.
        ours = facts.get("user") == now["user"] or os.geteuid() == 0
        if facts.get("namespace") != now["namespace"] or not ours:
            return "elsewhere"
        return "alive" if processes.is_alive(facts["process"]) else "dead"
    same_machine = now["machine"] and all(facts.get(name) == now[name] for name in ("host", "machine"))
    return "dead" if same_machine else "elsewhere"


def here() -> dict[str, str]:
    """Identify this machine, its start, its container and its user."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid())
    return {
        "host": processes.host(),
        "machine": processes.machine(),
        "boot": processes.boot(),
        "namespace": processes.namespace(),
        "user": user,
    }
