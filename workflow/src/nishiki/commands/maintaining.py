"""Commands for the installation: install, test, compile, completion."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from nishiki.commands.declare import command, option
from nishiki.errors import UserError
from nishiki.installation import INSTALLED, PROJECT

TINY = {"plane": "tiny", "turntable": "object-tiny", "goniometer": "satin-tiny"}
"""A small simulated scene for each geometry."""
SMALL_PICTURES = """\
scenes: scenes.tsv
render: {sequences: [{name: moving-light, frames: 2, columns: 48}]}
object_render: {views: 4, between: 1, film: {frames_per_step: 1, columns: 48, supersampling: 1}}
cloth_render: {view: {rows: 48, columns: 48}, supersampling: 1}
"""
"""Configuration of runs that only compile kernels."""


@command("install", "install --extras rig export", "install --all")
@option("--extras EXTRA...", "raw, video, mesh, rig, export, slurm; beside what is installed")
@option("--least", "install no extras")
@option("--all", "install every extra but slurm, and the tools for tests and documentation", "everything")
def install(**options) -> None:
    """Install the packages of a checkout again, or add extras."""
    how = "pip install 'nishiki[EXTRA]'" if INSTALLED else f"{PROJECT / 'nishiki'} install"
    raise UserError(f"the launcher of a checkout installs, or pip. Remedy: {how}")


@command("test --quick", "test tests/unit -k spectra", passed_on=True)
@option("--quick", "leave out the tests that are marked slow or long")
@option("--long", "also run long fuzzing, the campaign of faults, Slurm and many scenes")
@click.argument("rest", nargs=-1, type=click.UNPROCESSED, metavar="[PYTEST ARGUMENT]...")
def test(quick: bool, long: bool, rest: tuple[str, ...]) -> int:
    """Run the tests of a checkout with pytest."""
    if quick and long:
        raise click.UsageError("--quick and --long are not allowed together; choose one.")
    if INSTALLED:
        raise UserError("an installed package has no tests. Remedy: call the launcher of a checkout of the project")
    try:
        import pytest  # noqa: F401
    except ImportError:
        raise UserError("pytest is not installed; remove .venv and call ./nishiki test again") from None
    install_for_meshlab()
    tier = [option for option, given in (("--quick", quick), ("--long", long)) if given]
    words = rest or ("-n", str(min(os.cpu_count() or 1, 4)), "--dist", "loadfile", "--no-loadscope-reorder")
    return subprocess.run([sys.executable, "-m", "pytest", *tier, *words], cwd=PROJECT, check=False).returncode


@command("compile", name="compile")
@option("--plane", "only what paintings need")
def compile_kernels(plane: bool) -> int:
    """Compile all kernels ahead, by running tiny simulated scenes in a temporary folder; two to three minutes."""
    from nishiki.installation import installed

    # The simulated object needs the extra mesh; whoever installs without it digitises no objects.
    scenes = {name: preset for name, preset in TINY.items() if name != "turntable" or installed("scikit-image")}
    scenes = {"plane": "tiny"} if plane else scenes
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


@command("completion bash >> ~/.bashrc", "completion fish > ~/.config/fish/completions/nishiki.fish")
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")), help="the shell")
def completion(shell: str) -> None:
    """Print the script with which a shell completes commands, options and names of scenes."""
    from click.shell_completion import BashComplete, FishComplete, ZshComplete

    root = click.get_current_context().find_root().command
    form = {"bash": BashComplete, "zsh": ZshComplete, "fish": FishComplete}[shell]
    print(form(root, {}, "nishiki", "_NISHIKI_COMPLETE").source())


def install_for_meshlab() -> None:
    """Install the system libraries that pymeshlab's filters need, where that is allowed: as root on Debian or Ubuntu.

    Elsewhere, or where it fails, a message names the command; the tests that need the filters are then skipped.
    """
    from nishiki.geometry.scans import APT_LINE, missing_filters

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
