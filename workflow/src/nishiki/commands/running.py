"""Commands that digitise and simulate: run, demo, simulate."""

import contextlib
import os
import shutil
import subprocess
import sys
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import click

from nishiki.commands import declare
from nishiki.commands.capturing import convert_options
from nishiki.errors import UserError
from nishiki.installation import INSTALLED, PROJECT, SCRIPTS

NAMED = 20
"""Most unfinished or failed scenes that are printed by name."""


@declare.command(
    "run                                   # every scene of config/scenes.tsv",
    "run altarpiece                        # one scene",
    "run my-photographs/ --width-mm 320    # converted, checked, added to the table, digitised",
    "run captures/altarpiece --open        # a capture; its page opens",
    "run altarpiece --until normals        # further options are Snakemake's: --dry-run, --until, --forcerun, ...",
    passed_on=True,
)
@click.argument(
    "words",
    nargs=-1,
    type=click.UNPROCESSED,
    metavar="[SCENE|FOLDER]...",
    shell_complete=declare.names_of_scenes,
    help="scenes, captures, or folders of photographs, which are converted (default: every scene of the table)",
)
@declare.with_configuration
@declare.with_cores
@declare.with_profile
@declare.with_gone
@declare.option(
    "--stop-at-first-failure", "end the run when a scene fails or cannot be planned (default: go on with the others)"
)
@declare.option("--name SCENE", "name of the scene made from a folder (default: name of the folder)")
@declare.option("--open", "open the page of the result in the browser", "open_page")
@convert_options
def run(words, configfile, cores, profile, gone, stop_at_first_failure, name, open_page, **given) -> int:
    """Digitise folders of photographs, or scenes of the scene table.

    A folder of photographs is converted to captures/NAME, checked, and added to the scene table first; what was
    assumed is listed with the option that changes it (the options of convert). An error that the check finds ends the
    run before any work. Finished results are kept, and a run that was stopped goes on where it stopped.
    """
    from nishiki.commands.project import find_scenes

    wanted, passed = split_words(words)
    scenes = find_scenes(wanted, configfile, name=name, given=given)
    return run_scenes(
        configfile,
        scenes,
        passed,
        cores=cores,
        profile=profile,
        gone=gone,
        stop_at_first_failure=stop_at_first_failure,
        open_page=open_page,
    )


def split_words(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Divide arguments into scenes or folders, and options of Snakemake with their values.

    Raises NoSuchOption for an option that neither knows, and UserError where Snakemake cannot read a value.
    """
    if not any(word.startswith("-") for word in words):
        return list(words), []
    from snakemake_logger_plugin_nishiki.arguments import parse_words

    context = click.get_current_context()
    known = [name for each in context.command.params for name in each.opts if name.startswith("--")]
    try:
        targets = parse_words(words)
    except LookupError as unknown:
        name, others = unknown.args
        raise click.NoSuchOption(name, possibilities=[*known, *others], ctx=context) from None
    passed = list(words)[::-1]
    for target in targets:  # of equal words the last is the target, those before it may be values
        passed.remove(target)
    return targets, [word for word in passed[::-1] if word != "--"]


def run_scenes(
    configfile: str,
    scenes: Sequence[str] = (),
    passed: Sequence[str] = (),
    *,
    cores: str | None = None,
    profile: str = "default",
    gone: Sequence[str] = (),
    stop_at_first_failure: bool = False,
    open_page: bool = False,
) -> int:
    """Run the workflow on scenes, or on all of the configuration; the plan is checked first; the exit status.

    A scene that cannot be planned, or fails, does not stop the others; the exit status is 1 then.
    """
    from nishiki.commands.engine import LOOKS_ONLY, call_engine, names_targets
    from nishiki.commands.inspecting import expect_packages
    from nishiki.commands.results import page_of, write_index
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow

    values = load_yaml(Path(configfile))
    flow = Workflow(values, only=scenes, file=configfile, leave_out_refused=not stop_at_first_failure)
    for message in list(flow.refused.values())[:NAMED]:
        print(f"nishiki run: left out: {message}", file=sys.stderr)
    expect_packages(flow)
    by_name = declare.profile_arguments(profile, cores, (map(Path, flow.artifacts(scene)) for scene in flow.plans))
    targets_named = names_targets(passed, load_yaml(declare.profile_folder(profile) / "config.yaml"))
    # Snakemake hears of unfinished scenes by itself; where it decides, the named scenes are its targets.
    targets = [f"{flow.results}/{scene}/current/index.json" for scene in flow.plans] if scenes else []
    options = [
        *by_name,
        *([] if stop_at_first_failure else ["--keep-going"]),
        *passed,
        *(["--", *targets] if targets_named or LOOKS_ONLY & set(passed) else []),
    ]
    if not LOOKS_ONLY & set(passed):
        _announce(flow)
    start = time.monotonic()
    failures: list[dict[str, str]] = []
    status = call_engine(
        flow, options, configfile=configfile, gone=gone, unfinished_only=not targets_named, failures=failures
    )
    status = status or (1 if flow.refused else 0)
    if not LOOKS_ONLY & set(passed):
        seconds = time.monotonic() - start
        whole = Workflow(values, file=configfile, leave_out_refused=True) if scenes else flow
        page = write_index(whole, {failure["scene"]: f"{failure['name']}: {failure['why']}" for failure in failures})
        if len(flow.plans) + len(flow.refused) > 1:
            print(f"all scenes: {page}")
        elif open_page and not status:
            with contextlib.suppress(UserError):  # products without a page: that of all scenes is opened
                page = page_of(flow, next(iter(flow.plans)), first="report.html")
        if status:
            _tell_unfinished(flow, seconds, failures)
        else:
            _tell(flow, seconds)
        if open_page:
            webbrowser.open(page.resolve().as_uri())
    return status if status in (0, 2) else 1  # 2: Snakemake does not know an option


def _announce(flow) -> None:
    """Tell of each scene that is not finished what it is and how long it is expected to take."""
    from nishiki.commands.inspecting import describe_capture, duration

    for scene, plan in list(flow.plans.items())[:NAMED]:
        stages = [stage for stage in plan.stages if not Path(flow.artifact(scene, stage)).is_file()]
        if stages:
            seconds = duration(sum(flow.seconds(scene, stage) for stage in stages))
            about = describe_capture(plan.facts)
            text = f"{scene}: {about}; {len(stages)} stages to run, about {seconds} of one processor"
            print(text, file=sys.stderr, flush=True)


def _tell(flow, seconds: float) -> None:
    from nishiki.commands.results import VIEWERS

    for scene in flow.plans:
        current = Path(flow.results, scene, "current")
        pages = [current / name for name in ("report.html", *VIEWERS) if (current / name).is_file()]
        if current.exists():  # not where only some of its artifacts were asked for
            print(f"{scene}: {', '.join(map(str, pages)) or current}")
    print(f"done in {seconds:.1f} s")


def _tell_unfinished(flow, seconds: float, failures: list[dict[str, str]]) -> None:
    """Print which scenes a failed run has not finished, where each stands, and why."""
    from nishiki.engine.finished import reason_to_run

    next_of, failed = {}, {failure["scene"] for failure in failures}
    for scene, plan in flow.plans.items():
        missing = [stage for stage in plan.stages if not Path(flow.artifact(scene, stage)).is_file()]
        if missing:
            next_of[scene] = missing[0]
        elif scene in failed and reason_to_run(flow, scene):
            next_of[scene] = "publish"
    named = [f"{scene} (at {stage})" for scene, stage in next_of.items()] + list(flow.refused)
    total = len(flow.plans) + len(flow.refused)
    done = f"after {seconds:.1f} s {total - len(named)} of {total} scenes are finished; not: {_some(named, ', ')}"
    if not named:
        done = f"the run failed after {seconds:.1f} s, for the reason that stands above"
    print(f"{done}. Finished results are kept; the same command continues from there", file=sys.stderr)
    why = {failure["name"]: failure for failure in failures if failure["scene"] in next_of or not failure["scene"]}
    lines = [f"  {name}: {failure['why']} (log: {failure['log']})" for name, failure in why.items()]
    lines += [f"  {message}" for message in flow.refused.values()]
    if lines:
        print(f"failed:\n{_some(lines, chr(10))}", file=sys.stderr)


def _some(texts: list[str], between: str) -> str:
    """Name the first of some texts, and the number of the others."""
    more = f"{between}and {len(texts) - NAMED} more" if len(texts) > NAMED else ""
    return between.join(texts[:NAMED]) + more


DEMOS = {
    "painting": ("painting", "config/config.yaml", "a simulated painting: 40 to 70 s of processor time"),
    "jar": ("object", "config/object.yaml", "a simulated jar, 36 views on a turntable: 5 to 8 min of processor time"),
    "satin": ("satin", "config/cloth.yaml", "a simulated satin, 5,940 photographs: three minutes of processor time"),
    "rig": ("painting", "config/painting_by_rig.yaml", "a simulated dome and painting: 40 to 70 s of processor time"),
}
"""Preset of the simulator, configuration, and the text printed beforehand; times with compiled kernels."""


@declare.command("demo", "demo --object", "demo --cloth", passed_on=True)
@declare.option("--object", "simulate a jar on a turntable instead", "jar")
@declare.option("--cloth", "simulate a satin on a gonioreflectometer instead", "satin")
@declare.option("--rig", "let a simulated dome take the photographs of the painting (needs the extra rig)", "dome")
@click.argument("rest", nargs=-1, type=click.UNPROCESSED, metavar="[SNAKEMAKE OPTION]...")
def demo(jar: bool, satin: bool, dome: bool, rest: tuple[str, ...]) -> int:
    """Simulate a painting, digitise it and name its report.

    Photographs and results are written to the folder of the checkout; an installed package makes the folder
    nishiki-demo where it is called. What is there already is used again.
    """
    if jar + satin + dome > 1:
        raise click.UsageError("--object, --cloth and --rig: only one is allowed.")
    name = "jar" if jar else "satin" if satin else "painting"
    preset, configuration, told = DEMOS["rig" if dome else name]
    print(f"nishiki demo: {told}, more where kernels have to be compiled first", file=sys.stderr, flush=True)
    folder = Path("nishiki-demo").absolute() if INSTALLED else PROJECT
    if not (folder / "config").is_dir():
        shutil.copytree(PROJECT / "config", folder / "config")
    print(f"configuration, photographs and results: {folder}", file=sys.stderr)
    os.chdir(folder)
    capture, truth = Path(f"captures/{name}"), Path(f"captures/{name}-truth")
    if not capture.is_dir() or not truth.is_dir():
        status = call_simulator("--output", str(capture), "--truth", str(truth), "--preset", preset)
        if status:
            return status
    if dome:
        status = photograph_by_rig(capture, Path("captures/rig"), Path("captures/painting-by-rig"))
        if status:
            return status
    return run_scenes(configuration, passed=rest)


def photograph_by_rig(by_hand: Path, folder: Path, capture: Path) -> int:
    """Photograph the painting through a simulated dome, with the commands that a real dome is used with.

    Parameters
    ----------
    by_hand : Path
        The simulated capture whose photographs the simulated camera takes.
    folder : Path
        Folder of the rig: its description, the plan, the serial port and the folder of the camera's software. Kept, so
        that both files can be read as examples.
    capture : Path
        Capture folder to make; one that is there is kept.

    Returns
    -------
    int
        Exit status of the capture run.
    """
    if capture.is_dir():
        return 0
    from nishiki.simulate.rig.bench import PaintingBench, run_at_terminal, write_rig

    bench = PaintingBench(by_hand, folder)
    try:
        rig, plan = write_rig(bench, by_hand, folder)
        arguments = ["rig", "run", str(rig), str(plan), str(capture)]
        print(f"nishiki {' '.join(arguments)}", file=sys.stderr)
        return run_at_terminal([sys.executable, "-m", "nishiki", *arguments], bench.obey)
    finally:
        bench.close()


@declare.command(
    "simulate --output captures/small --truth captures/small-truth --preset tiny", passed_on=True, add_help_option=False
)
@click.argument("rest", nargs=-1, type=click.UNPROCESSED)
def simulate(rest: tuple[str, ...]) -> int:
    """Photograph a simulated painting, object or cloth, and keep the truth apart."""
    return call_simulator(*rest)


def call_simulator(*words: str) -> int:
    """Run the simulator in a process of its own; its exit status."""
    return subprocess.run([sys.executable, str(SCRIPTS / "simulate.py"), *words], check=False).returncode
