"""Snakemake, started as a registered run: beside no live one of the same scenes, behind what a dead one left."""

import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from nishiki.planning.plan import Plan
from nishiki.planning.workflow import Workflow
from nishiki.runs.records import refuse_while_running
from nishiki.runs.running_lock import registered
from nishiki.runs.soundness import set_aside_unsound

LOOKS_ONLY = {
    *("-n", "--dry-run", "--dryrun", "-S", "--summary", "-D", "--detailed-summary", "--dag", "--d3dag", "--rulegraph"),
    *("--filegraph", "--lint", "-l", "--list", "--list-rules", "--lt", "--list-target-rules", "--report", "--lu"),
    *("--list-untracked", "--lc", "--list-changes", "--li", "--list-input-changes", "--lp", "--list-params-changes"),
    *("-h", "--help", "-v", "--version"),
}
"""Options with which Snakemake runs nothing."""


def call_engine(flow: Workflow, command: list[str], *, gone: Iterable[str] = ()) -> int:
    """Run Snakemake on the scenes of a workflow; its exit status.

    Artifacts that must not be built on are set aside first; behind a run that was killed, their contents are looked at
    too. gone: machines of which it is known that nothing runs there any more. Raises UserError where another run of one
    of the scenes is alive.
    """
    # Every stage is a process: without compiled bytecode each would compile the same imports again.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    if LOOKS_ONLY & set(command):  # whoever only looks takes no lock, and stumbles over none
        return subprocess.run([*command[:3], "--nolock", *command[3:]], check=False, env=environment).returncode
    results = Path(flow.results)
    if "--unlock" in command:
        refuse_while_running(results, "the lock stays")
        return subprocess.run(command, check=False, env=environment).returncode
    with registered(results, flow.plans, gone=gone, tell=_tell) as held:
        set_aside_unsound(dict(_plans(flow)), _tell, contents=held.unclean)
        status = held.call(command, environment)
        if not status:
            held.ended = "done"
        elif held.ended == "interrupted":
            _tell("interrupted: its jobs were ended")
    return status


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _plans(flow: Workflow) -> Iterator[tuple[str, list[tuple[str, Path, tuple[str, ...]]]]]:
    """Stages of every scene, and of every variant of a swept one."""
    for scene, plan in flow.plans.items():
        yield scene, _stages(flow, plan)
    for swept in flow.sweep.scenes if flow.sweep else ():
        for variant in swept.variants:
            yield f"{swept.scene} {variant.name}", _stages(flow, variant.plan)


def _stages(flow: Workflow, plan: Plan) -> list[tuple[str, Path, tuple[str, ...]]]:
    return [
        (name, Path(flow.path(plan.scene.name, name, planned.key)).parent, tuple(planned.upstream))
        for name, planned in plan.stages.items()
    ]
