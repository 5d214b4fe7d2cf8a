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
        region = "over the pixels that the texels were solved for, peak: full scale"
        text = f"{with_model} dB {region}; model alone {alone} dB"
        facts.append(("Model and residual", text))
    if residual.get("kept") is not None:
        text = figure(residual["kept"])
        if residual.get("kept_of_visible") is not None:
            visible, every = (percent(100 * residual[name]) for name in ("kept_of_visible", "kept_of_all"))
            text += f": {visible} of the visible samples, {every} of all"
        facts.append(("Coefficients kept", text))
    if residual.get("bits_per_pixel") is not None:
        facts.append(("Coded size", f"{figure(residual['bits_per_pixel'])} bit an object pixel"))
    if everything := residual.get("renderer_bytes"):
        others = sum(everything.get(name, 0) for name in ("mesh", "charts", "cameras", "lamps"))
        total, beside = figure(everything["total"] / 1000), figure(others / 1000)
        text = f"{total} kB, of which mesh, charts, cameras and lamps {beside} kB"
        facts.append(("All that a renderer needs", text))
    parts = (evaluation or {}).get("bytes") or residual.get("renderer_bytes") or residual.get("bytes") or {}
    items = []
    if drawing := bytes_bars(parts):
        items.append(Figure("Where the bytes go", "Everything that a renderer needs.", svg=drawing))
    if drawing := rate_curve(residual):
        caption = (
            "Parameters and residual together: the model alone, and the steps that the allocation tried on its way to "
            "the target. Nothing was measured between them."
        )
        items.append(Figure("Quality against bytes", caption, svg=drawing))
    rows = [(_part_name(name), size) for name, size in parts.items()]
    blocks: list[Block] = [intro, Facts(facts), Figures(items), Fold("Bytes", "by part", [Table((), rows, "lr")])]
    return Section("residual", "Residual", blocks)


def bytes_bars(parts: dict[str, int]) -> str:
    """Bytes of every part as bars, largest first; sums are left out."""
    rows = sorted(((size, name) for name, size in parts.items() if name not in SUMS), key=lambda row: (-row[0], row[1]))
    labels = [_part_name(name) for _, name in rows]
    return bars([size / 1000 for size, _ in rows], labels, title="bytes by part", unit="kB") if rows else ""


def rate_curve(residual: dict[str, Any]) -> str:
    """PSNR against bytes, from none on: the model alone, and the settings that the allocation tried. Empty without
    figures of the model or of any setting: settings alone lie too close together to tell anything."""
    tried = sorted(
        (point["bytes"] / 1000, point["psnr_db"])
        for point in residual.get("curve") or []
        if point.get("psnr_db") is not None
    )
    alone, parameters = residual.get("model_psnr_db"), (residual.get("bytes") or {}).get("parameters")
    if not tried or alone is None or parameters is None:
        return ""
    kilobytes, quality = np.array(tried).T
    curves = [
        Curve("with residual", kilobytes, quality, dots=True),
        Curve("", kilobytes, quality),
        Curve("model alone", np.array([parameters / 1000]), np.array([alone]), colour=PALETTE[1], dots=True),
    ]
    low, high = min(alone, quality.min()), max(alone, quality.max())
    room = max(0.08 * (high - low), 0.5)
    return chart(
        curves,
        x_label="kB",
        y_label="PSNR, dB",
        title="quality against bytes",
        x_range=(0, 1.05 * kilobytes.max()),
        y_range=(low - room, high + room),
    )


def _part_name(name: str) -> str:
    return PART_NAMES.get(name, name.replace("_", " "))
