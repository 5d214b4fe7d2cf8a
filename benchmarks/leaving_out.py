"""What leaving out saves: each chain as a scene needs it against the same scene with every product asked for.

    python benchmarks/leaving_out.py                       three simulated scenes, tiny
    python benchmarks/leaving_out.py --data captures/x     the parts and channels of a sealed capture of one's own
    python benchmarks/leaving_out.py --page                write the stored lines into docs/notes/leaving-out.md

Seconds are of processor time, so that other programs on the machine do not count; bytes are those that the
processes asked the operating system for, of files in its cache as well; memory is the peak of the largest stage. All
come from the stages' own `run.json`. Every run is made twice and the second is counted: the first compiles kernels.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

PROJECT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(PROJECT / "workflow/src"), str(PROJECT / "scripts")]

from nishiki.capture.folder import load_capture  # noqa: E402
from nishiki.installation import EXTRAS, MODULES, is_installed  # noqa: E402
from nishiki.observations.region import usage_of  # noqa: E402
from nishiki.stages.table import PRODUCTS  # noqa: E402

SCENES = {"plane": "tiny", "turntable": "object-tiny", "goniometer": "satin-tiny"}
ASKED = {"plane": ["normals"], "turntable": ["cameras", "mesh"], "goniometer": ["weave"]}
"""What a scene asks for that needs little; the rest of its chain is left out."""
SMALL = {
    "render": {"pictures": [{"name": "daylight"}], "sequences": [{"name": "light", "frames": 3, "columns": 64}]},
    "object_render": {"views": 6, "between": 1, "film": {"frames_per_step": 1, "columns": 64, "supersampling": 1}},
    "cloth_render": {"view": {"rows": 72, "columns": 72}, "supersampling": 1},
}
"""Few and small pictures: this is about reading, loading and stages, not about painting pictures."""
PARTS = {
    "plane": ("check", "light ring1"),
    "turntable": ("states", "white_states", "photographs", "calibration", "silhouettes", "mesh", "scans"),
    "goniometer": ("oblique",),
}
MEASURE = """
import sys; sys.path.insert(0, {source!r})
from nishiki.artifacts.stage import RunFacts, bytes_read, peak_memory_kib
import time
before = time.process_time(), peak_memory_kib(), bytes_read()
{code}
after = time.process_time(), peak_memory_kib(), bytes_read()
print(*(b - a for a, b in zip(before, after)))
"""


def nishiki(folder: Path, *arguments: str) -> str:
    """One call of the command line; exits with its message where it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "nishiki", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(PROJECT / "workflow/src")},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    return done.stdout


def run_chain(folder: Path, capture: str, truth: str, products: list[str]) -> dict[str, dict]:
    """run.json of every stage of a fresh run; empty results, kernels as they are."""
    with tempfile.TemporaryDirectory(dir=folder) as name:
        place = Path(name)
        settings = {**SMALL, "scenes": "scenes.tsv", "products": products}
        (place / "config.yaml").write_text(yaml.safe_dump(settings))
        (place / "scenes.tsv").write_text(f"scene\tcapture\ttruth\none\t{capture}\t{truth}\n")
        nishiki(place, "run", "--configfile", "config.yaml", "--cores", "1")
        current = place / "results/one/current"
        return {path.parent.name: json.loads(path.read_text()) for path in sorted(current.glob("*/run.json"))}


def totals(facts: dict[str, dict]) -> dict:
    """Sums over the stages, and the largest memory."""
    return {
        "stages": len(facts),
        "cpu_s": round(sum(f["process_cpu_seconds"] for f in facts.values()), 2),
        "start_cpu_s": round(sum(f["start_cpu_seconds"] for f in facts.values()), 2),
        "peak_mib": max(f["peak_memory_mib"] for f in facts.values()),
        "read_mb": round(sum(f["bytes_read"] for f in facts.values()) / 1e6, 2),
        "packages": len({package for f in facts.values() for package in f["packages"]}),
    }


def chains(folder: Path, capture: str, truth: str, geometry: str) -> None:
    """Every product, the default ones, and a scene that asks for little; then each stage left out."""
    run_chain(folder, capture, truth, list(PRODUCTS))
    every = run_chain(folder, capture, truth, list(PRODUCTS))
    default = run_chain(folder, capture, truth, ["render", "evaluate", "report"])
    little = run_chain(folder, capture, truth, ASKED[geometry])
    for case, facts in (
        ("every product", every),
        ("default products", default),
        (", ".join(ASKED[geometry]), little),
    ):
        print(json.dumps({"chain": geometry, "case": case, **totals(facts), "default": facts is default}))
    for stage, facts in every.items():
        if stage in little:
            continue
        print(
            json.dumps(
                {
                    "chain": geometry,
                    "stage left out": stage,
                    "saves_cpu_s": facts["process_cpu_seconds"],
                    "peak_mib": facts["peak_memory_mib"],
                    "saves_read_mb": round(facts["bytes_read"] / 1e6, 3),
                }
            )
        )


def ingest(folder: Path, capture: str, settings: dict, repeats: int) -> dict[str, float]:
    """Processor seconds, MiB, bytes read and kept of ingest alone with these settings, medians."""
    rows = []
    for _ in range(repeats + 1):
        with tempfile.TemporaryDirectory(dir=folder) as name:
            output = Path(name)
            command = [
                sys.executable,
                str(PROJECT / "scripts/stage.py"),
                "ingest",
                "--capture",
                capture,
                "--output",
                name,
            ]
            done = subprocess.run(
                [*command, "--settings", json.dumps(settings)], capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise SystemExit(done.stderr)
            facts = json.loads(next(output.glob("*/run.json")).read_text())
            kept = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
            rows.append((facts["cpu_seconds"], facts["peak_memory_mib"], facts["bytes_read"] / 1e6, kept / 1e6))
    names = ("cpu_s", "peak_mib", "read_mb", "kept_mb")
    return {name: statistics.median(values) for name, values in zip(names, zip(*rows[1:], strict=True), strict=True)}


def parts(folder: Path, capture: str, title: str, repeats: int) -> None:
    """What ingest saves by each part of the capture, and by keeping one channel."""
    loaded = load_capture(Path(capture))
    whole = ingest(folder, capture, {"channels": "all"}, repeats)
    cases = [(f"without {part}", {"channels": "all", "without": [part]}) for part in PARTS[loaded.geometry]]
    if loaded.geometry == "plane" and len(loaded.settings.camera.channels) > 1:
        cases.append(("luminance alone", {"channels": "luminance"}))
    print(json.dumps({"scene": title, "ingest": "everything", "files": reading(loaded, {})["read"], **rounded(whole)}))
    for case, settings in cases:
        files = reading(loaded, settings)
        if files["read"] == files["of"] and "without" in settings:
            continue  # the capture has no such part
        found = ingest(folder, capture, settings, repeats)
        saved = {f"saves_{name}": round(whole[name] - value, 3) for name, value in found.items()}
        print(json.dumps({"scene": title, "ingest": case, "files": files["read"], **saved}))


def reading(loaded, settings: dict):
    """All files that ingest reads with these settings."""
    channels = settings.get("channels", "all")
    return usage_of(loaded, without=settings.get("without", ()), channels=channels)["total"]


def rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 3) for name, value in values.items()}


def packages(repeats: int) -> None:
    """What importing each heavy package costs a process that has numpy already; and what the command line loads."""
    cases = {name: f"import {module}" for name, module in MODULES.items() if is_installed(name) and name != "numpy"}
    cases["scikit-image"] = "from skimage.measure import marching_cubes"
    cases["scipy"] = "import scipy.optimize, scipy.sparse.linalg, scipy.spatial, scipy.ndimage"
    for name, code in {"numpy": "import numpy", **cases}.items():
        found = measured("" if name == "numpy" else "import numpy", code, repeats)
        extra = EXTRAS.get(name, "")
        print(json.dumps({"package": name, "extra": extra, **found, "installed_mb": installed_mb(name)}))
    for name, module in (("nishiki --version", "nishiki.cli"), ("nishiki plan", "nishiki.commands.inspecting")):
        print(json.dumps({"command": name, **measured("", f"import {module}", repeats)}))


def measured(before: str, code: str, repeats: int) -> dict[str, float]:
    """Processor seconds, MiB and MB read of some imports, in a process that has done `before`."""
    rows = []
    for _ in range(repeats + 1):
        text = MEASURE.format(source=str(PROJECT / "workflow/src"), code=code).replace(
            "\nbefore =", f"\n{before}\nbefore ="
        )
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
        rows.append([float(value) for value in done.stdout.split()[-3:]])
    seconds, kib, read = (statistics.median(values) for values in zip(*rows[1:], strict=True))
    return {"cpu_s": round(seconds, 3), "mib": round(kib / 1024, 1), "read_mb": round(read / 1e6, 2)}


def installed_mb(package: str) -> float:
    """Size on disk of a package, without what it depends on."""
    from importlib.metadata import distribution

    files = [file.locate() for file in distribution(package).files or ()]
    return round(sum(Path(file).stat().st_size for file in files if Path(file).is_file()) / 1e6, 1)


def write_page() -> None:
    """The tables of the stored lines at the end of the page, in place of those that stand there."""
    from page import PAGE, STORED, tables

    page = PAGE.parent / "leaving-out.md"
    about, *rows = [json.loads(line) for line in (STORED / "leaving_out.jsonl").read_text().splitlines()]
    text, marker, _ = page.read_text().partition("<!-- measured -->\n")
    page.write_text(f"{text}{marker}\nMeasured on {about['machine']}. **Bold**: the default.\n\n{tables(rows)}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", nargs="*", default=[], help="sealed captures whose parts are measured as well")
    parser.add_argument(
        "--only", choices=("chains", "parts", "packages"), nargs="*", default=("chains", "parts", "packages")
    )
    parser.add_argument(
        "--repeats", type=int, default=3, help="of ingest and imports; the median is printed (default 3)"
    )
    parser.add_argument("--page", action="store_true", help="measure nothing, write the page from the stored lines")
    options = parser.parse_args()
    if options.page:
        return write_page()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for geometry, preset in SCENES.items() if {"chains", "parts"} & set(options.only) else ():
            capture, truth = str(folder / geometry), str(folder / f"{geometry}-truth")
            nishiki(folder, "simulate", "--output", capture, "--truth", truth, "--preset", preset)
            if "parts" in options.only:
                parts(folder, capture, f"simulated {preset}", options.repeats)
            if "chains" in options.only:
                chains(folder, capture, truth, geometry)
        for capture in options.data if "parts" in options.only else ():
            parts(folder, str(Path(capture).resolve()), Path(capture).name, options.repeats)
    if "packages" in options.only:
        packages(options.repeats)


if __name__ == "__main__":
    main()
