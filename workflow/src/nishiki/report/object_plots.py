"""Drawings of a turntable scene: where the cameras stood, what the bytes are spent on, quality against bytes."""

from __future__ import annotations

from html import escape

import numpy as np

from nishiki.report.svg import GRID, PALETTE, SOFT, Curve, _open, _text, bars, chart

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


def turn_plot(
    centres: np.ndarray, names: list[str], held_out: set[str], *, axis=None, centre=None, size: int = 340
) -> str:
    """Cameras (views, 3) seen along the axis of the turn; views held out are open diamonds.

    axis, centre: of the circle; where they are not known, of the plane that fits the cameras best.
    """
    centres = np.asarray(centres, float).reshape(-1, 3)
    middle = np.asarray(centre, float) if centre is not None else centres.mean(axis=0)
    if axis is None:
        axis = np.linalg.svd(centres - middle)[2][2] if len(centres) > 2 else np.array([0.0, 1.0, 0.0])
    right, ahead = _across(np.asarray(axis, float))
    flat = np.stack([(centres - middle) @ right, (centres - middle) @ ahead], axis=1)
    reach = max(float(np.abs(flat).max(initial=0)), 1e-12)
    half = size / 2
    scale = (half - 34) / reach
    radius = float(np.median(np.linalg.norm(flat, axis=1))) * scale if len(flat) else 0.0
    parts = [_open(size, size, "places of the cameras seen along the axis of the turn")]
    parts.append(f'<circle cx="{half:g}" cy="{half:g}" r="{radius:.1f}" fill="none" stroke="{GRID}"/>')
    parts.append(f'<path d="M{half - 5:g} {half:g}h10M{half:g} {half - 5:g}v10" stroke="{SOFT}"/>')
    for (x, y), name in zip(flat * scale, names, strict=True):
        parts.append(_camera(half + x, half - y, name, name in held_out))
    if len(names) <= 40:
        for (x, y), name in list(zip(flat * scale, names, strict=True))[:: max(1, len(names) // 12)]:
            out = 1 + 15 / max(float(np.hypot(x, y)), 1e-9)
            parts.append(_text(half + x * out, half - y * out + 4, name, anchor="middle", size=10))
    return "".join([*parts, "</svg>"])


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across an axis."""
    axis = axis / np.linalg.norm(axis)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    right = np.cross(helper, axis)
    right /= np.linalg.norm(right)
    return right, np.cross(axis, right)


def _camera(x: float, y: float, name: str, held_out: bool) -> str:
    if held_out:
        title = f"<title>{escape(name)} (left out)</title>"
        path = f"M{x:.1f} {y - 6:.1f}l6 6l-6 6l-6 -6z"
        return f'<path d="{path}" fill="#fff" stroke="{PALETTE[1]}" stroke-width="2">{title}</path>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{PALETTE[0]}"><title>{escape(name)}</title></circle>'


def bytes_bars(parts: dict[str, int]) -> str:
    """Bytes of every part as bars, largest first; sums are left out."""
    rows = sorted(((size, name) for name, size in parts.items() if name not in SUMS), key=lambda row: (-row[0], row[1]))
    labels = [PART_NAMES.get(name, name.replace("_", " ")) for _, name in rows]
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
    low, high = (float(f([*quality, *([model_db] if model_db is not None else [])])) for f in (min, max))
    room = max(0.08 * (high - low), 0.5)
    return chart(
        curves, x_label="kB", y_label="PSNR, dB", title="quality against bytes", y_range=(low - room, high + room)
    )
