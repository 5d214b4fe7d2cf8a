"""Interpolation between measured views, judged on views left out; a JSON object a line.

    hemisphere.py [--data FOLDER] [--rounds N]

Every table of reflectances found in or below FOLDER (`.brdf`, or `.csv` with a capture's columns), all of its
directions of light with at least 60 views: the share `left_out` of the views is predicted from the others. Light along
the normal: with the symmetry of two mirror planes; oblique light: with the plane of incidence as the only mirror.
Without --data, or where FOLDER holds no table: an elongated lobe and a narrow one, without noise and with 3 %.

Keys: table, incidence_deg, azimuth_deg, views, left_out, method, rms_rel (root of the cosine-weighted squared error
over that of the values), rms_log (of the logarithm), fit_s (fit and prediction, the median), default.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT / "scripts"))

import _project  # noqa: E402, F401
from nishiki.capture.goniometer_tables import is_table, read_table  # noqa: E402
from nishiki.goniometry.directions import disc, images, reduce_pairs, unit  # noqa: E402
from nishiki.goniometry.hemisphere import gather_views  # noqa: E402
from nishiki.goniometry.interpolation import fit_spline  # noqa: E402
from nishiki.stages.goniometer_samples import GoniometerSamplesSettings  # noqa: E402

FEWEST = 60
SHARES = (0.3, 0.7)
CHANNELS = 4  # of a spectrum: neighbours tell the same


def lobes() -> list[tuple[str, float, float, np.ndarray, np.ndarray]]:
    """(name, theta_i, phi_i, views, values) of simulated cloths on a quarter of the hemisphere, 3 x 5 degrees."""
    theta, phi = np.meshgrid(np.radians(np.arange(3, 88, 3.0)), np.radians(np.arange(0, 91, 5.0)))
    views = unit(theta.ravel(), phi.ravel())
    slopes = views[:, :2] / (1 + views[:, 2:])
    found = []
    for name, wide, narrow in (("lobe", 0.3, 0.12), ("narrow lobe", 0.3, 0.04)):
        values = 0.02 + 0.5 * np.exp(-((slopes[:, :1] / wide) ** 2) - (slopes[:, 1:] / narrow) ** 2)
        noisy = values * (1 + 0.03 * np.random.default_rng(1).standard_normal(values.shape))
        found += [(name, 0.0, 0.0, views, values), (f"{name}, 3 % noise", 0.0, 0.0, views, noisy)]
    return found


def tables(folder: Path) -> list[tuple[str, float, float, np.ndarray, np.ndarray]]:
    """(name, theta_i, phi_i, views, values) of each direction of light of every table."""
    found = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".csv", ".brdf") and is_table(p)):
        table = read_table(path, path.name)
        lights = np.round(table.incident_deg, 1) * np.where(table.incident_deg[:, :1] < 1, 0, 1)
        for theta, phi in np.unique(lights, axis=0):
            rows = (lights == (theta, phi)).all(axis=1) & (table.values > 0).all(axis=1)
            turned = table.outgoing_deg[rows] - [0.0, phi]  # so that the plane of incidence is the x axis
            values = table.values[rows]
            chosen = np.unique(np.linspace(0, values.shape[1] - 1, CHANNELS).round().astype(int))
            found.append((path.stem, float(theta), float(phi), unit(*np.radians(turned).T), values[:, chosen]))
    return found


def fit_linear(points: np.ndarray, logs: np.ndarray, folds: np.ndarray):
    """Linear on the triangles of the points and their images; the nearest point's value outside them.

    Triangles over symmetric points need not be symmetric, so places are folded first.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    places = np.concatenate([points * fold for fold in folds])
    _, first = np.unique(np.round(places, 9) + 0.0, axis=0, return_index=True)
    unfolded, repeated = places[first], np.concatenate([logs] * len(folds))[first]
    inside, nearest = LinearNDInterpolator(unfolded, repeated), NearestNDInterpolator(unfolded, repeated)

    def predict(places: np.ndarray) -> np.ndarray:
        places = folded(places, folds)
        values = inside(places)
        return np.where(np.isfinite(values), values, nearest(places))

    return predict


def folded(places: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Places (m, 2) brought to one of their images: that with the greatest x, then the greatest y."""
    best = places
    for fold in folds:
        image = places * fold
        better = (image[:, 0] > best[:, 0]) | ((image[:, 0] == best[:, 0]) & (image[:, 1] > best[:, 1]))
        best = np.where(better[:, None], image, best)
    return best


def judge(views: np.ndarray, values: np.ndarray, symmetry: np.ndarray, method: str, share: float, rounds: int):
    """Errors of the views left out, and seconds: medians over the rounds."""
    points, logs, sigma, _ = gather_views(disc(views), values, np.zeros_like(values))
    results = []
    for seed in range(rounds):
        out = np.random.default_rng(seed).permutation(len(points)) < share * len(points)
        start = time.perf_counter()
        if method == "linear":
            predict = fit_linear(points[~out], logs[~out], symmetry)
        else:
            predict = fit_spline(points[~out], logs[~out], sigma[~out], symmetry)
        found = predict(points[out])
        seconds = time.perf_counter() - start
        true, weights = np.exp(logs[out]), np.cos(np.linalg.norm(points[out], axis=1) * np.pi / 2)[:, None]
        relative = np.sqrt((weights * (np.exp(found) - true) ** 2).sum() / (weights * true**2).sum())
        results.append((relative, np.sqrt(((found - logs[out]) ** 2).mean()), seconds))
    return np.median(results, axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    default = GoniometerSamplesSettings().interpolation
    quarter = images("quarter")[:, [0, 1], [0, 1]]
    mirror = np.array([[1.0, 1.0], [1.0, -1.0]])
    for name, theta, phi, views, values in (tables(options.data) if options.data else []) or lobes():
        if len(views) < FEWEST:
            continue
        along = theta == 0
        if along:
            views = reduce_pairs(np.tile([0.0, 0.0, 1.0], (len(views), 1)), views, "quarter")[1]
        judge(views, values, quarter if along else mirror, default, 0.5, 1)  # imports and compiled code
        for share in SHARES:
            for method in ("spline", "linear"):
                relative, log, seconds = judge(
                    views, values, quarter if along else mirror, method, share, options.rounds
                )
                line = {"table": name, "incidence_deg": theta, "azimuth_deg": phi, "views": len(views)}
                line |= {"left_out": share, "method": method, "rms_rel": round(float(relative), 5)}
                line |= {"rms_log": round(float(log), 5), "fit_s": round(float(seconds), 4)}
                print(json.dumps({**line, "default": method == default}), flush=True)


if __name__ == "__main__":
    main()
