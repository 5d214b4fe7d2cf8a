"""Outlines of mirror spheres, from the edges that photographs under different lamps share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from nishiki.capture.spheres.optics import SphereCamera, circle_of, outline_points

ANGLES = 360  # directions from the seed's centre in which an edge is looked for
ALONG = 16  # directions over which profiles are smoothed on either side
SECTORS = 12  # of the outline, left out one after the other for its uncertainty
SECTORS_OF_SUPPORT = 72  # of a circle, in each of which an edge may support it
LEAST_SUPPORT = 0.3  # share of the outline on which an edge must have been found
MOST_MAXIMA = 40  # of Hough's transform that are settled
GRADIENT_CAP = 0.15  # of the logarithm of the light, by pixel
DARKEST = 0.003  # of full scale, added before logarithms are taken
REFLECTION_PX = 0.15  # how far what the rim reflects shifts the whole edge, which no part of the edge tells


@dataclass(frozen=True)
class Outline:
    """Outline of a sphere.

    Attributes
    ----------
    parameters : (3,)
        m for a perspective camera, (column, row, radius) in pixels for an orthographic one.
    covariance : (3, 3)
        Of the parameters: the jackknife over sectors of the outline, and a shift and growth of all of it by
        `REFLECTION_PX`.
    rms_px : float
        Root mean square distance of the edge points used.
    support : float
        Share of the directions in which the edge was found.
    points : (n, 2)
        Edge points used (column, row).
    """

    parameters: np.ndarray
    covariance: np.ndarray
    rms_px: float
    support: float
    points: np.ndarray

    def circle(self, camera: SphereCamera) -> tuple[float, float, float]:
        """Column, row and radius in pixels of the circle nearest to the outline."""
        return circle_of(self.parameters, camera)

    def under(self, camera: SphereCamera) -> "Outline":
        """Fit the outline that another camera sees along the same edge points."""
        parameters = solve_outline(self.points, camera)
        covariance = _jackknife(self.points, circle_of(parameters, camera), camera) + _shifted(parameters, camera)
        rms = float(np.sqrt((_distances(self.points, parameters, camera) ** 2).mean()))
        return Outline(parameters, covariance, rms, self.support, self.points)


class Circle(NamedTuple):
    """A circle in pixels, and the share of its visible sectors along which an edge runs."""

    column: float
    row: float
    radius: float
    support: float


def edge_strength(
    stack: np.ndarray, circle: tuple[float, float, float], inner: float, outer: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find how strongly pictures change along rays from a circle's centre: root mean square over the pictures.

    Parameters
    ----------
    stack : (pictures, rows, columns) float32
        Crops of all photographs, of any scale.
    circle : (column, row, radius)
        In pixels of the crops.
    inner, outer : float
        How far the ring that is looked at reaches inwards and outwards, relative to the radius.

    Returns
    -------
    strength : (ANGLES, steps) float64
    radii : (steps,)
        Distances from the centre in pixels, a third of a pixel apart.
    """
    import cv2

    column, row, radius = circle
    radii = np.arange(max(1.0, radius * (1 - inner)), radius * (1 + outer), 1 / 3)
    turn = np.linspace(0, 2 * np.pi, ANGLES, endpoint=False)
    x = (column + np.cos(turn)[:, None] * radii).astype(np.float32)
    y = (row + np.sin(turn)[:, None] * radii).astype(np.float32)
    inside = (x >= 0) & (x <= stack.shape[2] - 1) & (y >= 0) & (y <= stack.shape[1] - 1)
    total = np.zeros(x.shape)
    for picture in stack:
        profile = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        wrapped = np.concatenate([profile[-ALONG:], profile, profile[:ALONG]])
        smooth = cv2.GaussianBlur(wrapped, (0, 0), sigmaX=2.0, sigmaY=ALONG / 4)[ALONG:-ALONG]
        total += np.gradient(smooth, axis=1) ** 2
    return np.where(inside, np.sqrt(total / len(stack)), 0.0), radii


def fit_outline(stack: np.ndarray, seed: Sequence[float], camera: SphereCamera, corner=(0, 0)) -> Outline:
    """Fit the outline of a sphere near a circle.

    Edges are the largest changes along rays from the circle's centre. The ellipse that the camera sees is fitted to
    them three times, each time with edges taken near the last fit and without those that lie off it.

    Parameters
    ----------
    stack : (pictures, rows, columns) float32
        Crops of all photographs around the sphere.
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
    corner = np.asarray(corner, float)
    circle = (seed[0] - corner[0], seed[1] - corner[1], seed[2])
    parameters = None
    for reach, least_px in ((0.06, 3.0), (0.03, 2.5), (0.03, 2.5)):
        reach = max(reach, least_px / circle[2])
        points = _edge_points(*edge_strength(stack, circle, reach, reach), circle)
        if len(points) < LEAST_SUPPORT * ANGLES:
            raise ValueError(f"an edge along {100 * len(points) / ANGLES:.0f} % of the outline only")
        pixels = points + corner
        keep = np.ones(len(pixels), bool)
        for _ in range(8):
            parameters = solve_outline(pixels[keep], camera)
            distance = _distances(pixels, parameters, camera)
            spread = 1.4826 * np.median(np.abs(distance[keep]))
            keep = np.abs(distance) < max(3 * spread, 0.3)
        support = keep.sum() / ANGLES
        if support < LEAST_SUPPORT:
            raise ValueError(f"edges that agree along {100 * support:.0f} % of the outline only")
        edge = outline_points(parameters, camera) - corner
        middle = (edge.min(axis=0) + edge.max(axis=0)) / 2
        circle = (float(middle[0]), float(middle[1]), float(np.linalg.norm(edge - middle, axis=1).mean()))
    return Outline(parameters, np.zeros((3, 3)), 0.0, float(support), pixels[keep]).under(camera)


def _edge_points(strength: np.ndarray, radii: np.ndarray, circle: Sequence[float]) -> np.ndarray:
    """Places (n, 2) of the strongest edge along each ray, to a part of a step."""
    inner = strength[:, 1:-1]
    peak = (inner > strength[:, :-2]) & (inner >= strength[:, 2:]) & (inner > 0)
    angle = np.flatnonzero(peak.any(axis=1))
    place = np.where(peak, inner, 0)[angle].argmax(axis=1) + 1
    before, here, after = (strength[angle, place + step] for step in (-1, 0, 1))
    distance = radii[place] + 0.5 * (before - after) / (before - 2 * here + after) * (radii[1] - radii[0])
    turn = 2 * np.pi * angle / ANGLES
    return np.column_stack([circle[0] + distance * np.cos(turn), circle[1] + distance * np.sin(turn)])


def solve_outline(pixels: np.ndarray, camera: SphereCamera) -> np.ndarray:
    """Fit the parameters of the outline through edge points, by linear least squares."""
    if camera.focal_px is not None:
        return np.linalg.lstsq(camera.rays(pixels), np.ones(len(pixels)), rcond=None)[0]
    middle = pixels.mean(axis=0)
    around = pixels - middle
    design = np.column_stack([2 * around, np.ones(len(around))])
    column, row, rest = np.linalg.lstsq(design, (around**2).sum(axis=1), rcond=None)[0]
    return np.array([column + middle[0], row + middle[1], np.sqrt(rest + column**2 + row**2)])


def _distances(pixels: np.ndarray, parameters: np.ndarray, camera: SphereCamera) -> np.ndarray:
    """Distances of edge points from an outline in pixels, positive outside."""
    if camera.focal_px is None:
        return np.hypot(*(pixels - parameters[:2]).T) - parameters[2]
    length = np.linalg.norm(parameters)
    angle = np.arccos(np.clip(camera.rays(pixels) @ parameters / length, -1, 1)) - np.arccos(1 / length)
    return angle * camera.focal_px


def _jackknife(pixels, circle, camera) -> np.ndarray:
    """Covariance of the parameters: the fit without each sector of the outline in turn."""
    around = pixels - circle[:2]
    sector = np.floor((np.arctan2(around[:, 1], around[:, 0]) + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    present = np.unique(sector)
    fits = np.array([solve_outline(pixels[sector != each], camera) for each in present])
    away = fits - fits.mean(axis=0)
    return (len(present) - 1) / len(present) * away.T @ away


def _shifted(parameters: np.ndarray, camera: SphereCamera) -> np.ndarray:
    """Covariance of the parameters of an outline whose column, row and radius are each uncertain by `REFLECTION_PX`."""
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
