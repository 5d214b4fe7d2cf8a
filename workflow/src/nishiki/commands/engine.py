"""Run Snakemake as a registered run on unfinished scenes, after clearing up behind dead runs.

It never runs beside a live one of the same scenes.

Snakemake's own locks are switched off: they stay where a run is killed, and do not say whose they are.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from statistics import fmean

from nishiki.artifacts.artifact import expect_links
from nishiki.engine.finished import set_aside_unsound, unfinished_scenes
from nishiki.engine.plan import Plan
from nishiki.engine.running_lock import register_run
from nishiki.engine.workflow import LEAVE_OUT, Workflow
from nishiki.installation import INSTALLED, SNAKEFILE, SOURCE

LOOKS_ONLY = {
    *("-n", "--dry-run", "--dryrun", "-S", "--summary", "-D", "--detailed-summary", "--dag", "--d3dag", "--rulegraph"),
    *("--filegraph", "--lint", "-l", "--list", "--list-rules", "--lt", "--list-target-rules", "--report", "--lu"),
    *("--list-untracked", "--lc", "--list-changes", "--li", "--list-input-changes", "--lp", "--list-params-changes"),
    *("-h", "--help", "-v", "--version", "--unlock"),
}
"""Options with which Snakemake prints or plans but runs no job."""
HOW_ONLY = {
    *("-k", "--keep-going", "-p", "--printshellcmds", "-q", "--quiet", "--verbose", "--show-failed-logs", "--nocolor"),
    *("--rerun-incomplete", "--ri", "-j", "--jobs", "-T", "--retries", "-w", "--latency-wait", "--local-cores"),
    *("--resources", "--res", "--default-resources", "--set-resources", "--set-threads", "--max-threads"),
    *("--max-jobs-per-second", "--max-status-checks-per-second", "--seconds-between-status-checks"),
}
"""Options that say how to run and not what to make; those of the plugin for Slurm are such, too."""
WHAT_TO_MAKE = frozenset(
    (
        *("force", "forceall", "forcerun", "touch", "until", "omit-from", "batch", "rerun-triggers", "config"),
        *("configfile", "configfiles", "target-jobs", "allowed-rules", "consider-ancient", "delete-all-output"),
        *("snakefile", "directory", "software-deployment-method", "use-conda"),
    )
)
"""Options in a profile that decide what is made."""
ITS_OWN_OUTPUT = {"--verbose", "--logger"}
"""Options with which Snakemake prints for itself."""
QUIET = ["--quiet", "rules", "host"]  # where Snakemake itself writes on the screen
SAMPLED_SCENES = 200
"""Scenes from which the expected time of each stage is taken."""


def names_targets(rest: Sequence[str], profile: dict) -> bool:
    """Return whether options for Snakemake may ask for more, or for less, than what is not finished.

    rest: of the command line; profile: keys and values of a profile. Then Snakemake decides on every scene, and so it
    does with whatever is not known here: a target, an option with a word as its value.
    """
    how = (word.split("=")[0] in HOW_ONLY or word.startswith("--slurm-") for word in rest)
    value = (re.fullmatch(r"[0-9.]+|\w+[=:][^/]+", word) for word in rest)
    known = all(option or number for option, number in zip(how, value, strict=True))
    decided = WHAT_TO_MAKE & {str(key).replace("_", "-") for key in profile}
    return not known or bool(decided)


def engine_environment() -> dict[str, str]:
    """Return the environment variables with which Snakemake is started.

    A profile for other work (SNAKEMAKE_PROFILE) does not apply here, and a home folder that cannot be written is
    replaced as the place of Snakemake's cache.
    """
    # Every stage is a process: without compiled bytecode each would compile the same imports again.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    if profile := environment.pop("SNAKEMAKE_PROFILE", None):
        _tell(f"SNAKEMAKE_PROFILE={profile} is not used here; name a profile for this run with --profile {profile}")
    cache = Path(environment.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "snakemake"
    try:
        cache.mkdir(parents=True, exist_ok=True)
        writable = os.access(cache, os.W_OK)
    except (OSError, RuntimeError):  # RuntimeError: "~" where no home folder is known
        writable = False
    return environment if writable else environment | {"XDG_CACHE_HOME": os.path.abspath(".snakemake/cache")}


def call_engine(
    flow: Workflow,
    options: list[str],
    *,
    configfile: str,
    gone: Iterable[str] = (),
    unfinished_only: bool = False,
    failures: list[dict[str, str]] | None = None,
) -> int:
    """Run Snakemake with some options on the scenes of a workflow; its exit status.

    failures: gets each failed job: scene, stage, name, why, log.

    unfinished_only: Snakemake hears only of scenes that are not finished (see `nishiki.engine.finished`), and is not
    started where all are.

    Artifacts that must not be built on are set aside first; behind a run that was killed, their contents are looked at
    too. gone: machines of which it is known that nothing runs there any more. Raises UserError where another run of one
    of the scenes is alive.
    """
    environment = engine_environment() | ({LEAVE_OUT: "1"} if flow.refused else {})
    snakemake = [sys.executable, "-m", "snakemake", "--nolock"]
    rest = ["--snakefile", str(SNAKEFILE), "--configfile", configfile, *options]
    if LOOKS_ONLY & set(options):
        return subprocess.run([*snakemake, *QUIET, *rest], check=False, env=environment).returncode
    with register_run(Path(flow.results), flow.plans, gone=gone, tell=_tell) as held:
        scenes = list(flow.plans)
        if unfinished_only:
            scenes = list(unfinished_scenes(flow, contents=held.unclean))
            done, total = len(flow.plans) - len(scenes), len(flow.plans) + len(flow.refused)
            if not scenes:
                _tell(f"Nothing to be done: {done} of {total} scenes are finished")
                held.ended = "done"
                return 0
            if done:
                _tell(f"{done} of {total} scenes are finished and left as they are")
            held.record_unfinished(scenes)
        expect_links(Path(flow.results))
        plans = [flow.plans[each.name] for scene in scenes for each in flow.plans[scene].scene.with_fields]
        plans += [variant.plan for swept in (flow.sweep.scenes if flow.sweep else ()) for variant in swept.variants]
        set_aside_unsound([stage for plan in plans for stage in _stages(flow, plan)], _tell, contents=held.unclean)
        with tempfile.TemporaryFile() as failed:
            counted = len(scenes) if unfinished_only else None
            shown = QUIET if ITS_OWN_OUTPUT & set(options) else _display(flow, scenes, counted, failed.fileno())
            if not INSTALLED:  # Snakemake looks for its plugins on the path of Python
                path = (str(SOURCE), environment.get("PYTHONPATH"))
                environment["PYTHONPATH"] = os.pathsep.join(filter(None, path))
            status = held.call([*snakemake, *shown, *rest], environment, keep=(failed.fileno(),))
            failed.seek(0)
            if failures is not None:
                failures += [json.loads(line) for line in failed]
        if not status:
            held.ended = "done"
        elif held.ended == "interrupted":
            _tell("interrupted: its jobs were ended")
    return status


def _display(flow: Workflow, scenes: list[str], unfinished: int | None, failed: int) -> list[str]:
    """Return options for Snakemake that leave its screen to the project's own logger plugin.

    unfinished: number of scenes that the run makes, where it is known; failed: descriptor for what failed. Snakemake's
    log file says more than a user wants to see, the rules with their reasons among it.
    """
    # means of processor seconds over some of the scenes, for a job of each rule
    seconds: dict[str, list[float]] = {}
    for scene in scenes[:: max(1, len(scenes) // SAMPLED_SCENES)]:
        for stage in flow.plans[scene].stages:
            parts = flow.parts(scene, stage)
            rule = stage if parts == 1 else "part"  # the stage's own job only joins its parts
            seconds.setdefault(rule, []).append(flow.seconds(scene, stage, 1 / parts))
    expected: dict[str, object] = {"seconds": {rule: round(fmean(values), 3) for rule, values in seconds.items()}}
    if unfinished is not None:
        expected |= {"scenes": len(flow.plans) + len(flow.refused), "finished": len(flow.plans) - unfinished}
    plugin_options = ["--logger-nishiki-expected", json.dumps(expected), "--logger-nishiki-failures", str(failed)]
    return ["--logger", "nishiki", *plugin_options, "--quiet", "host"]


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _stages(flow: Workflow, plan: Plan) -> Iterator[tuple[Path, dict[str, Path]]]:
    """Yield the folder of each stage of a plan, and those of the artifacts that it reads by their names."""
    scene = plan.scene.name
    for name, planned in plan.stages.items():
        above = {other: Path(path).parent for other, path in flow.above(scene, planned).items()}
        yield Path(flow.path(scene, name, planned.key)).parent, above
