"""What the page of a sweep tells: points, fronts, drawings, advice and tables, as plain data."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from nishiki.sweep.advice import advice
from nishiki.sweep.front import Point, front
from nishiki.sweep.plot import AXES, Mark, plot
from nishiki.sweep.settings import MeasureSettings, SweepSettings
from nishiki.sweep.summary import VariantRow

AXIS_NAMES = {"seconds": "time", "cpu_seconds": "CPU time"}
BUSY = 1.0
"""Load before a repeat from which the machine counts as in use by others, in processes waiting or running."""


def scene_content(
    scene: str,
    rows: list[VariantRow],
    measures: list[MeasureSettings],
    *,
    axis: str,
    counted: Sequence[str],
    evaluation: str,
) -> dict[str, Any]:
    """Everything about one scene of a sweep. rows : all variants, errors in the order of `measures`."""
    fronts = [_front(rows, points_of(rows, k, measure, axis)) for k, measure in enumerate(measures)]
    rows = [replace(row, ahead=tuple(number in indices for indices in fronts)) for number, row in enumerate(rows)]
    return {
        "scene": scene,
        "counted": list(counted),
        "evaluation": evaluation,
        "axis": axis,
        "measures": [labelled(measure) for measure in measures],
        "machines": sorted({machine for row in rows for machine in row.machines}),
        "load": max((row.load for row in rows), default=0.0),
        "busy": any(row.load >= BUSY for row in rows),
        "rows": [row.as_dict() for row in rows],
        "plots": [_plot(scene, rows, k, measure, axis, fronts[k]) for k, measure in enumerate(measures)],
        "advice": [_advice(rows, k, measure, axis) for k, measure in enumerate(measures)],
    }


def labelled(measure: MeasureSettings) -> dict[str, str]:
    """A measure for the page."""
    return {**measure.model_dump(mode="json"), "label": measure.label or measure.path}


def points_of(rows: Sequence[VariantRow], number: int, measure: MeasureSettings, axis: str) -> list[Point]:
    """Points in the plane of time and loss; the loss is the figure, or its negative where more is better."""
    sign = -1.0 if measure.better == "higher" else 1.0
    return [
        Point(row.name, row.times[axis].median, row.times[axis].low, row.times[axis].high, sign * row.errors[number])
        for row in rows
    ]


def _front(rows: Sequence[VariantRow], points: Sequence[Point]) -> list[int]:
    """Indices of the rows on the front; those apart are not compared."""
    compared = [k for k, row in enumerate(rows) if not row.apart]
    return [compared[k] for k in front([points[k] for k in compared])]


def _plot(scene, rows: list[VariantRow], number: int, measure: MeasureSettings, axis: str, best: list[int]) -> dict:
    marks = [
        Mark(
            row.name,
            row.times[axis].median,
            row.times[axis].low,
            row.times[axis].high,
            row.errors[number],
            kind=_kind(row),
            tip=_tip(row, number, measure),
        )
        for row in rows
    ]
    entry = labelled(measure)
    label = entry["label"] + (f", {measure.unit}" if measure.unit else "")
    svg = plot(
        marks,
        best,
        x_label=AXES[axis],
        y_label=label,
        higher=measure.better == "higher",
        title=f"{entry['label']} against {AXIS_NAMES[axis]}, {scene}",
    )
    return {"file": f"{scene}.svg" if number == 0 else f"{scene}-{number + 1}.svg", "svg": svg}


def _kind(row: VariantRow) -> str:
    entry = {"default": row.default, "paper": row.paper, "peer": row.peer, "apart": row.apart}
    return next((kind for kind, meant in entry.items() if meant), "")


def _tip(row: VariantRow, number: int, measure: MeasureSettings) -> str:
    time, cpu = row.times["seconds"], row.times["cpu_seconds"]
    return (
        f"{row.name}: {row.errors[number]:.4g} {measure.unit}; {time.median:.3g} s "
        f"({time.low:.3g} to {time.high:.3g}), CPU {cpu.median:.3g} s; {row.peak_memory_mib:.0f} MiB; "
        f"{row.bytes / 1e6:.3g} MB"
    )


def _advice(rows: list[VariantRow], number: int, measure: MeasureSettings, axis: str) -> list[str]:
    points = points_of(rows, number, measure, axis)
    default = next(point for point, row in zip(points, rows, strict=True) if row.default)
    paper = next((point for point, row in zip(points, rows, strict=True) if row.paper), None)
    higher = measure.better == "higher"
    points = [point for point, row in zip(points, rows, strict=True) if not row.apart]
    return advice(points, default, paper=paper, unit=measure.unit, higher=higher, axis=AXIS_NAMES[axis])


def sweep_content(name: str, title: str, version: str, settings: SweepSettings, scenes: list[dict]) -> dict[str, Any]:
    """The whole page."""
    return {
        "name": name,
        "title": title,
        "version": version,
        "repeats": settings.repeats,
        "settings": settings.model_dump(mode="json"),
        "scenes": scenes,
    }


def table_rows(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The flat table: a row for each variant of each scene."""
    return [_flat(scene, row) for scene in content["scenes"] for row in scene["rows"]]


def _flat(scene: dict[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    errors = {measure["path"]: value for measure, value in zip(scene["measures"], row["errors"], strict=True)}
    ahead = {f"front {measure['path']}": on for measure, on in zip(scene["measures"], row["ahead"], strict=True)}
    times = {
        f"{time}_{which}": row["times"][time][which] for time in row["times"] for which in ("median", "low", "high")
    }
    return {
        "scene": scene["scene"],
        "variant": row["name"],
        **errors,
        **times,
        "peak_memory_mib": row["peak_memory_mib"],
        "bytes": row["bytes"],
        "repeats": row["repeats"],
        "reproducible": row["reproducible"],
        "default": row["default"],
        "paper": row["paper"],
        "peer": row["peer"],
        "apart": row["apart"],
        **ahead,
        "counted": " ".join(scene["counted"]),
        "changes": "; ".join(row["changes"]),
    }
