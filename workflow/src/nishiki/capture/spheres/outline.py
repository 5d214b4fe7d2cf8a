"""Outlines of mirror spheres, from the edges that photographs under different lamps share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nishiki.capture.spheres.optics import SphereCamera, circle_of, outline_points

ANGLES = 360  # directions from the seed's centre in which an edge is looked for
ALONG = 16  # directions over which profiles are smoothed on either side
STEP_PX = 1 / 3  # along a ray
LEAST_RISE = 0.15  # of the strongest change along a ray, from which a brightening is an edge
GROWTH_PX, MOVE_PX = (0.0, 2.0, 0.2), (-0.5, 0.6, 0.25)  # of the rim beyond the strongest edges: first, last, step
LEAST_GROWTH_PX = 0.05  # below which the strongest edges are those of the rim
LEAST_ABSOLUTE = 8  # fits of least absolute distances, before as many of least squares
NEAR_PX, TURNS = 0.6, 4  # of the rim: edges that are fitted, and how often
SECTORS = 12  # of the outline, left out one after the other for its uncertainty
SECTORS_OF_SUPPORT = 72  # of a circle, in each of which an edge may support it
LEAST_SUPPORT = 0.3  # share of the outline on which an edge must have been found
MOST_MAXIMA = 40  # of Hough's transform that are settled
GRADIENT_CAP = 0.15  # of the logarithm of the light, by pixel
DARKEST = 0.003  # of full scale, added before logarithms are taken
REFLECTION_PX = 0.15  # how far what the rim reflects shifts the whole edge, which no part of the edge tells


@dataclass(frozen=True)
class Outline:
    """Outline of a sphere."""

    parameters: np.ndarray  # (3,): m for a perspective camera, (column, row, radius) in pixels for an orthographic one
    # (3, 3): of the parameters: the jackknife over sectors of the outline, and a shift and growth of all of it by
    # `REFLECTION_PX`
    covariance: np.ndarray
    rms_px: float  # root mean square distance of the edge points used
    support: float  # share of the directions in which the edge was found
    points: np.ndarray  # (n, 2): edge points used (column, row)

    def circle(self, camera: SphereCamera) -> tuple[float, float, float]:
        """Compute column, row and radius in pixels of the circle nearest to the outline."""
        return circle_of(self.parameters, camera)

    def under(self, camera: SphereCamera) -> "Outline":
        """Fit the outline for another camera to the same edge points."""
        parameters = solve_outline(self.points, camera)
        covariance = _jackknife(self.points, circle_of(parameters, camera), camera) + _shift_covariance(
            parameters, camera
        )
        rms = float(np.sqrt((_distances(self.points, parameters, camera) ** 2).mean()))
        return Outline(parameters, covariance, rms, self.support, self.points)


class Circle(NamedTuple):
    """A circle in pixels, and the share of its visible sectors along which an edge runs."""

    column: float
    row: float
    radius: float
    support: float


def fit_outline(stack: np.ndarray, seed: Sequence[float], camera: SphereCamera, corner=(0, 0)) -> Outline:
    """Fit the outline of a sphere near a circle.

    The ellipse that the camera sees is fitted to the strongest edges along rays from the circle's centre, and then to
    those that grow brighter outwards. A mirror shows at its rim what lies beside it, no brighter: an edge that grows
    darker is the end of the reflected ground or of the sphere's shadow, inside the rim.

    Parameters
    ----------
    stack : (pictures, rows, columns) float32
        Crops of all photographs around the sphere, linear.
    seed : (column, row, radius)
        In pixels of the whole photograph, to a twentieth of the radius.
    camera : SphereCamera
    corner : (int, int)
        Column and row of the crop's corner.

    Raises
    ------
    ValueError
        Where no outline was found.
    """
    circle = np.array(seed, float)
    circle[:2] -= corner
    for share, least_px in ((0.06, 3.0), (0.03, 2.5), (0.03, 2.5)):
        reach = max(share, least_px / circle[2])
        grid, strength, _ = _edge_strengths(stack, circle, reach)
        peak, part = _peaks(strength)
        at = np.where(peak, strength, 0).argmax(axis=1)
        parameters, points = _fit_robustly(grid, part, at, np.any(peak, axis=1), camera, corner)
        circle = np.array(circle_of(parameters, camera))
        circle[:2] -= corner
    grid, strength, rising = _edge_strengths(stack, circle, 2 * reach)
    peak, part = _peaks(rising)
    peak &= rising > LEAST_RISE * strength.max(axis=1, keepdims=True)
    for turn in range(TURNS):
        away = _distances(grid.reshape(-1, 2) + corner, parameters, camera).reshape(peak.shape)
        rim = np.zeros(ANGLES) if turn else _seek_rim(away, peak)
        if turn == 0 and rim.mean() < LEAST_GROWTH_PX:
            break
        away = np.where(peak, np.abs(away + STEP_PX * part - rim[:, None]), np.inf)
        near, at = away.min(axis=1) < NEAR_PX, away.argmin(axis=1)
        parameters, points = _fit_robustly(grid, part, at, near, camera, corner)
    return Outline(parameters, np.zeros((3, 3)), 0.0, len(points) / ANGLES, points).under(camera)


def _edge_strengths(stack: np.ndarray, circle: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure how strongly pictures change along rays from a circle's centre, and how strongly they brighten outwards.

    stack (pictures, rows, columns); reach: of the rays, relative to the radius, inwards and outwards. Returns places
    (ANGLES, steps, 2) column and row, and root mean squares over the pictures (ANGLES, steps) of both.
    """
    import cv2

    radii = np.arange(max(1.0, circle[2] * (1 - reach)), circle[2] * (1 + reach), STEP_PX)
    turn = np.linspace(0, 2 * np.pi, ANGLES, endpoint=False)[:, None]
    x, y = circle[0] + np.cos(turn) * radii, circle[1] + np.sin(turn) * radii
    inside = (x >= 0) & (x <= stack.shape[2] - 1) & (y >= 0) & (y <= stack.shape[1] - 1)
    total = np.zeros((2, *x.shape))
    for picture in stack:
        profile = cv2.remap(
            picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        wrapped = np.concatenate([profile[-ALONG:], profile, profile[:ALONG]])
        smooth = cv2.GaussianBlur(wrapped, (0, 0), sigmaX=2.0, sigmaY=ALONG / 4)[ALONG:-ALONG]
        change = np.gradient(smooth, axis=1)
        total += np.square([change, np.maximum(change, 0)])
    strength, rising = np.where(inside, np.sqrt(total / len(stack)), 0.0)
    return np.stack([x, y], axis=2), strength, rising


def _seek_rim(away: np.ndarray, peak: np.ndarray) -> np.ndarray:
    """Find by how much (ANGLES,) to move and grow an outline, in pixels along each ray, to pass through most edges.

    away (ANGLES, steps): distances from the outline; peak (ANGLES, steps): edges, of whatever strength.
    """
    from scipy.ndimage import gaussian_filter1d

    turn = np.linspace(0, 2 * np.pi, ANGLES, endpoint=False)
    moves = np.meshgrid(np.arange(*GROWTH_PX), *2 * [np.arange(*MOVE_PX)], indexing="ij")
    trials = np.reshape(moves, (3, -1)).T @ [np.ones(ANGLES), np.cos(turn), np.sin(turn)]
    edges, ray = gaussian_filter1d(peak.astype(np.float64), 1.0, axis=1), np.arange(ANGLES)
    step = np.clip((trials - away[:, 0]) / STEP_PX, 0, peak.shape[1] - 2)
    first = step.astype(int)
    near = edges[ray, first] * (1 - step + first) + edges[ray, first + 1] * (step - first)
    return trials[int(near.mean(axis=1).argmax())]


def _peaks(strength: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the local maxima (ANGLES, steps) along rays, and the parts of a step that lie between them and the place."""
    before, here, after = strength[:, :-2], strength[:, 1:-1], strength[:, 2:]
    peak = (here > before) & (here >= after)
    part = np.where(peak, 0.5 * (before - after) / np.where(peak, before - 2 * here + after, 1.0), 0.0)
    return np.pad(peak, ((0, 0), (1, 1))), np.pad(part, ((0, 0), (1, 1)))


def _fit_robustly(
    grid: np.ndarray, part: np.ndarray, at: np.ndarray, found: np.ndarray, camera: SphereCamera, corner: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the outline through edges at a step (ANGLES,) of each ray, without those that lie off it.

    Returns its parameters and the points (n, 2) used.
    """
    if found.sum() < LEAST_SUPPORT * ANGLES:
        raise ValueError(f"an edge along {100 * found.mean():.0f} % of the outline only")
    ray = np.flatnonzero(found)
    step = grid[ray, 1] - grid[ray, 0]
    pixels = grid[ray, at[ray]] + part[ray, at[ray], None] * step + corner
    keep, weights = np.ones(len(pixels), bool), np.ones(len(pixels))
    for turn in range(2 * LEAST_ABSOLUTE):
        parameters = solve_outline(pixels[keep], camera, weights[keep])
        distance = _distances(pixels, parameters, camera)
        if turn < LEAST_ABSOLUTE:
            weights = 1 / np.maximum(np.abs(distance), 0.1)
            continue
        weights = np.ones(len(pixels))
        spread = 1.4826 * np.median(np.abs(distance[keep]))
        keep = np.abs(distance) < max(3 * spread, 0.3)
    if keep.sum() < LEAST_SUPPORT * ANGLES:
        raise ValueError(f"edges that agree along {100 * keep.sum() / ANGLES:.0f} % of the outline only")
    return parameters, pixels[keep]


def solve_outline(pixels: np.ndarray, camera: SphereCamera, weights: np.ndarray | None = None) -> np.ndarray:
    """Fit the parameters of the outline through edge points, by linear least squares."""
    root = np.ones(len(pixels)) if weights is None else np.sqrt(weights)
    if camera.focal_px is not None:
        return np.linalg.lstsq(root[:, None] * camera.rays(pixels), root, rcond=None)[0]
    middle = pixels.mean(axis=0)
    around = pixels - middle
    design = np.column_stack([2 * around, np.ones(len(around))])
    column, row, rest = np.linalg.lstsq(root[:, None] * design, root * (around**2).sum(axis=1), rcond=None)[0]
    return np.array([column + middle[0], row + middle[1], np.sqrt(rest + column**2 + row**2)])


def _distances(pixels: np.ndarray, parameters: np.ndarray, camera: SphereCamera) -> np.ndarray:
    """Compute signed distances of edge points from an outline in pixels, positive outside."""
    if camera.focal_px is None:
        return np.hypot(*(pixels - parameters[:2]).T) - parameters[2]
    length = np.linalg.norm(parameters)
    angle = np.arccos(np.clip(camera.rays(pixels) @ parameters / length, -1, 1)) - np.arccos(1 / length)
    return angle * camera.focal_px


def _jackknife(pixels, circle, camera) -> np.ndarray:
    """Estimate the covariance of the parameters by leaving out each sector of the outline in turn."""
    around = pixels - circle[:2]
    sector = np.floor((np.arctan2(around[:, 1], around[:, 0]) + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    present = np.unique(sector)
    fits = np.array([solve_outline(pixels[sector != each], camera) for each in present])
    away = fits - fits.mean(axis=0)
    return (len(present) - 1) / len(present) * away.T @ away


def _shift_covariance(parameters: np.ndarray, camera: SphereCamera) -> np.ndarray:
    """Compute the covariance of an outline whose column, row and radius are each uncertain by `REFLECTION_PX`."""
    points = outline_points(parameters, camera)
    column, row, radius = circle_of(parameters, camera)
    outwards = (points - (column, row)) / radius
    moves = np.array([1.0, 0.0]), np.array([0.0, 1.0]), outwards
    changes = np.column_stack([solve_outline(points + REFLECTION_PX * move, camera) - parameters for move in moves])
    return changes @ changes.T


def edge_map(stack: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the strength (rows, columns) of the edges that photographs share, where it is largest across them.

    Gradients of the logarithm are averaged as tensors, each capped, so that a rim counts alike in bright and in dark
    photographs, whichever side of it is brighter. The strength is in standard deviations of its neighbourhood, at most
    2.5; their normals, returned with it, are angles from the columns' axis, of either sign.
    """
    import cv2

    tensor = np.zeros((3, *stack.shape[1:]), np.float32)
    for picture in stack:
        smooth = cv2.GaussianBlur(picture, (0, 0), 1.0)
        light = np.log(np.maximum(smooth, 0) + max(DARKEST, 0.05 * float(np.median(smooth))))
        x, y = (cv2.Sobel(light, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
        cap = 1 / np.hypot(1, np.hypot(x, y) / GRADIENT_CAP)
        x, y = x * cap, y * cap
        tensor += np.stack([x * x, x * y, y * y]) / len(stack)
    strength = np.sqrt(tensor[0] + tensor[2])
    xx, xy, yy = (cv2.GaussianBlur(each, (0, 0), 1.0) for each in tensor)
    normal = 0.5 * np.arctan2(2 * xy, xx - yy)
    coherence = np.hypot(2 * xy, xx - yy) / (xx + yy + 1e-12)
    usual = np.minimum(strength, 3 * np.median(strength))  # so that a strong edge does not hide a weak one beside it
    mean = cv2.blur(usual, (21, 21))
    deviation = np.sqrt(np.maximum(cv2.blur(usual**2, (21, 21)) - mean**2, 0)) + 0.05 * mean + 1e-6
    row, column = np.indices(strength.shape).astype(np.float32)
    x, y = np.cos(normal).astype(np.float32), np.sin(normal).astype(np.float32)
    ridge = np.ones(strength.shape, bool)
    for sign in (1, -1):
        ridge &= strength >= cv2.remap(strength, column + sign * x, row + sign * y, cv2.INTER_LINEAR)
    return np.where(ridge, np.clip((strength - mean) / deviation, 0, 2.5) * coherence, 0), normal


def propose_circles(stack: np.ndarray, inner: np.ndarray, radii: tuple[float, float]) -> list[Circle]:
    """Find circles along edges that enclose points, the best supported first; none is nearly another.

    Hough's transform with the edges' normals, then least squares on the edges near each maximum.

    Parameters
    ----------
    stack : (n, rows, columns) float32
        Crops of the photographs.
    inner : (m, 2)
        Highlights (column, row); nine in ten of them lie inside a circle.
    radii : (float, float)
        Least and largest radius in pixels.
    """
    import cv2

    weight, normal = edge_map(stack)
    rows, columns = weight.shape
    y, x = np.nonzero(weight > 0.3)
    weight, cosine, sine = weight[y, x], np.cos(normal[y, x]), np.sin(normal[y, x])
    hull = inner[np.argsort(np.linalg.norm(inner - np.median(inner, axis=0), axis=1))[: max(3, int(0.9 * len(inner)))]]
    hull = cv2.convexHull(hull.astype(np.float32))[:, 0]
    centre_y, centre_x = np.mgrid[:rows, :columns].astype(np.float32)
    farthest = np.max([np.hypot(centre_x - px, centre_y - py) for px, py in hull], axis=0)
    maxima = []
    for radius in np.geomspace(*radii, max(2, int(np.log(radii[1] / radii[0]) / 0.035))):
        votes = np.zeros(rows * columns)
        for sign in (1, -1):
            column, row = x + sign * radius * cosine, y + sign * radius * sine
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            cell = row[inside].astype(int) * columns + column[inside].astype(int)
            votes += np.bincount(cell, weights=weight[inside], minlength=rows * columns)
        width = max(1.0, 0.02 * radius)
        score = cv2.GaussianBlur(votes.reshape(rows, columns).astype(np.float32), (0, 0), width) * width**2 / radius
        score[farthest > 0.97 * radius] = 0
        for _ in range(3):
            row, column = np.unravel_index(int(score.argmax()), score.shape)
            if score[row, column] > 0:
                maxima.append((float(score[row, column]), float(column), float(row), radius))
            cv2.circle(score, (int(column), int(row)), max(2, int(0.1 * radius)), 0, -1)
    circles: list[Circle] = []
    edges = np.column_stack([x, y, weight, cosine, sine])
    for _, *seed in sorted(maxima, reverse=True)[:MOST_MAXIMA]:
        circle = _settle(edges, seed, (rows, columns))
        if circle is None or (np.hypot(*(hull - circle[:2]).T) > 0.98 * circle.radius).any():
            continue
        if all(
            abs(np.log(circle.radius / other.radius)) > 0.03
            or np.hypot(circle.column - other.column, circle.row - other.row) > 0.05 * other.radius
            for other in circles
        ):
            circles.append(circle)
    return sorted(circles, key=lambda each: -each.support)


def _settle(edges: np.ndarray, seed: Sequence[float], shape: tuple[int, int]) -> Circle | None:
    """Fit a circle to the edges near a seed that run along it; support: share of its visible sectors with an edge."""
    x, y, weight, cosine, sine = edges.T
    column, row, radius = seed
    reach = 0.04 * radius
    for last in (False, False, True):
        away = np.hypot(x - column, y - row)
        along = np.abs((x - column) * cosine + (y - row) * sine) > 0.93 * away
        near = along & (np.abs(away - radius) < max(1.5, 0.015 * radius if last else reach))
        if near.sum() < 12:
            return None
        if not last:
            root = np.sqrt(weight[near])
            design = np.column_stack([2 * x[near], 2 * y[near], np.ones(near.sum())]) * root[:, None]
            column, row, rest = np.linalg.lstsq(design, (x[near] ** 2 + y[near] ** 2) * root, rcond=None)[0]
            radius = float(np.sqrt(max(rest + column**2 + row**2, 1.0)))
    sector = ((np.arctan2(y[near] - row, x[near] - column) / (2 * np.pi) % 1) * SECTORS_OF_SUPPORT).astype(int)
    strongest = np.zeros(SECTORS_OF_SUPPORT)
    np.maximum.at(strongest, sector % SECTORS_OF_SUPPORT, weight[near])
    turn = np.linspace(0, 2 * np.pi, SECTORS_OF_SUPPORT, endpoint=False)
    at = column + radius * np.cos(turn), row + radius * np.sin(turn)
    visible = (at[0] > 1) & (at[0] < shape[1] - 2) & (at[1] > 1) & (at[1] < shape[0] - 2)
    share = np.minimum(strongest, 1).sum() / max(int(visible.sum()), SECTORS_OF_SUPPORT // 2)
    return Circle(float(column), float(row), radius, float(share))
