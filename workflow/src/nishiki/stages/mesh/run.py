"""Mesh: the object's surface, from a file, from range scans, or carved from its silhouettes."""

from dataclasses import asdict

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.codec.compact import grid_step
from nishiki.errors import UserError
from nishiki.formats.problems import raise_errors
from nishiki.geometry.camera import Camera, read_cameras
from nishiki.geometry.cleaning import Defects, clean
from nishiki.geometry.coherence import measure_coherence
from nishiki.geometry.front_parts import find_front_parts
from nishiki.geometry.hollows import ShadingPhotographs, sink_hollows
from nishiki.geometry.hull import carve, usual_misses
from nishiki.geometry.mesh import Mesh, read_points, read_triangles, write_ply
from nishiki.geometry.placement import agreement, find_overruled, move_mesh, outline_of
from nishiki.geometry.silhouettes import display, inside_of, segment
from nishiki.geometry.surface import fewest_triangles, shape_of, smooth_outline_steps, snap, without_small_parts
from nishiki.observations.turntable_coherence import FEWEST_VIEWS, describe_coherence
from nishiki.observations.views import Views
from nishiki.render.display import write_png

COARSE_CELLS, HOLLOW_CELLS = 128, 96
PARTS_PX, HOLLOWS_PX = 200, 100
"""Root of the object's area in photographs that are searched for edges of front parts, and for hollows."""
DARK = 60
"""sRGB code (of 255) below which a pixel may lie in shadow: 4.5 % of white."""
PREVIEW_ROWS = 480  # pixels


def run(context: Context) -> dict:
    """Find the surface, clean and simplify it, and measure how well it fits the silhouettes."""
    settings = context.settings
    views = Views(context.inputs["ingest"].folder)
    document = read_cameras(context.inputs["cameras"].path("cameras.json"))
    cameras = [Camera.from_dict(values) for values in document["views"]]
    unknown = sorted(set(settings.hold_out) - set(views.views))
    if unknown:
        raise UserError(f"hold_out: no view {', '.join(unknown)}; there are: {', '.join(views.views)}")
    source = source_of(settings.source, views)
    used = [name not in settings.hold_out for name in views.views]
    outlines, covers, unsure, facts = find_outlines(context, views, source == "silhouettes")
    masks, diagnostics = list(outlines), expect_coherence(context, views, cameras, outlines)
    if source == "silhouettes":
        context.progress.tell("hull")
        masks, overruling = overrule(context, views, cameras, outlines, unsure, used)
        given, background = len(masks) - len(facts), background_of(context, views)
        diagnostics["silhouettes"] = {"given": given, "background": background, **overruling, "views": facts}
        kept = keep_usable(masks, used)
        covers = [
            mask if cover is None else np.where(mask > inside_of(cover), np.uint8(255), cover)
            for mask, cover in zip(masks, covers, strict=True)
        ]
        hull = carve(keep_usable(covers, used), cameras, cells=settings.cells)
        diagnostics["hull"] = {"cell": hull.cell, "shape": hull.volume.shape, "box": hull.box.tolist()}
        if settings.concavities:
            context.progress.tell("front parts")
            coarse = carve(kept, cameras, cells=HOLLOW_CELLS)
            parts = find_front_parts(
                clean_surface(coarse.mesh, cameras, 1.0)[0], photographs(views, cameras, kept, PARTS_PX)
            )
            diagnostics["front_parts"] = parts.pixels_beside()
            hull = hull.cut(parts)
        mesh = hull.mesh
        del hull  # frees the volume
        mesh, defects, small = clean_surface(mesh, cameras, settings.smooth)
        if settings.concavities:
            context.progress.tell("hollows")
            coarse, _, _ = clean_surface(coarse.cut(parts).mesh, cameras, max(1.0, settings.smooth))
            mesh, diagnostics["concavities"] = sink_hollows(mesh, coarse, photographs(views, cameras, kept, HOLLOWS_PX))
    else:
        read = read_file if source == "file" else merge_scans
        vertices, triangles, diagnostics[source] = read(context, views, cameras, document["mirror"])
        mesh, defects = sound(vertices, triangles, cameras)
        mesh, small = without_small_parts(mesh)
    light = fewest_triangles(mesh, cameras, deviation_px=settings.deviation_px, most=settings.most_triangles)
    step = grid_step(light.mesh, cameras)  # the coarsest grid that moves no vertex visibly
    mesh = snap(light.mesh, step)
    if source == "silhouettes":
        masks = [o | (mask & outline_of(mesh, c)) for o, mask, c in zip(outlines, masks, cameras, strict=True)]
    write(context, views, cameras, mesh, masks)
    deviations = {"deviation_px": light.deviation_px, "deviation_largest_px": light.deviation_largest_px}
    return {
        "source": source,
        "unit": document["unit"],
        **asdict(shape_of(mesh)),
        "cleaned": {**defects.as_dict(), "small_parts": small},
        "decimation": {"triangles_before": light.before, **deviations, "grid_step": step},
        **diagnostics,
        "fit": fit_of(mesh, cameras, outlines, used),
    }


def source_of(source: str, views: Views) -> str:
    """Return the source of the surface. UserError where the capture lacks the requested one."""
    there = {"file": bool(views.geometry["mesh"]), "scans": bool(views.geometry["scans"]), "silhouettes": True}
    if source == "auto":
        return next(name for name, available in there.items() if available)
    if not there[source]:
        key = "mesh" if source == "file" else "scans"
        raise UserError(f"mesh: the capture has no {source}. Remedy: give turntable.{key}, or another source")
    return source


def keep_usable(masks: list, used: list[bool]) -> list:
    """Return masks of the usable views, None for the others."""
    return [mask if use else None for mask, use in zip(masks, used, strict=True)]


def find_outlines(context: Context, views: Views, needed: bool) -> tuple[list[np.ndarray | None], list, list, dict]:
    """Return silhouettes, given or segmented; of segmented ones cover, pixels that may be object, figures by view."""
    outlines, facts = [views.silhouette(name) for name in views.views], {}
    covers: list[np.ndarray | None] = [None] * len(outlines)
    unsure = [None if outline is None else np.zeros_like(outline) for outline in outlines]
    missing = [place for place, outline in enumerate(outlines) if outline is None] if needed else []
    for place in context.progress.over(missing, "silhouette"):
        picture = display(views.mean_light(place))
        segmented = segment(picture, background=background_of(context, views))
        outlines[place], covers[place] = segmented.mask, segmented.cover
        unsure[place] = segmented.dropped | (picture.max(axis=-1) < DARK)
        figures = {name: value for name, value in vars(segmented).items() if name not in ("mask", "cover")}
        facts[views.views[place]] = {**figures, "dropped": int(segmented.dropped.sum())}
    return outlines, covers, unsure, facts


def background_of(context: Context, views: Views) -> str:
    """Return the background: the setting, else the capture's."""
    named = context.settings.background
    return named if named != "capture" else views.attributes.get("background") or "auto"


def expect_coherence(context: Context, views: Views, cameras: list[Camera], outlines: list) -> dict:
    """Measure the coherence of outlines and cameras, before any correction.

    Raises CaptureError with the remedy where they contradict each other, unless the limit `contradiction` is allowed.
    """
    places = [place for place, outline in enumerate(outlines) if outline is not None]
    if len(places) < FEWEST_VIEWS:
        return {}
    posed = [cameras[place] for place in places]
    given = {name: name for name in views.views if views.silhouette(name) is not None}
    misses = usual_misses(len(places) - len(given)) if context.settings.misses is None else context.settings.misses
    found = measure_coherence([outlines[place] for place in places], posed, misses=misses)
    problems = describe_coherence(found, posed, given)
    if "contradiction" not in context.settings.allow:
        raise_errors(problems)
    by_view = {camera.name: share for camera, share in zip(posed, found.by_view, strict=True)}
    return {"coherence": {"contradiction": found.contradiction, "by_view": by_view}}


def overrule(
    context: Context, views: Views, cameras: list[Camera], masks: list[np.ndarray], unsure: list, used: list[bool]
) -> tuple[list[np.ndarray], dict]:
    """Extend masks by the hull of the other views, and return figures of the change; unsure: see `find_overruled`.

    Given masks stay as they are unless the setting `misses` is a number.
    """
    settings, out, shares = context.settings, list(masks), {}
    misses = usual_misses(sum(used)) if settings.misses is None else settings.misses
    if not misses or sum(used) < misses + 2:
        return out, {}
    hull = carve(keep_usable(masks, used), cameras, cells=COARSE_CELLS, misses=misses)
    loose, _ = without_small_parts(hull.mesh)
    for place, name in enumerate(views.views):
        if settings.misses is not None or views.silhouette(name) is None:
            more = find_overruled(loose, cameras[place], masks[place], unsure[place], hull.cell)
            out[place], shares[name] = masks[place] | more, float(more.sum() / max(1, masks[place].sum()))
    mean = float(np.mean(list(shares.values()))) if shares else 0.0
    return out, {"overruled": {"misses": misses, "genus": shape_of(loose).genus, "mean": mean, "share": shares}}


def clean_surface(raw: Mesh, cameras: list[Camera], smooth_px: float) -> tuple[Mesh, Defects, int]:
    """Clean and smooth a hull's surface; return it with the defects and the small parts removed."""
    mesh, defects = clean(raw.vertices, raw.triangles, cameras=cameras)
    mesh, small = without_small_parts(mesh)
    return smooth_outline_steps(mesh, cameras, most_px=smooth_px), defects, small


def photographs(
    views: Views, cameras: list[Camera], masks: list[np.ndarray | None], size_px: float
) -> ShadingPhotographs:
    """Read the photographs of the views with a mask; size_px: root of the object's area to which they are shrunk."""
    used = [place for place, mask in enumerate(masks) if mask is not None]
    shown, posed = [masks[place] for place in used], [cameras[place] for place in used]
    return ShadingPhotographs.of(map(views.mean_light, used), shown, posed, size_px=size_px)


def read_file(context: Context, views: Views, cameras: list[Camera], mirror: list[int] | None):
    """Read vertices and triangles of the capture's mesh, in the cameras' world."""
    vertices, triangles = read_triangles(context.inputs["ingest"].path(views.geometry["mesh"]))
    if "mesh_placement" in views.attributes:
        vertices, triangles = move_mesh(vertices, triangles, *views.attributes["mesh_placement"])
    return (*undo_mirror(vertices, triangles, mirror), {"vertices": len(vertices), "triangles": len(triangles)})


def undo_mirror(vertices: np.ndarray, triangles: np.ndarray, mirror: list[int] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the same surface in the unmirrored world of the cameras stage; triangles keep facing outwards."""
    if mirror is None:
        return vertices, triangles
    return vertices * np.array(mirror, np.float64), triangles[:, ::-1]


def merge_scans(context: Context, views: Views, cameras: list[Camera], mirror: list[int] | None):
    """Merge range scans, registered to the first, in the cameras' world."""
    from nishiki.geometry.scans import merge, register

    folder, settings = context.inputs["ingest"], context.settings
    scans = [read_points(folder.path(name)) for name in views.geometry["scans"]]
    registered = register([points for points, _ in scans], overlap=settings.overlap)
    moved = [motion.apply(points) for motion, (points, _) in zip(registered.motions, scans, strict=True)]
    vertices, triangles, facts = merge(moved, [faces for _, faces in scans])
    return (*undo_mirror(vertices, triangles, mirror), {**registered.as_dict(), **facts})


def sound(vertices: np.ndarray, triangles: np.ndarray, cameras: list[Camera]):
    """Apply `clean`; raise UserError where nothing is left, or where a camera cannot see the surface."""
    try:
        mesh, defects = clean(vertices, triangles, cameras=cameras)
    except ValueError as error:
        raise UserError(f"mesh: {error}. Remedy: look at the mesh file") from None
    for camera in cameras:
        _, depth = camera.project(mesh.vertices)
        if (depth <= 0).all():
            raise UserError(
                f"mesh: the whole surface lies behind the camera of view {camera.name!r}. Remedy: mesh and cameras "
                "must be of one world; check units and axes"
            )
    return mesh, defects


def fit_of(mesh: Mesh, cameras: list[Camera], masks: list, used: list[bool]) -> dict | None:
    """Compute how well the mesh covers the silhouettes: intersection over union by view; held-out views apart."""
    known = [place for place, mask in enumerate(masks) if mask is not None]
    if not known:
        return None
    iou = {cameras[place].name: agreement(outline_of(mesh, cameras[place]), masks[place]) for place in known}
    left, carved = ([iou[cameras[place].name] for place in known if used[place] == use] for use in (False, True))
    mean, held_out = (float(np.mean(shares)) if shares else None for shares in (carved, left))
    return {"iou": iou, "iou_mean": mean, "iou_least": min(carved, default=None), "iou_held_out": held_out}


def write(context: Context, views: Views, cameras: list[Camera], mesh: Mesh, masks: list) -> None:
    """Write mesh, silhouettes where all are known, preview."""
    mesh.save(context.output.path("mesh.npz"))
    write_ply(context.output.path("mesh.ply"), mesh, stamp=context.stamp, unit=views.unit)
    if all(mask is not None for mask in masks):
        import zarr
        from zarr.codecs import ZstdCodec

        store = zarr.create_array(
            context.output.folder / "silhouettes.zarr",
            shape=(len(masks), *views.shape),
            chunks=(1, *views.shape),
            dtype="uint8",
            compressors=[ZstdCodec(level=5, checksum=True)],
            dimension_names=("view", "row", "column"),
            attributes={"stamp": context.stamp, "views": list(views.views)},
        )
        for place, mask in enumerate(masks):
            store[place] = mask.astype(np.uint8)
    write_png(context.output.path("preview.png"), preview(views, cameras, mesh), stamp=context.stamp)


def preview(views: Views, cameras: list[Camera], mesh: Mesh) -> np.ndarray:
    """Return (rows, columns, 3) uint8: photograph and shaded mesh in two views a quarter apart, side by side."""
    import cv2

    from nishiki.geometry.placement import shade_from_camera

    columns = []
    for place in sorted({0, len(cameras) // 4}):
        photograph = display(views.mean_light(place))
        columns.append(np.vstack([photograph, shade_from_camera(mesh, cameras[place])[..., None].repeat(3, axis=-1)]))
    sheet = np.hstack(columns)
    shrink = min(1.0, 2 * PREVIEW_ROWS / sheet.shape[0])
    size = (round(sheet.shape[1] * shrink), round(sheet.shape[0] * shrink))
    return sheet if shrink == 1 else cv2.resize(sheet, size, interpolation=cv2.INTER_AREA)
