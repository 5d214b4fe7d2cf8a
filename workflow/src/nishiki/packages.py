"""Heavy packages: their modules, the extras that install them, and which of them this process has loaded."""

import importlib
import sys
from importlib.util import find_spec
from types import ModuleType

from nishiki.errors import UserError
from nishiki.installation import INSTALLED

PACKAGES = {
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
MODULES = {name: module for name, (module, _, _) in PACKAGES.items()}
EXTRAS = {name: extra for name, (_, extra, _) in PACKAGES.items() if extra}
PURPOSE = {name: purpose for name, (_, extra, purpose) in PACKAGES.items() if extra}
PARTS_OF_SCIPY = ("fft", "interpolate", "io", "ndimage", "optimize", "sparse", "spatial", "special", "stats")


def loaded() -> tuple[str, ...]:
    """Heavy packages that this process has loaded.

    scipy counts where a part of it is there that we call: numba takes scipy.linalg for itself, whatever it compiles.
    """
    present = {name: module in sys.modules for name, module in MODULES.items()}
    present["scipy"] = any(f"scipy.{part}" in sys.modules for part in PARTS_OF_SCIPY)
    return tuple(sorted(name for name, there in present.items() if there))


def installed(package: str) -> bool:
    """Whether a package can be imported; nothing of it is loaded."""
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
