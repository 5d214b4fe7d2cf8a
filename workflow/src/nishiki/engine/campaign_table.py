"""A campaign as one table: a row a scene, a column a figure of its finished stages."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from nishiki.artifacts.artifact import MANIFEST
from nishiki.artifacts.publish import INDEX
from nishiki.engine.workflow import Workflow

Value = str | float | bool | None
DEEPEST = 4  # blocks inside blocks: figures below are lists of a scene's own lights, views or regions


def campaign_rows(flow: Workflow) -> Iterator[dict[str, Value]]:
    """One row a scene of the configuration: scene, capture, geometry, `finished`, and STAGE.FIGURE columns.

    Figures are numbers, truth values and words of the diagnostics of the stages that are published; lists are left out.
    """
    for name, plan in flow.plans.items():
        row: dict[str, Value] = {
            "scene": name,
            "capture": str(plan.scene.capture),
            "geometry": plan.facts.geometry,
            "lights": float(len(plan.facts.lights)),
            "views": float(len(plan.facts.views)),
            "pixels": float(plan.facts.pixels),
        }
        current = Path(flow.results, name, "current")
        row["finished"] = (current / INDEX).is_file()
        for stage in plan.stages:
            manifest = current / stage / MANIFEST
            if row["finished"] and manifest.is_file():
                content = json.loads(manifest.read_text(encoding="utf-8"))
                row[f"{stage}.key"] = content["key"]
                row |= dict(figures(content["diagnostics"], stage))
        yield row


def figures(block: Mapping[str, Any], name: str, depth: int = 1) -> Iterator[tuple[str, Value]]:
    """Numbers and words of nested blocks by their dotted names; whole numbers as floats, so that a column has one
    type."""
    for key, value in block.items():
        dotted = f"{name}.{key}"
        if isinstance(value, Mapping) and depth < DEEPEST:
            yield from figures(value, dotted, depth + 1)
        elif isinstance(value, bool | str):
            yield dotted, value
        elif isinstance(value, int | float):
            yield dotted, float(value)


def columns_of(rows: Iterable[Mapping[str, Value]]) -> dict[str, list[Value]]:
    """The rows as columns in the order of their first appearance; None where a scene has no such figure.

    A column in which words and numbers meet is one of words.
    """
    rows = list(rows)
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [row.get(name) for row in rows] for name in names}
    for name, values in columns.items():
        if len({type(value) for value in values if value is not None}) > 1:
            columns[name] = [None if value is None else str(value) for value in values]
    return columns
