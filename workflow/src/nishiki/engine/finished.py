"""List finished scenes and their figures, and set aside artifacts that a run must not build on.

A scene is finished where each stage of its plan has an artifact under its key that is whole, was made by the present
code with the present libraries and from the upstream artifacts that stand there, and where the publication names
exactly these artifacts. Settings, products, truth and capture decide the keys.

Nothing is deleted: a folder that is set aside keeps its files under `<key>.set-aside-<digest>`, for whoever wants to
know what happened; `./nishiki prune` lists it.
"""

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from nishiki.artifacts.artifact import INDEX, MANIFEST, open_artifact
from nishiki.artifacts.provenance import differences, file_digest, library_version
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError


def unfinished_scenes(flow: Workflow, *, contents: bool = False) -> dict[str, str]:
    """List the scenes that a run has to make, in the order of the table, each with the first reason.

    contents: look at the files of artifacts more closely than at their sizes (see `open_artifact`).
    """
    reasons = ((scene, reason_to_run(flow, scene, contents=contents)) for scene in flow.plans)
    return {scene: reason for scene, reason in reasons if reason}


def reason_to_run(flow: Workflow, scene: str, *, contents: bool = False) -> str:
    """Return the first reason why a scene is not finished; empty where it is."""
    plan = flow.plans[scene]
    for field in plan.scene.fields:
        if reason := reason_to_run(flow, field.name, contents=contents):
            return f"{field.name}: {reason}"
    published: dict[str, dict[str, str]] = {}
    for name, planned in plan.stages.items():
        digests: dict[str, str | None] = {other: entry["digest"] for other, entry in published.items()}
        digest, reasons = reasons_of_stage(flow, scene, name, digests, contents=contents)
        if reasons:
            return f"{name}: {reasons[0]}"
        published[name] = {"key": planned.key, "digest": digest}
    code = flow.code("publish")
    try:
        with open(f"{flow.results}/{scene}/current/{INDEX}", "rb") as handle:
            index = json.load(handle)
        return "" if index["artifacts"] == published and index["code"] == code else "not published"
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return "not published"


def reasons_of_stage(
    flow: Workflow, scene: str, name: str, digests: Mapping[str, str | None], *, contents: bool = False
) -> tuple[str, list[str]]:
    """Return the digest of a stage's artifact and why it cannot stay, without any reason where it can.

    digests: of the artifacts that it reads, by their names, where they are known; None: not compared. contents: see
    `open_artifact`.
    """
    planned = flow.plans[scene].stages[name]
    try:
        artifact = open_artifact(Path(f"{flow.results}/{scene}/{name}/{planned.key}"), contents=contents)
    except UserError as error:
        return "", [str(error)]
    manifest = artifact.manifest
    if (manifest["stage"], manifest["key"]) != (name, planned.key):
        return "", [f"{artifact.folder}: holds {manifest['stage']} {manifest['key']}"]
    code, made_by = flow.code(name), manifest.get("code")
    reasons = [] if made_by == code else [f"its code changed: {made_by or '(none)'} -> {code}"]
    changes = differences(manifest.get("libraries", {}), _versions(planned.packages))
    reasons += [f"library {text}" for text in changes]
    for other, path in flow.above(scene, planned).items():
        present = digests[other] if other in digests else file_digest(Path(path))
        if present is not None and manifest["upstream"].get(other, {}).get("digest") != present:
            reasons.append(f"{other} was made again since, with another result")
    return artifact.sha256, reasons


@cache
def _versions(packages: tuple[str, ...]) -> dict[str, str]:
    return {name: library_version(name) for name in packages}


ASIDE = ".set-aside-"


@dataclass(frozen=True)
class Unsound:
    """An artifact folder that must not be built on, and why."""

    folder: Path
    why: str

    def __str__(self) -> str:
        return f"{self.folder}: {self.why}"


def unsound_artifacts(plans: Iterable[tuple[Path, Mapping[str, Path]]], *, contents: bool = False) -> list[Unsound]:
    """Find torn and stale artifacts of some scenes, in the order of the flow.

    plans: stages in the order of the flow, each its folder, and the folders of what it reads by their names.
    Torn: files missing or of the wrong size, or no readable manifest. Stale: an upstream artifact that stands there is
    not the one that it was made from. Sizes are looked at; contents: what a stage checks of its inputs too, as after a
    power cut; `./nishiki verify` reads everything.
    """
    unsound = []
    sound: dict[Path, str] = {}
    for folder, upstream in plans:
        if not folder.exists() or not any(folder.iterdir()):  # Snakemake makes the folder before the stage starts
            continue
        try:
            artifact = open_artifact(folder, contents=contents)
        except UserError as error:
            unsound.append(Unsound(folder, str(error).removeprefix(f"{folder}: ")))
            continue
        made_from = {other: part.get("digest") for other, part in artifact.manifest["upstream"].items()}
        stale = [name for name, other in upstream.items() if other in sound and made_from.get(name) != sound[other]]
        if stale:
            unsound.append(Unsound(folder, f"made from another version of {stale[0]} than the present one"))
        else:
            sound[folder] = file_digest(folder / MANIFEST)
    return unsound


def set_aside(folder: Path) -> Path:
    """Rename an artifact folder out of the way; the new path. The manifest's digest names it, `torn` without one."""
    manifest = folder / MANIFEST
    digest = file_digest(manifest)[:8] if manifest.is_file() else "torn"
    target = folder.with_name(f"{folder.name}{ASIDE}{digest}")
    number = 1
    while target.exists():
        number += 1
        target = folder.with_name(f"{folder.name}{ASIDE}{digest}-{number}")
    os.rename(folder, target)
    return target


def set_aside_unsound(
    plans: Sequence[tuple[Path, Mapping[str, Path]]], tell: Callable[[str], None], *, contents: bool = False
) -> list[Unsound]:
    """Set every torn or stale artifact aside and tell each; what was found. plans: see `unsound_artifacts`."""
    unsound = list({item.folder: item for item in unsound_artifacts(plans, contents=contents)}.values())
    for item in unsound:
        target = set_aside(item.folder)
        tell(f"set aside and made again: {item}; kept as {target.name}")
    put_dates_right(plans)
    return unsound


def put_dates_right(plans: Iterable[tuple[Path, Mapping[str, Path]]]) -> None:
    """Date manifests neither after now nor before those of their upstream artifacts.

    Digests have said what is sound. Dates mean nothing then, but Snakemake goes by them: where a clock was set back it
    would make finished artifacts again, and fail every job that has an input from the future.
    """
    now = time.time_ns()
    dates: dict[Path, int] = {}
    for folder, upstream in plans:
        manifest = folder / MANIFEST
        if not manifest.is_file():
            continue
        modified = manifest.stat().st_mtime_ns
        date = max([min(modified, now), *(dates[other] for other in upstream.values() if other in dates)])
        dates[folder] = date
        if date != modified:
            with contextlib.suppress(OSError):  # results that cannot be written: the run tells of that itself
                os.utime(manifest, ns=(date, date))


Value = str | float | bool | None
DEEPEST = 4  # blocks inside blocks: figures below are lists of a scene's own lights, views or regions


def campaign_rows(flow: Workflow) -> Iterator[dict[str, Value]]:
    """Yield a row for each scene of the configuration: scene, capture, geometry, `finished`, and STAGE.FIGURE columns.

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
    """Yield the numbers and words of nested blocks by their dotted names.

    Whole numbers become floats, so that a column has one type.
    """
    for key, value in block.items():
        dotted = f"{name}.{key}"
        if isinstance(value, Mapping) and depth < DEEPEST:
            yield from figures(value, dotted, depth + 1)
        elif isinstance(value, bool | str):
            yield dotted, value
        elif isinstance(value, int | float):
            yield dotted, float(value)


def columns_of(rows: Iterable[Mapping[str, Value]]) -> dict[str, list[Value]]:
    """Turn rows into columns in the order of their first appearance; None where a scene lacks the figure.

    A column in which words and numbers meet is one of words.
    """
    rows = list(rows)
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [row.get(name) for row in rows] for name in names}
    for name, values in columns.items():
        if len({type(value) for value in values if value is not None}) > 1:
            columns[name] = [None if value is None else str(value) for value in values]
    return columns
