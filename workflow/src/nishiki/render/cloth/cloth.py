"""A square of cloth that falls over a ball or a round table and comes to rest, from a coarse grid to a fine one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from nishiki.errors import UserError
from nishiki.render.cloth.cloth_kernels import steps

GRAVITY = 9.81
KINDS = {"ball": 0, "table": 1}
SEARCH_EVERY = 10
"""Time steps between two searches for points of the sheet that are near each other."""


@dataclass(frozen=True)
class Support:
    """What the cloth falls on, standing on the floor y = 0, its axis the y axis; metres.

    kind: ball or table; radius; top: height of its highest point; edge: radius of the table's rounded rim.
    """

    kind: Literal["ball", "table"] = "ball"
    radius: float = 0.16
    top: float = 0.46
    edge: float = 0.012


@dataclass(frozen=True)
class Cloth:
    """side: of the square, m; weight: kg/m2; stretch, shear: N/m; bend: N m; friction: on the support (Coulomb)."""

    side: float = 1.0
    weight: float = 0.25
    stretch: float = 1500.0
    shear: float = 20.0
    bend: float = 1.5e-4
    friction: float = 0.35


@dataclass(frozen=True)
class Draped:
    """points (n, n, 3) float64, metres: [i, j] at weft i, warp j; settled: root mean square speed at the end, m/s;
    strain: root mean square and largest relative change of the yarns' length; nearest: least distance of two points of
    the sheet that are not neighbours, in spacings of the grid; spacing: of the grid, m."""

    points: np.ndarray
    spacing: float
    settled: float
    strain: float
    strain_largest: float
    nearest: float


def drape(
    support: Support,
    cloth: Cloth,
    *,
    levels: tuple[int, ...] = (33, 65, 129),
    seconds: tuple[float, ...] = (1.5, 0.6, 0.25),
    turned: float = 0.3,
    seed: int = 1,
) -> Draped:
    """The cloth at rest, deterministic.

    levels: points along a side, coarse to fine; each finer grid starts from the smooth surface through the coarser
    one. seconds: simulated time on each. turned: radians by which the square is turned about the vertical. seed: of
    the small waves (2 mm) with which it starts, without which its folds would be a mirror image of themselves.
    """
    _check(support, cloth, levels, seconds)
    points = _flat(cloth.side, levels[0], support.top, turned, seed)
    speed = 0.0
    for n, duration in zip(levels, seconds, strict=True):
        if n != len(points):
            points = refined(points, n)
        points, speed = _settle(points, support, cloth, duration)
    spacing = cloth.side / (len(points) - 1)
    lengths = np.concatenate([np.linalg.norm(np.diff(points, axis=k), axis=2).ravel() for k in (0, 1)])
    strain = lengths / spacing - 1
    return Draped(
        points,
        spacing,
        speed,
        float(np.sqrt(np.mean(strain**2))),
        float(np.abs(strain).max()),
        _nearest(points, spacing),
    )


def _check(support: Support, cloth: Cloth, levels, seconds) -> None:
    if support.kind not in KINDS:
        raise UserError(f"drape: expected a support {' or '.join(KINDS)}, found {support.kind!r}")
    if len(levels) != len(seconds) or min(levels) < 5 or list(levels) != sorted(set(levels)):
        raise UserError(f"drape: expected rising levels of 5 points or more, one time each; found {levels}, {seconds}")
    sizes = (support.radius, support.top, support.edge, cloth.side, cloth.weight, cloth.stretch, cloth.shear)
    if not all(np.isfinite(size) and size > 0 for size in (*sizes, *seconds)):
        raise UserError(f"drape: expected sizes, weights, stiffnesses and times above 0, found {support}, {cloth}")
    if not (cloth.bend >= 0 and cloth.friction >= 0):
        raise UserError(f"drape: expected a stiffness and a friction of 0 or more, found {cloth}")


def _flat(side: float, n: int, height: float, turned: float, seed: int) -> np.ndarray:
    """The sheet as it starts: level, just above the support, with waves of 2 mm."""
    u, v = np.meshgrid(*(np.linspace(-0.5, 0.5, n),) * 2, indexing="ij")
    rng = np.random.default_rng(seed)
    waves = np.zeros_like(u)
    for _ in range(8):
        along, across, phase = rng.uniform(-6, 6), rng.uniform(-6, 6), rng.uniform(0, 2 * np.pi)
        waves += np.sin(2 * np.pi * (along * u + across * v) + phase)
    x = side * (np.cos(turned) * u + np.sin(turned) * v)
    z = side * (np.sin(turned) * u - np.cos(turned) * v)
    waves -= waves[n // 2, n // 2]
    return np.stack([x, height + 0.002 + 0.002 * waves / 8, z], axis=2)


def refined(points: np.ndarray, n: int) -> np.ndarray:
    """(n, n, 3): the bicubic spline through a grid of points (m, m, 3), at n points a side."""
    from scipy.interpolate import RectBivariateSpline

    at, to = np.linspace(0, 1, len(points)), np.linspace(0, 1, n)
    return np.stack([RectBivariateSpline(at, at, points[..., k])(to, to) for k in range(3)], axis=2)


def _settle(points: np.ndarray, support: Support, cloth: Cloth, duration: float) -> tuple[np.ndarray, float]:
    """The sheet after `duration` seconds, and its root mean square speed."""
    n = len(points)
    spacing = cloth.side / (n - 1)
    thickness = 0.85 * spacing
    # A wave of the stretched sheet may cross at most about a spacing in a step: then one sweep a step is enough.
    dt = min(2e-3, 0.06 * spacing)
    mass = cloth.weight * spacing**2
    scale = mass / dt**2
    softness = np.array([scale / cloth.stretch, scale / cloth.shear, scale * spacing**2 / max(cloth.bend, 1e-12)])
    shape = np.array([KINDS[support.kind], support.radius, support.top, support.edge])
    x, v = np.ascontiguousarray(points), np.zeros_like(points)
    total = max(1, round(duration / dt))
    for first in range(0, total, SEARCH_EVERY):
        count = min(SEARCH_EVERY, total - first)
        pairs = _pairs(x, spacing, thickness)
        # Heavy damping in the last third: what still swings then would only swing for long.
        damping = 5.0 if first < total * 2 / 3 else 20.0
        steps(x, v, pairs, count, dt, GRAVITY, damping, spacing, softness, shape, 0.002, thickness, cloth.friction)
    return x, float(np.sqrt(np.mean(np.sum(v * v, axis=2))))


def _pairs(x: np.ndarray, spacing: float, thickness: float) -> np.ndarray:
    """Pairs (k, 2) of points that may come too near before the next search, without neighbours on the grid; sorted."""
    found = _near(x, thickness + 0.5 * spacing)
    return np.ascontiguousarray(found, np.int64)


def _near(x: np.ndarray, reach: float) -> np.ndarray:
    from scipy.spatial import cKDTree

    n = len(x)
    pairs = cKDTree(x.reshape(-1, 3)).query_pairs(reach, output_type="ndarray")
    rows, columns = pairs // n, pairs % n
    apart = np.maximum(np.abs(rows[:, 0] - rows[:, 1]), np.abs(columns[:, 0] - columns[:, 1])) > 2
    pairs = np.sort(pairs[apart], axis=1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _nearest(x: np.ndarray, spacing: float) -> float:
    """Least distance of points that are not neighbours, in spacings; 2 where none are nearer."""
    pairs = _near(x, 2 * spacing)
    flat = x.reshape(-1, 3)
    return min(2.0, float(np.linalg.norm(flat[pairs[:, 0]] - flat[pairs[:, 1]], axis=1).min(initial=np.inf)) / spacing)
