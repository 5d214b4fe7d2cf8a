"""Exports drawn by other programs, beside the formulas that their loss is reckoned with, and photographs.

    NODE_PATH=node_modules python benchmarks/exports_drawn.py three results/PAINTING ...
    python benchmarks/exports_drawn.py materialx results/SCENE ...
    NISHIKI_BPY=FOLDER python benchmarks/exports_drawn.py blender results/SCENE ...

three.js draws `gltf` of paintings, the shaders that MaterialX makes draw `materialx` of paintings and objects, Blender
`gltf` and `usd` of paintings and objects, and `gltf` of cloths; in the folder of a scene are its latest exports. One
JSON line for each file. PSNR of coded pictures, dB, peak 1: of the drawing and of the formulas against the photographs,
and of one against the other, over the pixels whose photograph is valid; of cloths over all pixels that show them.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import blender_scene
import materialx_page
import three_page
import viewer_pages

from nishiki.artifacts.artifact import open_artifact
from nishiki.brdf.texels.model import POINT
from nishiki.colour.colour import decode, encode
from nishiki.evaluate.object_photographs import Photographs as ObjectPhotographs
from nishiki.observations.plane import Observations
from nishiki.render.cloth.scene import ClothScene
from nishiki.render.cloth.studio import Lighting, RenderVariant, frame_camera, render
from nishiki.render.display import three_channels
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.cloth import LAMPS, VIEWS, ExportedCloth, fitted_cloth
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.object_look import SeenPoints, object_look, object_mesh, show_in
from nishiki.stages.export.registry import METRES, CodedErrors
from nishiki.stages.export.scene import CodedPhotographs, ExportedScene

FORMATS = {"three": ("gltf",), "materialx": ("materialx",), "blender": ("gltf", "usd")}
FILES = {"gltf": "{}.glb", "usd": "{}.usdz", "materialx": "materialx/{}.mtlx"}
CLOTH_SIDE = 256
"""Pixels along a side of the pictures of a cloth."""
AGAINST = ("drawn", "formulas", "drawn against formulas")


def latest(folder: Path, stage: str, file: str) -> Path | None:
    """The newest export of that name."""
    files = sorted(folder.glob(f"{stage}/*/exports/{file}"), key=lambda path: path.stat().st_mtime)
    return files[-1] if files else None


def coded(linear: np.ndarray) -> np.ndarray:
    """sRGB, in 0 to 1."""
    return np.clip(encode(np.clip(linear, 0, 1), "srgb"), 0, 1)


def decibels(theirs: np.ndarray, ours: np.ndarray) -> float:
    """PSNR of sRGB-coded values, peak 1."""
    return float(-10 * np.log10(np.mean(np.square(coded(theirs) - coded(ours)))))


def drawn_paintings(
    program: str, file: Path, shape: tuple[int, int], pitch_mm: float, lamps: np.ndarray, *, flat: bool
):
    """Coded pictures (lamps, rows, columns, 3) of a painting from the front, and where it covers them."""
    if program == "three":
        with three_page.opened(file) as draw:
            made = np.stack([draw(*shape, pitch_mm / 1000, lamp) for lamp in lamps])
        return made[..., :3] / 255, made[..., 3] == 255
    if program == "materialx":
        with materialx_page.opened(file, *shape) as draw:
            made = np.stack([draw(lamp) for lamp in lamps])
        return coded(made), np.ones(made.shape[:-1], bool)
    camera = blender_scene.above(*shape, pitch_mm / 1000)
    made = blender_scene.pictures(file, camera, [{"direction": lamp} for lamp in lamps], flat=flat)
    return coded(made[..., :3]), made[..., 3] > 0.99


def paintings(program: str, folder: Path) -> Iterator[dict]:
    """Figures of a painting's files, {fitted, check: {against: dB}}."""
    current = folder / "current"
    names = [stage for stage in ("ingest", "normals", "height", "spectra", "brdf") if (current / stage).exists()]
    inputs = {stage: open_artifact(current / stage) for stage in names}
    scene, frames = ExportedScene(inputs), Observations(inputs["ingest"].folder)
    look = PaintingSurface(SimpleNamespace(inputs=inputs, settings=ExportSettings()), scene).look
    shape = rows, columns = look.colours.shape[:2]
    if look.step != 1 or frames.positions_mm is not None:
        sys.exit(f"{folder}: expected a texel for a pixel and distant lamps; choose a smaller scene")
    base = decode(look.colours.reshape(-1, 3) / 255, "srgb")
    normals = look.normals.reshape(-1, 3) / 255 * 2 - 1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    photographs = CodedPhotographs(frames, scene)
    groups = {"fitted": frames.fit_lights(), "check": frames.check_lights()}
    for name in FORMATS[program]:
        file = latest(folder, "export", FILES[name].format("painting"))
        if file is None:
            continue
        material = getattr(look.gloss, name).of(np.arange(rows), np.arange(columns))
        for flat in (True, False) if program == "blender" else (False,):
            result = {"scene": folder.name, "program": program, "format": name, "flattened": flat}
            for group, lights in groups.items():
                directions = frames.directions[lights]
                pictures, covered = drawn_paintings(program, file, shape, scene.pitch_mm or 1, directions, flat=flat)
                found = {against: CodedErrors(len(lights)) for against in AGAINST}
                strips = [strip for band in frames.bands() for strip in photographs.strips(band, lights)]
                for number, direction in enumerate(directions):
                    formulas = coded(material.render(base, normals, direction)).reshape(rows, columns, 3)
                    for band, values, valid in strips:
                        counted = valid[number] & covered[number, band].ravel()
                        drawn, own = (each[band].reshape(-1, 3) for each in (pictures[number], formulas))
                        pairs = ((drawn, values[number].T), (own, values[number].T), (drawn, own))
                        for errors, (shown, other) in zip(found.values(), pairs, strict=True):
                            errors.add(number, shown, other, counted)
                result[group] = {against: errors.decibels() for against, errors in found.items()}
                result["covered"] = float(covered.mean())
            yield result


def objects(program: str, folder: Path, count: int) -> Iterator[dict]:
    """Figures of an object's files in some captured views under their first light."""
    names = ("ingest", "mesh", "cameras", "texels", "object_brdf", "residual", "polarise")
    inputs = {name: open_artifact(folder / "current" / name) for name in names if (folder / "current" / name).exists()}
    context = SimpleNamespace(inputs=inputs)
    look = object_look(context)
    decoded, metres = look.decoded, METRES.get(inputs["mesh"].diagnostics.get("unit"), 1.0)
    photographs = ObjectPhotographs(inputs)
    views = range(0, len(decoded.views), max(1, len(decoded.views) // count))
    for name in FORMATS[program]:
        file = latest(folder, "object_export", FILES[name].format("object"))
        if file is None:
            continue
        shown, errors = show_in(look, name), {against: CodedErrors(len(views)) for against in AGAINST}
        apart = CodedErrors(len(views))
        for number, view in enumerate(views):
            points, camera = SeenPoints.of(look, view), decoded.cameras[view]
            if points.lamp.form != POINT:
                sys.exit(f"{folder}: expected a lamp at a place; other lamps are not drawn here")
            picture = drawn_object(program, file, (context, look), camera, points.lamp.vector * metres, metres)
            there = picture[points.covered]
            distance = np.linalg.norm(points.positions - points.lamp.vector, axis=1) * metres
            falloff = points.factors()[1] * (distance**2 if program == "blender" else 1)
            light, formulas = look.scale * there[:, :3] * falloff[:, None], shown(points)
            linear, valid = photographs.read(view, 0)
            photograph = encode(three_channels(linear)[points.covered], decoded.encoding)
            theirs, ours = (np.clip(encode(np.maximum(each, 0), decoded.encoding), 0, 1) for each in (light, formulas))
            counted = valid[points.covered] & (there[:, 3] > 0.99)
            for each, pair in zip(
                errors.values(), ((theirs, photograph), (ours, photograph), (theirs, ours)), strict=True
            ):
                each.add(number, *pair, counted)
            apart.add(number, theirs, ours, counted & (there[:, :3].max(axis=1) > 0) & (formulas.max(axis=1) > 0))
        yield {
            "scene": folder.name,
            "program": program,
            "format": name,
            **{against: each.decibels() for against, each in errors.items()},
            "where both see the lamp": apart.decibels(),
        }


def drawn_object(program: str, file: Path, surface: tuple, camera, lamp: np.ndarray, metres: float) -> np.ndarray:
    """(rows, columns, 4) linear picture and coverage; of Blender under a lamp that counts 1 a metre away."""
    if program == "blender":
        place = {"position": lamp, "reference": 1.0}
        return blender_scene.pictures(file, blender_scene.pinhole(camera, metres), [place])[0]
    scaled = replace(camera, translation=camera.translation * metres)
    with materialx_page.opened_object(file, object_mesh(*surface), camera.rows, camera.columns) as draw:
        return draw(scaled, lamp)


def cloths(folder: Path) -> Iterator[dict]:
    """Figures of a cloth's file under the views and lamps that its loss is reckoned with, cast shadows included."""
    inputs = {name: open_artifact(folder / "current" / name) for name in ("cloth_brdf", "cloth_render")}
    cloth, file = ExportedCloth.of(inputs), latest(folder, "cloth_export", "cloth.glb")
    if file is None:
        return
    material, scene = fitted_cloth(cloth.brdf), ClothScene.of([cloth.draped.surface])
    found: dict[str, list[np.ndarray]] = {"formulas": [], "drawn": [], "model": []}
    for elevation, azimuth in np.radians(VIEWS):
        size = {"rows": CLOTH_SIDE, "columns": CLOTH_SIDE, "distance": cloth.shown.view.distance}
        points = cloth.draped.surface.mesh.vertices
        camera = frame_camera(points, elevation=elevation, azimuth=azimuth, **size)
        lamps = [Lighting(*np.radians(place), (1.0, 1.0, 1.0), 0.0).lamp(azimuth) for place in LAMPS]
        takes = [RenderVariant((brdf,), tuple(one)) for brdf in (material, cloth.brdf) for one in np.eye(len(lamps))]
        made = render(scene, takes, lamps, camera, supersampling=1, shadows=True)
        asked = [{"direction": lamp.direction} for lamp in lamps]
        drawn = blender_scene.pictures(file, blender_scene.pinhole(camera, 1.0), asked)
        for number, picture in enumerate(drawn):
            ours, model = made[number], made[len(lamps) + number]
            counted = (ours.coverage > 0) & (picture[..., 3] > 0.99)
            values = (ours.linear[counted], picture[..., :3][counted], model.linear[counted])
            for each, value in zip(found.values(), values, strict=True):
                each.append(value)
    joined = {name: np.concatenate(values) for name, values in found.items()}
    lit = (joined["formulas"].max(axis=1) > 0) & (joined["drawn"].max(axis=1) > 0)
    yield {
        "scene": folder.name,
        "program": "blender",
        "format": "gltf",
        "pictures": len(found["drawn"]),
        "drawn against formulas": decibels(joined["drawn"], joined["formulas"]),
        "where both see the lamp": decibels(joined["drawn"][lit], joined["formulas"][lit]),
        "drawn against model": decibels(joined["drawn"], joined["model"]),
        "formulas against model": decibels(joined["formulas"], joined["model"]),
    }


def missing(program: str) -> str | None:
    """Why a program cannot be asked here."""
    if program == "blender":
        return blender_scene.missing()
    if program == "three" and three_page.THREE is None:
        return "the npm package three is not installed. Remedy: npm install three, and NODE_PATH as its node_modules"
    return viewer_pages.missing()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", choices=FORMATS)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE, with such an export")
    parser.add_argument("--views", type=int, default=4, help="of an object")
    options = parser.parse_args()
    if missing(options.program):
        sys.exit(str(missing(options.program)))
    for folder in options.folders:
        if (folder / "current/cloth_brdf").exists():
            lines = cloths(folder)
        elif (folder / "current/object_brdf").exists():
            lines = objects(options.program, folder, options.views)
        else:
            lines = paintings(options.program, folder)
        for line in lines:
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
