"""Estimate the light that a concave object throws on itself as a part of each photograph, to subtract it.

A sample is rho (E + B), E the light of the lamp and B the light of other places of the object. Under Lambert's law a
place is as bright from everywhere, so that the photograph itself holds what reaches the others, all bounces included
(S. K. Nayar, K. Ikeuchi and T. Kanade, Shape from interreflections, Int. J. Comput. Vis. 6 (3), 1991):

    B_ij = sum over k of F_ik I_kj,    F_ik = V_ik A_k cos_ik cos_ki / (pi r_ik^2)

with A the area of a facet, V whether the two see each other and I_kj the radiance of facet k under lamp j, relative to
white. The facets are those of a coarse grid, whose normals are integrated to a height; each round takes B off, fits the
normals again, and is nearer to the shape. What the camera does not see throws no light here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from nishiki.photometric.expected_error import LEAST_NZ
from nishiki.photometric.height import integrate_normals
from nishiki.threads import strips

if TYPE_CHECKING:
    from scipy import sparse

ROUNDS = 3
BOUNCES = 8  # of predicted light
FAINTEST = 1e-5  # form factor below which a facet throws no light worth counting
SIGHT = np.linspace(0.1, 0.9, 9)  # places between two facets where the surface may stand between them
CLEARANCE = 0.5  # facets by which it has to, as the heights are those of their centres
LARGEST = 0.9  # of the light: more is no correction
DARK = 1e-9  # relative to white


@dataclass(frozen=True)
class FacetGrid:
    """A coarse grid of the picture.

    observations (lights, rows, columns, channels), relative to white; valid (lights, rows, columns) bool; directions
    (lights, 3), unit, of distant lamps; fit: from these three, of observations that hold no thrown light, the normals
    (rows, columns, 3), which facets have one (rows, columns), and the samples that they rest on, as `valid`.
    """

    observations: np.ndarray
    valid: np.ndarray
    directions: np.ndarray
    fit: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]

    def scale(self, factor: float) -> FacetGrid:
        """Return facets so many times as bright."""
        return replace(self, observations=factor * self.observations)

    def every(self, stride: int) -> FacetGrid:
        """Select every stride-th facet each way."""
        values, valid = self.observations[:, ::stride, ::stride], self.valid[:, ::stride, ::stride]
        return replace(self, observations=np.ascontiguousarray(values), valid=np.ascontiguousarray(valid))


@dataclass(frozen=True)
class Interreflection:
    """Light that facets throw on each other.

    shares (lights, rows, columns, channels): thrown light that a facet reflects under each lamp, over the sum of its
    observations under all; factors: of `form_factors`, of the facets that are known (rows, columns) bool; reflectance
    (rows, columns, channels).
    """

    shares: np.ndarray
    factors: sparse.csr_array
    known: np.ndarray
    reflectance: np.ndarray


def taken_off(observations: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return observations (lights, ...) without the shares of their sum that are thrown light."""
    return np.maximum(observations - shares * observations.sum(axis=0), (1 - LARGEST) * observations)


def form_factors(normals: np.ndarray, valid: np.ndarray) -> sparse.csr_array:
    """Compute the share of each facet's light that reaches each other one, (facets, facets) of the valid ones.

    Parameters
    ----------
    normals : (rows, columns, 3) float
        Unit normals of a grid of facets, x right, y up, z to the camera.
    valid : (rows, columns) bool
        Facets with a normal.
    """
    from scipy import sparse

    if not valid.any():
        return sparse.csr_array((0, 0))
    height = integrate_normals(normals, valid=valid).height
    row, column = np.nonzero(valid)
    facing = normals[row, column].astype(np.float64)
    places = np.stack([column, -row, height[row, column]], axis=-1).astype(np.float64)
    area = 1 / np.maximum(facing[:, 2], LEAST_NZ)
    surface = np.where(valid, height, -np.inf)
    offset, lengths, blocks = np.einsum("kx,kx->k", facing, places), np.square(places).sum(axis=1), []
    for part in strips(len(places)):
        here, towards = places[part], facing[part]
        square = np.maximum(np.square(here).sum(axis=1)[:, None] + lengths - 2 * here @ places.T, DARK)
        leaving = towards @ places.T - offset[part, None]
        arriving = here @ facing.T - offset
        factors = np.maximum(leaving, 0) * np.maximum(arriving, 0) / square * area
        factors /= np.pi * np.maximum(square, area / np.pi)
        i, k = np.nonzero(factors > FAINTEST)
        for share in SIGHT:
            x, y, z = (here[i] + share * (places[k] - here[i])).T
            seen = surface[np.rint(-y).astype(int), np.rint(x).astype(int)] < z + CLEARANCE
            i, k = i[seen], k[seen]
        blocks.append(sparse.csr_array((factors[i, k], (i, k)), factors.shape))
    whole = sparse.vstack(blocks, format="csr")
    return sparse.diags_array(1 / np.maximum(whole.sum(axis=1), 1)) @ whole


def find_interreflection(facets: FacetGrid) -> Interreflection:
    """Find the light that facets throw on each other, with their shape, in ROUNDS."""
    observations, directions = facets.observations, facets.directions
    shares, total = np.zeros_like(observations), np.maximum(observations.sum(axis=0), DARK)
    for _ in range(ROUNDS):
        normals, known, used = facets.fit(taken_off(observations, shares), facets.valid, directions)
        factors = form_factors(normals, known)
        light = light_between_facets(factors, observations, known)
        reflectance = reflectance_of(observations, lambert(normals, directions) + light, used) * known[..., None]
        shares = reflectance * light / total
    return Interreflection(shares, factors, known, reflectance)


def light_between_facets(factors: sparse.csr_array, radiance: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the light B (lights, rows, columns, channels) that facets throw on each other; radiance of that shape."""
    light, seen = np.zeros(radiance.shape), radiance[:, known]
    lights, facets, channels = seen.shape
    received = factors @ seen.swapaxes(0, 1).reshape(facets, lights * channels)
    light[:, known] = received.reshape(facets, lights, channels).swapaxes(0, 1)
    return light


def lambert(normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the cosines (lights, rows, columns, 1) of lamps on normals (rows, columns, 3), 0 behind the surface."""
    return np.maximum(np.einsum("rcx,jx->jrc", normals, directions), 0)[..., None]


def reflectance_of(observations: np.ndarray, light: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the reflectance (rows, columns, channels), 0 to 1, from the samples used under this light."""
    reflected, received = (np.where(used[..., None], values, 0).sum(axis=0) for values in (observations, light))
    return np.clip(reflected / np.maximum(received, DARK), 0, 1)


def left_out_errors(facets: FacetGrid, found: Interreflection | None, folds: int) -> np.ndarray:
    """Return the mean error (lights,) of predicted radiance, each left out of the fit by turns; 0 without samples.

    found : thrown light to take off before the fit, and to predict with all its bounces; None: no such light.
    """
    lights, errors = np.arange(len(facets.directions)), np.zeros(len(facets.directions))
    direct = facets.observations if found is None else taken_off(facets.observations, found.shares)
    for fold in range(folds):
        kept, left = lights[lights % folds != fold], lights[fold::folds]
        normals, known, used = facets.fit(direct[kept], facets.valid[kept], facets.directions[kept])
        reflectance = reflectance_of(direct[kept], lambert(normals, facets.directions[kept]), used)
        cosines = lambert(normals, facets.directions[left])
        radiance = reflectance * cosines
        if found is not None:
            for _ in range(BOUNCES):
                radiance = reflectance * (cosines + light_between_facets(found.factors, radiance, found.known))
        apart = np.abs(radiance - facets.observations[left]).mean(axis=-1)
        compared = facets.valid[left] & known
        errors[left] = apart.sum(axis=(1, 2), where=compared) / np.maximum(compared.sum(axis=(1, 2)), 1)
    return errors
