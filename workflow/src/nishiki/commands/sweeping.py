"""The command that makes sweeps: error against run time over variants of settings."""

import argparse
import json
import sys
from pathlib import Path

from nishiki.commands.running import profile_arguments
from nishiki.errors import UserError
from nishiki.installation import SNAKEFILE


def sweep(options: argparse.Namespace, rest: list[str]) -> int:
    """Make each sweep: all variants, timed repeats, table and page. Exit status 1 where a stage failed or a repeat gave
    other bytes than its first run."""
    return max(_one(named, options, rest) for named in options.sweeps)


def _one(named: str, options: argparse.Namespace, rest: list[str]) -> int:
    from nishiki.commands.engine import LOOKS_ONLY, call_engine
    from nishiki.engine.project import load_yaml
    from nishiki.engine.sweep_plan import configuration_of
    from nishiki.engine.workflow import Workflow

    path = Path(named)
    given = configuration_of(path) if path.suffix in (".yaml", ".yml") else None
    configfile = options.configfile or given or "config/config.yaml"
    values = load_yaml(Path(configfile))
    if not isinstance(values, dict):
        raise UserError(f"{configfile}: expected a block of keys and values, found {type(values).__name__}")
    flow = Workflow({**values, "sweep": named}, file=configfile)
    tell_plan(flow)
    target = flow.sweep_path("sweep.json")
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), "--configfile", configfile]
    command += profile_arguments(options.profile, options.cores)
    command += ["--keep-going", *rest, "--config", f"sweep={json.dumps(named)}", "--", target]
    status = call_engine(flow, command, gone=options.host_is_gone)
    if status or LOOKS_ONLY & set(rest):
        return 1 if status else 0
    return tell_result(Path(target))


def tell_plan(flow) -> None:
    """How many variants of which scenes, which stages are timed, how many stages will be made."""
    for swept in flow.sweep.scenes:
        timed = sum(len(paths) for variant in swept.variants for paths in flow.timings(swept, variant).values())
        print(
            f"{flow.sweep.name}: {swept.scene}: {len(swept.variants)} variants, figures from {swept.evaluation}, "
            f"timed: {', '.join(swept.counted)} ({timed} runs)"
        )


def tell_result(path: Path) -> int:
    """The advice of a finished sweep, and where its page is; 1 where a repeat gave other bytes."""
    content = json.loads(path.read_text(encoding="utf-8"))
    status = 0
    for scene in content["scenes"]:
        for measure, lines in zip(scene["measures"], scene["advice"], strict=True):
            print(f"{scene['scene']}, {measure['label']}:")
            for line in lines:
                print(f"    {line}")
        for row in scene["rows"]:
            if not row["reproducible"]:
                status = 1
                print(
                    f"{scene['scene']}: {row['name']}: not reproducible: {', '.join(row['different'])}", file=sys.stderr
                )
    print(path.with_name("sweep.html"))
    return status
