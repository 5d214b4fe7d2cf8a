"""Which runs are alive on some results: every run keeps a record in `<results>/.runs/`.

The record lies under an exclusive flock(2), which the run's Snakemake inherits: the kernel gives the lock free when
both have ended, however they ended. So a record whose lock can be taken, and that was written on this machine, belongs
to a dead run: that is proof, and no clock is asked. The record of another machine proves nothing here.
"""

import fcntl
import getpass
import json
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from nishiki import processes
from nishiki.errors import UserError

RUNS = ".runs"
LARGEST = 2**24
"""Bytes of the largest record that is read; the names of a hundred thousand scenes have a tenth of that."""


@dataclass(frozen=True)
class Record:
    """A run as it registered itself, and what has become of it.

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
        """Whether files may be torn: it was killed, or ended while clearing up behind one that was."""
        return self.state != "ended" or bool(self.facts.get("unclean"))

    def __str__(self) -> str:
        facts = {"process": "?", "host": "?", "user": "?", "started": "?", **self.facts}
        pid = str(facts["process"]).split("-")[0]
        return f"process {pid} on {facts['host']}, user {facts['user']}, since {facts['started']}"

    def meets(self, scenes: set[str]) -> bool:
        """Whether it makes any of these scenes; one whose record cannot be read may make all."""
        return not self.facts or bool(self.scenes & scenes)

    def unknown(self) -> str:
        """What to tell of a run that this machine knows nothing certain about, and the remedy."""
        if not self.facts:
            return f"an unreadable record of a run. Remedy: make sure that no run is alive, then delete {self.path}"
        who = f"user {self.facts.get('user')} on {self.host}" if self.host == processes.host() else f"on {self.host}"
        return (
            f"a run did not end, and whether it is alive cannot be told from here: {self}. Remedy: run again as {who}; "
            f"or, where nothing of it can be alive, ./nishiki run --host-is-gone {self.host}"
        )


def records(results: Path) -> list[Record]:
    """Runs registered on some results, with what has become of them; changes nothing."""
    found = (_examined(path) for path in sorted((results / RUNS).glob("*.json")))
    return [record for record in found if record is not None]


def refuse_while_running(results: Path, what: str) -> None:
    """UserError where a run is alive on these results, or may be; `what`: what is not done then."""
    for record in records(results):
        if record.state == "alive":
            raise UserError(f"{results}: {what}: a run is alive: {record}. Remedy: wait for its end")
        if record.state == "elsewhere":
            raise UserError(f"{results}: {what}: {record.unknown()}")


def take(descriptor: int, kind: int = fcntl.LOCK_EX) -> bool:
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


def _examined(path: Path) -> Record | None:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    except OSError:
        return Record(path, {}, "elsewhere")
    try:
        facts = _parsed(os.pread(descriptor, LARGEST, 0))
        # Shared: two that look at the same time do not take each other for the run.
        return Record(path, facts, _state(facts) if take(descriptor, fcntl.LOCK_SH) else "alive")
    finally:
        os.close(descriptor)


def _parsed(data: bytes) -> dict[str, Any]:
    with suppress(ValueError, RecursionError):
        facts = json.loads(data)
        texts = ("id", "host", "process", "directory", "results")
        if isinstance(facts, dict) and all(isinstance(facts.get(name), str) for name in texts):
            scenes = facts.get("scenes")
            if isinstance(scenes, list) and all(isinstance(name, str) for name in scenes):
                return facts
    return {}


def _state(facts: dict[str, Any]) -> Literal["alive", "dead", "ended", "elsewhere"]:
    """What has become of a run whose lock is free."""
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
    """What tells this machine, this start of it, this container and this user from others."""
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
