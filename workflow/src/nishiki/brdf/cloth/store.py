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
    """Write a BRDF to a `.npz` file."""
    arrays = {_KIND: np.array(brdf.KIND), **brdf.as_arrays()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(arrays):
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(arrays[name], order="C"), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), member.getvalue(), zipfile.ZIP_DEFLATED)


def load_brdf(path: Path):
    """Read a BRDF that `save_brdf` wrote; raises UserError where the file is none."""
    arrays = load_arrays(path, name=f"{path}: expected a stored BRDF (.npz)")
    if _KIND not in arrays:
        raise UserError(f"{path}: expected a stored BRDF with its kind, found arrays {sorted(arrays)}")
    return class_of(str(arrays.pop(_KIND))).from_arrays(arrays)
