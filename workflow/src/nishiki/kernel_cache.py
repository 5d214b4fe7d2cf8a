"""Where compiled kernels are kept: by the name of their module, so that copies of the project share them.

numba by itself keeps them by the path of the source file. It imports the class below by the name that the environment
variable NUMBA_CACHE_LOCATOR_CLASSES gives.
"""

from pathlib import Path

from numba.core.caching import UserProvidedCacheLocator

PACKAGE = Path(__file__).resolve().parent


class ByModule(UserProvidedCacheLocator):
    """A folder of NUMBA_CACHE_DIR for every module of this package; other functions are left to the next class."""

    @classmethod
    def from_function(cls, py_func, py_file):
        """The locator of a function of this package; None for others, and where no folder is given."""
        return super().from_function(py_func, py_file) if PACKAGE in Path(py_file).resolve().parents else None

    @classmethod
    def get_suitable_cache_subpath(cls, py_file):
        """Name of the folder: that of the module, `photometric.solve` for example."""
        return ".".join(Path(py_file).resolve().relative_to(PACKAGE).with_suffix("").parts)
