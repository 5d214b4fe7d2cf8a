"""Normals of another program: read, turned to the axes of the maps, and compared with those of the stage.

Lamps left out cannot decide between the two: normals that were fitted to photographs predict them better than the true
ones (docs/notes/stages/normals.md). So the user decides by giving a map; what is measured of it is stated.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.images import read_codes, read_header
from nishiki.observations.plane import Observations

if TYPE_CHECKING:
    from nishiki.photometric.interreflection import Facets

LIKE = 0.5  # correlation with our normals, of the component that agrees less, from which axes are believed
SHORT = 0.5  # length of a vector below which there is no normal
AXES = tuple(
    np.array([[x, 0, 0], [0, y, 0], [0, 0, 1.0]])[[1, 0, 2] if swapped else [0, 1, 2]]
    for swapped, x, y in product((False, True), (1, -1), (1, -1))
)


@dataclass(frozen=True)
class GivenNormals:
    """Codes (rows, columns, 3) of the field, what turns them to vectors (full scale, 0: as they are), and its axes."""

    codes: np.ndarray
    full: float
    axes: np.ndarray

    def at(self, rows: slice | np.ndarray, columns: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Return unit normals (rows, columns, 3) float32 of some places; 0 where the map has none."""
        values = self.codes[rows][:, columns].astype(np.float32)
        vectors = (values if not self.full else 2 / self.full * values - 1) @ self.axes.T.astype(np.float32)
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        known = (length > SHORT) & (vectors[..., 2:] > 0)
        return np.divide(vectors, length, out=np.zeros_like(vectors), where=known)

    def into(self, maps: dict, rows: slice) -> None:
        """Replace the normals of some rows of the maps, in place, where the picture has one.

        The error is at least the angle between the two. `shading_normals`, which predict light, stay our own.
        """
        given, own = self.at(rows), maps["normals"]
        known = given[..., 2] > 0
        maps["normals"] = np.where(known[..., None], given, own)
        maps["sigma"] = np.where(known, np.maximum(maps["sigma"], angles(given, own)), maps["sigma"])


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Return the correlation of two lists of numbers; 0 where one does not vary."""
    a, b = first - first.mean(), second - second.mean()
    return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), np.finfo(np.float32).tiny))


def angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles (...), radians, between unit vectors (..., 3)."""
    return np.arccos(np.clip(np.sum(first * second, axis=-1), -1, 1)).astype(np.float32)


def find_given(frames: Observations, facets: Facets, step: int, path: Path) -> tuple[GivenNormals, dict[str, Any]]:
    """Read the map that the settings name, find its axes by our own normals of facets, and compare the two.

    step : side of a facet in pixels. Raises UserError where the size is another, where the map shows something else,
    or shows no relief.
    """
    codes, full = _read(frames, path)
    rows, columns = frames.shape
    middle, starts = np.minimum(np.arange(step // 2, rows + step // 2, step), rows - 1), np.arange(0, columns, step)
    own, known, _ = facets.fit(facets.observations, facets.valid, facets.directions)
    candidates = [GivenNormals(codes, full, axes) for axes in AXES]
    sums = [np.add.reduceat(given.at(middle), starts, axis=1) for given in candidates]  # as facets are made
    turned = [each / np.maximum(np.linalg.norm(each, axis=-1, keepdims=True), SHORT) for each in sums]
    known = known & (turned[0][..., 2] > 0)
    if not known.any():
        raise UserError(f"normals.given: {path}: no normals on the object. Remedy: a map of unit vectors")
    like = [min(correlation(each[known][:, k], own[known][:, k]) for k in (0, 1)) for each in turned]
    second, first = np.argsort(like, kind="stable")[-2:]
    if like[first] < LIKE:
        raise UserError(
            f"normals.given: {path}: its normals correlate with those of the photographs by {like[first]:.2g} with the "
            f"best axes (expected {LIKE:g} or more). Remedy: a map of this object, in this place, as unit vectors"
        )
    horizontal, vertical = (
        "".join("+-"[int(v < 0)] + "xyz"[k] for k, v in enumerate(row) if v) for row in AXES[first][:2]
    )
    return candidates[first], {
        "axes": {"x": horizontal, "y": vertical},
        "apart_median_deg": float(np.degrees(np.median(angles(turned[first], own)[known]))),
        "correlation": float(like[first]),
        "correlation_next_axes": float(like[second]),
    }


def _read(frames: Observations, path: Path) -> tuple[np.ndarray, float]:
    """Read the codes (rows, columns, 3) of the field, and their full scale, 0 for vectors as they are."""
    header = read_header(path)
    rows, columns = frames.shape
    whole = tuple(frames.attributes["image_shape"])
    row, column = frames.attributes["region_of_interest"][:2] if (header.rows, header.columns) == whole else (0, 0)
    if (header.rows, header.columns) not in (whole, (rows, columns)):
        raise UserError(
            f"normals.given: {path}: {header.rows} x {header.columns} pixels, expected {whole[0]} x {whole[1]} as the "
            f"photographs, or {rows} x {columns} as the maps. Remedy: a map of one of these sizes"
        )
    codes = read_codes(path, ("x", "y", "z"), header=header, region=(row, column, rows, columns))
    if codes.dtype.kind == "u":
        return codes, float(np.iinfo(codes.dtype).max)
    return codes, 0.0 if np.min(codes, initial=0, where=np.isfinite(codes)) < 0 else 1.0
