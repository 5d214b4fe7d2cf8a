"""Normals and reflectance fitted together with the gloss of the scene, pixel by pixel.

A gloss fitted to what the body leaves stays too weak, for body and normals have taken a part of it. Here the light of
every pixel is linearised by its own unknowns (reflectance, and the normal along both tangents; columns J) and by those
of the finish (strengths of the lobes and the transmission; columns S). With the robust weights W of the joint fit,

    A = sum over pixels of  S' W S - S' W J (J' W J)^-1 J' W S

are the equations of the shared unknowns after the pixels' own are eliminated (variable projection: G. H. Golub and
V. Pereyra, SIAM J. Numer. Anal. 10, 1973). They are solved with strengths of zero or more and a transmission from 0 to
1. Only the channels' mean takes part: white gloss does not show in differences of colour.
"""

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from nishiki.brdf.gloss_profile import GlossProfile, light_table, scattered_lobes, specular_samples
from nishiki.errors import UserError, require
from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag
from nishiki.photometric.gloss_kernel import refine_pixels
from nishiki.threads import over_rows

LARGEST_SIGMA = 0.1  # radians: where the normals are worse the blur is no longer a small one
STEP = 1e-3  # radians, of the differences along the tangents
SMALLEST = 1e-9  # of the largest eigenvalue: less is no information
MEASURED = 0.01  # fall of the squared error, relative, from which the lamps tell the transmission from a tilt


@dataclass(frozen=True)
class GlossTile:
    """Pixels under one set of directions, with the normals that the fit starts from."""

    observations: np.ndarray  # (lights, rows, columns, channels)
    valid: np.ndarray  # (lights, rows, columns) bool
    directions: np.ndarray  # (lights, 3)
    normals: np.ndarray  # (rows, columns, 3)
    flags: np.ndarray  # flags, sigma (rows, columns)
    sigma: np.ndarray
    reflectance: np.ndarray  # (rows, columns, channels)
    # (rows, columns) int: number of the cell of the picture, where finishes are told apart
    cells: np.ndarray | None = None

    @property
    def places(self) -> np.ndarray:
        """(rows, columns) int: cells of tiles that have them."""
        return require(self.cells)

    def only(self, chosen: np.ndarray | slice) -> "GlossTile":
        """Select some pixels of a tile (lights, 1, pixels, ...): numbers, or bool (pixels,)."""
        of_lights = {name: getattr(self, name)[:, :, chosen] for name in ("observations", "valid")}
        names = ("normals", "flags", "sigma", "reflectance", "cells")
        of_pixels = {name: value[:, chosen] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **of_lights, **of_pixels)


def step(tiles: Sequence[GlossTile], fits: Sequence["RefinedNormals"], gloss: GlossProfile) -> GlossProfile:
    """Return the gloss after one step from a joint fit with `gloss`.

    The transmission is 1 where another one does not lower the squared error by MEASURED: under a ring of lamps at one
    incidence it looks like a tilt.

    Parameters
    ----------
    tiles : of pixels (lights, 1, pixels, ...).
    fits : their joint fits with `gloss`.
    gloss : on any ladder of widths, which the result shares.
    """
    total = np.zeros((gloss.gamma.size + 2,) * 2)
    for tile, fit in zip(tiles, fits, strict=True):
        total += equations(tile, fit, gloss)
    (error, free), (of_dielectric, dielectric) = (_solve(total, least) for least in (0.0, 1.0))
    measured = error < (1 - MEASURED) * of_dielectric
    beta, transmission = (free[:-1], float(free[-1])) if measured else (dielectric[:-1], 1.0)
    return replace(gloss, beta=beta, transmission=transmission)


def _solve(total: np.ndarray, least: float) -> tuple[float, np.ndarray]:
    """Return the squared error, and strengths of zero or more with the transmission from `least` to 1."""
    from scipy.optimize import lsq_linear

    size = np.sqrt(np.maximum(np.diag(total)[:-1], np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(total[:-1, :-1] / size[:, None] / size)
    root = np.sqrt(np.maximum(values, max(SMALLEST * values.max(), np.finfo(float).tiny)))
    low, high = np.zeros(size.size), np.full(size.size, np.inf)
    low[-1], high[-1] = least * size[-1] * (1 - SMALLEST), size[-1]
    target = vectors.T @ (total[:-1, -1] / size) / root
    found = lsq_linear((vectors * root).T, target, (low, high), method="bvls").x / size
    found = np.append(np.maximum(found[:-1], 0), np.clip(found[-1], 0, 1))
    return float(total[-1, -1] - found @ (2 * total[:-1, -1] - total[:-1, :-1] @ found)), found


def equations(tile: GlossTile, fit: "RefinedNormals", gloss: GlossProfile) -> np.ndarray:
    """Return the normal equations (lobes + 2, lobes + 2) of strengths, transmission and right-hand side of a tile."""
    kept = (fit.flags[0] & (NO_ESTIMATE | NormalFlag.FALLBACK)) == 0
    normals, level = fit.normals[0, kept].astype(float), fit.reflectance[0, kept].mean(axis=-1).astype(float)
    channels, observed = tile.observations.shape[-1], tile.observations[:, 0, kept].mean(axis=-1).astype(float)
    valid = tile.valid[:, 0, kept]

    def parts(normal: np.ndarray, profile: GlossProfile) -> tuple[np.ndarray, ...]:
        """Return body, gloss, angle and attenuation, each (lights, pixels)."""
        given = observed[..., None], tile.directions, normal, level[:, None], profile
        phi, above, attenuation = specular_samples(*given, valid=valid)
        return observed - above, profile.value(phi) * attenuation, phi, attenuation

    body, shine, phi, attenuation = parts(normals, gloss)
    across = np.stack([normals[:, 2], np.zeros(len(normals)), -normals[:, 0]], axis=-1)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), SMALLEST)
    own, lean = [body], 0.0
    for tangent in (across, np.cross(normals, across)):
        turned = normals + STEP * tangent
        other, mirrored = parts(turned / np.linalg.norm(turned, axis=-1, keepdims=True), gloss)[:2]
        own.append((other + mirrored - body - shine) / STEP)
        lean = lean + ((mirrored - shine) / STEP) ** 2
    lit = np.where(valid, observed, 0)
    usual = (lit.sum(axis=0) - lit.max(axis=0, initial=0)) / np.maximum(valid.sum(axis=0) - 1, 1)
    variance = (NOISE * gloss.unit) ** 2 / channels + (MODEL_ERROR * usual) ** 2
    variance = variance + (GLOSS_ERROR * shine) ** 2 + TILT_ERROR**2 * lean
    rest = observed - body - shine
    weight = np.where(attenuation > 0, (1 + rest**2 / (TOLERANCE**2 * variance)) ** -2.0 / variance, 0)

    scatter = np.minimum(fit.sigma[0, kept], LARGEST_SIGMA) ** 2 / 2
    lobes = scattered_lobes(gloss.gamma, phi, scatter) * attenuation[..., None]
    passed, lossless = (parts(normals, replace(gloss, transmission=share))[0] for share in (1.0, 0.0))
    lost = passed - lossless
    shared = np.concatenate([lobes, np.stack([lost, observed + lost * gloss.transmission], axis=-1)], axis=-1)
    used = weight[..., None] > 0
    shared, free = (np.where(used, a, 0).swapaxes(0, 1) for a in (shared, np.stack(own, axis=-1)))
    weighted = free.swapaxes(1, 2) * weight.T[:, None]
    curvature, mixed = weighted @ free, weighted @ shared
    curvature += (SMALLEST * np.trace(curvature, axis1=1, axis2=2) + np.finfo(float).tiny)[:, None, None] * np.eye(3)
    whole = (shared * weight.T[..., None]).swapaxes(1, 2) @ shared
    return (whole - mixed.swapaxes(1, 2) @ np.linalg.solve(curvature, mixed)).sum(axis=0)


NOISE = 0.002  # of an observation, relative to white
MODEL_ERROR = 0.02  # of the body's shading, relative to the pixel's mean level: interreflection, mixed pixels
GLOSS_ERROR = 0.15  # of the predicted gloss, relative
TILT_ERROR = 0.02  # radians by which the mirroring surface may lean from the normal of the body
TOLERANCE = 3.0  # standard deviations at which a sample has lost three quarters of its weight
ITERATIONS = 15  # at most of a pixel
SECOND_START = 1.0  # robust cost a value above which the normal that mirrors the brightest light is tried too


JointScene = namedtuple("JointScene", "lights table rotation")
"""Data that all pixels of a joint fit share.

lights (lights, 8) float64: direction, half vector, F, cos theta_q; table (4, NODES) of `GlossProfile.table`;
rotation (C, C): the first row is the common level of the channels, the others are Helmert's differences.
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
"""Outputs of the kernel: fields of `RefinedNormals` of flat pixels.

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
    from scipy.linalg import helmert

    observations = np.ascontiguousarray(gloss.balance(observations), dtype=np.float32)
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
    scene = JointScene(lights, gloss.table(), helmert(channels, full=True))
    settings = settings._replace(noise=float(noise))
    known = np.ascontiguousarray(np.broadcast_to(valid, shape[:3]).reshape(count, pixels))
    over_rows(refine_pixels, pixels, observations.reshape(count, pixels, channels), known, scene, settings, fields)
    refined, rho, scalars, used, marks, cost = fields
    if gloss.colour is not None:
        fitted = (marks & (NO_ESTIMATE | NormalFlag.FALLBACK)) == 0
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
    """Make the outputs of the kernel, filled with the values to start from."""
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
