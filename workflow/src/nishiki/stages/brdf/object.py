"""Reflection: Lambert's term and a lobe of facets at every texel of an object."""

import json
from dataclasses import asdict

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.atlas.store import Texels
from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.environment import settle
from nishiki.brdf.texels.model import CaptureLamps, factors
from nishiki.brdf.texels.object_fit import fit_lambert, fit_object
from nishiki.brdf.texels.parameters import ParameterWriter
from nishiki.brdf.texels.shading import refine_normals
from nishiki.brdf.texels.texel_fit import CaptureViews, Sample, Tile, sample_texels
from nishiki.colour.colour import encoding_slope
from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.model_selection.decision import Decision, decide_normals, decide_object_gloss, economy, unseen_gain
from nishiki.observations.views import Views
from nishiki.stages.brdf import OBJECT_OUTPUTS
from nishiki.threads import threads

SAMPLE, FEW = 12000, 4000  # texels that normals are found from, and light and gloss


def run(context: Context) -> dict:
    """Settle the lighting on a sample of texels, then fit tile by tile."""
    settings = context.settings
    texels, views = Texels(context.inputs["texels"].folder), Views(context.inputs["ingest"].folder)
    separated = settings.components != "total" and {"diffuse", "specular"} <= set(texels.components)
    read = reader(texels, separated, settings.hold_out)
    lighting, cameras, light_of = lamps(texels, views, settings.lighting)
    numbers = list(range(texels.tiles))
    every = sample_texels(read, numbers, SAMPLE)
    sample = every.thin(FEW)
    lighting, settled = settle(
        lighting, sample, cameras, light_of, falloff=settings.falloff, encoding=texels.encoding,
        beside=settings.lighting == "auto",
    )  # fmt: skip
    capture = CaptureViews(
        np.array([camera.centre for camera in cameras]),
        [lighting.lamp(camera, int(light)) for camera, light in zip(cameras, light_of, strict=True)],
        texels.encoding,
    )
    mesh, hidden = Mesh.load(context.inputs["mesh"].path("mesh.npz")), None
    if settings.normals == "auto":
        of_texels = texels.triangles.ravel()[every.texels]
        turned, hidden = refine_normals(mesh, every, of_texels, capture.centres, capture.lamps)
    better, normals = decide_normals(hidden)
    context.progress.tell(str(normals))
    if better:
        mesh = turned
        texels.turn_normals(mesh)
        sample = sample_texels(read, numbers, FEW)
    mesh.save(context.output.path("mesh.npz"))
    shape = texels.tiles, texels.size, texels.size, texels.channels
    out = ParameterWriter(context.output.folder, OBJECT_OUTPUTS, shape, stamp=context.stamp)
    context.progress.tell(f"{texels.tiles} tiles, {len(cameras)} observations")
    specular, decision = shows_gloss(sample, capture, settings.specular)
    context.progress.tell(str(decision))
    if specular:
        fit = fit_object(read, numbers, capture, out.write, threads=threads())
    else:
        fit = fit_lambert(read, numbers, capture, out.write, threads=threads())
    used = settings.components if separated else "total"
    report = {"lighting": lighting.as_dict(), "found": settled, "fit": asdict(fit), "components": used}
    report["specular"] = specular
    at_bounds = []
    if specular and fit.at_bound_share:
        share = f"{100 * fit.at_bound_share:.2g} %"
        at_bounds = [f"width of the lobe, {share} of the texels"]
    text = json.dumps(report, indent=1, sort_keys=True, allow_nan=False)
    context.output.path("object_brdf.json").write_text(text + "\n")
    return {
        "lighting": lighting.kind,
        **settled,
        **asdict(fit),
        "at_bounds": at_bounds,
        "components": used,
        "economy": economy(normals, decision),
    }


def shows_gloss(sample: Sample, capture: CaptureViews, setting: str) -> tuple[bool, Decision]:
    """Decide whether to fit the specular part, by the setting or a sample of texels; return the decision too."""
    if setting != "auto":
        return setting == "keep", decide_object_gloss(None, setting)
    shape = sample.visible.shape
    diffuse, attenuation, alpha, weights = (np.zeros(shape, np.float32) for _ in range(4))
    for o, (centre, lamp) in enumerate(zip(capture.centres, capture.lamps, strict=True)):
        irradiance, angles = factors(sample.positions, sample.normals, centre, lamp, 1)
        facing = np.maximum(angles[:, 1], 0)
        diffuse[:, o], alpha[:, o] = irradiance[:, 0], np.sqrt(angles[:, 2])
        attenuation[:, o] = angles[:, 0] / np.maximum(facing, GRAZING)
        weights[:, o] = sample.visible[:, o] * facing
    weights *= np.isfinite(sample.values).all(axis=-1)
    values = np.nan_to_num(sample.values)
    if capture.encoding == "srgb":
        weights *= encoding_slope(values.mean(axis=-1), "srgb") ** 2
    gain = unseen_gain(values, diffuse, attenuation, alpha, weights)
    return gain.keep, decide_object_gloss(gain, setting)


def lamps(texels: Texels, views: Views, kind: str) -> tuple[CaptureLamps, list, np.ndarray]:
    """Return the stated lighting, the camera of every observation and the index of its light."""
    count = len(texels.lights)
    stated = {"camera": {"kind": "camera"}, "fitted": {"kind": "unknown"}}.get(kind, views.lamp)
    lighting = CaptureLamps.from_capture(stated, lights=count, unit=views.unit)
    cameras = list(texels.cameras)
    if texels.observations != count * len(cameras):
        raise UserError(
            f"texels: {texels.observations} observations, expected {count} lights x {len(cameras)} views. Remedy: "
            "run the texels stage again."
        )
    light_of = np.repeat(np.arange(count), len(cameras))
    return lighting, cameras * count, light_of


def reader(texels: Texels, separated: bool, hold_out: tuple[str, ...]):
    """Return read(tile) for the fit; omitted views count as not visible, whatever the store holds."""
    kept = np.array([view not in hold_out for _ in texels.lights for view in texels.views])

    def read(tile: int) -> Tile:
        positions, normals, inside = texels.geometry(tile)
        visible = texels.visible(tile) & kept[:, None, None]
        if separated:
            values, specular = texels.read("diffuse", tile), texels.read("specular", tile)
            return Tile(values, visible, positions, normals, inside, specular)
        bounds = np.where(kept[:, None, None], texels.bounds(tile), 0)
        return Tile(texels.read("total", tile), visible, positions, normals, inside, saturated=bounds)

    return read
