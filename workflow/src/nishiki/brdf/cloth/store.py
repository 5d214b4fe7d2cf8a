"""A BRDF in one `.npz` file: its kind, and its arrays; no pickle, the same bytes for the same numbers."""

import io
import zipfile
from importlib import import_module
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.stored import load_arrays

KINDS = {  # where the class of a kind is
    "bard_linear": "nishiki.brdf.cloth.bard:LinearBard",
    "bard_great_circle": "nishiki.brdf.cloth.bard:GreatCircleBard",
    "bard_scaled": "nishiki.brdf.cloth.bard:ScaledBard",
    "facets": "nishiki.brdf.cloth.facets:FacetBrdf",
    "yarn_facets": "nishiki.brdf.cloth.yarn_facets:YarnFacets",
    "weave": "nishiki.weave.brdf:WeaveBrdf",
    "ward": "nishiki.brdf.cloth.peers:Ward",
    "ashikhmin_shirley": "nishiki.brdf.cloth.peers:AshikhminShirley",
    "ggx": "nishiki.brdf.cloth.peers:Ggx",
    "table": "nishiki.brdf.cloth.table:TableBrdf",
    "dyed": "nishiki.brdf.cloth.dye:Dyed",
}
_KIND = "kind"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # of every member: a file's bytes do not depend on when it was written


def class_of(kind: str) -> type:
    """The dataclass of a kind of BRDF."""
    if kind not in KINDS:
        raise UserError(f"kind of BRDF: expected one of {', '.join(sorted(KINDS))}, found {kind!r}")
    module, name = KINDS[kind].split(":")
    return getattr(import_module(module), name)


def save_brdf(path: Path, brdf) -> None:
    """Write a reflection model of a cloth to a `.npz` file.

    The same numbers give the same bytes; nothing is pickled.

    Parameters
    ----------
    path : str or Path
        File to write; one that exists is replaced.
    brdf : ClothBrdf
        Model, from `nishiki.fit_cloth` for example.

    Raises
    ------
    OSError
        Where the file cannot be written.

    See Also
    --------
    read_cloth : Reads it back.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> cloth = nishiki.read_cloth("results/satin/current/brdf.npz")
    >>> nishiki.write_cloth("cloth.npz", cloth)
    >>> again = nishiki.read_cloth("cloth.npz")
    >>> light, view = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.0, 1.0])
    >>> bool((again.evaluate(light, view) == cloth.evaluate(light, view)).all())
    True
    """
    arrays = {_KIND: np.array(brdf.KIND), **brdf.as_arrays()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(arrays):
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(arrays[name], order="C"), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), member.getvalue(), zipfile.ZIP_DEFLATED)


def load_brdf(path: Path):
    """Read a reflection model of a cloth: a result of the stage cloth_brdf, or what `nishiki.write_cloth` wrote.

    Parameters
    ----------
    path : str or Path
        The `.npz` file.

    Returns
    -------
    ClothBrdf
        Its method `evaluate(incident, outgoing)` takes unit vectors (..., 3), x weft, y warp, z normal, and gives the
        bidirectional reflectance in 1 / sr, (..., channels) float64.

    Raises
    ------
    nishiki.errors.UserError
        Where the file is missing, damaged, or holds no such model.

    See Also
    --------
    fit_cloth : Fits a model to measurements.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> cloth = nishiki.read_cloth("results/satin/current/brdf.npz")
    >>> lights, view = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]), np.array([0.0, 0.0, 1.0])
    >>> values = cloth.evaluate(lights, view)
    >>> values.shape == (2, cloth.channels)
    True
    """
    arrays = load_arrays(path, name=f"{path}: expected a stored BRDF (.npz)")
    if _KIND not in arrays:
        raise UserError(f"{path}: expected a stored BRDF with its kind, found arrays {sorted(arrays)}")
    return class_of(str(arrays.pop(_KIND))).from_arrays(arrays)
