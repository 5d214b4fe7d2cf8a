"""Where the files of the project are that the command needs beside the package: in a checkout, or in an installation.

A checkout has the package in `workflow/src/nishiki` and `Snakefile`, `workflow/rules`, `workflow/profiles`, `scripts`,
`config` and `envs` around it. An installed package (`pip install .`) carries copies of these in its folder `project`.
"""

import os
import sys
import tempfile
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
SOURCE = PACKAGE.parent
"""The folder on the path of Python that holds the package."""
PACKAGES = (PACKAGE.name, "snakemake_logger_plugin_nishiki")
"""What of that folder is the project's; Snakemake finds its plugin for messages by its name."""
CARRIED = PACKAGE / "project"
"""Copies of the project's files; only in an installation."""
INSTALLED = CARRIED.is_dir()
PROJECT = CARRIED if INSTALLED else PACKAGE.parents[2]
"""The folder that holds `Snakefile`, `workflow`, `scripts`, `config` and `envs`."""
SNAKEFILE = PROJECT / "Snakefile"
PROFILES = PROJECT / "workflow" / "profiles"
SCRIPTS = PROJECT / "scripts"
COMMAND = "nishiki" if INSTALLED else "./nishiki"
"""How a user calls the command, for messages."""


def cache_folder() -> Path | None:
    """Folder for compiled kernels and what is known of source files; None where nothing may be written.

    `.kernels` of a checkout; in an installation `nishiki` below $XDG_CACHE_HOME, or below the system's usual place.
    """
    if not INSTALLED:
        return PROJECT / ".kernels" if os.access(PROJECT, os.W_OK) else None
    try:
        usual = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
        folder = Path(os.environ.get("XDG_CACHE_HOME") or usual) / "nishiki"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # RuntimeError: the user has no home
        return None
