"""Export files of an object for other programs: its views for viewers of museums, a scene of Mitsuba 3.

IIIF: tiles of Image API 3.0, level 0 (files alone), and a manifest of Presentation API 3.0 with a canvas for each view
of the capture. A canvas has three layers to choose from: the view as the coded object shows it, the fitted model alone,
and the normals. Views that were left out of the fit are predicted.
"""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.texels.model import DISTANT, POINT, ViewLamp, predict
from nishiki.colour.colour import decode, encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.formats.banded_pictures import ExrWriter, png_bytes, write_iiif_image
from nishiki.formats.mesh_heading import faces
from nishiki.formats.textured_surface import TexturedMesh, heading, sample, vertices
from nishiki.geometry.camera import NO_DISTORTION, Camera
from nishiki.geometry.mesh import Mesh
from nishiki.optional_formats.kintsugi import write_kintsugi
from nishiki.render.display import develop, normals_as_colours, three_channels
from nishiki.render.object.pixels import coverage
from nishiki.render.object.renderer import DecodedObject, ObjectRenderer
from nishiki.render.object.shots import ObjectPicture
from nishiki.stages.export import mitsuba_object
from nishiki.stages.export.iiif import QUALITY, canvas, image, manifest_of, tiles_psnr_db, write_manifest
from nishiki.stages.export.object_look import ObjectLook, ObjectSurface, SeenPoints
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
        pictures[name] = develop(three_channels(picture.linear) * share[..., None], share).pixels
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


FITTED_POINTS = 1000  # of the mesh, to which a pinhole is fitted


def write_mitsuba(context: Context, surface: ObjectSurface) -> dict:
    """Write the folder `mitsuba`: mesh, textures, captured views and lamps, and our reflection model in Python.

    Returns its errors, and how far its cameras are from the capture's.
    """
    look = surface.look
    parameters = surface.model
    unit = METRES.get(context.inputs["mesh"].diagnostics.get("unit"), 1.0)
    folder = context.output.path("exports/mitsuba/scene.json").parent
    figures = write_folder(folder, look, surface.mesh, parameters, unit=unit, stamp=context.stamp)
    return {**look.figures(), **figures, "kinds": {name: {"psnr_db": found} for name, found in errors(surface).items()}}


def write_folder(
    folder: Path,
    look: ObjectLook,
    mesh: TexturedMesh,
    parameters: dict[str, np.ndarray],
    *,
    unit: float,
    stamp: Mapping[str, str],
) -> dict:
    """Write the files; parameters: as of `ObjectSurface.model`; unit: metres of a length of 1 in the cameras' world.

    Returns the number of vertices, and `camera_px` as `scene_facts` has it.
    """
    decoded = look.decoded
    (folder / "object.ply").write_bytes(
        heading(len(mesh.positions), len(mesh.triangles))
        + vertices(mesh.positions, mesh.normals, mesh.texture)
        + faces(mesh.triangles)
    )
    header = {f"nishiki.{name}": text for name, text in stamp.items()}
    for name, values in parameters.items():
        channels = "RGB" if values.shape[2] == 3 else "Y"
        with ExrWriter(folder / f"{name}.exr", channels, values.shape[0], values.shape[1], header) as exr:
            exr.write(values)
    (folder / "colour.png").write_bytes(png_bytes(look.surface().pictures()["colour"]))
    facts, apart = scene_facts(decoded, mesh.positions, unit)
    facts |= {"colour_scale": look.scale, "stamp": dict(stamp)}
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_object.py").write_text(Path(mitsuba_object.__file__).read_text(encoding="utf-8"))
    return {"vertices": len(mesh.positions), "camera_px": apart}


def scene_facts(decoded: DecodedObject, positions: np.ndarray, unit: float) -> tuple[dict, float]:
    """Describe cameras and lamps of every captured view, lengths times `unit`.

    Also the largest distance in pixels between what the pinholes with square pixels show of `positions` and what the
    capture's cameras do.
    """
    middle, views, apart = positions.mean(axis=0), {}, 0.0
    points = positions / unit
    for name, camera in zip(decoded.views, decoded.cameras, strict=True):
        pinhole = nearest_pinhole(camera, points)
        apart = max(apart, float(np.linalg.norm(pinhole.project(points)[0] - camera.project(points)[0], axis=1).max()))
        lamps = {
            light: lamp_facts(decoded.lighting.lamp(camera, number), middle, unit)
            for number, light in enumerate(decoded.lights)
        }
        views[name] = {"camera": camera_facts(pinhole, positions, unit), "lamps": lamps}
    return {"views": views}, apart


def nearest_pinhole(camera: Camera, points: np.ndarray) -> Camera:
    """Fit the pinhole with square pixels at the camera's place, by least squares of the distances in pixels.

    It shows world points (n, 3) nearest to where the camera has them; the camera itself where it is one.

    Matrices without metric calibration, such as projective ones, have oblong pixels and an axis far off the picture.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    k, middle = camera.intrinsics, np.array([camera.columns - 1, camera.rows - 1]) / 2
    if not any(camera.distortion) and abs(k[0, 1]) + abs(k[0, 0] - k[1, 1]) < 1e-9 * k[0, 0]:
        return camera
    points = points[:: max(len(points) // FITTED_POINTS, 1)]
    seen = camera.project(points)[0]
    ahead = np.linalg.solve(k, [*middle, 1]) @ camera.rotation  # the first guess looks along the middle pixel
    ahead /= np.linalg.norm(ahead)
    right = camera.rotation[0] - ahead * (ahead @ camera.rotation[0])
    right /= np.linalg.norm(right)
    guess = np.stack([right, np.cross(ahead, right), ahead])

    def pinhole(unknowns: np.ndarray) -> Camera:
        rotation = Rotation.from_rotvec(unknowns[:3]).as_matrix() @ guess
        focal, (column, row) = k[0, 0] * np.exp(unknowns[3]), middle + k[0, 0] * unknowns[4:]
        square = np.array([[focal, 0, column], [0, focal, row], [0, 0, 1]])
        return replace(
            camera,
            intrinsics=square,
            rotation=rotation,
            translation=-rotation @ camera.centre,
            distortion=NO_DISTORTION,
        )

    found = least_squares(lambda unknowns: (pinhole(unknowns).project(points)[0] - seen).ravel(), np.zeros(6))
    return pinhole(found.x)


def camera_facts(camera: Camera, positions: np.ndarray, unit: float) -> dict:
    """Describe a pinhole as Mitsuba does: x left, y up, z ahead; `principal_offset` as shares of the size."""
    k, centre = camera.intrinsics, camera.centre * unit
    to_world = np.eye(4)
    to_world[:3] = np.column_stack([-camera.rotation[0], -camera.rotation[1], camera.rotation[2], centre])
    away = np.linalg.norm(positions - centre, axis=1)
    return {
        "to_world": to_world.tolist(),
        "field_of_view_deg": float(2 * np.degrees(np.arctan(camera.columns / (2 * k[0, 0])))),
        "principal_offset": [0.5 - (k[0, 2] + 0.5) / camera.columns, 0.5 - (k[1, 2] + 0.5) / camera.rows],
        "rows": camera.rows,
        "columns": camera.columns,
        "near": float(0.1 * away.min()),
        "far": float(10 * away.max()),
    }


def lamp_facts(lamp: ViewLamp, middle: np.ndarray, unit: float) -> dict:
    """Describe a lamp for scene.json.

    `distance` of a near one: at which a white that faces it shows 1; where it shows that at any distance (`falloff`
    false), that of the object's middle (3,), metres. Surroundings of unknown lamps are even light of their mean
    strength.
    """
    if lamp.form == POINT:
        position, known = np.asarray(lamp.vector, np.float64) * unit, lamp.reference > 0
        distance = lamp.reference * unit if known else float(np.linalg.norm(position - middle))
        return {"kind": "point", "position": position.tolist(), "distance": distance, "falloff": known}
    if lamp.form == DISTANT:
        return {"kind": "directional", "direction": (-np.asarray(lamp.vector, np.float64)).tolist()}
    mean = np.maximum(three_channels(lamp.harmonics[:1])[0], 0)
    return {"kind": "around", "radiance": mean.astype(float).tolist()}


def errors(surface: ObjectSurface) -> dict[str, dict]:
    """Compute the PSNR of the reflection model against photographs, with the colours of all photographs."""
    look, parameters = surface.look, surface.model
    colour = decode(look.colour / 255, "srgb")
    model = np.concatenate([colour * look.scale, parameters["ks"], parameters["sigma"]], axis=-1)

    def by_model(points: SeenPoints) -> np.ndarray:
        kd, ks, sigma = np.split(sample(model, points.places), [3, 6], axis=1)
        diffuse, gloss = predict(kd, ks, sigma[:, 0], points.positions, points.normals, points.centre, points.lamp)
        return diffuse + gloss

    return surface.compare({"model": by_model})


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
