"""Fuzz one reader, guided by coverage:  python tests/fuzz/run.py TARGET [--minutes 10] [--corpus FOLDER]

Needs the package atheris (not in the project's environment: it serves nothing else). The reader's misbehaviour ends the
program, and the input that caused it is kept beside the corpus as crash-*. The last line is a JSON summary.
"""

import argparse
import hashlib
import json
import sys
import time
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(PROJECT / "workflow" / "src"), str(PROJECT / "tests")]

import atheris  # noqa: E402

READERS = """
    nishiki.capture nishiki.formats nishiki.engine.project nishiki.artifacts.declaration nishiki.artifacts.artifact
    nishiki.geometry.mesh nishiki.polarisation.polariser_states
    trimesh.exchange.ply trimesh.exchange.obj
""".split()

with atheris.instrument_imports(include=READERS):
    from fuzz.corpus import corpus
    from fuzz.targets import TARGETS, TOKENS
    from fuzz.watch import lower_bounds, watched

counts = {"read": 0, "refused": 0}
started = time.monotonic()


def main() -> None:
    """Parse, make the corpus, hand over to libFuzzer, which does not come back."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--corpus", type=Path, default=Path("fuzz-corpus"), help="folder that keeps what was found")
    options = parser.parse_args()
    lower_bounds()
    folder = options.corpus / options.target
    folder.mkdir(parents=True, exist_ok=True)
    for seed in corpus(options.target):
        (folder / hashlib.sha256(seed).hexdigest()[:16]).write_bytes(seed)
    words = options.corpus / f"{options.target}.dict"
    quoted = ("".join(rf"\x{byte:02x}" for byte in token) for token in TOKENS)
    words.write_text("".join(f'"{token}"\n' for token in quoted))
    reader = TARGETS[options.target]
    for seed in corpus(options.target):  # first use imports and compiles
        try:
            watched(reader, seed)
        except Exception as error:
            print(f"warming up: {error!r}", file=sys.stderr)
    end = time.monotonic() + 60 * options.minutes

    def one(data: bytes) -> None:
        if time.monotonic() > end:
            finish(options.target)
        counts[watched(reader, data)] += 1

    flags = ["-rss_limit_mb=3000", "-timeout=30", "-max_len=65536", "-print_final_stats=0", f"-dict={words}"]
    atheris.Setup([sys.argv[0], *flags, f"-artifact_prefix={folder.parent}/{options.target}-", str(folder)], one)
    atheris.Fuzz()


def finish(target: str) -> None:
    """The summary, and the end of the program."""
    minutes = round((time.monotonic() - started) / 60, 2)
    print(json.dumps({"target": target, "executions": sum(counts.values()), **counts, "minutes": minutes}), flush=True)
    import os

    os._exit(0)


if __name__ == "__main__":
    main()
