"""Declare the settings of a sweep, and expand them to its variants."""

import itertools
from collections.abc import Collection
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field

from nishiki.artifacts.closed import Closed
from nishiki.errors import UserError

SweepName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]*$")]
Axis = Literal["seconds", "cpu_seconds"]


class MeasureSettings(Closed):
    """One error measure: a figure of the evaluation."""

    path: str = Field(
        description="dotted path into the evaluation's diagnostics or evaluation.json; * stands for every key, of "
        "which the mean is taken; {stage.setting} for a setting of the variant"
    )
    label: str = Field("", description="name of the figure; empty: its path")
    unit: str = Field("", description="unit of the figure")
    better: Literal["lower", "higher"] = Field("lower", description="whether less or more of it is better")


class SweepSettings(Closed):
    """Which settings vary on which scenes, what is measured, and which variants stand out."""

    scenes: tuple[str, ...] = Field((), description="scenes of the scene table; none named: all")
    stage: str = Field(description="stage whose settings vary; keys without a stage's name belong to it")
    vary: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(
        {}, description="grid: setting (stage.setting, or a setting of `stage`) and its values; all combinations"
    )
    variants: dict[str, dict[str, Any]] = Field({}, description="variants by name, each with several settings")
    settings: dict[str, Any] = Field(
        {}, description="settings of all variants, as in a configuration, over those of the scenes"
    )
    default: str = Field("", description="variant that is the default; empty: the scene as it is configured")
    paper: str = Field("", description="variant that is the paper's method")
    peers: tuple[str, ...] = Field((), description="variants that are methods of others")
    apart: tuple[str, ...] = Field(
        (), description="variants that answer another question (other bytes, fewer products): shown, not compared"
    )
    repeats: int = Field(3, ge=1, le=100, description="timed runs of each variant, each alone on the machine")
    error: tuple[str | MeasureSettings, ...] = Field(
        (), description="error measures, the first one leads; none: the one usual for the stage and the kind of capture"
    )
    counted: tuple[str, ...] = Field(
        (), description="stages whose time counts; none: those that lead to the evaluation and are not equal everywhere"
    )
    axis: Axis = Field("seconds", description="time that is drawn and advised on; both are in the table")
    title: str = Field("", description="heading of the page; empty: the sweep's name")


AS_CONFIGURED = "as configured"


@dataclass(frozen=True)
class Variant:
    """One point of a sweep: its name, and its settings as blocks by stage, to be laid over the scene's."""

    name: str
    overrides: dict[str, Any]


def expand(sweep: SweepSettings, *, stages: Collection[str], where: str) -> list[Variant]:
    """All variants of a sweep: the scene as it is configured, the grid in the order of its keys, the named ones.

    stages: names of all stages, to tell `stage.setting` from a setting inside a setting. Raises UserError naming
    `where` and the key: no variants, a name used twice, or a role given to a variant that is not there.
    """
    if not sweep.vary and not sweep.variants:
        raise UserError(f"{where}: nothing to vary; give `vary` (setting: values) or `variants` (name: settings)")
    variants = [Variant(AS_CONFIGURED, {}), *_grid(sweep, stages)]
    variants += [
        Variant(name, nested(settings, sweep.stage, stages, f"{where}: variants.{name}"))
        for name, settings in sweep.variants.items()
    ]
    names = [variant.name for variant in variants]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"{where}: two variants are called {name!r}; rename the one under `variants`")
    roles = {"default": (sweep.default,) if sweep.default else (), "paper": (sweep.paper,) if sweep.paper else ()}
    for key, named in {**roles, "peers": sweep.peers, "apart": sweep.apart}.items():
        for name in named:
            if name not in names:
                raise UserError(f"{where}: {key} names no variant {name!r}; variants: {', '.join(names)}")
    return variants


def _grid(sweep: SweepSettings, stages: Collection[str]) -> list[Variant]:
    keys = list(sweep.vary)
    short = {key: key.removeprefix(f"{sweep.stage}.") for key in keys}
    return [
        Variant(
            ", ".join(f"{short[key]}={shown(value)}" for key, value in zip(keys, values, strict=True)),
            nested(dict(zip(keys, values, strict=True)), sweep.stage, stages, "vary"),
        )
        for values in itertools.product(*sweep.vary.values())
        if keys
    ]


def nested(settings: dict[str, Any], stage: str, stages: Collection[str], where: str) -> dict[str, Any]:
    """Turn dotted settings into blocks. Raises UserError where one key is given twice.

    {"normals.solver": "lobe"} and, of the stage normals, {"solver": "lobe"} become {"normals": {"solver": "lobe"}}, as
    does that itself.
    """
    result: dict[str, Any] = {}
    for key, value in settings.items():
        parts = key.split(".")
        block_of_stage = len(parts) == 1 and isinstance(value, dict)
        if parts[0] not in stages or (len(parts) == 1 and not block_of_stage):
            parts = [stage, *parts]
        elif block_of_stage:
            value = dict(value)
        block = result
        for part in parts[:-1]:
            block = block.setdefault(part, {})
            if not isinstance(block, dict):
                raise UserError(f"{where}: {key} lies inside a setting that has a value of its own")
        if parts[-1] in block:
            raise UserError(f"{where}: {key} is given twice")
        block[parts[-1]] = value
    return result


def shown(value: Any) -> str:
    """Format a setting's value for a variant's name."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "none"
    if isinstance(value, list | tuple):
        return "/".join(shown(item) for item in value)
    return str(value)
