"""Repeat: run a stage once more on the same inputs, into a folder that is thrown away, and record what it took.

Everything after -- are the arguments of scripts/stage.py, without the stage's name and --output.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import _project
from nishiki.artifacts.artifact import MANIFEST, Artifact, open_artifact
from nishiki.formats.files import put_file
from nishiki.sweep.variants import processor
from nishiki.threads import ALONE, VARIABLES

RECORDED = ("seconds", "cpu_seconds", "peak_memory_mib", "host", "platform", "python", "cpus", "finished")


def main() -> None:
    """Repeat a stage and write one small JSON file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=Path, required=True, help="artifact.json of the first run")
    parser.add_argument("--threads", type=int, required=True, help="threads that the stage may use")
    parser.add_argument("--output", type=Path, required=True, help="JSON file to make")
    parser.add_argument("rest", nargs="+", metavar="ARGUMENT", help="arguments of the stage's script")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    first = open_artifact(arguments.first)
    for left in arguments.output.parent.glob(f".{arguments.output.stem}.*.repeat"):  # by a run that was killed
        shutil.rmtree(left, ignore_errors=True)
    folder = arguments.output.parent / f".{arguments.output.stem}.{os.getpid()}.repeat"
    try:
        status, record = repeat(first, folder, arguments.rest, arguments.threads)
        if status:
            raise SystemExit(status)
        put_file(arguments.output, json.dumps(record, indent=1, sort_keys=True) + "\n")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def repeat(first: Artifact, folder: Path, rest: list[str], threads: int) -> tuple[int, dict]:
    """Exit status of scripts/stage.py, and what its run took; whether its artifact has the bytes of the first."""
    load = os.getloadavg()[0]
    target = folder / first.key / MANIFEST
    script = _project.PROJECT / "scripts" / "stage.py"
    done = subprocess.run(
        [sys.executable, str(script), first.stage, *rest, "--output", str(target)],
        env={**os.environ, **dict.fromkeys(VARIABLES, str(threads)), **ALONE},
        check=False,
    )
    if done.returncode:
        return done.returncode, {}
    again = open_artifact(target)
    different = differing(first, again)
    return 0, {
        "scene": first.manifest["scene"],
        "stage": first.stage,
        "key": first.key,
        "digest": again.digest,
        "same": not different,
        "different": different,
        "bytes": sum(entry["bytes"] for entry in again.manifest["files"].values()),
        "files": len(again.manifest["files"]),
        "threads": threads,
        "load_before": round(load, 2),
        "processor": processor(),
        **{name: again.run[name] for name in RECORDED},
    }


def differing(first: Artifact, again: Artifact) -> list[str]:
    """List the differences between two artifacts of one key: names of files, or of parts of the manifest."""
    if first.digest == again.digest:
        return []
    a, b = first.manifest["files"], again.manifest["files"]
    files = [name for name in sorted({*a, *b}) if a.get(name) != b.get(name)]
    parts = [name for name in sorted({*first.manifest, *again.manifest} - {"files"})]
    return files + [f"{name} (manifest)" for name in parts if first.manifest.get(name) != again.manifest.get(name)]


if __name__ == "__main__":
    main()
