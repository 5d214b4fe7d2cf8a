"""Flat paintings under near lamps without white boards: error of the height with and without `height.flatten`.

    python benchmarks/flatten.py [--group chosen_on | unseen | far | trays ...]

Captures are simulated, 144 x 192 pixels of 0.5 mm; the white boards are taken away, and the stated lamp directions get
random errors. Both variants run through `nishiki run`, so that the figures are those a user gets. One JSON object a
line: lamps_half_diagonals: distance of the lamps; lamps_wrong_deg: standard deviation of their stated directions along
each axis; rms_mm and relief_mm: of the height's error and of the relief, less a plane; bow and flattened_deg: as the
stage says.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

PROJECT = Path(__file__).resolve().parents[1]
ROWS, COLUMNS, PITCH_MM = 144, 192, 0.5
HALF_DIAGONAL_MM = 0.5 * PITCH_MM * np.hypot(ROWS, COLUMNS)
FINISHES = {
    "chosen_on": [(3, "impasto", "satin"), (4, "canvas", "matte")],
    "unseen": [(11, "impasto", "varnish"), (12, "canvas", "satin"), (13, "impasto", "matte")],
    "far": [(14, "impasto", "satin"), (15, "canvas", "matte")],
    "trays": [(21, "impasto", "matte"), (22, "impasto", "matte")],
}
LAMPS = {
    "chosen_on": [(2.5, 1), (4, 2), (8, 3)],
    "unseen": [(2.2, 3), (3, 1), (5, 2)],
    "far": [(20, 2), (79, 3)],
    "trays": [(3, 2)],
}
"""Distance in half diagonals of the picture, and error of the directions in degrees."""


def nishiki(folder: Path, *arguments) -> None:
    """Run the command line in a folder; its messages are shown only where it fails."""
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "workflow/src")}
    command = [sys.executable, "-m", "nishiki", *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)


def make_capture(folder: Path, name: str, finish: tuple, distance: float, error_deg: float, scene: str) -> None:
    """A sealed capture `name` without white boards and with lamps that are not quite where the table says."""
    seed, relief, gloss = finish
    size = ["--rows", ROWS, "--columns", COLUMNS, "--pitch-mm", PITCH_MM, "--scene", scene, "--checks"]
    look = ["--seed", seed, "--relief", relief, "--gloss", gloss]
    lamps = ["--distance-mm", distance * HALF_DIAGONAL_MM, "--rings", 2, "--ring-lights", 12]
    nishiki(folder, "simulate", "--output", "made", "--truth", f"{name}-truth", *size, *look, *lamps)
    data = (folder / "made/data").rename(folder / name)
    shutil.rmtree(folder / "made")
    shutil.rmtree(data / "white")
    settings = yaml.safe_load((data / "capture.yaml").read_text())
    del settings["white"]
    (data / "capture.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    frames = (data / "frames.csv").read_text().splitlines()
    (data / "frames.csv").write_text("\n".join(row for row in frames if not row.startswith("white/")) + "\n")
    random = np.random.default_rng(seed * 100 + int(10 * distance))
    count, *rows = (data / "lights.lp").read_text().splitlines()
    for index, row in enumerate(rows):
        light, *direction = row.split()
        direction = np.array(direction, float)
        direction = direction / np.linalg.norm(direction) + random.normal(0, np.radians(error_deg), 3)
        direction /= np.linalg.norm(direction)
        rows[index] = " ".join([light, *(f"{value:.6f}" for value in direction)])
    (data / "lights.lp").write_text("\n".join([count, *rows]) + "\n")
    nishiki(folder, "seal", data)


def run_group(folder: Path, group: str) -> None:
    """Make the captures of a group, run both variants of each, print a line a variant."""
    (folder / "flat.yaml").write_text("height: {flatten: true}\n")
    table, scenes = ["scene\tcapture\ttruth\tproducts\tsettings"], {}
    kind = "spheres" if group == "trays" else "painting"
    for finish in FINISHES[group]:
        for distance, error_deg in LAMPS[group]:
            name = f"{group}-{finish[0]}-{distance:g}".replace(".", "p")
            make_capture(folder, name, finish, distance, error_deg, kind)
            for flatten in (False, True):
                scenes[f"{name}-{flatten}"] = (finish, distance, error_deg, flatten)
                table.append(f"{name}-{flatten}\t{name}\t{name}-truth\tevaluate\t{'flat.yaml' * flatten}")
    (folder / "scenes.tsv").write_text("\n".join(table) + "\n")
    (folder / "config.yaml").write_text("scenes: scenes.tsv\n")
    nishiki(folder, "run", "--configfile", "config.yaml")
    for scene, (finish, distance, error_deg, flatten) in scenes.items():
        current = folder / "results" / scene / "current"
        evaluation = json.loads((current / "evaluate/evaluation.json").read_text())
        height = json.loads((current / "height/artifact.json").read_text())["diagnostics"]
        line = {
            "group": group,
            "seed, relief, gloss": finish,
            "lamps_half_diagonals": distance,
            "lamps_wrong_deg": error_deg,
            "flatten": flatten,
            "rms_mm": round(evaluation["height"]["rms"], 4),
            "relief_mm": round(evaluation["height"]["relief_rms"], 4),
            "bow": round(height["bow"], 4),
            "flattened_deg": round(height["flattened_deg"], 2),
        }
        print(json.dumps(line), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--group", nargs="+", choices=FINISHES, default=list(FINISHES), help="all by default")
    options = parser.parse_args()
    for group in options.group:
        with tempfile.TemporaryDirectory() as folder:
            run_group(Path(folder), group)


if __name__ == "__main__":
    main()
