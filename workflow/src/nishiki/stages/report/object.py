"""Object report: one page on a turntable scene, from the artifacts of all other stages."""

from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.atlas.atlas import Atlas
from nishiki.atlas.quality import atlas_picture
from nishiki.atlas.store import ATLAS
from nishiki.brdf.texels.parameters import ParameterMaps, TexelFlag
from nishiki.formats.stored import load_arrays
from nishiki.geometry.camera import load_cameras
from nishiki.report.page import (
    MOST_PICTURES,
    Block,
    Cell,
    Figure,
    Figures,
    Fold,
    Heading,
    Metric,
    PageSection,
    Table,
    film_and_notes,
)
from nishiki.report.pictures import (
    bright_picture,
    brightening,
    colour_picture,
    describe_brightening,
    encode_picture,
    file_picture,
    scalar_picture,
    sea,
)
from nishiki.report.scene_page import SLIGHT, Head, SceneData, at, fact_rows, headline, write_scene_page
from nishiki.report.svg import bars, figure, lights_plot
from nishiki.stages.report.capture import export_section, facts_of_object
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


def rendered_section(data: SceneData) -> PageSection:
    """Return the rendered pictures, half as wide as the widest of the page."""
    render = data.inputs["object_render"]
    items = []
    for name in list(render.diagnostics["pictures"])[:MOST_PICTURES]:
        picture, note = bright_picture(render.path(f"{name}.png").read_bytes(), data.widest // 2)
        items.append(Figure(words(name), note, picture))
    intro = "Pictures computed from the decoded record: mesh, reflection model and residual."
    blocks = [intro, Figures(items, 3), *film_and_notes(render, "The turn", data.settings.video_mb)]
    return PageSection("rendered", "Rendered", blocks)


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


def comparison_section(data: SceneData) -> PageSection | None:
    """Return photograph, rendered view, model alone and difference of some views."""
    blocks: list[Block] = []
    for entry in data.evaluation.get("pictures") or []:
        arrays = load_arrays(data.inputs["object_evaluate"].path(entry["arrays"]))
        items = [
            Figure(heading, "" if blocks else caption, encode_picture(np.ascontiguousarray(arrays[key])))
            for key, (heading, caption) in PICTURES.items()
            if key in arrays
        ]
        if items:
            aside = "left out of everything, and predicted" if entry["left_out"] else "captured and coded"
            blocks += [Heading(f"View {entry['view']}", aside), Figures(items, 4)]
    return PageSection("comparison", "Photograph and rendering", blocks) if blocks else None


def views_section(data: SceneData) -> PageSection:
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
    return PageSection("views", "All views", [
        Table(("Pictures", *columns), kinds, "lrrrrrrrr", caption),
        f"Left out of carving, fits and residual, and predicted: {', '.join(left_out)}."
        if left_out
        else "No view was left out, so nothing is said here of views that were not captured.",
        "Each picture of every view is a row of object_evaluate/evaluation.csv.",
    ])  # fmt: skip


SEPARATION = (
    ("diffuse part, mean of the views", "by_view.diffuse", 1),
    ("specular part, mean of the views", "by_view.specular", 1),
    ("specular values below 0 by the formulas alone, which is noise, %", "by_view.negative", 100),
    ("of these further below 0 than three standard deviations of their noise, %", "by_view.doubtful", 100),
    ("change of the specular part by smoothing, rms", "by_view.changed.specular", 1),
    ("change of the diffuse part by smoothing, rms", "by_view.changed.diffuse", 1),
    ("value of 1 in these figures", "unit", 1),
)
"""Facts on the separation by the states of the polarisers, as of `fact_rows`."""


def separation_section(data: SceneData) -> PageSection:
    """Write the results of polarisation separation, with the first pictures that the stage drew."""
    polarise = data.inputs["polarise"]
    shown, path = list((polarise.diagnostics.get("pictures") or {}).items())[:MOST_PICTURES], polarise.path
    items = [
        Figure(f"View {view}: all light, diffuse, specular", "", file_picture(path(file).read_bytes(), data.widest))
        for file, view in shown
    ]
    return PageSection("separation", "Separation", [Table((), separation(polarise.diagnostics), "wr"), Figures(items)])


def separation(diagnostics: dict[str, Any]) -> list[tuple[str, Cell]]:
    """List label and value of facts on the separation, and β of the white boards by channel."""
    boards = (diagnostics.get("boards") or {}).items()
    return fact_rows(diagnostics, SEPARATION) + [
        (f"white board under {light or 'lamp'}: β by channel", ", ".join(map(figure, board["channel"])))
        for light, board in boards
        if board and board.get("channel")
    ]


def cameras_section(data: SceneData) -> PageSection:
    """Write the section on the cameras."""
    cameras = data.inputs["cameras"]
    held_out = set(data.inputs["texels"].settings["hold_out"]) if "texels" in data.inputs else set()
    diagnostics, views = cameras.diagnostics, load_cameras(cameras.path("cameras.json"))
    circle = diagnostics.get("circle") or {}
    centres = np.array([camera.centre for camera in views])
    drawing = turn_plot(centres, [camera.name for camera in views], held_out, circle.get("axis"), circle.get("centre"))
    caption = (
        "Dots: views; open diamonds: views left out; rings: 30°, 60° and 90° from the axis. In the object's own frame, "
        "the camera goes round."
    )
    uneven = at(diagnostics, "estimate", "uneven_steps_deg") or {}
    named = [(f"step unlike the others, {views}, degrees", step) for views, step in uneven.items()]
    return PageSection("cameras", "Cameras", [
        Figures([Figure("The turn, seen along its axis", caption, svg=drawing)]),
        Table((), [*fact_rows(diagnostics, CAMERAS), *named], "wr"),
    ])  # fmt: skip


CAMERAS = (
    ("from", "source", 1),
    ("unit of length", "unit", 1),
    ("radius of the turn", "circle.radius", 1),
    ("largest distance off its plane, % of the radius", "circle.off_plane", 100),
    ("steps of the turn, degrees", "circle.steps_deg", 1),
    ("reprojection error of a view, pixels", "reprojection_px", 1),
    ("error between views that the fit did not compare, pixels", "estimate.left_out_px", 1),
    ("focal length, estimated, pixels", "estimate.focal_px", 1),
    ("its standard deviation, pixels", "estimate.focal_sd_px", 1),
    ("camera looks down by, estimated, degrees", "estimate.tilt_deg", 1),
    ("its standard deviation, degrees", "estimate.tilt_sd_deg", 1),
    ("steps, as the left-out views prefer", "estimate.steps", 1),
    ("standard deviation of each step, degrees", "estimate.angle_sd_deg", 1),
    ("cost of the mirrored turn over that of this one", "estimate.mirror_ratio", 1),
    ("features that two views share, compared beside all outlines", "estimate.matches", 1),
)
"""Facts on the cameras, as of `fact_rows`."""


def turn_plot(centres: np.ndarray, names: list[str], held_out: set[str], axis=None, centre=None) -> str:
    """Draw the directions of cameras (views, 3) as lights are drawn, about the axis of the turn.

    axis, centre: of the circle; where they are not known, of the plane that fits the cameras best.
    """
    outwards = np.reshape(centres, (-1, 3)) - (np.mean(centres, axis=0) if centre is None else centre)
    frame = np.linalg.svd(outwards if axis is None else np.reshape(axis, (1, 3)))[2]
    frame = frame if axis is None else frame[[1, 2, 0]]
    directions = outwards @ (frame * np.linalg.det(frame)).T
    directions[:, 1:] *= 1 if directions[:, 2].sum() >= 0 else -1  # seen from the side of the cameras
    kinds = ["held out" if name in held_out else "sample" for name in names]
    title = "directions of the cameras, about the axis of the turn"
    return lights_plot(directions, names, kinds, title=title, sides=())


def geometry_section(data: SceneData) -> PageSection:
    """Return counts, silhouettes and a picture of the surface."""
    mesh = data.inputs["mesh"]
    preview = file_picture(mesh.path("preview.png").read_bytes(), data.widest)
    figure = Figure("The surface", "as the stage mesh drew it.", preview)
    cleaned = [name for name, count in (mesh.diagnostics.get("cleaned") or {}).items() if count]
    mended = [(f"removed or mended: {name.replace('_', ' ')}", f"cleaned.{name}", 1) for name in cleaned]
    rows = fact_rows(mesh.diagnostics, [*SURFACE, *mended])
    return PageSection("geometry", "Geometry", [Table((), rows, "lr"), Figures([figure])])


SURFACE = (
    *((name, name, 1) for name in ("source", "unit", "vertices", "triangles", "watertight", "parts")),
    ("holes through the body (genus)", "genus", 1),
    ("triangles before decimation", "decimation.triangles_before", 1),
    ("deviation by decimation, pixels", "decimation.deviation_px", 1),
    ("silhouettes covered (IoU), mean", "fit.iou_mean", 1),
    ("silhouettes covered (IoU), least", "fit.iou_least", 1),
    ("of views left out (IoU), mean", "fit.iou_held_out", 1),
)
"""Facts on the surface, as of `fact_rows`."""


LIGHTING = {
    "camera": "a lamp at the camera",
    "direction": "lamps of known direction",
    "position": "lamps at known places",
    "environment": "not stated; an irradiance over the normal was fitted",
}


MODEL = (
    ("texels", "texels", 1),
    ("visible samples", "samples", 1),
    ("model alone over these, dB", "psnr_db", 1),
    ("texels that a view shows near the mirror direction, %", "highlight_share", 100),
    ("median width of a highlight, degrees", "median_sigma", 180 / np.pi),
    ("texels whose highlight is that of neighbours, %", "filled_share", 100),
    ("texels as which the neighbours of a texel count for its highlight", "pull", 1),
    ("texels that no view shows, with everything of neighbours, %", "unseen_share", 100),
)
"""Facts on the reflection model, as of `fact_rows`."""


def model_section(data: SceneData) -> PageSection:
    """Write parameter maps as sheets of all charts, and the fit's diagnostics."""
    object_brdf = data.inputs["object_brdf"]
    maps, diagnostics = ParameterMaps(object_brdf.folder), object_brdf.diagnostics

    def read(tile: int) -> np.ndarray:
        part = maps.read(tile)
        joined = np.concatenate([part.kd, part.ks, part.sigma[..., None]], axis=-1)
        return np.where((part.flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN))[..., None] == 0, joined, np.nan)

    lighting = LIGHTING.get(diagnostics["lighting"], diagnostics["lighting"])
    if aside := diagnostics.get("beside_camera_deg"):
        lighting = f"stated at the camera, found {', '.join(map(figure, aside))}° beside it"
    intro = (
        "At every texel: diffuse reflection by Lambert's law, and a highlight by the lobe of Trowbridge and Reitz. "
        "The sheets show the charts of the surface beside each other."
    )
    parameters = np.stack([read(tile) for tile in range(maps.tiles)])
    figures = parameter_figures(
        atlas_picture(Atlas.load(data.inputs["texels"].path(ATLAS)), parameters, width=data.widest)
    )
    if len(figures) == 1:
        intro += " No texel has a highlight in this fit, so that there are no sheets of its strength and width."
    return PageSection(
        "model",
        "Reflection",
        [intro, Figures(figures, 3), Table((), [("lighting", lighting), *fact_rows(diagnostics, MODEL)], "lr")],
    )


def parameter_figures(parameters: np.ndarray) -> list[Figure]:
    """Draw K_d, and K_s and sigma where there is any gloss; parameters: sheet (rows, columns, 2 channels + 1)."""
    channels = (parameters.shape[-1] - 1) // 2
    kd, ks = three(parameters[..., :channels]), three(parameters[..., channels : 2 * channels])
    glossy = bool((ks > 0).any())
    figures = []
    for name, values, caption in (
        ("Diffuse reflection", kd, "K_d of every texel: the colour of the surface without its gloss."),
        ("Specular reflection", ks, "K_s of every texel, from its own highlights or its neighbours'."),
    )[: 1 + glossy]:
        gain = brightening(values)
        figures.append(Figure(name, caption + describe_brightening(gain), colour_picture(values * gain)))
    if glossy:
        width = scalar_picture(np.degrees(parameters[..., -1]), sea(), unit="degrees")
        figures.append(Figure("Width of the highlight", "sigma of every texel: the larger, the duller.", width))
    return figures


def three(values: np.ndarray) -> np.ndarray:
    """Select three channels for display: the given ones, one repeated, or the longest, middle and shortest of many."""
    channels = values.shape[-1]
    return values if channels == 3 else values[..., [channels - 1, channels // 2, 0]]


PART_NAMES = {
    "parameters": "reflection parameters",
    "pictures": "captured views as pictures",
    "start_states": "entropy coder's start",
    "index": "index of the tiles",
}
"""Names in words of parts of the residual's file, where they are not those of the code."""
SUMS = ("total", "residual_total")


RESIDUAL = (
    ("model and residual, over the pixels that the texels were solved for, dB", "psnr_db", 1),
    ("model alone, dB", "model_psnr_db", 1),
    ("captured views stored as pictures, kB", "pictures.bytes", 1e-3),
    ("texels of as many bytes, dB", "pictures.equal_bytes_psnr_db", 1),
    ("tiles", "tiles", 1),
    ("tiles that need no residual", "empty_tiles", 1),
    ("coefficients kept", "kept", 1),
    ("of the visible samples, %", "kept_of_visible", 100),
    ("of all samples, %", "kept_of_all", 100),
    ("coded size, bits an object pixel", "bits_per_pixel", 1),
    ("all that a renderer needs, bytes", "renderer_bytes.total", 1),
)
"""Facts on the residual, as of `fact_rows`."""


def residual_section(data: SceneData) -> PageSection:
    """Write the section on what the model does not explain, and on its bytes."""
    residual = data.diagnostics["residual"]
    intro = "What the model does not explain is kept as wavelet coefficients over the surface and the views."
    everything = residual["renderer_bytes"]
    parts = data.evaluation.get("bytes", everything)
    short = [name if name in SUMS else name.replace("residual_", "", 1) for name in parts]
    rows = [
        (PART_NAMES.get(name, name.replace("_", " ")), size) for name, size in zip(short, parts.values(), strict=True)
    ]
    largest = sorted((-size, name) for (name, size), part in zip(rows, parts, strict=True) if part not in SUMS)
    svg = bars([-size / 1000 for size, _ in largest], [name for _, name in largest], title="bytes by part", unit="kB")
    drawing = Figure("Where the bytes go", "Everything that a renderer needs.", svg=svg)
    blocks: list[Block] = [
        intro,
        Table((), fact_rows(residual, RESIDUAL), "lr"),
        Figures([drawing]),
        Fold("Bytes", "by part", [Table((), rows, "lr")]),
    ]
    return PageSection("residual", "Residual", blocks)


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
