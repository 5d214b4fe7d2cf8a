"""From the records of timed repeats to one row a variant."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

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
    """One variant of one scene. errors: one for each measure; times: seconds and cpu_seconds of all counted stages,
    the repeats added up one by one; stages: the same stage by stage; bytes: of the artifacts of the counted stages."""

    name: str
    names: tuple[str, ...]
    changes: tuple[str, ...]
    errors: tuple[float, ...]
    times: dict[str, Spread]
    stages: dict[str, dict[str, Spread]]
    peak_memory_mib: float
    bytes: int
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

    def as_dict(self) -> dict[str, Any]:
        """The row as plain data."""
        return asdict(self)


def variant_row(
    name: str,
    names: Sequence[str],
    changes: Sequence[str],
    errors: Sequence[float],
    records: dict[str, list[dict[str, Any]]],
    *,
    keys: dict[str, str],
    default: bool,
    paper: bool,
    peer: bool,
    apart: bool = False,
) -> VariantRow:
    """Row of one variant. records : by counted stage, one for each repeat; the same number for every stage."""
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
        machines=tuple(sorted({machine_of(record) for record in everything})),
        load=max((record["load_before"] for record in everything), default=0.0),
        default=default,
        paper=paper,
        peer=peer,
        apart=apart,
    )


def machine_of(record: dict[str, Any]) -> str:
    """One line about the machine of a repeat."""
    return f"{record['processor']}, {record['cpus']} cores, Python {record['python']}"
