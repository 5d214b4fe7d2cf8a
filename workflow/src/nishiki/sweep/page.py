"""The page of a sweep, in the look of the reports."""

from typing import Any

from markupsafe import Markup

from nishiki.report.numbers import figure
from nishiki.report.page import Block, Facts, Figure, Figures, Note, Page, Section, Table, render_page

HOW = (
    "Every variant is a plan of its own; artifacts that two variants have in common are made once. Each repeat runs "
    "the stage once more on the same inputs, alone on the machine and into a folder that is thrown away, and its "
    "artifact is compared with the first one byte by byte. Time is that of the stage, without the start of Python; CPU "
    "time is that of all its threads. The time of a variant is that of the stages counted, added up repeat by repeat; "
    "stages that all variants share are not counted, the evaluation neither."
)


def render_sweep(content: dict[str, Any]) -> str:
    """HTML of the page. content : as `content.sweep_content` makes it."""
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
                *(Section(scene["scene"], scene["scene"], scene_blocks(scene)) for scene in scenes),
                Section("how", "How it was measured", [HOW, Facts(counted), files]),
            ],
            version=content["version"],
            footer=f"Nishiki {content['version']}, sweep {content['name']}.",
        )
    )


def scene_blocks(scene: dict[str, Any]) -> list[Block]:
    """Drawings, advice and tables of one scene."""
    blocks: list[Block] = []
    axis = "CPU time" if scene["axis"] == "cpu_seconds" else "time"
    for measure, plot, advice in zip(scene["measures"], scene["plots"], scene["advice"], strict=True):
        caption = (
            f"Against the {axis} of {' + '.join(scene['counted'])}. Median of {scene['rows'][0]['repeats']} repeats; "
            "the whiskers reach to the fastest and the slowest. Lower left is better; a variant right of and above the "
            "dashed line is beaten by one on it."
        )
        blocks += [Figures([Figure(measure["label"], caption, svg=plot["svg"])], 1), Note(advice, listed=True)]
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
    """All variants with their figures, times, memory and bytes."""
    rows = []
    for row in scene["rows"]:
        times = []
        for time in ("seconds", "cpu_seconds"):
            spread = row["times"][time]
            times += [spread["median"], f"{figure(spread['low'])} … {figure(spread['high'])}"]
        others = [name for name in row["names"] if name != row["name"]]
        changes = "; ".join(row["changes"]) + (f" (same as {', '.join(others)})" if others else "")
        rows.append(
            [
                variant_name(row),
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


def variant_name(row: dict[str, Any]) -> str:
    """A variant's name, what it is, and whether its bytes were the same in every repeat."""
    roles = {"default": "default", "paper": "paper", "peer": "of others", "apart": "not compared"}
    name = row["name"] + "".join(f" ({meaning})" for role, meaning in roles.items() if row[role])
    return name if row["reproducible"] else Markup("{} <b>not reproducible</b>").format(name)
