"""Export: files of an object for other programs, among them its views for the viewers of libraries and museums.

IIIF: tiles of Image API 3.0, level 0 (files alone), and a manifest of Presentation API 3.0 with a canvas for each view
of the capture. A canvas has three layers to choose from: the view as the coded object shows it, the fitted model alone,
and the normals. Views that were left out of the fit are predicted.
"""

import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.colour.colour import encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.formats.banded_pictures import write_iiif_image
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.optional_formats.kintsugi import write_kintsugi
from nishiki.render.display import developed, normals_as_colours, three_channels
from nishiki.render.object.decoded_object import DecodedObject
from nishiki.render.object.renderer import ObjectRenderer, coverage
from nishiki.render.object.shots import ObjectPicture
from nishiki.stages.export.iiif import QUALITY, canvas, image, manifest_of, tiles_psnr_db, write_manifest
from nishiki.stages.export.object_look import ObjectSurface
from nishiki.stages.export.object_renderers import write_mitsuba
from nishiki.stages.export.registry import METRES, CodedErrors, write_formats, write_gltf, write_mtlx, write_usd

LAYERS = {
    "view": "As photographed, from the coded object",
    "model": "Fitted model alone: colour and gloss without the residual of the photographs",
    "normals": "Normals as colours: right red, up green, towards the camera blue",
}
BEHAVIOR = "individuals"  # of the manifest: each view is a picture of its own, none opens beside another as pages do


def write_iiif(context: Context, _surface: ObjectSurface) -> dict:
    """Write `manifest.json` and tiles for each view and layer; return errors against photographs."""
    decoded, photographs = DecodedObject.open(context.inputs), Photographs(context.inputs)
    left_out = decoded.numbers(context.settings.hold_out)
    address = context.settings.iiif.address.rstrip("/")
    folder = context.output.path("exports/iiif/manifest.json").parent
    whole, model = (decoded.renderer(without=left_out, model_only=alone) for alone in (False, True))
    places = range(len(decoded.views))
    shots = [whole.predicted(place) if place in left_out else whole.captured(place) for place in places]
    groups = {"fitted": [place for place in places if place not in left_out], "check": sorted(left_out)}
    errors = {name: (CodedErrors(len(views)), views) for name, views in groups.items() if views}
    kept: dict[str, list[float]] = {name: [] for name in LAYERS}
    canvases = []
    pairs = zip(whole.render(shots), model.render(shots), strict=True)
    for place, (shown, modelled) in zip(places, pairs, strict=True):
        view, camera = f"view-{place:03d}", shots[place].camera  # names of views may be no addresses
        pictures = layers(whole, camera, shown, modelled)
        shape = pictures["view"].shape[:2]
        for name, picture in pictures.items():
            with tempfile.TemporaryDirectory(dir=context.output.folder) as scratch:
                write_iiif_image(folder / view / name, f"{address}/{view}/{name}", picture, Path(scratch), QUALITY)
            kept[name].append(tiles_psnr_db(folder / view / name, picture))
        images = [image(f"{address}/{view}", name, label, shape) for name, label in LAYERS.items()]
        pitch = pitch_mm(decoded.mesh, camera, context.inputs["mesh"].diagnostics.get("unit"))
        made = canvas(f"{address}/canvas/{view}", images, shape, pitch)
        canvases.append({**made, "label": {"en": [f"View {decoded.views[place]}"]}})
        found, views = errors["check" if place in left_out else "fitted"]
        linear, valid = photographs.read(place, 0)
        drawn, seen = (encode(three_channels(each)[shown.covered], decoded.encoding) for each in (shown.linear, linear))
        found.add(views.index(place), drawn, seen, valid[shown.covered])
    content = manifest_of(context, address, canvases)
    write_manifest(folder, {**content, "behavior": [BEHAVIOR], "viewingDirection": "left-to-right"})
    return {
        "address": address,
        "views": len(canvases),
        "jpeg_psnr_db": {name: float(np.mean(each)) for name, each in kept.items()},
        "kinds": {"iiif": {"psnr_db": {name: found.decibels() for name, (found, _) in errors.items()}}},
    }


def layers(
    renderer: ObjectRenderer, camera: Camera, shown: ObjectPicture, modelled: ObjectPicture
) -> dict[str, np.ndarray]:
    """Render pictures (rows, columns, 3) uint8 of a view by layer, over black."""
    pictures = {}
    for name, picture in (("view", shown), ("model", modelled)):
        share = np.where(picture.reached, coverage(renderer.mesh, camera), 0).astype(np.float32)
        pictures[name] = developed(three_channels(picture.linear) * share[..., None], share).pixels
    normals = normals_as_colours(renderer.normals(shown, camera)) // 257
    pictures["normals"] = np.where(shown.covered[..., None], normals, 0).astype(np.uint8)
    return pictures


def pitch_mm(mesh: Mesh, camera: Camera, unit: str | None) -> float | None:
    """Compute the pixel size in mm at the distance of the object's middle; None without a unit of length."""
    if unit not in METRES:
        return None
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    depth = float((camera.rotation @ ((low + high) / 2) + camera.translation)[2])
    return 1000 * METRES[unit] * depth / float(camera.intrinsics[0, 0])


WRITERS = {
    "gltf": write_gltf,
    "usd": write_usd,
    "materialx": write_mtlx,
    "mitsuba": write_mitsuba,
    "iiif": write_iiif,
    "kintsugi": write_kintsugi,
}


def run(context: Context) -> dict:
    """Write every format that the settings name."""
    surface = ObjectSurface(context)
    return write_formats(context, {name: partial(write, context, surface) for name, write in WRITERS.items()})
