"""A real Slurm on this machine (`start.sh`), and Snakemake's plugin for it in a folder of its own."""

import contextlib
import importlib.metadata
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
START = Path(__file__).with_name("start.sh")
CANNOT = 3  # exit status of start.sh where this machine cannot have a Slurm
QUICK = ("--slurm-init-seconds-before-status-checks", "2", "--latency-wait", "20")
"""Options of a run that a Slurm on this machine allows: it answers at once."""


class Unavailable(Exception):
    """This machine cannot have a Slurm, or not the plugin; the text says why."""


@contextlib.contextmanager
def cluster(folder: Path) -> Iterator[None]:
    """A running Slurm that keeps its state and logs in a folder. Raises Unavailable."""
    try:
        done = subprocess.run([START, folder], capture_output=True, text=True, check=False)
        if done.returncode:
            raise (Unavailable if done.returncode == CANNOT else RuntimeError)(done.stderr.strip())
        yield
    finally:
        subprocess.run([START, folder, "stop"], check=False)


def install_plugin(folder: Path) -> Path:
    """Snakemake's plugin for Slurm, in the locked versions, in a folder of its own; empty where it is installed.

    Not in the environment of the tests: every start of Snakemake, in every other test, would be a second slower. Raises
    Unavailable.
    """
    uv = PROJECT / ".uv/bin/uv"
    export = [uv, "export", "--locked", "--no-default-groups", "--no-hashes", "--no-header", "--no-annotate", "--quiet"]
    try:
        text = _output([*export, "--extra", "slurm"])
        missing = [line for line in text.splitlines() if "==" in line and not _installed(line.split("==")[0])]
        if missing:
            into = ["--python", sys.executable, "--target", folder]
            _output([uv, "pip", "install", "--quiet", "--no-deps", *into, *missing])
    except (OSError, subprocess.CalledProcessError) as error:
        told = getattr(error, "stderr", None) or error
        raise Unavailable(f"Snakemake's plugin for Slurm cannot be installed: {told}") from None
    return folder


def _output(command: list) -> str:
    return subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True).stdout


def _installed(name: str) -> bool:
    try:
        return bool(importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return False
