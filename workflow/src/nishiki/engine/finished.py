"""Which scenes are finished: a run would make nothing of them again, so that the engine need not hear of them.

A scene is finished where each stage of its plan has an artifact under its key that is whole, was made by the present
code with the present libraries and from the upstream artifacts that stand there, and where the publication names
exactly these artifacts. Settings, products, truth and capture decide the keys; the facts cache sees their changes.
"""

import json
from functools import cache
from pathlib import Path

from nishiki.artifacts.artifact import open_artifact
from nishiki.artifacts.provenance import library_version
from nishiki.artifacts.publish import INDEX
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError
from nishiki.stages.table import CHAIN


def unfinished_scenes(flow: Workflow, *, contents: bool = False) -> dict[str, str]:
    """Scenes of a workflow that a run has to look at, in the order of the table, each with the first reason.

    contents: look at the files of artifacts more closely than at their sizes (see `open_artifact`).
    """
    reasons = ((scene, reason_to_run(flow, scene, contents=contents)) for scene in flow.plans)
    return {scene: reason for scene, reason in reasons if reason}


def reason_to_run(flow: Workflow, scene: str, *, contents: bool = False) -> str:
    """The first reason why a scene is not finished; empty where it is."""
    plan = flow.plans[scene]
    if plan.scene.settings.leave_out == "nothing":
        return "leave_out: nothing measures its stages, which finished ones may have left out"
    folder = f"{flow.results}/{scene}"
    published: dict[str, dict[str, str]] = {}
    for name, planned in plan.stages.items():
        try:
            artifact = open_artifact(Path(f"{folder}/{name}/{planned.key}"), contents=contents)
        except UserError as error:
            return str(error)
        manifest = artifact.manifest
        if (manifest["stage"], manifest["key"]) != (name, planned.key):
            return f"{artifact.folder}: holds {manifest['stage']} {manifest['key']}"
        if manifest.get("code") != flow.code(name):
            return f"the code of {name} changed"
        if manifest.get("libraries") != _versions(planned.packages):
            return f"a library of {name} changed"
        for other in planned.upstream:
            if other in CHAIN and manifest["upstream"].get(other, {}).get("digest") != published[other]["digest"]:
                return f"{name} was made from another version of {other} than the present one"
        published[name] = {"key": planned.key, "digest": artifact.sha256}
    return "" if _is_published(f"{folder}/current/{INDEX}", published, flow.code("publish")) else "not published"


def _is_published(path: str, artifacts: dict[str, dict[str, str]], code: str) -> bool:
    try:
        with open(path, "rb") as handle:
            index = json.load(handle)
        return index["artifacts"] == artifacts and index["code"] == code
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


@cache
def _versions(packages: tuple[str, ...]) -> dict[str, str]:
    return {name: library_version(name) for name in packages}
