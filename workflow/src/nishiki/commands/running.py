"""Commands that run something: the workflow, the demonstration, the simulator, the tests."""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from nishiki.errors import UserError
from nishiki.installation import INSTALLED, PROFILES, PROJECT, SCRIPTS, SNAKEFILE

DEMOS = {
    "painting": ("painting", "config/config.yaml"),
    "jar": ("object", "config/object.yaml"),
    "satin": ("satin", "config/cloth.yaml"),
    "painting-by-rig": ("painting", "config/painting_by_rig.yaml"),
}
NAMED = 20
"""Scenes that are told by name: unfinished ones, failed ones."""
TINY = {"plane": "tiny", "turntable": "object-tiny", "goniometer": "satin-tiny"}
"""A small simulated scene for each geometry."""


SMALL_PICTURES = """\
scenes: scenes.tsv
render: {sequences: [{name: moving-light, frames: 2, columns: 48}]}
object_render: {views: 4, between: 1, film: {frames_per_step: 1, columns: 48, supersampling: 1}}
cloth_render: {view: {rows: 48, columns: 48}, supersampling: 1}
"""
"""Configuration of runs of which only the compiled kernels are wanted."""


def run(options: argparse.Namespace, rest: list[str]) -> int:
    """Run the workflow on the configuration; the plan is checked first, so that bad input is told in one line.

    A scene that cannot be planned, or fails, does not stop the others; the exit status is 1 then.
    """
    from nishiki.commands.engine import LOOKS_ONLY, call_engine, names_targets
    from nishiki.commands.planning import expect_packages
    from nishiki.commands.viewing import write_index
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow

    values = load_yaml(options.configfile)
    flow = Workflow(values, file=options.configfile, leave_out_refused=not options.stop_at_first_failure)
    for message in list(flow.refused.values())[:NAMED]:
        print(f"nishiki run: left out: {message}", file=sys.stderr)
    expect_packages(flow)
    command = [
        sys.executable,
        "-m",
        "snakemake",
        "--snakefile",
        str(SNAKEFILE),
        "--configfile",
        options.configfile,
        *profile_arguments(options.profile, options.cores, (map(Path, flow.artifacts(scene)) for scene in flow.plans)),
        *([] if options.stop_at_first_failure else ["--keep-going"]),
        *rest,
    ]
    start = time.monotonic()
    targets_named = names_targets(rest, load_yaml(profile_folder(options.profile) / "config.yaml"))
    failures: list[dict[str, str]] = []
    status = call_engine(flow, command, gone=options.host_is_gone, unfinished_only=not targets_named, failures=failures)
    status = status or (1 if flow.refused else 0)
    if not LOOKS_ONLY & set(rest):
        seconds = time.monotonic() - start
        index = write_index(flow, {failure["scene"]: f"{failure['name']}: {failure['why']}" for failure in failures})
        if len(flow.plans) + len(flow.refused) > 1:
            print(f"all scenes: {index}")
        if status:
            _tell_unfinished(flow, seconds, failures)
        else:
            _tell(flow, seconds)
    return status if status in (0, 2) else 1  # 2: Snakemake does not know an option


def profile_arguments(name: str, cores: str | None, scenes: Iterable[Iterable[Path]] = ()) -> list[str]:
    """Snakemake's arguments for a shipped profile or a profile folder, and for what a local one may use of the machine.

    scenes: manifests of each scene's artifacts, where stages may get one thread each so that scenes run side by side.

    Raises UserError where there is no such profile, or where the plugin that it needs is not installed.
    """
    import importlib.util

    from nishiki.engine.machine import memory_arguments, thread_arguments
    from nishiki.engine.project import load_yaml
    from nishiki.packages import install_extras

    folder = profile_folder(name)
    if not (folder / "config.yaml").is_file():
        known = ", ".join(sorted(path.name for path in PROFILES.iterdir()))
        raise UserError(f"--profile {name}: no such profile; known: {known}, or a folder that holds a config.yaml")
    arguments = ["--workflow-profile", str(folder)]
    executor = str(load_yaml(folder / "config.yaml").get("executor", "local"))
    if executor != "local":
        plugin = f"snakemake_executor_plugin_{executor.replace('-', '_')}"
        if importlib.util.find_spec(plugin) is None:
            raise UserError(
                f"--profile {name}: the plugin for {executor} is not installed. Remedy: {install_extras(executor)}"
            )
        return arguments + (["--cores", cores] if cores else [])
    return [*arguments, *memory_arguments(), *thread_arguments(cores, scenes), "--cores", cores or "all"]


def profile_folder(name: str) -> Path:
    """Folder of a shipped profile, or the folder that is named."""
    return PROFILES / name if (PROFILES / name).is_dir() else Path(name)


def _tell(flow, seconds: float) -> None:
    from nishiki.commands.viewing import VIEWERS

    for scene in flow.plans:
        current = Path(flow.results, scene, "current")
        pages = [current / name for name in ("report.html", *VIEWERS) if (current / name).is_file()]
        if current.exists():  # not where only some of its artifacts were asked for
            print(f"{scene}: {', '.join(map(str, pages)) or current}")
    print(f"done in {seconds:.1f} s")


def _tell_unfinished(flow, seconds: float, failures: list[dict[str, str]]) -> None:
    """Which scenes a run that failed has not finished, where each stands, and why."""
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
    """The first of some texts, and how many there are beside them."""
    more = f"{between}and {len(texts) - NAMED} more" if len(texts) > NAMED else ""
    return between.join(texts[:NAMED]) + more


def demo(options: argparse.Namespace, rest: list[str]) -> int:
    """Simulate the painting, object or cloth, where it is not there yet; then run the configuration.

    With --rig the painting is photographed once more, through a simulated dome, and that capture is digitised.

    In the folder of the checkout; an installed package makes the folder `nishiki-demo` where it is called.
    """
    os.chdir(demo_folder() if INSTALLED else PROJECT)
    name = "jar" if options.object else "satin" if options.cloth else "painting"
    preset, configuration = DEMOS["painting-by-rig" if options.rig else name]
    capture, truth = Path(f"captures/{name}"), Path(f"captures/{name}-truth")
    if not capture.is_dir() or not truth.is_dir():
        status = simulate(options, ["--output", str(capture), "--truth", str(truth), "--preset", preset])
        if status:
            return status
    if options.rig:
        status = photograph_by_rig(capture, Path("captures/rig"), Path("captures/painting-by-rig"))
        if status:
            return status
    options = argparse.Namespace(
        configfile=configuration, cores=None, profile="default", host_is_gone=[], stop_at_first_failure=False
    )
    return run(options, rest)


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
        command = ["rig", "run", str(rig), str(plan), str(capture)]
        print(f"nishiki {' '.join(command)}", file=sys.stderr)
        return run_at_terminal([sys.executable, "-m", "nishiki", *command], bench.obey)
    finally:
        bench.close()


def demo_folder() -> Path:
    """The folder of an installed package's demonstrations; the configuration is copied where it is not there yet."""
    folder = Path("nishiki-demo").absolute()
    shutil.copytree(PROJECT / "config", folder / "config", dirs_exist_ok=True, copy_function=_copy_new)
    print(f"the demonstration's configuration, photographs and results: {folder}", file=sys.stderr)
    return folder


def _copy_new(source: str, target: str) -> None:
    """Copy a file where there is none yet."""
    if not os.path.lexists(target):
        shutil.copyfile(source, target)


def compile_kernels(options: argparse.Namespace, rest: list[str]) -> int:
    """Run tiny simulated scenes in a temporary folder: every kernel that they need is compiled and kept."""
    from nishiki.packages import installed

    # The simulated object needs the extra mesh; whoever installs without it digitises no objects.
    scenes = {name: preset for name, preset in TINY.items() if name != "turntable" or installed("scikit-image")}
    scenes = {"plane": "tiny"} if options.plane else scenes
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = "".join(f"{scene}\t{scene}\t{scene}-truth\n" for scene in scenes)
        (folder / "scenes.tsv").write_text("scene\tcapture\ttruth\n" + rows)
        (folder / "config.yaml").write_text(SMALL_PICTURES)
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        for arguments in (
            *(
                ["simulate", "--output", scene, "--truth", f"{scene}-truth", "--preset", preset]
                for scene, preset in scenes.items()
            ),
            # Compilation has one thread, stages ask for two: as many at a time as there are processors.
            ["run", "--configfile", "config.yaml", "--cores", str(2 * (os.cpu_count() or 1))],
        ):
            done = subprocess.run(
                [sys.executable, "-m", "nishiki", *arguments],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode:
                print(done.stdout + done.stderr, file=sys.stderr)
                return 1
    return 0


def simulate(options: argparse.Namespace, rest: list[str]) -> int:
    """Photograph a simulated painting."""
    return subprocess.run([sys.executable, str(SCRIPTS / "simulate.py"), *rest], check=False).returncode


def test(options: argparse.Namespace, rest: list[str]) -> int:
    """Run one tier of the tests with pytest; without further arguments, test files run side by side.

    tests/conftest.py says which tests belong to a tier.
    """
    if INSTALLED:
        raise UserError("an installed package has no tests. Remedy: call the launcher of a checkout of the project")
    try:
        import pytest  # noqa: F401
    except ImportError:
        raise UserError("pytest is not installed; remove .venv and call ./nishiki test again") from None
    install_for_meshlab()
    tier = [option for option, given in (("--quick", options.quick), ("--long", options.long)) if given]
    rest = rest or ["-n", str(min(os.cpu_count() or 1, 4)), "--dist", "loadfile", "--no-loadscope-reorder"]
    return subprocess.run([sys.executable, "-m", "pytest", *tier, *rest], cwd=PROJECT, check=False).returncode


def install_for_meshlab() -> None:
    """Install the system libraries that pymeshlab's filters need, where that is allowed: as root on Debian or Ubuntu.

    Elsewhere, or where it fails, a message names the command; the tests that need the filters are then skipped.
    """
    from nishiki.geometry.meshlab import APT_LINE, missing_filters

    if not missing_filters():
        return
    apt = shutil.which("apt-get")
    if apt and hasattr(os, "geteuid") and os.geteuid() == 0:
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        for arguments in (["update"], APT_LINE.split()[1:]):
            command = [apt, "-qq", "-y", *arguments]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return
        print(f"{APT_LINE} failed: {done.stderr.strip()}", file=sys.stderr)
    print(f"pymeshlab lacks filters, tests of range scans are skipped. Remedy: {APT_LINE}", file=sys.stderr)
