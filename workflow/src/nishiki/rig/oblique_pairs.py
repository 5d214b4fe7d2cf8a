"""The oblique pairs of directions that tell most of a cloth of which nothing has been measured yet.

The cloth chain chooses oblique images from its fit to normal incidence (`nishiki.brdf.cloth.oblique`). Before any
photograph, its prior knowledge of yarns stands for that fit, with the information that the planned views of normal
incidence will add to it.
"""

from __future__ import annotations

import numpy as np

from nishiki.brdf.cloth.oblique import choose_oblique
from nishiki.brdf.cloth.parametric import ShapeFit
from nishiki.brdf.cloth.yarn_facets import CENTRE, SPREAD
from nishiki.brdf.cloth.yarn_fit import LAMBERT, Measured, normal_weights, parts_of
from nishiki.goniometry.directions import between, unit

BODY_ALBEDO = 0.2  # of a cloth of medium colour
STEP = 0.02  # of the finite differences; the parameters are logarithms
GRID_DEG = 15.0  # of the candidates
STEEPEST_DEG = 75.0


def expected_fit(views: np.ndarray) -> ShapeFit:
    """What a fit to views (n, 3) of normal incidence will leave open, before they are measured."""
    incident = np.tile([0.0, 0.0, 1.0], (len(views), 1))
    parts = parts_of(incident, views)
    coefficients = np.array([[BODY_ALBEDO, LAMBERT]])

    def predicted(x: np.ndarray) -> np.ndarray:
        fixed, columns = parts(x)
        return fixed + columns @ coefficients[0]

    values = predicted(CENTRE)
    measured = Measured(incident, views, values[:, None], np.ones(len(views), bool), True)
    steps = STEP * np.eye(CENTRE.size)
    slopes = np.stack([(predicted(CENTRE + s) - predicted(CENTRE - s)) / (2 * STEP) for s in steps], axis=1)
    weighted = slopes * normal_weights(measured)[:, None]
    information = weighted.T @ weighted + np.diag(1 / SPREAD**2)
    return ShapeFit(CENTRE.copy(), coefficients, information, cost=0.0, misfit=0.0, evaluations=0)


def candidate_pairs(separation_deg: float) -> np.ndarray:
    """(n, 4) degrees: theta_i, phi_i, theta_r, phi_r of oblique pairs of a weave with two mirror planes.

    The lamp stays in the quarter from weft to warp; the camera goes all round.
    """
    lamps = [(t, p) for t in np.arange(GRID_DEG, STEEPEST_DEG + 1, GRID_DEG) for p in np.arange(0, 91, GRID_DEG)]
    views = [(0.0, 0.0)]
    views += [(t, p) for t in np.arange(GRID_DEG, STEEPEST_DEG + 1, GRID_DEG) for p in np.arange(0, 360, GRID_DEG)]
    pairs = np.array([(*lamp, *view) for lamp in lamps for view in views])
    incident, outgoing = unit(*np.radians(pairs[:, :2]).T), unit(*np.radians(pairs[:, 2:]).T)
    return pairs[np.degrees(between(incident, outgoing)) >= separation_deg - 1e-6]


def recommend_oblique(views_deg: np.ndarray, count: int, separation_deg: float) -> list[tuple[float, ...]]:
    """Pairs (theta_i, phi_i, theta_r, phi_r) in degrees, by lamp, that go with views (n, 2) of normal incidence."""
    pairs = candidate_pairs(separation_deg)
    fit = expected_fit(unit(*np.radians(views_deg).T))
    incident, outgoing = unit(*np.radians(pairs[:, :2]).T), unit(*np.radians(pairs[:, 2:]).T)
    chosen = pairs[choose_oblique(fit, incident, outgoing, count)]
    return [tuple(map(float, pair)) for pair in chosen[np.lexsort(chosen.T[::-1])]]
