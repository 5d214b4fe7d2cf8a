"""Lamps that were left out, predicted: the default chain against the methods of relighting programs, in one run.

    python benchmarks/relighting.py --data FOLDER_OF_MEASURED_DATA
    python benchmarks/relighting.py --data FOLDER --only uw_cat diligent_ball-12
    python benchmarks/relighting.py --data FOLDER --only uw_cat --refine auto gloss none --no-peers

Every set is converted; some of its lamps are held out, and every method predicts the photographs under them from the
others. One JSON line a set and method: mean CIEDE2000 over all pixels of the object that the photograph shows neither
saturated nor clipped and for which the chain has an estimate (`missing`: the share that has none); mean PSNR of linear
light over the lamps, peak = the reference white; mean angular error of the normals where the set has true ones; CPU
seconds of the fit. Chain: `nishiki run` with default settings; its seconds are those of separate, normals, height and
brdf. The peers are NumPy, all samples, no masks:

    least squares   normal from the mean channel, reflectance of each channel; Woodham (1980)
    L1              the same, iteratively reweighted least absolute deviations
    PTM             biquadratic polynomial of each channel, 6 terms; Malzbender, Gelb and Wolters (2001), eq. 5
    HSH 4, HSH 9    hemispherical harmonics of each channel, 2 and 3 orders; Gautron et al. (2004), eq. 7

`diligent_*-24` and `-12` hold every fourth lamp (few rows of the grid) and the 12 nearest to the axis of the camera (a
narrow cone). Large photographs are cropped to 384 x 384 pixels.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT / "workflow/src"))

from nishiki.evaluate.camera_colour import assumed_colour  # noqa: E402
from nishiki.evaluate.maps import angular_error_deg  # noqa: E402
from nishiki.evaluate.relighting import LightComparison  # noqa: E402
from nishiki.observations.plane import Observations  # noqa: E402

CROPS = {"rti_fossil": ("1088", "1856", "384", "384"), "rti_marble": ("600", "1000", "384", "384")}
SMALL = ("uw_gray", "uw_cat", "uw_owl", "uw_horse", "psbox_cat")
DILIGENT = ("diligent_ball", "diligent_cat")
SETS = (*DILIGENT, *(f"{name}-{count}" for name in DILIGENT for count in (24, 12)), *SMALL, *CROPS)
FOLDS = 2  # of the sets with 12 lamps
COMPARED = ("least squares", "L1", "PTM", "HSH 4", "HSH 9")
STAGES = ("separate", "normals", "height", "brdf")


def nishiki(folder: Path, *arguments: str) -> None:
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


def capture_of(data: Path, folder: Path, name: str) -> Path:
    """The sealed capture of a set, converted where it does not exist yet."""
    capture = folder / "captures" / name
    if not capture.exists():
        capture.parent.mkdir(parents=True, exist_ok=True)
        source, _, count = name.partition("-")
        place = data / source
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            if count:
                place = subset(place, Path(scratch), int(count))
            crop = ("--roi", *CROPS[source]) if source in CROPS else ()
            nishiki(folder, "convert", str(place), str(capture), *crop)
    return capture


def subset(source: Path, folder: Path, count: int) -> Path:
    """A DiLiGenT set with `count` lamps to fit and a few to leave out: 24 spread, or 12 in a narrow cone."""
    directions = np.loadtxt(source / "light_directions.txt")
    if count == 24:
        chosen = np.union1d(np.arange(0, 96, 4), np.arange(2, 96, 8))
    else:
        chosen = np.sort(np.argsort(-directions[:, 2])[: count + 3])
    for k in chosen:
        shutil.copy(source / f"{k + 1:03d}.png", folder)
    for file in ("light_directions.txt", "light_intensities.txt"):
        lines = (source / file).read_text().splitlines()
        (folder / file).write_text("\n".join(lines[k] for k in chosen) + "\n")
    shutil.copy(source / "mask.png", folder)
    return folder


def held_out(name: str, lights: tuple[str, ...]) -> list[list[str]]:
    """Lamps left out, a list a fold."""
    if name.endswith("-24"):
        return [[light for light in lights if (int(light) - 1) % 8 == 2]]
    if name.endswith("-12"):
        return [list(lights[2::5])]
    if len(lights) > 16:
        return [list(lights[::8])]
    return [list(lights[fold::8]) for fold in range(FOLDS)]


def run_chain(folder: Path, capture: Path, lamps: list[str], truth: Path | None, refine: str) -> tuple[Path, float]:
    """The folder of the current results after a run from nothing, and the CPU seconds of the stages that fit.

    refine : setting of the stage normals, whether normals and gloss are fitted together.
    """
    work = Path(tempfile.mkdtemp(dir=folder))
    (work / "scenes.tsv").write_text(f"scene\tcapture\ttruth\none\t{capture}\t{truth or ''}\n")
    settings = {"scenes": "scenes.tsv", "products": ["evaluate"], "hold_out": lamps}
    settings["normals"] = {"refine": refine}
    (work / "config.yaml").write_text(yaml.safe_dump(settings))
    nishiki(work, "run", "--configfile", "config.yaml", "--cores", "1")
    current = work / "results/one/current"
    runs = [json.loads((current / s / "run.json").read_text()) for s in STAGES if (current / s).is_dir()]
    return current, sum(run["cpu_seconds"] for run in runs)


def least_squares(stack, lights, channels):
    """Lambert: normal (pixels, 3), reflectance (pixels, channels) from stack (lights, pixels), channels (..., C)."""
    scaled = np.linalg.lstsq(lights, stack, rcond=None)[0].T
    return reflect(scaled, lights, channels)


def least_absolute(stack, lights, channels, rounds=20):
    """The same, minimising the sum of absolute residuals."""
    scaled = np.linalg.lstsq(lights, stack, rcond=None)[0]
    least = 1e-4 * np.abs(stack).mean() + 1e-12
    for _ in range(rounds):
        weight = 1 / np.maximum(np.abs(stack - lights @ scaled), least)
        matrix = np.einsum("lp,li,lj->pij", weight, lights, lights)
        scaled = np.linalg.solve(matrix, np.einsum("lp,lp,li->pi", weight, stack, lights)[..., None])[..., 0].T
    return reflect(scaled.T, lights, channels)


def reflect(scaled, lights, channels):
    """Unit normals, and the reflectance of each channel by least squares."""
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    normals = np.divide(scaled, length, out=np.tile([0.0, 0.0, 1.0], (len(scaled), 1)), where=length > 0)
    shading = np.maximum(lights @ normals.T, 0)
    reflectance = np.einsum("lp,lpc->pc", shading, channels) / np.maximum((shading**2).sum(0), 1e-9)[:, None]
    return normals, reflectance


def polynomial(lights):
    """(lights, 6) terms of a polynomial texture map."""
    u, v = lights[:, 0], lights[:, 1]
    return np.stack([u * u, v * v, u * v, u, v, np.ones_like(u)], axis=1)


def harmonics(lights, terms):
    """(lights, terms) hemispherical harmonics, 4 or 9."""
    z, azimuth = np.clip(lights[:, 2], 0, 1), np.arctan2(lights[:, 1], lights[:, 0])
    root = np.sqrt(np.maximum(z - z * z, 0))
    columns = [
        np.full_like(z, 1 / np.sqrt(2 * np.pi)),
        np.sqrt(6 / np.pi) * np.cos(azimuth) * root,
        np.sqrt(1.5 / np.pi) * (2 * z - 1),
        np.sqrt(6 / np.pi) * np.sin(azimuth) * root,
        np.sqrt(30 / np.pi) * np.cos(2 * azimuth) * (z * z - z),
        np.sqrt(30 / np.pi) * np.cos(azimuth) * (2 * z - 1) * root,
        np.sqrt(2.5 / np.pi) * (1 - 6 * z + 6 * z * z),
        np.sqrt(30 / np.pi) * np.sin(azimuth) * (2 * z - 1) * root,
        np.sqrt(30 / np.pi) * np.sin(2 * azimuth) * (z * z - z),
    ]
    return np.stack(columns[:terms], axis=1)


def predictions(method, channels, lights, targets):
    """(targets, pixels, C) predicted photographs, and the normals (pixels, 3) where the method has them."""
    if method in ("least squares", "L1"):
        solve = least_squares if method == "least squares" else least_absolute
        normals, reflectance = solve(channels.mean(axis=-1), lights, channels)
        return np.maximum(targets @ normals.T, 0)[..., None] * reflectance, normals
    terms = polynomial if method == "PTM" else lambda vectors: harmonics(vectors, int(method.split()[1]))
    pixels = channels.shape[1:]
    weights = np.linalg.pinv(terms(lights)) @ channels.reshape(len(lights), -1)
    return np.maximum(terms(targets) @ weights, 0).reshape(-1, *pixels), None


def score(frames: Observations, predicted: dict[int, np.ndarray], known: np.ndarray) -> tuple[float, int, list[float]]:
    """Sum of CIEDE2000 and number of pixels, and the PSNR of each lamp; predicted: (pixels of the mask, C) by lamp."""
    total, count, psnr = 0.0, 0, []
    for j, values in predicted.items():
        comparison = LightComparison.of(frames.shape, assumed_colour(len(frames.channels)))
        picture = np.zeros((*frames.shape, len(frames.channels)), np.float32)
        picture[frames.mask] = values
        for rows in frames.bands():
            observed, valid = frames.read(rows, lights=np.array([j]))
            comparison.add(
                rows, picture[rows], observed[0], usable=valid[0], known=known[rows], inside=frames.mask[rows],
                classes=frames.mask[rows].astype(np.uint8),
            )  # fmt: skip
        seen = comparison.classes > 0
        total, count = total + float(comparison.de00_map[seen].sum(dtype=np.float64)), count + int(seen.sum())
        psnr.append(comparison.score()["psnr_linear_db"])
    return total, count, psnr


def of_chain(current: Path) -> dict:
    """Figures that the chain's own evaluation wrote."""
    found = json.loads((current / "evaluate/evaluation.json").read_text())
    lights = found["lights"]
    count = sum(light["de00"]["count"] for light in lights)
    return {
        "sum": sum(light["de00"]["mean"] * light["de00"]["count"] for light in lights),
        "count": count,
        "missing": sum(light["excluded"].get("no_estimate", 0) for light in lights) / count,
        "psnr": [light["psnr_linear_db"] for light in lights],
        "normals": ((found["normals"] or {}).get("inside") or {}).get("mean"),
    }


def known_pixels(current: Path) -> np.ndarray:
    """Pixels of which the chain has normals: the others are left out for all."""
    from nishiki.artifacts.maps import Maps
    from nishiki.photometric.flags import NO_ESTIMATE

    return (Maps(current / "normals").read("flags") & NO_ESTIMATE) == 0


def measure(data: Path, folder: Path, name: str, refine: list[str], peers: tuple[str, ...]) -> None:
    """Print the lines of one set."""
    capture = capture_of(data, folder, name)
    truth = data / name.partition("-")[0] / "normals_gt.npz"
    truth = truth if truth.is_file() else None
    table = (capture / "data/frames.csv").read_text().splitlines()
    column = table[0].split(",").index("light")
    lights = tuple(line.split(",")[column] for line in table[1:])
    chains = {"default" if setting == "auto" else f"refine: {setting}": setting for setting in refine}
    rows = {method: {"sum": 0.0, "count": 0, "psnr": [], "angles": [], "cpu": []} for method in (*chains, *peers)}
    folds = held_out(name, lights)
    for lamps in folds:
        for method, setting in chains.items():
            current, seconds = run_chain(folder, capture, lamps, truth, setting)
            chain = of_chain(current)
            rows[method]["cpu"].append(seconds)
            for key in ("sum", "count", "psnr"):
                rows[method][key] += chain[key]
            rows[method].setdefault("missing", chain["missing"])
            rows[method]["angles"] += [chain["normals"]] if chain["normals"] is not None else []
        frames = Observations(current / "ingest")
        fit, targets = frames.fit_lights(lamps), frames.check_lights(lamps)
        channels = np.concatenate([frames.read(band)[0][:, frames.mask[band]] for band in frames.bands()], axis=1)
        known = known_pixels(current)
        for method in peers:
            start = time.process_time()
            found, normals = predictions(
                method, channels[fit].astype(np.float64), frames.directions[fit], frames.directions[targets]
            )
            rows[method]["cpu"].append(time.process_time() - start)
            total, count, psnr = score(frames, dict(zip(targets.tolist(), found, strict=True)), known)
            rows[method]["sum"] += total
            rows[method]["count"] += count
            rows[method]["psnr"] += psnr
            if normals is not None and truth is not None:
                true = np.load(truth)["normals"][frames.mask]
                rows[method]["angles"].append(float(np.nanmean(angular_error_deg(normals, true))))
    for method, row in rows.items():
        line = {
            "set": name, "lamps": len(lights) - len(folds[0]), "method": method,
            "de00": round(row["sum"] / row["count"], 3), "psnr_db": round(float(np.mean(row["psnr"])), 2),
            "normals_deg": round(float(np.mean(row["angles"])), 3) if row["angles"] else None,
            "cpu_s": round(float(np.mean(row["cpu"])), 2),
            "missing": round(row["missing"], 4) if method in chains else None, "default": method == "default",
        }  # fmt: skip
        print(json.dumps(line), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, type=Path, help="folder of the measured sets")
    parser.add_argument("--only", nargs="+", choices=SETS, default=SETS)
    parser.add_argument("--refine", nargs="+", choices=("auto", "gloss", "none"), default=["auto"])
    parser.add_argument("--no-peers", action="store_true", help="the chain alone")
    parser.add_argument("--work", type=Path, help="keep captures and results here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (options.work or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for item in options.only:
            if (options.data / item.partition("-")[0]).is_dir():
                measure(options.data.resolve(), folder, item, options.refine, () if options.no_peers else COMPARED)
            else:
                print(f"{item}: not in {options.data}", file=sys.stderr)


if __name__ == "__main__":
    main()
