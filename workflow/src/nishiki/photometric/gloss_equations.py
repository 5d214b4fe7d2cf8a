"""Fit the gloss that pixels share while their normals and reflectances stay free: one Gauss-Newton step.

A gloss fitted to what the body leaves stays too weak, for body and normals have taken a part of it. Here the light of
every pixel is linearised by its own unknowns (reflectance, and the normal along both tangents; columns J) and by those
of the finish (strengths of the lobes and the transmission; columns S). With the robust weights W of the joint fit,

    A = sum over pixels of  S' W S - S' W J (J' W J)^-1 J' W S

are the equations of the shared unknowns after the pixels' own are eliminated (variable projection: G. H. Golub and
V. Pereyra, SIAM J. Numer. Anal. 10, 1973). They are solved with strengths of zero or more and a transmission from 0 to
1. Only the channels' mean takes part: white gloss does not show in differences of colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.gloss_profile import GlossProfile, scattered_lobes, specular_samples
from nishiki.errors import require
from nishiki.photometric import flags as bits
from nishiki.photometric.gloss import GLOSS_ERROR, MODEL_ERROR, NOISE, TILT_ERROR, TOLERANCE, RefinedNormals

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
        """Return the same of some pixels of a tile (lights, 1, pixels, ...): numbers, or bool (pixels,)."""
        of_lights = {name: getattr(self, name)[:, :, chosen] for name in ("observations", "valid")}
        names = ("normals", "flags", "sigma", "reflectance", "cells")
        of_pixels = {name: value[:, chosen] for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **of_lights, **of_pixels)


def step(tiles: Sequence[GlossTile], fits: Sequence[RefinedNormals], gloss: GlossProfile) -> GlossProfile:
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


def equations(tile: GlossTile, fit: RefinedNormals, gloss: GlossProfile) -> np.ndarray:
    """Return the normal equations (lobes + 2, lobes + 2) of strengths, transmission and right-hand side of a tile."""
    kept = (fit.flags[0] & (bits.NO_ESTIMATE | bits.FALLBACK)) == 0
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
