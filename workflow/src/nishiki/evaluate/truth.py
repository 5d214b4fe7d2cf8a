"""What is known of an object apart from its capture: which of it can be compared."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nishiki.errors import UserError


@dataclass(frozen=True)
class CheckTruth:
    """Hold the noise-free colour (rows, columns, 3) under one check light.

    A white facing the lamp has Y = 1, with the lamp's own spectrum and with D65; gloss and body: (rows, columns) parts
    of it; lit: (rows, columns) share of the lamp, 0..1.
    """

    xyz_lamp: np.ndarray
    xyz_d65: np.ndarray
    gloss: np.ndarray
    body: np.ndarray
    lit: np.ndarray


@dataclass(frozen=True)
class Truth:
    """Any part may be None or empty."""

    normals: np.ndarray | None = None  # (rows, columns, 3), zero or NaN where unknown
    height_mm: np.ndarray | None = None  # (rows, columns)
    paints: np.ndarray | None = None  # (rows, columns, samples) integers into spectra (paints, 61)
    spectra: np.ndarray | None = None
    regions: np.ndarray | None = None  # (rows, columns), with names
    region_names: tuple[str, ...] = ()
    roughness: np.ndarray | None = None  # (paints,) GGX alpha
    checks: tuple[str, ...] = ()  # names of the lights whose colours are known
    arrays: Mapping[str, Any] | None = None
    lights: tuple[str, ...] = ()
    window: tuple[slice, slice] = (slice(None), slice(None))

    def check(self, light: str) -> CheckTruth | None:
        """Return truth of one check light, read when asked for; None where it is not known."""
        if light not in self.checks or self.arrays is None:
            return None
        at, names = self.checks.index(light), ("xyz_lamp", "xyz_d65", "gloss", "body")
        parts = {name: np.asarray(self.arrays[name][at])[self.window] for name in names}
        lit = np.asarray(self.arrays["lit"][self.lights.index(light)])[self.window].astype(np.float32) / 100.0
        return CheckTruth(**parts, lit=lit)

    def equivalent_gamma(self) -> tuple[float, float, float] | None:
        """Return half width at half maximum, radians, that the GGX facet distributions have: least, median, largest.

        D falls to half where tan(phi) = alpha sqrt(sqrt 2 - 1), leaving cos^4 aside (Walter et al., EGSR 2007, eq. 33).
        """
        alpha = None if self.roughness is None else self.roughness[self.roughness > 0]
        if alpha is None or not alpha.size:
            return None
        gamma = np.arctan(alpha * np.sqrt(np.sqrt(2.0) - 1.0))
        return float(gamma.min()), float(np.median(gamma)), float(gamma.max())


def truth_from(
    arrays: Mapping[str, Any],
    *,
    shape: tuple[int, int],
    attributes: Mapping[str, Any] | None = None,
    region: tuple[int, int, int, int] | None = None,
    asked: tuple[int, int, int, int] | None = None,
) -> Truth:
    """Truth from named arrays: those that docs/simulator.md lists, or `normals` alone.

    shape : (rows, columns) of the scene's maps; region : (row, column, rows, columns) of the scene in the photographs;
    asked : the region of interest of the capture, which holds that of the scene. A truth of the whole photograph or of
    the region of interest is cropped to the scene. Raises UserError where no size fits.
    """
    attributes = attributes or {}
    names = set(arrays)
    if "normals" not in names and "height_mm" not in names:
        found = ", ".join(sorted(names)) or "none"
        raise UserError(f"truth: expected an array named normals or height_mm, found {found}")
    window = _window(np.shape(arrays["normals" if "normals" in names else "height_mm"])[:2], shape, region, asked)

    def mapped(name: str) -> np.ndarray | None:
        return np.asarray(arrays[name][...])[window] if name in names else None

    def listed(name: str) -> np.ndarray | None:
        return np.asarray(arrays[name][...]) if name in names else None

    complete = {"xyz_lamp", "xyz_d65", "gloss", "body", "lit"} <= names
    return Truth(
        normals=mapped("normals"),
        height_mm=mapped("height_mm"),
        paints=mapped("labels") if "spectra" in names else None,
        spectra=listed("spectra"),
        regions=mapped("regions"),
        region_names=tuple(attributes.get("regions", ())),
        roughness=listed("roughness"),
        checks=tuple(attributes.get("checks", ())) if complete else (),
        arrays=arrays if complete else None,
        lights=tuple(attributes.get("lights", ())),
        window=window,
    )


def _window(size: tuple[int, int], shape: tuple[int, int], region, asked) -> tuple[slice, slice]:
    if size == tuple(shape):
        return slice(None), slice(None)
    if region is not None and tuple(region[2:]) == tuple(shape):
        row, column, rows, columns = region
        if asked is not None and size == tuple(asked[2:]):
            row, column = row - asked[0], column - asked[1]
        if row + rows <= size[0] and column + columns <= size[1]:
            return slice(row, row + rows), slice(column, column + columns)
    raise UserError(
        f"truth: expected {shape[0]} x {shape[1]} pixels as the scene, or the whole photograph, found "
        f"{size[0]} x {size[1]}; give the truth of this very capture"
    )
