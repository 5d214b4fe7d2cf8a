"""Write the page of a sweep: points, fronts, drawings, advice and tables."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from markupsafe import Markup

from nishiki.report.page import Block, Facts, Figure, Figures, Note, Page, PageSection, Table, render_page
from nishiki.report.svg import figure
from nishiki.sweep.front import AXES, VariantPoint, advice, front, plot
from nishiki.sweep.variants import MeasureSettings, SweepSettings, VariantRow

AXIS_NAMES = {"seconds": "time", "cpu_seconds": "CPU time"}
KINDS = {"default": "default", "paper": "paper", "peer": "of others", "apart": "not compared"}
"""Roles of variants, the first of which determines a sign in the drawing, and their names in the table."""
BUSY = 1.0
"""Load before a repeat, in processes waiting or running, from which others count as using the machine."""


def scene_content(
    scene: str,
    rows: list[VariantRow],
    measures: list[MeasureSettings],
    *,
    axis: str,
    counted: Sequence[str],
    evaluation: str,
) -> dict[str, Any]:
    """Build all data of one scene of a sweep. rows : all variants, errors in the order of `measures`."""
    compared = [k for k, row in enumerate(rows) if not row.apart]
    fronts = []
    for number, measure in enumerate(measures):
        points = points_of(rows, number, measure, axis)
        fronts.append([compared[k] for k in front([points[k] for k in compared])])
    rows = [replace(row, ahead=tuple(number in indices for indices in fronts)) for number, row in enumerate(rows)]
    return {
        "scene": scene,
        "counted": list(counted),
        "evaluation": evaluation,
        "axis": axis,
        "measures": [label_measure(measure) for measure in measures],
        "machines": sorted({machine for row in rows for machine in row.machines}),
        "load": max((row.load for row in rows), default=0.0),
        "busy": any(row.load >= BUSY for row in rows),
        "rows": [asdict(row) for row in rows],
        "plots": [_plot(scene, rows, k, measure, axis, fronts[k]) for k, measure in enumerate(measures)],
        "advice": [_advice(rows, k, measure, axis) for k, measure in enumerate(measures)],
    }


def label_measure(measure: MeasureSettings) -> dict[str, str]:
    """Describe a measure for the page."""
    return {**measure.model_dump(mode="json"), "label": measure.label or measure.path}


def points_of(rows: Sequence[VariantRow], number: int, measure: MeasureSettings, axis: str) -> list[VariantPoint]:
    """Make points in the plane of time and loss; the loss is the figure, or its negative where more is better."""
    sign = -1.0 if measure.better == "higher" else 1.0
    return [
        VariantPoint(
            row.name,
            row.times[axis].median,
            row.times[axis].low,
            row.times[axis].high,
            sign * row.errors[number],
            row.errors[number],
            next((kind for kind in KINDS if getattr(row, kind)), ""),
            _tip(row, number, measure),
        )
        for row in rows
    ]


def _plot(scene, rows: list[VariantRow], number: int, measure: MeasureSettings, axis: str, best: list[int]) -> dict:
    entry = label_measure(measure)
    label = entry["label"] + (f", {measure.unit}" if measure.unit else "")
    svg = plot(
        points_of(rows, number, measure, axis),
        best,
        x_label=AXES[axis],
        y_label=label,
        higher=measure.better == "higher",
        title=f"{entry['label']} against {AXIS_NAMES[axis]}, {scene}",
    )
    return {"file": f"{scene}.svg" if number == 0 else f"{scene}-{number + 1}.svg", "svg": svg}


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
    """Build the content of the whole page."""
    return {
        "name": name,
        "title": title,
        "version": version,
        "repeats": settings.repeats,
        "settings": settings.model_dump(mode="json"),
        "scenes": scenes,
    }


def table_rows(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Build the flat table: a row for each variant of each scene."""
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
        **{key: row[key] for key in ("peak_memory_mib", "bytes", "repeats", "reproducible", *KINDS)},
        **ahead,
        "counted": " ".join(scene["counted"]),
        "changes": "; ".join(row["changes"]),
    }


HOW = (
    "Every variant is a plan of its own; artifacts that two variants have in common are made once. Each repeat runs "
    "the stage once more on the same inputs, alone on the machine and into a folder that is thrown away, and its "
    "artifact is compared with the first one byte by byte. Time is that of the stage, without the start of Python; CPU "
    "time is that of all its threads. The time of a variant is that of the stages counted, added up repeat by repeat; "
    "stages that all variants share are not counted, the evaluation neither."
)


def render_sweep(content: dict[str, Any]) -> str:
    """Render the page as HTML. content : from `content.sweep_content`."""
    scenes = content["scenes"]
    counted = []
    for scene in scenes:
        stages, machines = ", ".join(scene["counted"]), "; ".join(scene["machines"])
        counted.append((scene["scene"], f"counted: {stages}; figures from {scene['evaluation']}; {machines}"))
    drawings = " ".join(plot["file"] for scene in scenes for plot in scene["plots"])
    files = f"The same figures as a table: sweep.csv; everything: sweep.json; the drawings: {drawings}"
    return render_page(
        Page(
            title=content["title"],
            subtitle=f"Error against run time: settings of the stage {content['settings']['stage']}.",
            sections=[
                *(PageSection(scene["scene"], scene["scene"], scene_blocks(scene)) for scene in scenes),
                PageSection("how", "How it was measured", [HOW, Facts(counted), files]),
            ],
            version=content["version"],
            footer=f"Nishiki {content['version']}, sweep {content['name']}.",
        )
    )


def scene_blocks(scene: dict[str, Any]) -> list[Block]:
    """Build drawings, advice and tables of one scene."""
    blocks: list[Block] = []
    axis = AXIS_NAMES[scene["axis"]]
    for measure, drawing, hint in zip(scene["measures"], scene["plots"], scene["advice"], strict=True):
        caption = (
            f"Against the {axis} of {' + '.join(scene['counted'])}. Median of {scene['rows'][0]['repeats']} repeats; "
            "the whiskers reach to the fastest and the slowest. Lower left is better; a variant right of and above the "
            "dashed line is beaten by one on it."
        )
        blocks += [Figures([Figure(measure["label"], caption, svg=drawing["svg"])], 1), Note(hint, listed=True)]
    if scene["busy"]:
        load = figure(scene["load"], 2)
        text = (
            f"Measured on a machine in use: the load before a repeat reached {load}. Times of the clock are then too "
        )
        blocks.append(Note([text + "long; CPU times are less affected."], warning=True))
    blocks.append(table_of_variants(scene))
    if len(scene["counted"]) > 1:
        rows = [
            [
                row["name"],
                *(row["stages"].get(stage, {}).get("cpu_seconds", {}).get("median") for stage in scene["counted"]),
            ]
            for row in scene["rows"]
        ]
        align = "l" + "r" * len(scene["counted"])
        blocks.append(Table(("variant", *scene["counted"]), rows, align, "CPU seconds stage by stage, median."))
    for row in scene["rows"]:
        if not row["reproducible"]:
            text = f"{row['name']}: a repeat gave other bytes than the first run: {', '.join(row['different'])}."
            blocks.append(Note([text], warning=True))
    return blocks


def table_of_variants(scene: dict[str, Any]) -> Table:
    """Tabulate all variants with their figures, times, memory and bytes."""
    rows = []
    for row in scene["rows"]:
        times = []
        for time in ("seconds", "cpu_seconds"):
            spread = row["times"][time]
            times += [spread["median"], f"{figure(spread['low'])} … {figure(spread['high'])}"]
        name = row["name"] + "".join(f" ({meaning})" for kind, meaning in KINDS.items() if row[kind])
        others = [other for other in row["names"] if other != row["name"]]
        changes = "; ".join(row["changes"]) + (f" (same as {', '.join(others)})" if others else "")
        rows.append(
            [
                name if row["reproducible"] else Markup("{} <b>not reproducible</b>").format(name),
                "yes" if row["ahead"][0] else "",
                *(figure(value, 4) for value in row["errors"]),
                *times,
                row["peak_memory_mib"],
                row["bytes"] / 1e6,
                changes,
            ]
        )
    measures = [measure["label"] + (f", {measure['unit']}" if measure["unit"] else "") for measure in scene["measures"]]
    return Table(
        ["variant", "front", *measures, "time, s", "from to", "CPU, s", "from to", "memory, MiB", "MB",
         "differs from the default in"],
        rows,
        "ll" + "r" * (len(measures) + 6) + "w",
        "All variants. Front: whether it is on the front of the first figure. Tinted: the default. Memory: peak of the "
        "stages counted; MB: of their artifacts.",
        marked={number for number, row in enumerate(scene["rows"]) if row["default"]},
    )  # fmt: skip
