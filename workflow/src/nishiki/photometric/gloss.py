"""Normals and reflectance fitted together with the gloss of the scene, pixel by pixel."""

from collections import namedtuple
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nishiki.brdf.gloss_profile import GlossProfile, light_table
from nishiki.errors import UserError
from nishiki.photometric import flags as bits
from nishiki.photometric.gloss_kernel import refine_pixels
from nishiki.threads import over_rows

NOISE = 0.002  # of an observation, relative to white
MODEL_ERROR = 0.02  # of the body's shading, relative to the pixel's mean level: interreflection, mixed pixels
GLOSS_ERROR = 0.15  # of the predicted gloss, relative
TILT_ERROR = 0.02  # radians by which the mirroring surface may lean from the normal of the body
TOLERANCE = 3.0  # standard deviations at which a sample has lost three quarters of its weight
ITERATIONS = 15  # at most of a pixel
SECOND_START = 1.0  # robust cost a value above which the normal that mirrors the brightest light is tried too


JointScene = namedtuple("JointScene", "lights table rotation")
"""What all pixels of a joint fit share.

lights (lights, 8) float64: direction, half vector, F, cos theta_q; table (4, NODES) of `GlossProfile.table`;
rotation (C, C): the first row is the common level of the channels.
"""


class JointSettings(NamedTuple):
    """Settings of a joint fit; see the constants above."""

    noise: float | None = None  # of an observation; None: NOISE of the gloss' unit
    model_error: float = MODEL_ERROR
    second_start: float = SECOND_START
    max_condition: float = 1e4
    gloss_error: float = GLOSS_ERROR
    tilt_error: float = TILT_ERROR
    tolerance: float = TOLERANCE
    iterations: int = ITERATIONS


JointFields = namedtuple("JointFields", "normals reflectance scalars lights_used flags cost")
"""What the kernel changes: fields of `RefinedNormals` of flat pixels.

scalars (4, pixels): albedo, sigma, condition, residual.
"""


@dataclass(frozen=True)
class RefinedNormals:
    """Maps (rows, columns, ...) of the joint fit; fields as those of NormalField.

    normals (.., 3), reflectance (.., channels), albedo (its mean), sigma (radians), residual (rms of the level,
    relative to white), condition: float32; lights_used uint16: samples whose weight is more than half of their own;
    flags uint8; cost float32: robust cost, 0 where nothing was refined. Pixels of NO_ESTIMATE and FALLBACK keep what
    they came with.
    """

    normals: np.ndarray
    reflectance: np.ndarray
    albedo: np.ndarray
    sigma: np.ndarray
    residual: np.ndarray
    condition: np.ndarray
    lights_used: np.ndarray
    flags: np.ndarray
    cost: np.ndarray


def refine_normals(
    observations: np.ndarray,
    directions: np.ndarray,
    *,
    normals: np.ndarray,
    gloss: GlossProfile,
    valid: np.ndarray | None = None,
    flags: np.ndarray | None = None,
    reflectance: np.ndarray | None = None,
    settings: JointSettings | None = None,
) -> RefinedNormals:
    """Fit I'_jk = rho_k b(n . l_j) + s_j(n) at every pixel from the given normals (see `gloss_kernel`).

    observations (lights, rows, columns, channels), relative to white; directions (lights, 3) unit; valid (lights, rows,
    columns) bool, None for all; normals (rows, columns, 3) unit, of any solver, to start from (a metal starts from
    the half vectors, weighted by the light); flags (rows, columns)
    uint8: where a bit of NO_ESTIMATE is set nothing is done; reflectance (rows, columns, channels) kept there and where
    the fit fails, zeros if None; gloss: of `nishiki.brdf.gloss_profile`. The result does not depend on threads or
    tiles.

    Raises UserError where shapes do not fit.
    """
    observations = np.ascontiguousarray(gloss.balanced(observations), dtype=np.float32)
    shape = observations.shape
    if observations.ndim != 4 or np.shape(normals) != (*shape[1:3], 3) or len(directions) != shape[0]:
        raise UserError(
            f"joint fit: expected observations (lights, rows, columns, channels) with as many directions and a normal "
            f"for each pixel, found {shape}, {len(directions)} directions and normals {np.shape(normals)}"
        )
    count, pixels, channels = shape[0], shape[1] * shape[2], shape[3]
    valid = np.isfinite(observations).all(axis=-1) & (True if valid is None else valid)
    settings = settings or JointSettings()
    noise = NOISE * gloss.unit if settings.noise is None else settings.noise
    noise = noise if gloss.colour is None else noise / gloss.colour.mean()
    lights = light_table(directions, gloss.refractive_index)
    if gloss.colour is not None:  # a metal does not follow Lambert's law
        normals = np.moveaxis(np.where(valid, observations.mean(axis=-1), 0), 0, -1) @ lights[:, 3:6]
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), np.finfo(float).tiny)
    fields = empty_fields(pixels, channels, normals, reflectance, flags)
    scene = JointScene(lights, gloss.table(), channel_rotation(channels))
    settings = settings._replace(noise=float(noise))
    known = np.ascontiguousarray(np.broadcast_to(valid, shape[:3]).reshape(count, pixels))
    over_rows(refine_pixels, pixels, observations.reshape(count, pixels, channels), known, scene, settings, fields)
    refined, rho, scalars, used, marks, cost = fields
    if gloss.colour is not None:
        fitted = (marks & (bits.NO_ESTIMATE | bits.FALLBACK)) == 0
        rho[fitted], scalars[0, fitted] = gloss.colour, gloss.colour.mean()
        scalars[3, fitted] *= gloss.colour.mean()
    albedo, sigma, condition, residual = scalars.reshape(4, *shape[1:3])
    return RefinedNormals(
        normals=refined.reshape(*shape[1:3], 3),
        reflectance=rho.reshape(*shape[1:3], channels),
        albedo=albedo,
        sigma=sigma,
        residual=residual,
        condition=condition,
        lights_used=used.reshape(shape[1:3]),
        flags=marks.reshape(shape[1:3]),
        cost=cost.reshape(shape[1:3]),
    )


def empty_fields(pixels, channels, normals, reflectance, flags):
    """Make the outputs of the kernel, filled with what is known before."""
    scalars = np.zeros((4, pixels), np.float32)
    scalars[1] = 0.5 * np.pi
    start = np.zeros((pixels, channels)) if reflectance is None else reflectance.reshape(pixels, channels)
    marks = np.zeros(pixels) if flags is None else flags.reshape(pixels)
    return JointFields(
        np.array(normals, dtype=np.float32, order="C").reshape(pixels, 3).copy(),
        np.array(start, dtype=np.float32, order="C"),
        scalars,
        np.zeros(pixels, np.uint16),
        np.array(marks, dtype=np.uint8),
        np.zeros(pixels, np.float32),
    )


def channel_rotation(channels: int) -> np.ndarray:
    """Orthogonal matrix (C, C) whose first row is the common level; the others are Helmert's differences."""
    rotation = np.zeros((channels, channels))
    rotation[0] = 1 / np.sqrt(channels)
    for k in range(1, channels):
        rotation[k, :k], rotation[k, k] = 1.0, -float(k)
        rotation[k] /= np.sqrt(k * (k + 1.0))
    return rotation
