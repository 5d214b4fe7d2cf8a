"""Tiles and manifest of the International Image Interoperability Framework, for viewers of libraries and museums.

Image API 3.0, level 0 (files alone, no image server), and Presentation API 3.0: one canvas with the layers to choose
from, its scale in millimetres (Physical Dimension service), and what capture.yaml says of object, maker and rights.
"""

import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.capture.schema import OBJECT_FACTS
from nishiki.colour.colour import srgb_encode
from nishiki.formats.banded_pictures import iiif_size, picture_on_disk, read_iiif_tiles, write_iiif_image
from nishiki.render.display import normals_as_colours
from nishiki.stages.export.scene import ExportedScene

PRESENTATION = "http://iiif.io/api/presentation/3/context.json"
PHYSICAL = "http://iiif.io/api/annex/services/physdim"
OPEN_RIGHTS = r"https?://(creativecommons\.org|rightsstatements\.org)/\S+"
"""Allowed values of `rights` in a manifest."""
QUALITY = 92  # of the JPEG tiles
RAKING = np.array([-np.cos(np.radians(20)), 0.0, np.sin(np.radians(20))])
"""Light of the relief picture: from the left, 20 degrees above the surface."""
ABOUT = {"object_id": "Object", **OBJECT_FACTS, "creator": "Photographs by", "date": "Photographed", "notes": "Notes"}


def colour(scene: ExportedScene, rows: slice) -> np.ndarray:
    """Return diffuse colour, sRGB."""
    return np.floor(255 * srgb_encode(scene.srgb(rows)) + 0.5)


def relief(scene: ExportedScene, rows: slice) -> np.ndarray:
    """Render the surface as grey plaster in raking light."""
    lit = np.maximum(scene.relief_normals(rows) @ RAKING, 0)
    return np.repeat(np.floor(255 * srgb_encode(lit)[..., None] + 0.5), 3, axis=-1)


def normals(scene: ExportedScene, rows: slice) -> np.ndarray:
    """Encode normals as colours, y up."""
    return normals_as_colours(scene.normals(rows)) // 257


LAYERS: dict[str, tuple[str, Callable[[ExportedScene, slice], np.ndarray]]] = {
    "colour": ("Colour of the surface in daylight (D65), without shading and gloss", colour),
    "relief": ("Relief in raking light from the left, 20° above the surface", relief),
    "normals": ("Normals as colours: right red, up green, towards the eye blue", normals),
}


def write_iiif(context: Context, scene: ExportedScene) -> dict:
    """Write the folder `iiif`: `manifest.json`, and a folder of tiles for each layer."""
    address = context.settings.iiif.address.rstrip("/")
    folder = context.output.path("exports/iiif/manifest.json").parent
    psnr_db = {}
    for name, (_, picture_of) in LAYERS.items():
        with tempfile.TemporaryDirectory(dir=context.output.folder) as scratch:
            picture = picture_on_disk(Path(scratch) / "picture", *scene.shape)
            for rows in scene.bands():
                picture[rows] = picture_of(scene, rows)
            write_iiif_image(folder / name, f"{address}/{name}", picture, Path(scratch), QUALITY)
            psnr_db[name] = tiles_psnr_db(folder / name, picture)
    write_manifest(folder, manifest(context, scene, address))
    return {"address": address, "jpeg_psnr_db": psnr_db}


def tiles_psnr_db(folder: Path, picture: np.ndarray) -> float:
    """Compute the PSNR of the tiles at full resolution against the coded picture; peak 255."""
    tiles = read_iiif_tiles(folder, *picture.shape[:2])
    squares = sum(float(np.square(tile - picture[window].astype(np.float32)).sum()) for window, tile in tiles)
    return float(10 * np.log10(255**2 * picture.size / max(squares, 1.0)))


def write_manifest(folder: Path, content: dict) -> None:
    """Write `manifest.json` of a folder."""
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    (folder / "manifest.json").write_text(text, encoding="utf-8")


def manifest(context: Context, scene: ExportedScene, address: str) -> dict:
    """Return the Presentation API's manifest of a painting, as plain data."""
    images = [image(address, name, label, scene.shape) for name, (label, _) in LAYERS.items()]
    return manifest_of(context, address, [canvas(f"{address}/canvas", images, scene.shape, scene.pitch_mm)])


def canvas(address: str, images: list[dict], shape: tuple[int, int], pitch_mm: float | None) -> dict:
    """Return a canvas of selectable layers; pitch_mm: size of its pixels on the object."""
    painted = {
        "id": f"{address}/painted", "type": "Annotation", "motivation": "painting", "target": address,
        "body": {"type": "Choice", "items": images},
    }  # fmt: skip
    page = {"id": f"{address}/page", "type": "AnnotationPage", "items": [painted]}
    shown = {"id": address, "type": "Canvas", "height": shape[0], "width": shape[1], "items": [page]}
    if pitch_mm:
        shown["service"] = [{
            "@context": f"{PHYSICAL}/1/context.json", "id": f"{address}/scale", "type": "Service", "profile": PHYSICAL,
            "physicalScale": pitch_mm, "physicalUnits": "mm",
        }]  # fmt: skip
    return shown


def manifest_of(context: Context, address: str, canvases: list[dict]) -> dict:
    """Return a manifest with these canvases, and object, maker and rights from capture.yaml."""
    about, stamp = context.inputs["ingest"].diagnostics["capture"], context.stamp
    facts = {label: about.get(key) for key, label in ABOUT.items()}
    facts["Made by"] = f"Nishiki {stamp['version']}: scene {stamp['scene']}, export {stamp['key']}"
    content = {
        "@context": PRESENTATION, "id": f"{address}/manifest.json", "type": "Manifest",
        "label": {"none": [about.get("title") or stamp["scene"]]},
        "metadata": [_pair(label, value) for label, value in facts.items() if value], "items": canvases,
    }  # fmt: skip
    rights = about.get("rights")
    if rights and re.fullmatch(OPEN_RIGHTS, rights):
        content["rights"] = rights
    elif rights:
        content["requiredStatement"] = _pair("Rights", rights)
    return content


def _pair(label: str, value: str) -> dict:
    return {"label": {"en": [label]}, "value": {"none": [value]}}


def image(address: str, name: str, label: str, shape: tuple[int, int]) -> dict:
    """Return a layer: its representative picture, and its tiles."""
    width, height = iiif_size(*shape)
    service = {"id": f"{address}/{name}", "type": "ImageService3", "profile": "level0"}
    return {
        "id": f"{address}/{name}/full/{width},{height}/0/default.jpg", "type": "Image", "format": "image/jpeg",
        "label": {"en": [label]}, "width": width, "height": height, "service": [service],
    }  # fmt: skip
