"""Format numbers for readers, and draw SVG text: curves, light directions, bars.

Numbers have digits in groups of three, a true minus, and powers of ten in place of an e. Drawings have plain shapes
only, no script, no outside reference.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

NARROW_SPACE = "\u202f"
PLAIN = (1e-4, 1e7)
"""Range of magnitudes written out; beyond it a power of ten is easier to read."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def plain(value: float, digits: int = 4, *, padded: bool = False) -> str:
    """Format a finite number with `digits` significant digits.

    padded: keep zeros at the end, which say how exact a measured value is. Whole numbers below 1e7 keep all digits.
    """
    if value == 0:
        return "0"
    if not math.isfinite(value):
        return str(value)
    size = abs(float(f"{value:.{digits}g}"))
    if PLAIN[0] <= size < PLAIN[1]:
        decimals = max(0, digits - 1 - math.floor(math.log10(size)))
        shown = f"{value:,.{decimals}f}"
        if "." in shown and not padded:
            shown = shown.rstrip("0").rstrip(".")
        return shown.replace(",", NARROW_SPACE).replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if "." in mantissa and not padded:
        mantissa = mantissa.rstrip("0").rstrip(".")
    power = "10" + str(int(exponent)).translate(_RAISED)
    return power if mantissa == "1" else f"{mantissa.replace('-', '−')} × {power}"


def figure(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Format a measured figure: `digits` significant ones, a dash where there is none."""
    if value is None:
        return "–"
    if isinstance(value, int):
        digits = max(digits, len(str(abs(value))))
    shown = plain(value, digits, padded=not isinstance(value, int))
    return f"{shown}{NARROW_SPACE}{unit}" if unit else shown


def percent(value: float | None) -> str:
    """Format a share in per cent, to a hundredth."""
    if value is None:
        return "–"
    if 0 < value < 0.01:
        return "< 0.01\u202f%"
    return f"{value:.2f}\u202f%" if value else "0"


def format_signed(share: float | None) -> str:
    """Format a share in per cent with its sign, to a tenth."""
    if share is None:
        return "–"
    tenths = round(1000 * share)
    return f"{tenths / 10:+.1f}\u202f%".replace("-", "−") if tenths else "0\u202f%"


def degrees(value: float | None) -> str:
    """Format an angle to a degree, with a true minus and without a negative zero."""
    return "–" if value is None else f"{round(value):d}°".replace("-", "−")


DASHES = ("5 4", "1.5 3.5")
"""Patterns of dashed lines."""
PALETTE = ("#1f4e79", "#b5542b", "#3f7f4c", "#7a5195", "#a0892c", "#4b8a99")
INK, SOFT, GRID, PAPER = "#22262b", "#6b7178", "#e3e3df", "#fff"
FONT = "Source Sans 3,Segoe UI,Roboto,Arial,sans-serif"
LEFT, BOTTOM = 66, 44
"""Room for the labels of the axes, pixels."""
LEGEND_ROW, LEGEND_LINE = 17, 20
"""Height of a row of a legend, length of its lines, pixels."""


class Drawing:
    """Shapes in pixels, y downwards. The title is read out, not drawn. alone : as a file of its own, on white."""

    def __init__(self, width: float, height: float, title: str, *, alone: bool = False):
        space = f'xmlns="http://www.w3.org/2000/svg" font-family="{FONT}" ' if alone else ""
        size = f'viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}"'
        self.parts = [f'<svg {space}{size} role="img" aria-label="{escape(title, quote=True)}">']
        if alone:
            self.parts.append(f'<rect width="{width:g}" height="{height:g}" fill="{PAPER}"/>')

    def finish(self) -> str:
        """Return the whole drawing."""
        return "".join([*self.parts, "</svg>"])

    def text(self, x, y, text, *, anchor="start", size=12, colour=INK, upwards=False) -> None:
        """Draw a text whose `anchor` (start, middle, end) is at x."""
        turned = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if upwards else ""
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}" text-anchor="{anchor}"{turned}>'
            f"{escape(str(text))}</text>"
        )

    def line(self, x0, y0, x1, y1, colour) -> None:
        """Draw a thin line."""
        self.parts.append(f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}"/>')

    def circle(self, x, y, radius, *, tip="", **paint) -> None:
        """Draw a disc or a ring; tip : tooltip of a pointer on it."""
        self._shape(f'circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"', tip, **paint)

    def path(self, commands, *, tip="", **paint) -> None:
        """Draw any outline, by the commands of SVG."""
        self._shape(f'path d="{commands}"', tip, **paint)

    def diamond(self, x, y, half, *, tip="", **paint) -> None:
        """Draw a square standing on its corner."""
        self.path(f"M{x:.1f} {y - half:.1f}l{half} {half}l-{half} {half}l-{half} -{half}z", tip=tip, **paint)

    def bar(self, x, y, width, height, colour) -> None:
        """Draw a filled rectangle."""
        self.parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" fill="{colour}"/>')

    def picture(self, x, y, width, height, source) -> None:
        """Draw a picture by its data URI, stretched to this size."""
        self.parts.append(f'<image x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" href="{source}"/>')

    def _shape(
        self, shape, tip, *, fill="none", stroke="", width=1.0, dashed=False, dash=DASHES[0], opacity=1.0
    ) -> None:
        paint = f' fill="{fill}"' + (f' fill-opacity="{opacity:.2g}"' if opacity < 1 else "")
        if stroke:
            paint += f' stroke="{stroke}" stroke-width="{width:g}"' + (f' stroke-dasharray="{dash}"' if dashed else "")
        end = f"><title>{escape(tip)}</title></{shape.split()[0]}>" if tip else "/>"
        self.parts.append(f"<{shape}{paint}{end}")


def outline(x: np.ndarray, y: np.ndarray) -> str:
    """Return the path commands of a line through points in pixels; NaN breaks it."""
    commands, drawing = [], False
    for a, b in zip(x, y, strict=True):
        known = bool(np.isfinite(a) and np.isfinite(b))
        if known:
            commands.append(f"{'L' if drawing else 'M'}{a:.1f} {b:.1f}")
        drawing = known
    return "".join(commands)


@dataclass(frozen=True)
class ChartAxis:
    """A linear or logarithmic axis from values (low to high) to pixels (start to end)."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool = False

    def __call__(self, values) -> np.ndarray:
        """Convert values to pixels; those without a logarithm become NaN."""
        values = np.asarray(values, float)
        low, high = self.low, self.high
        if self.logarithmic:
            values = np.log(np.where(values > 0, values, np.nan))
            low, high = math.log(low), math.log(high)
        return self.start + (values - low) / (high - low) * (self.end - self.start)

    def marks(self) -> list[float]:
        """Round values for the ticks; powers of ten on a long logarithmic axis, with 2 and 5 between on a short one."""
        if not self.logarithmic:
            return ticks(self.low, self.high)
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        factors = (1, 2, 5) if last - first <= 3 else (1,)
        values = [float(f"{factor}e{power}") for power in range(first, last + 1) for factor in factors]
        return [value for value in values if self.low <= value <= self.high]


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round numbers (1, 2, 2.5 or 5 times a power of ten apart) inside low..high, about `count` of them."""
    span = high - low
    if not (np.isfinite(span) and span > 0):
        return [float(low)] if np.isfinite(low) else []
    raw = span / max(count, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= raw * 0.999)
    first = np.ceil(low / step - 1e-9)
    return [float((first + k) * step) for k in range(int(np.floor((high - first * step) / step + 1e-9)) + 1)]


def draw_axes(drawing: Drawing, x: ChartAxis, y: ChartAxis, x_label: str, y_label: str) -> None:
    """Draw grid, numbers and labels of two axes."""
    for value, at in zip(x.marks(), x(x.marks()), strict=True):
        drawing.line(at, y.end, at, y.start, GRID)
        drawing.text(at, max(y.start, y.end) + 16, _number(value), anchor="middle")
    for value, at in zip(y.marks(), y(y.marks()), strict=True):
        drawing.line(x.start, at, x.end, at, GRID)
        drawing.text(x.start - 7, at + 4, _number(value), anchor="end")
    floor, middle = max(y.start, y.end), (y.start + y.end) / 2
    drawing.line(x.start, floor, x.end, floor, SOFT)
    drawing.text((x.start + x.end) / 2, floor + 35, x_label, anchor="middle")
    drawing.text(14, middle, y_label, anchor="middle", upwards=True)


def _number(value: float) -> str:
    return plain(0.0 if abs(value) < 1e-12 else value, 6)


@dataclass(frozen=True)
class ChartCurve:
    """One curve of a chart: x, y of equal length; NaN breaks the line. dots: as points, not as a line."""

    label: str
    x: np.ndarray
    y: np.ndarray
    colour: str = PALETTE[0]
    dashed: bool = False
    dots: bool = False
    dash: str = DASHES[0]  # pattern of a dashed line
    strength: np.ndarray | None = None  # opacity of each point, 0 to 1, or None


def chart(
    curves: Sequence[ChartCurve],
    *,
    x_label: str,
    y_label: str,
    title: str,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    size: tuple[int, int] = (560, 300),
    logarithmic: bool = False,
) -> str:
    """Draw curves over common axes, the legend in rows above.

    size : width, and height without the legend. logarithmic : the y axis.
    """
    width, height = size
    x = ChartAxis(*(x_range or _range([curve.x for curve in curves])), LEFT, width - 12)
    low, high = y_range or _range([curve.y for curve in curves], zero=True)
    named = [curve for curve in curves if curve.label]
    above = LEGEND_ROW * len(named)
    y = ChartAxis(low, high, above + height - BOTTOM, above + 10, logarithmic)
    drawing = Drawing(width, above + height, title)
    draw_axes(drawing, x, y, x_label, y_label)
    margin = 0.02 * (y.start - y.end)
    for curve in curves:
        across, up = x(curve.x), y(curve.y)
        inside = (across >= x.start - 1e-6) & (across <= x.end + 1e-6) & np.isfinite(up)
        if curve.dots:  # a point outside is not drawn at all
            inside &= (up >= y.end - margin) & (up <= y.start + margin)
            strength = np.full(across.shape, 0.6) if curve.strength is None else np.asarray(curve.strength, float)
            for a, b, opacity in zip(across[inside], up[inside], strength[inside], strict=True):
                drawing.circle(a, b, 2.2, fill=curve.colour, opacity=opacity)
        else:  # a line runs to the edge
            commands = outline(np.where(inside, across, np.nan), np.clip(up, y.end - margin, y.start + margin))
            drawing.path(commands, stroke=curve.colour, width=1.8, dashed=curve.dashed, dash=curve.dash)
    for row, curve in enumerate(named):
        at = 8 + LEGEND_ROW * row
        if curve.dots:
            drawing.circle(LEFT + LEGEND_LINE / 2, at, 2.6, fill=curve.colour)
        else:
            commands = f"M{LEFT} {at}h{LEGEND_LINE}"
            drawing.path(commands, stroke=curve.colour, width=2, dashed=curve.dashed, dash=curve.dash)
        drawing.text(LEFT + LEGEND_LINE + 5, at + 4, curve.label, size=11)
    return drawing.finish()


def _range(arrays: list[np.ndarray], *, zero: bool = False) -> tuple[float, float]:
    """Compute the range of all finite values, with 0 in it where requested; never empty."""
    values = np.concatenate([np.asarray(a, float).ravel() for a in arrays] or [np.zeros(0)])
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    if zero:
        low, high = min(low, 0.0), high + 0.05 * (high - min(low, 0.0))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


MOST_NAMES = 16  # beside each other in a drawing of lights


def lights_plot(
    directions: np.ndarray,
    names: list[str],
    kinds: list[str],
    *,
    size: int = 340,
    title: str = "directions of the lights, seen from the camera",
    sides: Sequence[str] = ("top", "right", "bottom", "left"),
) -> str:
    """Draw light directions (lights, 3) from the camera: distance from the middle grows evenly with incidence.

    The rim is 90 degrees. kinds: sample | check | held out. Of many lights only some are named.
    """
    middle, radius = size / 2, size / 2 - 30
    drawing = Drawing(size, size, title)
    for degrees in (30, 60, 90):
        drawing.circle(middle, middle, radius * degrees / 90, stroke=GRID)
        aside = 0.7071 * radius * degrees / 90
        drawing.text(middle - aside - 3, middle + aside + 10, f"{degrees}°", anchor="end", size=10, colour=SOFT)
    drawing.line(middle - radius, middle, middle + radius, middle, GRID)
    drawing.line(middle, middle - radius, middle, middle + radius, GRID)
    for text, dx, dy in zip(sides, (0, 1, 0, -1), (-1, 0, 1, 0), strict=False):
        x, y = middle + dx * (radius + 14), middle + dy * (radius + 14) + 4
        drawing.text(x, y, text, anchor="middle", colour=SOFT)
    lights = zip(np.asarray(directions, float), names, kinds, strict=True)
    for number, (direction, name, kind) in enumerate(lights):
        x, y, z = direction
        horizontal = float(np.hypot(x, y))
        reach = np.degrees(np.arctan2(horizontal, z)) / 90 * radius / horizontal if horizontal > 0 else 0.0
        x, y, tip = middle + x * reach, middle - y * reach, f"{name} ({kind})"
        if kind == "check":
            drawing.circle(x, y, 5, fill=PAPER, stroke=PALETTE[1], width=2, tip=tip)
        elif kind == "held out":
            drawing.diamond(x, y, 6, fill=PAPER, stroke=PALETTE[1], width=2, tip=tip)
        else:
            drawing.circle(x, y, 4.5, fill=PALETTE[0], tip=tip)
        if number % -(-len(names) // MOST_NAMES) == 0:
            drawing.text(x + 8, y + 4, name, size=10)
    return drawing.finish()


def bars(values: list[float], labels: list[str], *, title: str, unit: str, width: int = 560) -> str:
    """Draw horizontal bars with their values, from 0; `values` >= 0."""
    top, line, left = 4, 20, 20 + 6 * max(map(len, labels), default=0)
    largest = max([*values, 0.0]) or 1.0
    drawing = Drawing(width, top * 2 + line * len(values), title)
    for k, (value, label) in enumerate(zip(values, labels, strict=True)):
        y, length = top + k * line, (width - left - 90) * value / largest
        drawing.text(left - 8, y + 14, label, anchor="end", size=11)
        drawing.bar(left, y + 4, max(length, 0.5), 12, PALETTE[0])
        drawing.text(left + length + 6, y + 14, f"{plain(value, 3)} {unit}", size=11)
    return drawing.finish()
