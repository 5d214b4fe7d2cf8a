"""Measure the coherence of silhouettes and cameras, and find the mistake that explains its absence.

The visual hull of all silhouettes holds the object, and the line of sight of every outline pixel touches the object. So
each of these lines meets the hull of the other views, whatever the shape of the object (Hernández, Schmitt and Cipolla,
Silhouette coherence for camera calibration under circular motion, IEEE Trans. PAMI 29(2), 2007). The share of outline
pixels whose line of sight misses that hull, in the mean over the views, is the contradiction. A mistake is named where
its correction removes the contradiction. A rotation of all cameras about the axis of a turntable, and a common factor
of their focal lengths, leave the contradiction (almost) as it is and cannot be seen without a mesh.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations, pairwise

import numpy as np

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera
from nishiki.geometry.hull import SilhouetteField, bounding_box, field_of, sight_rays
from nishiki.geometry.hull_kernels import trace_rays
from nishiki.geometry.placement import shrink
from nishiki.geometry.turn import scale_turn

LONGEST_SIDE = 320
"""Pixels of the longer side of the silhouettes that are compared."""
RAYS, SCREENING_RAYS = 160, 24
"""Outline pixels a view: for the figures, and for the choice among many corrections."""
TOLERANCE_PX, TOLERANCE = 1.0, 0.02
"""Distance from the hull that still counts as touching: pixels, and a share of the root of the silhouettes' area."""
NOTICEABLE, NOTICEABLE_VIEW = 0.01, 0.1
"""Contradiction, and that of the worst view, from which corrections are tried. Sound captures gave 0 with given
silhouettes and 0.000 to 0.015 with silhouettes found in photographs, a chair of thin parts 0.039; the mildest
mistake, two neighbouring views of a round jar exchanged, gave 0.011. Where views are forgiven one that is moved
contradicts alone: 0.17 and more of it."""
EXPLAINED = 0.25
"""A correction explains the contradiction where it leaves no more than this share of it."""
SCALES = (1 / 8, 1 / 6, 1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0, 6.0, 8.0)
FOCAL_FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.7, 2.0)
EXHAUSTED = 0.02
"""Share of the contradiction from which on no better correction is looked for."""
EQUAL = 2e-3
"""Contradictions that differ by less are equal."""
LIKELY = 6
"""Views of which all pairs are tried as exchanged."""
BORDER_SHARE = 0.5
"""A silhouette that covers more of the picture's border than this may be the background."""


@dataclass(frozen=True)
class Correction:
    """A correction that would remove a contradiction."""

    # "turn-reversed", "cameras-order", "views-exchanged", "pictures-mirrored", "camera-scale", "focal-length", "turn-
    # angles", "silhouette-inverted" or "view-contradicts"
    kind: str
    detail: str = ""  # the factor of a scale, the axis of a mirror, empty otherwise
    order: tuple[int, ...] | None = None  # camera of each silhouette, by place; None where all keep theirs
    views: tuple[int, ...] = ()  # places of the views that it concerns, all others being right; empty: all


@dataclass(frozen=True)
class Coherence:
    """Agreement of silhouettes and cameras."""

    # mean over the views of `by_view`, the share of each outline that misses the hull of the other views
    contradiction: float
    by_view: tuple[float, ...]
    correction: Correction | None = None  # its explanation, or None
    corrected: float | None = None  # contradiction with the correction


@dataclass(frozen=True)
class Attempt:
    """A correction to try."""

    correction: Correction
    order: tuple[int, ...] | None = None  # (silhouette of each camera), cameras, silhouettes
    cameras: list[Camera] | None = None
    without: tuple[int, ...] = ()  # places of the cameras that take no part


def measure_coherence(silhouettes: list[np.ndarray], cameras: list[Camera], *, misses: int = 0) -> Coherence:
    """Measure how silhouettes, (rows, columns) bool, one a camera, contradict; find the mistake that explains it.

    misses: views that may wrongly see background at a point; a shadow of the object looks like a dark background.

    The time is about 10 ms a view where nothing is wrong, and some seconds where corrections are tried.
    """
    reduced = [shrink(mask, camera, LONGEST_SIDE) for mask, camera in zip(silhouettes, cameras, strict=True)]
    outlines = Outlines([mask for mask, _ in reduced], [camera for _, camera in reduced], misses)
    stated = outlines.miss_shares()
    found = Coherence(float(stated.mean()), tuple(stated.tolist()))
    outlines.enough = EXPLAINED * max(found.contradiction, NOTICEABLE)
    # silhouettes that cover most of the picture's border and leave out something within
    edges = [np.concatenate([m[0], m[-1], m[:, 0], m[:, -1]]).mean() for m in outlines.masks]
    inverted = [i for i, edge in enumerate(edges) if edge > BORDER_SHARE and (~outlines.masks[i]).sum() > 16]
    if inverted:
        masks = [~mask if i in inverted else mask for i, mask in enumerate(outlines.masks)]
        share = float(Outlines(masks, outlines.cameras, misses).miss_shares().mean())
        if share < outlines.enough:
            return replace(found, correction=Correction("silhouette-inverted", views=tuple(inverted)), corrected=share)
    if found.contradiction <= NOTICEABLE and max(found.by_view) <= NOTICEABLE_VIEW:
        return found
    # cameras of pictures of another size, or of another zoom
    of_size = partial(_scale_intrinsics, kind="camera-scale", factors=SCALES, columns=3)
    of_focal_length = partial(_scale_intrinsics, kind="focal-length", factors=FOCAL_FACTORS, columns=2)
    of_all = (_reversals, _orders, _exchanges, _mirrors, of_size, _steps, of_focal_length, _odd_views)
    least = np.inf
    strict = Outlines(outlines.masks, outlines.cameras, 0) if misses else outlines
    # a mistake of all cameras shows in many views
    few = np.quantile(found.by_view, 0.75) < EXPLAINED * found.contradiction
    for family in (_exchanges, _odd_views) if few else of_all:
        if family is _odd_views and found.correction is not None:
            break
        trial, share = _best_trial(outlines, family(outlines))
        # where views are forgiven several corrections may explain: without, the right one leaves least
        if trial is not None and share < outlines.enough and (left := strict.contradiction(trial)) < least:
            found, least = replace(found, correction=trial.correction, corrected=share), left - EQUAL
        if not misses and least < max(NOTICEABLE * EXPLAINED, EXHAUSTED * found.contradiction):
            break
    return found


class Outlines:
    """Outline pixels and distance maps of silhouettes, compared under any assignment to any cameras.

    enough: contradiction below which a correction explains the stated one.
    """

    enough = 0.0

    def __init__(self, masks: list[np.ndarray], cameras: list[Camera], misses: int):
        self.masks, self.cameras, self.misses = masks, cameras, misses
        self.pixels = [_outline_pixels(mask) for mask in masks]
        self.fields: SilhouetteField = field_of(masks, cameras)
        self.size = float(np.median([np.sqrt(mask.sum()) for mask in masks]))
        together = np.logical_or.reduce(masks)
        spans = [np.flatnonzero(together.any(axis=axis))[[0, -1]] for axis in (1, 0)]
        # An extent that ends on the picture's border would bound nothing.
        self.extent = [np.clip(span, 1, size - 2) for span, size in zip(spans, together.shape, strict=True)]

    def miss_shares(
        self,
        order: Sequence[int] | np.ndarray | None = None,
        cameras: list[Camera] | None = None,
        *,
        without: tuple[int, ...] = (),
        rays: int = RAYS,
    ) -> np.ndarray:
        """Compute the share (views,) of each outline that misses the hull of the others; 1 where no hull is possible.

        order (views,): silhouette of each camera; without: cameras that take no part, whose share is 0.
        """
        moved, cameras = cameras is not None, self.cameras if cameras is None else cameras
        order = np.arange(len(cameras)) if order is None else np.asarray(order)
        used = np.array([i for i in range(len(cameras)) if i not in without])
        ball = self._ball_of(cameras) if moved else self._ball
        if ball is None:
            return np.isin(np.arange(len(cameras)), used).astype(float)
        middle, radius = ball
        geometry = SilhouetteField.geometry_of([cameras[i] for i in used])
        views, origins, directions = [], [], []
        for place, i in enumerate(used):
            pixels = self.pixels[order[i]]
            pixels = pixels[np.linspace(0, len(pixels) - 1, min(rays, len(pixels))).astype(int)]
            directions.append(sight_rays(pixels, cameras[i]))
            origins.append(np.repeat(cameras[i].centre[None], len(pixels), axis=0))
            views.append(np.full(len(pixels), place))
        views, origins, directions = np.concatenate(views), np.concatenate(origins), np.concatenate(directions)
        nearest = np.einsum("ij,ij->i", middle - origins, directions)
        spans = np.column_stack([np.maximum(nearest - radius, 0.0), nearest + radius])
        reach = max(TOLERANCE_PX, TOLERANCE * self.size) * float(np.median(nearest) / np.median(geometry[1][:, 10]))
        deepest = np.empty(len(views))
        field = *geometry, self.fields.frames[order[used]], self.fields.buffer
        trace_rays(field, views, origins, directions, spans, self.misses, max(reach, 1e-6 * radius), deepest)
        counts = np.bincount(views, minlength=len(used))
        out = np.zeros(len(cameras))
        out[used] = np.bincount(views, deepest < -reach, minlength=len(used)) / np.maximum(counts, 1)
        return out

    @cached_property
    def _ball(self) -> tuple[np.ndarray, float] | None:
        return self._ball_of(self.cameras)

    def _ball_of(self, cameras: list[Camera]) -> tuple[np.ndarray, float] | None:
        """Find a ball, centre (3,) and radius, around the common extent of the silhouettes; None without one."""
        frames = []
        for camera in cameras:
            frame = np.zeros((camera.rows, camera.columns), bool)
            frame[np.ix_(*self.extent)] = True  # the corners alone: the box is that of their convex outline
            frames.append(frame)
        try:
            box = bounding_box(frames, cameras)
        except UserError:
            return None
        return box.mean(axis=0), float(np.linalg.norm(box[1] - box[0]) / 2)

    def contradiction(self, trial: Attempt, rays: int = RAYS) -> float:
        """Average `miss_shares` over the views that take part."""
        shares = self.miss_shares(trial.order, trial.cameras, without=trial.without, rays=rays)
        return float(shares.sum() / (len(shares) - len(trial.without)))


def _best_trial(outlines: Outlines, trials: list[Attempt]) -> tuple[Attempt | None, float]:
    """Return the trial with the least contradiction, the first of equals; the best two are fully traced."""
    if len(trials) > 2:
        screened = [outlines.contradiction(trial, SCREENING_RAYS) for trial in trials]
        trials = [trials[k] for k in sorted(np.argsort(screened, kind="stable")[:2])]
    shares = [outlines.contradiction(trial) + EQUAL * rank for rank, trial in enumerate(trials)]
    best = int(np.argmin(shares)) if shares else 0
    return (trials[best], shares[best] - EQUAL * best) if shares else (None, np.inf)


def _reversals(outlines: Outlines) -> list[Attempt]:
    """Try the object turned the other way."""
    cameras = _scale_turn(outlines.cameras, -1.0)
    return [Attempt(Correction("turn-reversed"), cameras=cameras)] if cameras else []


def _scale_turn(cameras: list[Camera], factor: float) -> list[Camera] | None:
    centres = np.array([camera.centre for camera in cameras])
    moved = scale_turn(np.array([camera.matrix for camera in cameras]), centres, factor)
    if moved is None:
        return None
    return [
        replace(Camera.from_matrix(c.name, matrix, rows=c.rows, columns=c.columns), distortion=c.distortion)
        for c, matrix in zip(cameras, moved, strict=True)
    ]


def _orders(outlines: Outlines) -> list[Attempt]:
    """List trials of photographs in another order than the cameras: backwards, sorted as text, begun elsewhere."""
    places = list(range(len(outlines.cameras)))
    as_text = [[place for _, place in sorted((str(place + first), place) for place in places)] for first in (0, 1)]
    orders = [places[::-1], *as_text, *(np.argsort(order).tolist() for order in as_text)]
    orders += [each[k:] + each[:k] for k in places[1:] for each in (places, places[::-1])]
    distinct = dict.fromkeys(tuple(order) for order in orders if order != places)
    return [Attempt(Correction("cameras-order", order=tuple(np.argsort(o).tolist())), o) for o in distinct]


def _exchanges(outlines: Outlines) -> list[Attempt]:
    """List trials of two views exchanged: neighbours, and pairs of the views without which the others agree best."""
    count = len(outlines.cameras)
    alone = [outlines.contradiction(Attempt(Correction(""), without=(i,)), SCREENING_RAYS) for i in range(count)]
    likely = sorted(np.argsort(alone, kind="stable")[:LIKELY].tolist())
    trials = []
    for first, second in dict.fromkeys([*combinations(likely, 2), *pairwise(range(count))]):
        order = list(range(count))
        order[first], order[second] = second, first
        trials.append(Attempt(Correction("views-exchanged", order=tuple(order), views=(first, second)), tuple(order)))
    return trials


def _mirrors(outlines: Outlines) -> list[Attempt]:
    """List trials of all pictures mirrored, or turned by half a turn."""
    return [
        Attempt(Correction("pictures-mirrored", detail), cameras=[_mirror(camera, axes) for camera in outlines.cameras])
        for detail, axes in (("left to right", (0,)), ("top to bottom", (1,)), ("turned by half a turn", (0, 1)))
    ]


def _mirror(camera: Camera, axes: tuple[int, ...]) -> Camera:
    k, last = camera.intrinsics.copy(), (camera.columns - 1, camera.rows - 1)
    for axis in axes:
        k[axis] *= -1
        k[axis, 2] += last[axis]
    return replace(camera, intrinsics=k)


def _scale_intrinsics(outlines: Outlines, kind: str, factors: Sequence[float], columns: int) -> list[Attempt]:
    """Multiply the first columns of the first two rows of the intrinsics by each factor."""
    place = np.add.outer((0, 0, 3), np.arange(3)) < columns
    scaled = [[replace(c, intrinsics=c.intrinsics * np.where(place, f, 1)) for c in outlines.cameras] for f in factors]
    return [Attempt(Correction(kind, f"{f:.3g}"), cameras=cameras) for f, cameras in zip(factors, scaled, strict=True)]


def _steps(outlines: Outlines) -> list[Attempt]:
    """Try other steps of the turn than those of the cameras."""
    count = len(outlines.cameras)
    factors = (count / (count - 1), (count - 1) / count, (count + 1) / count, count / (count + 1), 0.5, 2.0)
    moved = [(f"{f:.4g}", _scale_turn(outlines.cameras, f)) for f in (*factors, *(-f for f in factors))]
    return [Attempt(Correction("turn-angles", detail), cameras=cameras) for detail, cameras in moved if cameras]


def _odd_views(outlines: Outlines) -> list[Attempt]:
    """Try to leave out views one after the other, a sixth of all at most, until the others agree."""
    count, left = len(outlines.cameras), ()
    for _ in range(max(1, count // 6) if count > 3 else 0):
        longer = [Attempt(Correction("view-contradicts"), without=(*left, i)) for i in range(count) if i not in left]
        shares = [outlines.contradiction(trial, SCREENING_RAYS) for trial in longer]
        left = longer[int(np.argmin(shares))].without
        if min(shares) < outlines.enough:
            break
    return [Attempt(Correction("view-contradicts", views=tuple(sorted(left))), without=left)] if left else []


def _outline_pixels(mask: np.ndarray) -> np.ndarray:
    """Find column, row (n, 2) float64 of a mask's outermost pixels; those on the picture's border are no outline."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    inner = cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE)
    outline = mask & (inner == 0)
    outline[[0, -1]] = outline[:, [0, -1]] = False
    return np.argwhere(outline)[:, ::-1].astype(np.float64)
