"""The models of the literature fitted by the same code, with the same weights, to the same measurements."""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.cloth.interface import halves
from nishiki.brdf.cloth.measures import incidences, single
from nishiki.brdf.cloth.parametric import ShapeFit, fit_shape
from nishiki.brdf.cloth.peers import AshikhminShirley, Ggx, Ward
from nishiki.brdf.cloth.yarn_fit import MISS, MISS_OBLIQUE, Measured, normal_weights, refuse_black

# Shape parameters as logarithms (the reflectance a logit, the index log(n - 1)): prior centres and spreads, then starts
PRIORS = {
    "ward": ([np.log(0.3)] * 2, [1.0] * 2, [[0.0, 0.0], [-1.0, 0.5], [0.5, -1.0]]),
    "ggx": ([np.log(0.3)] * 2 + [np.log(0.54)], [1.0, 1.0, 0.08], [[0.0] * 3, [-1.0, 0.5, 0.0], [0.5, -1.0, 0.0]]),
    "ashikhmin_shirley": (
        [np.log(10.0)] * 2 + [np.log(0.05 / 0.95)], [1.5, 1.5, 0.5], [[0.0] * 3, [2.0, -1.0, 0.0], [-1.0, 2.0, 0.0]],
    ),
}  # fmt: skip

PARAMETERS = {
    "ward": ("width along x", "width along y"),
    "ggx": ("width along x", "width along y", "refractive index"),
    "ashikhmin_shirley": ("exponent along x", "exponent along y", "reflectance"),
}


@dataclass(frozen=True)
class PeerFit:
    """A peer and what its fit says."""

    brdf: Ward | Ggx | AshikhminShirley
    fit: ShapeFit
    used: np.ndarray


def peer_of(kind: str, x: np.ndarray, diffuse: np.ndarray, specular: np.ndarray):
    """The model of a vector of shape parameters."""
    e = np.exp(np.asarray(x, float))
    if kind == "ward":
        return Ward(diffuse, specular, float(e[0]), float(e[1]))
    if kind == "ggx":
        return Ggx(diffuse, specular, float(e[0]), float(e[1]), float(1 + e[2]))
    return AshikhminShirley(diffuse, specular, float(e[0]), float(e[1]), float(e[2] / (1 + e[2])))


def peer_weights(measured: Measured) -> np.ndarray:
    """Inverse standard deviations (n,): views of normal incidence together, single ones at the oblique incidences.

    The level of an oblique incidence is that of its own measurements, for no model is known yet.
    """
    weight = np.empty(len(measured.grey))
    if measured.normal.any():
        weight[measured.normal] = normal_weights(measured.take(measured.normal))
    oblique = np.flatnonzero(~measured.normal)
    for _, _, rows in incidences(measured.incident[oblique]):
        values = measured.grey[oblique[rows]]
        level = np.sqrt(np.mean(values**2))
        weight[oblique[rows]] = single(values, np.full(len(rows), level), miss=MISS_OBLIQUE)
    return np.minimum(weight, 1 / (1e-3 * MISS * measured.grey.max()))


def fit_peer(kind: str, measured: Measured, rows: np.ndarray, *, evaluations: int = 40) -> PeerFit:
    """The best of three starts: alike in both directions, and longer either way. UserError where all is black."""
    rows = np.asarray(rows)[np.isfinite(measured.values[rows]).all(axis=1)]
    chosen = measured.take(rows)
    refuse_black(chosen)
    centre, spread, starts = (np.asarray(part, float) for part in PRIORS[kind])
    one = np.ones(1)

    def parts(x):
        model = peer_of(kind, x, 0 * one, one)
        g = halves(chosen.incident, chosen.outgoing)
        lobe = model.lobe(g, chosen.incident, chosen.outgoing)
        return np.zeros(len(rows)), np.stack([np.full(len(rows), 1 / np.pi), lobe], axis=1)

    weight = peer_weights(chosen)
    fits = [
        fit_shape(
            parts,
            chosen.values,
            weight,
            centre=centre,
            spread=spread,
            limits=np.full(2, np.inf),
            start=centre + offset,
            evaluations=evaluations,
        )
        for offset in starts
    ]
    fit = min(fits, key=lambda candidate: candidate.cost)
    return PeerFit(peer_of(kind, fit.x, fit.coefficients[:, 0], fit.coefficients[:, 1]), fit, rows)
