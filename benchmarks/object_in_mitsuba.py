"""Objects exported for Mitsuba 3, rendered by it beside our own pictures of the model without its residual.

    python benchmarks/object_in_mitsuba.py results/SCENE ... [--views 4] [--variant llvm_ad_rgb]

Needs Mitsuba (group path-tracing) and `./nishiki export SCENE mitsuba`. Along the rays through the middles of the
pixels that show the object, in captured views, direct light with cast shadows, linear values. One JSON line a view:

    points       relative difference from our model at the very point behind a pixel: median, 99th percentile, share
                 of the pixels above 1 %, where both see the lamp
    pictures     the same against `object_render`, which shades texels and interpolates their coded values; `db`: of the
                 coded pictures where both see the lamp, `db_all`: with cast shadows
    texels       our model at texels, interpolated, from the same textures, against `object_render`: what is left where
                 that is done in Mitsuba's place
    shadow       share of the pixels that only Mitsuba has in shadow
"""

import argparse
import importlib.util
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.artifacts.artifact import open_artifact
from nishiki.atlas.surface import texel_points
from nishiki.brdf.texels.model import predict
from nishiki.colour.colour import decode, encode
from nishiki.formats.textured_surface import sample
from nishiki.render.display import three_channels
from nishiki.render.object.renderer import DecodedObject
from nishiki.stages.export.object_look import SeenPoints, TextureAtlas, model_textures, texture_atlas
from nishiki.stages.export.registry import METRES

DARK = 1e-6


def module_of(folder: Path):
    """The exported module, its model registered."""
    spec = importlib.util.spec_from_file_location("nishiki_object", folder / "nishiki_object.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.define()
    return module


def along_rays(mi, scene, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(n, 3) what a scene shows along rays (n, 3) from one place."""
    sampler, integrator = mi.load_dict({"type": "independent"}), scene.integrator()
    if mi.variant().startswith("scalar"):
        sampler.seed(0, 1)
        seen = [integrator.sample(scene, sampler, mi.Ray3f(origin.tolist(), ray.tolist()))[0] for ray in rays]
        return np.array(seen)
    sampler.seed(0, len(rays))
    directions = mi.Vector3f(*(mi.Float(np.ascontiguousarray(axis, np.float32)) for axis in rays.T))
    ray = mi.RayDifferential3f(mi.Point3f(*origin.tolist()), directions)
    return np.array(integrator.sample(scene, sampler, ray)[0]).T


def differences(theirs: np.ndarray, ours: np.ndarray) -> dict[str, float]:
    """Relative differences of the means over the channels."""
    apart = np.abs(theirs.mean(axis=-1) / ours.mean(axis=-1) - 1)
    return {
        "median": float(np.median(apart)),
        "p99": float(np.percentile(apart, 99)),
        "above": float((apart > 0.01).mean()),
    }


def decibels(theirs: np.ndarray, ours: np.ndarray) -> float:
    """PSNR of sRGB-coded values, peak 1."""
    coded = (encode(np.clip(each, 0, 1), "srgb") for each in (theirs, ours))
    return float(-10 * np.log10(np.mean(np.square(np.subtract(*coded)))))


def by_texels(decoded: DecodedObject, layout: TextureAtlas, points: SeenPoints) -> np.ndarray:
    """(n, 3) what the model shows at seen points where it is evaluated at texels, as `object_render` does it."""
    shaded = np.zeros((*layout.shape, 3), np.float32)
    for tile, (row, column) in enumerate(layout.origin):
        kd, ks, sigma = (np.asarray(values, np.float32) for values in decoded.residual.parameters(tile))
        positions, normals, inside = (
            values[0]
            for values in texel_points(decoded.mesh, decoded.atlas, decoded.texel_triangles, slice(tile, tile + 1))
        )
        light = sum(predict(kd, ks, sigma, positions, normals, points.centre, points.lamp))
        window = (slice(row, row + len(kd)), slice(column, column + len(kd)))
        shaded[window][inside] = encode(three_channels(light), decoded.encoding)[inside]
    return decode(sample(shaded, points.places), decoded.encoding)


def measured(mi, folder: Path, count: int):
    """Figures of some views of a scene."""
    names = ("ingest", "mesh", "cameras", "texels", "object_brdf", "residual")
    inputs = {name: open_artifact(folder / "current" / name) for name in names}
    made = sorted(folder.glob("object_export/*/exports/mitsuba"), key=lambda path: path.stat().st_mtime)
    if not made:
        sys.exit(f"{folder}: no export for Mitsuba. Remedy: ./nishiki export {folder.name} mitsuba")
    decoded, module = DecodedObject.open(inputs), module_of(made[-1])
    layout, unit = texture_atlas(decoded.atlas), METRES.get(inputs["mesh"].diagnostics.get("unit"), 1.0)
    textures = np.concatenate(list(model_textures(decoded, layout).values()), axis=-1)
    renderer = decoded.renderer(model_only=True)
    for view in range(0, len(decoded.views), max(1, len(decoded.views) // count)):
        camera = decoded.cameras[view]
        points = SeenPoints.of(SimpleNamespace(decoded=decoded, layout=layout), view)
        kd, ks, sigma = np.split(sample(textures, points.places), [3, 6], axis=1)
        modelled = predict(kd, ks, sigma[:, 0], points.positions, points.normals, points.centre, points.lamp)
        picture = three_channels(next(renderer.render([renderer.captured(view)])).linear)[points.covered]
        scene = mi.load_dict(module.description(view=decoded.views[view], body="model", folder=made[-1]))
        rays = points.positions - camera.centre
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        theirs = along_rays(mi, scene, camera.centre * unit, rays)
        light = sum(modelled)
        both = (theirs.mean(axis=-1) > DARK) & (light.mean(axis=-1) > DARK)
        yield {
            "scene": folder.name,
            "view": decoded.views[view],
            "pixels": len(rays),
            "points": differences(theirs[both], light[both]),
            "pictures": {
                **differences(theirs[both], picture[both]),
                "db": decibels(theirs[both], picture[both]),
                "db_all": decibels(theirs, picture),
            },
            "texels": differences(by_texels(decoded, layout, points)[both], picture[both]),
            "shadow": float(np.mean((theirs.mean(axis=-1) <= DARK) & (light.mean(axis=-1) > DARK))),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE, with the export mitsuba")
    parser.add_argument("--views", type=int, default=4, help="of each scene")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of Mitsuba; scalar_rgb needs no LLVM")
    options = parser.parse_args()
    import mitsuba as mi

    mi.set_variant(options.variant)
    for folder in options.folders:
        for line in measured(mi, folder, options.views):
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
