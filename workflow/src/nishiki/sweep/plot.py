"""Error against run time as SVG: every variant with the spread of its repeats, the front, the default, the paper."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from nishiki.report.svg import GRID, INK, PALETTE, SOFT, number, ticks

AXES = {"seconds": "time, seconds", "cpu_seconds": "CPU time, seconds"}
LOG_FROM = 8.0
"""From this ratio of the largest to the smallest value an axis is logarithmic."""
WIDTH, HEIGHT = 640, 400
LEFT, RIGHT, TOP, BOTTOM = 66, 18, 14, 74
FONT = "Source Sans 3,Segoe UI,Roboto,Arial,sans-serif"
COLOURS = {"default": PALETTE[1], "paper": PALETTE[3], "peer": PALETTE[2], "": PALETTE[0], "apart": SOFT}
MEANINGS = {
    "default": "default",
    "paper": "the paper's method",
    "peer": "methods of others",
    "": "variants",
    "apart": "not compared",
}


@dataclass(frozen=True)
class Mark:
    """One variant: x with its spread, y, what it is (default, paper, peer, apart, nothing), what its tooltip says."""

    name: str
    x: float
    low: float
    high: float
    y: float
    kind: str = ""
    tip: str = ""


@dataclass(frozen=True)
class Axis:
    """A linear or logarithmic axis from values (low to high) to pixels (start to end)."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool = False

    def __call__(self, value: float) -> float:
        """Pixel of a value."""
        f = math.log if self.logarithmic else float
        low, high = f(self.low), f(self.high)
        return self.start + (f(value) - low) / (high - low) * (self.end - self.start)

    def marks(self) -> list[float]:
        """Round values for the ticks: 1, 2, 5 times powers of ten on a logarithmic axis."""
        if not self.logarithmic:
            return ticks(self.low, self.high, 6)
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        found = [float(f"{factor}e{power}") for power in range(first, last + 1) for factor in (1, 2, 5)]
        return [value for value in found if self.low <= value <= self.high]


def axis_over(values: Sequence[float], start: float, end: float, *, flipped: bool = False, room: float = 0.08) -> Axis:
    """An axis that holds all values with some room; logarithmic where they span a wide ratio and none is 0."""
    low, high = min(values), max(values)
    if low > 0 and high / low >= LOG_FROM:
        factor = (high / low) ** room
        low, high, logarithmic = low / factor, high * factor, True
    else:
        margin = room * (high - low) or 0.1 * abs(high) or 1.0
        positive = low >= 0
        low, high, logarithmic = low - margin, high + margin, False
        low = max(low, 0.0) if positive else low
    return Axis(low, high, end, start, logarithmic) if flipped else Axis(low, high, start, end, logarithmic)


def plot(marks: Sequence[Mark], best: Sequence[int], *, x_label: str, y_label: str, higher: bool, title: str) -> str:
    """The drawing as a file of its own. Lower left is better: where more is better, the axis points down.

    best : indices of the front's marks, from the fastest on.
    """
    x = axis_over([value for mark in marks for value in (mark.low, mark.x, mark.high)], LEFT, WIDTH - RIGHT)
    y = axis_over([mark.y for mark in marks], HEIGHT - BOTTOM, TOP, flipped=higher)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        f'font-family="{FONT}" role="img" aria-label="{escape(title, quote=True)}">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>'
    ]
    parts += _frame(x, y, x_label, f"{y_label}{' (up is worse)' if higher else ''}")
    parts += _front([marks[k] for k in best], x, y)
    parts += [_mark(mark, x, y, number in best) for number, mark in enumerate(marks)]
    parts += _labels(marks, x, y)
    parts += _legend({mark.kind for mark in marks})
    return "".join([*parts, "</svg>"])


def _frame(x: Axis, y: Axis, x_label: str, y_label: str) -> list[str]:
    floor = HEIGHT - BOTTOM
    parts = []
    for value in x.marks():
        parts.append(_line(x(value), TOP, x(value), floor, GRID))
        parts.append(_text(x(value), floor + 16, number(value), anchor="middle"))
    for value in y.marks():
        parts.append(_line(LEFT, y(value), WIDTH - RIGHT, y(value), GRID))
        parts.append(_text(LEFT - 7, y(value) + 4, number(value), anchor="end"))
    parts.append(_line(LEFT, floor, WIDTH - RIGHT, floor, SOFT))
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, floor + 34, x_label, anchor="middle"))
    middle = (TOP + floor) / 2
    turn = f' transform="rotate(-90 14 {middle:.1f})"'
    return [*parts, _text(14, middle, y_label, anchor="middle", more=turn)]


def _front(best: Sequence[Mark], x: Axis, y: Axis) -> list[str]:
    """The front as steps: to the right of and above the line a variant is beaten."""
    if not best:
        return []
    path = f"M{x(best[0].x):.1f} {TOP}V{y(best[0].y):.1f}"
    path += "".join(f"H{x(mark.x):.1f}V{y(mark.y):.1f}" for mark in best[1:])
    return [f'<path d="{path}H{WIDTH - RIGHT}" fill="none" stroke="{SOFT}" stroke-width="1.4" stroke-dasharray="5 4"/>']


def _mark(mark: Mark, x: Axis, y: Axis, ahead: bool) -> str:
    at, colour = (x(mark.x), y(mark.y)), COLOURS[mark.kind]
    whisker = "".join(_line(x(end), at[1] - 4, x(end), at[1] + 4, colour) for end in (mark.low, mark.high))
    whisker += _line(x(mark.low), at[1], x(mark.high), at[1], colour)
    return f"<g><title>{escape(mark.tip or mark.name)}</title>{whisker}{shape(mark.kind, *at, ahead=ahead)}</g>"


def shape(kind: str, x: float, y: float, *, ahead: bool = True) -> str:
    """The sign of a kind of variant: filled on the front, hollow off it."""
    colour = COLOURS[kind]
    paint = f'fill="{colour if ahead else "#fff"}" stroke="{colour}" stroke-width="1.8"'
    if kind == "default":
        return f'<path d="M{x:.1f} {y - 7:.1f}l7 7l-7 7l-7 -7z" {paint}/>'
    if kind == "paper":
        return f'<rect x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10" {paint}/>'
    if kind == "peer":
        return f'<path d="M{x:.1f} {y - 6.5:.1f}l6 11h-12z" {paint}/>'
    if kind == "apart":
        return f'<path d="M{x - 5:.1f} {y:.1f}h10m-5 -5v10" {paint}/>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5" {paint}/>'


PLACES: tuple[tuple[int, int, str], ...] = (
    (9, -8, "start"),
    (9, 16, "start"),
    (-9, -8, "end"),
    (-9, 16, "end"),
    (0, -12, "middle"),
    (0, 20, "middle"),
    (13, 4, "start"),
    (-13, 4, "end"),
)
"""Where a name may stand beside its mark: offsets in pixels and what of the text lies there."""


def _labels(marks: Sequence[Mark], x: Axis, y: Axis) -> list[str]:
    """A name beside each mark where there is room: the marks that stand out first; others are in tooltip and table."""
    taken = [(x(mark.x) - 7, y(mark.y) - 7, x(mark.x) + 7, y(mark.y) + 7) for mark in marks]
    taken += [(x(mark.low), y(mark.y) - 4, x(mark.high), y(mark.y) + 4) for mark in marks]
    parts = []
    for mark in sorted(marks, key=lambda mark: (list(COLOURS).index(mark.kind), mark.y)):
        wide = 5.6 * len(mark.name) + 2
        for dx, dy, anchor in PLACES:
            px, py = x(mark.x) + dx, y(mark.y) + dy
            left = px - {"start": 0, "middle": wide / 2, "end": wide}[anchor]
            box = (left, py - 9, left + wide, py + 3)
            inside = left >= LEFT and left + wide <= WIDTH - RIGHT and py - 9 >= TOP and py + 3 <= HEIGHT - BOTTOM
            if inside and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                parts.append(_text(px, py, mark.name, anchor=anchor, size=11))
                break
    return parts


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _legend(kinds: set[str]) -> list[str]:
    parts, at = [], LEFT + 4.0
    for kind in [kind for kind in MEANINGS if kind in kinds]:
        parts += [shape(kind, at, HEIGHT - 14), _text(at + 11, HEIGHT - 10, MEANINGS[kind], size=11)]
        at += 20 + 5.2 * len(MEANINGS[kind])
    parts.append(f'<path d="M{at:.1f} {HEIGHT - 14}h22" stroke="{SOFT}" stroke-width="1.4" stroke-dasharray="5 4"/>')
    return [*parts, _text(at + 28, HEIGHT - 10, "front; hollow: off it", size=11)]


def _line(x0: float, y0: float, x1: float, y1: float, colour: str) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}"/>'


def _text(x: float, y: float, text: str, *, anchor: str = "start", size: int = 12, more: str = "") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{INK}" text-anchor="{anchor}"{more}>'
        f"{escape(str(text))}</text>"
    )
