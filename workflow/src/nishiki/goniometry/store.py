"""Reflectances on disk: `reflectance.npz`, the arrays, and `reflectance.json`, their names."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.files import read_json
from nishiki.formats.stored import load_arrays
from nishiki.goniometry.table import BasicReflectance, ReflectanceSet

ARRAYS, NAMES = "reflectance.npz", "reflectance.json"
FORMAT = 1
ROWS = ("incident", "outgoing", "values", "noise", "valid")
GRID = ("theta", "phi", "values", "measured", "extrapolated")


def write_reflectances(folder: Path, measured: ReflectanceSet, *, more: dict[str, Any] | None = None) -> None:
    """Write both files into the folder; more: further entries of the JSON file, finite plain values."""
    arrays = {name: getattr(measured, name) for name in ROWS}
    if measured.basic is not None:
        arrays |= {f"basic_{name}": getattr(measured.basic, name) for name in GRID}
    np.savez(folder / ARRAYS, **arrays)
    names = {
        "format": FORMAT,
        "regions": list(measured.regions),
        "channels": list(measured.channels),
        "symmetry": measured.symmetry,
        "weave": measured.weave,
        "normal_deg": measured.normal_deg,
    }
    text = json.dumps({**names, **(more or {})}, indent=1, sort_keys=True, allow_nan=False)
    (folder / NAMES).write_text(text + "\n")


class Reflectances(ReflectanceSet):
    """The reflectances of an artifact: a ReflectanceSet read from its folder; `details` holds the whole JSON file."""

    def __init__(self, folder: Path | str):
        """Read `reflectance.npz` and `reflectance.json`. UserError where they are missing or of another format."""
        folder = Path(folder)
        try:
            names, arrays = read_json(folder / NAMES), load_arrays(folder / ARRAYS)
        except UserError as e:
            raise UserError(f"{folder}: no reflectances that can be read here ({e}); run reflectance first") from e
        if names.get("format") != FORMAT:
            stored = names.get("format")
            raise UserError(f"{folder}: reflectances of format {stored}, expected {FORMAT}; run reflectance again")
        basic = (
            BasicReflectance(**{name: arrays[f"basic_{name}"] for name in GRID}) if "basic_theta" in arrays else None
        )
        super().__init__(
            **{name: arrays[name] for name in ROWS},
            regions=tuple(names["regions"]),
            channels=tuple(names["channels"]),
            symmetry=names["symmetry"],
            weave=names["weave"],
            normal_deg=names["normal_deg"],
            basic=basic,
        )
        object.__setattr__(self, "details", names)
