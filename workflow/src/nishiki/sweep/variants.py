"""Declare the settings of a sweep, expand them to its variants, and summarise the timed repeats of each."""

import itertools
import math
import platform
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal

from pydantic import Field

from nishiki.artifacts.declaration import Closed
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
    """Varied settings and scenes, measures, and special variants."""

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
    """One point of a sweep: its name, and its settings as blocks by stage, which override the scene's."""

    name: str
    overrides: dict[str, Any]


def expand(sweep: SweepSettings, *, stages: Collection[str], where: str) -> list[Variant]:
    """List all variants of a sweep: the scene as configured, the grid in the order of its keys, the named ones.

    stages: names of all stages, to tell `stage.setting` from a setting inside a setting. Raises UserError naming
    `where` and the key: no variants, a name used twice, or a role given to a variant that is not there.
    """
    if not sweep.vary and not sweep.variants:
        raise UserError(f"{where}: nothing to vary; give `vary` (setting: values) or `variants` (name: settings)")
    variants = [Variant(AS_CONFIGURED, {}), *_grid(sweep, stages)]
    variants += [
        Variant(name, nest_settings(settings, sweep.stage, stages, f"{where}: variants.{name}"))
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
            ", ".join(f"{short[key]}={format_value(value)}" for key, value in zip(keys, values, strict=True)),
            nest_settings(dict(zip(keys, values, strict=True)), sweep.stage, stages, "vary"),
        )
        for values in itertools.product(*sweep.vary.values())
        if keys
    ]


def nest_settings(settings: dict[str, Any], stage: str, stages: Collection[str], where: str) -> dict[str, Any]:
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


def format_value(value: Any) -> str:
    """Format a setting's value for a variant's name."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "none"
    if isinstance(value, list | tuple):
        return "/".join(format_value(item) for item in value)
    return str(value)


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the model of the processor, as the system names it."""
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


NORMALS = MeasureSettings(path="normals_mean_deg", label="mean angular error of the normals", unit="°")
HEIGHT = MeasureSettings(path="height_rms_mm", label="rms error of the height", unit="mm")
SPECTRA = MeasureSettings(path="reflectance_rmse_mean", label="rms error of the spectral reflectance")
RELIGHTING = MeasureSettings(path="relighting_de00_mean", label="ΔE00 of lights that no fit saw")
LEFT_OUT = MeasureSettings(
    path="psnr.left_out_interpolated.mean_psnr_db", label="PSNR of views left out", unit="dB", better="higher"
)
CAPTURED = MeasureSettings(
    path="psnr.captured.mean_psnr_db", label="PSNR of the captured views", unit="dB", better="higher"
)
CLOTH = MeasureSettings(path="regions.*.rms_rel_default.*", label="relative rms error of measurements that no fit saw")
USUAL = {"plane": (NORMALS, RELIGHTING), "turntable": (LEFT_OUT, CAPTURED), "goniometer": (CLOTH,)}
USUAL_OF_STAGE = {"height": (HEIGHT, RELIGHTING), "spectra": (SPECTRA, RELIGHTING), "brdf": (RELIGHTING,)}
"""Measures in the order of preference: the first one in the evaluation is used."""


def candidates(stage: str, geometry: str) -> tuple[MeasureSettings, ...]:
    """List measures usual for a sweep of `stage` on captures of this geometry, in the order of preference."""
    return (*USUAL_OF_STAGE.get(stage, ()), *USUAL[geometry])


def as_measure(given: str | MeasureSettings) -> MeasureSettings:
    """Build a measure from its path alone: a usual one where the path matches."""
    if isinstance(given, MeasureSettings):
        return given
    known = (*USUAL_OF_STAGE.values(), *USUAL.values())
    return next((measure for group in known for measure in group if measure.path == given), MeasureSettings(path=given))


def values_of(
    measure: MeasureSettings, sources: list[dict[str, Any]], settings: dict[str, Any]
) -> dict[tuple[str, ...], float]:
    """Find all figures at the measure's path in the first of `sources` that holds it, by the keys for each *.

    settings : of the variant, by stage, for {stage.setting} in the path. Empty where no source has the path.
    """
    path = re.sub(r"\{([a-z_.]+)\}", lambda match: str(_at(settings, match[1].split("."))), measure.path)
    return next((values for source in sources if (values := _values(source, path.split(".")))), {})


def average_common(by_variant: dict[str, dict[tuple[str, ...], float]]) -> dict[str, float | None]:
    """Average each variant's figures over the keys common to all, so that all are judged on the same.

    by_variant : figures, as `values_of` gives them. None for a variant that has none, or none in common.
    """
    holders = [set(values) for values in by_variant.values() if values]
    common = sorted(set.intersection(*holders)) if holders else []
    return {
        name: math.fsum(values[key] for key in common) / len(common) if values and common else None
        for name, values in by_variant.items()
    }


def _at(block: Any, parts: list[str]) -> Any:
    for part in parts:
        if not isinstance(block, dict) or part not in block:
            raise UserError(f"an error measure names the setting {'.'.join(parts)}, which the variant does not have")
        block = block[part]
    return block


def _values(block: Any, parts: list[str], stars: tuple[str, ...] = ()) -> dict[tuple[str, ...], float]:
    """Find all finite numbers at a path, by the keys for its *; {} where it leads nowhere or to no number."""
    if not parts:
        number = isinstance(block, int | float) and not isinstance(block, bool) and math.isfinite(block)
        return {stars: float(block)} if number else {}
    if isinstance(block, list):
        block = {str(k): item for k, item in enumerate(block)}
    if not isinstance(block, dict):
        return {}
    if parts[0] != "*":
        return _values(block[parts[0]], parts[1:], stars) if parts[0] in block else {}
    parts_below = [_values(item, parts[1:], (*stars, str(key))) for key, item in block.items()]
    return {key: value for values in parts_below for key, value in values.items()}


def paths_in(block: Any, prefix: str = "") -> list[str]:
    """List all dotted paths of numbers in nested dictionaries, for messages."""
    if isinstance(block, dict):
        return [
            path for key, item in block.items() for path in paths_in(item, f"{prefix}.{key}" if prefix else str(key))
        ]
    return [prefix] if isinstance(block, int | float) and not isinstance(block, bool) else []


TIMES = ("seconds", "cpu_seconds")


@dataclass(frozen=True)
class Spread:
    """Median of the repeats, and the least and the greatest of them."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Summarise some values; 0 where there are none."""
        if not values:
            return cls(0.0, 0.0, 0.0)
        return cls(round(median(values), 4), round(min(values), 4), round(max(values), 4))


@dataclass(frozen=True)
class VariantRow:
    """Results of one variant of one scene."""

    name: str
    names: tuple[str, ...]
    changes: tuple[str, ...]
    errors: tuple[float, ...]  # one for each measure
    times: dict[str, Spread]  # seconds and cpu_seconds summed over the counted stages for each repeat
    stages: dict[str, dict[str, Spread]]  # the same stage by stage
    peak_memory_mib: float
    bytes: int  # of the artifacts of the counted stages
    repeats: int
    reproducible: bool
    different: tuple[str, ...]
    keys: dict[str, str]
    machines: tuple[str, ...]
    load: float
    default: bool = False
    paper: bool = False
    peer: bool = False
    apart: bool = False
    ahead: tuple[bool, ...] = field(default=())


def variant_row(
    name: str,
    names: Sequence[str],
    changes: Sequence[str],
    errors: Sequence[float],
    records: dict[str, list[dict[str, Any]]],
    *,
    keys: dict[str, str],
) -> VariantRow:
    """Summarise one variant. records: by counted stage, one a repeat."""
    numbers = range(min((len(runs) for runs in records.values()), default=0))
    everything = [record for runs in records.values() for record in runs]
    different = {f"{record['stage']}: {name}" for record in everything for name in record["different"]}
    return VariantRow(
        name=name,
        names=tuple(names),
        changes=tuple(changes),
        errors=tuple(errors),
        times={time: Spread.of([sum(runs[k][time] for runs in records.values()) for k in numbers]) for time in TIMES},
        stages={
            stage: {time: Spread.of([record[time] for record in runs]) for time in TIMES}
            for stage, runs in records.items()
        },
        peak_memory_mib=max(
            (median(record["peak_memory_mib"] for record in runs) for runs in records.values()), default=0.0
        ),
        bytes=sum(runs[0]["bytes"] for runs in records.values()),
        repeats=len(numbers),
        reproducible=all(record["same"] for record in everything),
        different=tuple(sorted(different)),
        keys=dict(keys),
        machines=tuple(sorted({f"{r['processor']}, {r['cpus']} cores, Python {r['python']}" for r in everything})),
        load=max((record["load_before"] for record in everything), default=0.0),
    )
