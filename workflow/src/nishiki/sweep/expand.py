"""From the block of a sweep to its variants: the grid of all combinations, and the named ones."""

import itertools
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from nishiki.errors import UserError
from nishiki.sweep.settings import SweepSettings

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
    """Dotted settings as blocks: {"normals.solver": "lobe"} and, of the stage normals, {"solver": "lobe"} become
    {"normals": {"solver": "lobe"}}, as does that itself. Raises UserError where one key is given twice."""
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
    """A setting's value in a variant's name."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "none"
    if isinstance(value, list | tuple):
        return "/".join(shown(item) for item in value)
    return str(value)
