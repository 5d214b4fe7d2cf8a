"""The command plan: what will run, what will be read and loaded, what is left out and why."""

import argparse
import json
from typing import Any

from nishiki.capture.folder import load_capture
from nishiki.commands.inspecting import stage_state
from nishiki.engine.plan import Plan
from nishiki.engine.project import load_yaml
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError
from nishiki.observations.capture_usage import usage_of
from nishiki.packages import EXTRAS, PURPOSE, install_command, installed
from nishiki.stages.base import SceneFacts
from nishiki.stages.table import CHAIN


def plan(options: argparse.Namespace, rest: list[str]) -> None:
    """Print, per scene, stages with their costs, what is read of the capture, packages, and what is left out and why.

    With --json one JSON object a scene and line.
    """
    flow = Workflow(load_yaml(options.configfile), only=options.scene, file=options.configfile)
    for name in flow.plans:
        summary = scene_plan(flow, name)
        print(json.dumps(summary, sort_keys=True) if options.json else text_of(summary))


def scene_plan(flow: Workflow, name: str) -> dict[str, Any]:
    """Everything that the plan of a scene says, as plain values."""
    made = flow.plans[name]
    ingest = made.stages["ingest"].settings
    parts = {key: ingest[key] for key in ("without", "channels", "tile_mib", "white_block")}
    reading = usage_of(load_capture(made.scene.capture), **parts)
    loaded = tuple(dict.fromkeys(p for names in made.packages.values() for p in names if p in EXTRAS))
    missing = tuple(package for package in loaded if not installed(package))
    return {
        "scene": name,
        "geometry": made.facts.geometry,
        "what": described(made.facts),
        "stages": [_stage(flow, made, name, stage) for stage in made.stages],
        "reads": reading.as_dict(),
        "optional_packages": {
            "loaded": list(loaded),
            "not_loaded": dict(made.idle),
            "missing": {package: install_command((package,)) for package in missing},
        },
        "held_out": list(made.held_out),
        "left_out": dict(made.left_out),
    }


def expect_packages(flow: Workflow) -> None:
    """UserError where a stage that would run needs a package that is not installed; video has a way without it."""
    for name, made in flow.plans.items():
        for stage, packages in made.packages.items():
            missing = tuple(p for p in packages if p in EXTRAS and p != "av" and not installed(p))
            if missing and stage_state(flow, name, stage)[0] == "run":
                need = " and ".join(f"{p} ({PURPOSE[p]})" for p in missing)
                raise UserError(
                    f"scene {name!r}: {stage} needs {need}, not installed. Remedy: {install_command(missing)}"
                )


def _stage(flow: Workflow, made: Plan, scene: str, stage: str) -> dict[str, Any]:
    state, reasons = stage_state(flow, scene, stage)
    return {
        "stage": stage,
        "key": made.stages[stage].key,
        "state": state,
        "reasons": reasons,
        "does": CHAIN[stage].does,
        "memory_mb": flow.memory_mb(scene, stage),
        "seconds": round(flow.seconds(scene, stage), 1),
        "packages": list(made.packages[stage]),
    }


def described(facts: SceneFacts) -> str:
    """One line on a capture: its size and how many lights, views, polariser states or pairs of directions it has."""
    channels = f"{facts.channels} channel{'s' * (facts.channels > 1)}"
    if facts.geometry == "goniometer":
        of = "a table of" if facts.table else f"windows of {facts.pixels} pixels,"
        lit = f"{facts.frontal} of them lit along the normal"
        return f"{of} {facts.measurements} pairs of directions, {lit}, {channels}"
    size = f"{facts.pixels / 1e6:.2f} Mpx" if facts.pixels >= 10_000 else f"{facts.pixels} pixels"
    if facts.geometry != "turntable":
        return f"{size}, {len(facts.lights)} lights, {channels}"
    states = f", {len(facts.states)} polariser states" if len(facts.states) > 1 else ""
    lights = f" under {len(facts.lights)} lights" if len(facts.lights) > 1 else ""
    return f"{size}, {len(facts.views)} views{lights}{states}, {channels}"


def text_of(summary: dict[str, Any]) -> str:
    """The plan of a scene for reading."""
    width = max(len(stage["stage"]) for stage in summary["stages"])
    lines = [f"{summary['scene']}: {summary['what']}"]
    for stage in summary["stages"]:
        cost = f"{stage['memory_mb']:6} MiB {_duration(stage['seconds']):>7}"
        lines.append(f"  {stage['stage']:{width}}  {stage['key']}  {stage['state']:4}  {cost}  {stage['does']}")
    lines += (
        _total_lines(summary["stages"]) + _read_lines(summary["reads"]) + _package_lines(summary["optional_packages"])
    )
    if summary["held_out"]:
        lines.append(f"  held out of every fit and predicted instead: {', '.join(summary['held_out'])}")
    lines += [f"  without {left}: {why}" for left, why in summary["left_out"].items()]
    return "\n".join(lines)


def _total_lines(stages: list[dict[str, Any]]) -> list[str]:
    to_run = [stage for stage in stages if stage["state"] == "run"]
    if not to_run:
        return ["  nothing to run: every stage is done"]
    memory, seconds = max(stage["memory_mb"] for stage in to_run), sum(stage["seconds"] for stage in to_run)
    return [
        f"  {len(to_run)} of {len(stages)} stages to run: at most {memory} MiB and {_duration(seconds)} of one core"
    ]


def _duration(seconds: float) -> str:
    """Seconds, minutes or hours, whichever reads best."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _read_lines(reads: dict[str, Any]) -> list[str]:
    """Files, channels and tiles: how many of how many."""
    rows = [*reads["files"], {**reads["total"], "what": "all files"}]
    lines = [
        f"  reads {row['read']:>5} of {row['of']:>5}  {row['what']:34} {_size(row['bytes_read'], row['bytes_of'])}"
        for row in rows
    ]
    read, of = reads["channels"]
    lines.append(f"  keeps {read:>5} of {of:>5}  channels")
    if reads["tiles"]:
        read, of = reads["tiles"]
        lines.append(f"  keeps {read:>5} of {of:>5}  tiles (bands of rows times lights)")
    return lines


def _size(read: int, of: int) -> str:
    unit, size = ("GB", 1e9) if of >= 1e9 else ("MB", 1e6) if of >= 1e5 else ("kB", 1e3)
    return f"{read / size:.2f} of {of / size:.2f} {unit}"


def _package_lines(packages: dict[str, Any]) -> list[str]:
    loaded = [f"{name} ({PURPOSE[name]})" for name in packages["loaded"]]
    lines = [f"  optional packages loaded: {', '.join(loaded) or 'none'}"]
    if packages["not_loaded"]:
        names = [f"{name} ({why})" for name, why in packages["not_loaded"].items()]
        lines.append(f"  not loaded: {', '.join(names)}")
    return lines + [f"  {name} is not installed. Remedy: {how}" for name, how in packages["missing"].items()]
