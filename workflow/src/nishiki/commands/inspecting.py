"""Commands that look and change nothing: explain, schema; and the state of a stage."""

import argparse
import json
from pathlib import Path

from nishiki.artifacts.artifact import MANIFEST, Artifact, open_artifact
from nishiki.artifacts.provenance import differences
from nishiki.engine.plan import Plan
from nishiki.engine.project import Configuration, load_yaml
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError
from nishiki.stages.table import CHAIN


def _workflow(options: argparse.Namespace) -> Workflow:
    return Workflow(load_yaml(options.configfile), only=options.scene, file=options.configfile)


def stage_state(flow: Workflow, scene: str, stage: str) -> tuple[str, list[str]]:
    """State of a stage (done | run) and the reasons to run."""
    path = Path(flow.artifact(scene, stage))
    if not path.is_file():
        return "run", [f"no artifact for key {path.parent.name}", *_nearest(path.parent, flow, scene, stage)]
    try:
        artifact = open_artifact(path.parent, contents=False)
    except UserError as error:
        return "run", [str(error)]
    reasons = []
    if artifact.manifest["code"] != flow.code(stage):
        reasons.append(f"its code changed: {artifact.manifest['code'] or '(none)'} -> {flow.code(stage)}")
    versions = json.loads(flow.libraries(scene, stage, path.parent.name))
    reasons += [f"library {text}" for text in differences(artifact.manifest["libraries"], versions)]
    reasons += _upstream_reasons(flow, scene, stage, artifact)
    return ("run" if reasons else "done"), reasons


def _upstream_reasons(flow: Workflow, scene: str, stage: str, artifact: Artifact) -> list[str]:
    reasons = []
    for upstream in flow.plans[scene].stages[stage].upstream:
        if upstream not in CHAIN:
            continue
        path = Path(flow.artifact(scene, upstream))
        state, _ = stage_state(flow, scene, upstream)
        if state == "run":
            reasons.append(f"{upstream} will run before it")
        elif open_artifact(path, contents=False).digest != artifact.manifest["upstream"][upstream]["digest"]:
            reasons.append(f"{upstream} was made again since, with another result")
    return reasons


def _nearest(folder: Path, flow: Workflow, scene: str, stage: str) -> list[str]:
    """What differs from the newest artifact of the same stage."""
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


def explain(options: argparse.Namespace, rest: list[str]) -> int:
    """Print why each stage would run or not; with --keys, what differs between two artifacts of a stage."""
    flow = _workflow(options)
    if options.keys:
        return _explain_keys(flow.project.results, *options.keys)
    for name, made in flow.plans.items():
        _explain_scene(flow, name, made)
    return 0


def _explain_scene(flow: Workflow, name: str, made: Plan) -> None:
    for stage in made.stages:
        state, reasons = stage_state(flow, name, stage)
        print(f"{name}/{stage}: {'will run' if state == 'run' else 'up to date'}")
        for reason in reasons:
            print(f"    {reason}")
    for left, why in made.left_out.items():
        print(f"{name}/{left}: left out, {why}")


def _explain_keys(results: Path, first: str, second: str) -> int:
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
    return 0


def schema(options: argparse.Namespace, rest: list[str]) -> None:
    """Print the JSON schema of the configuration."""
    print(json.dumps(Configuration.model_json_schema(), indent=1))
