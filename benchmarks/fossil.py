"""Whole runs on a large capture: photographs to normals through the workflow; processor time, memory, files.

    python benchmarks/fossil.py --data FOLDER

FOLDER holds photographs and an .lp file, or folders of that kind (those with the largest photographs are used). Kernels
are compiled before; every case starts from an empty results folder.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
CASES = {
    "least_squares, luminance": (
        "ingest: {channels: luminance}\nseparate: {method: none}\nnormals: {solver: least_squares, refine: none}\n"
    ),
    "least_squares": "separate: {method: none}\nnormals: {solver: least_squares, refine: none}\n",
    "trimmed": "separate: {method: trimmed}\nnormals: {solver: least_squares, refine: none}\n",
    "refit": "normals: {solver: least_squares, refine: none}\n",
    "default": "",
}


def nishiki(folder: Path, *arguments: str) -> dict:
    """Run the command line; wall and processor seconds of all processes."""
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "workflow/src")}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "nishiki", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    return {
        "wall_s": round(time.perf_counter() - start, 2),
        "user_s": round(after.ru_utime - before.ru_utime, 2),
        "system_s": round(after.ru_stime - before.ru_stime, 2),
    }


def stage_facts(folder: Path) -> dict:
    """Seconds of processor and peak memory of each stage, from their run facts."""
    facts = {}
    for path in sorted((folder / "results").glob("*/*/*/run.json")):
        if "current" not in path.parts:
            run = json.loads(path.read_text())
            facts[path.parts[-3]] = (run["process_cpu_seconds"], run["peak_memory_mib"])
    return facts


def sources(data: Path) -> list[Path]:
    """Folders below `data` that hold an .lp file and JPEG photographs."""
    found = {path.parent for path in [*data.glob("*.lp"), *data.glob("*/*.lp")]}
    return sorted(folder for folder in found if any(folder.glob("*.jpg")) or any(folder.glob("*.JPG")))


def run_case(folder: Path, capture: Path, name: str, settings: str, product: str) -> dict:
    """One run from nothing."""
    work = folder / f"{capture.name}-{name}-{product}"
    work.mkdir()
    (work / "scenes.tsv").write_text(f"scene\tcapture\tproducts\n{capture.name}\t{capture}\t{product}\n")
    (work / "config.yaml").write_text("scenes: scenes.tsv\n" + settings)
    total = nishiki(work, "run", "--configfile", "config.yaml")
    stages = stage_facts(work)
    stage_cpu = sum(cpu for cpu, _ in stages.values())
    peak = max(memory for _, memory in stages.values())
    disk = sum(path.stat().st_size for path in (work / "results").rglob("*") if path.is_file()) / 2**20
    return {
        **total,
        "stages_cpu_s": round(stage_cpu, 2),
        "peak_rss_mb": round(peak, 0),
        "disk_mb": round(disk),
        "stages": ", ".join(f"{stage} {cpu:.1f} s {memory:.0f} MiB" for stage, (cpu, memory) in stages.items()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", required=True, type=Path, help="folder of photographs with an .lp, or of such folders"
    )
    options = parser.parse_args()
    found = sources(options.data.resolve())
    if not found:
        raise SystemExit(f"{options.data}: no folder with an .lp file and JPEG photographs")
    with tempfile.TemporaryDirectory() as name:
        for source in found:
            folder = Path(name)
            capture = folder / source.name
            nishiki(folder, "convert", str(source), str(capture))
            crop = folder / f"{source.name}-crop"
            nishiki(folder, "convert", str(source), str(crop), "--roi", "64", "64", "256", "256")
            for case, settings in CASES.items():
                run_case(folder, crop, f"warm-{case}".replace(", ", "-"), settings, "normals")
                facts = run_case(folder, capture, case.replace(", ", "-"), settings, "normals")
                print(
                    json.dumps({"object": source.name, "method": case, **facts, "default": case == "default"}),
                    flush=True,
                )


if __name__ == "__main__":
    main()
