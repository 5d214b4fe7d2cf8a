"""The section of an object's page on the residual: what it costs, and quality against bytes."""

from typing import Any

import numpy as np

from nishiki.report.numbers import figure, percent
from nishiki.report.page import Block, Facts, Figure, Figures, Fold, Section, Table
from nishiki.report.svg import PALETTE, Curve, bars, chart

PART_NAMES = {
    "mesh": "mesh",
    "charts": "charts",
    "cameras": "cameras",
    "lamps": "lamps",
    "residual_parameters": "reflection parameters",
    "residual_residual": "residual",
    "residual_start_states": "entropy coder's start",
    "residual_container": "container",
    "residual_header": "header",
    "residual_index": "index of the tiles",
    "parameters": "reflection parameters",
    "start_states": "entropy coder's start",
    "index": "index of the tiles",
}
SUMS = ("total", "residual_total")


def residual_section(residual: dict[str, Any] | None, evaluation: dict[str, Any] | None) -> Section | None:
    """residual : diagnostics of the stage or None; evaluation : evaluation.json or None."""
    if residual is None:
        return None
    intro = "What the model does not explain is kept as wavelet coefficients over the surface and the views."
    if residual.get("empty_tiles") is not None:
        intro += f" {figure(residual['empty_tiles'])} of {figure(residual['tiles'])} tiles need none."
    facts = []
    if residual.get("psnr_db") is not None:
        with_model, alone = figure(residual["psnr_db"]), figure(residual.get("model_psnr_db"))
        text = f"{with_model} dB over the pixels that the texels were solved for; model alone {alone} dB"
        facts.append(("Model and residual", text))
    if residual.get("kept") is not None:
        text = figure(residual["kept"])
        if residual.get("kept_of_visible") is not None:
            visible, every = (percent(100 * residual[name]) for name in ("kept_of_visible", "kept_of_all"))
            text += f": {visible} of the visible samples, {every} of all"
        facts.append(("Coefficients kept", text))
    if residual.get("bits_per_pixel") is not None:
        facts.append(("Coded size", f"{figure(residual['bits_per_pixel'])} bit an object pixel"))
    parts = (evaluation or {}).get("bytes") or residual.get("bytes") or {}
    items = []
    if drawing := bytes_bars(parts):
        items.append(Figure("Where the bytes go", "Everything that a renderer needs.", svg=drawing))
    curve = [point for point in residual.get("curve") or [] if point.get("psnr_db") is not None]
    if len(curve) > 1:
        drawing = rate_curve(curve, residual.get("model_psnr_db"))
        caption = "The steps that the allocation tried on its way to the target."
        items.append(Figure("Quality against bytes", caption, svg=drawing))
    rows = [(_part_name(name), size) for name, size in parts.items()]
    blocks: list[Block] = [intro, Facts(facts), Figures(items), Fold("Bytes", "by part", [Table((), rows, "lr")])]
    return Section("residual", "Residual", blocks)


def bytes_bars(parts: dict[str, int]) -> str:
    """Bytes of every part as bars, largest first; sums are left out."""
    rows = sorted(((size, name) for name, size in parts.items() if name not in SUMS), key=lambda row: (-row[0], row[1]))
    labels = [_part_name(name) for _, name in rows]
    return bars([size / 1000 for size, _ in rows], labels, title="bytes by part", unit="kB") if rows else ""


def rate_curve(points: list[dict], model_db: float | None) -> str:
    """PSNR against bytes of the settings that the allocation tried."""
    points = sorted(points, key=lambda point: point["bytes"])
    kilobytes = np.array([point["bytes"] / 1000 for point in points])
    quality = np.array([point["psnr_db"] for point in points])
    curves = [Curve("residual and model", kilobytes, quality), Curve("", kilobytes, quality, dots=True)]
    if model_db is not None:
        ends = np.array([kilobytes[0], kilobytes[-1]])
        curves.append(Curve("model alone", ends, np.full(2, model_db), colour=PALETTE[1], dashed=True))
    levels = [*quality, *([] if model_db is None else [model_db])]
    low, high = float(min(levels)), float(max(levels))
    room = max(0.08 * (high - low), 0.5)
    ends_db = (low - room, high + 4 * room)  # the legend stands on top
    return chart(curves, x_label="kB", y_label="PSNR, dB", title="quality against bytes", y_range=ends_db)


def _part_name(name: str) -> str:
    return PART_NAMES.get(name, name.replace("_", " "))
