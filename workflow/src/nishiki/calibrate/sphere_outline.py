"""Outlines of mirror spheres, from the edges that photographs under different lamps share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.capture.mirror_sphere import SphereCamera, circle_of, outline_points

ANGLES = 360  # directions from the seed's centre in which an edge is looked for
SECTORS = 12  # of the outline, left out one after the other for its uncertainty
LEAST_SUPPORT = 0.3  # share of the outline on which an edge must have been found
TRIALS = 600  # circles through three edge points that are tried
RIVAL = 0.7  # of the best support: circles with as much are compared by their radius
OUTERMOST = 0.04  # relative difference of radii that are taken to be of one circle
REFLECTION_PX = 0.1  # how far what the rim reflects shifts the whole edge, which no part of the edge tells


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


def edge_strength(
    stack: np.ndarray, circle: tuple[float, float, float], inner: float, outer: float
) -> tuple[np.ndarray, np.ndarray]:
    """Root mean square of the derivative along rays from a circle's centre, over pictures.

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
        smooth = cv2.GaussianBlur(profile, (0, 0), sigmaX=3.0, sigmaY=0.5)
        total += np.gradient(smooth, axis=1) ** 2
    return np.where(inside, np.sqrt(total / len(stack)), 0.0), radii


def fit_outline(stack: np.ndarray, seed: tuple[float, float, float], camera: SphereCamera, corner=(0, 0)) -> Outline:
    """Outline of a sphere near a circle.

    Edges are the largest changes along rays from the seed's centre. A consensus of circles through three of them
    leaves out those of reflections and of the surroundings; the ellipse that the camera sees is then fitted to the
    rest, twice, each time with edges taken nearer to the last fit.

    Parameters
    ----------
    stack : (pictures, rows, columns) float32
        Crops of all photographs around the sphere.
    seed : (column, row, radius)
        In pixels of the whole photograph, to about a quarter of the radius.
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
    points = _edge_points(*edge_strength(stack, circle, 0.3, 0.6), circle, most=5)
    circle = _consensus(points, circle)
    parameters = None
    for reach in (0.06, 0.03, 0.03):
        reach = max(reach, 4.0 / circle[2])
        points = _edge_points(*edge_strength(stack, circle, reach, reach), circle, most=1)
        if len(points) < LEAST_SUPPORT * ANGLES:
            raise ValueError(f"an edge along {100 * len(points) / ANGLES:.0f} % of the outline only")
        pixels = points[:, :2] + corner
        keep = np.ones(len(pixels), bool)
        for _ in range(8):
            parameters = _solve(pixels[keep], camera)
            distance = _distances(pixels, parameters, camera)
            spread = 1.4826 * np.median(np.abs(distance[keep]))
            keep = np.abs(distance) < max(3 * spread, 0.3)
        support = keep.sum() / ANGLES
        if support < LEAST_SUPPORT:
            raise ValueError(f"edges agree along {100 * support:.0f} % of the outline only")
        edge = outline_points(parameters, camera) - corner
        middle = (edge.min(axis=0) + edge.max(axis=0)) / 2
        circle = (float(middle[0]), float(middle[1]), float(np.linalg.norm(edge - middle, axis=1).mean()))
    pixels, distance = pixels[keep], distance[keep]
    covariance = _jackknife(pixels, circle, corner, camera) + _shifted(parameters, camera)
    return Outline(parameters, covariance, float(np.sqrt((distance**2).mean())), float(support), pixels)


def _edge_points(strength: np.ndarray, radii: np.ndarray, circle, *, most: int) -> np.ndarray:
    """Points (n, 3) with column, row and strength: up to `most` local maxima along each ray, to a part of a step."""
    inner = strength[:, 1:-1]
    peak = (inner > strength[:, :-2]) & (inner >= strength[:, 2:]) & (inner > 0)
    floor = 2.0 * np.median(strength[strength > 0]) if (strength > 0).any() else 0.0
    points = []
    for angle, (row, line) in enumerate(zip(peak, strength, strict=True)):
        places = np.flatnonzero(row) + 1
        places = places[line[places] > floor] if most > 1 else places
        for place in places[np.argsort(line[places])[::-1][:most]]:
            before, here, after = line[place - 1 : place + 2]
            shift = 0.5 * (before - after) / (before - 2 * here + after)
            distance = radii[place] + shift * (radii[1] - radii[0])
            turn = 2 * np.pi * angle / ANGLES
            points.append((circle[0] + distance * np.cos(turn), circle[1] + distance * np.sin(turn), here))
    return np.array(points).reshape(-1, 3)


def _consensus(points: np.ndarray, seed) -> tuple[float, float, float]:
    """The circle through three points that most others agree with (RANSAC), with a fixed random sequence.

    The horizon of what a sphere on a table shows is a circle, too, of 0.7 times its radius: of circles with similar
    support the outermost counts.
    """
    if len(points) < LEAST_SUPPORT * ANGLES:
        raise ValueError("no outline: too few edges around the seed")
    random = np.random.default_rng(0)
    plane = points[:, :2]
    turn = np.arctan2(plane[:, 1] - seed[1], plane[:, 0] - seed[0])
    sector = np.floor((turn + np.pi) / (2 * np.pi) * 72).astype(int) % 72
    tolerance = max(1.5, 0.01 * seed[2])
    circles, scores = [], []
    for _ in range(TRIALS):
        three = plane[random.integers(0, len(plane), 3)]
        design = np.column_stack([2 * three, np.ones(3)])
        if abs(np.linalg.det(design)) < 1e-3 * seed[2] ** 2:
            continue
        column, row, rest = np.linalg.solve(design, (three**2).sum(axis=1))
        radius = np.sqrt(max(rest + column**2 + row**2, 0.0))
        if not 0.6 * seed[2] < radius < 1.6 * seed[2] or np.hypot(column - seed[0], row - seed[1]) > 0.5 * seed[2]:
            continue
        near = np.abs(np.hypot(*(plane - (column, row)).T) - radius) < tolerance
        circles.append((float(column), float(row), float(radius)))
        scores.append(len(np.unique(sector[near])))
    if not circles or max(scores) < LEAST_SUPPORT * 72:
        raise ValueError("no outline: the edges around the seed lie on no circle")
    good = [circle for circle, score in zip(circles, scores, strict=True) if score >= RIVAL * max(scores)]
    # Of the outermost circles, the one that most edges lie on.
    outer = max(radius for _, _, radius in good) * (1 - OUTERMOST)
    return max(
        (each for each in zip(scores, circles, strict=True) if each[1] in good and each[1][2] >= outer),
        key=lambda each: each[0],
    )[1]


def _solve(pixels: np.ndarray, camera: SphereCamera) -> np.ndarray:
    """Parameters of the outline through edge points, by linear least squares."""
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


def _jackknife(pixels, circle, corner, camera) -> np.ndarray:
    """Covariance of the parameters: the fit without each sector of the outline in turn."""
    around = pixels - corner - circle[:2]
    sector = np.floor((np.arctan2(around[:, 1], around[:, 0]) + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    present = np.unique(sector)
    fits = np.array([_solve(pixels[sector != each], camera) for each in present])
    away = fits - fits.mean(axis=0)
    return (len(present) - 1) / len(present) * away.T @ away


def _shifted(parameters: np.ndarray, camera: SphereCamera) -> np.ndarray:
    """Covariance of the parameters of an outline whose column, row and radius are each uncertain by `REFLECTION_PX`."""
    points = outline_points(parameters, camera)
    column, row, radius = circle_of(parameters, camera)
    outwards = (points - (column, row)) / radius
    moves = np.array([1.0, 0.0]), np.array([0.0, 1.0]), outwards
    changes = np.column_stack([_solve(points + REFLECTION_PX * move, camera) - parameters for move in moves])
    return changes @ changes.T


def find_circles(pictures: np.ndarray, count: int) -> list[tuple[float, float, float]]:
    """Circles (column, row, radius) that may be outlines of spheres, the likeliest first: seeds for `fit_outline`.

    pictures (n, rows, columns) float32: the mean and the brightest of all photographs, made small. At least
    6 * count + 6 circles where there are as many (Hough's transform, as in OpenCV).
    """
    import cv2

    circles: list[tuple[float, float, float]] = []
    for picture in pictures:
        top = float(np.percentile(picture, 99.5)) or 1.0
        codes = np.clip(np.sqrt(np.clip(picture / top, 0, 1)) * 255, 0, 255).astype(np.uint8)
        codes = cv2.GaussianBlur(codes, (0, 0), 1.5)
        side = min(codes.shape)
        voted = cv2.HoughCircles(
            codes,
            cv2.HOUGH_GRADIENT_ALT,
            1.5,
            side / 30,
            param1=60,
            param2=0.6,
            minRadius=max(5, side // 60),
            maxRadius=int(0.55 * side),
        )
        for vote in [] if voted is None else np.asarray(voted).reshape(-1, 3)[: 6 * count + 6]:
            if all(np.hypot(vote[0] - c[0], vote[1] - c[1]) > 0.3 * vote[2] for c in circles):
                circles.append(tuple(float(v) for v in vote))
    return circles
