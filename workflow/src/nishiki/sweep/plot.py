"""Error against run time as SVG: every variant with the spread of its repeats, the front, the default, the paper."""

from collections.abc import Sequence
from dataclasses import dataclass

from nishiki.report.svg import PALETTE, PAPER, SOFT, Axis, Drawing, draw_axes

AXES = {"seconds": "time, seconds", "cpu_seconds": "CPU time, seconds"}
LOG_FROM = 8.0
"""From this ratio of the largest to the smallest value an axis is logarithmic."""
WIDTH, HEIGHT = 640, 400
LEFT, RIGHT, TOP, BOTTOM = 66, 18, 14, 74
COLOURS = {"default": PALETTE[1], "paper": PALETTE[3], "peer": PALETTE[2], "": PALETTE[0], "apart": SOFT}
MEANINGS = {
    "default": "default",
    "paper": "the paper's method",
    "peer": "methods of others",
    "": "variants",
    "apart": "not compared",
}
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


def axis_over(values: Sequence[float], start: float, end: float, *, flipped: bool = False, room: float = 0.08) -> Axis:
    """An axis that holds all values with some room; logarithmic where they span a wide ratio and none is 0."""
    low, high = min(values), max(values)
    logarithmic = low > 0 and high / low >= LOG_FROM
    if logarithmic:
        factor = (high / low) ** room
        low, high = low / factor, high * factor
    else:
        margin = room * (high - low) or 0.1 * abs(high) or 1.0
        low, high = max(low - margin, 0.0) if low >= 0 else low - margin, high + margin
    return Axis(low, high, end, start, logarithmic) if flipped else Axis(low, high, start, end, logarithmic)


def plot(marks: Sequence[Mark], best: Sequence[int], *, x_label: str, y_label: str, higher: bool, title: str) -> str:
    """The drawing as a file of its own. Lower left is better: where more is better, the axis points down.

    best : indices of the front's marks, from the fastest on.
    """
    x = axis_over([value for mark in marks for value in (mark.low, mark.x, mark.high)], LEFT, WIDTH - RIGHT)
    y = axis_over([mark.y for mark in marks], HEIGHT - BOTTOM, TOP, flipped=higher)
    drawing = Drawing(WIDTH, HEIGHT, title, alone=True)
    draw_axes(drawing, x, y, x_label, f"{y_label}{' (up is worse)' if higher else ''}")
    if best:  # steps: to the right of and above the line a variant is beaten
        front = [marks[k] for k in best]
        steps = "".join(f"H{x(mark.x):.1f}V{y(mark.y):.1f}" for mark in front[1:])
        commands = f"M{x(front[0].x):.1f} {TOP}V{y(front[0].y):.1f}{steps}H{WIDTH - RIGHT}"
        drawing.path(commands, stroke=SOFT, width=1.4, dashed=True)
    for number, mark in enumerate(marks):
        at, colour = y(mark.y), COLOURS[mark.kind]
        for end in (mark.low, mark.high):
            drawing.line(x(end), at - 4, x(end), at + 4, colour)
        drawing.line(x(mark.low), at, x(mark.high), at, colour)
        draw_sign(drawing, mark.kind, x(mark.x), at, filled=number in best, tip=mark.tip or mark.name)
    draw_names(drawing, marks, x, y)
    draw_legend(drawing, {mark.kind for mark in marks})
    return drawing.finish()


def draw_sign(drawing: Drawing, kind: str, x: float, y: float, *, filled: bool = True, tip: str = "") -> None:
    """The sign of a kind of variant: filled on the front, hollow off it."""
    colour = COLOURS[kind]
    paint = {"fill": colour if filled else PAPER, "stroke": colour, "width": 1.8, "tip": tip}
    if kind == "default":
        drawing.diamond(x, y, 7, **paint)
    elif kind == "paper":
        drawing.path(f"M{x - 5:.1f} {y - 5:.1f}h10v10h-10z", **paint)
    elif kind == "peer":
        drawing.path(f"M{x:.1f} {y - 6.5:.1f}l6 11h-12z", **paint)
    elif kind == "apart":
        drawing.path(f"M{x - 5:.1f} {y:.1f}h10m-5 -5v10", **paint)
    else:
        drawing.circle(x, y, 4.5, **paint)


def draw_names(drawing: Drawing, marks: Sequence[Mark], x: Axis, y: Axis) -> None:
    """A name beside each mark where there is room: the marks that stand out first; others are in tooltip and table."""
    boxes = [(x(mark.x) - 7, y(mark.y) - 7, x(mark.x) + 7, y(mark.y) + 7) for mark in marks]
    boxes += [(x(mark.low), y(mark.y) - 4, x(mark.high), y(mark.y) + 4) for mark in marks]
    for mark in sorted(marks, key=lambda mark: (list(COLOURS).index(mark.kind), mark.y)):
        width = 5.6 * len(mark.name) + 2
        for dx, dy, anchor in PLACES:
            right, up = x(mark.x) + dx, y(mark.y) + dy
            left = right - {"start": 0, "middle": width / 2, "end": width}[anchor]
            box = (left, up - 9, left + width, up + 3)
            inside = left >= LEFT and box[2] <= WIDTH - RIGHT and box[1] >= TOP and box[3] <= HEIGHT - BOTTOM
            if inside and not any(_overlap(box, other) for other in boxes):
                boxes.append(box)
                drawing.text(right, up, mark.name, anchor=anchor, size=11)
                break


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def draw_legend(drawing: Drawing, kinds: set[str]) -> None:
    """What the signs mean, below the axis."""
    at = LEFT + 4.0
    for kind in [kind for kind in MEANINGS if kind in kinds]:
        draw_sign(drawing, kind, at, HEIGHT - 14)
        drawing.text(at + 11, HEIGHT - 10, MEANINGS[kind], size=11)
        at += 20 + 5.2 * len(MEANINGS[kind])
    drawing.path(f"M{at:.1f} {HEIGHT - 14}h22", stroke=SOFT, width=1.4, dashed=True)
    drawing.text(at + 28, HEIGHT - 10, "front; hollow: off it", size=11)
