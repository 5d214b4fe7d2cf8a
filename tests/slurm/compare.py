"""Three chains and a mosaic on this machine and through a real Slurm on it: the jobs that Slurm ran, and digests.

    python tests/slurm/compare.py                  print; exit status 0 where all artifacts have the same bytes
    python tests/slurm/compare.py --page           write docs/notes/slurm-run.md too

Needs root and Debian's packages, which `start.sh` installs; a few minutes.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(PROJECT / part) for part in ("", "workflow/src", "tests/faults", "tests/slurm")]

from arena import PRESETS, Arena, environment, make_arena  # noqa: E402
from cluster import QUICK, Unavailable, cluster, install_plugin  # noqa: E402

from nishiki.artifacts.artifact import MANIFEST  # noqa: E402
from nishiki.artifacts.provenance import file_digest  # noqa: E402

PAGE = PROJECT / "docs/notes/slurm-run.md"
SUBMITTED = re.compile(r"(?:Group )?[Jj]ob \S+ has been submitted with SLURM jobid (\d+)")


def through_slurm(arena: Arena, folder: Path) -> tuple[str, str]:
    """Run the scenes through a Slurm of its own; Snakemake's log file with what the run told last, and Slurm's list of
    finished jobs."""
    with cluster(folder / "slurm"):
        plugin = install_plugin(folder / "plugin")
        told = environment()
        told["PYTHONPATH"] += f"{os.pathsep}{plugin}"
        command = arena.command("run", "--profile", "slurm", *QUICK, "--configfile", "config.yaml")
        done = subprocess.run(
            command,
            cwd=arena.folder,
            env=told,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode:
            raise SystemExit(done.stdout)
        log = max((arena.folder / ".snakemake/log").glob("*.log")).read_text()
        return log + done.stdout, (folder / "slurm/log/jobs").read_text()


def digests(arena: Arena, root: Path) -> dict[tuple[str, str, str], str]:
    """Digest of the manifest of every artifact, which holds the digests of all its files, by scene, stage and key."""
    found = {}
    for path in arena.artifacts(root):
        scene, stage, key = path.relative_to(root).parts
        found[scene, stage, key] = file_digest(path / MANIFEST)
    return found


def page(log: str, jobs: str, local: dict, other: dict) -> str:
    """Everything for reading, as Markdown."""
    numbers = sorted({int(number) for number in SUBMITTED.findall(log)})
    equal = sum(other.get(name) == digest for name, digest in local.items())
    rows = [dict(re.findall(r"(\w+)=(\S*)", line)) for line in jobs.splitlines()]
    lines = [
        "# A run through Slurm, and the same run without it",
        "",
        "Written by `python tests/slurm/compare.py --page`: small simulated scenes of the three chains and a mosaic,",
        "first on one machine by itself, then through a Slurm of two nodes that `tests/slurm/start.sh` started there.",
        "",
        f"**{equal} of {len(local)} artifacts have the same bytes**; through Slurm they came in {len(numbers)} jobs.",
        "Digests are those of the manifests, which list every file with its own digest.",
        "",
        "| scene | stage | key | on one machine | through Slurm | |",
        "|---|---|---|---|---|---|",
    ]
    for (scene, stage, key), digest in local.items():
        theirs = other.get((scene, stage, key), "missing")
        same = "same" if theirs == digest else "**other**"
        lines.append(f"| {scene} | {stage} | `{key}` | `{digest[:16]}` | `{theirs[:16]}` | {same} |")
    lines += [
        "",
        "## What Slurm says of its jobs",
        "",
        "Its log of finished jobs (`jobcomp/filetxt`). A small scene is one job: short stages share one.",
        "",
        "| job | state | node | asked for | start | end | time limit, min |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: int(row["JobId"])):
        wanted = [row[name] for name in ("JobId", "JobState", "NodeList", "Tres", "StartTime", "EndTime", "TimeLimit")]
        lines.append("| " + " | ".join(wanted) + " |")
    lines += ["", "## What the run printed", "", "```", *shortened(log), "```", ""]
    return "\n".join(lines)


def shortened(log: str) -> list[str]:
    """Lines of the run that speak of jobs, without paths of this machine."""
    kept = [
        line for line in log.splitlines() if re.search(r"submitted with|steps \(|Finished job|^\w+: .*report", line)
    ]
    return [re.sub(r" \(log: .*\)|/\S*/(?=results)", "", line) for line in kept]


def main() -> None:
    """Arguments in, page out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="write docs/notes/slurm-run.md")
    parser.add_argument("--folder", type=Path, help="keep scenes, results and logs here (default: temporary)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        arena = make_arena(folder / "arena", (*PRESETS, "mosaic"))
        shutil.rmtree(arena.results, ignore_errors=True)
        try:
            log, jobs = through_slurm(arena, folder)
        except Unavailable as error:
            raise SystemExit(str(error)) from None
        local, other = digests(arena, arena.kept), digests(arena, arena.results)
        text = page(log, jobs, local, other)
    print(text)
    print(json.dumps({"artifacts": len(local), "equal": sum(other.get(k) == v for k, v in local.items())}))
    if options.page:
        PAGE.write_text(text)
    raise SystemExit(0 if local == other else 1)


if __name__ == "__main__":
    main()
