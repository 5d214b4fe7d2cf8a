"""Seeded mutations of the readers' files, without instrumentation:  python tests/fuzz/short.py SEED TARGET=COUNT ...

One line of JSON a target; a misbehaviour ends its target and is told there with its input. Exit status 0 in any case.
"""

import json
import sys
import traceback
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(PROJECT / "workflow" / "src"), str(PROJECT / "tests")]

from fuzz.watch import lower_bounds, watched  # noqa: E402


def main(seed: int, wanted: dict[str, int]) -> None:
    """Fuzz each target so many times."""
    lower_bounds()
    from fuzz.corpus import corpus
    from fuzz.mutate import mutations
    from fuzz.targets import TARGETS

    for target, count in wanted.items():
        seeds = corpus(target)
        told = {"target": target, "seeds": len(seeds), "read": 0, "refused": 0, "misbehaviour": None}
        for number, data in enumerate(mutations(seeds, count, seed=seed)):
            try:
                told[watched(TARGETS[target], data)] += 1
            except BaseException:
                told["misbehaviour"] = (
                    f"{number}: {traceback.format_exc()[-1500:]} from {data[:400]!r} ({len(data)} bytes)"
                )
                break
        print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), {name: int(count) for name, count in (word.split("=") for word in sys.argv[2:])})
