"""Runs every case of stability and writes docs/notes/stability.md: `python tests/stability/page.py [--only ROOM]`."""

import argparse
import importlib.util
import sys
import time
import traceback
from pathlib import Path

import yaml

PROJECT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
PAGE = PROJECT / "docs/notes/stability.md"
if __name__ == "__main__":
    sys.path[:0] = [str(PROJECT / part) for part in ("workflow/src", "scripts", "tests", "")]

from stability.cases import REGISTRY, Case  # noqa: E402

TITLES = {
    "radiometry": "Radiometry and separation",
    "polarisation": "Polarisation",
    "normals": "Normals and height",
    "spectra": "Spectra and colour",
    "brdf": "Reflection model of a plane",
    "render": "Rendering",
    "geometry": "Geometry",
    "patches": "Charts and texels",
    "object_brdf": "Reflection model of an object",
    "residual": "Residual",
    "cloth_brdf": "Reflection of a cloth",
    "weave": "Weave",
    "frame": "The frame of the stages",
}


def load() -> list[Case]:
    """All cases, by area in the page's order."""
    for path in sorted(HERE.glob("test_*.py")):
        spec = importlib.util.spec_from_file_location(f"stability.{path.stem}", path)
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    order = list(TITLES)
    return sorted(REGISTRY.values(), key=lambda item: order.index(item.area) if item.area in order else len(order))


def found() -> list[dict[str, str]]:
    """The cases that failed when they were first written."""
    return yaml.safe_load((HERE / "found.yaml").read_text(encoding="utf-8")) or []


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    cells = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in row) + " |" for row in cells]


def _number(value: float) -> str:
    return "0" if value == 0 else f"{value:.1e}" if value < 1e-2 or value >= 1e4 else f"{value:.3g}"


def _measured(item: Case) -> str:
    try:
        error = float(item.measure())
    except Exception:
        traceback.print_exc()
        error = float("inf")
    if not error <= item.bound:
        print(f"BEYOND ITS BOUND: {item.source}: {error:.3g} {item.unit}, bound {item.bound:.3g}", file=sys.stderr)
    return _number(error)


def _section(title: str, cases: list[Case]) -> list[str]:
    rows = []
    for item in cases:
        started = time.perf_counter()
        error = _measured(item)
        print(f"{time.perf_counter() - started:6.2f} s  {item.source}: {error} {item.unit}")
        row = [item.name, item.hazard, item.treatment, item.outcome, item.reference]
        rows.append([*row, f"{error} {item.unit}", _number(item.bound)])
    head = ["case", "hazard", "treatment", "outcome", "reference", "worst error", "bound"]
    return [f"### {title}", "", *_table(head, rows), ""]


def _limits() -> list[str]:
    """What the run stops for: the table of `nishiki.stages.table`."""
    from nishiki.stages.table import LIMITS

    rows = [
        [
            stage,
            f"`{limit.name}`",
            limit.meaning,
            limit.sound if limit.doubt is not None else "",
            limit.stated + ", warns only" * limit.warns,
            limit.why,
            limit.remedy,
        ]
        for stage, limits in LIMITS.items()
        for limit in limits
        if limit.stated
    ]
    head = ["stage", "limit", "figure", "sound", "expected", "why there", "remedy"]
    return ["## Limits", "", (HERE / "limits.md").read_text(encoding="utf-8").rstrip(), "", *_table(head, rows), ""]


def _standing() -> dict[str, list[str]]:
    """Sections of the page as it stands: title to lines."""
    found: dict[str, list[str]] = {}
    section: list[str] = []
    for line in PAGE.read_text(encoding="utf-8").splitlines() if PAGE.is_file() else []:
        if line.startswith("#"):
            section = found.setdefault(line.lstrip("# "), [])
        section.append(line)
    return found


def page(cases: list[Case], only: set[str]) -> str:
    """Text of the page; the cases of the areas in `only` are run now, the sections of the others stay as they are."""
    lines = [(HERE / "introduction.md").read_text(encoding="utf-8").rstrip(), "", "## Cases", ""]
    standing = _standing()
    for area in dict.fromkeys(item.area for item in cases):
        title = TITLES[area]
        if area in only:
            lines += _section(title, [item for item in cases if item.area == area])
        else:
            lines += standing.get(title, [])
    lines += [*_limits(), "## Cases that failed when they were first written", ""]
    lines += _table(["case", "seen", "mended by"], [[row["case"], row["seen"], row["mended"]] for row in found()])
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the cases and write the page; with --only, those of some areas, and leave the other sections as they are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="ROOM", choices=TITLES, help="run the cases of test_ROOM.py")
    only = parser.parse_args().only
    cases = load()
    text = page(cases, set(only or TITLES))
    PAGE.write_text(text, encoding="utf-8")
    print(f"wrote {PAGE}: {len(cases)} cases")


if __name__ == "__main__":
    main()
