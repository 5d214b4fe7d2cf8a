"""Closed settings models: an unknown key is an error that names the nearest known one."""

import difflib
import re
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from nishiki.artifacts.limits import Limit
from nishiki.errors import UserError


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
