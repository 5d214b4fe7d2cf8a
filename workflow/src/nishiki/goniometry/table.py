"""Hold measured reflectances of cloths, and store them in `reflectance.npz` and `reflectance.json`."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.declaration import Output, convert_to_declared
from nishiki.errors import UserError
from nishiki.formats.files import read_json
from nishiki.formats.stored import load_arrays
from nishiki.goniometry.directions import Symmetry, angles
from nishiki.goniometry.interpolation import coefficients, evaluate

NORMAL_DEG = 1.0


@dataclass(frozen=True)
class BasicReflectance:
    """BRDF at normal incidence over the whole view hemisphere, on a regular grid."""

    theta: np.ndarray  # (nt,) float64, radians, 0 to pi/2 in equal steps, both included
    phi: np.ndarray  # (np,) radians, 0 to 2 pi in equal steps, the last excluded, an even number
    values: np.ndarray  # (regions, nt, np, channels) float64, sr^-1, positive
    # (nt, np) bool: a measured direction, or its mirror image, lies within the cell; False: interpolated
    measured: np.ndarray
    # (nt, np) bool: no measured direction farther out in its azimuth (grazing views)
    extrapolated: np.ndarray | None = None

    def evaluate(self, outgoing: np.ndarray, region: int = 0) -> np.ndarray:
        """Evaluate the BRDF (..., channels) float64, sr^-1, at unit vectors (..., 3); 0 below the horizon.

        Bicubic spline of the logarithm, periodic in phi, continued through the pole: positive and smooth everywhere.
        """
        return evaluate(self._coefficients[region], np.asarray(outgoing, np.float64))

    @cached_property
    def _coefficients(self) -> tuple[np.ndarray, ...]:
        return tuple(coefficients(values) for values in self.values)


@dataclass(frozen=True)
class ReflectanceSet:
    """Measurements of a goniometer: one BRDF value for each pair of directions, region and channel.

    incident, outgoing (n, 3) float64: unit vectors away from the cloth, x weft, y warp, z normal; values
    (n, regions, channels) float64, sr^-1, 0 where not valid; noise: likewise, standard deviation of the mean, 0 where
    unknown; valid (n, regions) bool; threads_per_cm: of warp and weft, None where they were not counted; basic: the
    normal-incidence part on the hemisphere, None until it is made (see `hemisphere.complete`).
    """

    incident: np.ndarray
    outgoing: np.ndarray
    values: np.ndarray
    noise: np.ndarray
    valid: np.ndarray
    regions: tuple[str, ...]
    channels: tuple[str, ...]
    symmetry: Symmetry = "quarter"
    weave: str = "unknown"
    threads_per_cm: Sequence[float] | None = None
    normal_deg: float = NORMAL_DEG
    basic: BasicReflectance | None = field(default=None, repr=False)

    @classmethod
    def of(cls, incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray, **known) -> "ReflectanceSet":
        """Build a set from arrays; values (n,), (n, channels) or (n, regions, channels), the rest by default.

        known: any other field. Directions are normalised. ValueError where shapes disagree or values are not finite.
        """
        incident, outgoing = np.asarray(incident, np.float64), np.asarray(outgoing, np.float64)
        for directions in (incident, outgoing):
            length = np.linalg.norm(directions, axis=-1)
            if directions.ndim != 2 or directions.shape[1] != 3 or not (np.isfinite(length) & (length > 0)).all():
                raise ValueError(f"expected unit vectors (n, 3), found an array {directions.shape}")
        incident, outgoing = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (incident, outgoing))
        values = np.asarray(values, np.float64)
        values = values[:, None, None] if values.ndim == 1 else values[:, None, :] if values.ndim == 2 else values
        if incident.shape != outgoing.shape or incident.shape[0] != values.shape[0] or not np.isfinite(values).all():
            raise ValueError(f"directions {incident.shape}, {outgoing.shape} and finite values {values.shape} needed")
        _, regions, channels = values.shape
        names = ("grey",) if channels == 1 else ("red", "green", "blue") if channels == 3 else ()
        filled = {
            "noise": np.zeros_like(values),
            "valid": np.ones(values.shape[:2], bool),
            "regions": ("cloth",) if regions == 1 else tuple(f"region {i + 1}" for i in range(regions)),
            "channels": names or tuple(f"channel {i + 1}" for i in range(channels)),
        }
        return cls(incident, outgoing, values, **{**filled, **known})

    def __len__(self) -> int:
        return len(self.incident)

    @property
    def normal_incidence(self) -> np.ndarray:
        """(n,) bool: lit along the normal, within normal_deg."""
        return angles(self.incident)[0] < np.radians(self.normal_deg)

    def take(self, chosen: np.ndarray | slice) -> "ReflectanceSet":
        """Select measurements (indices, (n,) bool, or a slice); `basic` is kept, for it may be of all."""
        rows = {name: getattr(self, name)[chosen] for name in ROWS}
        rest = {item.name: getattr(self, item.name) for item in fields(ReflectanceSet) if item.name not in ROWS}
        return ReflectanceSet(**rows, **rest)

    @property
    def spacing_ratio(self) -> float | None:
        """Spacing of the weft yarns over that of the warp yarns, where the threads were counted."""
        return None if self.threads_per_cm is None else self.threads_per_cm[0] / self.threads_per_cm[1]


ARRAYS, NAMES = "reflectance.npz", "reflectance.json"
FORMAT = 1  # of the file; readers refuse others
ROWS = ("incident", "outgoing", "values", "noise", "valid")
GRID = ("theta", "phi", "values", "measured", "extrapolated")


def write_reflectances(
    folder: Path, outputs: Iterable[Output], measured: ReflectanceSet, *, more: dict[str, Any] | None = None
) -> None:
    """Write both files into the folder, arrays as declared; more: further entries of the JSON file."""
    arrays = {name: getattr(measured, name) for name in ROWS}
    if measured.basic is not None:
        arrays |= {f"basic_{name}": getattr(measured.basic, name) for name in GRID}
    np.savez(folder / ARRAYS, **convert_to_declared(outputs, arrays))
    names = {
        "format": FORMAT,
        "regions": list(measured.regions),
        "channels": list(measured.channels),
        "symmetry": measured.symmetry,
        "weave": measured.weave,
        "threads_per_cm": measured.threads_per_cm,
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
            threads_per_cm=names.get("threads_per_cm"),
            normal_deg=names["normal_deg"],
            basic=basic,
        )
        object.__setattr__(self, "details", names)
