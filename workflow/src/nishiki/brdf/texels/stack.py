"""One tile's stack of observations, turned texel by texel into what a fit reads.

A texel is seen in a third of the views of a turn, or fewer: only these observations are kept, side by side, and a
count for each texel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.brdf.texels.lighting import ENVIRONMENT, POINT, Lamp
from nishiki.brdf.texels.model import GRAZING, angles_at, irradiance_at
from nishiki.colour.encoding import encoding_slope

MULTIPLE = 8  # observations a texel are padded to a multiple, with weight 0


@dataclass(frozen=True)
class Observed:
    """The visible observations of the texels of a tile that are seen at all; every array float32 unless said.

    texel (points,) int32: row * T + column.  values (points, slots, channels).  diffuse (points, slots): what
    multiplies K_d.  attenuation: what multiplies K_s exp(..), 0 where the lamp is behind.  alpha (points, slots):
    radians.  weights: cos(theta_r), times the squared slope of the encoding where asked; 0 in unused slots.
    view (points, slots) int32: which observation a slot holds, -1 none.
    """

    texel: np.ndarray
    values: np.ndarray
    diffuse: np.ndarray
    attenuation: np.ndarray
    alpha: np.ndarray
    weights: np.ndarray
    view: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(points,) int32: usable observations of each texel, those with a weight."""
        return np.sum(self.weights > 0, axis=1, dtype=np.int32)


def observed(
    values: np.ndarray,
    visible: np.ndarray,
    positions: np.ndarray,
    normals: np.ndarray,
    centres: np.ndarray,
    lamps: list[Lamp],
    *,
    encoding: str = "linear",
    bright: np.ndarray | None = None,
) -> Observed:
    """Gather a tile: values (M, T, T, channels) linear, visible (M, T, T), positions and normals (T, T, 3).

    centres (M, 3): of the cameras; lamps: one an observation.  encoding: in which errors count; "srgb" weighs each
    observation by the squared slope of the curve.  bright: (M, T, T, channels) values that this slope is taken at, the
    values themselves if None.  Observations that are not finite are left out.  Weighted by cos(theta_r) (Miyazaki et
    al. 2007, section 3.1).
    """
    texel, view = _slots(np.ascontiguousarray(visible))
    points, slots = view.shape
    channels = values.shape[-1]
    places = np.ascontiguousarray(positions, np.float32).reshape(-1, 3)
    facing = np.ascontiguousarray(normals, np.float32).reshape(-1, 3)
    picked = np.zeros((points, slots, channels), np.float32)
    _pick(np.ascontiguousarray(values, np.float32), texel, view, picked)
    diffuse, attenuation, alpha, weights = (np.zeros((points, slots), np.float32) for _ in range(4))
    centres = np.ascontiguousarray(centres, np.float32)
    _look(places, facing, texel, view, centres, *_side_by_side(lamps), diffuse, attenuation, alpha, weights)
    if encoding == "srgb":
        level = picked
        if bright is not None:
            level = np.zeros_like(picked)
            _pick(np.ascontiguousarray(bright, np.float32), texel, view, level)
        weights *= encoding_slope(level.mean(axis=-1), "srgb") ** 2
    weights[~np.isfinite(picked).all(axis=-1)] = 0
    return Observed(texel, picked, diffuse, attenuation, alpha, weights, view)


def _side_by_side(lamps: list[Lamp]) -> tuple:
    """Form, vectors, rotations, grey harmonics and squared references of the lamps, as arrays."""
    form = np.array([lamp.form for lamp in lamps], np.int64)
    vectors, rotations = (np.stack([getattr(lamp, name) for lamp in lamps]) for name in ("vector", "rotation"))
    harmonics = np.stack([lamp.harmonics.mean(axis=1, keepdims=True) for lamp in lamps]).astype(np.float32)
    references = np.array([lamp.reference if lamp.form == POINT else 0 for lamp in lamps], np.float32) ** 2
    return form, vectors, rotations, harmonics, references


def _slots(visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texels that are seen (points,), and their observations (points, slots), -1 where a slot is empty."""
    flat = visible.reshape(visible.shape[0], -1)
    count = flat.sum(axis=0)
    texel = np.flatnonzero(count).astype(np.int32)
    slots = -(-max(int(count.max(initial=0)), 1) // MULTIPLE) * MULTIPLE
    view = np.full((texel.size, slots), -1, np.int32)
    _fill_slots(flat, texel, view)
    return texel, view


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_slots(visible, texel, view):
    for p in range(texel.size):
        slot = 0
        for o in range(visible.shape[0]):
            if visible[o, texel[p]]:
                view[p, slot] = o
                slot += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _pick(stack, texel, view, out):
    columns = stack.shape[2]
    for p in range(texel.size):
        row, column = texel[p] // columns, texel[p] % columns
        for slot in range(view.shape[1]):
            o = view[p, slot]
            if o < 0:
                break
            for c in range(out.shape[2]):
                out[p, slot, c] = stack[o, row, column, c]


@njit(cache=True, nogil=True, error_model="numpy")
def _look(places, facing, texel, view, centres, form, vectors, rotations, harmonics, references,
          diffuse, attenuation, alpha, weights):  # fmt: skip
    """What `model.factors` gives, for every slot."""
    zero, grazing = np.float32(0), np.float32(GRAZING)
    for p in range(texel.size):
        px, py, pz = places[texel[p], 0], places[texel[p], 1], places[texel[p], 2]
        nx, ny, nz = facing[texel[p], 0], facing[texel[p], 1], facing[texel[p], 2]
        for slot in range(view.shape[1]):
            o = view[p, slot]
            if o < 0:
                break
            cos_i, cos_r, alpha2, strength = angles_at(
                px, py, pz, nx, ny, nz, centres[o], form[o], vectors[o], references[o]
            )
            if form[o] == ENVIRONMENT:
                diffuse[p, slot] = irradiance_at(nx, ny, nz, rotations[o], harmonics[o], 0)
            elif cos_i > zero:
                diffuse[p, slot] = cos_i * strength
            if cos_r > zero:
                weights[p, slot] = cos_r
                if cos_i > zero:
                    attenuation[p, slot] = strength / (cos_r if cos_r > grazing else grazing)
            alpha[p, slot] = np.sqrt(alpha2)
