"""Cut a capture of a plane under distant lamps into overlapping fields, as a camera on a stage photographs them.

    python benchmarks/cut_mosaic.py --capture FOLDER --output FOLDER [--grid 2 2] [--overlap 0.2] [--seed 1]
        [--region COLUMN ROW COLUMNS ROWS]

Every photograph is resampled into every field: with an error of the stage's position, a turn of up to 1 degree, a scale
that is wrong by up to 0.2 %, and the barrel distortion of a lens (the FOV model: F. Devernay and O. Faugeras, 2001).
The lamps stand still over the painting, so that their directions turn in the camera's frame. `fields.csv` states the
positions with their errors; the truth is written beside the folder, to OUTPUT-truth.json.
"""

import argparse
import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import yaml

from nishiki.capture.seal import seal

TURN_DEG, SCALE, POSITION_PX, BARREL = 1.0, 0.002, 12.0, 0.2
"""Largest turn, change of scale and error of position of a field; angle of view of the FOV model at the corner."""


def place_fields(shape: tuple[int, int], grid: tuple[int, int], overlap: float, seed: int) -> list[dict]:
    """Place fields so that all lie within a picture of this shape (rows, columns).

    Returns the fields by rows of the grid: name, shape, centre (column, row), stated (the same with the stage's error),
    turn in radians from columns to rows, scale (pixels of the picture to one of the field), barrel in radians.
    """
    random = np.random.default_rng(seed)
    size, places = [], []
    for extent, count in zip(shape, grid, strict=True):
        side = extent / (1 + (count - 1) * (1 - overlap))
        inner = int(side * 0.96 - 2 * POSITION_PX)  # room for turns, distortion and wrong positions
        size.append(inner)
        first = (extent - 1) / 2 - (count - 1) / 2 * (1 - overlap) * inner
        places.append(first + np.arange(count) * (1 - overlap) * inner)
    fields = []
    for row, y in enumerate(places[0]):
        for column, x in enumerate(places[1]):
            stated = np.array([x, y])
            fields.append(
                {
                    "name": f"{chr(97 + row)}{column + 1}",
                    "shape": size,
                    "stated": stated.tolist(),
                    "centre": (stated + random.uniform(-POSITION_PX, POSITION_PX, 2)).tolist(),
                    "turn": float(np.radians(random.uniform(-TURN_DEG, TURN_DEG))),
                    "scale": float(1 + random.uniform(-SCALE, SCALE)),
                    "barrel": BARREL,
                }
            )
    return fields


def picture_places(field: dict, points: np.ndarray) -> np.ndarray:
    """Return where in the picture (column, row) points (..., 2) of a field lie."""
    rows, columns = field["shape"]
    reach = np.hypot(rows, columns) / 2
    plane = points - np.array([(columns - 1) / 2, (rows - 1) / 2])
    angle = np.linalg.norm(plane, axis=-1, keepdims=True) / reach * field["barrel"]
    plane = plane * np.where(angle > 0, np.tan(angle) / np.maximum(angle, 1e-12), 1) * field["scale"]
    cosine, sine = np.cos(field["turn"]), np.sin(field["turn"])
    turned = np.stack(
        [cosine * plane[..., 0] - sine * plane[..., 1], sine * plane[..., 0] + cosine * plane[..., 1]], -1
    )
    return turned + field["centre"]


def cut(picture: np.ndarray, field: dict, full: int) -> np.ndarray:
    """Resample a picture (rows, columns, channels) of codes up to `full` into a field; what is saturated stays so."""
    grid = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in field["shape"][::-1])), -1)
    places = picture_places(field, grid).astype(np.float32)
    codes = np.minimum(cv2.remap(picture, places, None, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT), full)
    hot = cv2.dilate((picture >= 0.98 * full).astype(np.uint8), np.ones((3, 3), np.uint8))
    codes[cv2.remap(hot * np.uint8(255), places, None, cv2.INTER_LINEAR) > 0] = full
    return codes


def turn_lamps(text: str, turn: float) -> str:
    """Return an .lp file whose directions are turned into the frame of a field."""
    first, *rest = text.strip().splitlines()
    cosine, sine, lines = np.cos(turn), np.sin(turn), [first]
    for line in rest:
        name, x, y, z = line.rsplit(maxsplit=3)
        turned = cosine * float(x) - sine * float(y), sine * float(x) + cosine * float(y)
        lines.append(f"{name} {turned[0]:.6f} {turned[1]:.6f} {z}")
    return "\n".join(lines) + "\n"


def cut_capture(
    capture: Path, output: Path, *, grid: tuple[int, int], overlap: float, seed: int, region: list[int] | None = None
) -> list[dict]:
    """Write the fields of a capture, sealed, and return them; region: column, row, columns, rows of the photographs."""
    source = capture / "data" if (capture / "data").is_dir() else capture
    described = yaml.safe_load((source / "capture.yaml").read_text())
    with (source / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))

    def photograph(name: str) -> np.ndarray:
        picture = cv2.imread(str(source / name), cv2.IMREAD_UNCHANGED)
        left, top, columns, height = region or (0, 0, picture.shape[1], picture.shape[0])
        return picture[top : top + height, left : left + columns]

    fields = place_fields(photograph(rows[0]["file"]).shape[:2], grid, overlap, seed)
    pitch, full = described.get("pixel_pitch_mm"), 2 ** described["camera"].get("bits", 8) - 1
    for field in fields:
        folder = output / "fields" / field["name"]
        folder.mkdir(parents=True)
        (folder / "capture.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
        lamps = described["lights"]["file"]
        (folder / lamps).write_text(turn_lamps((source / lamps).read_text(), field["turn"]))
        if (source / "spectra").is_dir():
            shutil.copytree(source / "spectra", folder / "spectra")
    for row in rows:
        picture, name = photograph(row["file"]), str(Path(row["file"]).with_suffix(".png"))
        for field in fields:
            target = output / "fields" / field["name"] / name
            target.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(target), cut(picture, field, full), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        row["file"] = name
    lines = ["field,path,x_mm,y_mm"]
    for field in fields:
        folder = output / "fields" / field["name"]
        with (folder / "frames.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            table.writeheader()
            table.writerows(rows)
        seal(folder)
        x, y = field["stated"]
        stated = f"{x * pitch:.3f},{-y * pitch:.3f}" if pitch else ","
        lines.append(f"{field['name']},fields/{field['name']},{stated}")
    (output / "fields.csv").write_text("\n".join(lines) + "\n")
    output.with_name(output.name + "-truth.json").write_text(json.dumps(fields, indent=1) + "\n")
    return fields


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", required=True, type=Path)
    parser.add_argument("--output", required=True, type=Path, help="folder to make")
    parser.add_argument("--grid", nargs=2, type=int, default=(2, 2), metavar=("ROWS", "COLUMNS"))
    parser.add_argument("--overlap", type=float, default=0.2, help="share of a field that the next one shows too")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--region", nargs=4, type=int, help="column, row, columns and rows of the photographs")
    options = parser.parse_args()
    cut_capture(
        options.capture,
        options.output,
        grid=tuple(options.grid),
        overlap=options.overlap,
        seed=options.seed,
        region=options.region,
    )


if __name__ == "__main__":
    main()
