"""Error against run time, on measured and simulated captures: convert or simulate, sweep, write the page.

    python benchmarks/error_against_run_time.py --data FOLDER_OF_MEASURED_DATA
    python benchmarks/error_against_run_time.py --data FOLDER --only cat satin    some scenes
    python benchmarks/error_against_run_time.py --from-results                    the page from the stored lines

Captures and results are kept in --work (default: results/error-against-run-time), so that a later call continues where
this one ended. The lines behind the page are docs/benchmarks/sweep-*.jsonl, the page is
docs/notes/error-against-run-time.md, its drawings are in docs/sweeps/.
"""

import argparse
import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import yaml

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT / "workflow/src"))

from nishiki.sweep.page import AXIS_NAMES, scene_content  # noqa: E402
from nishiki.sweep.variants import (  # noqa: E402
    MeasureSettings,
    Spread,
    VariantRow,
)

STORED = PROJECT / "docs/benchmarks"
DRAWINGS = PROJECT / "docs/sweeps"
PAGE = PROJECT / "docs/notes/error-against-run-time.md"
SWEEPS = PROJECT / "config/sweeps"
NOTES = Path(__file__).with_name("error_against_run_time.yaml")


@dataclass(frozen=True)
class Part:
    """One sweep of one scene: a shipped sweep, variants of its own, and settings of all of its variants."""

    name: str
    sweep: str
    variants: dict[str, dict] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    settings: dict = field(default_factory=dict)
    repeats: int = 2
    error: tuple[str, ...] = ()


@dataclass(frozen=True)
class Subject:
    """One capture: how it is made, what is true of it, what is swept. measured: a folder of the measured data."""

    title: str
    about: str
    parts: tuple[Part, ...]
    measured: str = ""
    convert: tuple[str, ...] = ()
    simulate: tuple[str, ...] = ()
    truth: str = ""


NO_SHADOWS = {"evaluate.cast_shadows": False}
"""No height is integrated for the evaluation: it costs more than what is compared."""
SUBJECTS = {
    "cat": Subject(
        "A cat under 96 lights (DiLiGenT, measured)",
        "96 photographs, true normals by a scanner.",
        (
            Part(
                "cat",
                "normals",
                {
                    "24 lights": {"lights": 24, "refine": "none"},
                    "12 lights": {"lights": 12, "refine": "none"},
                    "green channel alone": {"ingest.channels": "green"},
                },
                without=("refit, lobe",),
                settings=NO_SHADOWS,
            ),
        ),
        measured="diligent_cat",
        truth="normals_gt.npz",
    ),
    "fossil": Subject(
        "A fossil under 41 lights (RTI dome, measured)",
        "No truth: four lights are kept from every fit and predicted instead. 384 × 384 pixels of the photographs.",
        (
            Part(
                "fossil",
                "normals",
                {"12 lights": {"lights": 12, "refine": "none"}},
                without=("joint fit", "refit, lobe", "refit, lobes"),
                settings=NO_SHADOWS,
            ),
        ),
        measured="rti_fossil",
        convert=("--roi", "1088", "1856", "384", "384"),
    ),
    "painting": Subject(
        "A painting under 9 lights (simulated)",
        "Impasto under varnish, 192 × 256 pixels; normals, spectra and colours are known.",
        (
            Part("painting-normals", "normals", without=("joint fit", "refit, lobes"), settings=NO_SHADOWS),
            Part("painting-spectra", "spectra", settings=NO_SHADOWS),
        ),
        simulate=("--preset", "painting", "--rows", "192", "--columns", "256"),
    ),
    "dino": Subject(
        "A dinosaur on a turntable (Oxford, measured)",
        "36 views of 576 × 720 pixels, no truth: three views are left out and predicted. To save time, a quarter of "
        "the usual texels along each side, a hull of 96 cells, and three passes at most.",
        (
            Part(
                "dino",
                "residual",
                without=("parameters as fitted", "half of the bytes"),
                settings={
                    "texels.texels_per_pixel": 0.25,
                    "mesh.cells": 96,
                    "residual.passes": 3,
                    "object_evaluate.similarity": False,
                },
                error=("psnr.left_out_interpolated.mean_psnr_db", "psnr.captured.mean_psnr_db"),
            ),
        ),
        measured="oxford_dino",
    ),
    "jar": Subject(
        "A jar on a turntable (simulated)",
        "24 views of 128 × 128 pixels in two polariser states.",
        (
            Part(
                "jar",
                "residual",
                {"polarisers' noise left in": {"polarise.smoothing": False}},
                without=("parameters as fitted",),
                settings={"object_evaluate.similarity": False},
            ),
        ),
        simulate=("--preset", "object", "--rows", "128", "--columns", "128", "--views", "24"),
    ),
    "satin": Subject(
        "A black satin of 5 harnesses on a gonioreflectometer (simulated)",
        "5940 photographs; the error is that of all measurements which no fit of the variant used.",
        (Part("satin", "cloth", without=("40 oblique", "paper, linear form")),),
        simulate=("--preset", "satin"),
    ),
}
CLOSING = """\
## How repeats are timed

Each repeat is a job of its own that has the machine to itself, with the threads that the stage's rule would give it.
It runs the stage on the same inputs into a folder that is thrown away, and records time, CPU time, peak memory,
bytes, the load of the machine before, and whether the artifact has the very bytes of the first one; where it has not,
the page says which file differs, and the command ends with status 1. The records are small files in
`results/sweeps/timings/<scene>/<stage>/<key>/`: an interrupted sweep continues with those that are missing, and
sweeps share them. Change the code, and only what depends on it is timed again.
"""
INTRODUCTION = """\
# Error against run time

Which settings a scene deserves, from measurements: each drawing shows what every variant costs and how wrong it is.
Written by

    python benchmarks/error_against_run_time.py --data FOLDER

which converts the measured captures, simulates the others, and runs the sweeps of `config/sweeps` on them
([how sweeps work](../sweeps.md)). Lower left is better; hollow marks are beaten by another variant. Times are CPU
seconds of the stages named, medians of the repeats; the whiskers reach from the fastest to the slowest.
"""


def nishiki(folder: Path, *arguments: str) -> None:
    """Run the command line; its exit status 2 or 1 ends this program with its message."""
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "workflow/src")}
    done = subprocess.run([sys.executable, "-m", "nishiki", *arguments], cwd=folder, env=environment, check=False)
    if done.returncode:
        raise SystemExit(f"nishiki {' '.join(arguments)}: exit status {done.returncode}")


def capture_of(name: str, subject: Subject, work: Path, data: Path | None) -> Path | None:
    """Make the subject's capture where it is not there yet; its truth, or None."""
    capture, truth = work / f"captures/{name}", work / f"captures/{name}-truth"
    capture.parent.mkdir(parents=True, exist_ok=True)
    if subject.simulate:
        if not capture.is_dir():
            nishiki(work, "simulate", "--output", str(capture), "--truth", str(truth), *subject.simulate)
        return truth
    if data is None:
        raise SystemExit(f"{name}: --data is needed, the folder that holds {subject.measured}")
    if not capture.is_dir():
        nishiki(work, "convert", str(data / subject.measured), str(capture), *subject.convert)
    return data / subject.measured / subject.truth if subject.truth else None


def sweep_of(part: Part) -> dict:
    """The shipped sweep with what this part changes of it."""
    shipped = yaml.safe_load((SWEEPS / f"{part.sweep}.yaml").read_text())
    variants = {name: given for name, given in shipped["variants"].items() if name not in part.without}
    return {
        **shipped,
        "variants": {**variants, **part.variants},
        "peers": [name for name in shipped.get("peers", ()) if name not in part.without],
        "apart": [name for name in shipped.get("apart", ()) if name not in part.without],
        "settings": {**shipped.get("settings", {}), **part.settings},
        "repeats": part.repeats,
        "error": list(part.error),
    }


def run(name: str, work: Path, data: Path | None, cores: str) -> None:
    """Sweep one subject and store its lines."""
    subject = SUBJECTS[name]
    truth = capture_of(name, subject, work, data)
    (work / f"{name}.tsv").write_text(f"scene\tcapture\ttruth\n{name}\tcaptures/{name}\t{truth or ''}\n")
    (work / f"{name}.yaml").write_text(f"scenes: {name}.tsv\n")
    for part in subject.parts:
        (work / f"sweep-{part.name}.yaml").write_text(yaml.safe_dump(sweep_of(part), sort_keys=False))
        nishiki(work, "sweep", f"sweep-{part.name}.yaml", "--configfile", f"{name}.yaml", "--cores", cores)
        (scene,) = json.loads((work / f"results/sweeps/sweep-{part.name}/sweep.json").read_text())["scenes"]
        about = {key: scene[key] for key in ("machines", "load", "axis", "counted", "evaluation", "measures")}
        lines = [about, *({key: row[key] for key in row if key != "ahead"} for row in scene["rows"])]
        text = "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines)
        (STORED / f"sweep-{part.name}.jsonl").write_text(text)


def stored(part: Part) -> dict | None:
    """A part as the page shows it, from its stored lines."""
    path = STORED / f"sweep-{part.name}.jsonl"
    if not path.is_file():
        return None
    about, *lines = [json.loads(line) for line in path.read_text().splitlines()]
    measures = [MeasureSettings(**measure) for measure in about["measures"]]
    rows = [row_from(line) for line in lines]
    keys = {key: about[key] for key in ("axis", "counted", "evaluation")}
    return {**scene_content(part.name, rows, measures, **keys), "load": about["load"]}


def row_from(line: dict) -> VariantRow:
    """A row from its stored line."""
    times = {name: Spread(**spread) for name, spread in line["times"].items()}
    stages = {
        stage: {name: Spread(**spread) for name, spread in found.items()} for stage, found in line["stages"].items()
    }
    return VariantRow(**{**line, "times": times, "stages": stages})


def standing(scene: dict, number: int) -> str:
    """on | within the spread | off: where the default stands."""
    first = scene["advice"][number][0]
    return "off" if "is not on the front" in first else "within the spread" if "within the spread" in first else "on"


def page() -> dict[Path, str]:
    """The page and its drawings from the stored lines."""
    notes = yaml.safe_load(NOTES.read_text()) or {}
    files: dict[Path, str] = {}
    parts, summary = [], []
    for subject in SUBJECTS.values():
        found = [(part, scene) for part in subject.parts if (scene := stored(part)) is not None]
        if not found:
            continue
        parts.append(f"## {subject.title}\n\n{subject.about}\n")
        for part, scene in found:
            summary += summary_rows(part, scene, subject)
            parts.append(section(part, scene, notes.get(part.name, {}), files))
    head = "| scene | error | default | time | place of the default |\n|---|---|---|---|---|\n"
    files[PAGE] = "\n".join(
        [INTRODUCTION, machine_text(), head + "\n".join(summary) + "\n", *missing_text(), *parts, CLOSING]
    )
    return files


def missing_text() -> list[str]:
    """Which subjects have no stored lines yet, and the command that measures them."""
    names = [name for name, subject in SUBJECTS.items() if not all(stored(part) for part in subject.parts)]
    if not names:
        return []
    return [f"Not measured yet: {', '.join(names)}. The command above with `--only {' '.join(names)}` adds them.\n"]


def summary_rows(part: Part, scene: dict, subject: Subject) -> list[str]:
    """Rows of the table at the top, one for each measure."""
    default = next(row for row in scene["rows"] if row["default"])
    time = default["times"][scene["axis"]]["median"]
    places = {"on": "on the front", "within the spread": "on the front within the spread", "off": "off the front"}
    return [
        f"| [{part.name}](#{anchor(subject.title)}) | {measure['label']} "
        f"| {default['errors'][k]:.4g} {measure['unit']} | {time:.3g} s | {places[standing(scene, k)]} |"
        for k, measure in enumerate(scene["measures"])
    ]


def anchor(title: str) -> str:
    """Name of a heading in a link."""
    return "".join(c for c in title.lower().replace(" ", "-") if c.isalnum() or c == "-")


def machine_text() -> str:
    """The machines of all stored parts, and how busy they were."""
    scenes = [scene for subject in SUBJECTS.values() for part in subject.parts if (scene := stored(part))]
    machines = sorted({machine for scene in scenes for machine in scene["machines"]})
    text = f"Measured on {'; '.join(machines)}."
    load = max((scene["load"] for scene in scenes), default=0.0)
    if load >= 1:
        text += (
            f" The machine was in use by other work (load up to {load:.0f} before a repeat): times of the clock are "
            "several times too long and are not shown; CPU times are larger than on a quiet machine, and scatter as "
            "the whiskers show."
        )
    return text + "\n"


def section(part: Part, scene: dict, notes: dict, files: dict[Path, str]) -> str:
    """One part: drawings, advice, why the default is where it is, table."""
    lines = []
    for k, measure in enumerate(scene["measures"]):
        drawing = DRAWINGS / scene["plots"][k]["file"]
        files[drawing] = scene["plots"][k]["svg"] + "\n"
        lines += [f"![{measure['label']} against {AXIS_NAMES[scene['axis']]}](../sweeps/{drawing.name})", ""]
        lines += [f"* {text}" for text in scene["advice"][k]]
        if notes.get("default"):
            lines.append(f"* {' '.join(notes['default'].split())}" if k == 0 else "")
        lines.append("")
    lines.append(f"Time of {' + '.join(scene['counted'])}; {scene['rows'][0]['repeats']} repeats.")
    if notes.get("text"):
        lines += ["", " ".join(notes["text"].split())]
    return "\n".join([*lines, "", table(scene), ""])


def table(scene: dict) -> str:
    """Markdown table of all variants; bold: the default."""
    axis = scene["axis"]
    measures = [
        f"{measure['label']}{', ' + measure['unit'] if measure['unit'] else ''}" for measure in scene["measures"]
    ]
    heads = ["variant", *measures, f"{AXIS_NAMES[axis]}, s", "from … to", "memory, MiB", "MB", "front"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in scene["rows"]:
        time = row["times"][axis]
        roles = {" (paper)": row["paper"], " (of others)": row["peer"], " (not compared)": row["apart"]}
        role = next((text for text, meant in roles.items() if meant), "")
        cells = [row["name"] + role, *(f"{value:.4g}" for value in row["errors"]), f"{time['median']:.3g}"]
        cells += [
            f"{time['low']:.3g} … {time['high']:.3g}",
            f"{row['peak_memory_mib']:.0f}",
            f"{row['bytes'] / 1e6:.3g}",
        ]
        cells.append("–" if row["apart"] else ", ".join("yes" if on else "no" for on in row["ahead"]))
        lines.append("| " + " | ".join(f"**{cell}**" if row["default"] else cell for cell in cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run what was asked for, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the measured data")
    parser.add_argument(
        "--work", type=Path, default=PROJECT / "results/error-against-run-time", help="captures, results"
    )
    parser.add_argument("--only", nargs="*", choices=SUBJECTS, help="scenes to run (default: all)")
    parser.add_argument("--cores", default="all", help="processors to use (default: all)")
    parser.add_argument("--from-results", action="store_true", help="run nothing, write the page from stored lines")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    for name in [] if options.from_results else options.only or SUBJECTS:
        run(name, options.work.resolve(), options.data and options.data.resolve(), options.cores)
    for path, text in page().items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
