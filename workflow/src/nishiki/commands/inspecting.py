"""Commands that change nothing: plan, explain, schema; and the state of a stage."""

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nishiki.commands.declare import any_scene_argument, command, option, with_configuration, with_json
from nishiki.errors import UserError
from nishiki.installation import EXTRAS, PURPOSE, install_command, is_installed

if TYPE_CHECKING:
    from nishiki.engine.plan import Plan
    from nishiki.engine.workflow import Workflow
    from nishiki.stages.base import SceneFacts


def planned_workflow(configfile: str, scene: str | None = None, changes: dict | None = None, **how) -> "Workflow":
    """Return the plans of a configuration with these changes of its keys, or of one of its scenes."""
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow

    return Workflow(
        load_yaml(Path(configfile)) | (changes or {}), only=[scene] if scene else (), file=configfile, **how
    )


@command("plan", "plan altarpiece")
@any_scene_argument
@with_configuration
@with_json
def plan(scene: str | None, configfile: str, as_json: bool) -> None:
    """Show which stages would run, what they read and cost, and what is left out and why."""
    flow = planned_workflow(configfile, scene)
    for name in flow.plans:
        summary = scene_plan(flow, name)
        print(json.dumps(summary, sort_keys=True) if as_json else text_of(summary))


def scene_plan(flow: "Workflow", name: str) -> dict[str, Any]:
    """Return the plan of a scene as plain values."""
    from nishiki.capture.folder import load_capture
    from nishiki.capture.mosaic import MosaicCapture
    from nishiki.observations.region import usage_of

    made = flow.plans[name]
    capture, reads = load_capture(made.scene.capture), {}
    if not isinstance(capture, MosaicCapture):
        ingest = made.stages["ingest"].settings
        reads = usage_of(capture, without=ingest["without"], channels=ingest["channels"])
    loaded = tuple(dict.fromkeys(p for names in made.packages.values() for p in names if p in EXTRAS))
    missing = tuple(package for package in loaded if not is_installed(package))
    return {
        "scene": name,
        "geometry": made.facts.geometry,
        "what": describe_capture(made.facts),
        "stages": [_stage(flow, made, name, stage) for stage in made.stages],
        "reads": reads,
        "optional_packages": {
            "loaded": list(loaded),
            "not_loaded": dict(made.unused_packages),
            "missing": {package: install_command((package,)) for package in missing},
        },
        "held_out": list(made.held_out),
        "left_out": dict(made.left_out),
    }


def expect_packages(flow: "Workflow") -> None:
    """Raise a UserError where a stage to run needs a package that is not installed; video has a way without it."""
    for name, made in flow.plans.items():
        for stage, packages in made.packages.items():
            missing = tuple(p for p in packages if p in EXTRAS and p != "av" and not is_installed(p))
            if missing and stage_state(flow, name, stage)[0] == "run":
                need = " and ".join(f"{p} ({PURPOSE[p]})" for p in missing)
                raise UserError(
                    f"scene {name!r}: {stage} needs {need}, not installed. Remedy: {install_command(missing)}"
                )


def _stage(flow: "Workflow", made: "Plan", scene: str, stage: str) -> dict[str, Any]:
    from nishiki.stages.table import CHAIN

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


def describe_capture(facts: "SceneFacts") -> str:
    """Describe a capture in one line: size and number of lights, views, polariser states or pairs of directions."""
    channels = f"{facts.channels} channel{'s' * (facts.channels > 1)}"
    if facts.geometry == "goniometer":
        of = "a table of" if facts.table else f"windows of {facts.pixels} pixels,"
        lit = f"{facts.frontal} of them lit along the normal"
        return f"{of} {facts.measurements} pairs of directions, {lit}, {channels}"
    size = f"{facts.pixels / 1e6:.2f} Mpx" if facts.pixels >= 10_000 else f"{facts.pixels} pixels"
    if facts.fields:
        return f"mosaic of {len(facts.fields)} fields, {size} with their overlaps, {channels}"
    if facts.geometry != "turntable":
        return f"{size}, {len(facts.lights)} lights, {channels}"
    states = f", {len(facts.states)} polariser states" if len(facts.states) > 1 else ""
    lights = f" under {len(facts.lights)} lights" if len(facts.lights) > 1 else ""
    return f"{size}, {len(facts.views)} views{lights}{states}, {channels}"


def text_of(summary: dict[str, Any]) -> str:
    """Format the plan of a scene for reading."""
    width = max(len(stage["stage"]) for stage in summary["stages"])
    lines = [f"{summary['scene']}: {summary['what']}"]
    for stage in summary["stages"]:
        cost = f"{stage['memory_mb']:6} MiB {duration(stage['seconds']):>7}"
        lines.append(f"  {stage['stage']:{width}}  {stage['key']}  {stage['state']:4}  {cost}  {stage['does']}")
    if to_run := [stage for stage in summary["stages"] if stage["state"] == "run"]:
        count = f"{len(to_run)} of {len(summary['stages'])} stages to run"
        memory, seconds = max(stage["memory_mb"] for stage in to_run), sum(stage["seconds"] for stage in to_run)
        lines.append(f"  {count}: at most {memory} MiB and {duration(seconds)} of one core")
    else:
        lines.append("  nothing to run: every stage is done")
    if reads := summary["reads"]:
        lines += [
            f"  reads {row['read']:>5} of {row['of']:>5}  {row['what']:34} {_size(row['bytes_read'], row['bytes_of'])}"
            for row in (*reads["files"], {**reads["total"], "what": "all files"})
        ]
        lines.append("  keeps {:>5} of {:>5}  channels".format(*reads["channels"]))
    packages = summary["optional_packages"]
    loaded = [f"{name} ({PURPOSE[name]})" for name in packages["loaded"]]
    lines.append(f"  optional packages loaded: {', '.join(loaded) or 'none'}")
    if packages["not_loaded"]:
        names = [f"{name} ({why})" for name, why in packages["not_loaded"].items()]
        lines.append(f"  not loaded: {', '.join(names)}")
    lines += [f"  {name} is not installed. Remedy: {how}" for name, how in packages["missing"].items()]
    if summary["held_out"]:
        lines.append(f"  held out of every fit and predicted instead: {', '.join(summary['held_out'])}")
    lines += [f"  without {left}: {why}" for left, why in summary["left_out"].items()]
    return "\n".join(lines)


def duration(seconds: float) -> str:
    """Format a time in seconds, minutes or hours, whichever reads best."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _size(read: int, of: int) -> str:
    unit, size = ("GB", 1e9) if of >= 1e9 else ("MB", 1e6) if of >= 1e5 else ("kB", 1e3)
    return f"{read / size:.2f} of {of / size:.2f} {unit}"


@cache  # a mosaic asks for the stages of every field; a workflow is that of one command
def stage_state(flow: "Workflow", scene: str, stage: str) -> tuple[str, list[str]]:
    """State of a stage (done | run) and the reasons to run."""
    from nishiki.artifacts.provenance import place_above
    from nishiki.engine.finished import reasons_of_stage

    planned = flow.plans[scene].stages[stage]
    folder = Path(flow.artifact(scene, stage)).parent
    if not Path(flow.artifact(scene, stage)).is_file():
        return "run", [f"no artifact for key {planned.key}", *_nearest(folder, flow, scene, stage)]
    waiting = [name for name in flow.above(scene, planned) if stage_state(flow, *place_above(scene, name))[0] == "run"]
    _, reasons = reasons_of_stage(flow, scene, stage, dict.fromkeys(waiting))
    reasons += [f"{name} will run before it" for name in waiting]
    return ("run" if reasons else "done"), reasons


def _nearest(folder: Path, flow: "Workflow", scene: str, stage: str) -> list[str]:
    """List the differences from the newest artifact of the same stage."""
    from nishiki.artifacts.artifact import MANIFEST
    from nishiki.artifacts.provenance import differences

    others = sorted(folder.parent.glob(f"*/{MANIFEST}"), key=lambda path: path.stat().st_mtime)
    if not others:
        return []
    other = json.loads(others[-1].read_text())
    planned = flow.plans[scene].stages[stage]
    changed = differences(other["settings"], planned.settings)
    for name in sorted(set(planned.upstream) | set(other["upstream"])):
        before = other["upstream"].get(name, {}).get("key") or other["upstream"].get(name, {}).get("digest", "(none)")
        now = planned.upstream.get(name, "(none)")
        if before != now:
            changed.append(f"upstream {name}: {before[:12]} -> {now[:12]}")
    return [f"since {other['key']}: {text}" for text in changed]


@command("explain altarpiece", "explain altarpiece --keys 1f3a 9c0d")
@any_scene_argument
@with_configuration
@option("--keys KEY KEY", "two keys of one stage: what differs between them", nargs=2)
def explain(scene: str | None, configfile: str, keys: tuple[str, str] | None) -> None:
    """Explain why each stage of a scene would run or not, or what differs between two results."""
    flow = planned_workflow(configfile, scene)
    if keys:
        _explain_keys(flow.project.results, *keys)
        return
    for name, made in flow.plans.items():
        for stage in made.stages:
            state, reasons = stage_state(flow, name, stage)
            print(f"{name}/{stage}: {'will run' if state == 'run' else 'up to date'}")
            for reason in reasons:
                print(f"    {reason}")
        for left, why in made.left_out.items():
            print(f"{name}/{left}: left out, {why}")


def _explain_keys(results: Path, first: str, second: str) -> None:
    from nishiki.artifacts.artifact import MANIFEST
    from nishiki.artifacts.provenance import differences

    manifests = []
    for key in (first, second):
        folders = [path for path in results.glob(f"*/*/{key}*") if (path / MANIFEST).is_file()]
        if not folders:
            raise UserError(f"no artifact with key {key} below {results}")
        manifests.append(json.loads((folders[0] / MANIFEST).read_text()))
    a, b = manifests
    print(f"{a['scene']}/{a['stage']}/{a['key']} and {b['scene']}/{b['stage']}/{b['key']}")
    keys = ("stage", "scene", "format_version", "settings", "upstream", "code", "libraries")
    for text in differences({key: a.get(key) for key in keys}, {key: b.get(key) for key in keys}) or ["no difference"]:
        print(f"    {text}")


@command("schema > settings.json")
def schema() -> None:
    """Print the JSON schema of config.yaml: every setting with its meaning."""
    from nishiki.engine.project import Configuration

    print(json.dumps(Configuration.model_json_schema(), indent=1))
