"""Where lamps are, from the rays that mirror spheres reflect, and from the fall-off of their light on a flat surface.

A lamp at L is described by u / rho seen from the origin o of the scene: u a unit direction, rho the inverse of its
distance. Seen from a point P, it lies in direction u - rho (P - o), which also holds for lamps at infinity (rho = 0):
directions are well determined where positions are not. A flat matt surface with normal z at points X receives light
in proportion to

    E = (u - rho X)_z / |u - rho X|^3 .

All lamps and the outlines of all spheres are fitted together by least squares: highlights in units of their
uncertainty, outlines held by the covariance of their fits, brightness of the surface in units of its own scatter. Of
log E, means over a lamp (its strength) and over a place (reflectance of the surface, shading of the lens) do not count.
Origin and scale follow the outlines while these move: what an outline leaves uncertain, all lamps share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nishiki.capture.mirror_sphere import SphereCamera, reflected_rays

LEAST_FREEDOM = 8  # of the highlights: as many must agree before their uncertainty is taken from their agreement


@dataclass(frozen=True)
class Sighting:
    """Highlight of lamp `lamp` on sphere `sphere`: pixel (2,) (column, row) and its standard deviation."""

    lamp: int
    sphere: int
    pixel: np.ndarray
    sigma_px: float


@dataclass(frozen=True)
class Falloff:
    """Light on a flat surface.

    pixels (n, 2) of the surface, which is the object's plane: to the right of and above the photograph's middle;
    log_light (lamps, n), NaN where saturated or dark.
    """

    pixels: np.ndarray
    log_light: np.ndarray


@dataclass(frozen=True)
class LampFit:
    """Result of `fit_lamps`, in the unit of the spheres' radius; seen from the origin.

    Attributes
    ----------
    directions : (lamps, 3)
        Unit vectors.
    direction_sigma : (lamps,)
        Root mean square error of the direction that the fit expects, radians.
    inverse_distance, inverse_distance_sigma : (lamps,)
        0 where one sphere alone was given.
    position_sigma : (lamps,)
        Root mean square error of the position; infinite where the distance is not determined.
    residuals_px : dict
        Distance of each highlight from where the fit expects it, by (lamp, sphere), pixels.
    chi_square : float
        Mean squared residual of the highlights in units of their uncertainty, by degree of freedom; 1 where the
        uncertainties are right. NaN without redundancy.
    falloff_rms : float
        Root mean square of the relative residuals on the surface; NaN without one.
    pitch : float
        Length of a pixel in the object's plane.
    """

    directions: np.ndarray
    direction_sigma: np.ndarray
    inverse_distance: np.ndarray
    inverse_distance_sigma: np.ndarray
    position_sigma: np.ndarray
    residuals_px: dict[tuple[int, int], float]
    chi_square: float
    falloff_rms: float
    pitch: float

    @property
    def positions(self) -> np.ndarray:
        """(lamps, 3); infinite where the distance is not determined."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.directions / self.inverse_distance[:, None]


def fit_lamps(
    sightings: list[Sighting],
    parameters: list[np.ndarray],
    covariances: list[np.ndarray],
    camera: SphereCamera,
    radius: float,
    origin_of: Callable[[list[np.ndarray]], tuple[np.ndarray, float]],
    *,
    lamps: int,
    near: bool,
    falloff: Falloff | None = None,
) -> LampFit:
    """Directions and, where `near`, distances of all lamps.

    sightings of `lamps` lamps on the spheres whose outlines have these parameters and covariances; radius: of the
    spheres, sets the unit; origin_of: gives, from the outlines' parameters, the origin (3,) of the scene in the
    camera's frame and the length of a pixel in the object's plane; near: fit the distances (two spheres or more, or a
    surface), else lamps are taken to be far away. The distance of a lamp that one sphere alone shows is held loosely
    at the median of the others.
    """
    from scipy.optimize import least_squares

    spheres = len(parameters)
    roots = [np.linalg.cholesky(c + 1e-18 * np.trace(c) * np.eye(3)) for c in covariances]
    which = np.array([s.lamp for s in sightings])
    seen_by = np.array([s.sphere for s in sightings])
    pixels = np.array([s.pixel for s in sightings])
    sigma_px = np.array([s.sigma_px for s in sightings])

    def rays(outlines: list[np.ndarray], at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points, directions = np.empty((2, len(at), 3))
        for k in range(spheres):
            of = seen_by == k
            points[of], directions[of] = reflected_rays(at[of], outlines[k], camera, radius)
        return points - origin_of(outlines)[0], directions

    points, directions = rays(parameters, pixels)
    # Radians on the mirror's picture of the surroundings for a pixel, in both directions.
    steps = [
        np.linalg.norm(rays(parameters, pixels + step)[1] - directions, axis=1) for step in ([0.1, 0.0], [0.0, 0.1])
    ]
    per_pixel = 10 * np.sqrt((steps[0] ** 2 + steps[1] ** 2) / 2)
    start, start_inverse = _start(points, directions, which, lamps, near)
    typical = float(np.median(start_inverse[start_inverse > 0])) if (start_inverse > 0).any() else 0.0
    alone = np.bincount(which, minlength=lamps) < 2
    once = np.flatnonzero(alone & (typical > 0 and falloff is None))
    start_inverse[once] = typical
    across = np.stack([np.linalg.svd(u[None])[2][1:] for u in start])
    unknowns = 3 if near else 2
    scale = float(np.linalg.norm(points, axis=1).max()) or radius  # rho is fitted in units of 1 / scale

    def lamp_of(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = x[: lamps * unknowns].reshape(lamps, unknowns)
        u = start + values[:, 0, None] * across[:, 0] + values[:, 1, None] * across[:, 1]
        inverse = start_inverse + values[:, 2] / scale if near else np.zeros(lamps)
        return u / np.linalg.norm(u, axis=1)[:, None], inverse

    def outlines_of(x: np.ndarray) -> list[np.ndarray]:
        moved = x[lamps * unknowns :].reshape(spheres, 3)
        return [p + root @ m for p, root, m in zip(parameters, roots, moved, strict=True)]

    def highlight_residuals(x: np.ndarray) -> np.ndarray:
        u, inverse = lamp_of(x)
        at, shown = rays(outlines_of(x), pixels)
        towards = u[which] - inverse[which, None] * at
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        away = (towards - shown) / (per_pixel * sigma_px)[:, None]
        return np.concatenate([(away * across[which, 0]).sum(axis=1), (away * across[which, 1]).sum(axis=1)])

    def surface_residuals(x: np.ndarray) -> np.ndarray:
        u, inverse = lamp_of(x)
        places = np.column_stack([falloff.pixels * origin_of(outlines_of(x))[1], np.zeros(len(falloff.pixels))])
        towards = u[:, None, :] - inverse[:, None, None] * places
        expected = np.log(np.maximum(towards[..., 2], 1e-9)) - 1.5 * np.log((towards**2).sum(axis=-1))
        return _centred(falloff.log_light - expected)

    spread = 0.01

    def residuals(x: np.ndarray) -> np.ndarray:
        parts = [highlight_residuals(x), x[lamps * unknowns :]]
        if len(once):
            parts.append(lamp_of(x)[1][once] / typical - 1)
        if falloff is not None:
            parts.append(surface_residuals(x) / spread)
        return np.concatenate(parts)

    x = np.zeros(lamps * unknowns + 3 * spheres)
    freedom = 2 * len(sightings) - lamps * unknowns + len(once)
    chi = float("nan")
    for _ in range(3 if falloff is not None or freedom >= LEAST_FREEDOM else 1):
        fit = least_squares(residuals, x, x_scale="jac", method="trf", ftol=1e-10, xtol=1e-10, max_nfev=40)
        x = fit.x
        if falloff is not None:
            spread = max(float(np.sqrt((surface_residuals(x) ** 2).mean())), 1e-4)
        left = highlight_residuals(x).reshape(2, -1)
        chi = float((left**2).sum() / freedom) if freedom > 0 else chi
        if freedom >= LEAST_FREEDOM:  # many highlights that agree better than expected are that good
            sigma_px = sigma_px * min(1.0, np.sqrt(chi))
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)
    u, inverse = lamp_of(x)
    # Where highlights disagree by more than their own uncertainty, all uncertainties grow with that.
    worse = max(1.0, chi) if freedom > 0 else 1.0
    blocks = [covariance[i * unknowns : (i + 1) * unknowns, i * unknowns : (i + 1) * unknowns] for i in range(lamps)]
    direction_sigma = np.array([np.sqrt(worse * (b[0, 0] + b[1, 1])) for b in blocks])
    inverse_sigma = np.array([np.sqrt(worse * b[2, 2]) / scale for b in blocks]) if near else np.zeros(lamps)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = 1 / inverse
        position_sigma = np.sqrt((direction_sigma * distance) ** 2 + (inverse_sigma * distance**2) ** 2)
    position_sigma = np.where((inverse > 0) & near, position_sigma, np.inf)
    off = np.linalg.norm(highlight_residuals(x).reshape(2, -1), axis=0) * sigma_px
    return LampFit(
        u,
        direction_sigma,
        inverse,
        inverse_sigma,
        position_sigma,
        {(s.lamp, s.sphere): float(px) for s, px in zip(sightings, off, strict=True)},
        chi,
        spread if falloff is not None else float("nan"),
        origin_of(outlines_of(x))[1],
    )


def _start(points, directions, which, lamps, near) -> tuple[np.ndarray, np.ndarray]:
    """Directions (lamps, 3) and inverse distances: the point nearest to a lamp's rays, else their mean direction."""
    u, inverse = np.empty((lamps, 3)), np.zeros(lamps)
    for lamp in range(lamps):
        at, rays = points[which == lamp], directions[which == lamp]
        u[lamp] = rays.mean(axis=0)
        if near and len(rays) > 1:
            projections = np.eye(3) - rays[:, :, None] * rays[:, None, :]
            matrix = projections.sum(axis=0)
            place = np.linalg.lstsq(matrix, (projections @ at[:, :, None]).sum(axis=0)[:, 0], rcond=None)[0]
            if place @ u[lamp] > 0:
                u[lamp], inverse[lamp] = place, 1 / np.linalg.norm(place)
    return u / np.linalg.norm(u, axis=1)[:, None], inverse


def _centred(values: np.ndarray) -> np.ndarray:
    """Values (lamps, places) less the means over both, as a vector without those that are not known."""
    known = np.isfinite(values)
    rest = np.where(known, values, 0.0)
    for _ in range(5):  # settles the means where some are not known; once is exact where all are
        rest -= np.where(known, rest.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1), 0)
        if len(rest) > 2:
            rest -= np.where(known, rest.sum(axis=0) / np.maximum(known.sum(axis=0), 1), 0)
    return rest[known]
