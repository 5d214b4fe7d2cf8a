"""Heavy packages: their modules, the extras that install them, and which of them this process has loaded."""

import importlib
import sys
from importlib.util import find_spec
from types import ModuleType

from nishiki.errors import UserError
from nishiki.installation import INSTALLED

MODULES = {
    "OpenEXR": "OpenEXR",
    "av": "av",
    "colour-science": "colour",
    "dracopy": "DracoPy",
    "gphoto2": "gphoto2",
    "jinja2": "jinja2",
    "materialx": "MaterialX",
    "numba": "numba",
    "numpy": "numpy",
    "opencv-contrib-python-headless": "cv2",
    "pyarrow": "pyarrow",
    "pymeshlab": "pymeshlab",
    "pyserial": "serial",
    "pywavelets": "pywt",
    "rawpy": "rawpy",
    "scikit-image": "skimage",
    "scipy": "scipy",
    "trimesh": "trimesh",
    "usd-core": "pxr",
    "zarr": "zarr",
}
"""Package as it is installed, to the module that is imported."""
EXTRAS = {
    "rawpy": "raw",
    "av": "video",
    "trimesh": "mesh",
    "pymeshlab": "mesh",
    "scikit-image": "mesh",
    "gphoto2": "rig",
    "pyserial": "rig",
    "colour-science": "rig",
    "pyarrow": "export",
    "materialx": "export",
    "usd-core": "export",
}
"""Packages that are no part of the least installation, and the extra that brings them."""
PURPOSE = {
    "rawpy": "camera raw",
    "av": "video",
    "trimesh": "mesh files",
    "pymeshlab": "range scans",
    "scikit-image": "a surface from silhouettes",
    "colour-science": "a colour target",
    "pyarrow": "a Parquet file",
    "materialx": "a MaterialX document",
    "usd-core": "a USD file",
    "gphoto2": "a camera on USB",
    "pyserial": "a device on a serial line",
}
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
