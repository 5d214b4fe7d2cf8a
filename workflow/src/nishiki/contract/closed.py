"""Closed settings models: an unknown key is an error that names the nearest known one."""

import difflib
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from nishiki.contract.limits import names_of
from nishiki.errors import UserError


class Closed(BaseModel):
    """Base of every settings model: frozen, no unknown keys, no silent conversion of strings to numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, allow_inf_nan=False)


class Guarded(Closed):
    """Base of the settings of a stage: its result is checked against the limits of `nishiki.contract.limits`."""

    allow: tuple[str, ...] = Field(
        (), description="names of limits (docs/stability.md) that the result may exceed; otherwise the run stops there"
    )

    @field_validator("allow")
    @classmethod
    def _known_limits(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        known = names_of(cls.STAGE)
        for name in names:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(known) or 'none'}"
                raise ValueError(f"no limit of {cls.STAGE} is called {name!r}; {hint}")
        return tuple(sorted(set(names)))


Model = TypeVar("Model", bound=Closed)


def parse(model: type[Model], values: Any, where: str) -> Model:
    """`values` as a checked `model`.

    Raises UserError naming `where` (a file, or a block of one), the key, what was found and what was expected.
    """
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise UserError(f"{where}: expected a block of keys and values, found {type(values).__name__} {values!r}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = "; ".join(_explain(model, problem) for problem in error.errors())
        raise UserError(f"{where}: {problems}") from None


def _explain(model: type[Closed], problem: dict) -> str:
    path = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model, problem["loc"][:-1])
        near = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
        return f"unknown key {path!r}; {hint}"
    if problem["type"] == "missing":
        return f"key {path!r} is missing"
    return f"{path}: {problem['msg'][0].lower()}{problem['msg'][1:]}, found {problem['input']!r}"


def _known_keys(model: type[Closed], path: tuple) -> list[str]:
    """Keys of the block at `path` inside `model` (unions are searched for the first model that fits)."""
    for part in path:
        field = model.model_fields.get(str(part)) if isinstance(part, str) else None
        inner = _inner_model(field.annotation) if field else None
        if inner is not None:
            model = inner
    return sorted(model.model_fields)


def _inner_model(annotation: Any) -> type[Closed] | None:
    if isinstance(annotation, type) and issubclass(annotation, Closed):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _inner_model(argument)
        if found is not None:
            return found
    return None
