"""Normals on real objects: error against truth, or of predicted left-out lights, beside time and memory.

    python benchmarks/normals.py --data FOLDER [--only METHOD ...] [--objects NAME ...]

FOLDER is an object's folder or holds some. Three kinds are known by the files inside:

* light_directions.txt, light_intensities.txt, mask.png, normals_gt.npz and NNN.png: mean angular error over the mask;
* photographs and a lights.lp that names them, or <stem>.N.png with <stem>.mask.png and a lights.lp without names. Where
  the mask is a filled circle the object is taken as a sphere: angular error inside 0.95 of the radius. All others, and
  those: every eighth light is left out and predicted (psnr_db, of the linear values, peak the 99.9th percentile).

One JSON object a line. compute_s: selection and solution together, inputs in memory, compiled, best of three, all
cores; cpu_us_per_pixel: processor time of all threads a pixel. peak_rss_mb: of a process of its own for each line, with
everything it holds, the photographs included. ratio_to_default: time a pixel over the default's.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.solve import estimate_normals

CROP = 512  # pixels a side, from the middle of larger photographs
GREY = (0.2989, 0.5870, 0.1140)


def nishiki_method(select, solver, trust=False, **settings):
    """Selection then solution as the stages run them; trust: saturated samples are told, and may be chosen again."""

    def run(stack, lights, valid):
        valid = valid if trust else None
        usable = None
        if select != "none":
            usable = select_diffuse(stack, lights, method=select, valid=valid, **settings).usable
        field = estimate_normals(stack, lights, usable=usable, valid=valid, solver=solver)
        return field.normals, field.albedo

    return run


def numpy_lstsq(stack, lights, valid):
    """What a script usually does: one call of NumPy's least squares on everything."""
    b = np.linalg.lstsq(lights, stack.reshape(len(lights), -1), rcond=None)[0].T
    return split(b, stack.shape[1:])


def l1_reweighted(stack, lights, valid, rounds=10):
    """Least absolute deviations by iteratively re-weighted least squares in NumPy, the usual robust script."""
    flat = stack.reshape(len(lights), -1).astype(np.float64)
    weights = np.ones_like(flat)
    pairs = np.einsum("ja,jb->jab", lights, lights).reshape(len(lights), 9)
    for _ in range(rounds):
        matrix = (weights.T @ pairs).reshape(-1, 3, 3) + 1e-12 * np.eye(3)
        b = np.linalg.solve(matrix, ((weights * flat).T @ lights)[..., None])[..., 0]
        weights = 1 / np.maximum(np.abs(flat - lights @ b.T), 1e-4 * np.linalg.norm(b, axis=1) + 1e-12)
    return split(b, stack.shape[1:])


def split(b, shape):
    """Scaled normals as unit normals and albedo of the image's shape."""
    albedo = np.linalg.norm(b, axis=1)
    normals = b / np.maximum(albedo, 1e-12)[:, None]
    return normals.reshape(*shape, 3), albedo.reshape(shape)


METHODS = {
    "default": nishiki_method("refit", "lobe", trust=True),
    "refit": nishiki_method("refit", "least_squares", trust=True),
    "trimmed_30_70": nishiki_method("trimmed", "least_squares", keep=(0.3, 0.7)),
    "trimmed_20_80": nishiki_method("trimmed", "least_squares", keep=(0.2, 0.8)),
    "threshold": nishiki_method("threshold", "least_squares"),
    "least_squares": nishiki_method("none", "least_squares"),
    "numpy_lstsq": numpy_lstsq,
    "numpy_l1_reweighted": l1_reweighted,
}


def objects_in(folder):
    """Object folders at or directly below the given folder."""
    candidates = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    return [path for path in candidates if (path / "light_directions.txt").exists() or (path / "lights.lp").exists()]


def load(folder):
    """Stack (lights, 1, pixels) or (lights, rows, columns), lights, valid, mask, truth or None, seconds of decoding."""
    start = time.perf_counter()
    reader = load_truth if (folder / "normals_gt.npz").exists() else load_photographs
    loaded = reader(folder)
    return (*loaded, time.perf_counter() - start)


def load_truth(folder):
    """An object with calibrated lights and true normals."""
    mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    lights = np.loadtxt(folder / "light_directions.txt")
    intensities = np.loadtxt(folder / "light_intensities.txt")
    stack = np.empty((len(lights), 1, np.count_nonzero(mask)), dtype=np.float32)
    valid = np.empty(stack.shape, dtype=bool)
    names = (folder / "filenames.txt").read_text().split() if (folder / "filenames.txt").exists() else None
    for k in range(len(lights)):
        raw = read(folder / (names[k] if names else f"{k + 1:03d}.png"))[mask]
        valid[k, 0] = (raw < np.iinfo(raw.dtype).max).all(axis=-1)
        linear = raw[:, ::-1] / np.iinfo(raw.dtype).max / intensities[k]
        stack[k, 0] = np.clip(linear @ GREY, 0, 1)
    truth = np.load(folder / "normals_gt.npz")["normals"][mask][None]
    return stack, lights / np.linalg.norm(lights, axis=1, keepdims=True), valid, truth


def load_photographs(folder):
    """8-bit photographs with an .lp file; JPEG is taken as coded by sRGB, PNG as linear."""
    lines = [line.split() for line in (folder / "lights.lp").read_text().splitlines() if line.strip()][1:]
    lights = np.array([[float(value.replace(",", ".")) for value in line[-3:]] for line in lines])
    if len(lines[0]) > 3:
        files = [folder / Path(line[0]).name for line in lines]
    else:
        stem = next(folder.glob("*.mask.png")).name.removesuffix(".mask.png")
        files = [folder / f"{stem}.{k}.png" for k in range(len(lines))]
    masks = list(folder.glob("*mask*.png"))
    mask = read(masks[0]).reshape(*read(masks[0]).shape[:2], -1)[..., 0] > 0 if masks else None
    window = area(read(files[0]).shape[:2], mask)
    stack, valid = [], []
    for file in files:
        raw = read(file)[window]
        valid.append((raw < 255).all(axis=-1))
        stack.append(linear_values(raw, file.suffix.lower() in (".jpg", ".jpeg"))[..., ::-1] @ np.float32(GREY))
    stack = np.array(stack, dtype=np.float32)
    truth = None
    if mask is not None:
        truth = sphere(mask)
        truth = None if truth is None else truth[window]
        stack[:, ~mask[window]] = 0
    return stack, lights / np.linalg.norm(lights, axis=1, keepdims=True), np.array(valid), truth


def read(file):
    """An image as OpenCV gives it, or an error that names the file."""
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise SystemExit(f"cannot read {file}")
    return image


def linear_values(raw, coded):
    """0..1 float32, with the sRGB curve undone where coded."""
    levels = np.arange(256) / 255
    if coded:
        levels = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return levels.astype(np.float32)[raw]


def area(shape, mask):
    """The mask's bounding box, or the middle of a photograph that is larger than CROP."""
    if mask is not None:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        return np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    middle = [max(0, (size - CROP) // 2) for size in shape]
    return np.s_[middle[0] : middle[0] + CROP, middle[1] : middle[1] + CROP]


def sphere(mask):
    """Normals of the sphere whose outline the mask is, NaN outside 0.95 of its radius; None if it is no circle."""
    rows, columns = np.nonzero(mask)
    radius = 0.25 * (np.ptp(rows) + np.ptp(columns) + 2)
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    x = (x - 0.5 * (columns.min() + columns.max())) / radius
    y = (0.5 * (rows.min() + rows.max()) - y) / radius
    square = x * x + y * y
    if np.mean((square <= 1) != mask) > 0.01 * mask.mean():
        return None
    normals = np.dstack([x, y, np.sqrt(np.maximum(1 - square, 0))])
    normals[square > 0.95**2] = np.nan
    return normals


def measure(folder, name):
    """One line of the benchmark, in this process alone."""
    stack, lights, valid, truth, decoding = load(folder)
    method = METHODS[name]
    few = min(64, stack.shape[2])
    method(np.ascontiguousarray(stack[:, :1, :few]), lights, np.ascontiguousarray(valid[:, :1, :few]))  # compiles
    walls, processors = [], []
    for _ in range(1 if name.startswith("numpy") else 3):
        wall, processor = time.perf_counter(), time.process_time()
        normals, _ = method(stack, lights, valid)
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    pixels = stack[0].size
    line = {"object": folder.name, "method": name, "mae_deg": None, "compute_s": min(walls), "decode_s": decoding}
    line |= {"peak_rss_mb": peak, "pixels": pixels, "lights": len(lights), "us_per_pixel": min(walls) / pixels * 1e6}
    line |= {"cpu_us_per_pixel": min(processors) / pixels * 1e6, "default": name == "default"}
    if truth is not None:
        errors = angles(normals, truth)
        line |= {"mae_deg": float(errors.mean()), "median_deg": float(np.median(errors))}
    if not (folder / "normals_gt.npz").exists():
        line["psnr_db"] = left_out(stack, lights, valid, method)
    return line


def angles(normals, truth):
    """Degrees between found and true normals where there is truth."""
    known = np.isfinite(truth).all(axis=-1)
    found, truth = normals[known].astype(np.float64), truth[known].astype(np.float64)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip(np.sum(found * truth, axis=1), -1, 1)))


def left_out(stack, lights, valid, method):
    """PSNR in dB of albedo * max(n . l, 0) against every eighth light, which the fit has not seen."""
    out = np.arange(len(lights)) % 8 == 3
    kept = np.ascontiguousarray
    normals, albedo = method(kept(stack[~out]), lights[~out], kept(valid[~out]))
    inside = stack.max(axis=0) > 0
    peak = np.percentile(stack[:, inside], 99.9)
    squares, samples = 0.0, 0
    for j in np.flatnonzero(out):
        seen = inside & valid[j]
        predicted = albedo * np.maximum(normals @ lights[j], 0)
        squares += np.sum((predicted[seen] - stack[j][seen]) ** 2, dtype=np.float64)
        samples += np.count_nonzero(seen)
    return float(10 * np.log10(peak**2 / (squares / samples)))


def main():
    """Every method on every object, each pair in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--objects", nargs="+", help="names of object folders; all found without")
    parser.add_argument("--one", choices=list(METHODS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.data, arguments.one)))
        return
    folders = [path for path in objects_in(arguments.data) if not arguments.objects or path.name in arguments.objects]
    if not folders:
        raise SystemExit(f"no object with light_directions.txt or lights.lp in {arguments.data} or directly below it")
    for folder in folders:
        reference = None
        for name in arguments.only:
            command = [sys.executable, __file__, "--data", str(folder), "--one", name]
            line = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
            reference = line["us_per_pixel"] if name == "default" else reference
            line["ratio_to_default"] = line["us_per_pixel"] / reference if reference else None
            print(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in line.items()}), flush=True)


if __name__ == "__main__":
    main()
