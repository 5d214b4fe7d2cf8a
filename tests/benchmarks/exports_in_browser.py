"""Paintings exported as glTF or OpenPBR materials, drawn by other programs in a browser: three.js, and the shaders that
MaterialX makes; beside the formulas that their loss is reckoned with, and photographs.

    .venv/bin/python tests/benchmarks/exports_in_browser.py materialx results/SCENE ...
    NODE_PATH=node_modules .venv/bin/python tests/benchmarks/exports_in_browser.py gltf results/SCENE ...

Needs Chromium, and the extra export or the npm package three. PSNR of coded pictures, dB, peak 1, over the pixels whose
photograph is valid: of the drawing and of the formulas against the photographs, and of one against the other.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import _project  # noqa: F401

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import materialx_page
import three_page

from nishiki.artifacts.artifact import open_artifact
from nishiki.colour.encoding import decode, encode
from nishiki.observations.plane import Observations
from nishiki.stages.export.declaration import ExportSettings
from nishiki.stages.export.look import painting_look
from nishiki.stages.export.photographs import CodedErrors, Photographs
from nishiki.stages.export.scene import ExportedScene

FILES = {"gltf": "painting.glb", "materialx": "materialx/painting.mtlx"}
Draw = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""The coded picture (rows, columns, 3) under a distant lamp (3,), and where the painting covers it (rows, columns)."""


@contextmanager
def opened(name: str, file: Path, shape: tuple[int, int], pitch_mm: float) -> Iterator[Draw]:
    """Draw an exported file in a browser."""
    if name == "gltf":
        with three_page.opened(file) as draw_file:

            def drawn(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                picture = draw_file(*shape, pitch_mm / 1000, direction)
                return picture[..., :3] / 255, picture[..., 3] == 255

            yield drawn
    else:
        with materialx_page.opened(file, *shape) as draw_linear:
            everywhere = np.ones(shape, bool)
            yield lambda direction: (np.clip(encode(draw_linear(direction), "srgb"), 0, 1), everywhere)


def measured(name: str, folder: Path) -> dict:
    """Figures of one format of one scene, {fitted, check: {against: dB}}."""
    current = folder / "current"
    names = [stage for stage in ("ingest", "normals", "height", "spectra", "brdf") if (current / stage).exists()]
    inputs = {stage: open_artifact(current / stage) for stage in names}
    scene, frames = ExportedScene(inputs), Observations(inputs["ingest"].folder)
    look = painting_look(SimpleNamespace(inputs=inputs, settings=ExportSettings()), scene)
    rows, columns = look.colours.shape[:2]
    if look.step != 1 or frames.positions_mm is not None:
        sys.exit(f"{folder}: expected a texel for a pixel and distant lamps; choose a smaller scene")
    files = sorted(folder.glob(f"export/*/exports/{FILES[name]}"), key=lambda file: file.stat().st_mtime)
    if not files:
        sys.exit(f"{folder}: no {FILES[name]}. Remedy: ./nishiki export {folder.name} {name}")
    material = getattr(look.gloss, name).of(np.arange(rows), np.arange(columns))
    base = decode(look.colours.reshape(-1, 3) / 255, "srgb")
    normals = look.normals.reshape(-1, 3) / 255 * 2 - 1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    photographs = Photographs(frames, scene)
    result: dict = {"scene": folder.name, "format": name, "pixels": rows * columns}
    with opened(name, files[-1], (rows, columns), scene.pitch_mm or 1) as draw:
        for group, lights in (("fitted", frames.fit_lights()), ("check", frames.check_lights())):
            found = {against: CodedErrors(len(lights)) for against in ("drawn", "formulas", "drawn against formulas")}
            strips = [strip for band in frames.bands() for strip in photographs.strips(band, lights)]
            for number, light in enumerate(lights):
                direction = frames.directions[light]
                drawn, covered = draw(direction)
                formulas = np.clip(encode(material.shown(base, normals, direction), "srgb"), 0, 1)
                formulas = formulas.reshape(rows, columns, 3)
                for band, values, valid in strips:
                    counted, own = valid[:, number] & covered[band].ravel(), formulas[band].reshape(-1, 3)
                    pairs = ((drawn, values[:, number]), (formulas, values[:, number]), (drawn, own))
                    for errors, (shown, against) in zip(found.values(), pairs, strict=True):
                        errors.add(number, shown[band].reshape(-1, 3), against, counted)
            result[group] = {against: errors.decibels() for against, errors in found.items()}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format", choices=FILES)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE, with that export")
    options = parser.parse_args()
    if options.format == "gltf" and three_page.THREE is None:
        sys.exit("the npm package three is not installed. Remedy: npm install three, and NODE_PATH as its node_modules")
    for folder in options.folders:
        print(json.dumps(measured(options.format, folder)), flush=True)


if __name__ == "__main__":
    main()
