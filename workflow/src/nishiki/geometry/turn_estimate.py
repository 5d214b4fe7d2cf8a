"""Estimate the cameras of a turntable from its photographs alone.

One pinhole camera, fixed, sees an object that turns about one axis: unknown are the focal length, the camera's
orientation to the axis (3) and the angle of every view. The distance of the camera to the axis is the unit of length.

Evidence are rays of two views that meet: matched features, and the outermost tangents of two outlines. The two planes
through the baseline of a pair of views that touch the object are the same in both pictures (epipolar tangency: R.
Cipolla and P. Giblin, Visual Motion of Curves and Surfaces, 2000; K.-Y. K. Wong and R. Cipolla, ICCV 2001), whatever
the surface, so that outlines without any texture serve. A residual is the angle between the two planes about the
baseline, in pixels: (phi_i - phi_j) f / sqrt(1 / sin(alpha_i)^2 + 1 / sin(alpha_j)^2), alpha from baseline to ray.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.stored import PlainFields
from nishiki.geometry.camera import NO_DISTORTION, Camera
from nishiki.geometry.turn import FEWEST_VIEWS, rotation_matrix

FACING = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Rotation of a camera on the world's x axis that looks at the axis z, with z up in the picture."""
FOCAL_START, FOCAL_RANGE = 2.0, (0.6, 15.0)  # of the longer side
TILTS_DEG, LARGEST_TILT_DEG, LARGEST_ROLL_DEG = (20.0, -20.0), 75.0, 40.0
PRINCIPAL_SD = 0.005
"""Standard deviation of the principal point about the picture's centre, of the longer side."""
OUTLINE_SD_PX = 0.5
"""Standard deviation of an offset that all outlines share, outside or inside of the object's edge."""
WIDEST_PENCIL = 0.9 * np.pi  # angle that an outline fills about a baseline; above, the epipole is too near
UNUSABLE_PX = 3.0  # residual of such a pair, so that none is gained by it
LEAST_SIGMA_PX = 0.05
LEAST_SINE = 0.3  # of the angle between rays, and between baseline and ray, of points that give the object's extent
EXTENT = (1, 99)  # per cent of such points
STEP_SD_DEG = 0.2
SHARED = 4  # views over the least variance of an error that a view's residuals share, in variances of one residual
MOST_PAIRS = 2500  # of outlines
FOLDS = 3
FREE_GAIN = 0.8
"""Steps are free where that divides the error at left-out pairs by this factor or better."""
LEAST_RATIO = 1.2
"""Cost of the turn in the other sense, relative to the best, below which the sense is not determined.

A simulated jar in 12 views of 96 pixels was estimated in the wrong sense at 1.07; right ones had 1.35 and more.
"""
UNEVEN_SIGMAS = 5.0
"""Deviation of a step from the median step, in standard deviations of the steps, from which the step is reported."""
LEAST_COST = 0.1  # of a residual, counted so that two senses that both fit far within the noise are alike
MOST_FOCAL_SD, MOST_ANGLE_SD_DEG = 0.15, 2.0
MOST_ERROR = 0.02
"""Error at left-out pairs, of the height of the outlines, above which the photographs contradict a turn."""
FEATURE_SIDE = 1200  # pixels of the longer side of pictures in which features are matched
FEATURE_REACH = (1, 2)  # views ahead; at 40 degrees half of the matches on a painted jar were wrong
RATIO, STILL_PX = 0.8, 1.0
REMEDY = (
    "Remedy: photograph a ChArUco board on the table in every view, or give the camera matrices (turntable.cameras)"
)


@dataclass(frozen=True)
class Matches:
    """Features seen in two views."""

    views: np.ndarray  # (n, 2) places of the two views
    pixels: np.ndarray  # (n, 2, 2) float64 column, row in each

    @classmethod
    def none(cls) -> "Matches":
        """Return no features."""
        return cls(np.zeros((0, 2), int), np.zeros((0, 2, 2)))


@dataclass(frozen=True)
class TurnEstimate(PlainFields):
    """Cameras of a turn and their uncertainty."""

    cameras: list[Camera] = field(repr=False)
    focal_px: float
    focal_sd_px: float
    tilt_deg: float  # of the camera's axis below the plane of the turn
    tilt_sd_deg: float
    steps: str  # "equal" or "free"
    angles_deg: tuple[float, ...]  # (views,) from the first
    angle_sd_deg: float  # of the least certain view; 0 where steps are equal
    uneven_steps_deg: dict[str, float]  # steps unlike the others, by "view to view"
    outline_px: float  # robust standard deviation of residuals
    match_px: float | None
    matches: int  # features in two views that were used
    left_out_px: float  # robust error at pairs of views that took no part in a fit
    left_out_equal_px: float
    mirror_ratio: float  # cost of the turn in the other sense over that of this one; about 1: undecided
    height: float  # of the object along the axis, in the world's unit


def reduce_grey(picture: np.ndarray) -> np.ndarray:
    """Convert a picture (rows, columns, 3) uint8 to grey of FEATURE_SIDE pixels at most."""
    import cv2

    factor = min(1.0, FEATURE_SIDE / max(picture.shape))
    return cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None, fx=factor, fy=factor, interpolation=3)


def match_features(greys: list[np.ndarray], masks: list[np.ndarray]) -> Matches:
    """Match SIFT features (D. Lowe, IJCV 2004) within the masks between views that are near each other on the turn.

    greys: of `reduce_grey`. Matches are mutual, distinct, agree with one epipolar geometry, and move: what
    stands still is background or the lamp's reflection.
    """
    import cv2

    factor = min(1.0, FEATURE_SIDE / max(masks[0].shape))
    finder, found = cv2.SIFT.create(4000, contrastThreshold=0.02), []
    for grey, mask in zip(greys, masks, strict=True):
        inner = cv2.erode(cv2.resize(mask.astype(np.uint8), grey.shape[::-1]), np.ones((5, 5), np.uint8))
        points, codes = finder.detectAndCompute(grey, inner)
        places = np.array([point.pt for point in points], np.float64).reshape(-1, 2)
        found.append(((places + 0.5) / factor - 0.5, codes))
    views, pixels, count = [], [], len(masks)
    for ahead, first in product(FEATURE_REACH, range(count)):
        second = (first + ahead) % count
        (from_places, from_codes), (to_places, to_codes) = found[first], found[second]
        if min(len(from_places), len(to_places)) < 8:
            continue
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        back = {m.queryIdx: m.trainIdx for (m,) in matcher.knnMatch(to_codes, from_codes, 1)}
        both = [
            (best.queryIdx, best.trainIdx)
            for best, other in matcher.knnMatch(from_codes, to_codes, 2)
            if best.distance < RATIO * other.distance and back[best.trainIdx] == best.queryIdx
        ]
        pair = np.stack([from_places[[a for a, _ in both]], to_places[[b for _, b in both]]], axis=1)
        pair = pair[np.linalg.norm(pair[:, 0] - pair[:, 1], axis=1) > STILL_PX / factor]
        if len(pair) < 12:
            continue
        cv2.setRNGSeed(1)
        _, agreeing = cv2.findFundamentalMat(pair[:, 0], pair[:, 1], cv2.FM_RANSAC, 1.5 / factor, 0.999)
        pair = pair[agreeing.ravel() > 0] if agreeing is not None else pair[:0]
        views.append(np.tile([first, second], (len(pair), 1)))
        pixels.append(pair)
    return Matches(np.concatenate(views), np.concatenate(pixels)) if views else Matches.none()


def outline_hull(mask: np.ndarray) -> np.ndarray:
    """Find the corners (n, 2) float64 (column, row) of the convex outline of a mask, half a pixel beyond its pixels."""
    import cv2

    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    corners = cv2.convexHull(np.concatenate(contours))[:, 0].astype(np.float32)
    angles = np.arange(8) * np.pi / 4
    beyond = corners[:, None] + 0.5 * np.column_stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    return cv2.approxPolyDP(cv2.convexHull(beyond.reshape(-1, 2)), 0.03, True)[:, 0].astype(np.float64)


class Evidence:
    """Residuals of a turn: of tangents of outlines, then of matched features.

    pairs (n, 2): the views of each residual; kinds (n,) bool: of features. Parameters: log of the focal length in
    longer sides, rotation vector of the camera from FACING; and for each residual the angle between its views. Not
    fitted, but counted in the covariance: principal point, in longer sides, and relative size of all outlines.
    """

    def __init__(
        self,
        masks: list[np.ndarray],
        matches: Matches,
        intrinsics: np.ndarray | None = None,
        distortion: tuple[float, ...] = NO_DISTORTION,
    ):
        rows, columns = masks[0].shape
        self.side, self.count = float(max(rows, columns)), len(masks)
        centre = np.array([(columns - 1) / 2, (rows - 1) / 2])

        def ideal(pixels: np.ndarray) -> np.ndarray:
            """Convert pixels (n, 2) to those of a lens without distortion about the centre."""
            if intrinsics is None or not len(pixels):
                return pixels
            import cv2

            lens = np.array([[intrinsics[0, 0], 0, centre[0]], [0, intrinsics[0, 0], centre[1]], [0, 0, 1]])
            return cv2.undistortPoints(pixels[:, None], intrinsics, np.array(distortion), P=lens)[:, 0]

        hulls = [ideal(outline_hull(mask)) for mask in masks]
        self.height = float(np.median([np.ptp(hull[:, 1]) for hull in hulls]))
        most = max(map(len, hulls))
        self.corners = np.array([np.concatenate([h, np.repeat(h[:1], most - len(h), 0)]) for h in hulls]) - centre
        self.middles = np.array([(hull.max(axis=0) + hull.min(axis=0)) / 2 for hull in hulls])[:, None] - centre
        tangents = np.stack(np.triu_indices(self.count, 1), axis=1)
        if len(tangents) > MOST_PAIRS:
            tangents = tangents[np.random.default_rng(1).permutation(len(tangents))[:MOST_PAIRS]]
        self.tangents, self.matches = (
            tangents,
            Matches(matches.views, ideal(matches.pixels.reshape(-1, 2)).reshape(-1, 2, 2) - centre),
        )
        self.pairs = np.concatenate([tangents, tangents, matches.views])
        self.kinds = np.arange(len(self.pairs)) >= 2 * len(tangents)

    def rays(self, lens: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """Compute rays (..., 3) in the world of pixels (..., 2) from the centre, lens: focal, rotation, point."""
        scaled = (offsets - self.side * lens[4:6]) / (self.side * np.exp(lens[0]))
        rays = np.concatenate([scaled, np.ones((*offsets.shape[:-1], 1))], axis=-1)
        return rays @ (rotation_matrix(lens[1:4]) @ FACING)

    def residuals(self, lens: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """Compute residuals (n,) in pixels. lens (7,): parameters, principal point, size; turns (n,) radians."""
        tangents, out = len(self.tangents), []
        for _, at, wide in self.touching(lens, turns[:tangents]):
            out.append(np.where(wide, UNUSABLE_PX, self._pixels(lens, *at)))
        if len(self.matches.views):
            rays, turns = self.rays(lens, self.matches.pixels), turns[2 * tangents :]
            middle = rays[:, 0] + _turn(rays[:, 1], turns)
            at = [tuple(v[:, 0] for v in _angles(rays[:, k : k + 1], bool(k), turns, middle)) for k in (0, 1)]
            out.append(self._pixels(lens, *at))
        return np.concatenate(out)

    def touching(self, lens: np.ndarray, turns: np.ndarray) -> Iterator[tuple[list, list, np.ndarray]]:
        """Yield of both outermost planes through each baseline the rays of both views, and their angles and sines.

        The last array (n,) bool marks where an outline is too wide about the baseline to have such planes.
        """
        first, second = self.tangents.T
        corners = self.rays(lens, self.middles + (1 + lens[6]) * (self.corners - self.middles))
        middles = self.rays(lens, self.middles)[:, 0]
        middle, rows = middles[first] + _turn(middles[second], turns), np.arange(len(turns))
        sets = (corners[first], corners[second])
        planes = [_angles(rays, place == 1, turns, middle) for place, rays in enumerate(sets)]
        wide = np.any([np.ptp(angle, axis=1) > WIDEST_PENCIL for angle, _ in planes], axis=0)
        for extreme in (np.argmax, np.argmin):
            places = [extreme(angle, axis=1) for angle, _ in planes]
            at = [(angle[rows, place], sine[rows, place]) for (angle, sine), place in zip(planes, places, strict=True)]
            yield [rays[rows, place] for rays, place in zip(sets, places, strict=True)], at, wide

    def _pixels(self, lens: np.ndarray, first: tuple, second: tuple) -> np.ndarray:
        apart = np.remainder(first[0] - second[0] + np.pi, 2 * np.pi) - np.pi
        return apart * self.side * np.exp(lens[0]) / np.sqrt(first[1] ** -2.0 + second[1] ** -2.0)


def _turn(vectors: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Turn vectors (n, 3) by angles (n,) about z."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y, z = vectors.T
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z])


def _angles(rays: np.ndarray, turned: bool, turns: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute angles (n, m) of rays (n, m, 3) about the baseline, from the plane of `middle` (n, 3), and their sines.

    The first camera stands at (1, 0, 0), the second is turned by `turns` (n,); turned: rays are of the second.
    """
    base = np.column_stack([np.cos(turns) - 1, np.sin(turns), np.zeros_like(turns)])
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    ahead = middle - np.einsum("ij,ij->i", middle, base)[:, None] * base
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    aside = np.cross(base, ahead)
    if turned:
        ahead, aside = _turn(ahead, -turns), _turn(aside, -turns)
    x, y = (np.einsum("nmk,nk->nm", rays, axis) for axis in (ahead, aside))
    return np.arctan2(y, x), np.maximum(np.hypot(x, y) / np.linalg.norm(rays, axis=-1), 1e-9)


@dataclass
class Adjustment:
    """Fit of one turn to evidence, robust (Huber's pseudo loss) and weighted by the noise of tangents and features.

    start (4,): lens parameters. free: each view has its angle, and each step is expected to be the common one to
    STEP_SD_DEG, robustly, so that a slip or a missing view stays one. deviations (views,): radians beyond equal steps,
    the first 0, then the common step. sigmas: of both kinds.
    """

    evidence: Evidence
    sense: int
    start: np.ndarray
    free: bool = False
    focal_known: bool = False
    deviations: np.ndarray | None = None
    sigmas: np.ndarray = field(default_factory=lambda: np.array([0.5, 0.5]))
    cost: float = np.inf

    @property
    def angles(self) -> np.ndarray:
        """Angles (views,) of the views in radians."""
        equal = self.sense * 2 * np.pi * np.arange(self.evidence.count) / self.evidence.count
        return equal if self.deviations is None else equal + self.deviations[:-1]

    def _model(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lens, count = np.concatenate([values[:4], np.zeros(3)]), self.evidence.count
        moved = np.concatenate([[0.0], values[4:-1]]) if self.free else np.zeros(count)
        angles = self.sense * 2 * np.pi * np.arange(count) / count + moved
        first, second = self.evidence.pairs.T
        return lens, angles[second] - angles[first]

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Compute residuals (n,) in standard deviations."""
        residuals = self.evidence.residuals(*self._model(values)) / self.sigmas[self.evidence.kinds.astype(int)]
        return np.concatenate([residuals, self._prior() @ values[4:]]) if self.free else residuals

    def _prior(self) -> np.ndarray:
        """Compute the matrix (views, views) from deviations and common step to the deviation of each step in its sd."""
        count = self.evidence.count
        steps = np.hstack([np.roll(np.eye(count), 1, axis=1) - np.eye(count), -np.ones((count, 1))])
        return steps[:, 1:] / np.radians(STEP_SD_DEG)

    def jacobian(self, values: np.ndarray, lens_terms: int = 4) -> np.ndarray:
        """Differentiate by lens_terms parameters of the lens, then by the angles; a residual depends on one turn."""
        lens, turns = self._model(values)
        sigmas = self.sigmas[self.evidence.kinds.astype(int)]
        here, step = self.evidence.residuals(lens, turns), 1e-6
        moved = [self.evidence.residuals(lens + step * row, turns) for row in np.eye(7)[:lens_terms]]
        columns = np.column_stack([(each - here) / (step * sigmas) for each in moved])
        columns[:, 0] *= not self.focal_known
        if not self.free:
            return columns
        by_turn = (self.evidence.residuals(lens, turns + step) - here) / (step * sigmas)
        angles, rows = np.zeros((len(here), self.evidence.count)), np.arange(len(here))
        angles[rows, self.evidence.pairs[:, 0]] -= by_turn
        angles[rows, self.evidence.pairs[:, 1]] += by_turn
        columns = np.hstack([columns, angles[:, 1:], np.zeros((len(here), 1))])
        return np.vstack([columns, np.hstack([np.zeros((self.evidence.count, lens_terms)), self._prior()])])

    @property
    def values(self) -> np.ndarray:
        """All parameters."""
        moved = np.zeros(self.evidence.count + 1) if self.deviations is None else self.deviations
        return np.concatenate([self.start, moved[1:]]) if self.free else self.start

    def solve(self, used: np.ndarray | None = None, most: int = 40) -> "Adjustment":
        """Fit to the residuals `used` (n,) bool."""
        from scipy.optimize import least_squares

        used = np.ones(len(self.evidence.pairs), bool) if used is None else used
        used = np.concatenate([used, np.ones(self.evidence.count if self.free else 0, bool)])
        tilt, roll = np.radians([LARGEST_TILT_DEG, LARGEST_ROLL_DEG])
        reach = np.concatenate([[tilt, roll, roll], np.full(self.evidence.count, np.pi) if self.free else []])
        low, high = (np.concatenate([[np.log(f)], sign * reach]) for f, sign in zip(FOCAL_RANGE, (-1, 1), strict=True))
        if self.focal_known:
            low[0], high[0] = self.start[0] - 1e-9, self.start[0] + 1e-9
        found = least_squares(
            lambda values: self.residuals(values)[used],
            np.clip(self.values, low + 1e-12, high - 1e-12),
            lambda values: self.jacobian(values)[used],
            bounds=(low, high),
            loss="soft_l1",
            f_scale=2.0,
            x_scale=np.concatenate([[0.3, 0.1, 0.1, 0.1], np.full(len(low) - 4, 0.02)]),
            max_nfev=most,
        )
        moved = np.concatenate([[0.0], found.x[4:]]) if self.free else None
        return replace(self, start=found.x[:4], deviations=moved, cost=float(found.cost))

    def reweight(self) -> "Adjustment":
        """Measure the noise of both kinds, then fit again."""
        residuals = np.abs(self.residuals(self.values)[: len(self.evidence.pairs)])
        residuals *= self.sigmas[self.evidence.kinds.astype(int)]
        kinds = (residuals[~self.evidence.kinds], residuals[self.evidence.kinds])
        sigmas = [max(LEAST_SIGMA_PX, 1.4826 * float(np.median(each))) if len(each) else 0.5 for each in kinds]
        return replace(self, sigmas=np.array(sigmas)).solve()

    def left_out(self) -> float:
        """Predict each third of the pairs of views from the others: mean absolute error in pixels."""
        fold, errors = self.evidence.pairs.sum(axis=1) % FOLDS, []
        for number in range(FOLDS):
            fitted = self.solve(fold != number, most=8)
            errors.append(np.abs(fitted.residuals(fitted.values)[: len(fold)][fold == number]))
        sigmas = np.concatenate([self.sigmas[self.evidence.kinds.astype(int)][fold == n] for n in range(FOLDS)])
        return float(np.mean(np.minimum(np.concatenate(errors) * sigmas, UNUSABLE_PX)))

    def covariance(self) -> np.ndarray:
        """Compute the parameters' covariance; all pairs of a view share its errors.

        Dyadic clusters: P. Aronow, C. Samii and V. Assenova, Political Analysis 23, 2015. Errors of the
        principal point and of the place of all outlines add their share.
        """
        values, count = self.values, self.evidence.count
        jacobian = self.jacobian(values, 7)
        residuals = self.residuals(values)
        weights = 1 / np.sqrt(1 + (residuals / 2) ** 2)
        errors = [PRINCIPAL_SD, PRINCIPAL_SD, 2 * OUTLINE_SD_PX / self.evidence.height]
        unknown, jacobian = jacobian[:, 4:7] * errors, np.delete(jacobian, [4, 5, 6], axis=1)
        normal = (jacobian * weights[:, None]).T @ jacobian
        inverse = np.linalg.inv(normal + 1e-12 * np.trace(normal) * np.eye(len(normal)))
        scores = jacobian * (weights * residuals)[:, None]
        meat = count / SHARED * normal  # outlines that agree by chance, as those of a round body, tell nothing
        meat += scores[len(self.evidence.pairs) :].T @ scores[len(self.evidence.pairs) :]
        for view in range(count):
            total = scores[: len(self.evidence.pairs)][(self.evidence.pairs == view).any(axis=1)].sum(axis=0)
            meat += np.outer(total, total)
        gain = inverse @ (jacobian * weights[:, None]).T @ unknown
        own = inverse @ meat @ inverse
        return own + gain @ gain.T

    def extent(self) -> tuple[float, float]:
        """Find the object's lowest and highest place along the axis, where its outlines of two views touch."""
        lens, turns = self._model(self.values)
        turns, heights = turns[: len(self.evidence.tangents)], []
        base = np.column_stack([np.cos(turns) - 1, np.sin(turns), np.zeros_like(turns)])
        for (first, second), at, wide in self.evidence.touching(lens, turns):
            second = _turn(second, turns)
            normal = np.cross(first, second)
            along = np.einsum("ij,ij->i", np.cross(base, second), normal) / np.einsum("ij,ij->i", normal, normal)
            sure = ~wide & (np.minimum(at[0][1], at[1][1]) > LEAST_SINE)
            heights.append((along * first[:, 2])[sure & (np.abs(np.sin(turns)) > LEAST_SINE)])
        low, high = np.percentile(np.concatenate(heights), EXTENT)
        return float(low), float(high)


def find_turn(evidence: Evidence, focal: float | None = None) -> list[Adjustment]:
    """Fit the turn with equal steps in both senses, from views from above and from below; the better sense first."""
    start = np.array([np.log(focal or FOCAL_START), 0.0, 0.0, 0.0])
    senses = [
        [
            Adjustment(evidence, sense, start + tilt * np.eye(4)[1], focal_known=focal is not None).solve(most=30)
            for tilt in np.radians(TILTS_DEG)
        ]
        for sense in (1, -1)
    ]
    return sorted((min(each, key=lambda fit: fit.cost) for each in senses), key=lambda fit: fit.cost)


def estimate_turn(
    greys: list[np.ndarray],
    masks: list[np.ndarray],
    names: tuple[str, ...],
    *,
    intrinsics: np.ndarray | None = None,
    distortion: tuple[float, ...] = NO_DISTORTION,
    steps: str = "free",
    height: float | None = None,
) -> TurnEstimate:
    """Estimate the cameras of photographs taken once round an object, in their order.

    Parameters
    ----------
    greys, masks : list of ndarray
        Picture of `reduce_grey`, and (rows, columns) bool, of every view.
    names : tuple of str
        Names of the views.
    intrinsics : ndarray, optional
        (3, 3) matrix of a known lens; without one the pixels are square and the centre of the picture is its principal
        point.
    distortion : tuple of float
        k1, k2, p1, p2, k3 of the known lens.
    steps : str
        "equal", or "free": one angle a view where that predicts left-out pairs of views better.
    height : float, optional
        Height of the object along the axis in the world's unit, which sets the scale; without it the mean distance of
        the cameras to the axis is 1.

    Returns
    -------
    TurnEstimate
        World: z along the axis, upward in the pictures; the origin on the axis, halfway up the object.

    Raises
    ------
    UserError
        For fewer than 8 views, and where the photographs contradict one turn or do not determine its cameras.
    """
    rows, columns = masks[0].shape
    if len(masks) < FEWEST_VIEWS:
        raise UserError(
            f"cameras: {len(masks)} views determine no cameras; expected {FEWEST_VIEWS} or more, once round. {REMEDY}"
        )
    empty = [name for name, mask in zip(names, masks, strict=True) if not mask.any()]
    if empty:
        raise UserError(f"cameras: no outline of the object was found in view {', '.join(empty[:5])}. {REMEDY}")
    cut = [n for n, mask in zip(names, masks, strict=True) if mask[[0, -1]].any() or mask[:, [0, -1]].any()]
    if cut:
        raise UserError(
            f"cameras: the border of the picture cuts the object in view {', '.join(cut[:5])}; whole outlines "
            f"are needed. {REMEDY}"
        )
    matches = match_features(greys, masks)
    evidence = Evidence(masks, matches, intrinsics, distortion)
    focal = None if intrinsics is None else float(intrinsics[0, 0]) / evidence.side
    best, other = find_turn(evidence, focal)
    fit = best.reweight()
    deviation = np.sqrt(np.diag(fit.covariance()))
    error = equal_error = fit.left_out()
    if steps == "free":
        free = min((replace(each, sigmas=fit.sigmas, free=True).solve() for each in (fit, other)), key=lambda f: f.cost)
        other = other if free.sense == fit.sense else best  # if both fits disagree on the sense, ratio is 1: refused
        free = free.reweight()
        if (free_error := free.left_out()) < FREE_GAIN * equal_error:
            fit, error, deviation = free, free_error, np.sqrt(np.diag(free.covariance()))
        else:  # the difference of the two fits counts as uncertainty
            deviation = np.hypot(deviation, free.start - fit.start)
    least = LEAST_COST * len(evidence.pairs)
    ratio = replace(other, sigmas=fit.sigmas, free=fit.free).solve().cost / max(fit.cost, least)
    angle_sd = float(np.degrees(deviation[4:-1].max())) if fit.free else 0.0
    if error > max(MOST_ERROR * evidence.height, 1.0):
        raise UserError(
            f"cameras: the photographs contradict one turn by {error:.2g} px; expected the object once round before a "
            f"background that is not the object's, in order, camera and zoom fixed. {REMEDY}"
        )
    if ratio < LEAST_RATIO:
        raise UserError(
            "cameras: the photographs do not determine which way the object turns: it is too round and too smooth, or "
            f"stands still. {REMEDY}"
        )
    if deviation[0] > MOST_FOCAL_SD or angle_sd > MOST_ANGLE_SD_DEG:
        raise UserError(
            f"cameras: the photographs do not determine the cameras (focal length to {100 * deviation[0]:.2g} %, "
            f"angles to {angle_sd:.2g} degrees): the object is too round and too smooth. {REMEDY}"
        )
    steps_deg = np.degrees(np.diff(fit.sense * fit.angles, append=2 * np.pi))
    deviations = np.abs(steps_deg - np.median(steps_deg))
    scatter = max(1.4826 * float(np.median(deviations)), np.sqrt(2) * angle_sd)
    matrix = intrinsics
    if matrix is None:
        pixels = evidence.side * np.exp(fit.start[0])
        matrix = np.array([[pixels, 0, (columns - 1) / 2], [0, pixels, (rows - 1) / 2], [0, 0, 1.0]])
    low, high = fit.extent()
    scale = 1.0 if height is None else height / (high - low)
    rotation, cameras = rotation_matrix(fit.start[1:4]) @ FACING, []
    for name, angle in zip(names, fit.angles, strict=True):
        turned = rotation @ rotation_matrix(np.array([0.0, 0.0, -angle]))
        centre = scale * np.array([np.cos(angle), np.sin(angle), -(low + high) / 2])
        cameras.append(Camera(name, matrix, turned, -turned @ centre, rows, columns, distortion))
    ahead = rotation[2]
    return TurnEstimate(
        cameras=cameras,
        focal_px=float(matrix[0, 0]),
        focal_sd_px=float(deviation[0] * matrix[0, 0]),
        tilt_deg=float(np.degrees(np.arcsin(-ahead[2]))),
        tilt_sd_deg=float(np.degrees(deviation[1])),
        steps="free" if fit.free else "equal",
        angles_deg=tuple(np.degrees(fit.angles).tolist()),
        angle_sd_deg=angle_sd,
        uneven_steps_deg={
            f"{name} to {after}": float(step)
            for name, after, step, deviation in zip(names, [*names[1:], names[0]], steps_deg, deviations, strict=True)
            if fit.free and deviation > UNEVEN_SIGMAS * scatter
        },
        outline_px=float(fit.sigmas[0]),
        match_px=float(fit.sigmas[1]) if len(matches.views) else None,
        matches=len(matches.views),
        left_out_px=error,
        left_out_equal_px=equal_error,
        mirror_ratio=float(ratio),
        height=scale * (high - low),
    )
