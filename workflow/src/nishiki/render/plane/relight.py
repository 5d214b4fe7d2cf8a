"""Observations that a camera would make under a captured light, predicted from what the other stages recovered.

The prediction is in the camera's own channels and relative to the white board, as ingest delivers observations:
I' = albedo c f + beta D F G / cos_r with c = max(n . l, 0) and the factor f of the body shading (1: Lambert), so that
no spectrum and no colour matrix stands between it and a photograph.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.render.plane.scene import Gloss, Light
from nishiki.render.plane.shade import ColourGroups, pixel_to_plane, shade_channels
from nishiki.render.plane.shadow import cast_shadows


@dataclass(frozen=True)
class Prediction:
    """One light's predicted photograph."""

    observations: np.ndarray  # (rows, columns, channels) float32, a perfect white that faces the lamp is 1
    flags: np.ndarray  # (rows, columns) uint8, bits of nishiki.render.plane.scene
    visibility: np.ndarray | None  # (rows, columns) float32, what each pixel sees of the lamp; None without a height


def predict_observations(
    normals: np.ndarray,
    albedo: np.ndarray,
    lights: list[Light],
    *,
    shading: np.ndarray | None = None,
    slopes: np.ndarray | None = None,
    gloss: Gloss | None = None,
    labels: np.ndarray | None = None,
    height: np.ndarray | None = None,
    pitch: float = 1.0,
    shadows: str = "sweep",
) -> Iterator[Prediction]:
    """One prediction a light, in order, so that a stack of them need not be held in memory.

    normals: (rows, columns, 3); albedo: (rows, columns, channels), perfect white 1; shading, slopes, gloss, labels,
    height, pitch as in `PlaneScene`; shadows: "sweep", "march" or "none".  The spectra of the lights are not used; a
    white board at the same place has divided out intensity and fall-off, which should therefore stay 1 and False.
    """
    if albedo.ndim != 3 or albedo.shape[:2] != normals.shape[:2] or normals.shape[2:] != (3,):
        raise UserError(
            f"expected normals (rows, columns, 3) and albedo (rows, columns, channels), "
            f"found {normals.shape} and {albedo.shape}; give maps of one size"
        )
    if height is not None and height.shape != normals.shape[:2]:
        raise UserError(f"height: expected the shape of the normals {normals.shape[:2]}, found {height.shape}")
    plane = pixel_to_plane(pitch, normals.shape[:2])
    channels = albedo.shape[2]
    groups = ColourGroups(
        np.eye(channels)[None], np.zeros((1, channels)), np.ones((1, channels)), np.zeros(1, np.int64), 0
    )
    for light in lights:
        visibility = None
        if height is not None and shadows != "none":
            cast = cast_shadows(height, [light], pitch=pitch, method=shadows)
            visibility = cast.visibility
        seen = shade_channels(
            normals,
            albedo,
            [light],
            groups=groups,
            shading=shading,
            slopes=slopes,
            gloss=Gloss.none() if gloss is None else gloss,
            labels=labels,
            visibility=visibility,
            plane=plane,
        )
        yield Prediction(seen.values, seen.flags, None if visibility is None else visibility[0])
