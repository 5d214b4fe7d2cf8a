"""A painting for renderers: a scene of Mitsuba 3, and tables of the MERL database."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.torrance_sparrow import MIRROR, body_factor, specular, transmittance
from nishiki.errors import require
from nishiki.formats.banded_pictures import ExrWriter
from nishiki.formats.merl import MERL_HIDDEN, merl_bytes, merl_directions
from nishiki.formats.textured_surface import faces, heading, vertices
from nishiki.stages.export import mitsuba_paint
from nishiki.stages.export.scene import ExportedScene, reliefs

UP = np.array([0.0, 0.0, 1.0])
GLOSS = {"beta": "beta", "gamma": "gamma", "index": "refractive_index", "transmission": "transmission"}
Texture = Callable[[slice], np.ndarray]
"""Some rows of a texture, of the picture's columns."""


def write_mitsuba(context: Context, scene: ExportedScene) -> dict:
    """Write the folder `mitsuba`; return what of the model it leaves out."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    textures = model_textures(scene)
    header = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    for name, read in textures.items():
        channels = "Y" if name == "regions" else "RGB"
        with ExrWriter(folder / f"{name}.exr", channels, *scene.shape, header) as exr:
            for rows in scene.bands():
                exr.write(read(rows).reshape(-1, scene.shape[1], len(channels)))
    count = write_relief(folder, context, scene)
    gloss = (getattr(scene.gloss, name).tolist() for name in GLOSS.values())
    facts = {
        "rows": scene.shape[0],
        "columns": scene.shape[1],
        "width": scene.shape[1] * scene.pitch,
        "height": scene.shape[0] * scene.pitch,
        "unit": scene.unit,
        "textures": list(textures),
        "shadows": scene.casts_shadows,
        "gloss": {"regions": [dict(zip(GLOSS, each, strict=True)) for each in zip(*gloss, strict=True)]},
        "stamp": dict(context.stamp),
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_paint.py").write_text(Path(mitsuba_paint.__file__).read_text(encoding="utf-8"))
    clipped = sum(int(np.count_nonzero(scene.srgb(rows) < 0)) for rows in scene.bands())
    return {"vertices": count, "clipped": clipped / (3 * scene.shape[0] * scene.shape[1])}


def model_textures(scene: ExportedScene) -> dict[str, Texture]:
    """Return what `nishiki_paint.py` reads, by name."""
    textures: dict[str, Texture] = {
        "albedo": scene.srgb,
        "normals": scene.shading_normals,
        "shading": lambda rows: body_terms(scene, rows),
    }
    if not scene.casts_shadows:
        textures["directional"] = lambda rows: np.pad(require(scene.shading(rows))[..., 3:], ((0, 0), (0, 0), (0, 1)))
    if scene.gloss.beta.any():
        textures["slopes"] = scene.slopes
    if len(scene.gloss.beta) > 1:
        textures["regions"] = scene.regions
    return textures


def body_terms(scene: ExportedScene, rows: slice) -> np.ndarray:
    """Return (r, columns, 3) terms a, b, d of the body shading, (1, 0, 0) for Lambert's law."""
    terms = scene.shading(rows)
    return np.full((*scene.known(rows).shape, 3), [1, 0, 0], np.float32) if terms is None else terms[..., :3]


def write_relief(folder: Path, context: Context, scene: ExportedScene) -> int:
    """Write relief.ply, the displaced plane with its texture coordinates, and flat.ply; return the count of vertices.

    Their normals are those of the plane: the model takes those of the faces.
    """
    most = context.settings.mesh_vertices
    counts = np.sum([(len(band.places), len(band.triangles)) for band in reliefs(scene, most, colours=None)], axis=0)
    with open(folder / "relief.ply", "wb") as file:
        file.write(heading(*counts))
        for band in reliefs(scene, most, colours=None):
            file.write(vertices(band.places, np.broadcast_to(UP, band.places.shape), band.texture))
        for band in reliefs(scene, most, colours=None):
            file.write(faces(band.triangles))
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    size = np.array([scene.shape[1], scene.shape[0]]) * scene.pitch
    places = np.column_stack([(corners - 0.5) * size * [1, -1], np.zeros(4)])
    flat = heading(4, 2) + vertices(places, np.tile(UP, (4, 1)), corners) + faces(np.array([[0, 2, 1], [1, 2, 3]]))
    (folder / "flat.ply").write_bytes(flat)
    return int(counts[0])


def write_merl(context: Context, scene: ExportedScene) -> dict:
    """Write a table a region: its lobes, and the mean of its body colour and body shading."""
    beta, gamma, index, lost = (getattr(scene.gloss, name) for name in GLOSS.values())
    labels = scene.regions(slice(0, scene.shape[0])) if len(index) > 1 else None
    light, view = merl_directions()
    spreads = []
    for region in range(len(index)):
        colour, shading, spread = mean_body(scene, labels, region)
        if colour is None:
            continue
        brdf = brdf_of(light, view, colour, shading, beta[region], gamma[region], index[region], lost[region])
        context.output.path(f"exports/merl/region-{region}.binary").write_bytes(merl_bytes(brdf))
        spreads.append(spread)
    return {"colour_spread": spreads}


def mean_body(
    scene: ExportedScene, labels: np.ndarray | None, region: int
) -> tuple[np.ndarray | None, np.ndarray, float]:
    """Return mean linear sRGB (3,) and terms of the body shading (3,) of a region, and the spread of its colour.

    The spread is the root mean square distance from the mean, relative to it. None where no pixel has an estimate.
    """
    count, colours, squares, shadings = 0, np.zeros(3), np.zeros(3), np.zeros(3)
    for rows in scene.bands():
        chosen = scene.known(rows)
        if labels is not None:
            chosen &= labels[rows] == region
        colour = scene.srgb(rows)[chosen].astype(np.float64)
        count += len(colour)
        colours += colour.sum(axis=0)
        squares += (colour**2).sum(axis=0)
        shadings += body_terms(scene, rows)[chosen].sum(axis=0, dtype=np.float64)
    if not count:
        return None, shadings, 0.0
    mean = colours / count
    spread = np.sqrt(max(float((squares / count - mean**2).sum()), 0.0)) / max(float(np.linalg.norm(mean)), 1e-9)
    return mean, shadings / count, float(spread)


def brdf_of(light, view, colour, shading, beta, gamma, index, transmission) -> np.ndarray:
    """Return the BRDF (..., 3) per steradian; `MERL_HIDDEN` where light or view is below the surface.

    light, view (..., 3): unit vectors; colour (3,), shading (3,): of the body; beta, gamma (lobes,); index: of
    refraction; transmission: share of the surface's loss that the body's light suffers.
    """
    normal = np.array([0.0, 0.0, 1.0])
    towards_light, towards_view = light[..., 2], view[..., 2]
    middle = light + view
    along = middle[..., 2] / np.linalg.norm(middle, axis=-1)
    seen = (towards_light > 0) & (towards_view > 0)
    passed = [1 + transmission * (transmittance(cosine, index) - 1) for cosine in (towards_light, towards_view)]
    body = passed[0] * passed[1] * body_factor(shading, np.maximum(towards_light, 0), np.maximum(along, 0))
    gloss = sum(
        specular(normal, light, view, beta=b, gamma=g, refractive_index=index) for b, g in zip(beta, gamma, strict=True)
    )
    gloss = gloss / np.maximum(towards_light, 1e-9)
    if index >= MIRROR:  # a metal mirrors in its colour
        body, gloss = gloss, 0 * gloss
    values = (body[..., None] * colour + gloss[..., None]) / np.pi
    return np.where(seen[..., None], values, MERL_HIDDEN)
