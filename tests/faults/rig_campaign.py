"""Capture runs that are killed, unplugged and out of disk at random places; each must end as an undisturbed one.

Every run is a process of its own. A fault strikes at a certain step: when a file is opened, renamed or removed in the
folder of the captures, or before a device does something. One JSON object a line: each trial, last the sums.

    python tests/faults/rig_campaign.py --seed 1 --trials 60
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import random
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "workflow/src"))
from captures import RING, make_capture
from rig_devices import Bench, write_plan

import nishiki.observations.check  # noqa: F401  once, before processes are forked
from nishiki.capture.seal import payload_digests, verify_seal
from nishiki.errors import UserError
from nishiki.rig.device import DeviceLost
from nishiki.rig.records import Journal
from nishiki.rig.run import RECONNECTIONS, run_capture

KINDS = ("kill", "full disk", "unplugged")
STOPPED = 3
"""Exit status of a run that stopped with a message."""
WRITING = os.O_WRONLY | os.O_RDWR


class Steps:
    """Counts the steps of a process and calls `strike` from one of them on.

    Parameters
    ----------
    folder : Path
        Files below it count.
    kind : str
        A full disk counts steps that write, an unplugged cable those of devices, a kill all.
    at, length : int
        Number of the first step that is struck, from 1, and how many are; 0: none.
    strike : callable
        What happens then.
    """

    def __init__(self, folder: Path, kind: str, at: int, length: int, strike: Callable[[], None]) -> None:
        self.folder, self.kind, self.at, self.length, self.strike = str(folder), kind, at, length, strike
        self.count = 0

    def step(self, *what: str) -> None:
        """One more step, of the sorts given: write, read, device."""
        counted = {"full disk": "write", "unplugged": "device"}.get(self.kind, what[0])
        if counted in what:
            self.count += 1
            if self.at <= self.count < self.at + self.length:
                self.strike()

    def audit(self, event: str, arguments: tuple) -> None:
        """A hook for `sys.addaudithook`."""
        if event in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.copyfile"):
            if any(isinstance(a, str | os.PathLike) and str(a).startswith(self.folder) for a in arguments):
                opens = event == "open" and isinstance(arguments[2], int)
                writes = arguments[2] & WRITING if opens else event in ("os.rename", "os.mkdir", "shutil.copyfile")
                self.step("write" if writes else "read")


def run_once(folder: Path, plan: Path, hand: Path, kind: str, at: int, length: int) -> tuple[int, int]:
    """One run in a process of its own. Returns its exit status (negative: the signal) and the number of its steps."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        try:
            status = _run(folder, plan, hand, kind, at, length, writing)
        except BaseException:
            sys.excepthook(*sys.exc_info())
            status = 1
        os._exit(status)
    os.close(writing)
    _, waited = os.waitpid(process, 0)
    with os.fdopen(reading) as pipe:
        counted = pipe.read()
    return os.waitstatus_to_exitcode(waited), int(counted or 0)


def _run(folder: Path, plan: Path, hand: Path, kind: str, at: int, length: int, pipe: int) -> int:
    def strike() -> None:
        if kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "full disk":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        raise DeviceLost("unplugged")

    steps = Steps(folder, kind, at, length, strike)

    def disturb(device: str) -> None:
        steps.step(*(("device", "write") if device == "photograph" else ("device",)))

    bench = Bench(hand, disturb)
    expose = bench.see

    def see_and_count() -> Path:
        with (folder.parent / "exposures").open("a") as log:
            log.write("x")
        return expose()

    bench.see = see_and_count
    sys.addaudithook(steps.audit)
    status = 0
    try:
        run_capture(
            Path("rig.yaml"),
            plan,
            folder / "capture",
            open_devices=bench.open,
            ask=bench.ask,
            pause=lambda seconds: None,
        )
    except (UserError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.ENOSPC:
            raise
        status = STOPPED
    os.write(pipe, str(steps.count).encode())
    return status


def content(capture: Path) -> dict[str, str]:
    """Digest of every file of a finished capture, by its name."""
    return payload_digests(capture / "data")


def trial(arena: Path, numbers: random.Random, number: int, plan: Path, hand: Path, lengths: dict[str, int]) -> dict:
    """One to three faults of a kind, then a run to the end. Returns what was tried and what is wrong, if anything."""
    kind = KINDS[number % len(KINDS)]
    folder = arena / f"trial{number}" / "captures"
    folder.mkdir(parents=True)
    faults, statuses = numbers.randint(1, 3), []
    for _ in range(faults):
        at = numbers.randint(1, lengths[kind])
        length = numbers.randint(1, 2 * RECONNECTIONS) if kind == "unplugged" else lengths[kind]
        status, _ = run_once(folder, plan, hand, kind, at, length)
        statuses.append(status)
        if status == 0:
            break
    wrong = [f"status {status}" for status in statuses if status not in (0, STOPPED, -signal.SIGKILL)]
    if status != 0 and run_once(folder, plan, hand, "none", 0, 0)[0] != 0:
        wrong.append("did not go on")
    capture = folder / "capture"
    if not wrong:
        wrong += [str(problem) for problem in verify_seal(capture)]
        reference = content(arena / "reference/captures/capture")
        wrong += [] if content(capture) == reference else ["other bytes than the undisturbed run"]
        frames = sum(name.endswith(".png") for name in reference)
        exposures = len((folder.parent / "exposures").read_text())
        interruptions = sum(status != 0 for status in statuses)
        lost = Counter(event["event"] for event in Journal(folder / "capture.rig/journal.jsonl").events())["lost"]
        if not frames <= exposures <= frames + interruptions + lost:
            wrong.append(f"{exposures} exposures for {frames} frames")
        left = {path.name for path in folder.iterdir()} | {p.name for p in (folder / "capture.rig").iterdir()}
        if left - {"capture", "capture.rig", "journal.jsonl", "frames.tsv", "lock"}:
            wrong.append(f"left behind: {sorted(left)}")
    return {"trial": number, "kind": kind, "statuses": statuses, "wrong": wrong}


def main() -> None:
    """Run the campaign; exit status 1 where anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trials", type=int, default=60)
    options = parser.parse_args()
    numbers = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        arena = Path(name).resolve()
        hand = make_capture(arena / "hand", lights=RING[:4])
        plan = write_plan(arena, hand)
        lengths = {}
        for kind in KINDS:
            folder = arena / ("reference" if kind == KINDS[0] else f"counted {kind}") / "captures"
            folder.mkdir(parents=True)
            status, lengths[kind] = run_once(folder, plan, hand, kind, 0, 0)
            if status or lengths[kind] < 20:
                raise SystemExit(f"the undisturbed run failed: status {status}, {lengths[kind]} steps")
        sums: Counter[str] = Counter()
        for number in range(options.trials):
            line = trial(arena, numbers, number, plan, hand, lengths)
            struck = sum(status != 0 for status in line["statuses"])
            sums.update(trials=1, interruptions=struck, wrong=bool(line["wrong"]))
            sums[line["kind"]] += 1
            print(json.dumps(line), flush=True)
        print(json.dumps(dict(sums)))
    raise SystemExit(1 if sums["wrong"] else 0)


if __name__ == "__main__":
    main()
