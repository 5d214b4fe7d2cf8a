"""Reflectance of the painting's regions as tables of the MERL database."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.body_shading import body_factor, transmittance
from nishiki.brdf.parameters import gloss_table
from nishiki.brdf.torrance_sparrow import specular
from nishiki.formats.merl import MERL_HIDDEN, merl_bytes, merl_directions
from nishiki.observations.plane import Observations
from nishiki.report.files import read_json
from nishiki.stages.export.scene import ExportedScene


def write(context: Context, scene: ExportedScene) -> dict:
    """A table a region: its lobes, and the mean of its body colour and body shading."""
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    beta, gamma, index, transmission = gloss_table(parameters)
    labels = Observations(context.inputs["ingest"].folder).regions if len(index) > 1 else None
    light, view = merl_directions()
    files, spreads = [], []
    for region in range(len(index)):
        colour, shading, spread = mean_body(scene, labels, region)
        if colour is None:
            continue
        brdf = brdf_of(light, view, colour, shading, beta[region], gamma[region], index[region], transmission)
        file = f"exports/merl/region-{region}.binary"
        context.output.path(file).write_bytes(merl_bytes(brdf))
        files.append(file)
        spreads.append(spread)
    return {"files": files, "colour_spread": spreads}


def mean_body(
    scene: ExportedScene, labels: np.ndarray | None, region: int
) -> tuple[np.ndarray | None, np.ndarray, float]:
    """Mean linear sRGB (3,) and terms of the body shading (3,) of a region, and the spread of its colour.

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
        shadings += scene.shading(rows)[chosen].sum(axis=0, dtype=np.float64)
    if not count:
        return None, shadings, 0.0
    mean = colours / count
    spread = np.sqrt(max(float((squares / count - mean**2).sum()), 0.0)) / max(float(np.linalg.norm(mean)), 1e-9)
    return mean, shadings / count, float(spread)


def brdf_of(light, view, colour, shading, beta, gamma, index, transmission) -> np.ndarray:
    """The BRDF (..., 3) per steradian; `MERL_HIDDEN` where light or view is below the surface.

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
    values = (body[..., None] * colour + (gloss / np.maximum(towards_light, 1e-9))[..., None]) / np.pi
    return np.where(seen[..., None], values, MERL_HIDDEN)
