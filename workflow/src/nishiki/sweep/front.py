"""Compare variants by error and run time: the Pareto front, its drawing, and advice in words."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from nishiki.report.svg import PALETTE, PAPER, SOFT, ChartAxis, Drawing, draw_axes

NEGLIGIBLE = 0.01
"""Relative difference of errors below which they count as equal if the times do not differ clearly either."""


@dataclass(frozen=True)
class VariantPoint:
    """Variant in the plane of time and loss."""

    name: str
    time: float  # median over the repeats
    low: float  # low, high: least and greatest of them
    high: float
    loss: float  # the error, less is better (the negative of a measure of which more is better)
    figure: float = 0.0  # of the drawing: the error or measure itself
    kind: str = ""  # of the drawing: default, paper, peer, apart, or nothing
    tip: str = ""  # of the drawing: what its tooltip says


def front(points: Sequence[VariantPoint]) -> list[int]:
    """List the indices of the points that no other point beats, from the fastest on.

    A point is beaten by one that is at least as good in time and loss and better in one of them. O(n log n).
    """
    order = sorted(range(len(points)), key=lambda k: quickest(points[k]))
    indices: list[int] = []
    for k in order:
        best = points[indices[-1]] if indices else None
        equal = best is not None and (best.time, best.loss) == (points[k].time, points[k].loss)
        if best is None or points[k].loss < best.loss or equal:
            indices.append(k)
    return indices


def beaten_by(point: VariantPoint, others: Sequence[VariantPoint]) -> tuple[list[VariantPoint], bool]:
    """List the others that beat `point`, best loss first, and whether at least one does so clearly.

    Clearly: it is faster beyond the spread of the repeats, or its loss is lower by more than NEGLIGIBLE.
    """
    better = [
        other
        for other in others
        if other.time <= point.time
        and other.loss <= point.loss
        and (other.time, other.loss) != (point.time, point.loss)
    ]
    clear = any(other.high < point.low or point.loss - other.loss > NEGLIGIBLE * abs(point.loss) for other in better)
    return sorted(better, key=least), clear


AXES = {"seconds": "time, seconds", "cpu_seconds": "CPU time, seconds"}
LOG_FROM = 8.0
"""Least ratio of the largest to the smallest value for a logarithmic axis."""
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
"""Possible places of a name beside its mark: offset in pixels and anchor of the text."""


def axis_over(
    values: Sequence[float], start: float, end: float, *, flipped: bool = False, room: float = 0.08
) -> ChartAxis:
    """Choose an axis that holds all values with some room; logarithmic for wide ratios without 0."""
    low, high = min(values), max(values)
    logarithmic = low > 0 and high / low >= LOG_FROM
    if logarithmic:
        factor = (high / low) ** room
        low, high = low / factor, high * factor
    else:
        margin = room * (high - low) or 0.1 * abs(high) or 1.0
        low, high = max(low - margin, 0.0) if low >= 0 else low - margin, high + margin
    return ChartAxis(low, high, end, start, logarithmic) if flipped else ChartAxis(low, high, start, end, logarithmic)


def plot(
    points: Sequence[VariantPoint], best: Sequence[int], *, x_label: str, y_label: str, higher: bool, title: str
) -> str:
    """Draw a file of its own. Lower left is better: where more is better, the axis points down.

    best : indices of the front's points, from the fastest on.
    """
    x = axis_over([value for point in points for value in (point.low, point.time, point.high)], LEFT, WIDTH - RIGHT)
    y = axis_over([point.figure for point in points], HEIGHT - BOTTOM, TOP, flipped=higher)
    drawing = Drawing(WIDTH, HEIGHT, title, alone=True)
    draw_axes(drawing, x, y, x_label, f"{y_label}{' (up is worse)' if higher else ''}")
    if best:  # steps: to the right of and above the line a variant is beaten
        first, *others = (points[k] for k in best)
        steps = "".join(f"H{x(point.time):.1f}V{y(point.figure):.1f}" for point in others)
        commands = f"M{x(first.time):.1f} {TOP}V{y(first.figure):.1f}{steps}H{WIDTH - RIGHT}"
        drawing.path(commands, stroke=SOFT, width=1.4, dashed=True)
    for number, point in enumerate(points):
        across, at, colour = float(x(point.time)), float(y(point.figure)), COLOURS[point.kind]
        for end in (point.low, point.high):
            drawing.line(x(end), at - 4, x(end), at + 4, colour)
        drawing.line(x(point.low), at, x(point.high), at, colour)
        draw_sign(drawing, point.kind, across, at, filled=number in best, tip=point.tip)
    draw_names(drawing, points, x, y)
    kinds = {point.kind for point in points}
    at = LEFT + 4.0
    for kind in [kind for kind in MEANINGS if kind in kinds]:
        draw_sign(drawing, kind, at, HEIGHT - 14)
        drawing.text(at + 11, HEIGHT - 10, MEANINGS[kind], size=11)
        at += 20 + 5.2 * len(MEANINGS[kind])
    drawing.path(f"M{at:.1f} {HEIGHT - 14}h22", stroke=SOFT, width=1.4, dashed=True)
    drawing.text(at + 28, HEIGHT - 10, "front; hollow: off it", size=11)
    return drawing.finish()


def draw_sign(drawing: Drawing, kind: str, x: float, y: float, *, filled: bool = True, tip: str = "") -> None:
    """Draw the sign of a kind of variant: filled on the front, hollow off it."""
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


def draw_names(drawing: Drawing, points: Sequence[VariantPoint], x: ChartAxis, y: ChartAxis) -> None:
    """Draw a name beside each sign where there is room, conspicuous ones first; others are in the table."""
    places = [(x(point.time), y(point.figure)) for point in points]
    boxes = [(across - 7, at - 7, across + 7, at + 7) for across, at in places]
    boxes += [(x(point.low), y(point.figure) - 4, x(point.high), y(point.figure) + 4) for point in points]
    for point in sorted(points, key=lambda point: (list(COLOURS).index(point.kind), point.figure)):
        width = 5.6 * len(point.name) + 2
        for dx, dy, anchor in PLACES:
            right, up = x(point.time) + dx, y(point.figure) + dy
            left = right - {"start": 0, "middle": width / 2, "end": width}[anchor]
            box = (left, up - 9, left + width, up + 3)
            inside = left >= LEFT and box[2] <= WIDTH - RIGHT and box[1] >= TOP and box[3] <= HEIGHT - BOTTOM
            apart = (box[2] <= b[0] or b[2] <= box[0] or box[3] <= b[1] or b[3] <= box[1] for b in boxes)
            if inside and all(apart):
                boxes.append(box)
                drawing.text(right, up, point.name, anchor=anchor, size=11)
                break


WORTH_SAVING = 0.85
"""Share of the default's time below which a faster variant is mentioned."""
WORDS = {1: "the same", 2: "twice the", 0.5: "half the"} | {
    1 / part: f"a {word} of the" for part, word in {3: "third", 4: "quarter", 5: "fifth", 10: "tenth"}.items()
}


def advice(
    points: list[VariantPoint], default: VariantPoint, *, paper: VariantPoint | None, unit: str, higher: bool, axis: str
) -> list[str]:
    """Write sentences on the default: whether it is on the front, cost of less time, gain of more, the paper.

    points : all variants, the default among them
    unit : of the loss; higher : more of the measure is better (the losses are then its negatives)
    axis : the time meant, `time` or `CPU time`
    """

    def against(point: VariantPoint) -> str:
        """Format a variant against the default: `half the time for 0.1° more`."""
        ratio = point.time / default.time if default.time > 0 else 1.0
        return f"{share(ratio, axis)} {_difference(point, default, unit, higher)}"

    winners, clear = beaten_by(default, [point for point in points if point is not default])
    winners = winners[:2]
    rest = [point for point in (points[k] for k in front(points)) if point not in winners]
    sentences = [_standing(default, [f"{point.name} ({against(point)})" for point in winners], clear)]
    faster = [point for point in rest if point.time < WORTH_SAVING * default.time and point.high < default.low]
    sentences += [f"To save time: {point.name}: {against(point)}." for point in _ends(faster, least, quickest)]
    better = _ends([point for point in rest if point.loss < default.loss], quickest, least)
    sentences += [f"For less error: {point.name}: {against(point)}." for point in better]
    if not better and not winners:
        sentences.append("No variant is better at any price.")
    if paper is not None and paper is not default:
        sentences.append(f"The paper's method ({paper.name}): {against(paper)}.")
    return sentences


def least(point: VariantPoint) -> tuple[float, float]:
    """Order points by their loss."""
    return point.loss, point.time


def quickest(point: VariantPoint) -> tuple[float, float]:
    """Order points by their time."""
    return point.time, point.loss


def _ends(points: list[VariantPoint], *orders: Callable[[VariantPoint], tuple[float, float]]) -> list[VariantPoint]:
    """List the first point by every order, each once."""
    return list(dict.fromkeys(min(points, key=order) for order in orders if points))


def _standing(default: VariantPoint, winners: list[str], clear: bool) -> str:
    if not winners:
        return f"The default ({default.name}) is on the front: no variant is both faster and better."
    if not clear:
        return (
            f"The default ({default.name}) is on the front within the spread of the repeats; by the medians alone "
            f"{' and '.join(winners)} would be ahead of it."
        )
    return f"The default ({default.name}) is not on the front. At least as fast and better: {'; '.join(winners)}."


def share(ratio: float, axis: str) -> str:
    """Express a ratio of times in words, if a word is true to 5 per cent."""
    words = [word for value, word in WORDS.items() if abs(ratio / value - 1) <= 0.05]
    return f"{words[0] if words else f'{ratio:.2g} times the' if ratio < 10 else f'{ratio:.0f} times the'} {axis}"


def _difference(point: VariantPoint, default: VariantPoint, unit: str, higher: bool) -> str:
    change = point.loss - default.loss
    if change == 0:
        return "for the same error" if not higher else "for the same figure"
    more = (change > 0) != higher
    gap = "" if unit in ("", "°", "%") else " "
    amount = f"{abs(change):.2g}{gap}{unit}"
    return f"{'for' if change > 0 else 'and'} {amount} {'more' if more else 'less'}"
