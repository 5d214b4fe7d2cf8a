"""Small drawings as SVG text: curves, light directions, bars. Plain shapes only, no script, no outside reference."""

from dataclasses import dataclass
from html import escape

import numpy as np

from nishiki.report.numbers import plain, power_of_ten

PALETTE = ("#1f4e79", "#b5542b", "#3f7f4c", "#7a5195", "#a0892c", "#4b8a99")
INK, SOFT, GRID = "#22262b", "#6b7178", "#e3e3df"


@dataclass(frozen=True)
class Curve:
    """One curve of a chart: x, y of equal length; NaN breaks the line. dots: as points, not as a line.

    strength: opacity of each point, 0 to 1, or None."""

    label: str
    x: np.ndarray
    y: np.ndarray
    colour: str = PALETTE[0]
    dashed: bool = False
    dots: bool = False
    strength: np.ndarray | None = None


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers (1, 2, 2.5 or 5 times a power of ten apart) inside low..high, about `count` of them."""
    span = high - low
    if not (np.isfinite(span) and span > 0):
        return [float(low)] if np.isfinite(low) else []
    raw = span / max(count, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= raw * 0.999)
    first = np.ceil(low / step - 1e-9)
    return [float((first + k) * step) for k in range(int(np.floor((high - first * step) / step + 1e-9)) + 1)]


def number(value: float) -> str:
    """A tick's label, without needless digits."""
    return plain(0.0 if abs(value) < 1e-12 else value, 6)


def decade(exponent: float) -> str:
    """Label of a power of ten."""
    return power_of_ten(round(exponent))


def chart(
    curves: list[Curve],
    *,
    x_label: str,
    y_label: str,
    title: str,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    width: int = 560,
    height: int = 300,
    decades: bool = False,
) -> str:
    """Curves over common axes; the legend stands in the upper right corner. `title` is read out, not drawn.

    decades : the y values are logarithms to the base 10, and so labelled.
    """
    left, right, top, bottom = 58, 12, 10, 44
    x0, x1 = x_range or _range([curve.x for curve in curves])
    y0, y1 = y_range or _range([curve.y for curve in curves], zero=True)
    inner_width, inner_height = width - left - right, height - top - bottom

    def px(x):
        return left + (np.asarray(x, float) - x0) / (x1 - x0) * inner_width

    def py(y):
        return top + (y1 - np.asarray(y, float)) / (y1 - y0) * inner_height

    parts = [_open(width, height, title)]
    for value in ticks(x0, x1, 6):
        at = float(px(value))
        parts.append(_line(at, top, at, top + inner_height, GRID))
        parts.append(_text(at, height - bottom + 16, number(value), anchor="middle"))
    for value in np.arange(np.ceil(y0), y1 + 1e-9) if decades else ticks(y0, y1, 5):
        at = float(py(value))
        parts.append(_line(left, at, width - right, at, GRID))
        parts.append(_text(left - 7, at + 4, decade(value) if decades else number(value), anchor="end"))
    parts.append(_line(left, top + inner_height, width - right, top + inner_height, SOFT))
    parts.append(_text(left + inner_width / 2, height - 8, x_label, anchor="middle"))
    middle = top + inner_height / 2
    parts.append(_text(14, middle, y_label, anchor="middle", turn=f"rotate(-90 14 {middle:.1f})"))
    for curve in curves:
        x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
        margin = 0.02 * (y1 - y0)
        inside = (x >= x0) & (x <= x1) & (y >= y0 - margin) & (y <= y1 + margin)
        if not curve.dots:  # a line runs to the edge; a point outside is not drawn at all
            y, inside = np.clip(y, y0 - margin, y1 + margin), (x >= x0) & (x <= x1)
        parts.append(_curve(px(np.where(inside, x, np.nan)), py(y), curve))
    parts += _legend([curve for curve in curves if curve.label], width - right - 8, top + 12)
    return "".join([*parts, "</svg>"])


def lights_plot(directions: np.ndarray, names: list[str], kinds: list[str], *, size: int = 340) -> str:
    """Light directions (lights, 3) seen from the camera: distance from the middle grows evenly with incidence.

    The rim is 90 degrees. kinds: sample | check | held out. Names are drawn up to 16 lights.
    """
    middle, radius = size / 2, size / 2 - 30
    parts = [_open(size, size, "directions of the lights, seen from the camera")]
    for degrees in (30, 60, 90):
        parts.append(
            f'<circle cx="{middle:g}" cy="{middle:g}" r="{radius * degrees / 90:.1f}" fill="none" stroke="{GRID}"/>'
        )
        aside = 0.7071 * radius * degrees / 90
        parts.append(_text(middle - aside - 3, middle + aside + 10, f"{degrees}°", anchor="end", size=10, colour=SOFT))
    parts.append(_line(middle - radius, middle, middle + radius, middle, GRID))
    parts.append(_line(middle, middle - radius, middle, middle + radius, GRID))
    for text, dx, dy in (("top", 0, -1), ("right", 1, 0), ("bottom", 0, 1), ("left", -1, 0)):
        parts.append(
            _text(middle + dx * (radius + 14), middle + dy * (radius + 14) + 4, text, anchor="middle", colour=SOFT)
        )
    for direction, name, kind in zip(np.asarray(directions, float), names, kinds, strict=True):
        x, y, z = direction
        horizontal = float(np.hypot(x, y))
        reach = np.degrees(np.arctan2(horizontal, z)) / 90 * radius / horizontal if horizontal > 0 else 0.0
        at = middle + x * reach, middle - y * reach
        parts.append(_mark(at, kind, name))
        if len(names) <= 16:
            parts.append(_text(at[0] + 8, at[1] + 4, name, size=10))
    return "".join([*parts, "</svg>"])


def bars(values: list[float], labels: list[str], *, title: str, unit: str, width: int = 560) -> str:
    """Horizontal bars with their values, from 0; `values` >= 0."""
    top, line, left = 4, 20, 110
    largest = max([*values, 0.0]) or 1.0
    parts = [_open(width, top * 2 + line * len(values), title)]
    for k, (value, label) in enumerate(zip(values, labels, strict=True)):
        y = top + k * line
        long = (width - left - 90) * value / largest
        parts.append(_text(left - 8, y + 14, label, anchor="end", size=11))
        parts.append(f'<rect x="{left}" y="{y + 4}" width="{max(long, 0.5):.1f}" height="12" fill="{PALETTE[0]}"/>')
        parts.append(_text(left + long + 6, y + 14, f"{number(float(f'{value:.3g}'))} {unit}", size=11))
    return "".join([*parts, "</svg>"])


def _range(arrays: list[np.ndarray], *, zero: bool = False) -> tuple[float, float]:
    """Range of all finite values, with 0 in it where asked; never empty."""
    values = np.concatenate([np.asarray(a, float).ravel() for a in arrays] or [np.zeros(0)])
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    if zero:
        low, high = min(low, 0.0), high + 0.05 * (high - min(low, 0.0))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _open(width: int, height: int, title: str) -> str:
    return (
        f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" '
        f'aria-label="{escape(title, quote=True)}">'
    )


def _line(x0, y0, x1, y1, colour) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}"/>'


def _text(x, y, text, *, anchor="start", size=12, colour=INK, turn="") -> str:
    turned = f' transform="{turn}"' if turn else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}" text-anchor="{anchor}"{turned}>'
        f"{escape(str(text))}</text>"
    )


def _curve(x: np.ndarray, y: np.ndarray, curve: Curve) -> str:
    known = np.isfinite(x) & np.isfinite(y)
    if curve.dots:
        strength = np.full(x.shape, 0.6) if curve.strength is None else np.asarray(curve.strength, float)
        places = zip(x[known], y[known], strength[known], strict=True)
        shapes = (f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.2" fill-opacity="{s:.2g}"/>' for a, b, s in places)
        return f'<g fill="{curve.colour}">{"".join(shapes)}</g>'
    commands, drawing = [], False
    for a, b, there in zip(x, y, known, strict=True):
        if there:
            commands.append(f"{'L' if drawing else 'M'}{a:.1f} {b:.1f}")
        drawing = bool(there)
    dash = ' stroke-dasharray="5 4"' if curve.dashed else ""
    return f'<path d="{"".join(commands)}" fill="none" stroke="{curve.colour}" stroke-width="1.8"{dash}/>'


def _legend(curves: list[Curve], right: float, top: float) -> list[str]:
    parts = []
    for k, curve in enumerate(curves):
        y = top + 16 * k
        parts.append(_text(right - 26, y + 4, curve.label, anchor="end", size=11))
        if curve.dots:
            parts.append(f'<circle cx="{right - 10:.1f}" cy="{y:.1f}" r="2.6" fill="{curve.colour}"/>')
        else:
            dash = ' stroke-dasharray="5 4"' if curve.dashed else ""
            parts.append(
                f'<line x1="{right - 20:.1f}" y1="{y:.1f}" x2="{right:.1f}" y2="{y:.1f}" stroke="{curve.colour}" '
                f'stroke-width="2"{dash}/>'
            )
    return parts


def _mark(at: tuple[float, float], kind: str, name: str) -> str:
    x, y = at
    title = f"<title>{escape(name)} ({escape(kind)})</title>"
    ring = f'fill="#fff" stroke="{PALETTE[1]}" stroke-width="2"'
    if kind == "check":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" {ring}>{title}</circle>'
    if kind == "held out":
        return f'<path d="M{x:.1f} {y - 6:.1f}l6 6l-6 6l-6 -6z" {ring}>{title}</path>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5" fill="{PALETTE[0]}">{title}</circle>'
