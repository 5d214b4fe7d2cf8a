"""The cloth that pictures of cloths show: a square that falls over a ball and comes to rest.

    python benchmarks/draped_cloth.py
    python benchmarks/draped_cloth.py --output workflow/src/nishiki/render/cloth/draped_cloth.npz

One line of JSON: how far it came to rest, how much its yarns are strained, its least distance to itself. The package
ships the surface that --output wrote, so that no picture needs a simulation. Deterministic: the same machine writes the
same file.

Extended position-based dynamics. M. Macklin, M. Mueller, N. Chentanez: XPBD, Motion in Games 2016: a constraint C with
compliance a moves its points along their gradients g by -C w g / (sum w g^2 + a / dt^2); one iteration in many small
steps (Macklin et al., Small steps in physics simulation, SCA 2019), so that the multipliers start at zero in every
step. Points are visited in one fixed order: turned round from step to step, the sheet would tremble.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from numba import njit
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "workflow/src"))
from nishiki.render.cloth.surfaces import STEP

SIDE = 1.0
"""Side of the square, m."""
TURNED = np.radians(17)
"""Of the square about the vertical."""
WEIGHT, STRETCH, SHEAR, BEND = 0.25, 1500.0, 20.0, 1.5e-4
"""kg/m2, N/m, N/m, N m."""
BALL_RADIUS, BALL_TOP = 0.16, 0.46
"""Of the ball, and the height of its highest point over the floor, m."""
FRICTION = 0.35
"""On ball and floor (Coulomb)."""
GRAVITY, GAP = 9.81, 0.002
"""m/s2; least distance to the ball and the floor, m."""
LEVELS = ((33, 1.5), (65, 0.6), (129, 0.25))
"""Points along a side, coarse to fine, and the seconds simulated with each."""
SEARCH_EVERY = 10
"""Time steps between two searches for points of the sheet that are near each other."""


def drape(levels=LEVELS, *, bend: float = BEND, seed: int = 1) -> tuple[np.ndarray, float]:
    """Points (n, n, 3) at rest, metres, [i, j] at weft i and warp j; their root mean square speed at the end, m/s.

    Each finer grid starts from the smooth surface through the coarser one. seed: of the small waves (2 mm) with which
    it starts, without which its folds would be a mirror image of themselves.
    """
    points, speed = flat(levels[0][0], seed), 0.0
    for n, duration in levels:
        if n != len(points):
            points = refined(points, n)
        points, speed = settle(points, duration, bend)
    return points, speed


def flat(n: int, seed: int) -> np.ndarray:
    """The sheet as it starts: level, just above the ball, with waves of 2 mm."""
    u, v = np.meshgrid(*(np.linspace(-0.5, 0.5, n),) * 2, indexing="ij")
    rng = np.random.default_rng(seed)
    waves = np.zeros_like(u)
    for _ in range(8):
        along, across, phase = rng.uniform(-6, 6), rng.uniform(-6, 6), rng.uniform(0, 2 * np.pi)
        waves += np.sin(2 * np.pi * (along * u + across * v) + phase)
    x = SIDE * (np.cos(TURNED) * u + np.sin(TURNED) * v)
    z = SIDE * (np.sin(TURNED) * u - np.cos(TURNED) * v)
    waves -= waves[n // 2, n // 2]
    return np.stack([x, BALL_TOP + 0.002 + 0.002 * waves / 8, z], axis=2)


def refined(points: np.ndarray, n: int) -> np.ndarray:
    """(n, n, 3): the bicubic spline through a grid of points (m, m, 3), at n points a side."""
    at, to = np.linspace(0, 1, len(points)), np.linspace(0, 1, n)
    return np.stack([RectBivariateSpline(at, at, points[..., k])(to, to) for k in range(3)], axis=2)


def settle(points: np.ndarray, duration: float, bend: float) -> tuple[np.ndarray, float]:
    """The sheet after `duration` seconds, and its root mean square speed."""
    spacing = SIDE / (len(points) - 1)
    thickness = 0.85 * spacing
    # A wave of the stretched sheet may cross at most about a spacing in a step: then one sweep a step is enough.
    dt = min(2e-3, 0.06 * spacing)
    scale = WEIGHT * spacing**2 / dt**2
    softness = np.array([scale / STRETCH, scale / SHEAR, scale * spacing**2 / bend])
    x, v = np.ascontiguousarray(points), np.zeros_like(points)
    total = max(1, round(duration / dt))
    for first in range(0, total, SEARCH_EVERY):
        count = min(SEARCH_EVERY, total - first)
        pairs = near(x, thickness + 0.5 * spacing)
        # Heavy damping in the last third: what still swings then would only swing for long.
        steps(x, v, pairs, count, dt, 5.0 if first < total * 2 / 3 else 20.0, spacing, softness, thickness)
    return x, float(np.sqrt(np.mean(np.sum(v * v, axis=2))))


def near(x: np.ndarray, reach: float) -> np.ndarray:
    """Pairs (k, 2) of points within reach of each other that are no neighbours on the grid, sorted."""
    n = len(x)
    pairs = cKDTree(x.reshape(-1, 3)).query_pairs(reach, output_type="ndarray")
    rows, columns = pairs // n, pairs % n
    apart = np.maximum(np.abs(rows[:, 0] - rows[:, 1]), np.abs(columns[:, 0] - columns[:, 1])) > 2
    pairs = np.sort(pairs[apart], axis=1)
    return np.ascontiguousarray(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))], np.int64)


def figures_of(points: np.ndarray) -> dict[str, float]:
    """Strain of the yarns, root mean square and largest; least distance of points that are no neighbours, in spacings
    (2: none is nearer); highest and lowest point, m."""
    spacing = SIDE / (len(points) - 1)
    lengths = np.concatenate([np.linalg.norm(np.diff(points, axis=k), axis=2).ravel() for k in (0, 1)])
    strain = lengths / spacing - 1
    ends = points.reshape(-1, 3)[near(points, 2 * spacing)]
    nearest = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).min(initial=2 * spacing) / spacing
    height = points[..., 1]
    return {
        "strain": float(np.sqrt(np.mean(strain**2))), "strain_largest": float(np.abs(strain).max()),
        "nearest": float(nearest), "highest": float(height.max()), "lowest": float(height.min()),
    }  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def keep_length(x, ai, aj, bi, bj, rest, softness):
    """Draw two points of equal mass to their distance at rest; softness: a / (w dt^2)."""
    dx, dy, dz = x[bi, bj, 0] - x[ai, aj, 0], x[bi, bj, 1] - x[ai, aj, 1], x[bi, bj, 2] - x[ai, aj, 2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length < 1e-12:
        return
    move = (length - rest) / (length * (2.0 + softness))
    x[ai, aj, 0] += move * dx
    x[ai, aj, 1] += move * dy
    x[ai, aj, 2] += move * dz
    x[bi, bj, 0] -= move * dx
    x[bi, bj, 1] -= move * dy
    x[bi, bj, 2] -= move * dz


@njit(cache=True, nogil=True, error_model="numpy")
def keep_straight(x, ai, aj, bi, bj, ci, cj, softness):
    """Draw three points in a row towards a straight line.

    The curvature a - 2 b + c, a vector: bending energy quadratic in it, as for sheets that hardly stretch (Bergou et
    al., A quadratic bending model for inextensible surfaces, SGP 2006).
    """
    for k in range(3):
        move = (x[ai, aj, k] - 2.0 * x[bi, bj, k] + x[ci, cj, k]) / (6.0 + softness)
        x[ai, aj, k] -= move
        x[bi, bj, k] += 2.0 * move
        x[ci, cj, k] -= move


@njit(cache=True, nogil=True, error_model="numpy")
def keep_shape(x, spacing, stretch, shear, bend):
    """One sweep over all constraints of the sheet x (n, n, 3); the three softnesses as in the functions above."""
    n, diagonal = x.shape[0], spacing * np.sqrt(2.0)
    for i in range(n):
        for j in range(n):
            if i > 0 and i < n - 1:
                keep_straight(x, i - 1, j, i, j, i + 1, j, bend)
            if j > 0 and j < n - 1:
                keep_straight(x, i, j - 1, i, j, i, j + 1, bend)
            if i < n - 1 and j < n - 1:
                keep_length(x, i, j, i + 1, j + 1, diagonal, shear)
                keep_length(x, i + 1, j, i, j + 1, diagonal, shear)
            if i < n - 1:
                keep_length(x, i, j, i + 1, j, spacing, stretch)
            if j < n - 1:
                keep_length(x, i, j, i, j + 1, spacing, stretch)


@njit(cache=True, nogil=True, error_model="numpy")
def keep_apart(x, before, pairs, thickness, friction):
    """Push points of the sheet apart that are nearer than `thickness`; they rub on each other.

    pairs (k, 2): numbers of points in the flattened grid; before: where the points were at the start of the step.
    """
    flat, old = x.reshape(-1, 3), before.reshape(-1, 3)
    for p in range(len(pairs)):
        a, b = pairs[p, 0], pairs[p, 1]
        dx, dy, dz = flat[b, 0] - flat[a, 0], flat[b, 1] - flat[a, 1], flat[b, 2] - flat[a, 2]
        square = dx * dx + dy * dy + dz * dz
        if square >= thickness * thickness or square < 1e-18:
            continue
        length = np.sqrt(square)
        move = 0.5 * (thickness - length) / length
        for k, d in ((0, dx), (1, dy), (2, dz)):
            flat[a, k] -= move * d
            flat[b, k] += move * d
            slip = 0.5 * friction * ((flat[b, k] - old[b, k]) - (flat[a, k] - old[a, k]))
            flat[a, k] += slip
            flat[b, k] -= slip


@njit(cache=True, nogil=True, error_model="numpy")
def lay_on(x, before, gap, friction):
    """Push the points out of the ball and of the floor y = 0, at least `gap` away; Coulomb friction on both."""
    n = x.shape[0]
    for i in range(n):
        for j in range(n):
            for ground in range(2):
                depth, nx, ny, nz = x[i, j, 1], 0.0, 1.0, 0.0
                if ground == 0:
                    dx, dy, dz = x[i, j, 0], x[i, j, 1] - (BALL_TOP - BALL_RADIUS), x[i, j, 2]
                    length = np.sqrt(dx * dx + dy * dy + dz * dz)
                    depth, nx, ny, nz = length - BALL_RADIUS, dx / length, dy / length, dz / length
                depth = gap - depth
                if depth <= 0.0:
                    continue
                x[i, j, 0] += depth * nx
                x[i, j, 1] += depth * ny
                x[i, j, 2] += depth * nz
                mx, my, mz = x[i, j, 0] - before[i, j, 0], x[i, j, 1] - before[i, j, 1], x[i, j, 2] - before[i, j, 2]
                along = mx * nx + my * ny + mz * nz
                mx, my, mz = mx - along * nx, my - along * ny, mz - along * nz
                slip = np.sqrt(mx * mx + my * my + mz * mz)
                held = 1.0 if slip <= friction * depth else friction * depth / slip
                x[i, j, 0] -= held * mx
                x[i, j, 1] -= held * my
                x[i, j, 2] -= held * mz


@njit(cache=True, nogil=True, error_model="numpy")
def even_out(v, old, share):
    """Internal friction: each velocity drawn to the mean of its neighbours' by `share`; old is scratch.

    One sweep a step in a fixed order is not symmetric and would feed the shortest waves of the grid; this takes more
    from them than they get.
    """
    old[...] = v
    n = v.shape[0]
    for i in range(n):
        for j in range(n):
            for k in range(3):
                change, c = 0.0, old[i, j, k]
                change += old[i - 1, j, k] - c if i > 0 else 0.0
                change += old[i + 1, j, k] - c if i < n - 1 else 0.0
                change += old[i, j - 1, k] - c if j > 0 else 0.0
                change += old[i, j + 1, k] - c if j < n - 1 else 0.0
                v[i, j, k] += 0.25 * share * change


@njit(cache=True, nogil=True, error_model="numpy")
def steps(x, v, pairs, count, dt, damping, spacing, softness, thickness):
    """`count` time steps of the sheet x with velocities v, both (n, n, 3) and changed in place.

    The middle point is held, or the sheet would slide off the ball. softness: of stretch, shear and bend.
    """
    before = np.empty_like(x)
    keep = np.exp(-damping * dt)
    fastest = 0.5 * thickness / dt
    n = x.shape[0]
    for _ in range(count):
        before[...] = x
        for i in range(n):
            for j in range(n):
                v[i, j, 1] -= GRAVITY * dt
                speed = np.sqrt(v[i, j, 0] ** 2 + v[i, j, 1] ** 2 + v[i, j, 2] ** 2)
                scale = keep * (fastest / speed if speed > fastest else 1.0)
                for k in range(3):
                    v[i, j, k] *= scale
                    x[i, j, k] += dt * v[i, j, k]
        keep_shape(x, spacing, softness[0], softness[1], softness[2])
        keep_apart(x, before, pairs, thickness, 0.2)
        x[n // 2, n // 2] = before[n // 2, n // 2]
        lay_on(x, before, GAP, FRICTION)
        for i in range(n):
            for j in range(n):
                for k in range(3):
                    v[i, j, k] = (x[i, j, k] - before[i, j, k]) / dt
        even_out(v, before, 0.3)


def write_drape(path: Path, points: np.ndarray) -> None:
    """Write a grid of points (n, n, 3), metres, as whole steps of 2 micrometres.

    Differences of differences along both axes are small, so that they compress to half of what single precision takes.
    """
    steps = np.round(points / STEP).astype(np.int32)
    differences = np.diff(np.diff(steps, axis=0, prepend=0), axis=1, prepend=0)
    np.savez_compressed(path, differences=differences)


def main() -> None:
    """Let it fall; write it where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="file to write")
    arguments = parser.parse_args()
    points, speed = drape()
    if arguments.output:
        write_drape(arguments.output, points)
    print(json.dumps({"points": len(points), "speed": speed, **figures_of(points)}))


if __name__ == "__main__":
    main()
