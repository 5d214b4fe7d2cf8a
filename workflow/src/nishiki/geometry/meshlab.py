"""MeshLab's filters, and whether all of those that are needed are there.

Without the system library libOpenGL, pymeshlab imports but lacks every filter of some of its plugins, without a word.
"""

from __future__ import annotations

from nishiki.errors import UserError
from nishiki.packages import optional

FILTERS = ("generate_surface_reconstruction_screened_poisson", "compute_normal_for_point_clouds")
"""Filters that this project calls."""
PACKAGES = ("libgl1", "libopengl0")
"""Debian packages that pymeshlab's plugins load libraries from."""
APT_LINE = f"apt-get install {' '.join(PACKAGES)}"


def missing_filters() -> tuple[str, ...]:
    """Names of the filters that are needed and not there; all of them where pymeshlab cannot be imported."""
    try:
        import pymeshlab
    except ImportError:
        return FILTERS
    mesh_set = pymeshlab.MeshSet()
    return tuple(name for name in FILTERS if not hasattr(mesh_set, name))


def mesh_set():
    """An empty pymeshlab.MeshSet. Raises UserError where the package or filters of it are missing."""
    pymeshlab = optional("pymeshlab")
    missing = missing_filters()
    if missing:
        raise UserError(
            f"pymeshlab lacks {', '.join(missing)}: its plugins need system libraries that are not installed. Remedy: "
            f"`{APT_LINE}` on Debian and Ubuntu (then start again), or give a finished mesh instead of scans"
        )
    return pymeshlab.MeshSet()
