"""Declare the settings of a stage, the limits of its result and the arrays that it writes.

Limits bound conditions, flagged shares, registration and parameters. A limit stands where captures leave off: beyond
what sound captures give (listed in docs/notes/stability.md), of the object and not of the picture, against what came
in and not what the stage made of it. From `doubt` on the run goes on with a warning, which stands at the head of the
report. The setting `allow` of a stage lists the limits that its result may exceed.

Settings are closed models: an unknown key is an error that names the nearest known one.
"""

import difflib
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from nishiki.errors import UserError

AT_BOUNDS = "at_bounds"
"""Any stage lists such parameters in words under this name, at any depth of its diagnostics."""


def at_bounds(diagnostics: Mapping[str, Any]) -> list[str]:
    """List parameters at a bound, each with the block of the diagnostics that it belongs to."""
    names = []
    for name, value in diagnostics.items():
        if name == AT_BOUNDS:
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


class Output(NamedTuple):
    """An array of a store, as it is written and as the stage's page shows it."""

    name: str  # NNN: three digits; COMPONENT: a word
    dtype: str
    unit: str  # of its values, or what they count; empty of codes
    meaning: str
    axes: str = ""  # where they follow the capture: names of the axes, a number where the length is fixed

    @property
    def attributes(self) -> dict[str, Any]:
        """What is stored beside the values."""
        return {name: text for name, text in (("unit", self.unit), ("meaning", self.meaning)) if text}


def output_of(outputs: Iterable[Output], name: str) -> Output:
    """Return the declaration of an array. KeyError where a stage writes one that it does not declare."""
    for output in outputs:
        if re.fullmatch(output.name.replace("NNN", r"\d{3}").replace("COMPONENT", r"\w+"), name):
            return output
    raise KeyError(name)


def convert_to_declared(outputs: Iterable[Output], arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Give arrays their declared types. KeyError where one is not declared, ValueError where axes disagree.

    Axes of one name have one length in all arrays.
    """
    outputs, lengths, out = tuple(outputs), dict[str, int](), {}
    for name, values in arrays.items():
        declared = output_of(outputs, name)
        axes = declared.axes.split()
        pairs = zip(axes, values.shape, strict=False)
        found = tuple(lengths.setdefault(axis, int(axis) if axis.isdigit() else n) for axis, n in pairs)
        if len(axes) != values.ndim or found != values.shape:
            raise ValueError(f"array {name} of shape {values.shape}: expected the axes {axes}, of lengths {lengths}")
        out[name] = values.astype(declared.dtype, copy=False)
    return out


class Closed(BaseModel):
    """Base of every settings model: frozen, no unknown keys, no silent conversion of strings to numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, allow_inf_nan=False)


class Guarded(Closed):
    """Base of the settings of a stage; a subclass states its name, the version of its output and its limits."""

    STAGE: ClassVar[str]
    VERSION: ClassVar[int]
    LIMITS: ClassVar[tuple[Limit, ...]] = ()

    allow: tuple[str, ...] = Field(
        (), description="names of limits (docs/notes/stability.md) that the result may exceed without stopping the run"
    )

    def __init_subclass__(
        cls, *, stage: str = "", version: int = 1, limits: tuple[Limit, ...] = (), **options: Any
    ) -> None:
        super().__init_subclass__(**options)
        if stage:
            cls.STAGE, cls.VERSION, cls.LIMITS = stage, version, limits

    @field_validator("allow")
    @classmethod
    def _check_limits(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        known = tuple(limit.name for limit in cls.LIMITS if limit.stated)
        for name in names:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(known) or 'none'}"
                raise ValueError(f"no limit of {cls.STAGE} is called {name!r}; {hint}")
        return tuple(sorted(set(names)))


Model = TypeVar("Model", bound=Closed)


@dataclass(frozen=True)
class Fault:
    """A value that a closed model refuses."""

    kind: str  # what is wrong
    key: str  # its place, with dots; empty where several values contradict one another
    text: str = ""  # text, hint: what is expected, and where to look for the right key
    hint: str = ""
    value: Any = None  # what was given

    def __str__(self) -> str:
        if self.kind == "missing-key":
            return f"key {self.key!r} is missing"
        if self.kind == "unknown-key":
            return f"unknown key {self.key!r}; {self.hint}"
        return f"{self.key}: {self.text}, found {self.value!r}"


def merge_blocks(below: dict, above: dict) -> dict:
    """Lay blocks of settings over others."""
    result = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merge_blocks(result[key], value) if both else value
    return result


def parse(model: type[Model], values: Any, where: str) -> Model:
    """Check `values` against a `model`.

    Raises UserError naming `where` (a file, or a block of one), the key, what was found and what was expected.
    """
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise UserError(f"{where}: expected a block of keys and values, found {type(values).__name__} {values!r}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise UserError(f"{where}: {'; '.join(map(str, faults(model, values, error)))}") from None


def faults(model: type[Closed], values: dict, error: ValidationError) -> list[Fault]:
    """List the faults of `values`.

    A value that may be of several kinds has a problem for each: those of the nearest kind are returned, or all in one.
    """
    by_place: dict[tuple, list[tuple[tuple, Any]]] = {}
    problems = error.errors()
    inside = {problem["loc"][:-1] for problem in problems}
    for problem in problems:
        if problem["type"] == "too_short" and problem["loc"] in inside:
            continue  # refused items are not counted: the list is not too short
        path, chosen = _written(values, problem["loc"])
        by_place.setdefault(chosen, []).append((path, problem))
    result = []
    for chosen, several in by_place.items():
        deepest = max(len(path) for path, _ in several)
        nearest = [(path, problem) for path, problem in several if len(path) == deepest]
        if len(nearest) == 1 or deepest > len(chosen):
            result += [_fault(model, path, problem) for path, problem in nearest]
        else:
            kinds = dict.fromkeys(_plain(problem["msg"]).removeprefix("input should be ") for _, problem in nearest)
            text = f"input should be {' or '.join(kinds)}"
            result.append(Fault("wrong-value", _join_path(chosen), text, value=nearest[0][1]["input"]))
    return result


def _written(values: Any, place: tuple) -> tuple[tuple, tuple]:
    """Return a problem's keys as the user wrote them, and those up to the choice of a value's kind.

    Between them, pydantic names the kinds that it tried. A key that is missing or unknown ends the way.
    """
    path: list = []
    chosen = None
    for number, part in enumerate(place):
        inside = isinstance(values, dict) and part in values
        listed = isinstance(values, list | tuple) and isinstance(part, int) and part < len(values)
        if inside or listed:
            path.append(part)
            values = values[part]
        elif number + 1 == len(place) and (
            isinstance(values, list | tuple)
            if isinstance(part, int)
            else isinstance(values, dict) and "[" not in part  # not "[key]", nor a kind like "literal['auto']"
        ):
            path.append(part)
        elif chosen is None:
            chosen = tuple(path)
    return tuple(path), tuple(path) if chosen is None else chosen


def _plain(message: str) -> str:
    """Reword a message of pydantic for the configuration."""
    text = message[0].lower() + message[1:]
    text = re.sub(r"a valid dictionary( or instance of \w+)?", "a block of keys and values", text)
    text = re.sub(r"a valid (tuple|list|array)", "a list", text)
    return re.sub(r"a valid (integer|number), unable to parse string as (an?) \w+", r"\2 \1", text)


def _fault(model: type[Closed], path: tuple, problem: Any) -> Fault:
    key, last, value = _join_path(path), str(path[-1]) if path else "", problem["input"]
    if problem["type"] == "missing":
        return Fault("missing-key", key)
    if problem["type"] == "extra_forbidden":
        block = model  # that of the key; of a union the first model that fits
        for part in path[:-1]:
            field = block.model_fields.get(str(part)) if isinstance(part, str) else None
            block = (_inner_model(field.annotation) if field else None) or block
        known = sorted(block.model_fields)
        near = difflib.get_close_matches(last, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
        return Fault("unknown-key", key, hint=hint)
    return Fault("wrong-value", key, _plain(problem["msg"]), value=value)


def _join_path(path: tuple) -> str:
    return ".".join(map(str, path))


def _inner_model(annotation: Any) -> type[Closed] | None:
    if isinstance(annotation, type) and issubclass(annotation, Closed):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        inner = _inner_model(argument)
        if inner is not None:
            return inner
    return None
