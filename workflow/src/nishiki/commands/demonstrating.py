"""Commands that simulate: the demonstrations, and captures of the simulator."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import click

from nishiki.commands.declare import command, option
from nishiki.installation import INSTALLED, PROJECT, SCRIPTS

DEMOS = {
    "painting": ("painting", "config/config.yaml", "a simulated painting: 40 seconds of processor time"),
    "jar": ("object", "config/object.yaml", "a simulated jar, 36 views on a turntable: five minutes of processor time"),
    "satin": ("satin", "config/cloth.yaml", "a simulated satin, 5,940 photographs: three minutes of processor time"),
    "rig": ("painting", "config/painting_by_rig.yaml", "a simulated dome and painting: 40 seconds of processor time"),
}
"""Preset of the simulator, configuration, and what is told beforehand; times with compiled kernels."""


@command("demo", "demo --object", "demo --cloth", passed_on=True)
@option("--object", "simulate a jar on a turntable instead", "jar")
@option("--cloth", "simulate a satin on a gonioreflectometer instead", "satin")
@option("--rig", "let a simulated dome take the photographs of the painting (needs the extra rig)", "dome")
@click.argument("rest", nargs=-1, type=click.UNPROCESSED, metavar="[SNAKEMAKE OPTION]...")
def demo(jar: bool, satin: bool, dome: bool, rest: tuple[str, ...]) -> int:
    """Simulate a painting, digitise it and name its report.

    Photographs and results are written to the folder of the checkout; an installed package makes the folder
    nishiki-demo where it is called. What is there already is used again.
    """
    from nishiki.commands.running import run_scenes

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
        command = ["rig", "run", str(rig), str(plan), str(capture)]
        print(f"nishiki {' '.join(command)}", file=sys.stderr)
        return run_at_terminal([sys.executable, "-m", "nishiki", *command], bench.obey)
    finally:
        bench.close()


@command(
    "simulate --output captures/small --truth captures/small-truth --preset tiny", passed_on=True, add_help_option=False
)
@click.argument("rest", nargs=-1, type=click.UNPROCESSED)
def simulate(rest: tuple[str, ...]) -> int:
    """Photograph a simulated painting, object or cloth, and keep the truth apart."""
    return call_simulator(*rest)


def call_simulator(*words: str) -> int:
    """Run the simulator in a process of its own; its exit status."""
    return subprocess.run([sys.executable, str(SCRIPTS / "simulate.py"), *words], check=False).returncode
