"""Torrance-Sparrow fits: accuracy on measured paints, time a point, and accuracy on simulated points and scenes.

    python benchmarks/brdf.py --data FOLDER       every *.brdf in FOLDER or in FOLDER/cornell_brdf
    python benchmarks/brdf.py --data simulated    points and scenes of its own, of the model and of GGX

One JSON object a line; `"default": true` marks what is shipped as default.  r2_cuberoot: of the mean over the bands,
y = (f cos theta_i cos theta_r)^(1/3); r2_cuberoot_bands: of all bands, pooled; r2_unseen: of all bands, on every second
sample, predicted from the others.  us_per_point: processor time of all
threads (one is used), inputs in memory, compiled; a point of a paint is one measured direction pair with all its bands,
a point of the simulation 36 observations of 3 channels.  ratio_to_scipy: scipy's time a point (analytic
Jacobian, or finite differences) over this one's, in the same run.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(2, str(Path(__file__).resolve().parents[1] / "workflow/src"))
from point_fits import fit_torrance_sparrow
from published_fits import fit_brightest_light, fit_points, histogram_of, point_problem
from reflectance_table import (
    chosen_by_incidences,
    directions,
    fit_reflectance_table,
    predict_reflectances,
    r2_cube_root,
)

import _project  # noqa: F401
from nishiki.brdf.gloss_profile import fit_gloss
from nishiki.brdf.torrance_sparrow import attenuation, fresnel, half_vector_geometry, specular

VIEW = np.array([0.0, 0.0, 1.0])
TABLE_METHODS = [  # lobes, distribution, refractive index, exponent of the body, shared_from, default
    (2, "ggx", None, None, "bands", True),
    (2, "ggx", None, 0.0, "bands", False),
    (1, "ggx", None, None, "bands", False),
    (1, "ggx", None, 0.0, "bands", False),
    (2, "torrance_sparrow", None, None, "bands", False),
    (2, "torrance_sparrow", None, 0.0, "bands", False),
    (2, "torrance_sparrow", None, None, "mean", False),
    (1, "torrance_sparrow", None, None, "bands", False),
    (1, "torrance_sparrow", None, 0.0, "bands", False),
    (1, "torrance_sparrow", 1.45, 0.0, "bands", False),
]


def report(**fields):
    print(json.dumps(fields), flush=True)


def fastest(run, repeats):
    """(processor seconds of the fastest of some runs, last result)."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        result = run()
        seconds.append(time.process_time() - start)
    return min(seconds), result


def read_table(path: Path):
    """(lights, views, brdf) of a gonioreflectometer table: count, wavelengths, then rows of four angles and values."""
    lines = [line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    bands = int(lines[0])
    numbers = np.array(" ".join(lines[1:]).split(), float)
    rows = numbers[bands:].reshape(-1, 4 + bands)
    return directions(rows[:, 0], rows[:, 1]), directions(rows[:, 2], rows[:, 3]), rows[:, 4:]


def paints(folder: Path):
    paths = sorted(folder.glob("*.brdf")) or sorted((folder / "cornell_brdf").glob("*.brdf"))
    if not paths:
        sys.exit(f"no *.brdf in {folder} or {folder / 'cornell_brdf'}")
    for path in paths:
        lights, views, brdf = read_table(path)
        fit, unseen_incidences = chosen_by_incidences(lights, views, brdf)
        report(
            material=path.stem, model=f"chosen by incidences left out: {len(fit.gamma)} lobes",
            r2_cuberoot=round(fit.r2_mean, 5), r2_cuberoot_bands=round(fit.r2_bands, 5),
            r2_unseen_incidences=round(unseen_incidences, 5), refractive_index=round(fit.refractive_index, 4),
            body_exponent=round(fit.body_exponent, 4), at_bound=list(fit.at_bound) or None,
        )  # fmt: skip
        for lobes, distribution, index, exponent, shared, default in TABLE_METHODS:
            settings = {"lobes": lobes, "distribution": distribution, "refractive_index": index, "shared_from": shared}
            settings["body_exponent"] = exponent
            half = fit_reflectance_table(lights[::2], views[::2], brdf[::2], **settings)
            unseen = predict_reflectances(half, lights[1::2], views[1::2])
            weight = lights[1::2, 2] * views[1::2, 2]
            seconds, fit = fastest(lambda s=settings, a=(lights, views, brdf): fit_reflectance_table(*a, **s), 3)
            report(
                material=path.stem,
                model=f"{'lambert' if exponent == 0 else 'minnaert'}+{lobes}x{distribution}",
                method=f"levenberg_marquardt_cube_root, gloss from {shared}, n {'fitted' if index is None else index}",
                r2_cuberoot=round(fit.r2_mean, 5),
                r2_cuberoot_bands=round(fit.r2_bands, 5),
                r2_unseen=round(r2_cube_root(brdf[1::2], unseen, weight), 5),
                us_per_point=round(seconds / len(brdf) * 1e6, 2),
                gamma=fit.gamma.round(5).tolist(),
                beta=fit.beta.round(4).tolist(),
                refractive_index=round(fit.refractive_index, 4),
                body_exponent=round(fit.body_exponent, 4),
                at_bound=list(fit.at_bound) or None,
                default=default,
                ratio_to_scipy=None,
            )


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def ggx(normals, lights, alpha, index=1.5):
    """GGX with Smith masking relative to the white reference: what the model is not."""
    g = half_vector_geometry(normals, lights, VIEW)
    d = alpha**2 / (np.pi * (g.cos_phi**2 * (alpha**2 - 1) + 1) ** 2)
    i, r = np.maximum(g.cos_i, 1e-9), np.maximum(g.cos_r, 1e-9)
    smith = [2 * c / (c + np.sqrt(alpha**2 + (1 - alpha**2) * c * c)) for c in (i, r)]
    value = np.pi * d * fresnel(g.cos_q, index) * smith[0] * smith[1] / (4 * r)
    return np.where((g.cos_i > 0) & (g.cos_r > 0), value, 0)


def simulated_points(points, kind, noise, dtype, seed=0):
    """36 lights on a dome over tilted facets, view from above: fit inputs, true gamma (None for GGX)."""
    rng = np.random.default_rng(seed)
    tilt = np.abs(rng.normal(0, 0.25, points))
    azimuth = rng.uniform(0, 2 * np.pi, points)
    normals = directions(tilt, azimuth)[:, None]
    k = np.arange(36)
    lights = directions(np.arccos(1 - 0.8 * (k + 0.5) / 36), k * np.pi * (3 - np.sqrt(5)))[None]
    gamma = np.exp(rng.uniform(np.log(0.08), np.log(0.4), points))
    g = half_vector_geometry(normals, lights, VIEW)
    if kind == "torrance_sparrow":
        beta = rng.uniform(3, 30, (points, 1))
        gloss = specular(normals, lights, VIEW, beta=beta, gamma=gamma[:, None], refractive_index=1.45)
    else:
        gloss, gamma = ggx(normals, lights, gamma[:, None]), None
    albedo = rng.uniform(0.05, 0.9, (points, 1, 3))
    cos_i = np.maximum(g.cos_i, 0)
    values = albedo * cos_i[..., None] + gloss[..., None]
    truth = values.copy()
    values += noise * rng.normal(size=values.shape)
    weights = (g.cos_i > 0) & (g.cos_r > 0)
    arrays = (g.phi, values, attenuation(g, 1.45), cos_i, weights)
    return [np.ascontiguousarray(a, dtype) for a in arrays], truth, gamma


def cube_root_r2(fit, arrays, truth):
    """R^2 of the noise-free observations after a cube root, over the points that have a lobe."""
    phi, _, factor, cos_i, weights = (np.asarray(a, float) for a in arrays)
    gamma = np.where(np.isfinite(fit.gamma), fit.gamma, 1.0)
    lobe = factor * np.exp2(-((phi / gamma[:, None]) ** 2))
    model = fit.diffuse[:, None] * cos_i[..., None] + fit.specular[:, None] * lobe[..., None]
    used = weights > 0
    y, y_model = np.cbrt(truth[used]), np.cbrt(np.maximum(model[used], 0))
    return float(1 - np.sum((y - y_model) ** 2) / np.sum((y - y.mean()) ** 2))


def scipy_time(arrays, count, analytic):
    """Processor microseconds a point and the strengths of scipy's Levenberg-Marquardt on the first points."""
    few = [a[:count].astype(float) for a in arrays]
    strengths, reports = np.zeros((count, 3, 2)), np.zeros((count, 8))
    point_problem(*(a[0] for a in few[:4]), np.sqrt(few[4][0]))
    seconds, _ = fastest(lambda: fit_points(*few, strengths, reports, analytic=analytic), 1)
    return seconds / count * 1e6


def points(count, scipy_count):
    for kind, noise in (("torrance_sparrow", 0.0), ("torrance_sparrow", 0.005), ("ggx", 0.005)):
        arrays, truth, gamma = simulated_points(count, kind, noise, np.float32)
        phi, values, factor, cos_i, weights = arrays
        reference = scipy_time(arrays, scipy_count, True)
        differences = scipy_time(arrays, scipy_count, False)
        for precision in (np.float32, np.float64):
            given = [a.astype(precision) for a in (phi, values, factor, cos_i, weights)]

            def run(a=given):
                return fit_torrance_sparrow(a[0], a[1], attenuation=a[2], diffuse=a[3], weights=a[4])

            run()
            seconds, fit = fastest(run, 5)
            time_a_point = seconds / count * 1e6
            good = fit.flags == 0
            error = None if gamma is None else np.abs(fit.gamma / gamma - 1)[good]
            report(
                material=f"simulated_{kind}_noise_{noise}",
                model="lambert+1xtorrance_sparrow",
                method=f"variable_projection_{np.dtype(precision).name}",
                r2_cuberoot=round(cube_root_r2(fit, arrays, truth), 5),
                us_per_point=round(time_a_point, 3),
                gamma=float(np.median(fit.gamma[good])),
                beta=float(np.median(fit.specular[good])),
                refractive_index=1.45,
                default=precision == np.float32,
                ratio_to_scipy=round(reference / time_a_point, 1),
                ratio_to_scipy_differences=round(differences / time_a_point, 1),
                gamma_error_median=None if error is None else float(np.median(error)),
                gamma_error_p99=None if error is None else float(np.quantile(error, 0.99)),
                flagged=round(float(1 - good.mean()), 4),
            )


def scenes():
    """GGX relief with noisy normals: parameters from 7 lights, judged on two others."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:200, 0:200] / 200
    normals = unit(np.dstack([0.5 * np.sin(9 * x + 3 * y), 0.5 * np.cos(7 * y - 2 * x), np.ones_like(x)]))
    lights = directions([0.3, *[0.7] * 5, 0.05], [0, 1, 2.1, 3.1, 4.2, 5.2, 0])
    new = directions([0.5, 0.9], [0.5, 3.3])[:, None, None]
    albedo = 0.3 + 0.2 * np.sin(20 * x)
    noisy, sigma = unit(normals + 0.02 * rng.normal(size=normals.shape)), np.full(x.shape, 0.02)

    def diffuse(towards):
        return albedo * np.maximum(np.sum(normals * towards, axis=-1), 0)

    for alpha in (0.05, 0.12, 0.3):
        clean = diffuse(lights[:, None, None]) + ggx(normals, lights[:, None, None], alpha)
        photographs = clean + 0.003 * rng.normal(size=clean.shape)
        truth = np.minimum(diffuse(new) + ggx(normals, new, alpha), 2)
        start = time.process_time()
        histogram = histogram_of(photographs, noisy, albedo, lights, sigma=sigma)
        start = time.process_time()
        histogram = histogram_of(photographs, noisy, albedo, lights, sigma=sigma)
        gather = time.process_time() - start
        runs = [("ladder", lambda h=histogram: fit_gloss(h))]
        runs.append(("brightest_light", lambda p=photographs: fit_brightest_light(p, noisy, albedo, lights)))
        for name, run in runs:
            seconds, fit = fastest(run, 1)
            beta, gamma = np.atleast_1d(fit.beta), np.atleast_1d(fit.gamma)
            gloss = sum(
                specular(normals, new, VIEW, beta=b, gamma=g, refractive_index=1.45)
                for b, g in zip(beta, gamma, strict=True)
            )
            model = np.minimum(diffuse(new) + gloss, 2)
            a, b = np.cbrt(truth), np.cbrt(np.maximum(model, 0))
            seconds += 0 if name == "brightest_light" else gather
            report(
                material=f"simulated_scene_ggx_{alpha}",
                model=f"lambert+{beta.size}xtorrance_sparrow",
                method=name,
                r2_cuberoot=round(float(1 - np.sum((a - b) ** 2) / np.sum((a - a.mean()) ** 2)), 6),
                rms_new_lights=round(float(np.sqrt(np.mean((model - truth) ** 2))), 5),
                us_per_point=round(seconds / x.size * 1e6, 3),
                gamma=gamma.round(5).tolist(),
                beta=beta.round(4).tolist(),
                refractive_index=1.45,
                default=name == "lobes auto, normal noise 1",
                ratio_to_scipy=None,
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="folder with *.brdf (or cornell_brdf/*.brdf), or 'simulated'")
    parser.add_argument("--points", type=int, default=20000, help="simulated points (default: %(default)s)")
    parser.add_argument("--scipy-points", type=int, default=300, help="of them for scipy (default: %(default)s)")
    arguments = parser.parse_args()
    if arguments.data == "simulated":
        points(arguments.points, arguments.scipy_points)
        scenes()
    else:
        paints(Path(arguments.data))


if __name__ == "__main__":
    main()
