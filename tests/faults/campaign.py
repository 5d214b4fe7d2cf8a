"""Faults of every kind against small scenes: is each noticed, is each recovered from, is anything lost or wrong?

    python tests/faults/campaign.py --seed 1 --kills 100

One JSON object a kind of fault, and a last line with their sums: {tried, detected, recovered, lost, wrong}. Detected: a
command names the damage, or the folder of what was unfinished is not there. Recovered: the next run ends with the bytes
of an undisturbed one. Lost: a finished artifact that was sound is gone. Wrong: other bytes presented as finished.
Exit status 0 where all were detected and recovered and nothing was lost or wrong.
"""

import argparse
import json
import random
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "workflow/src"))

from arena import PRESETS, Arena, make_arena
from deaths import KINDS as DEATHS
from disks import KINDS as DISKS
from files import KINDS as FILES

KINDS = {**DEATHS, **FILES, **DISKS}
"""Each kind is a generator: (arena, random numbers, amount) -> one Outcome a fault."""


@dataclass
class Tally:
    """Counts over the faults of one kind."""

    tried: int = 0
    detected: int = 0
    recovered: int = 0
    lost: int = 0
    wrong: int = 0

    def add(self, other) -> None:
        """Count an outcome or another tally."""
        for name in asdict(self):
            setattr(self, name, getattr(self, name) + int(getattr(other, name)))

    @property
    def passed(self) -> bool:
        """Nothing missed, nothing lost, nothing wrong."""
        return self.tried == self.detected == self.recovered and not self.lost and not self.wrong


def campaign(arena: Arena, kinds: list[str], *, seed: int, kills: int, amount: int) -> Tally:
    """Run the kinds of faults; print one line each and the sum. Faults that a machine does not allow are told."""
    whole = Tally()
    for kind in kinds:
        arena.restore()
        tally, stages, start = Tally(), {}, time.monotonic()
        numbers = random.Random(f"{seed} {kind}")
        try:
            for outcome in KINDS[kind](arena, numbers, kills if kind == "killed run" else amount):
                tally.add(outcome)
                stages[outcome.where] = stages.get(outcome.where, 0) + 1
                if not (outcome.detected and outcome.recovered) or outcome.lost or outcome.wrong:
                    print(json.dumps({"kind": kind, **asdict(outcome)}), file=sys.stderr, flush=True)
        except PermissionError as error:
            print(json.dumps({"kind": kind, "skipped": str(error)}), flush=True)
            continue
        whole.add(tally)
        seconds = round(time.monotonic() - start, 1)
        print(json.dumps({"kind": kind, **asdict(tally), "seconds": seconds, "where": stages}), flush=True)
    print(json.dumps(asdict(whole)), flush=True)
    return whole


def main() -> None:
    """Arguments in, JSON lines out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of all random choices (default 0)")
    parser.add_argument("--kills", type=int, default=100, help="runs killed at random moments (default 100)")
    parser.add_argument("--amount", type=int, default=3, help="faults of every other kind, a stage (default 3)")
    parser.add_argument("--scenes", nargs="+", choices=list(PRESETS), default=list(PRESETS), help="(default: all)")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="(default: all)")
    parser.add_argument("--folder", type=Path, help="keep the scenes here, for a next time (default: temporary)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        arena = make_arena(options.folder or Path(temporary), tuple(options.scenes))
        tally = campaign(arena, options.kinds, seed=options.seed, kills=options.kills, amount=options.amount)
    raise SystemExit(0 if tally.passed else 1)


if __name__ == "__main__":
    main()
