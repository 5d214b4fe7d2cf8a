"""Commands of results and campaigns: files of one scene for other programs, a table of all, sweeps of settings."""

import importlib
import json
import shutil
import sys
from pathlib import Path

import click

from nishiki.commands.declare import (
    command,
    option,
    scene_argument,
    with_configuration,
    with_cores,
    with_gone,
    with_profile,
)
from nishiki.commands.inspecting import expect_packages, planned_workflow
from nishiki.commands.running import profile_arguments
from nishiki.errors import UserError, require
from nishiki.packages import optional

FORMATS = """\
Formats of a painting: normals, height, albedo, relight, spectral, gltf, usd, materialx, mitsuba, merl, iiif
Formats of an object:  gltf, usd, materialx, mitsuba, iiif, kintsugi
Formats of a cloth:    gltf, mitsuba, bsdf
See docs/stages/export.md."""


@command("export altarpiece normals relight", "export jar gltf --output for-the-web", epilog=FORMATS)
@scene_argument
@click.argument("formats", nargs=-1, required=True, metavar="FORMAT...", help="what to write, see below")
@option("--output FOLDER", "copy the files there, too; the folder must not exist")
@with_configuration
@with_cores
@with_gone
def export(scene, formats, output, configfile, cores, gone) -> int:
    """Write a scene's results in formats of other programs; stages that these need run first."""
    from nishiki.commands.engine import call_engine
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow

    if output and Path(output).exists():
        raise UserError(f"--output {output}: exists already. Remedy: name a folder that does not")
    values = load_yaml(Path(configfile))
    asked = {scene: formats}
    flow = Workflow({**values, "exports": asked}, only=[scene], file=configfile)
    expect_packages(flow)
    stage = next(name for name in flow.plans[scene].stages if name.endswith("export"))
    target = flow.artifact(scene, stage)
    options = [*profile_arguments("default", cores), "--config", f"exports={json.dumps(asked)}", "--", target]
    if call_engine(flow, options, configfile=configfile, gone=gone):
        return 1
    made = Path(target).parent / "exports"
    if output:
        shutil.copytree(made, output)
        made = Path(output)
    print(made)
    for path in sorted(made.iterdir()):
        print(f"    {path.name}{'/' if path.is_dir() else ''}")
    return 0


@command("table campaign.csv", "table campaign.parquet")
@click.argument("file", help="file to write, .csv or .parquet (needs the extra export)")
@with_configuration
def table(file: str, configfile: str) -> None:
    """Write the figures of all scenes as a table, one row per scene."""
    from nishiki.capture.taking import table_text
    from nishiki.engine.finished import campaign_rows, columns_of

    path = Path(file)
    if path.suffix not in (".csv", ".parquet"):
        raise UserError(f"{path}: expected a name that ends in .csv or .parquet")
    columns = columns_of(campaign_rows(planned_workflow(configfile, leave_out_refused=True)))
    if path.suffix == ".parquet":
        pyarrow = optional("pyarrow")
        parquet = importlib.import_module("pyarrow.parquet")
        parquet.write_table(pyarrow.table(columns), path)
    else:
        path.write_text(table_text([list(columns), *zip(*columns.values(), strict=True)]), encoding="utf-8")
    finished = sum(value is True for value in columns["finished"])
    print(f"{path}: {len(columns['scene'])} scenes, {finished} of them finished, {len(columns)} columns")


@command("sweep config/sweeps/normals.yaml", passed_on=True)
@click.argument(
    "words",
    nargs=-1,
    required=True,
    type=click.UNPROCESSED,
    metavar="SWEEP... [SNAKEMAKE OPTION]...",
    help="files of sweeps, or names under `sweeps` in the configuration",
)
@option("--configfile FILE", "configuration (default: the one that the sweep's file names, else config/config.yaml)")
@with_cores
@with_profile
@with_gone
def sweep(words, configfile, cores, profile, gone) -> int:
    """Run variants of settings, and plot their error against their run time.

    All variants are made and timed; then table, page and advice are written. Exit status 1 where a stage failed or a
    repeat gave other bytes than its first run.
    """
    count = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    if not count:
        raise click.UsageError("expected a sweep before the options of Snakemake: a file, or a name.")
    return max(_one(named, configfile, (profile, cores), gone, words[count:]) for named in words[:count])


def _one(named: str, configfile: str | None, where: tuple, gone: tuple[str, ...], rest: tuple[str, ...]) -> int:
    from nishiki.commands.engine import LOOKS_ONLY, call_engine
    from nishiki.engine.project import load_yaml
    from nishiki.engine.sweep_plan import configuration_of
    from nishiki.engine.workflow import Workflow

    path = Path(named)
    given = configuration_of(path) if path.suffix in (".yaml", ".yml") else None
    configfile = configfile or given or "config/config.yaml"
    values = load_yaml(Path(configfile))
    flow = Workflow({**values, "sweep": named}, file=configfile)
    planned = require(flow.sweep)
    for swept in planned.scenes:
        timed = sum(len(paths) for variant in swept.variants for paths in flow.timings(swept, variant).values())
        print(
            f"{planned.name}: {swept.scene}: {len(swept.variants)} variants, figures from {swept.evaluation}, "
            f"timed: {', '.join(swept.counted)} ({timed} runs)"
        )
    target = flow.sweep_path("sweep.json")
    options = [*profile_arguments(*where), "--keep-going", *rest]
    options += ["--config", f"sweep={json.dumps(named)}", "--", target]
    status = call_engine(flow, options, configfile=configfile, gone=gone)
    if status or LOOKS_ONLY & set(rest):
        return 1 if status else 0
    return tell_result(Path(target))


def tell_result(path: Path) -> int:
    """Print the advice of a finished sweep and the place of its page; 1 where a repeat gave other bytes."""
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
