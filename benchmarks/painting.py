"""A painting from its photographs: normals against truth and colours under lamps that no fit has seen.

    python benchmarks/painting.py --data simulated [--rows N --columns N] [--methods NAME ...] [--budget]
    python benchmarks/painting.py --data FOLDER          (also captures of benchmarks/path_traced.py)

FOLDER holds captures NAME with their truth NAME-truth (truth.zarr as scripts/simulate.py writes it). `simulated` makes
captures of different seed, finish and relief first. Every method runs through scripts/stage.py, so that the
figures are those a user gets. One JSON object a line: angles in degrees; de00_*: CIEDE2000 between the predicted and
the photographed check light, through the camera's colour map (de00_truth_*: between XYZ from the spectra and noise-free
XYZ); `lights`: the same for each check light, split into pixels without (diffuse) and with highlights by the truth.
us_per_pixel: selection, normals and reflectance in memory, compiled, best of three; finishes_s: seconds for the
finishes of the scene beside it. --budget adds a line a scene and check light with parts of the prediction replaced
by the truth.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path[0] = str(PROJECT / "scripts")  # instead of the benchmarks' folder, whose names would hide the scripts'
sys.path.insert(1, str(PROJECT / "workflow" / "src"))

SCENES = {
    "varnish": ["--seed", "1"],
    "steep": ["--seed", "3", "--relief-gain", "2"],
    "satin": ["--seed", "4", "--gloss", "satin", "--relief-gain", "1.5"],
    "canvas": ["--seed", "6", "--relief", "canvas", "--relief-gain", "2"],
}
METHODS = {
    "default": {},
    "selection": {"normals": {"refine": "none"}},
    "paper": {
        "separate": {"method": "threshold"},
        "normals": {"refine": "none", "solver": "least_squares", "reflectance": "mean"},
    },
}
STAGES = {
    "separate": ("ingest",),
    "normals": ("ingest", "separate"),
    "height": ("normals",),
    "spectra": ("ingest", "normals"),
    "brdf": ("ingest", "normals"),
    "evaluate": ("ingest", "normals", "height", "spectra", "brdf"),
}


def run_script(name, *arguments):
    """Run a script of the project; its messages are shown only where it fails."""
    program = ["simulate.py"] if name == "simulate" else ["stage.py", name]
    command = [sys.executable, str(PROJECT / "scripts" / program[0]), *program[1:], *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr[-2000:]}")


def simulate(folder, rows, columns):
    """Captures and truths of all SCENES in the folder."""
    for name, options in SCENES.items():
        size = ["--rows", rows, "--columns", columns]
        run_script("simulate", *size, *options, "--output", folder / name, "--truth", folder / f"{name}-truth")


def pairs_in(folder):
    """(capture, truth) folders at or below the given one."""
    places = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    truths = [(place, place.with_name(f"{place.name}-truth")) for place in places]
    found = [(a, b) for a, b in truths if next(a.glob("**/capture.yaml"), None) and (b / "truth.zarr").is_dir()]
    if not found:
        raise SystemExit(f"{folder}: no capture NAME with a truth NAME-truth in it")
    return found


def stage(name, inputs, settings, place, *extra):
    """Run a stage; the folder of its artifact."""
    arguments = ["--inputs", *inputs] if inputs else []
    run_script(name, *arguments, *extra, "--settings", json.dumps(settings), "--output", place / name)
    (artifact,) = (place / name).iterdir()
    return artifact


def run_method(ingested, truth, settings, place):
    """All stages of one method; their artifacts by name."""
    from nishiki.artifacts.provenance import truth_digest

    made = {"ingest": ingested}
    for name, needs in STAGES.items():
        chosen, extra = dict(settings.get(name, {})), []
        if name == "evaluate":
            chosen["truth_sha256"] = truth_digest(truth)
            extra = ["--truth", truth]
        made[name] = stage(name, [made[need] for need in needs], chosen, place, *extra)
    return made


def figures(artifact):
    """The figures of an evaluation."""
    found = json.loads((artifact / "evaluation.json").read_text())
    normals, overall = found["normals"]["estimated"], found["overall"]["de00"]
    lights = []
    for light in found["lights"]:
        line = {"light": light["name"], "incidence_deg": round(light["incidence_deg"], 1)}
        line |= summary("de00", light["de00"]) | summary("de00_truth", light["truth"]["lamp"]["de00"])
        for name in ("diffuse", "highlight"):
            line |= summary(f"de00_{name}", light["by_class"].get(name, {}).get("de00", {}))
            line |= summary(f"de00_truth_{name}", light["truth"]["lamp"]["by_class"].get(name, {}))
        lights.append(line)
    return {
        "normals_mae_deg": round(normals["mean"], 3),
        "normals_median_deg": round(normals["median"], 3),
        **summary("de00", overall),
        **{
            f"de00_truth_{name}_mean": average(line.get(f"de00_truth_{name}_mean") for line in lights)
            for name in ("diffuse", "highlight")
        },
        "lights": lights,
    }


def summary(name, values):
    """Mean and 90th percentile of a summary, where it has them."""
    return {f"{name}_{k}": round(values[k], 3) for k in ("mean", "p90") if values.get(k) is not None}


def average(values):
    """Mean over the lights that have a value."""
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 3) if known else None


def timing(ingested, settings):
    """Best of three of selection, normals and reflectance in memory, and the seconds for the scene's gloss."""
    from nishiki.observations.plane import Observations, Parcel
    from nishiki.photometric.light_selection import select_diffuse
    from nishiki.stages.normals import NormalsSettings
    from nishiki.stages.normals.finishes import choose_finishes
    from nishiki.stages.normals.parcel import fit_finishes, solve

    frames = Observations(ingested)
    lights = frames.fit_lights()
    chosen = NormalsSettings(**settings.get("normals", {}))
    directions, rows = frames.directions[lights], slice(0, min(frames.shape[0], 512))
    observations, valid = frames.read(rows, lights=lights)
    parcel = Parcel(rows, slice(0, frames.shape[1]), directions, np.ones(len(lights), np.float32))
    seconds, gloss_seconds = [], []
    for _ in range(4):
        start = time.perf_counter()
        profile = choose_finishes(frames, None, lights, chosen).joint[0]
        gloss_seconds.append(time.perf_counter() - start)
        start = time.perf_counter()
        level = np.ascontiguousarray(observations.mean(axis=-1))
        usable = select_diffuse(level, directions, valid=valid, **settings.get("separate", {})).usable
        maps = solve(observations, usable, valid, parcel, chosen)
        fit_finishes(maps, observations, valid, parcel, chosen, [profile], np.zeros(valid.shape[1:], int))
        seconds.append(time.perf_counter() - start)
    return {
        "us_per_pixel": round(min(seconds[1:]) / valid[0].size * 1e6, 2),
        "finishes_s": round(min(gloss_seconds[1:]), 3),
        "refined": profile is not None,
    }


def budget(made, truth):
    """Error of each check light with parts of the prediction replaced by the truth; (diffuse, highlight) means."""
    import zarr

    from nishiki.artifacts.maps import Maps
    from nishiki.brdf.gloss_profile import GlossProfile, body_shading
    from nishiki.brdf.scene import gloss_table
    from nishiki.brdf.slopes import slope_covariance
    from nishiki.evaluate.relighting import classify, truth_difference
    from nishiki.observations.plane import Observations
    from nishiki.render.plane.scene import Gloss
    from nishiki.render.plane.shade import PlaneMaps, cast_shadows
    from nishiki.stages.painting_maps import light_of, predict_light, spectral_colour

    frames, group = Observations(made["ingest"]), zarr.open_group(truth / "truth.zarr", mode="r")
    maps, spectra = Maps(made["normals"]), Maps(made["spectra"])
    coefficients, basis = spectra.read("coefficients"), np.array(spectra.attributes("coefficients")["basis"])
    gloss = Gloss(*gloss_table(json.loads((made["brdf"] / "parameters.json").read_text())))
    normals, reflectance = maps.read("normals"), maps.read("reflectance")
    true_normals = group["normals"][...].astype(np.float32)
    height, true_height = Maps(made["height"]).read("height"), group["height_mm"][...]
    colour = spectral_colour(dict(np.load(made["ingest"] / "curves.npz"))["illuminant"], basis)
    pitch, white = frames.pixel_pitch_mm, colour.white
    for index, name in enumerate(group.attrs["checks"]):
        j = frames.lights.index(name)
        lamp = light_of(frames.directions[j], None, angular_radius=np.radians(0.5))
        xyz, shine, body = (group[part][index] for part in ("xyz_lamp", "gloss", "body"))
        lit = group["lit"][list(group.attrs["lights"]).index(name)] / 100.0
        classes = classify(body, shine, lit, inside=frames.mask)
        ours, exact = (
            predict_light(
                PlaneMaps(n, reflectance, gloss, slopes=slope_covariance(n)),
                lamp,
                visibility=cast_shadows(h, [lamp], pitch=pitch),
                pitch=pitch,
            )
            for n, h in ((normals, height), (true_normals, true_height))
        )
        diffuse, exact_diffuse = (
            colour.xyz(part, coefficients) - part.specular[..., None] * white for part in (ours, exact)
        )
        true_body = xyz - shine[..., None] * white
        cosine = np.maximum(normals @ frames.directions[j].astype(np.float32), 1e-3)
        without = cosine / body_shading(
            cosine, normals[..., 2], GlossProfile(*np.ones((2, 1)), gloss.refractive_index[0])
        )
        cases = {
            "nothing": diffuse + ours.specular[..., None] * white,
            "normals": exact_diffuse + exact.specular[..., None] * white,
            "gloss": diffuse + shine[..., None] * white,
            "gloss_and_normals": exact_diffuse + shine[..., None] * white,
            "gloss_without_losses": diffuse * np.minimum(without, 3)[..., None] + shine[..., None] * white,
            "body": true_body + ours.specular[..., None] * white,
            "body_and_normals": true_body + exact.specular[..., None] * white,
        }
        line = {"light": name, "replaced": {}}
        for case, picture in cases.items():
            _, by_class = truth_difference(picture.astype(np.float32), xyz, white, classes=classes)
            line["replaced"][case] = [round(by_class[c].mean or 0.0, 3) for c in ("diffuse", "highlight")]
        yield line


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="simulated, or a folder of captures with their truth")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--rows", type=int, default=192)
    parser.add_argument("--columns", type=int, default=256)
    parser.add_argument("--budget", action="store_true", help="also replace parts of the default's prediction by truth")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        scratch = Path(scratch)
        folder = scratch / "captures" if options.data == "simulated" else Path(options.data)
        if options.data == "simulated":
            simulate(folder, options.rows, options.columns)
        for capture, truth in pairs_in(folder):
            place = scratch / "results" / capture.name
            ingested = stage("ingest", [], {"channels": "all"}, place, "--capture", capture)
            for method in options.methods:
                made = run_method(ingested, truth, METHODS[method], place / method)
                line = {"scene": capture.name, "method": method, **figures(made["evaluate"])}
                line |= timing(ingested, METHODS[method])
                print(json.dumps({**line, "default": method == "default"}), flush=True)
                if options.budget and method == "default":
                    for part in budget(made, truth):
                        print(json.dumps({"scene": capture.name, "method": "default", **part}), flush=True)


if __name__ == "__main__":
    main()
