"""Search the circles of mirror balls: edges around moving highlights, and rays of two balls that meet."""

from itertools import combinations, product

import numpy as np

from nishiki.capture.spheres.lamps import LENSES, set_lens, triangulate
from nishiki.capture.spheres.optics import SphereCamera, reflected_rays
from nishiki.capture.spheres.outline import Circle, propose_circles, solve_outline
from nishiki.capture.spheres.search import (
    LEAST_LAMPS,
    MARGIN,
    Cluster,
    Crop,
    Findings,
    Overview,
    SphereInput,
    bright_blocks,
    cluster_highlights,
    corner_of,
    crop_around,
    find_moving_highlights,
    read_crops,
    residual_of,
)
from nishiki.errors import UserError
from nishiki.formats.masks import read_mask

MOST_TRIED = 8  # clusters that are examined, and circles of each
LEAST_SUPPORT = 0.45  # of a circle that may be a ball's outline
RIVAL = 0.7  # of the best support: of one ball alone, the outermost circle with as much is its outline
AS_GOOD = 1.15  # residual relative to the least, up to which circles explain the scene as well, and edges rank them
LARGEST = 7.0  # radius of a ball relative to that of the circle around its highlights
LEAST_RADIUS_PX = 10.0
LEAST_AREA_PX = 100  # of a sphere in a mask
OUTSIDE = 0.1  # share of the highlights that may lie outside of a circle
CROP_SIDE = 440.0  # pixels of a crop in which circles are proposed
COARSE_PX = 20.0  # radius of a cluster on the reduced photographs below which circles are proposed on the whole ones
FINE_PX = 4.0  # radius of a cluster on the reduced photographs below which these show no circle
CROP_REACH = 4.0  # of such a crop, in radii of the cluster
AGREEMENT = np.radians(8.0)  # up to which directions from two circles belong to two balls
CLEAR = 0.7  # support of a circle that is not moved
SETTLED = np.radians(1.5)  # up to which rays agree as well as places on reduced photographs can


def locate_given(given: SphereInput, findings: Findings) -> list[Circle]:
    """Locate the circles that the user gives: parts of the mask, or edges near the circles that are named.

    Parameters
    ----------
    given : SphereInput
        With a mask or seeds.
    findings : Findings
        Its camera states the size of the photographs.

    Returns
    -------
    list of Circle
        One a sphere.

    Raises
    ------
    UserError
        Where the mask has another size than the photographs or shows no sphere.
    """
    import cv2

    shape = findings.camera.rows, findings.camera.columns
    if given.mask is not None:
        mask = read_mask(given.mask)
        if mask.shape != shape:
            raise UserError(
                f"{given.mask}: expected the photographs' size {shape[1]} x {shape[0]}, found {mask.shape[1]} x "
                f"{mask.shape[0]}. Remedy: paint the spheres in a picture of that size"
            )
        count, _, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        circles = [
            Circle(x + (w - 1) / 2, y + (h - 1) / 2, (w + h) / 4, 1.0)
            for x, y, w, h, area in parts[1:count]
            if area > LEAST_AREA_PX
        ]
        if not circles:
            raise UserError(
                f"{given.mask}: expected spheres as areas of more than {LEAST_AREA_PX} pixels that are not zero, found "
                "none. Remedy: paint the spheres white on black"
            )
        return sorted(circles)
    seeds = [Circle(column, row, radius, 0.0) for row, column, radius in given.seeds]
    crops = [crop_around(seed, shape) for seed in seeds]
    circles = []
    for seed, crop, stack in zip(seeds, crops, read_crops(given.photographs, crops), strict=True):
        inner = np.array([[seed.column, seed.row]])
        proposed = _propose(stack, corner_of(crop), inner, (0.75 * seed.radius, 1.3 * seed.radius), 1.0)
        near = [c for c in proposed if np.hypot(c.column - seed.column, c.row - seed.row) < 0.3 * seed.radius]
        circles.append(_outermost(near) if near else seed)
    return circles


def _propose(stack, corner, inner: np.ndarray, radii: tuple[float, float], factor: float) -> list[Circle]:
    """Find candidate circles in pixels of the photographs around highlights, in a crop that is reduced where large.

    stack: crop whose pixels are `factor` pixels large, `corner` its first pixel's place in units of its own pixels.
    """
    import cv2

    origin = np.asarray(corner, float) * factor
    shrink = max(1.0, max(stack.shape[1:]) / CROP_SIDE)
    size = (max(8, round(stack.shape[2] / shrink)), max(8, round(stack.shape[1] / shrink)))
    small = np.array([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in stack])
    pixel = factor * stack.shape[2] / size[0]
    places = (inner + 0.5 - origin) / pixel - 0.5
    circles: list[Circle] = []
    for c in propose_circles(small, places, (max(radii[0] / pixel, 4.0), max(radii[1] / pixel, 8.0))):
        column, row = (np.array([c.column, c.row]) + 0.5) * pixel - 0.5 + origin
        circles.append(Circle(column, row, c.radius * pixel, c.support))
    return circles


def _outermost(circles: list[Circle]) -> Circle:
    """Select the largest of the circles with good support.

    The horizon of what a ball on a table shows is a circle, too.
    """
    best = max(circle.support for circle in circles)
    return max((circle for circle in circles if circle.support >= RIVAL * best), key=lambda each: each.radius)


def search_circles(given: SphereInput, overview: Overview, findings: Findings) -> tuple[list[Circle], list[Crop]]:
    """Search the circles of mirror balls.

    Chosen are the circles whose highlights agree about the lamps; of one ball alone, the outermost.

    Parameters
    ----------
    given : SphereInput
        Its photographs are read at full size around small clusters of highlights.
    overview : Overview
        Reduced photographs.
    findings : Findings
        Rejected circles are added to it.

    Returns
    -------
    circles : list of Circle
        One a ball, in pixels of the photographs.
    crops : list of Crop
        Crops of the photographs that were read on the way.
    """
    clusters = cluster_highlights(find_moving_highlights(overview.stack), overview)[:MOST_TRIED]
    shape = findings.camera.rows, findings.camera.columns
    small = [c for c in clusters if c.radius / overview.factor < COARSE_PX and overview.factor > 1.2]
    crops = [crop_around((*c.centre, CROP_REACH * c.radius / MARGIN), shape) for c in small]
    fine = dict(zip(map(id, small), zip(crops, read_crops(given.photographs, crops), strict=True), strict=True))
    candidates: list[tuple[Cluster, list[Circle]]] = []
    left: dict[Circle, float] = {}

    for cluster in clusters:
        inner = np.array(list(cluster.places.values()))
        radii = 1.02 * cluster.radius, LARGEST * cluster.radius
        circles: list[Circle] = []
        if id(cluster) in fine:
            crop, stack = fine[id(cluster)]
            circles = _propose(stack, corner_of(crop), inner, (radii[0], CROP_REACH * cluster.radius), 1.0)
            radii = (CROP_REACH * cluster.radius, radii[1])
        if cluster.radius / overview.factor > FINE_PX:
            centre = (cluster.centre + 0.5) / overview.factor - 0.5
            crop = crop_around((*centre, LARGEST * cluster.radius / overview.factor / 1.5), overview.stack.shape[1:])
            circles += _propose(overview.stack[(slice(None), *crop)], corner_of(crop), inner, radii, overview.factor)
        if good := [c for c in circles if c.support >= LEAST_SUPPORT and c.radius >= LEAST_RADIUS_PX]:
            left |= _unexplained_shares(cluster, good, overview, findings.camera)
            least = AS_GOOD * min(left[circle] for circle in good)
            # Circles that explain the scene as well as the best are ranked by their edges.
            good.sort(key=lambda c: (max(left[c], least), -c.support))
            candidates.append((cluster, good[:MOST_TRIED]))
        else:
            nowhere = Circle(cluster.centre[0], cluster.centre[1], cluster.radius, 0.0)
            best = max(circles, key=lambda each: each.support, default=nowhere)
            findings.rejected.append((best, f"no outline: edges along {100 * best.support:.0f} % of a circle only"))
    return _choose(candidates, left, overview, findings), list(fine.values())


def _choose(
    candidates: list[tuple[Cluster, list[Circle]]], left: dict[Circle, float], overview: Overview, findings: Findings
) -> list[Circle]:
    """Choose one circle for each ball such that all agree on the lamps under one lens.

    left: share of the scene's light that each circle does not explain.

    Of the pairs that agree, the one begins whose lamps explain the scene best: the horizon of what a ball on a table
    shows is a circle, too, and so is what it stands in. Others are added where they agree with it.
    """
    pairs = []
    for i, j in combinations(range(len(candidates)), 2):
        for one, two in product(candidates[i][1], candidates[j][1]):
            if np.hypot(one.column - two.column, one.row - two.row) < one.radius + two.radius:
                continue
            places = candidates[i][0].places, candidates[j][0].places
            pair = ((one, places[0]), (two, places[1]))
            if min(_meet(pair, lens, findings.camera)[1] for lens in LENSES[::4]) < 3 * AGREEMENT:
                angle, best = min((_meet(pair, lens, findings.camera)[1], -k) for k, lens in enumerate(LENSES))
                if angle < AGREEMENT:
                    pairs.append((max(left[one], left[two]), angle, i, j, one, two, LENSES[-best]))
    if not pairs:
        chosen = {}
        if candidates:
            first = max(range(len(candidates)), key=lambda i: candidates[i][0].score * candidates[i][1][0].support)
            least = min(left[circle] for circle in candidates[first][1])
            chosen[first] = _outermost([c for c in candidates[first][1] if left[c] <= AS_GOOD * least])
    else:
        pairs = [pair for pair in pairs if pair[0] <= AS_GOOD * min(pairs)[0]]
        least = min(pair[1] for pair in pairs)
        pairs = [pair for pair in pairs if pair[1] < 1.2 * least + np.radians(0.5)]
        _, _, i, j, one, two, lens = max(pairs, key=lambda pair: pair[4].support + pair[5].support)
        if least > SETTLED and min(one.support, two.support) < CLEAR:
            one, two = _settle_pair((candidates[i][0], candidates[j][0]), (one, two), lens, overview, findings.camera)
        chosen = {i: one, j: two}
        for k in set(range(len(candidates))) - {i, j}:
            fitting = []
            for circle in candidates[k][1]:
                apart = all(
                    np.hypot(circle.column - c.column, circle.row - c.row) > circle.radius + c.radius
                    for c in chosen.values()
                )
                pair = ((one, candidates[i][0].places), (circle, candidates[k][0].places))
                angle = _meet(pair, lens, findings.camera)[1]
                if apart and angle < min(AGREEMENT, 2 * least + np.radians(2)):
                    fitting.append((left[circle], angle, circle))
            if fitting:
                chosen[k] = min(fitting)[2]
    why = "another circle has clearer highlights"
    if pairs:
        why = "its highlights do not agree with those of the other spheres"
    taken = list(chosen.values())
    findings.rejected += [
        (circles[0], why)
        for k, (_, circles) in enumerate(candidates)
        if k not in chosen
        and all(np.hypot(circles[0].column - c.column, circles[0].row - c.row) > c.radius for c in taken)
    ]
    return sorted(taken)


def _unexplained_shares(
    cluster: Cluster, circles: list[Circle], overview: Overview, camera: SphereCamera
) -> dict[Circle, float]:
    """Compute the share of the scene's light not explained by the lamps of each circle; 1 without a scene.

    A turn of all lamps does not change that share, so the ball is treated as seen from afar.
    """
    import cv2

    seen = sorted(cluster.places)
    places = np.array([cluster.places[i] for i in seen])
    free = np.ones(overview.stack.shape[1:], np.uint8)
    at = [int((v + 0.5) / overview.factor) for v in cluster.centre]
    cv2.circle(free, at, int(2.5 * cluster.radius / overview.factor), 0, -1)
    light = bright_blocks(overview.stack[seen], free > 0)
    shares = dict.fromkeys(circles, 1.0)
    if light is None:
        return shares
    for circle in circles:
        away = np.hypot(*(places - circle[:2]).T)
        if (away >= circle.radius).mean() <= OUTSIDE:
            inside = (
                np.asarray(circle[:2]) + (places - circle[:2]) * np.minimum(1, 0.999 * circle.radius / away)[:, None]
            )
            shares[circle] = residual_of(light, reflected_rays(inside, np.array(circle[:3]), camera, 1.0)[1])
    return shares


def _meet(pair, lens: float | None, camera: SphereCamera) -> tuple[np.ndarray, float]:
    """Compute lamp directions (lamps, 3) from between two balls; each pair has circle and highlights.

    Also returns the median angle in radians by which rays from both balls miss each other.
    """
    both = sorted(set(pair[0][1]) & set(pair[1][1]))
    if len(both) < LEAST_LAMPS:
        return np.zeros((0, 3)), np.inf
    points, directions = [], []
    seen = set_lens(camera, lens)
    turn = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    for circle, places in pair:
        rim = np.column_stack([circle[0] + circle[2] * np.cos(turn), circle[1] + circle[2] * np.sin(turn)])
        radius = circle[2] / pair[0][0][2]
        at, rays = reflected_rays(np.array([places[i] for i in both]), solve_outline(rim, seen), seen, radius)
        points.append(at)
        directions.append(rays)
    lamps = np.tile(np.arange(len(both)), 2)
    between = np.concatenate(points) - np.nanmean(np.concatenate(points), axis=0)
    towards, _, miss = triangulate(between, np.concatenate(directions), lamps, len(both))
    return towards, float(np.median(np.where(np.isfinite(miss), miss, np.pi)))


def _settle_pair(
    clusters: tuple[Cluster, Cluster], circles: tuple[Circle, Circle], lens: float | None, overview: Overview, camera
) -> tuple[Circle, Circle]:
    """Move the circles of two balls to where their rays meet best and the scene is best explained.

    For rims that are blurred, or beside stronger edges; the focal length is settled with them.
    """
    from scipy.optimize import minimize

    both = sorted(set(clusters[0].places) & set(clusters[1].places))
    light = bright_blocks(overview.stack[both], np.ones(overview.stack.shape[1:], bool))
    if light is None:
        return circles

    def cost(x: np.ndarray) -> float:
        pair = ((x[:3], clusters[0].places), (x[3:6], clusters[1].places))
        towards, miss = _meet(pair, None if x[6] < 0.02 else 0.5 / np.tan(min(x[6], 0.6)), camera)
        return np.log(miss + np.radians(0.2)) + np.log(residual_of(light, np.nan_to_num(towards)) + 0.01)

    start = np.array([*circles[0][:3], *circles[1][:3], 0.0 if lens is None else np.arctan(0.5 / lens)])
    steps = 0.05 * np.array([circles[0].radius] * 3 + [circles[1].radius] * 3 + [1.0])
    simplex = np.vstack([start, start + np.diag(steps)])
    x = minimize(cost, start, method="Nelder-Mead", options={"maxfev": 400, "initial_simplex": simplex}).x.tolist()
    return Circle(x[0], x[1], x[2], circles[0].support), Circle(x[3], x[4], x[5], circles[1].support)
