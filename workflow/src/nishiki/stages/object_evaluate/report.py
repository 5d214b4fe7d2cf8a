"""The sections of an object's page that compare rendered views with photographs."""

import io
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.formats.stored import load_arrays
from nishiki.report.files import contents
from nishiki.report.page import Block, Figure, Figures, Fold, Heading, Section, Table
from nishiki.report.pictures import encoded

KINDS = {
    "captured": "captured views, decoded",
    "captured_truth": "captured views, decoded, against noise-free truth",
    "model_alone": "captured views, model alone",
    "left_out_interpolated": "views left out, residual of the neighbours",
    "left_out_slot": "views left out, as the decoder filled them",
    "left_out_model_alone": "views left out, model alone",
    "left_out_interpolated_truth": "views left out, residual of the neighbours, against noise-free truth",
    "left_out_slot_truth": "views left out, as the decoder filled them, against noise-free truth",
}
"""Figures of an evaluation in words."""
PICTURES = {
    "photograph": ("Photograph", "the object's pixels as the camera saw them."),
    "rendered": ("Rendered", "model and residual, decoded."),
    "model": ("Model alone", "what the reflection model predicts without the residual."),
    "error": ("Difference", "between rendered view and photograph, enlarged."),
}


def comparison_section(evaluate: Artifact | None, evaluation: dict[str, Any] | None) -> Section | None:
    """Photograph, rendered view, model alone and difference of some views; evaluation : evaluation.json."""
    blocks: list[Block] = []
    for entry in (evaluation or {}).get("pictures") or []:
        data = contents(evaluate, entry["arrays"])
        arrays = {} if data is None else load_arrays(io.BytesIO(data), name=entry["arrays"])
        items = [
            Figure(heading, "" if blocks else caption, encoded(np.ascontiguousarray(arrays[key])))
            for key, (heading, caption) in PICTURES.items()
            if key in arrays
        ]
        if items:
            aside = "left out of everything, and predicted" if entry["left_out"] else "captured and coded"
            blocks += [Heading(f"View {entry['view']}", aside), Figures(items, 4)]
    return Section("comparison", "Photograph and rendering", blocks) if blocks else None


def views_section(evaluation: dict[str, Any] | None) -> Section | None:
    """Figures over all views of each kind of picture, and every view's."""
    if evaluation is None:
        return None
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
    left_out = evaluation["left_out"]["views"]
    each = [
        (
            f"{row['view']} (left out)" if row["left_out"] else row["view"],
            *(row[key] for key in ("light", "picture", "against", "psnr_db", "covered_psnr_db", "similarity")),
            *(row[key] for key in ("pixels", "uncovered_pixels", "superfluous_pixels")),
        )
        for row in evaluation["rows"]
    ]
    head = ("View", "light", "picture", "against", "dB", "covered dB", "similarity", "pixels", "not covered", "beyond")
    return Section("views", "All views", [
        Table(("Pictures", *columns), kinds, "lrrrrrrrr", caption),
        f"Left out of carving, fits and residual, and predicted: {', '.join(left_out)}."
        if left_out
        else "No view was left out, so nothing is said here of views that were not captured.",
        Fold("Each view", f"{len(each)} rows", [Table(head, each, "llllrrrrrr")]),
    ])  # fmt: skip
