"""Compares two results folders: do two versions of the code give the same maps, tables and figures?

    python benchmarks/compare_results.py results-before results-after [--scenes tiny]

One JSON object a line for each stage of each scene: how many arrays and figures there are, how many have other
bytes, and the largest difference, absolute and relative to the largest value of the array (`arrays`), or
relative to the figure (`figures`). Keys may differ: artifacts are taken from `current/`. Times, digests, versions
and host names are no figures. For checking that a change
of structure changes no result; a difference beyond float32 rounding (1e-6) ends with exit status 1.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import zarr

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401

ROUNDING = 1e-6  # relative
NO_FIGURE = {"code", "digest", "key", "libraries", "upstream", "version", "files", "stamp", "created", "seconds"}


def main() -> None:
    """Arguments in, one line a stage out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--scenes", nargs="*", help="names of scenes (default: all of the first folder)")
    arguments = parser.parse_args()
    worst = 0.0
    for scene in arguments.scenes or sorted(path.parent.name for path in arguments.before.glob("*/current")):
        first, second = (folder / scene / "current" for folder in (arguments.before, arguments.after))
        for stage in sorted(path.name for path in first.iterdir() if (path / "artifact.json").is_file()):
            row = compared(first / stage, second / stage)
            worst = max(worst, row["arrays_relative"], row["figures_relative"], float("inf") if row["missing"] else 0)
            print(json.dumps({"scene": scene, "stage": stage, **row}), flush=True)
    sys.exit(worst > ROUNDING)


def compared(first: Path, second: Path) -> dict:
    """Differences of two artifacts."""
    one, other = arrays(first), arrays(second)
    missing = sorted(one.keys() ^ other.keys())
    changed, largest, relative = 0, 0.0, 0.0
    for name in one.keys() & other.keys():
        a, b = one[name], other[name]
        if a.shape != b.shape or a.dtype != b.dtype:
            missing.append(name)
        elif a.tobytes() != b.tobytes():
            changed += 1
            off = difference(a, b)
            largest = max(largest, off)
            relative = max(relative, off / max(float(np.nanmax(np.abs(a.astype(np.float64)))), 1e-300) if off else 0.0)
    figures, of_other = dict(numbers(manifest(first))), dict(numbers(manifest(second)))
    missing += sorted(figures.keys() ^ of_other.keys())
    apart = [
        abs(value - of_other[name]) / max(abs(value), 1e-12) for name, value in figures.items() if name in of_other
    ]
    return {
        "arrays": len(one),
        "arrays_changed": changed,
        "arrays_largest": largest,
        "arrays_relative": relative,
        "figures": len(figures),
        "figures_changed": sum(value > 0 for value in apart),
        "figures_relative": max(apart, default=0.0),
        "missing": missing[:10],
    }


def difference(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference; infinite where one is NaN and the other is not, or where texts differ."""
    if a.dtype.kind not in "fiub":
        return float("inf")
    a, b = a.astype(np.float64), b.astype(np.float64)
    if (np.isnan(a) != np.isnan(b)).any():
        return float("inf")
    return float(np.nanmax(np.abs(a - b), initial=0.0))


def arrays(folder: Path) -> dict[str, np.ndarray]:
    """All arrays of an artifact, Zarr and npz, by their place in it."""
    found = {}
    for path in sorted(folder.resolve().glob("*.zarr")):
        store = zarr.open(path, mode="r")
        members = dict(store.members(max_depth=None)) if isinstance(store, zarr.Group) else {"": store}
        found |= {
            f"{path.name}/{name}": np.asarray(item[...])
            for name, item in members.items()
            if isinstance(item, zarr.Array)
        }
    for path in sorted(folder.resolve().glob("*.npz")):
        with np.load(path) as stored:
            found |= {f"{path.name}/{name}": stored[name] for name in stored.files}
    return found


def manifest(folder: Path) -> dict:
    """Diagnostics, and the evaluation where there is one."""
    told = {"diagnostics": json.loads((folder / "artifact.json").read_text())["diagnostics"]}
    for path in sorted(folder.resolve().glob("*.json")):
        if path.name not in ("artifact.json", "run.json"):
            told[path.stem] = json.loads(path.read_text())
    return told


def numbers(value, place: str = ""):
    """Every number with its place."""
    if isinstance(value, dict):
        for key, item in value.items():
            if key not in NO_FIGURE:
                yield from numbers(item, f"{place}.{key}")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from numbers(item, f"{place}.{number}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield place, float(value)


if __name__ == "__main__":
    main()
