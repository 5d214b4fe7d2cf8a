"""What the workflow costs beside computing: seconds until "nothing to be done", for one scene and for many.

    python benchmarks/overhead.py --data simulated
    python benchmarks/overhead.py --data captures/painting --scenes 1 100 1000
    python benchmarks/overhead.py --data captures/painting --scenes 1000 --own-captures
    python benchmarks/overhead.py --data captures/painting --scenes --campaign 4

One scene is simulated (or the capture given is used) and run; then the same results, with Snakemake's records of them,
are laid out under as many scene names as asked for, and a run with nothing changed is timed: with one capture for all
scenes, or, --own-captures, with a capture of hard links for each. peak_mib: of the timed run. A campaign runs that many
scenes from nothing, on one processor and on two, and tells which share of the processor time the stages computed,
which share they loaded libraries, and which share the workflow took.
"""

import argparse
import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
SETTINGS = "scenes: scenes.tsv\nrender:\n  pictures: [{name: daylight}]\n  sequences: []\n"


def nishiki(folder: Path, *arguments: str) -> tuple[float, float, int, str]:
    """Wall and processor seconds and peak memory (MiB, of its largest process) of one call of the command line, and
    what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "workflow/src")}
    with tempfile.TemporaryFile("w+") as text:
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "nishiki", *arguments], cwd=folder, env=environment, stdout=text, stderr=text
        )
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        text.seek(0)
        printed = text.read()
    if process.returncode:
        raise SystemExit(printed)
    return wall, usage.ru_utime + usage.ru_stime, round(usage.ru_maxrss / 1024), printed


def table(folder: Path, names: list[str], capture: str, *, own: bool = False) -> None:
    """Write the scene table; own: a capture of hard links for each scene but the first."""
    captures = [capture] * len(names)
    for number, name in enumerate(names[1:] if own else (), start=1):
        captures[number] = f"captures/{name}"
        if not (folder / captures[number]).exists():
            shutil.copytree(folder / capture, folder / captures[number], copy_function=os.link)
    rows = "".join(f"{name}\t{place}\t\n" for name, place in zip(names, captures, strict=True))
    (folder / "scenes.tsv").write_text("scene\tcapture\ttruth\n" + rows)


def multiply(folder: Path, names: list[str]) -> None:
    """Give each name the results of the first scene and Snakemake's records of them."""
    records = folder / ".snakemake/metadata"
    for name in names:
        target = folder / "results" / name
        if not target.exists():
            shutil.copytree(folder / "results/one", target, symlinks=True, copy_function=os.link)
    for record in list(records.rglob("*")):
        if not record.is_file():
            continue
        path = base64.b64decode(record.name, altchars=b"-_").decode()
        if not path.startswith("results/one/"):
            continue
        text = record.read_text()
        for name in names:
            renamed = base64.b64encode(path.replace("results/one/", f"results/{name}/", 1).encode(), altchars=b"-_")
            moved = text.replace("results/one/", f"results/{name}/").replace("--scene one ", f"--scene {name} ")
            (records / renamed.decode()).write_text(moved)


def campaign(folder: Path, count: int, cores: int) -> dict:
    """A campaign of scenes from nothing: wall time, and processor time by what it was spent on."""
    (folder / "campaign.yaml").write_text(SETTINGS.replace("scenes.tsv", "campaign.tsv") + "results: campaign\n")
    shutil.rmtree(folder / "campaign", ignore_errors=True)
    wall, cpu, _, _ = nishiki(folder, "run", "--configfile", "campaign.yaml", "--cores", str(cores))
    made = (path for path in (folder / "campaign").glob("*/*/*/run.json") if path.parts[-3] != "current")
    runs = [json.loads(path.read_text()) for path in made]
    stages = sum(run["process_cpu_seconds"] for run in runs)
    loading = sum(run["start_cpu_seconds"] for run in runs)
    return {
        "case": "campaign from nothing",
        "scenes": count,
        "stages": len(runs),
        "cores": cores,
        "wall_s": round(wall, 2),
        "cpu_s": round(cpu, 2),
        "computing": round((stages - loading) / cpu, 4),
        "loading": round(loading / cpu, 4),
        "workflow": round(1 - stages / cpu, 4),
        "workflow_s_a_job": round((cpu - stages) / (len(runs) + count), 3),
        "scene_cpu_s": round(stages / count, 1),
        "default": True,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="simulated", help="a sealed capture, or simulated (default)")
    parser.add_argument("--scenes", nargs="*", type=int, default=[1, 1000], help="numbers of scenes (default 1 1000)")
    parser.add_argument("--repeats", type=int, default=3, help="runs; the median is printed (default 3)")
    parser.add_argument("--own-captures", action="store_true", help="a capture for each scene, of hard links")
    parser.add_argument("--campaign", type=int, default=0, help="scenes of a campaign that is run from nothing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        capture = options.data
        if capture == "simulated":
            capture = "capture"
            nishiki(folder, "simulate", "--output", "capture", "--truth", "truth", "--preset", "tiny")
        else:
            capture = str(Path(capture).resolve())
        (folder / "config.yaml").write_text(SETTINGS)
        table(folder, ["one"], capture)
        wall, cpu, _, _ = nishiki(folder, "run", "--configfile", "config.yaml")
        stages = sum(1 for path in (folder / "results/one/current").iterdir() if path.is_dir())
        print(
            json.dumps(
                {"case": "first run of a tiny scene", "scenes": 1, "stages": stages, "wall_s": wall, "cpu_s": cpu}
            )
        )
        for count in options.scenes:
            names = ["one", *(f"scene{i:05d}" for i in range(1, count))]
            multiply(folder, names[1:])
            table(folder, names, capture, own=options.own_captures)
            if options.own_captures:  # captures that are new are read once
                nishiki(folder, "run", "--configfile", "config.yaml")
            times = []
            for _ in range(options.repeats):
                wall, cpu, peak, text = nishiki(folder, "run", "--configfile", "config.yaml")
                if "Nothing to be done" not in text:
                    raise SystemExit(f"expected nothing to be done:\n{text[-2000:]}")
                times.append((wall, cpu, peak))
            wall, cpu, peak = sorted(times)[len(times) // 2]
            what = "nothing to be done, captures of their own" if options.own_captures else "nothing to be done"
            case = {"case": what, "scenes": count, "stages": stages * count}
            case |= {"wall_s": round(wall, 2), "cpu_s": round(cpu, 2), "peak_mib": peak, "default": True}
            print(json.dumps(case), flush=True)
        if options.campaign:
            rows = "".join(f"scene{i:05d}\t{capture}\t\n" for i in range(options.campaign))
            (folder / "campaign.tsv").write_text("scene\tcapture\ttruth\n" + rows)
            for cores in (1, 2):
                print(json.dumps(campaign(folder, options.campaign, cores)), flush=True)


if __name__ == "__main__":
    main()
