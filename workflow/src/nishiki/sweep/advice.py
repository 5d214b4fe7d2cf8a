"""What the figures of a sweep advise, in words."""

from nishiki.sweep.front import Point, beaten_by, front

WORTH_SAVING = 0.85
"""A faster variant is mentioned where it takes less than this share of the default's time."""
WORDS = ((0.5, "half"), (1 / 3, "a third of"), (0.25, "a quarter of"), (0.2, "a fifth of"), (0.1, "a tenth of"))


def advice(
    points: list[Point], default: Point, *, paper: Point | None, unit: str, higher: bool, axis: str
) -> list[str]:
    """Sentences on the default: whether it is on the front, what less time costs, what more time buys, the paper.

    points : all variants, the default among them
    unit : of the loss; higher : more of the measure is better (the losses are then its negatives)
    axis : the time meant, `time` or `CPU time`
    """
    best = [points[k] for k in front(points)]
    winners, clear = beaten_by(default, [point for point in points if point is not default])
    winners = winners[:2]
    sentences = [_standing(default, winners, clear, unit, higher, axis)]
    rest = [point for point in best if point not in winners]
    sentences += _faster(default, rest, unit, higher, axis)
    sentences += _better(default, rest, unit, higher, axis, last_word=not winners)
    if paper is not None and paper is not default:
        sentences.append(f"The paper's method ({paper.name}): {compared(paper, default, unit, higher, axis)}.")
    return sentences


def _standing(default: Point, winners: list[Point], clear: bool, unit: str, higher: bool, axis: str) -> str:
    if not winners:
        return f"The default ({default.name}) is on the front: no variant is both faster and better."
    texts = [f"{point.name} ({compared(point, default, unit, higher, axis)})" for point in winners]
    if not clear:
        return (
            f"The default ({default.name}) is on the front within the spread of the repeats; by the medians alone "
            f"{' and '.join(texts)} would be ahead of it."
        )
    return f"The default ({default.name}) is not on the front. At least as fast and better: {'; '.join(texts)}."


def _faster(default: Point, best: list[Point], unit: str, higher: bool, axis: str) -> list[str]:
    """The front's variants that save time: the least loss, and the fastest of all where that is another one."""
    faster = [point for point in best if point.time < WORTH_SAVING * default.time and point.high < default.low]
    if not faster:
        return []
    least = min(faster, key=lambda point: (point.loss, point.time))
    shown = [least] + [point for point in faster[:1] if point is not least]
    return [f"To save time: {point.name}: {compared(point, default, unit, higher, axis)}." for point in shown]


def _better(default: Point, best: list[Point], unit: str, higher: bool, axis: str, *, last_word: bool) -> list[str]:
    """The front's variants that err less: the cheapest, and the best of all where that is another one."""
    better = [point for point in best if point.loss < default.loss]
    if not better:
        return ["No variant is better at any price."] * last_word
    first = min(better, key=lambda point: (point.time, point.loss))
    least = min(better, key=lambda point: (point.loss, point.time))
    shown = [first] + [least] * (least is not first)
    return [f"For less error: {point.name}: {compared(point, default, unit, higher, axis)}." for point in shown]


def compared(point: Point, default: Point, unit: str, higher: bool, axis: str) -> str:
    """`half the time for 0.1° more`: a variant against the default."""
    ratio = point.time / default.time if default.time > 0 else 1.0
    return f"{share(ratio, axis)} {_difference(point, default, unit, higher)}"


def share(ratio: float, axis: str) -> str:
    """A ratio of times in words, where a word is true to 5 per cent."""
    for value, word in WORDS:
        if abs(ratio / value - 1) <= 0.05:
            return f"{word} the {axis}"
    if abs(ratio - 1) <= 0.05:
        return f"the same {axis}"
    if abs(ratio / 2 - 1) <= 0.05:
        return f"twice the {axis}"
    return f"{ratio:.2g} times the {axis}" if ratio < 10 else f"{ratio:.0f} times the {axis}"


def _difference(point: Point, default: Point, unit: str, higher: bool) -> str:
    change = point.loss - default.loss
    if change == 0:
        return "for the same error" if not higher else "for the same figure"
    more = (change > 0) != higher
    gap = "" if unit in ("", "°", "%") else " "
    amount = f"{abs(change):.2g}{gap}{unit}"
    return f"{'for' if change > 0 else 'and'} {amount} {'more' if more else 'less'}"
