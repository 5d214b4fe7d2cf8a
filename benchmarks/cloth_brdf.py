"""Reflection models of a cloth: error where nothing was fitted, against measured directions and fitting time.

    python benchmarks/cloth_brdf.py --data CAPTURE [--models yarn_facets ggx ...] [--fewer] [--oblique 20]

CAPTURE: a goniometer capture folder, an artifact of the stage goniometer_samples, or a table `.npz` with arrays
incident (n, 3), outgoing (n, 3), values (n, channels); or a folder that holds several of them. One JSON object a line:
{capture, model, measured_directions, incidence_deg, azimuth, rms_rel, peak_direction_err_deg, peak_value_err_rel,
fit_s}, one line for each model, set of measurements and incidence; `azimuth` is weft, bias, warp, or degrees, and
`all` for the mean over the azimuths of an incidence. `"default": true`: the shipped default with its default number
of oblique images. rms_rel is weighted by cos theta_r and the solid angle of the view's cell. Models are judged on
all oblique measurements that neither their own fit nor the choice of oblique images has used. fit_s: processor time
of the fit, compiled, inputs in memory; that of `yarns` includes the search for the weave. --fewer: the views of normal
incidence thinned from all of them to 15.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
from cloth_peers import PRIORS, fit_peer
from cloth_references import REFERENCES, fit_reference

import _project  # noqa: F401
from nishiki.brdf.cloth.interface import incidences, prediction_error, solid_angles
from nishiki.brdf.cloth.models import FACETS, MODELS, PUBLISHED, YARNS, Fitted, fit_models
from nishiki.brdf.cloth.yarn_fit import Measured
from nishiki.goniometry.hemisphere import complete
from nishiki.goniometry.table import Reflectances, ReflectanceSet
from nishiki.weave.yarn_search import search_yarns
from nishiki.weave.yarn_weave import bindings

ROOT = Path(__file__).resolve().parents[1]
PLANES = {0.0: "weft", 45.0: "bias", 90.0: "warp"}
FEWER = (540, 270, 135, 68, 34, 15)


def captures(folder: Path) -> list[Path]:
    """The captures, artifacts or tables at a place."""
    if is_one(folder):
        return [folder]
    found = sorted(path for path in folder.iterdir() if is_one(path))
    if not found:
        sys.exit(f"{folder}: no capture.yaml, reflectance.npz or table .npz in it or in its folders")
    return found


def is_one(path: Path) -> bool:
    """Whether there is one capture, artifact or table."""
    if path.suffix == ".npz":
        return path.name != "reflectance.npz"
    return any((path / name).is_file() for name in ("capture.yaml", "data/capture.yaml", "reflectance.npz"))


def read(path: Path) -> ReflectanceSet:
    """The reflectances of a capture, an artifact or a table."""
    if path.suffix == ".npz":
        with np.load(path) as stored:
            return ReflectanceSet.of(stored["incident"], stored["outgoing"], stored["values"])
    if (path / "reflectance.npz").is_file():
        return Reflectances(path)
    with tempfile.TemporaryDirectory() as place:
        ingested = stage("ingest", place, "--capture", str(path))
        return Reflectances(stage("goniometer_samples", place, "--inputs", str(ingested)))


def stage(name: str, place: str, *arguments: str) -> Path:
    """Run a stage; the artifact's folder."""
    out = Path(place) / name
    command = [sys.executable, str(ROOT / "scripts/stage.py"), name, *arguments, "--output", str(out)]
    subprocess.run(command, check=True, stdout=sys.stderr, env={**os.environ, "PYTHONPATH": str(ROOT / "workflow/src")})
    return next(path.parent for path in out.glob("*/artifact.json"))


def thinned(measured: ReflectanceSet, count: int) -> np.ndarray:
    """Rows: `count` views of normal incidence, each the farthest from those before, and all oblique measurements."""
    normal = np.flatnonzero(measured.normal_incidence)
    if count >= len(normal):
        return np.arange(len(measured))
    views = measured.outgoing[normal]
    chosen = [int(np.argmax(views[:, 2]))]
    distance = np.full(len(normal), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(views - views[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.sort(np.concatenate([normal[chosen], np.flatnonzero(~measured.normal_incidence)]))


def searched(measured: ReflectanceSet, region: int):
    """The yarns found at normal incidence, for a fit, and processor seconds."""
    start = time.process_time()
    best = search_yarns(Measured.of(measured, region), bindings()).best
    return (best.brdf, {"rms_rel_normal": best.rms_rel}), time.process_time() - start


EVERY = (*MODELS, *REFERENCES, *PRIORS)


def fit_one(measured: ReflectanceSet, region: int, name: str, oblique: int, chosen=None, yarns=None):
    """(Fitted, seconds): the grid of normal incidence is part of the input, like the reflectances.

    chosen: rows of the oblique measurements that a model of `cloth_peers` uses; the choice does not count in its time;
    yarns: from `searched`, for the model of that name.
    """
    data = Measured.of(measured, region)
    basic = (lambda views: measured.basic.evaluate(views, region), measured.basic.values[region])
    yarns, seconds = yarns if name == YARNS else (None, 0.0)
    start = time.process_time() - seconds
    if name in PRIORS:
        peer = fit_peer(name, data, np.concatenate([np.flatnonzero(measured.normal_incidence), chosen]))
        fitted = Fitted(peer.brdf, peer.used)
    elif name in REFERENCES:
        fitted = fit_reference(name, data, basic)
    else:
        fitted = fit_models(data, basic, [name], oblique=oblique, yarns=yarns)[name]
    return fitted, time.process_time() - start


def judge(name, model, fitted, seconds, measured, region, seen, count, default):
    """Print the errors at all oblique incidences."""
    valid = measured.valid[:, region] & ~measured.normal_incidence
    valid[seen] = False
    rows = np.flatnonzero(valid)
    incident, outgoing, values = measured.incident[rows], measured.outgoing[rows], measured.values[rows, region]
    predicted = fitted.brdf.evaluate(incident, outgoing)
    by_theta = {}
    for theta, phi, group in incidences(incident):
        if len(group) < 8:
            continue
        error = prediction_error(outgoing[group], values[group], predicted[group], solid_angles(outgoing[group]))
        degrees, turn = round(float(np.degrees(theta)), 2), round(float(np.degrees(phi)), 2)
        line = (error.rms_rel, np.degrees(error.peak_direction), error.peak_value)
        by_theta.setdefault(degrees, []).append((PLANES.get(turn, turn), line))
    for degrees, lines in by_theta.items():
        mean = np.mean(np.abs([line for _, line in lines]), axis=0)
        for plane, line in [*lines, ("all", mean)]:
            entry = {
                "capture": name,
                "model": model,
                "measured_directions": int(count),
                "incidence_deg": degrees,
                "azimuth": plane,
                "rms_rel": round(float(line[0]), 4),
                "peak_direction_err_deg": round(float(line[1]), 2),
                "peak_value_err_rel": round(float(line[2]), 4),
                "fit_s": round(seconds, 3),
            }
            print(json.dumps({**entry, "default": True} if default else entry), flush=True)


def run(name: str, measured: ReflectanceSet, region: int, models, oblique: int, fewer: bool) -> None:
    """All models with and without oblique images; then the default with fewer views of normal incidence."""
    fit_one(measured, region, FACETS, 0)  # compiles
    yarns = searched(measured, region) if YARNS in models else None
    for count in dict.fromkeys((0, oblique)):
        seen = fit_one(measured, region, FACETS, count)[0].used if count else np.empty(0, int)
        chosen = seen[~measured.normal_incidence[seen]]
        for model in models:
            if count and model in (*PUBLISHED, *REFERENCES):
                continue  # they use no oblique images: as above
            fitted, seconds = fit_one(measured, region, model, count, chosen, yarns)
            everything = model == "bard_scaled"  # it has seen what it is judged by
            used = 0 if everything else len(fitted.used)
            kept = seen if everything else np.union1d(seen, fitted.used)
            judge(name, model, fitted, seconds, measured, region, kept.astype(int), used or len(measured),
                  model == YARNS and count == oblique)  # fmt: skip
    for count in FEWER[1:] if fewer else ():
        few, _ = complete(measured.take(thinned(measured, count)))
        for extra in dict.fromkeys((0, oblique)):
            fitted, seconds = fit_one(few, region, FACETS, extra)
            judge(name, FACETS, fitted, seconds, few, region, fitted.used, len(fitted.used), False)


def main() -> None:
    """Parse, read, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="capture, artifact, table, or a folder of them")
    parser.add_argument("--models", nargs="*", choices=EVERY, default=EVERY, help="(default: all)")
    parser.add_argument("--oblique", type=int, default=20, help="oblique images (default: %(default)s)")
    parser.add_argument("--fewer", action="store_true", help="fewer views of normal incidence as well")
    arguments = parser.parse_args()
    for path in captures(arguments.data):
        measured = read(path)
        if measured.basic is None:
            measured, _ = complete(measured)
        for region, label in enumerate(measured.regions):
            name = path.stem if len(measured.regions) == 1 else f"{path.stem}/{label}"
            run(name, measured, region, arguments.models, arguments.oblique, arguments.fewer)


if __name__ == "__main__":
    main()
