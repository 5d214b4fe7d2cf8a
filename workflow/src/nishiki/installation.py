"""Where the files of the project are that the command needs beside the package: in a checkout, or in an installation.

A checkout has the package in `workflow/src/nishiki` and `Snakefile`, `workflow/rules`, `workflow/profiles`, `scripts`,
`config` and `envs` around it. An installed package (`pip install .`) carries copies of these in its folder `project`.
"""

import hashlib
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


def use_kernel_cache() -> None:
    """Give this state of the package's compiled modules its own folder of kernels; before numba is imported.

    numba renews a cached function when the function's own file changes, but not when a function that it inlines from
    another file does: an edit would rerun a stage with the old machine code.
    """
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", "nishiki.kernel_cache.ByModule,UserProvidedCacheLocator")
    folder = None if "NUMBA_CACHE_DIR" in os.environ else cache_folder()
    if folder is None:
        return
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_bytes()
        if b"numba" in text:
            digest.update(text)
    kernels = folder / digest.hexdigest()[:12]
    kernels.mkdir(parents=True, exist_ok=True)
    os.environ["NUMBA_CACHE_DIR"] = str(kernels)
