"""Spectral reflectance: error on spectra that the estimator was not trained on, and time per pixel.

    python benchmarks/spectra.py --data FOLDER [--camera NAME] [--quick] [--library]

FOLDER (or FOLDER/spectra) is searched for what it holds, whatever the names: camera files (a name line, then one line
of 33 values 400-720/10 nm a channel), illuminants (`*.spd`: nm, power), reflectance sets (`*.npz` with `wavelengths`
and `reflectance`, or `*.csv` whose first line is the wavelengths), Kubelka-Munk pigment tables (quoted name, K then S,
with the wavelengths in `spectra.txt` beside it), paints by maker (`*.rs`: quoted name, then 36 values 380-730/10 nm).
One JSON object a line; `"default": true` marks the default settings. `--makers` measures the makers' paints alone:
every method on every maker, the share of truth inside the error band, and training on the other makers' paints. Each
maker's paints are measured as they are and mixed with each other ("mixed": Kubelka-Munk below a smooth surface).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_from_spectra, xyz_to_lab
from nishiki.colour.estimate import estimate_spectra, fit_estimator
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights, resample, under_one_lamp
from nishiki.colour.training import synthetic_reflectances

DIFFERENCE_LIGHTS = (("", "D65"), ("_A", "A"), ("_F11", "FL11"))
LEAST_MIXED = 9  # paints of a maker that are mixed with each other
CONCENTRATIONS = (1.0, 0.6, 0.3, 0.15, 0.07, 0.03)


def read_cameras(folder: Path) -> dict[str, np.ndarray]:
    """Sensitivities (N, 61) by camera name, from every text file of that shape below the folder."""
    cameras: dict[str, np.ndarray] = {}
    for path in sorted(folder.rglob("*.txt")):
        name = None
        blocks: dict[str, list[list[float]]] = {}
        for line in path.read_text(errors="replace").splitlines():
            try:
                values = [float(word) for word in line.split()]
            except ValueError:
                name = line.strip()
                continue
            if name and len(values) == 33:
                blocks.setdefault(name, []).append(values)
        grid = np.arange(400.0, 721.0, 10.0)
        cameras.update({key: resample(grid, np.array(rows), name=key) for key, rows in blocks.items()})
    return cameras


def read_illuminants(folder: Path) -> dict[str, np.ndarray]:
    """Spectral power (61,) by the last word of the file name, `cie.stdillum.F11.spd` -> `F11`."""
    found = {}
    for path in sorted(folder.rglob("*.spd")):
        table = np.loadtxt(path)
        found[path.stem.split(".")[-1]] = resample(table[:, 0], table[:, 1], name=path.name)
    return found


def read_reflectances(folder: Path) -> dict[str, np.ndarray]:
    """Reflectance sets (M, 61) by file name without its ending; a csv is read where no npz of the same name exists."""
    found = {}
    for path in sorted(folder.rglob("*.npz")):
        with np.load(path, allow_pickle=False) as arrays:
            if {"wavelengths", "reflectance"} <= set(arrays.files):
                found[path.stem] = resample(arrays["wavelengths"], arrays["reflectance"], name=path.name)
    for path in sorted(folder.rglob("*.csv")):
        if path.stem not in found:
            rows = [[float(word) for word in line.split(",") if word.strip()] for line in path.open() if line.strip()]
            found[path.stem] = resample(np.array(rows[0]), np.array(rows[1:]), name=path.name)
    return found


def read_paints(folder: Path) -> dict[str, np.ndarray]:
    """Reflectances (M, 61) of every paint of a Kubelka-Munk table, pure and let down with its first (white) paint."""
    found = {}
    for path in sorted(folder.rglob("*.txt")):
        axis = path.with_name("spectra.txt")
        lines = [line for line in path.read_text(errors="replace").splitlines() if line.startswith('"')]
        if not lines or not axis.is_file():
            continue
        wavelengths = np.array(axis.read_text().split(), dtype=float)
        pairs = [np.array(line.split('"')[2].split(), dtype=float).reshape(2, -1) for line in lines]
        found[path.stem] = resample(wavelengths, _let_down(pairs), name=path.name)
    return found


def read_makers(folder: Path) -> dict[str, np.ndarray]:
    """Reflectances (M, 61) by maker, from every `*.rs` file below the folder; lines of another length are left out."""
    grid = np.arange(380.0, 731.0, 10.0)
    found = {}
    for path in sorted(folder.rglob("*.rs")):
        lines = [line.rsplit('"', 1)[-1].split() for line in path.read_text(errors="replace").splitlines()]
        rows = [[float(word) for word in words] for words in lines if len(words) == grid.size]
        if rows:
            found[path.stem] = resample(grid, np.array(rows), name=path.name)
    return found


def _let_down(pairs: list[np.ndarray]) -> np.ndarray:
    """Kubelka-Munk reflectance of infinitely thick mixtures of each paint (2, W) with the first."""
    spectra = []
    for index, paint in enumerate(pairs):
        for share in CONCENTRATIONS if index else (1.0,):
            absorption, scattering = share * paint + (1.0 - share) * pairs[0]
            ratio = absorption / scattering
            spectra.append(1.0 + ratio - np.sqrt(ratio**2 + 2.0 * ratio))
    return np.array(spectra)


def mixed_paints(spectra: np.ndarray, count: int = 200, *, index: float = 1.5, seed: int = 0) -> np.ndarray:
    """(count, 61) mixtures of one to three paints (M, 61) with the lightest of them, as seen through their surface.

    Measured reflectances are taken below the surface and back (Saunderson, J. Opt. Soc. Am. 32, 1942), and mixed there
    by Kubelka and Munk's law with scattering alike, so that a maker's white tints the maker's own pigments.
    """
    outside = ((index - 1) / (index + 1)) ** 2
    inside = 1 - (1 - 0.0918) / index**2  # diffuse light; 0.0918: Lusher's value for light from outside, index 1.5
    measured = np.clip(spectra, 0.005, 0.97)
    below = np.clip(measured / ((1 - outside) * (1 - inside) + inside * measured), 0.004, 0.985)
    ratio = (1 - below) ** 2 / (2 * below)
    white, rng = ratio.mean(axis=1).argmin(), np.random.default_rng(seed)
    shares = np.zeros((count, len(ratio)))
    for row in shares:
        paints = rng.choice(len(ratio), size=min(len(ratio), rng.choice([1, 1, 2, 3])), replace=False)
        row[paints] = rng.dirichlet(np.ones(len(paints)))
        tint = 0.0 if rng.random() < 0.25 else rng.uniform(0.1, 0.97)
        row *= 1 - tint
        row[white] += tint
    mixed = shares @ ratio
    body = 1 / (1 + mixed + np.sqrt(mixed**2 + 2 * mixed))
    return (1 - outside) * (1 - inside) * body / (1 - inside * body)


def locally_weighted(training, weights, responses, *, neighbours=40):
    """The locally weighted linear estimator of the literature, the obvious way: one small regression a pixel."""
    seen = training @ weights.T
    roots, scale = np.sqrt(seen), np.sqrt(seen).std(axis=0)
    out = np.empty((len(responses), training.shape[1]))
    for i, response in enumerate(responses):
        apart = np.sum(((roots - np.sqrt(np.maximum(response, 0.0))) / scale) ** 2, axis=1)
        width = np.partition(apart, neighbours)[neighbours]
        weight = np.exp(-apart / width)
        gram = (seen * weight[:, None]).T @ seen + 1e-6 * weight.sum() * np.eye(seen.shape[1])
        out[i] = response @ np.linalg.solve(gram, (seen * weight[:, None]).T @ training)
    return out


def pseudo_inverse(training, weights, responses):
    """Least-squares regression of training spectra on training responses."""
    return responses @ (np.linalg.pinv(training @ weights.T) @ training)


def library_recovery(training, weights, responses, *, colour_of):
    """colour-science's ready-made recovery from linear sRGB: Mallett and Yuksel 2019. It knows no camera."""
    import colour

    spectra = np.empty((len(responses), WAVELENGTHS_NM.size))
    shape = colour.SpectralShape(400, 700, 5)
    basis = colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019.copy().align(shape)
    for i, rgb in enumerate(colour_of(responses)):
        spectra[i] = colour.recovery.RGB_to_sd_Mallett2019(rgb, basis_functions=basis).values
    return spectra


def scores(found: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Spectral and colour errors of estimates (M, 61)."""
    rmse = np.sqrt(np.mean((found - truth) ** 2, axis=1))
    result = {"rmse_mean": rmse.mean(), "rmse_p95": np.percentile(rmse, 95)}
    for suffix, name in DIFFERENCE_LIGHTS:
        lamp = illuminant(name)
        white = white_xyz(lamp)
        lab = [xyz_to_lab(xyz_from_spectra(lamp, spectra), white) for spectra in (found, truth)]
        difference = delta_e_2000(*lab)
        result[f"de00_mean{suffix}"] = difference.mean()
        result[f"de00_p90{suffix}"] = np.percentile(difference, 90)
    return {key: round(float(value), 5) for key, value in result.items()}


def splits(sets: dict[str, np.ndarray]):
    """(name, training, test) triples: halves by index and two random halves of each set."""
    for name, spectra in sets.items():
        order = np.arange(len(spectra))
        yield f"{name}[0::2]", spectra[0::2], f"{name}[1::2]", spectra[1::2]
        yield f"{name}[1::2]", spectra[1::2], f"{name}[0::2]", spectra[0::2]
        for seed in (1, 2):
            order = np.random.default_rng(seed).permutation(len(spectra))
            half = len(order) // 2
            yield f"{name}[random {seed}a]", spectra[order[:half]], f"{name}[random {seed}b]", spectra[order[half:]]


def time_per_pixel(estimator, responses, *, repeats=5) -> tuple[float, float]:
    """Best elapsed and processor microseconds a pixel: an image of patches, everything in memory, compiled before."""
    rng = np.random.default_rng(0)
    patches = responses[rng.integers(0, len(responses), 500)]
    image = np.repeat(patches, 800, axis=0) * rng.uniform(0.98, 1.02, (400_000, 1))
    image = image.astype(np.float32)
    estimate_spectra(image, estimator)
    times = []
    for _ in range(repeats):
        start, busy = time.perf_counter(), time.process_time()
        estimate_spectra(image, estimator)
        times.append((time.perf_counter() - start, time.process_time() - busy))
    elapsed, processor = np.min(times, axis=0) / len(image) * 1e6
    return round(float(elapsed), 4), round(float(processor), 4)


def lines_of_case(case, *, with_library, timed):
    """Every method on one training set, test set, camera and lamp; noise-free and with 0.5 % noise of two kinds."""
    weights = channel_weights(case["lamp"], case["camera"])
    training, truth = case["training"], case["truth"]
    exact = truth @ weights.T
    rng = np.random.default_rng(7)
    observed = {
        "none": exact,
        "0.005 of white": exact + 0.005 * rng.standard_normal(exact.shape),
        "0.5 % of signal": exact * (1.0 + 0.005 * rng.standard_normal(exact.shape)),
    }
    fitted = {
        "paper as printed": fit_estimator(training, case["lamp"], case["camera"], method="paper", white_width=0.0),
        "paper": fit_estimator(training, case["lamp"], case["camera"], method="paper"),
        "wiener": fit_estimator(training, case["lamp"], case["camera"], method="wiener"),
        "local": fit_estimator(training, case["lamp"], case["camera"]),
    }
    for method, estimator in fitted.items():
        speed, processor = time_per_pixel(estimator, exact) if timed else (None, None)
        for noise, responses in observed.items():
            found = estimate_spectra(responses, estimator).spectra()
            yield {"method": method, "noise": noise, **scores(found, truth), "cond": round(estimator.condition, 4),
                   "us_per_pixel": speed, "cpu_us_per_pixel": processor, "bases": len(estimator.basis),
                   "default": method == "local"}  # fmt: skip
    others = {"least squares (pinv)": pseudo_inverse, "locally weighted linear": locally_weighted}
    if with_library:
        others["colour-science Mallett2019"] = lambda t, w, r: library_recovery(t, w, r, colour_of=_srgb_of(t, w))
    for method, function in others.items():
        for noise, responses in observed.items():
            start = time.perf_counter()
            found = function(training, weights, responses)
            speed = (time.perf_counter() - start) / len(responses) * 1e6
            yield {"method": method, "noise": noise, **scores(found, truth), "cond": None,
                   "us_per_pixel": round(speed, 2), "default": False}  # fmt: skip


def lines_of_makers(makers, camera, lamp, munsell, *, others):
    """Each method on the paints of each maker; sigma against error. The three bases of Munsell are the reference."""
    weights = channel_weights(lamp, camera)
    own = synthetic_reflectances()
    fitted = {
        ("paper", "Munsell"): fit_estimator(munsell, lamp, camera, method="paper"),
        ("wiener", "Munsell"): fit_estimator(munsell, lamp, camera, method="wiener"),
        ("local", "Munsell"): fit_estimator(munsell, lamp, camera),
        ("paper", "synthetic (shipped)"): fit_estimator(own, lamp, camera, method="paper"),
        ("wiener", "synthetic (shipped)"): fit_estimator(own, lamp, camera, method="wiener"),
        ("local", "synthetic (shipped)"): fit_estimator(own, lamp, camera),
    }
    everything, white = [], white_xyz(lamp)
    mixed = {f"{name}, mixed": mixed_paints(rows) for name, rows in makers.items() if len(rows) >= LEAST_MIXED}
    for maker, spectra in {**makers, "Munsell": munsell, **mixed}.items():
        estimators = dict(fitted)
        truth = xyz_to_lab(xyz_from_spectra(lamp, spectra), white)
        if others and maker in makers:
            training = np.concatenate([rows for name, rows in makers.items() if name != maker])
            estimators["local", "other makers"] = fit_estimator(np.clip(training, 1e-4, 1.0), lamp, camera)
        for (method, train), estimator in estimators.items():
            field = estimate_spectra(spectra @ weights.T, estimator)
            rmse = np.sqrt(np.mean((field.spectra() - spectra) ** 2, axis=1))
            found = xyz_to_lab(xyz_from_spectra(lamp, field.spectra()), white)
            line = {"train": train, "method": method, "rmse": rmse, "ratio": rmse / field.sigma, "maker": maker}
            line["de00"] = delta_e_2000(found, truth)
            everything.append(line)
            yield _summary(line)
    for train, method in dict.fromkeys((line["train"], line["method"]) for line in everything):
        for name, members in (("all makers", makers), ("all makers, mixed", mixed)):
            kept = [x for x in everything if (x["train"], x["method"]) == (train, method) and x["maker"] in members]
            if kept:
                joined = {key: np.concatenate([line[key] for line in kept]) for key in ("rmse", "ratio", "de00")}
                yield _summary({"train": train, "method": method, "maker": name, **joined})


def lines_of_two_lamps(makers, camera, lamps):
    """The default on the makers' paints under one lamp and under two, which give six channels, with noise of responses.

    The noise of a response is `noise` at white and a twentieth of it at black. `ends` is the rms at 400 and 700 nm.
    """
    training, own = synthetic_reflectances(), {name: lamps[name] for name in ("A", "D6500")}
    violet, red = (np.exp(-0.5 * ((WAVELENGTHS_NM - peak) / width) ** 2) for peak, width in ((410, 8), (670, 12)))
    own["violet and red"] = violet + red
    for names in (("A",), ("D6500",), ("A", "D6500"), ("A", "violet and red"), ("D6500", "violet and red")):
        curves = under_one_lamp(
            np.repeat([own[name] for name in names], len(camera), axis=0), np.concatenate([camera] * len(names))
        )
        estimator, weights = fit_estimator(training, **curves), channel_weights(**curves)
        for noise in (0.0, 0.002, 0.005):
            rng, parts = np.random.default_rng(7), []
            for spectra in makers.values():
                exact = spectra @ weights.T
                seen = exact + noise * (exact + 0.05) / 1.05 * rng.standard_normal(exact.shape)
                field = estimate_spectra(seen, estimator)
                error = field.spectra() - spectra
                stated = field.sigma[:, None] * estimator.profile
                labs = (xyz_to_lab(xyz_from_spectra(illuminant("D65"), s), white_xyz(illuminant("D65")))
                        for s in (field.spectra(), spectra))  # fmt: skip
                within = [np.mean(np.abs(error) < k * stated, axis=0) for k in (1, 2)]
                rmse = np.sqrt(np.mean(error**2, axis=1)).mean()
                parts.append([rmse, np.mean(error[:, [0, -1]] ** 2), delta_e_2000(*labs).mean(),
                              *(share.mean() for share in (*within, *(w[[0, -1]] for w in within)))])  # fmt: skip
            rmse, ends, de00, *shares = np.mean(parts, axis=0)
            yield {"lamps": " + ".join(names), "noise": noise, "rmse_mean": round(rmse, 4), "ends": round(ends**0.5, 3),
                   "de00_D65": round(de00, 2), "within_1_2_sigma": np.round(shares[:2], 2).tolist(),
                   "within_1_2_sigma_at_the_ends": np.round(shares[2:], 2).tolist(),
                   "condition": round(estimator.condition, 1)}  # fmt: skip


def _summary(line) -> dict:
    return {
        "test": line["maker"],
        "train": line["train"],
        "method": line["method"],
        "default": (line["method"], line["train"]) == ("local", "synthetic (shipped)"),
        "spectra": len(line["rmse"]),
        "rmse_mean": round(float(line["rmse"].mean()), 5),
        "de00_mean": round(float(line["de00"].mean()), 4),  # under the lamp of the capture
        "within_1_sigma": round(float(np.mean(line["ratio"] <= 1.0)), 3),
        "within_2_sigma": round(float(np.mean(line["ratio"] <= 2.0)), 3),
    }


def _srgb_of(training, weights):
    """Camera responses to linear sRGB by least squares over the training set, as a raw converter's matrix does."""
    from nishiki.colour.colour import xyz_to_srgb_linear

    lamp = illuminant("D65")
    target = xyz_to_srgb_linear(xyz_from_spectra(lamp, training), white=white_xyz(lamp))
    matrix = np.linalg.pinv(training @ weights.T) @ target
    return lambda responses: responses @ matrix


def cases(folder: Path, cameras: list[str] | None, quick: bool):
    """Every combination worth a line, as dictionaries."""
    known, lamps = read_cameras(folder), read_illuminants(folder)
    measured, paints = read_reflectances(folder), read_paints(folder)
    names = cameras or [name for name in ("Canon 60D", "Nikon D700", "Point Grey Grasshopper2 14S5C") if name in known]
    names = names or list(known)[:3]
    wanted = [name for name in ("A", "D65", "D6500", "F11") if name in lamps] or list(lamps)[:3]
    own = synthetic_reflectances()
    for index, camera in enumerate(names):
        for lamp in wanted if not quick else wanted[:1]:
            base = {"camera_name": camera, "camera": known[camera], "illuminant": lamp, "lamp": lamps[lamp]}
            halves = list(splits(measured))
            for train, training, test, truth in halves if index == 0 and not quick else halves[:1]:
                yield {**base, "train": train, "training": training, "test": test, "truth": truth}
            sources = [("synthetic (shipped)", own)] + [(name, spectra) for name, spectra in measured.items()]
            for train, training in sources:
                for test, truth in {**(measured if training is own else {}), **paints}.items():
                    yield {**base, "train": train, "training": training, "test": test, "truth": truth}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with cameras, illuminants, reflectances")
    parser.add_argument("--camera", action="append", help="camera name (repeatable); default: three of the file")
    parser.add_argument("--quick", action="store_true", help="first illuminant and one split a set only")
    parser.add_argument("--library", action="store_true", help="also colour-science's recovery (slow to import)")
    parser.add_argument("--makers", action="store_true", help="the makers' paints alone")
    parser.add_argument("--two-lamps", action="store_true", help="the makers' paints under one lamp and under two")
    arguments = parser.parse_args()
    folder = arguments.data / "spectra" if (arguments.data / "spectra").is_dir() else arguments.data
    count = 0
    if arguments.makers or arguments.two_lamps:
        known, lamps, munsell = read_cameras(folder), read_illuminants(folder), read_reflectances(folder)
        makers = read_makers(folder)
        if not (known and lamps and munsell and makers):
            raise SystemExit(
                f"{folder}: expected cameras, illuminants, chips and paints by maker, found no complete set"
            )
        if arguments.two_lamps:
            for line in lines_of_two_lamps(makers, known[(arguments.camera or ["Canon 60D"])[0]], lamps):
                print(json.dumps(line), flush=True)
            return
        for number, camera in enumerate(
            arguments.camera or ["Canon 60D", "Nikon D700", "Point Grey Grasshopper2 14S5C"]
        ):
            for lamp in ("A", "D6500", "F11")[: 1 if arguments.quick else 3]:
                head = {"camera": camera, "illuminant": lamp}
                chips = next(iter(munsell.values()))
                first = number == 0 and lamp == "A"
                for line in lines_of_makers(makers, known[camera], lamps[lamp], chips, others=first):
                    print(json.dumps({**head, **line}), flush=True)
        return
    for index, case in enumerate(cases(folder, arguments.camera, arguments.quick)):
        head = {"train": case["train"], "test": case["test"], "camera": case["camera_name"],
                "illuminant": case["illuminant"]}  # fmt: skip
        for line in lines_of_case(case, with_library=arguments.library and index == 0, timed=index == 0):
            print(json.dumps({**head, **line}), flush=True)
            count += 1
    if not count:
        raise SystemExit(f"{folder}: expected camera, illuminant and reflectance files, found no complete set of them")


if __name__ == "__main__":
    main()
