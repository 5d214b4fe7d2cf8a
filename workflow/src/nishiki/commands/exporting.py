"""Commands that hand results to other programs: files of one scene, a table of all."""

import argparse
import csv
import importlib
import json
import shutil
import sys
from pathlib import Path

from nishiki.commands.running import profile_arguments
from nishiki.errors import UserError
from nishiki.installation import SNAKEFILE
from nishiki.packages import optional


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


def table(options: argparse.Namespace, rest: list[str]) -> int:
    """Write one row a scene of a campaign, as CSV or Parquet by the name of the file."""
    from nishiki.engine.campaign_table import campaign_rows, columns_of
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow

    path = Path(options.file)
    if path.suffix not in (".csv", ".parquet"):
        raise UserError(f"{path}: expected a name that ends in .csv or .parquet")
    flow = Workflow(load_yaml(Path(options.configfile)), file=options.configfile, leave_out_refused=True)
    columns = columns_of(campaign_rows(flow))
    if path.suffix == ".parquet":
        pyarrow = optional("pyarrow")
        parquet = importlib.import_module("pyarrow.parquet")
        parquet.write_table(pyarrow.table(columns), path)
    else:
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))
    finished = sum(value is True for value in columns["finished"])
    print(f"{path}: {len(columns['scene'])} scenes, {finished} of them finished, {len(columns)} columns")
    return 0
