"""Check a result against its limits: conditions, flagged shares, registration, bounds of parameters.

A limit stands where captures leave off: beyond what sound captures give (listed in docs/notes/stability.md), of
the object and not of the picture, against what came in and not what the stage made of it. From `doubt` on the run goes
on with a warning, which stands at the head of the report. The setting `allow` of a stage lists the limits that its
result may exceed.
"""

import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from nishiki.errors import UserError

NAME = "at_bounds"
"""Any stage lists such parameters in words under this name, at any depth of its diagnostics."""


def at_bounds(diagnostics: Mapping[str, Any]) -> list[str]:
    """List parameters at a bound, each with the block of the diagnostics that it belongs to."""
    names = []
    for name, value in diagnostics.items():
        if name == NAME:
            names += [str(each) for each in value]
        elif isinstance(value, Mapping):
            names += [f"{name}: {each}" for each in at_bounds(value)]
    return names


Figure = Callable[[Mapping[str, Any]], float | None]


@dataclass(frozen=True)
class Limit:
    """Bound a figure of the diagnostics: the result is beyond the limit below `least` or above `most`."""

    name: str
    meaning: str
    figure: Figure  # None where it does not apply; without a bound it is reported only
    most: float | None = None
    least: float | None = None
    remedy: str = ""  # what to change
    why: str = ""  # reason of the value
    warns: bool = False  # the run goes on beyond the limit too, because the result may be right
    doubt: float | None = None  # level on the same side from which the run goes on with a warning

    def beyond(self, value: float) -> bool:
        """Return whether a value is beyond the limit; a NaN is."""
        above = self.most is not None and not value <= self.most
        return above or (self.least is not None and not value >= self.least)

    def doubtful(self, value: float) -> bool:
        """Return whether a value is a reason for a warning but not beyond a limit that stops."""
        if self.beyond(value):
            return self.warns
        return self.doubt is not None and not (value <= self.doubt if self.most is not None else value >= self.doubt)

    @property
    def stated(self) -> str:
        """The limit in words, empty where there is none."""
        if self.most is not None:
            return f"at most {self.most:g}"
        return "" if self.least is None else f"at least {self.least:g}"

    @property
    def sound(self) -> str:
        """What sound captures give, in words: the level of doubt where there is one, else the limit."""
        if self.doubt is None:
            return self.stated
        return f"{'at most' if self.most is not None else 'at least'} {self.doubt:g}"


@dataclass(frozen=True)
class LimitCheck:
    """One figure of a result beside its limit. allowed: beyond it, and listed in the setting `allow`."""

    limit: Limit
    value: float
    beyond: bool
    allowed: bool


def at(path: str) -> Figure:
    """Read the diagnostic at a dotted path; None where it is missing."""

    def figure(diagnostics: Mapping[str, Any]) -> float | None:
        value = _part(diagnostics, path)
        return None if value is None else float(value)

    return figure


def _part(value: Any, path: str) -> Any:
    """Return what stands at a dotted path, None where nothing does; * stands for every part of a block or list."""
    first, _, rest = path.partition(".")
    if first == "*":
        parts = value.values() if isinstance(value, Mapping) else value or ()
        return [_part(each, rest) if rest else each for each in parts]
    value = value.get(first) if isinstance(value, Mapping) else None
    return _part(value, rest) if rest else value


def share(part: str, total_path: str) -> Figure:
    """Divide one diagnostic by another; 0 of nothing is 0."""
    return _combine_two(part, total_path, lambda value, total: value / total if total else 0.0)


def excess(part: str, over: str) -> Figure:
    """Subtract one diagnostic from another."""
    return _combine_two(part, over, operator.sub)


def _combine_two(first: str, second: str, combine: Callable[[float, float], float]) -> Figure:
    """Combine two diagnostics; None where either is missing."""

    def figure(diagnostics: Mapping[str, Any]) -> float | None:
        one, other = at(first)(diagnostics), at(second)(diagnostics)
        return None if one is None or other is None else combine(one, other)

    return figure


def extreme(path: str, of: Callable[[Iterable[float]], float] = max) -> Figure:
    """Return the largest (or smallest) number in the list or block at a dotted path, where * stands for all parts."""

    def figure(diagnostics: Mapping[str, Any]) -> float | None:
        numbers = [float(each) for each in _leaves(_part(diagnostics, path)) if each is not None]
        return of(numbers) if numbers else None

    return figure


def _leaves(value: Any) -> Iterable[Any]:
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for each in value:
            yield from _leaves(each)
    else:
        yield value


def limit_checks(
    limits: Iterable[Limit], diagnostics: Mapping[str, Any], allow: Iterable[str] = ()
) -> list[LimitCheck]:
    """Check every figure that has a limit or counts flags, in the order of the limits."""
    allow, checks = set(allow), []
    for limit in limits:
        value = limit.figure(diagnostics)
        if value is not None:
            beyond = limit.beyond(value)
            checks.append(LimitCheck(limit, value, beyond, beyond and limit.name in allow))
    return checks


def check(stage: str, limits: Iterable[Limit], diagnostics: Mapping[str, Any], allow: Iterable[str] = ()) -> None:
    """Raise a UserError that names each limit that a stage's result exceeds, with its remedy, unless it is allowed."""
    beyond = [each for each in limit_checks(limits, diagnostics, allow) if each.beyond and not each.allowed]
    wrong = [each for each in beyond if not each.limit.warns]
    if wrong:
        failed = "; ".join(
            f"{each.limit.meaning} is {each.value:.4g}, expected {each.limit.stated} (limit {each.limit.name})"
            for each in wrong
        )
        failed += f". Remedy: {'; '.join(dict.fromkeys(each.limit.remedy for each in wrong))}"
        names = ", ".join(each.limit.name for each in wrong)
        raise UserError(
            f"the result is beyond what can be trusted and is not kept: {failed}. To keep such a result all the same, "
            f"set {stage}.allow: [{names}]; what finished before stays"
        )


def limit_warnings(
    stage: str, limits: Iterable[Limit], diagnostics: Mapping[str, Any], allow: Iterable[str] = ()
) -> list[str]:
    """Return a sentence for each figure that deserves a warning, unless its limit is allowed."""
    allow = set(allow)
    return [
        f"{each.limit.meaning} is {each.value:.3g}, expected {each.limit.sound}. Remedy: {each.limit.remedy}; or, if "
        f"it is right, set {stage}.allow: [{each.limit.name}]"
        for each in limit_checks(limits, diagnostics, allow)
        if each.limit.doubtful(each.value) and each.limit.name not in allow
    ]
