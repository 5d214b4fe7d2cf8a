"""Lay out the surface as tiles of texels, and sample every view on them."""

from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.atlas import quality
from nishiki.atlas.atlas import Atlas, build_atlas
from nishiki.atlas.charts import Charts, make_charts, probe_spacing, turning
from nishiki.atlas.write import Source, TexelsWriter
from nishiki.errors import UserError
from nishiki.evaluate.object_photographs import LinearPictures
from nishiki.formats.stored import open_array
from nishiki.geometry.camera import Camera, load_cameras
from nishiki.geometry.mesh import Mesh
from nishiki.observations.views import Views, encode
from nishiki.stages.texels import OUTPUTS, TexelsSettings


def run(context: Context) -> dict:
    """Lay out charts and atlas once, then read one view after another."""
    settings = context.settings
    views = Views(context.inputs["ingest"].folder)
    cameras = load_cameras(context.inputs["cameras"].path("cameras.json"))
    mesh = Mesh.load(context.inputs["mesh"].path("mesh.npz"))
    outlines = context.inputs["mesh"].path("silhouettes.zarr")
    silhouettes = open_array(outlines) if outlines.exists() else None
    check(views, cameras)
    charts, atlas = lay_out(mesh, [c for c in cameras if c.name not in settings.hold_out] or cameras, settings)
    source = LinearPictures(context.inputs)
    writer = TexelsWriter(
        context.output.folder,
        OUTPUTS,
        mesh,
        atlas,
        cameras,
        Source(
            views.lights,
            source.components,
            len(views.channels),
            views.encoding,
            views.full_turn,
            tuple(settings.hold_out),
        ),
        stamp=context.stamp,
    )
    facts = dict.fromkeys(("visible", "texels", "pixels", "silhouette", "uncovered"), 0)
    shares: list[float | None] = []
    for index in context.progress.over(range(len(cameras)), "view"):
        silhouette = None if silhouettes is None else silhouettes[index] != 0
        view = writer.view(index, silhouette)
        facts["pixels"] += len(view.places.row)
        shares.append(quality.texels_per_pixel(mesh, atlas, cameras[index], view.raster.triangle[view.shown]))
        if silhouette is not None:
            facts["silhouette"] += int(silhouette.sum())
            facts["uncovered"] += int((silhouette & (view.raster.triangle < 0)).sum())
        for light in range(len(views.lights)):
            pictures, valid = source.parts(index, light)
            # states of a polariser saturate one by one: what their sum would have been is not known
            saturated = source.find_saturated(index, light) if source.separated is None else None
            count = writer.pictures(view, light, pictures, valid, saturated)
            if cameras[index].name not in settings.hold_out:
                facts["visible"] += count["visible"]
                facts["texels"] += count["inside"]
    write_preview(context.output.path("preview.png"), atlas, writer.finish(), views.encoding)
    return describe_texels(mesh, charts, atlas, writer, {**facts, "per_pixel": shares})


def check(views: Views, cameras: list[Camera]) -> None:
    """Raise UserError where cameras and photographs do not belong together."""
    names = tuple(camera.name for camera in cameras)
    if names != tuple(views.views):
        raise UserError(
            f"the cameras are of the views {', '.join(names[:5])} ..., the photographs of {', '.join(views.views[:5])}"
            " ...; expected the same. Remedy: give artifacts of the same capture"
        )
    for camera in cameras:
        if (camera.rows, camera.columns) != tuple(views.shape):
            raise UserError(
                f"view {camera.name}: the camera is of pictures of {camera.rows} x {camera.columns} pixels, the "
                f"photograph has {views.shape[0]} x {views.shape[1]}. Remedy: calibrate at the size of the photographs"
            )


def lay_out(mesh: Mesh, cameras: list[Camera], settings: TexelsSettings) -> tuple[Charts, Atlas]:
    """Compute charts of the mesh, and tiles as dense as the capture's own sampling."""
    if not len(mesh.triangles):
        raise UserError("the mesh has no triangles. Remedy: look at the silhouettes or scans of the stage mesh")
    up, front = turning(cameras)
    charts = make_charts(
        mesh, up=up, front=front, spacing=probe_spacing(mesh, cameras, texels_per_pixel=settings.texels_per_pixel)
    )
    density = quality.sampling_density(mesh, charts.plane, cameras)
    scale = quality.texels_per_unit(density, charts.plane, charts.chart, texels_per_pixel=settings.texels_per_pixel)
    return charts, build_atlas(charts.plane, charts.chart, scale, size=settings.tile)


def write_preview(path: Path, atlas: Atlas, texels: np.ndarray, encoding: str) -> None:
    """Write the mean colour of every texel, chart by chart; grey where no observation covers it."""
    import cv2

    picture = quality.atlas_picture(atlas, texels)
    known = np.isfinite(picture).all(axis=2)
    top = np.percentile(picture[known], 99.5) if known.any() and encoding == "linear" else 1.0
    shown = np.clip(encode(np.nan_to_num(picture) / max(float(top), 1e-12), "srgb"), 0, 1)
    shown = shown[..., [0, 0, 0]] if shown.shape[2] < 3 else shown[..., 2::-1]
    shown = np.where(known[..., None], shown, 0.25)
    cv2.imwrite(str(path), np.round(shown * 255).astype(np.uint8))


def describe_texels(mesh: Mesh, charts: Charts, atlas: Atlas, writer: TexelsWriter, facts: dict) -> dict:
    """Return diagnostics."""
    stretch = quality.stretch_percentiles(mesh, atlas)
    per_pixel = [value for value in facts["per_pixel"] if value is not None]
    return {
        "charts": len(charts.frames.direction),
        "tiles": atlas.tiles,
        "tile": atlas.size,
        "texels_inside": int(writer.inside.sum()),
        "texels_per_pixel": float(np.median(per_pixel)) if per_pixel else None,
        "object_pixels": facts["pixels"],
        "visible_share": facts["visible"] / max(1, facts["texels"]),
        "silhouette_uncovered_share": facts["uncovered"] / facts["silhouette"] if facts["silhouette"] else None,
        "stretch_percentiles": dict(zip(("50", "90", "99", "100"), stretch, strict=True)),
        "smoothing_rounds": charts.smoothing_rounds,
        "degenerate_triangles": charts.degenerate,
        "split_off_flipped": charts.flipped,
        "split_off_overlapping": charts.overlapped,
        "components": list(writer.components),
    }
