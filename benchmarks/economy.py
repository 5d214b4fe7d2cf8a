"""What is left out by measured decisions: the criterion, the error and the seconds with and without it.

    python benchmarks/economy.py --data FOLDER [--only lights gloss bases views object] [--work FOLDER]

FOLDER holds DiLiGenT objects (folders with light_directions.txt, normals_gt.npz) and oxford_dino. Everything else is
simulated. One JSON object a line: scene, what, setting, the criterion measured and its limit where one was, error with
its unit, seconds and cpu_seconds of the stages that it concerns (own processes, imports included).
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.artifacts.maps import Maps
from nishiki.observations.plane import Observations

PROJECT = Path(__file__).resolve().parents[1]


class Runs:
    """Stages run by hand in a folder of their own; the same inputs and settings are run once."""

    def __init__(self, folder: Path, repeats: int = 1):
        self.folder, self.repeats = folder, repeats

    def stage(
        self, name: str, inputs=(), *, capture: Path | None = None, truth: Path | None = None, **settings
    ) -> Path:
        """Folder of the artifact."""
        command = [sys.executable, str(PROJECT / "scripts/stage.py"), name, "--output", str(self.folder / name)]
        command += ["--settings", json.dumps(settings), "--inputs", *map(str, inputs)]
        command += ["--capture", str(capture)] if capture else []
        command += ["--truth", str(truth)] if truth else []
        before = set((self.folder / name).glob("*"))
        done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name} {settings}: {done.stderr[-2000:]}")
        made = set((self.folder / name).glob("*")) - before
        return (
            made.pop() if made else max((self.folder / name).glob("*"), key=lambda p: (p / "run.json").stat().st_mtime)
        )

    def simulate(self, name: str, *options: str) -> Path:
        """Capture of a simulated scene; its truth lies beside it, with -truth in its name."""
        capture = self.folder / name
        if not capture.exists():
            command = [sys.executable, str(PROJECT / "scripts/simulate.py"), "--output", str(capture)]
            command += ["--truth", f"{capture}-truth", *options]
            subprocess.run(command, cwd=PROJECT, capture_output=True, check=True)
        return capture

    def converted(self, source: Path) -> Path:
        """Capture of a folder of photographs."""
        capture = self.folder / source.name
        if not capture.exists():
            command = [sys.executable, "-m", "nishiki", "convert", str(source), str(capture)]
            subprocess.run(command, cwd=PROJECT, capture_output=True, check=True)
        return capture


def seconds(*artifacts: Path) -> dict[str, float]:
    """Seconds and processor seconds of the stages together."""
    facts = [json.loads((artifact / "run.json").read_text()) for artifact in artifacts]
    return {
        "seconds": round(sum(fact["seconds"] for fact in facts), 2),
        "cpu_seconds": round(sum(fact["process_cpu_seconds"] for fact in facts), 2),
    }


def decided(artifact: Path, what: str) -> dict:
    """Criterion of a decision in an artifact's diagnostics; empty where none was made."""
    block = json.loads((artifact / "artifact.json").read_text())["diagnostics"].get("economy", {})
    if what not in block:
        return {}
    return {"decided": block[what]["decision"], "measured": block[what]["measured"], "limit": block[what]["limit"]}


def diagnostics(artifact: Path) -> dict:
    """What a stage says of its result."""
    return json.loads((artifact / "artifact.json").read_text())["diagnostics"]


def read_map(artifact: Path, name: str) -> np.ndarray:
    """A map of an artifact."""
    return Maps(artifact).read(name)


def truth_normals(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Normals (rows, columns, 3) and where they are known, of a DiLiGenT object or of a simulated truth."""
    if (folder / "normals_gt.npz").exists():
        normals = np.load(folder / "normals_gt.npz")["normals"]
    else:
        import zarr

        normals = np.asarray(zarr.open_group(folder / "truth.zarr", mode="r")["normals"])
    return normals, np.linalg.norm(normals, axis=-1) > 0.5


def angular_error(normals: np.ndarray, truth: tuple[np.ndarray, np.ndarray], mask: np.ndarray) -> float:
    """Mean angle over the object, degrees."""
    true, known = truth
    inside = known & mask
    cosine = np.clip(np.sum(normals[inside].astype(np.float64) * true[inside], axis=-1), -1, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


def scenes(runs: Runs, data: Path | None) -> dict[str, tuple[Path, Path]]:
    """Plane captures with many lights, and where their true normals are."""
    found = {}
    for folder in sorted(data.iterdir()) if data else []:
        if (folder / "light_directions.txt").exists() and (folder / "normals_gt.npz").exists():
            found[folder.name] = runs.converted(folder), folder
    for gloss in ("varnish", "matte"):
        options = ("--preset", "tiny", "--rows", "128", "--columns", "192", "--rings", "3", "--ring-lights", "20")
        capture = runs.simulate(f"painting-61-{gloss}", *options, "--gloss", gloss)
        found[capture.name] = capture, capture.with_name(f"{capture.name}-truth")
    return found


def lights(runs: Runs, data: Path | None):
    """Normals with all lights, fewer, and as many as the measured decision takes."""
    for name, (capture, truth) in scenes(runs, data).items():
        ingest = runs.stage("ingest", capture=capture, channels="all")
        frames, true = Observations(ingest), truth_normals(truth)
        for setting in ("all", 64, 48, 32, 24, 16, 8):
            if isinstance(setting, int) and setting >= len(frames.fit_lights()):
                continue
            chosen = runs.stage("separate", [ingest], lights=setting)
            normals = runs.stage("normals", [ingest, chosen], lights=setting)
            said = diagnostics(normals)
            yield {
                "scene": name,
                "what": "lights",
                "setting": setting,
                "lights": len(said["lights"]),
                "joint_fit": said["refined"],
                "error_deg": round(angular_error(read_map(normals, "normals"), true, frames.mask), 3),
                **seconds(chosen, normals),
                **decided(chosen, "lights"),
            }


def gloss(runs: Runs, data: Path | None):
    """Plane scenes with and without gloss: colour error under lights that no fit has seen, with and without it."""
    for kind in ("varnish", "satin", "matte", "none"):
        options = ("--preset", "tiny", "--gloss", kind)
        capture = runs.simulate(f"painting-{kind}", *options)
        ingest = runs.stage("ingest", capture=capture, channels="all")
        chosen = runs.stage("separate", [ingest])
        normals = runs.stage("normals", [ingest, chosen])
        for setting in ("auto", "keep", "drop"):
            fitted = runs.stage("brdf", [ingest, normals], specular=setting)
            judged = runs.stage("evaluate", [ingest, normals, fitted])
            yield {
                "scene": capture.name,
                "what": "specular",
                "setting": setting,
                "error_de00": diagnostics(judged)["relighting_de00_mean"],
                **seconds(fitted),
                **decided(fitted, "specular"),
            }


def bases(runs: Runs, data: Path | None):
    """Cameras and lamps by the number of bases that they support; error on spectra that were not trained on."""
    import time

    from nishiki.colour.colour import illuminant
    from nishiki.colour.estimate import estimate_spectra, fit_estimator
    from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights
    from nishiki.colour.training import synthetic_reflectances
    from nishiki.model_selection.sufficient import output_bases

    def bell(centre, width):
        return np.exp(-0.5 * ((WAVELENGTHS_NM - centre) / width) ** 2)

    cameras = {
        "three channels": np.stack([bell(600, 35), bell(540, 40), bell(450, 28)]),
        "three nearly equal channels": np.stack([bell(560, 80), bell(555, 80), bell(550, 80)]),
        "one channel": bell(550, 80)[None],
        "six channels": np.stack([bell(centre, 22) for centre in (420, 470, 520, 570, 620, 670)]),
    }
    lamps = {"A": illuminant("A"), "sodium": bell(589, 3) + 1e-4}
    training, unseen = synthetic_reflectances(), synthetic_reflectances(1000, seed=7)
    for camera, sensitivities in cameras.items():
        for lamp, power in lamps.items():
            found = []

            def rule(estimates, mean_square, found=found):
                found.append(output_bases(estimates, mean_square))
                return found[-1].count

            responses = unseen @ channel_weights(power, sensitivities).T
            pixels = np.ascontiguousarray(np.tile(responses, (300, 1)), np.float32)
            for setting in ("auto", 3, 8, 16):
                estimator = fit_estimator(training, power, sensitivities, bases=rule if setting == "auto" else setting)
                error = np.sqrt(np.mean((estimate_spectra(responses, estimator).spectra() - unseen) ** 2))
                start = time.process_time()
                estimate_spectra(pixels, estimator, threads=1)
                yield {
                    "scene": f"{camera}, {lamp}",
                    "what": "bases",
                    "setting": setting,
                    "bases": len(estimator.basis),
                    "condition": estimator.condition,
                    "error_rms": round(float(error), 5),
                    "us_per_pixel": round((time.process_time() - start) / len(pixels) * 1e6, 3),
                    **({"measured": found[0].loss, "limit": 0.002} if setting == "auto" else {}),
                }


def views(runs: Runs, data: Path | None):
    """A cloth fitted to all views of normal incidence, to fewer, and to as many as are taken: oblique pairs judged."""
    capture = runs.simulate("satin", "--preset", "satin-tiny")
    ingest = runs.stage("ingest", capture=capture, channels="all")
    measured = runs.stage("goniometer_samples", [ingest])
    for setting in ("all", 34, "auto"):
        fitted = runs.stage("cloth_brdf", [measured], measurements=setting, compare=[], oblique=0)
        judged = runs.stage("cloth_evaluate", [measured, fitted])
        yield {
            "scene": "satin-tiny",
            "what": "measurements",
            "setting": setting,
            "errors": diagnostics(judged)["regions"],
            **seconds(fitted),
            **decided(fitted, "measurements"),
        }


def turned(runs: Runs, data: Path | None):
    """Objects on a turntable: the specular part and the residual, kept and left out."""
    found = {"object-tiny": runs.simulate("jar", "--preset", "object-tiny")}
    if data and (data / "oxford_dino").is_dir():
        found["oxford_dino"] = runs.converted(data / "oxford_dino")
    for name, capture in found.items():
        ingest = runs.stage("ingest", capture=capture, channels="all")
        cameras = runs.stage("cameras", [ingest])
        mesh = runs.stage("mesh", [ingest, cameras])
        texels = runs.stage("texels", [ingest, cameras, mesh])
        for setting in ("auto", "keep", "drop"):
            fitted = runs.stage("object_brdf", [ingest, texels], specular=setting)
            yield {
                "scene": name,
                "what": "specular",
                "setting": setting,
                "model_psnr_db": diagnostics(fitted)["psnr_db"],
                **seconds(fitted),
                **decided(fitted, "specular"),
            }
        if name == "oxford_dino":
            continue
        fitted = runs.stage("object_brdf", [ingest, texels])
        for setting in ("auto", "never"):
            coded = runs.stage("residual", [texels, fitted], target="psnr", amount=30, sufficient=setting)
            yield {
                "scene": name,
                "what": "residual",
                "setting": setting,
                "psnr_db": diagnostics(coded)["psnr_db"],
                "bytes": diagnostics(coded)["bytes"]["total"],
                **seconds(coded),
                **decided(coded, "residual"),
            }


PARTS = {"lights": lights, "gloss": gloss, "bases": bases, "views": views, "object": turned}


def main() -> None:
    """JSON lines of the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of measured objects")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS), help="decisions to measure")
    parser.add_argument("--work", type=Path, help="folder for captures and results (default: a temporary one)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        for part in options.only:
            for row in PARTS[part](Runs(work), options.data):
                print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
