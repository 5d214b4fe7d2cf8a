"""Run every benchmark and write the tables of the appendix to the benchmark page.

    python benchmarks/page.py --data FOLDER_OF_MEASURED_DATA
    python benchmarks/page.py --data FOLDER --only normals spectra      renew some, keep the others
    python benchmarks/page.py --from-results                           write the tables from the stored lines

The JSON lines are kept in docs/benchmarks/, the tables in docs/notes/benchmarks-tables.md. What they show is said in
words in docs/notes/benchmarks.md, which is written by hand.
"""

import argparse
import json
import platform
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
STORED = PROJECT / "docs/benchmarks"
PAGE = PROJECT / "docs/notes/benchmarks-tables.md"
FEW_LIGHTS = ("diligent_ball-24", "diligent_ball-12", "diligent_cat-24", "diligent_cat-12", "uw_gray", "uw_cat")
PROGRAM_OF = {"few_lights": "relighting"}
"""Where the program is not called as its lines are."""
PROGRAMS = {
    "normals": (["--data", "{data}"], "Normals", "normals.md"),
    "relighting": (["--data", "{data}"], "Relighting: lamps left out", "normals.md"),
    "few_lights": (
        ["--data", "{data}", "--refine", "auto", "gloss", "none", "--no-peers", "--only", *FEW_LIGHTS],
        "Few lights: normals and gloss fitted together, or one after the other",
        "normals.md",
    ),
    "spectra": (["--data", "{data}"], "Spectra", "spectra.md"),
    "brdf": (["--data", "{data}"], "Reflection model", "brdf.md"),
    "painting": (["--data", "simulated"], "Simulated painting", None),
    "render": (["--data", "simulated"], "Rendering", "render.md"),
    "fossil": (["--data", "{data}"], "Whole runs on a 12-megapixel capture", None),
    "overhead": (["--data", "simulated"], "Overhead of the workflow", None),
    "leaving_out": ([], "What leaving out saves", "../notes/leaving-out.md"),
    "texels": ([], "Texels of a surface", "texels.md"),
    "texel_fit": ([], "Reflection of texels", "object_brdf.md"),
    "residual": (["--data", "{data}/oxford_dino"], "Coded residual of a turntable", "residual.md"),
    "exports": (["--data", "{data}"], "Exports to other programs", "export.md"),
    "cloth_brdf": (["--data", "captures"], "Reflection of a cloth", "cloth_brdf.md"),
}
SHOWN = {
    "spectra": {"camera": "Canon 60D", "illuminant": "A"},
    "cloth_brdf": {"azimuth": "all"},
}  # of long results; the others stay in the JSON lines
INTRODUCTION = """\
# Benchmarks: tables

What these tables show is said in [benchmarks](benchmarks.md). Written by `python benchmarks/page.py`; the JSON
lines behind the tables are in `docs/benchmarks/`. Measured data are not part of the project; each program says with
`--help` what it looks for. **Bold** rows are the shipped defaults.
"""


def machine() -> str:
    """One line about this machine."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            model = line.split(":", 1)[1].strip()
            break
    import os

    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}"


def measure(name: str, data: str) -> list[dict]:
    """JSON lines of one program; exits with its message where it fails."""
    arguments = [argument.format(data=data) for argument in PROGRAMS[name][0]]
    print(f"{name} {' '.join(arguments)}", file=sys.stderr, flush=True)
    done = subprocess.run(
        [sys.executable, str(PROJECT / f"benchmarks/{PROGRAM_OF.get(name, name)}.py"), *arguments],
        cwd=PROJECT,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{name}: exit status {done.returncode}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def cell(value: object) -> str:
    """A value as text: four significant digits, lists shortened."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(cell(item) for item in value)
    if isinstance(value, dict):
        return ", ".join(f"{name} {cell(item)}" for name, item in value.items())
    return str(value)


def tables(rows: list[dict]) -> str:
    """Markdown tables, one for each set of keys that occurs."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(tuple(key for key in row if key != "default"), []).append(row)
    texts = []
    for keys, group in groups.items():
        lines = ["| " + " | ".join(keys) + " |", "|" + "---|" * len(keys)]
        for row in group:
            cells = [cell(row[key]) for key in keys]
            bold = [f"**{text}**" for text in cells] if row.get("default") else cells
            lines.append("| " + " | ".join(bold) + " |")
        texts.append("\n".join(lines))
    return "\n\n".join(texts)


def page() -> str:
    """The whole page from the stored lines."""
    parts = [INTRODUCTION]
    for name, (arguments, title, stage_page) in PROGRAMS.items():
        path = STORED / f"{name}.jsonl"
        if not path.is_file():
            continue
        about, *rows = [json.loads(line) for line in path.read_text().splitlines()]
        more = f" Methods and limits: [stages/{stage_page}](../stages/{stage_page})." if stage_page else ""
        only = SHOWN.get(name, {})
        rows = [row for row in rows if all(row.get(key) == value for key, value in only.items())]
        if only:
            more += (
                f" Shown: {', '.join(f'{key} {value}' for key, value in only.items())}; the rest is in the JSON lines."
            )
        command = f"`python benchmarks/{PROGRAM_OF.get(name, name)}.py {' '.join(arguments).format(data='FOLDER')}`"
        parts.append(f"## {title}\n\n{command} on {about['machine']}.{more}\n\n{tables(rows)}\n")
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="folder of the measured data")
    parser.add_argument("--only", nargs="*", choices=PROGRAMS, help="programs to run (default: all)")
    parser.add_argument("--from-results", action="store_true", help="run nothing, write the tables from stored lines")
    options = parser.parse_args()
    if not options.from_results and not options.data:
        parser.error("--data is needed, or --from-results")
    STORED.mkdir(parents=True, exist_ok=True)
    for name in [] if options.from_results else options.only or PROGRAMS:
        lines = [{"machine": machine()}, *measure(name, options.data)]
        (STORED / f"{name}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    PAGE.write_text(page())


if __name__ == "__main__":
    main()
