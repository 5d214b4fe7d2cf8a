"""Summarise timed repeats: error measures, medians and spread, one row a variant."""

import math
import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from nishiki.errors import UserError
from nishiki.sweep.settings import MeasureSettings


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Model of the processor, as the system names it."""
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
"""Measures in the order of preference: the first one that the evaluation holds is taken."""


def candidates(stage: str, geometry: str) -> tuple[MeasureSettings, ...]:
    """Measures usual for a sweep of `stage` on captures of this geometry, in the order of preference."""
    return (*USUAL_OF_STAGE.get(stage, ()), *USUAL[geometry])


def as_measure(given: str | MeasureSettings) -> MeasureSettings:
    """Build a measure from its path alone: one of the usual ones where the path is theirs."""
    if isinstance(given, MeasureSettings):
        return given
    known = (*USUAL_OF_STAGE.values(), *USUAL.values())
    return next((measure for group in known for measure in group if measure.path == given), MeasureSettings(path=given))


def values_of(
    measure: MeasureSettings, sources: list[dict[str, Any]], settings: dict[str, Any]
) -> dict[tuple[str, ...], float]:
    """All figures at the measure's path in the first of `sources` that holds it, by what each * stands for.

    settings : of the variant, by stage, for {stage.setting} in the path. Empty where no source has the path.
    """
    path = re.sub(r"\{([a-z_.]+)\}", lambda match: str(_at(settings, match[1].split("."))), measure.path)
    return next((values for source in sources if (values := _values(source, path.split(".")))), {})


def compared(by_variant: dict[str, dict[tuple[str, ...], float]]) -> dict[str, float | None]:
    """One figure for each variant: the mean over what all variants have, so that all are judged on the same.

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
    """All finite numbers at a path, by the keys that its * stood for; {} where it leads nowhere or to no number."""
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
    """All dotted paths of numbers in nested dictionaries, for messages."""
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
        """Spread of some values; 0 where there are none."""
        if not values:
            return cls(0.0, 0.0, 0.0)
        return cls(round(median(values), 4), round(min(values), 4), round(max(values), 4))


@dataclass(frozen=True)
class VariantRow:
    """Hold one variant of one scene."""

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
