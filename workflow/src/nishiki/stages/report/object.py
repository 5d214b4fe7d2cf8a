"""Object report: one page on a turntable scene, from the artifacts of all other stages."""

from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.stored import load_arrays
from nishiki.geometry.camera import load_cameras
from nishiki.report.page import (
    MOST_PICTURES,
    Block,
    Cell,
    Facts,
    Figure,
    Figures,
    Heading,
    Metric,
    Section,
    Table,
    film_and_notes,
)
from nishiki.report.pictures import bright_picture, encoded, file_picture
from nishiki.report.scene_page import SLIGHT, Head, SceneData, at, headline, write_scene_page
from nishiki.report.svg import GRID, PALETTE, SOFT, Drawing, figure, percent
from nishiki.stages.report.capture import export_section, facts_of_object
from nishiki.stages.report.object_reflection import model_section, residual_section
from nishiki.stages.table import chain_of


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    data = SceneData(context)
    ingest = data.diagnostics["ingest"]
    views = len(ingest["views"])
    one, many = "an object photographed from one place", f"an object on a turntable, photographed from {views} places"
    head = Head(
        title=ingest["capture"].get("title"),
        about=one if views == 1 else many,
        facts=facts_of_object(ingest),
        tiles=at_a_glance(data.diagnostics),
        verdict=object_headline(data.diagnostics),
        warnings=list(ingest.get("warnings") or []),
    )
    return write_scene_page(data, chain_of("turntable"), head, SECTIONS)


def at_a_glance(diagnostics: dict[str, dict[str, Any]]) -> list[Metric]:
    """Return the most important figures; diagnostics : by stage."""
    evaluation = diagnostics.get("object_evaluate") or {}
    psnr = evaluation.get("psnr") or {}
    total = at(evaluation, "bytes", "total") or at(diagnostics, "residual", "renderer_bytes", "total")
    tiles = [
        (at(psnr, "captured", "mean_psnr_db"), "dB", "rendered views against their photographs"),
        (at(_left_out(psnr), "mean_psnr_db"), "dB", "views that took no part, predicted"),
        (at(psnr, "model_alone", "mean_psnr_db"), "dB", "the reflection model alone"),
        (None if total is None else total / 1000, "kB", "everything that a renderer needs"),
        (evaluation.get("bits_per_object_pixel"), "bit", "a pixel of the object"),
        (at(diagnostics, "mesh", "triangles"), "", "triangles"),
    ]
    return [Metric(*tile) for tile in tiles if tile[0] is not None]


def _left_out(psnr: dict[str, Any]) -> dict[str, Any] | None:
    """Return the figures of the views that no fit used."""
    return next((part for name, part in psnr.items() if name.startswith("left_out") and part), None)


CLOSE, PLAIN = 1.0, 3.0  # % of full scale, rms, from which a rendered view is told from its photograph, and at a glance
FEW_VIEWS = 24  # of an object: steps of more than 15 degrees, between which gloss moves further than its width


def object_headline(diagnostics: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Return the headline of a turntable scene; diagnostics : of its stages."""
    psnr = at(diagnostics, "object_evaluate", "psnr") or {}
    left_out = _left_out(psnr)
    measured = [
        (error := 100 * 10 ** (-part["mean_psnr_db"] / 20), limit, f"{what} {figure(error, 2)} % of full scale")
        for part, what, limit in (
            (psnr.get("captured"), "rendered views differ from their photographs by", CLOSE),
            (left_out, "views that took no part are predicted with errors of", PLAIN),
        )
        if part
    ]
    covered = at(diagnostics, "mesh", "fit", "iou_mean")
    if covered is not None:
        measured.append((1 - covered, SLIGHT, f"the surface covers {100 * covered:.1f} % of the outlines"))
    ingest, views = diagnostics["ingest"], len(diagnostics["ingest"]["views"])
    unseen = at(diagnostics, "object_brdf", "unseen_share") or 0.0
    unit = (at(ingest, "capture", "turntable") or {}).get("unit", "mm")
    pictures = at(diagnostics, "residual", "pictures") or {}
    carried = "captured views are stored as pictures, because texels of the surface in as many bytes reach "
    carried += f"{figure(pictures.get('equal_bytes_psnr_db'), 3)} dB; these figures do not hold for views between them"
    scan = "give a mesh or scans of the object"
    scan += "" if "polarise" in diagnostics else ", or photograph it through polarisers"
    untested = "no view was left out to test views between the photographs"
    turn = "add a turn with the camera higher, or with the object laid down"
    advice = [
        (bool(pictures), carried, scan),
        (1 < views < FEW_VIEWS, f"{views} views are few", "photograph the object every ten degrees"),
        (unseen > SLIGHT, f"{100 * unseen:.0f} % of the surface is in no photograph", turn),
        (bool(psnr) and left_out is None, untested, "name some in the setting texels.hold_out"),
        (not ingest.get("boards"), "no white board: brightness is relative", "photograph a white board (--white)"),
        (unit in (None, "none"), "no unit of length: sizes are relative", "state turntable.unit"),
    ]
    return headline(measured, advice)


def rendered_section(data: SceneData) -> Section:
    """Return the rendered pictures, half as wide as the widest of the page."""
    render = data.inputs["object_render"]
    items = []
    for name in list(render.diagnostics["pictures"])[:MOST_PICTURES]:
        picture, note = bright_picture(render.path(f"{name}.png").read_bytes(), data.widest // 2)
        items.append(Figure(words(name), note, picture))
    intro = "Pictures computed from the decoded record: mesh, reflection model and residual."
    blocks = [intro, Figures(items, 3), *film_and_notes(render, "The turn", data.settings.video_mb)]
    return Section("rendered", "Rendered", blocks)


def words(name: str) -> str:
    """Describe a picture's file name in words."""
    kind, _, rest = name.partition("-")
    predicted = rest.endswith("-predicted")
    rest = rest.removesuffix("-predicted")
    text = f"Between views {rest.replace('-', ' and ')}" if kind == "between" else f"View {rest}"
    return text + (" (left out, predicted)" if predicted else "")


KINDS = {
    "captured": "captured views, decoded",
    "captured_truth": "captured views, decoded, against noise-free truth",
    "model_alone": "captured views, model alone",
    "left_out_interpolated": "views left out, residual of the neighbours",
    "left_out_model_alone": "views left out, model alone",
    "left_out_interpolated_truth": "views left out, residual of the neighbours, against noise-free truth",
}
"""Names in words of an evaluation's figures."""
PICTURES = {
    "photograph": ("Photograph", "the object's pixels as the camera saw them."),
    "rendered": ("Rendered", "model and residual, decoded."),
    "model": ("Model alone", "what the reflection model predicts without the residual."),
    "error": ("Difference", "between rendered view and photograph, enlarged."),
}


def comparison_section(data: SceneData) -> Section | None:
    """Return photograph, rendered view, model alone and difference of some views."""
    blocks: list[Block] = []
    for entry in data.evaluation.get("pictures") or []:
        arrays = load_arrays(data.inputs["object_evaluate"].path(entry["arrays"]))
        items = [
            Figure(heading, "" if blocks else caption, encoded(np.ascontiguousarray(arrays[key])))
            for key, (heading, caption) in PICTURES.items()
            if key in arrays
        ]
        if items:
            aside = "left out of everything, and predicted" if entry["left_out"] else "captured and coded"
            blocks += [Heading(f"View {entry['view']}", aside), Figures(items, 4)]
    return Section("comparison", "Photograph and rendering", blocks) if blocks else None


def views_section(data: SceneData) -> Section:
    """Return figures over all views of each kind of picture, and every view's."""
    evaluation = data.evaluation
    scale = "sRGB-coded" if evaluation["encoding"] == "srgb" else "linear"
    columns = {
        "views": "views",
        "mean dB": "mean_psnr_db",
        "covered dB": "mean_covered_psnr_db",
        "worst dB": "worst_psnr_db",
        "all pixels dB": "pooled_psnr_db",
        "similarity": "mean_similarity",
        "not covered": "uncovered_pixels",
        "beyond": "superfluous_pixels",
    }
    kinds = [
        (KINDS.get(name, name.replace("_", " ")), *(part[key] for key in columns.values()))
        for name, part in evaluation["figures"].items()
        if part
    ]
    caption = (
        f"PSNR against the photographs, peak: full scale of the {scale} values, over all pixels that the object's "
        "outline or the rendered surface takes up. Pixels of the outline that the surface does not reach, and pixels "
        "that it covers beyond the outline, count as errors; the second figure is without them."
    )
    left_out = evaluation["left_out"]
    return Section("views", "All views", [
        Table(("Pictures", *columns), kinds, "lrrrrrrrr", caption),
        f"Left out of carving, fits and residual, and predicted: {', '.join(left_out)}."
        if left_out
        else "No view was left out, so nothing is said here of views that were not captured.",
        "Each picture of every view is a row of `evaluation.csv`.",
    ])  # fmt: skip


def separation_section(data: SceneData) -> Section:
    """Write the results of polarisation separation, with the first pictures that the stage drew."""
    polarise = data.inputs["polarise"]
    shown = list((polarise.diagnostics.get("pictures") or {}).items())[:MOST_PICTURES]
    items = [
        Figure(
            f"View {view}: all light, diffuse, specular",
            "",
            file_picture(polarise.path(file).read_bytes(), data.widest),
        )
        for file, view in shown
    ]
    return Section("separation", "Separation", [*sentences(polarise.diagnostics), Figures(items)])


def sentences(diagnostics: dict[str, Any]) -> list[str]:
    """Return mean share of each component, of negative and of doubtful pixels; the white boards."""
    views = diagnostics.get("by_view") or []

    def mean(name: str) -> float | None:
        values = [view[name] for view in views if view.get(name) is not None]
        return float(np.mean(values)) if values else None

    negative, doubtful = (None if mean(name) is None else 100 * mean(name) for name in ("negative", "doubtful"))
    unit = {"white board": "1 is a white board", "full scale": "1 is the full scale of the camera"}
    texts = [
        "Diffuse and specular parts by the state of the polarisers. On average over the object's frames: diffuse "
        f"{figure(mean('diffuse'))}, specular {figure(mean('specular'))} ({unit[diagnostics['unit']]}). By the "
        f"formulas alone {percent(negative)} of the specular values are negative, which is noise, and "
        f"{percent(doubtful)} lie further below 0 than three standard deviations of their noise."
    ]
    changed = [view["changed"] for view in views if (view.get("changed") or {}).get("specular") is not None]
    if changed:
        diffuse, specular = (
            figure(float(np.mean([each[name] for each in changed]))) for name in ("diffuse", "specular")
        )
        texts.append(
            "Smoothing by the noise that was measured in the photographs changed the specular part by "
            f"{specular} and the diffuse part by {diffuse} (root mean squares)."
        )
    for light, board in (diagnostics.get("boards") or {}).items():
        if board and board.get("channel"):
            values = ", ".join(figure(value) for value in board["channel"])
            texts.append(f"White board under {light or 'lamp'}: β = {values} by channel.")
    return texts


MOST_MARKED, MOST_NAMED = 40, 12
"""Largest number of cameras with names, and approximate number of names drawn."""


def cameras_section(data: SceneData) -> Section:
    """Write the section on the cameras."""
    cameras = data.inputs["cameras"]
    held_out = set(data.inputs["texels"].settings["hold_out"]) if "texels" in data.inputs else set()
    diagnostics, views = cameras.diagnostics, load_cameras(cameras.path("cameras.json"))
    circle = diagnostics.get("circle") or {}
    centres = np.array([camera.centre for camera in views])
    drawing = turn_plot(centres, [camera.name for camera in views], held_out, circle.get("axis"), circle.get("centre"))
    caption = "Dots: views; open diamonds: views left out. The object's own frame: the camera goes round."
    return Section("cameras", "Cameras", [
        Figures([Figure("The turn, seen along its axis", caption, svg=drawing)]),
        Facts(facts(diagnostics, circle)),
    ])  # fmt: skip


def facts(diagnostics: dict[str, Any], circle: dict[str, Any]) -> list[tuple[str, str]]:
    """List label and text of facts on the cameras. diagnostics : of the stage; circle : a part of them."""
    errors = [value for value in (diagnostics.get("reprojection_px") or {}).values() if value is not None]
    error, estimate = "not known: the matrices were given", diagnostics.get("estimate")
    if errors:
        error = f"{figure(float(np.mean(errors)))} pixels on average, {figure(max(errors))} at worst"
    if estimate:
        error = f"{figure(estimate['left_out_px'])} pixels, between views that the fit did not compare"
    off_plane = None if circle.get("off_plane") is None else 100 * round(circle["off_plane"], 9)
    steps = circle.get("steps_deg") or []
    return [
        ("From", diagnostics.get("source") or "–"),
        ("Radius", figure(circle.get("radius"), 3, diagnostics.get("unit") or "")),
        ("Off its plane", f"{percent(off_plane)} of the radius at most"),
        ("Steps", f"{figure(min(steps, default=None), 4)}° to {figure(max(steps, default=None), 4)}°"),
        ("Reprojection error", error),
        *(estimate_facts(estimate, diagnostics.get("unit") or "") if estimate else ()),
    ]


def estimate_facts(estimate: dict[str, Any], unit: str) -> list[tuple[str, str]]:
    """List label and text of the uncertainty of cameras estimated from the photographs."""
    steps = "equal, as the left-out views prefer"
    if estimate["steps"] == "free":
        steps = f"not equal; each angle to {figure(estimate['angle_sd_deg'])}°"
    return [
        ("Focal length", f"{figure(estimate['focal_px'])} ± {figure(estimate['focal_sd_px'])} pixels, estimated"),
        ("Camera looks down by", f"{figure(estimate['tilt_deg'])}° ± {figure(estimate['tilt_sd_deg'])}°"),
        ("Steps of the turn", steps),
        ("Sense of the turn", f"the other sense fits worse, at {figure(estimate['mirror_ratio'])} times the cost"),
        ("Compared", f"outlines of all views, {estimate['matches']} features that two views share"),
        ("Scale", "arbitrary: no height was stated" if unit == "arbitrary" else "from the stated height"),
    ]


def turn_plot(centres: np.ndarray, names: list[str], held_out: set[str], axis=None, centre=None) -> str:
    """Draw cameras (views, 3) along the axis of the turn; held-out views are open diamonds.

    axis, centre: of the circle; where they are not known, of the plane that fits the cameras best.
    """
    centres = np.asarray(centres, float).reshape(-1, 3)
    middle = np.asarray(centre, float) if centre is not None else centres.mean(axis=0)
    if axis is None:
        axis = np.linalg.svd(centres - middle)[2][2] if len(centres) > 2 else np.array([0.0, 1.0, 0.0])
    right, ahead = _across(np.asarray(axis, float))
    flat = np.stack([(centres - middle) @ right, (middle - centres) @ ahead], axis=1)
    reach = max(float(np.abs(flat).max(initial=0)), 1e-12)
    half = 170
    places = flat * (half - 34) / reach
    drawing = Drawing(2 * half, 2 * half, "places of the cameras seen along the axis of the turn")
    radius = float(np.median(np.linalg.norm(places, axis=1))) if len(places) else 0.0
    drawing.circle(half, half, radius, stroke=GRID)
    drawing.path(f"M{half - 5} {half}h10M{half} {half - 5}v10", stroke=SOFT)
    for (x, y), name in zip(places, names, strict=True):
        if name in held_out:
            drawing.diamond(half + x, half + y, 6, fill="#fff", stroke=PALETTE[1], width=2, tip=f"{name} (left out)")
        else:
            drawing.circle(half + x, half + y, 4, fill=PALETTE[0], tip=name)
    if len(names) <= MOST_MARKED:
        for (x, y), name in list(zip(places, names, strict=True))[:: max(1, len(names) // MOST_NAMED)]:
            out = 1 + 15 / max(float(np.hypot(x, y)), 1e-9)
            drawing.text(half + x * out, half + y * out + 4, name, anchor="middle", size=10)
    return drawing.finish()


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors across an axis."""
    axis = axis / np.linalg.norm(axis)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    right = np.cross(helper, axis)
    right /= np.linalg.norm(right)
    return right, np.cross(axis, right)


def geometry_section(data: SceneData) -> Section:
    """Return counts, silhouettes and a picture of the surface."""
    mesh = data.inputs["mesh"]
    preview = file_picture(mesh.path("preview.png").read_bytes(), data.widest)
    figure = Figure("The surface", "as the stage mesh drew it.", preview)
    return Section("geometry", "Geometry", [Table((), rows(mesh.diagnostics), "lr"), Figures([figure])])


SURFACE = {
    "triangles before decimation": ("decimation", "triangles_before"),
    "deviation by decimation, pixels": ("decimation", "deviation_px"),
    "silhouettes covered (IoU), mean": ("fit", "iou_mean"),
    "silhouettes covered (IoU), least": ("fit", "iou_least"),
    "of views left out (IoU), mean": ("fit", "iou_held_out"),
}
"""Labels of the mesh's diagnostics, by their paths."""


def rows(mesh: dict[str, Any]) -> list[tuple[str, Cell]]:
    """List label and value of facts on the surface; mesh : diagnostics of the stage."""
    values: list[tuple[str, Cell]] = [(name, mesh.get(name)) for name in ("source", "unit", "vertices", "triangles")]
    values.append(("watertight", {True: "yes", False: "no"}.get(mesh.get("watertight"))))
    values += [("parts", mesh.get("parts")), ("holes through the body (genus)", mesh.get("genus"))]
    for name, count in (mesh.get("cleaned") or {}).items():
        values.append((f"removed or mended: {name.replace('_', ' ')}", count or None))
    values += [(label, at(mesh, *path)) for label, path in SURFACE.items()]
    return [(name, value) for name, value in values if value is not None]


SECTIONS = (
    ("object_render", rendered_section),
    ("object_evaluate", comparison_section),
    ("object_evaluate", views_section),
    ("object_brdf", model_section),
    ("residual", residual_section),
    ("polarise", separation_section),
    ("mesh", geometry_section),
    ("cameras", cameras_section),
    ("object_export", export_section),
)
"""Sections of the page in their order, each with the stage without which it is left out."""
