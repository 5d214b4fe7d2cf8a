"""Find the files of the project beside the package, and heavy packages: their modules and the extras for them.

A checkout has the package in `workflow/src/nishiki` and `Snakefile`, `workflow/rules`, `workflow/profiles`, `scripts`,
`config` and `envs` around it. An installed package (`pip install .`) carries copies of these in its folder `project`.
"""

import hashlib
import importlib
import os
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from nishiki.errors import UserError

PACKAGE = Path(__file__).resolve().parent
SOURCE = PACKAGE.parent
"""The folder on the path of Python that holds the package."""
PACKAGES = (PACKAGE.name, "snakemake_logger_plugin_nishiki")
"""Packages of the project in that folder; Snakemake finds its logger plugin by its name."""
CARRIED = PACKAGE / "project"
"""Copies of the project's files; only in an installation."""
INSTALLED = CARRIED.is_dir()
PROJECT = CARRIED if INSTALLED else PACKAGE.parents[2]
"""The folder that holds `Snakefile`, `workflow`, `scripts`, `config` and `envs`."""
SNAKEFILE = PROJECT / "Snakefile"
PROFILES = PROJECT / "workflow" / "profiles"
SCRIPTS = PROJECT / "scripts"
COMMAND = "nishiki" if INSTALLED else "./nishiki"
"""The command as a user types it, for messages."""


def cache_folder() -> Path | None:
    """Return the folder for compiled kernels and facts of source files; None where nothing may be written.

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


HEAVY = {
    "OpenEXR": ("OpenEXR", "", ""),
    "av": ("av", "video", "video"),
    "colour-science": ("colour", "rig", "a colour target"),
    "dracopy": ("DracoPy", "", ""),
    "gphoto2": ("gphoto2", "rig", "a camera on USB"),
    "jinja2": ("jinja2", "", ""),
    "materialx": ("MaterialX", "export", "a MaterialX document"),
    "numba": ("numba", "", ""),
    "numpy": ("numpy", "", ""),
    "opencv-contrib-python-headless": ("cv2", "", ""),
    "pyarrow": ("pyarrow", "export", "a Parquet file"),
    "pymeshlab": ("pymeshlab", "mesh", "range scans"),
    "pyserial": ("serial", "rig", "a device on a serial line"),
    "pywavelets": ("pywt", "", ""),
    "rawpy": ("rawpy", "raw", "camera raw"),
    "scikit-image": ("skimage", "mesh", "a surface from silhouettes"),
    "scipy": ("scipy", "", ""),
    "trimesh": ("trimesh", "mesh", "mesh files"),
    "usd-core": ("pxr", "export", "a USD file"),
    "zarr": ("zarr", "", ""),
}
"""Package as it is installed: the module that is imported, the extra that brings it where the least installation does
not, and what it is for then."""
MODULES = {name: module for name, (module, _, _) in HEAVY.items()}
EXTRAS = {name: extra for name, (_, extra, _) in HEAVY.items() if extra}
PURPOSE = {name: purpose for name, (_, extra, purpose) in HEAVY.items() if extra}
PARTS_OF_SCIPY = ("fft", "interpolate", "io", "ndimage", "optimize", "sparse", "spatial", "special", "stats")


def list_loaded() -> tuple[str, ...]:
    """List the heavy packages that this process has loaded.

    scipy counts where a part of it is there that we call: numba takes scipy.linalg for itself, whatever it compiles.
    """
    present = {name: module in sys.modules for name, module in MODULES.items()}
    present["scipy"] = any(f"scipy.{part}" in sys.modules for part in PARTS_OF_SCIPY)
    return tuple(sorted(name for name, there in present.items() if there))


def is_installed(package: str) -> bool:
    """Return whether a package can be imported; nothing of it is loaded."""
    return find_spec(MODULES.get(package, package).partition(".")[0]) is not None


def optional(package: str) -> ModuleType:
    """Import a package that an extra installs. Raises UserError with the command to install it where it is missing."""
    try:
        return importlib.import_module(MODULES[package])
    except ImportError:
        need = f"{PURPOSE[package]} needs the package {package}, which is not installed"
        raise UserError(f"{need}. Remedy: {install_command((package,))}") from None


def install_command(packages: tuple[str, ...]) -> str:
    """Return the command that installs the missing extras beside the present ones."""
    return install_extras(*sorted({EXTRAS[name] for name in packages}))


def install_extras(*extras: str) -> str:
    """Return the command that installs extras: the launcher of a checkout, or pip for an installed package."""
    if INSTALLED:
        return f"pip install 'nishiki[{','.join(extras)}]'"
    return f"./nishiki install --extras {' '.join(extras)}"
