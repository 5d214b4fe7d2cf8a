"""How far lamps measured from mirror spheres are from the truth, and whether the stated uncertainties say so.

    python benchmarks/mirror_spheres.py [--layouts 12] [--seed 100]

Every layout is random: places of the spheres, distance and turn of ten lamps of 12 mm radius, focal length. The
photographs are traced ray by ray (mirror_rays). z is an error over its stated standard deviation: root mean square 1
where the uncertainties are right.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(PROJECT / "tests"), str(PROJECT / "workflow/src")]

from mirror_rays import Scene, dome  # noqa: E402

from nishiki.calibrate.result import calibrate_spheres  # noqa: E402
from nishiki.capture.spheres.search import SphereInput  # noqa: E402

FLOOR, ROWS, COLUMNS, LAMPS = -1000.0, 520, 760, 10
CASES = {  # spheres, radius in pixels, a board as well, lamps far away
    "one, far lamps": (1, 32, False, True),
    "one, far lamps, larger": (1, 64, False, True),
    "three": (3, 37, False, False),
    "three, larger": (3, 61, False, False),
    "three and a board": (3, 37, True, False),
    "one and a board": (1, 37, True, False),
    "one and a board, larger": (1, 61, True, False),
}


def written(folder: Path, pictures) -> list[Path]:
    folder.mkdir()
    paths = [folder / f"{i:02d}.png" for i in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        cv2.imwrite(str(path), np.round(np.clip(picture, 0, 1) * 65535).astype(np.uint16))
    return paths


def board(lamps, x, y, random):
    """Photographs of a matt board in the floor's plane, shaded by the lens, with noise."""
    for lamp in lamps:
        towards = lamp - np.stack([x, y, np.full_like(x, FLOOR)], axis=-1)
        light = towards[..., 2] / np.linalg.norm(towards, axis=-1) ** 3
        yield 0.7 * light / light.max() * (1 - 0.15 * (x**2 + y**2) / x.max() ** 2) + random.normal(0, 0.005, x.shape)


def one_layout(case: str, seed: int, folder: Path) -> np.ndarray:
    """(lamps, 4): error of the direction in degrees, its z; relative error of the position, its z."""
    count, radius_px, with_board, far = CASES[case]
    random = np.random.default_rng(seed)
    focal = random.uniform(2800, 3600)
    size = radius_px / focal * -FLOOR
    reach = np.array([COLUMNS, ROWS]) / 2 / focal * -FLOOR - 2.2 * size
    turn = random.uniform(0, 2 * np.pi)
    corners = turn + 2 * np.pi * np.arange(count) / count
    places = np.column_stack([np.cos(corners), np.sin(corners)]) * reach * random.uniform(0.6, 1, (count, 1))
    spheres = [((x, y, FLOOR + size), size) for x, y in places]
    scene = Scene(spheres, rows=ROWS, columns=COLUMNS, floor=FLOOR, focal_px=focal, samples=4)
    distance = 2e4 if far else random.uniform(400, 600)
    lamps = dome(LAMPS, distance, (0, 0, 0), seed=seed, lowest_deg=20)
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    lamps = lamps @ turned.T + [0, 0, FLOOR]
    pictures = [scene.photograph(lamp, size=0.024 * distance, seed=1000 * seed + i) for i, lamp in enumerate(lamps)]
    row, column = np.mgrid[:ROWS, :COLUMNS]
    x, y = (column - (COLUMNS - 1) / 2) * -FLOOR / focal, ((ROWS - 1) / 2 - row) * -FLOOR / focal
    boards = written(folder / "board", list(board(lamps, x, y, random))) if with_board else []
    seeds = [
        ((ROWS - 1) / 2 - focal * y / (-FLOOR - size), (COLUMNS - 1) / 2 + focal * x / (-FLOOR - size), radius_px)
        for x, y in places
    ]
    result = calibrate_spheres(
        SphereInput(written(folder / "lamps", pictures), seeds, focal_px=focal, radius_mm=size, board=boards)
    )
    origin = np.array(spheres[0][0]) if count == 1 and not with_board else np.array([0, 0, FLOOR])
    truth = lamps - origin
    length = np.linalg.norm(truth, axis=1)
    out = np.full((LAMPS, 4), np.nan)
    for i, lamp in enumerate(result.numbers["lamps"]):
        angle = np.degrees(np.arccos(np.clip(np.dot(lamp["direction"], truth[i] / length[i]), -1, 1)))
        out[i, :2] = angle, angle / lamp["direction_sigma_deg"]
        if "position_mm" in lamp:
            error = np.linalg.norm(np.array(lamp["position_mm"]) - truth[i])
            out[i, 2:] = error / length[i], error / lamp["position_sigma_mm"]
    return out


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layouts", type=int, default=12)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--only", help="cases whose name begins so")
    options = parser.parse_args()
    print("case | direction mean, largest | z rms, share below 1 | position mean, largest | z rms, share below 1")
    for case in CASES:
        if not case.startswith(options.only or ""):
            continue
        rows = []
        for seed in range(options.seed, options.seed + options.layouts):
            with tempfile.TemporaryDirectory() as folder:
                rows.append(one_layout(case, seed, Path(folder)))
        angle, z, relative, zp = np.concatenate(rows).T
        line = f"{case}, {CASES[case][1]} px | {np.nanmean(angle):.3f}°, {np.nanmax(angle):.2f}°"
        line += f" | {np.sqrt(np.nanmean(z**2)):.2f}, {np.mean(z[np.isfinite(z)] < 1):.2f}"
        if np.isfinite(relative).any():
            line += f" | {100 * np.nanmean(relative):.2f} %, {100 * np.nanmax(relative):.2f} %"
            line += f" | {np.sqrt(np.nanmean(zp**2)):.2f}, {np.nanmean(zp[np.isfinite(zp)] < 1):.2f}"
            line += f" ({np.isfinite(relative).mean():.2f} of the lamps have positions)"
        print(line, flush=True)


if __name__ == "__main__":
    main()
