"""Paintings exported as glTF, drawn by three.js: beside the formulas that their loss is reckoned with, and photographs.

    NODE_PATH=node_modules .venv/bin/python tests/benchmarks/gltf_in_three.py results/SCENE ...

The npm package three has to be there. PSNR of coded pictures, dB, peak 1, over the pixels whose photograph is valid:
of three.js and of the formulas against the photographs, and of one against the other.
"""

import argparse
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import _project  # noqa: F401

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import three_page

from nishiki.artifacts.artifact import open_artifact
from nishiki.colour.encoding import decode, encode
from nishiki.observations.plane import Observations
from nishiki.stages.export.declaration import ExportSettings
from nishiki.stages.export.look import painting_look
from nishiki.stages.export.photographs import CodedErrors, Photographs
from nishiki.stages.export.scene import ExportedScene


def measured(folder: Path) -> dict:
    """Figures of one scene, {fitted, check: {against: dB}}."""
    current = folder / "current"
    names = [name for name in ("ingest", "normals", "height", "spectra", "brdf") if (current / name).exists()]
    inputs = {name: open_artifact(current / name) for name in names}
    scene, frames = ExportedScene(inputs), Observations(inputs["ingest"].folder)
    look = painting_look(SimpleNamespace(inputs=inputs, settings=ExportSettings()), scene)
    rows, columns = look.colours.shape[:2]
    if look.step != 1 or frames.positions_mm is not None:
        sys.exit(f"{folder}: expected a texel for a pixel and distant lamps; choose a smaller scene")
    gloss = look.gloss.gltf.of(np.arange(rows), np.arange(columns))
    base = decode(look.colours.reshape(-1, 3) / 255, "srgb")
    normals = look.normals.reshape(-1, 3) / 255 * 2 - 1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    files = sorted(folder.glob("export/*/exports/painting.glb"), key=lambda file: file.stat().st_mtime)
    if not files:
        sys.exit(f"{folder}: no painting.glb. Remedy: ./nishiki export {folder.name} gltf")
    photographs = Photographs(frames, scene)
    result = {"scene": folder.name, "pixels": rows * columns}
    with three_page.opened(files[-1]) as draw:
        for name, lights in (("fitted", frames.fit_lights()), ("check", frames.check_lights())):
            found = {against: CodedErrors(len(lights)) for against in ("three", "formulas", "three against formulas")}
            strips = [strip for band in frames.bands() for strip in photographs.strips(band, lights)]
            for number, light in enumerate(lights):
                direction = frames.directions[light]
                picture = draw(rows, columns, (scene.pitch_mm or 1) / 1000, direction)
                drawn, covered = picture[..., :3] / 255, picture[..., 3] == 255
                formulas = encode(gloss.shown(base, normals, direction), "srgb").reshape(rows, -1, 3)
                formulas = np.clip(formulas, 0, 1)
                for band, values, valid in strips:
                    pairs = ((drawn, values[:, number]), (formulas, values[:, number]))
                    pairs += ((drawn, formulas[band].reshape(-1, 3)),)
                    for errors, (shown, against) in zip(found.values(), pairs, strict=True):
                        errors.add(
                            number, shown[band].reshape(-1, 3), against, valid[:, number] & covered[band].ravel()
                        )
            result[name] = {against: errors.decibels() for against, errors in found.items()}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE, with the export gltf")
    options = parser.parse_args()
    if three_page.THREE is None:
        sys.exit("the npm package three is not installed. Remedy: npm install three, and NODE_PATH as its node_modules")
    for folder in options.folders:
        print(json.dumps(measured(folder)), flush=True)


if __name__ == "__main__":
    main()
