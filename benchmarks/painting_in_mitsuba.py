"""Paintings exported for Mitsuba 3, rendered by it beside our own pictures and the photographs.

    python benchmarks/painting_in_mitsuba.py results/SCENE ... [--samples 16] [--variant llvm_ad_rgb]

Needs Mitsuba (group path-tracing) and `./nishiki export SCENE mitsuba`. Two JSON lines a scene:

    lamps        one lamp 60 and 20 degrees above the plane, from the left; nishiki_paint.py, flat, against `render`
                 without cast shadows: relative difference, median and 99th percentile over the channels, share of the
                 pixels above 1 %, and that among pixels whose colour sRGB holds; `paint_db`: of the coded pictures;
                 `relief_db`: with the relief against `render` with cast shadows; `without_*_db`: `render` without the
                 slopes, the regions but the largest, the directional terms: what each is worth
    photographs  dB of the coded pictures under the lights of the fit and under those that no fit saw: `render`,
                 nishiki_paint.py, flat and with the relief
"""

import argparse
import importlib.util
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.artifacts.artifact import Artifact, open_artifact
from nishiki.colour.colour import encode, illuminant, white_xyz, xyz_to_srgb_linear
from nishiki.observations.plane import Observations
from nishiki.render.plane.frame import render
from nishiki.render.plane.scene import Light, PlaneScene
from nishiki.stages.export.registry import CodedErrors
from nishiki.stages.export.scene import CodedPhotographs, ExportedScene
from nishiki.stages.render.painting import load_scene

STAGES = ("ingest", "normals", "height", "spectra", "brdf")
ELEVATIONS = (60, 20)
D65 = illuminant("D65")


class Pictures:
    """Linear pictures (rows, columns, 3) of one painting under a distant lamp, by each renderer."""

    def __init__(self, mi, inputs: dict[str, Artifact], folder: Path, samples: int):
        self._mi, self._folder, self._samples = mi, folder, samples
        spec = importlib.util.spec_from_file_location("nishiki_paint", folder / "nishiki_paint.py")
        self._module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(self._module)
        self._module.define()
        self.scene = load_scene(inputs, cast_shadows=True)

    def render(self, lamp: np.ndarray, *, relief: bool = False, scene: PlaneScene | None = None) -> np.ndarray:
        """Our own."""
        scene = self.scene if scene is None else scene
        scene = scene if relief else replace(scene, height=None)
        xyz = render(scene, [Light(direction=tuple(lamp), spectrum=D65)]).xyz
        return xyz_to_srgb_linear(xyz, white=white_xyz(D65))

    def paint(self, lamp: np.ndarray, *, relief: bool = False) -> np.ndarray:
        """nishiki_paint.py; flat, all samples of a pixel are alike."""
        samples = self._samples if relief else 1
        made = self._module.description([lamp.tolist()], relief=relief, samples=samples, folder=self._folder)
        return np.array(self._mi.render(self._mi.load_dict(made)))


def decibels(theirs: np.ndarray, ours: np.ndarray) -> float:
    """PSNR of sRGB-coded pixels (n, 3), peak 1."""
    coded = (encode(np.clip(each, 0, 1), "srgb") for each in (theirs, ours))
    return float(-10 * np.log10(np.mean(np.square(np.subtract(*coded)))))


def largest_region(scene: PlaneScene) -> PlaneScene:
    """The scene with the gloss of the region with most pixels everywhere."""
    labels = np.full_like(scene.labels, np.bincount(scene.labels.ravel()).argmax())
    return replace(scene, labels=labels)


def under_lamps(pictures: Pictures, exported: ExportedScene) -> dict:
    """Mitsuba's pictures beside ours."""
    everything = slice(0, exported.shape[0])
    known, inside = exported.read_known(everything), exported.srgb(everything).min(axis=-1) >= 0
    found = {}
    for elevation in np.radians(ELEVATIONS):
        lamp = np.array([-np.cos(elevation), 0, np.sin(elevation)])
        ours, theirs, scene = pictures.render(lamp), pictures.paint(lamp), pictures.scene
        lit = known & (ours.min(axis=-1) > 1e-4)
        apart = np.abs(theirs[lit] / ours[lit] - 1)
        lines = {
            "pixels": int(lit.sum()),
            "median": float(np.median(apart)),
            "p99": float(np.percentile(apart, 99)),
            "above": float((apart > 0.01).any(axis=1).mean()),
            "above_in_srgb": float((apart[inside[lit]] > 0.01).any(axis=1).mean()),
            "paint_db": decibels(theirs[known], ours[known]),
        }
        relief = pictures.paint(lamp, relief=True)
        lines["relief_db"] = decibels(relief[known], pictures.render(lamp, relief=True)[known])
        left_out = {"slopes": replace(scene, slopes=None)}
        if scene.labels is not None:
            left_out["regions"] = largest_region(scene)
        if scene.shading is not None and scene.shading.shape[-1] > 3:
            left_out["directional"] = replace(scene, shading=scene.shading[..., :3])
        for name, less in left_out.items():
            lines[f"without_{name}_db"] = decibels(pictures.render(lamp, scene=less)[known], ours[known])
        found[f"{np.degrees(elevation):.0f}"] = lines
    return found


def against_photographs(
    pictures: Pictures, exported: ExportedScene, frames: Observations, hold_out: Sequence[str]
) -> dict:
    """PSNR against the photographs, as `CodedErrors` says it; hold_out: lights that no fit saw, where the capture
    names none."""
    ways = {
        f"{name}{'_relief' * relief}": (getattr(pictures, name), relief)
        for name in ("render", "paint")
        for relief in (False, True)
    }
    found = {}
    for group, lights in {"fitted": frames.fit_lights(hold_out), "check": frames.check_lights(hold_out)}.items():
        errors = {name: CodedErrors(len(lights)) for name in ways}
        for number, light in enumerate(lights):
            lamp = np.asarray(frames.directions[light], float)
            shown = {
                name: encode(np.maximum(make(lamp, relief=relief), 0), "srgb") for name, (make, relief) in ways.items()
            }
            for band in frames.bands():
                for rows, values, valid in CodedPhotographs(frames, exported).strips(band, lights[number : number + 1]):
                    for name, picture in shown.items():
                        errors[name].add(number, picture[rows].reshape(-1, 3), values[0].T, valid[0])
        found[group] = {name: round(each.decibels()["all"], 2) for name, each in errors.items() if len(lights)}
        found[group]["lights"] = len(lights)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE, with the export mitsuba")
    parser.add_argument("--samples", type=int, default=16, help="a pixel, with the relief")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of Mitsuba; scalar_rgb needs no LLVM")
    options = parser.parse_args()
    import mitsuba as mi

    mi.set_variant(options.variant)
    for folder in options.folders:
        made = sorted(folder.glob("export/*/exports/mitsuba"), key=lambda path: path.stat().st_mtime)
        if not made:
            sys.exit(f"{folder}: no export for Mitsuba. Remedy: ./nishiki export {folder.name} mitsuba")
        inputs = {
            name: open_artifact(folder / "current" / name) for name in STAGES if (folder / "current" / name).exists()
        }
        pictures, exported = Pictures(mi, inputs, made[-1], options.samples), ExportedScene(inputs)
        print(json.dumps({"scene": folder.name, "lamps": under_lamps(pictures, exported)}), flush=True)
        frames, hold_out = (
            Observations(inputs["ingest"].folder),
            open_artifact(made[-1].parents[1]).settings["hold_out"],
        )
        photographs = against_photographs(pictures, exported, frames, hold_out)
        print(json.dumps({"scene": folder.name, "photographs": photographs}), flush=True)


if __name__ == "__main__":
    main()
