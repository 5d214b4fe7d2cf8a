"""The parts of a turntable scene's page, from what the stages reported."""

from __future__ import annotations

from typing import Any

import numpy as np

from nishiki.report.object_plots import PART_NAMES, bytes_bars, rate_curve, turn_plot
from nishiki.report.pictures import PagePicture, encoded

ABOUT = (("object_id", "Object"), ("creator", "Creator"), ("date", "Date"), ("rights", "Rights"), ("notes", "Notes"))

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


def facts(ingest: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and text of what is known of the capture."""
    capture = ingest["capture"]
    found = [(label, str(capture[key])) for key, label in ABOUT if capture.get(key)]
    camera = capture.get("camera") or {}
    encoding = {"linear": "linear values", "srgb": "sRGB-coded values"}.get(camera.get("encoding"), "")
    parts = [camera.get("model"), f"{camera['bits']} bits" if camera.get("bits") else None, encoding]
    found.append(("Camera", ", ".join(part for part in parts if part) or "not stated"))
    views, states = len(ingest["views"]), [state for state in ingest["states"] if state]
    turn = "a full turn" if (capture.get("turntable") or {}).get("full_turn") else "part of a turn"
    size = f"{ingest['columns']} × {ingest['rows']} pixels, {len(ingest['channels'])} channels"
    found.append(("Views", f"{views} over {turn}, {size} each"))
    if states:
        found.append(("Polarisers", ", ".join(states)))
    lights = capture.get("lights") or {}
    kinds = {"camera": "a lamp beside the camera", "direction": "known directions", "position_mm": "known places"}
    kind = lights.get("kind") if isinstance(lights, dict) else None
    found.append(("Lighting", kinds.get(kind, "not stated; fitted")))
    return found


def glance(inputs: dict[str, dict]) -> list[dict]:
    """The figures that matter most."""
    tiles = []

    def tile(value, unit, meaning):
        if value is not None:
            tiles.append({"value": value, "unit": unit, "meaning": meaning})

    evaluation = inputs.get("object_evaluate") or {}
    psnr = evaluation.get("psnr") or {}
    tile((psnr.get("captured") or {}).get("mean_psnr_db"), "dB", "rendered views against their photographs")
    for name, found in psnr.items():
        if name.startswith("left_out"):
            tile(found.get("mean_psnr_db"), "dB", "views that took no part, predicted")
            break
    tile((psnr.get("model_alone") or {}).get("mean_psnr_db"), "dB", "the reflection model alone")
    total = (evaluation.get("bytes") or (inputs.get("residual") or {}).get("bytes") or {}).get("total")
    tile(None if total is None else total / 1000, "kB", "everything that a renderer needs")
    tile(evaluation.get("bits_per_object_pixel"), "bit", "a pixel of the object")
    tile((inputs.get("mesh") or {}).get("triangles"), "", "triangles")
    return tiles


def cameras_section(cameras: dict[str, Any], centres: np.ndarray, names: list[str], held_out: set[str]) -> dict:
    """Circle of the cameras from above and their errors; centres (views, 3) in the world."""
    circle = cameras.get("circle") or {}
    errors = {name: value for name, value in (cameras.get("reprojection_px") or {}).items() if value is not None}
    steps = circle.get("steps_deg") or []
    return {
        "svg": turn_plot(centres, names, held_out, axis=circle.get("axis"), centre=circle.get("centre")),
        "source": cameras.get("source"),
        "unit": cameras.get("unit"),
        "radius": circle.get("radius"),
        "off_plane": None if circle.get("off_plane") is None else 100 * round(circle["off_plane"], 9),
        "least_step": min(steps, default=None),
        "largest_step": max(steps, default=None),
        "errors": errors,
        "mean_error": float(np.mean(list(errors.values()))) if errors else None,
        "worst_error": max(errors.values(), default=None),
    }


def geometry_section(mesh: dict[str, Any]) -> dict:
    """Counts and silhouettes of the surface: label and value, in the order told."""
    fit = mesh.get("fit") or {}
    rows = [(name.replace("_", " "), mesh.get(name)) for name in ("source", "unit", "vertices", "triangles")]
    rows.append(("watertight", {True: "yes", False: "no"}.get(mesh.get("watertight"))))
    rows += [
        (f"removed or mended: {name.replace('_', ' ')}", value) for name, value in (mesh.get("cleaned") or {}).items()
    ]
    light = mesh.get("decimation") or {}
    rows.append(("triangles before decimation", light.get("triangles_before")))
    rows.append(("deviation by decimation, pixels", light.get("deviation_px")))
    rows.append(("silhouettes covered (IoU), mean", fit.get("iou_mean")))
    rows.append(("silhouettes covered (IoU), least", fit.get("iou_least")))
    rows.append(("of views left out (IoU), mean", fit.get("iou_held_out")))
    return {"rows": [(name, value) for name, value in rows if value is not None]}


def separation_section(polarise: dict[str, Any], pictures: list[tuple[str, PagePicture]]) -> dict:
    """What the polarisers separated: mean share of each component and of doubtful pixels."""
    views = polarise.get("by_view") or []

    def mean(name: str) -> float | None:
        values = [view[name] for view in views if view.get(name) is not None]
        return float(np.mean(values)) if values else None

    boards = polarise.get("boards") or {}
    return {
        "method": polarise.get("method"),
        "boards": {
            light or "lamp": board["channel"] for light, board in boards.items() if board and board.get("channel")
        },
        "diffuse": mean("diffuse"),
        "specular": mean("specular"),
        "negative": mean("negative"),
        "doubtful": mean("doubtful"),
        "pictures": [{"picture": picture, "name": name} for name, picture in pictures],
    }


def residual_section(residual: dict[str, Any] | None, evaluation: dict[str, Any] | None) -> dict | None:
    """Bytes by part, and the curve of quality against bytes where it was recorded."""
    if residual is None:
        return None
    parts = (evaluation or {}).get("bytes") or residual.get("bytes") or {}
    curve = [point for point in residual.get("curve") or [] if point.get("psnr_db") is not None]
    return {
        **{name: residual.get(name) for name in ("psnr_db", "model_psnr_db", "kept", "kept_of_all", "kept_of_visible")},
        **{name: residual.get(name) for name in ("tiles", "empty_tiles", "step", "bits_per_pixel", "pixels")},
        "parts": [(PART_NAMES.get(name, name.replace("_", " ")), size) for name, size in parts.items()],
        "bytes_svg": bytes_bars(parts),
        "curve_svg": rate_curve(curve, residual.get("model_psnr_db")) if len(curve) > 1 else "",
    }


def comparisons(evaluation: dict[str, Any] | None, arrays: dict[str, dict[str, np.ndarray]]) -> list[dict]:
    """Photograph, rendered view, model alone and difference of some views; arrays: by file, uint8 as displayed."""
    shown = []
    words = {
        "photograph": ("Photograph", "the object's pixels as the camera saw them."),
        "rendered": ("Rendered", "model and residual, decoded."),
        "model": ("Model alone", "what the reflection model predicts without the residual."),
        "error": ("Difference", "between rendered view and photograph, enlarged."),
    }
    for entry in (evaluation or {}).get("pictures") or []:
        found = arrays.get(entry["arrays"]) or {}
        pictures = [
            {"picture": encoded(np.ascontiguousarray(found[key])), "name": name, "caption": caption}
            for key, (name, caption) in words.items()
            if key in found
        ]
        if pictures:
            shown.append({"view": entry["view"], "left_out": entry["left_out"], "pictures": pictures})
    return shown


def evaluation_section(evaluation: dict[str, Any] | None) -> dict | None:
    """Figures over all views of each kind of picture, and every view's."""
    if evaluation is None:
        return None
    kinds = [(KINDS.get(name, name.replace("_", " ")), found) for name, found in evaluation["figures"].items() if found]
    return {
        "kinds": kinds,
        "rows": evaluation["rows"],
        "encoding": evaluation["encoding"],
        "left_out": evaluation["left_out"]["views"],
    }
