"""The command that writes files of a scene's results for other programs."""

import argparse
import json
import shutil
import sys
from pathlib import Path

from nishiki.commands.running import profile_arguments
from nishiki.errors import UserError
from nishiki.installation import SNAKEFILE


def export(options: argparse.Namespace, rest: list[str]) -> int:
    """Make the export of one scene, and whatever of the scene it needs that is not made yet; name its files."""
    from nishiki.commands.engine import call_engine
    from nishiki.commands.planning import expect_packages
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow

    if options.output and Path(options.output).exists():
        raise UserError(f"--output {options.output}: exists already. Remedy: name a folder that does not")
    values = load_yaml(Path(options.configfile))
    asked = {options.scene: options.formats}
    flow = Workflow({**values, "exports": asked}, only=options.scene, file=options.configfile)
    expect_packages(flow)
    stage = next(name for name in flow.plans[options.scene].stages if name.endswith("export"))
    target = flow.artifact(options.scene, stage)
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), "--configfile", options.configfile]
    command += profile_arguments("default", options.cores)
    command += ["--config", f"exports={json.dumps(asked)}", "--", target]
    status = call_engine(flow, command, gone=options.host_is_gone)
    if status:
        return 1
    made = Path(target).parent / "exports"
    if options.output:
        shutil.copytree(made, options.output)
        made = Path(options.output)
    print(made)
    for path in sorted(made.iterdir()):
        print(f"    {path.name}{'/' if path.is_dir() else ''}")
    return 0
