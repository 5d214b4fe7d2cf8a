"""Measure the lamps of photographs that show mirror balls: one ball gives directions, two or more give positions.

Every photograph shows the same balls under one lamp. Steps: balls from highlights that move (`search`), outlines from
the edges that all photographs share (`outline`), highlights from what each photograph has more than most others, the
lens from the agreement of the balls, one fit of all lamps and outlines (`lamps`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import combinations, product
from pathlib import Path

import numpy as np

from nishiki.capture.lights import light_name
from nishiki.capture.spheres.lamps import Falloff, LampFit, Sighting, fit_lamps, triangulate
from nishiki.capture.spheres.optics import (
    INSIDE,
    Highlight,
    SphereCamera,
    circle_of,
    find_highlight,
    outline_points,
    reflected_rays,
    sphere_of,
)
from nishiki.capture.spheres.outline import Circle, Outline, fit_outline, propose_circles, solve_outline
from nishiki.capture.spheres.scene import SceneFit, bright_blocks, fit_scene, residual_of
from nishiki.capture.spheres.search import (
    Cluster,
    Overview,
    cluster_highlights,
    find_moving_highlights,
    read_overview,
    subtract_surroundings,
)
from nishiki.capture.taking import channel_names, full_scale_of, read_grey
from nishiki.errors import UserError
from nishiki.formats.exif import read_exif
from nishiki.formats.image_headers import read_header
from nishiki.formats.images import read_codes
from nishiki.formats.masks import read_mask

MARGIN = 1.65  # of the radius: half the side of the crop around a sphere
DOUBLED = 0.35  # light of the second highlight relative to the first, from which it is doubtful which is the lamp
FAINT = 0.15  # of the median peak: below there is no highlight
AREA_RANGE = 2.8  # a highlight this many times larger or smaller than the others is doubtful
POSITION_SHARE = 0.05  # relative uncertainty of a distance up to which positions are written
BOARD_BLOCKS = 12  # along the longer side of the board's photographs
AGREEMENT_SIGMAS = 4.0
MOST_CLUSTERS = 8  # that are examined
LEAST_SUPPORT = 0.45  # of a circle that may be a ball's outline
RIVAL = 0.7  # of the best support: of one ball alone, the outermost circle with as much is its outline
LEAST_OF_SAME = 0.38  # support of a circle as large as that of another ball
SAME_SIZE = 0.05  # relative difference of radii
MOST_SIZES = 3  # of other balls that are tried
MOST_RIVALS = 8  # circles that may be the outline of one ball
EQUAL = 1.03  # residual relative to the least, up to which edges alone rank circles
AS_GOOD = 1.15  # residual relative to the least, up to which circles explain the scene as well
LARGEST = 7.0  # radius of a ball relative to that of the circle around its highlights
LEAST_RADIUS_PX = 10.0
OUTSIDE = 0.1  # share of the highlights that may lie outside of a circle
CROP_SIDE = 440.0  # pixels of a crop in which circles are proposed
COARSE_PX = 20.0  # radius of a cluster on the reduced photographs below which circles are proposed on the whole ones
FINE_PX = 4.0  # radius of a cluster on the reduced photographs below which these show no circle
CROP_REACH = 4.0  # of such a crop, in radii of the cluster
AGREEMENT = np.radians(8.0)  # up to which directions from two circles belong to two balls
CLEAR = 0.7  # support of a circle that is not moved
SETTLED = np.radians(1.5)  # up to which rays agree as well as places on reduced photographs can
LEAST_LAMPS = 4  # that must be measured
LENSES = (None, 12.0, 8.0, 6.0, 4.5, 3.5, 2.8, 2.2, 1.8, 1.5, 1.25, 1.0, 0.8)
"""Focal lengths that are tried, in longer sides of the photograph; None: seen from afar."""
LEVEL_DEG = 5.0  # tilt of a scene up to which it is taken to be level
LEVEL_SIGMA_DEG = 2.0  # by which a scene that is level on average may be tilted
USUAL_LENS = 2.0  # longer sides: the focal length whose obliqueness is the error where none is known
FILM_DIAGONAL_MM = 43.27
MATT_SHARE = 0.36  # of the photographs in which a place on a ball is bright, from which it is no mirror
LEAST_MEASURED = 0.5  # of the photographs: balls that fewer have highlights on are not believed

Crop = tuple[tuple[slice, slice], np.ndarray]
"""Rows and columns of the photographs, and their light there (n, rows, columns)."""


@dataclass(frozen=True)
class SphereInput:
    """What is given of the spheres.

    Attributes
    ----------
    photographs : sequence of Path
        One a lamp.
    seeds : sequence of (row, column, radius)
        Circles in pixels to a quarter of the radius; empty: spheres are searched.
    mask : Path or None
        Picture that is non-zero on the spheres.
    count : int or None
        Number of spheres that must be found; None: as many as there are.
    focal_px : float or None
        Focal length in pixels; infinite: seen from afar; None: from Exif or the agreement of the spheres.
    radius_mm : float or None
        Of every sphere.
    object_height_mm : float
        Of the object's surface above the plane on which the spheres lie.
    board : sequence of Path
        Photographs of a flat board in the object's plane, one a lamp in the same order.
    compare : Path or None
        A lights file.
    """

    photographs: Sequence[Path]
    seeds: Sequence[tuple[float, float, float]] = ()
    mask: Path | None = None
    count: int | None = None
    focal_px: float | None = None
    radius_mm: float | None = None
    object_height_mm: float = 0.0
    board: Sequence[Path] = ()
    compare: Path | None = None


@dataclass
class Findings:
    """What the photographs show so far; filled step by step, so that a failure can be drawn.

    Attributes
    ----------
    mean : (rows, columns) float32
        Of all photographs, reduced, and the brightest of them.
    brightest : (rows, columns) float32
    factor : float
        Pixels of a photograph in a pixel of these.
    camera : SphereCamera
    outlines : list of Outline
        One a sphere.
    crops : list of (picture, (column, row))
        Brightest of all photographs around each sphere, and the crop's corner.
    highlights : dict
        By (photograph, sphere); None where there is none.
    rejected : list of (Circle, str)
        Circles that were examined and why they are no mirror spheres.
    left_out : dict
        Reason by the name of each photograph whose lamp cannot be measured.
    """

    mean: np.ndarray
    brightest: np.ndarray
    factor: float
    camera: SphereCamera
    outlines: list[Outline] = field(default_factory=list)
    crops: list[tuple[np.ndarray, tuple[int, int]]] = field(default_factory=list)
    highlights: dict[tuple[int, int], Highlight | None] = field(default_factory=dict)
    rejected: list[tuple[Circle, str]] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


class SpheresError(UserError):
    """No lamps could be measured; `findings` tell how far it came."""

    def __init__(self, text: str, findings: Findings) -> None:
        super().__init__(text)
        self.findings = findings


@dataclass(frozen=True)
class MeasuredSpheres:
    """Lamps of all photographs with a highlight.

    Attributes
    ----------
    photographs : list of Path
        Those whose lamp was measured.
    names : list of str
        Of their lamps.
    findings : Findings
        Its highlights count all photographs that were given; `numbers` are those of the measured.
    numbers : list of int
    fit : LampFit
        In millimetres where the spheres' radius is known, else in radii.
    lens_sigma : (lamps,)
        Part of the uncertainty of the directions that the unknown lens makes, radians; within fit.direction_sigma.
    positioned : bool
        Whether all lamps have positions worth writing.
    scene : SceneFit or None
        How well the lamps explain what lies beside the spheres.
    warnings : list of str
    """

    photographs: list[Path]
    names: list[str]
    findings: Findings
    numbers: list[int]
    fit: LampFit
    lens_sigma: np.ndarray
    positioned: bool
    scene: SceneFit | None
    warnings: list[str]


def measure_spheres(given: SphereInput) -> MeasuredSpheres:
    """Find mirror spheres in photographs and measure the lamp of each. SpheresError where they cannot be measured."""
    _refuse(given)
    names = [light_name(path.name) for path in given.photographs]
    doubled_names = sorted({name for name in names if names.count(name) > 1})
    if doubled_names:
        raise UserError(f"photographs: names appear twice: {', '.join(doubled_names[:5])}. Remedy: rename the files")
    overview = read_overview(given.photographs, read_light)
    header = read_header(given.photographs[0])
    rows, columns = header.rows, header.columns
    findings = Findings(
        overview.stack.mean(axis=0), overview.stack.max(axis=0), overview.factor, SphereCamera.of(rows, columns)
    )
    circles, read = (
        (_given_circles(given, findings), []) if given.seeds or given.mask else _search(given, overview, findings)
    )
    if not circles or (given.count is not None and len(circles) != given.count):
        expected = "at least one" if given.count is None else f"{given.count}"
        raise SpheresError(
            f"{len(circles)} mirror spheres were found, expected {expected}. Remedy: say where each is with --sphere "
            "ROW COLUMN RADIUS (pixels, roughly), or paint them in a picture for --mask",
            findings,
        )
    crops = [_crop(circle, (rows, columns)) for circle in circles]
    stacks = [_cut(crop, read) for crop in crops]
    if any(stack is None for stack in stacks):
        stacks = _read_crops(given.photographs, crops)
    for circle, crop, stack in zip(circles, crops, stacks, strict=True):
        _measure_sphere(given, circle, crop, stack, findings)
    sightings, warnings = _sightings(findings, names)
    seen = sorted({s.lamp for s in sightings})
    if len(seen) < max(LEAST_LAMPS, LEAST_MEASURED * len(names)):
        reasons = "; ".join(f"{name}: {why}" for name, why in list(findings.left_out.items())[:8])
        raise SpheresError(
            f"{len(names) - len(seen)} of {len(names)} lamps have no highlight that can be used ({reasons}). Remedy: "
            "photograph these lamps again, shade what else shines on the spheres, or correct --sphere",
            findings,
        )
    numbers = {lamp: i for i, lamp in enumerate(seen)}
    sightings = [Sighting(numbers[s.lamp], s.sphere, s.pixel, s.sigma_px) for s in sightings]
    stack = overview.stack[seen]
    lens, lens_sigma = _estimate_lens(given, findings, sightings, len(seen), stack)
    findings.camera, findings.outlines = _under(lens, findings)
    falloff = _falloff(given, findings.camera, seen) if given.board else None
    near = len(findings.outlines) > 1
    fit = fit_lamps(
        sightings,
        [each.parameters for each in findings.outlines],
        [each.covariance for each in findings.outlines],
        findings.camera,
        _radii([each.parameters for each in findings.outlines], findings.camera, given),
        lambda parameters: _origin(parameters, findings.camera, given),
        lamps=len(seen),
        near=near or falloff is not None,
        falloff=falloff,
    )
    fit = fit.widened(lens_sigma)
    chosen = [names[i] for i in seen]
    warnings += [f"{name}: {why}; left out" for name, why in findings.left_out.items()]
    warnings += _fit_warnings(fit, chosen, near, given)
    return MeasuredSpheres(
        [given.photographs[i] for i in seen],
        chosen,
        findings,
        seen,
        fit,
        lens_sigma,
        _positioned(fit, given),
        fit_scene(bright_blocks(stack, _without_spheres(findings)), fit.directions),
        warnings,
    )


def read_light(path: Path) -> np.ndarray:
    """Light (rows, columns) float32 of a photograph, 1 at full scale; of a JPEG by the square of its codes."""
    header = read_header(path)
    if header.kind != "jpeg":
        return read_grey(path) / np.float32(full_scale_of(path))
    light = read_codes(path, channel_names(header), header=header, luma=True)[..., 0] / np.float32(255)
    return light * light


def _refuse(given: SphereInput) -> None:
    if given.focal_px is not None and not given.focal_px > 0:
        raise UserError(f"--focal-px: expected a number of pixels above 0, found {given.focal_px:g}")
    if given.radius_mm is not None and not given.radius_mm > 0:
        raise UserError(f"--radius-mm: expected a number above 0, found {given.radius_mm:g}")
    if given.board and given.radius_mm is None:
        raise UserError("--board: the fall-off needs lengths. Remedy: give the spheres' radius with --radius-mm")
    if given.board and len(given.board) != len(given.photographs):
        raise UserError(
            f"--board: expected {len(given.photographs)} photographs, one for every lamp in the same order, found "
            f"{len(given.board)}"
        )
    if len(given.photographs) < LEAST_LAMPS:
        raise UserError(
            f"photographs: expected at least {LEAST_LAMPS}, one a lamp, found {len(given.photographs)}. Remedy: give "
            "the folder of all photographs"
        )


def _given_circles(given: SphereInput, findings: Findings) -> list[Circle]:
    """Circles of the mask's parts, or along edges near those that the user names."""
    import cv2

    shape = findings.camera.rows, findings.camera.columns
    if given.mask is not None:
        mask = read_mask(given.mask)
        if mask.shape != shape:
            raise UserError(
                f"{given.mask}: expected the photographs' size {shape[1]} x {shape[0]}, found {mask.shape[1]} x "
                f"{mask.shape[0]}"
            )
        count, _, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        circles = [
            Circle(x + (w - 1) / 2, y + (h - 1) / 2, (w + h) / 4, 1.0)
            for x, y, w, h, area in parts[1:count]
            if area > 100
        ]
        if not circles:
            raise UserError(f"{given.mask}: no sphere, all pixels are zero. Remedy: paint the spheres non-zero")
        return sorted(circles)
    seeds = [Circle(column, row, radius, 0.0) for row, column, radius in given.seeds]
    crops = [_crop(seed, shape) for seed in seeds]
    circles = []
    for seed, crop, stack in zip(seeds, crops, _read_crops(given.photographs, crops), strict=True):
        inner = np.array([[seed.column, seed.row]])
        proposed = _propose(stack, _corner(crop), inner, (0.75 * seed.radius, 1.3 * seed.radius), 1.0)
        near = [c for c in proposed if np.hypot(c.column - seed.column, c.row - seed.row) < 0.3 * seed.radius]
        circles.append(_outermost(near) if near else seed)
    return circles


def _propose(stack, corner, inner: np.ndarray, radii: tuple[float, float], factor: float) -> list[Circle]:
    """Propose circles in pixels of the photographs around highlights, in a crop that is reduced where it is large.

    stack: crop whose pixels are `factor` pixels large, `corner` its first pixel's place in units of its own pixels.
    """
    import cv2

    origin = np.asarray(corner, float) * factor
    circles: list[Circle] = []
    for side in (CROP_SIDE, CROP_SIDE / 2):  # rims are sharp or blurred
        shrink = max(1.0, max(stack.shape[1:]) / side)
        size = (max(8, round(stack.shape[2] / shrink)), max(8, round(stack.shape[1] / shrink)))
        small = np.array([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in stack])
        pixel = factor * stack.shape[2] / size[0]
        places = (inner + 0.5 - origin) / pixel - 0.5
        for c in propose_circles(small, places, (max(radii[0] / pixel, 4.0), max(radii[1] / pixel, 8.0))):
            column, row = (np.array([c.column, c.row]) + 0.5) * pixel - 0.5 + origin
            circles.append(Circle(column, row, c.radius * pixel, c.support))
        if shrink == 1 and max(stack.shape[1:]) <= side / 2:
            break
    return sorted(circles, key=lambda each: -each.support)


def _outermost(circles: list[Circle]) -> Circle:
    """The largest of the circles with good support: the horizon of what a ball on a table shows is a circle, too."""
    best = max(circle.support for circle in circles)
    return max((circle for circle in circles if circle.support >= RIVAL * best), key=lambda each: each.radius)


def _search(given: SphereInput, overview: Overview, findings: Findings) -> tuple[list[Circle], list[Crop]]:
    """Find the circles of mirror balls, and crops of the photographs that were read for them.

    The circles are those whose highlights agree about the lamps; of one ball alone, the outermost.
    """
    from scipy.optimize import minimize

    clusters = cluster_highlights(find_moving_highlights(overview.stack), overview)[:MOST_CLUSTERS]
    shape = findings.camera.rows, findings.camera.columns
    small = [c for c in clusters if c.radius / overview.factor < COARSE_PX and overview.factor > 1.2]
    crops = [_crop((*c.centre, CROP_REACH * c.radius / MARGIN), shape) for c in small]
    fine: dict[int | None, Crop] = dict(
        zip(map(id, small), zip(crops, _read_crops(given.photographs, crops), strict=True), strict=True)
    )
    if overview.factor == 1:
        fine[None] = ((slice(0, shape[0]), slice(0, shape[1])), overview.stack)
    candidates: list[tuple[Cluster, list[Circle]]] = []
    left: dict[Circle, float] = {}

    def examine(cluster: Cluster, circles: list[Circle], least: float = LEAST_SUPPORT) -> list[Circle]:
        residual = _explain_scene(cluster, overview, findings.camera)
        good = [c for c in circles if c.support >= least and c.radius >= LEAST_RADIUS_PX]
        left.update({circle: residual(circle) for circle in good})
        least = min((left[circle] for circle in good), default=1.0)
        # Circles that explain the scene as well as the best are ranked by their edges.
        return sorted(good, key=lambda c: (max(left[c], EQUAL * least), -c.support))[:MOST_RIVALS]

    def propose_near(cluster: Cluster, circle: Sequence[float], radii: tuple[float, float]) -> list[Circle]:
        crop = _crop(circle, shape)
        stack = _cut(crop, list(fine.values()))
        inner = np.array(list(cluster.places.values()))
        return _propose(stack, _corner(crop), inner, radii, 1.0) if stack is not None else []

    for cluster in clusters:
        inner = np.array(list(cluster.places.values()))
        radii = 1.02 * cluster.radius, LARGEST * cluster.radius
        circles: list[Circle] = []
        if id(cluster) in fine:
            crop, stack = fine[id(cluster)]
            circles = _propose(stack, _corner(crop), inner, (radii[0], CROP_REACH * cluster.radius), 1.0)
            radii = (CROP_REACH * cluster.radius, radii[1])
        if cluster.radius / overview.factor > FINE_PX:
            centre = (cluster.centre + 0.5) / overview.factor - 0.5
            crop = _crop((*centre, LARGEST * cluster.radius / overview.factor / 1.5), overview.stack.shape[1:])
            circles += _propose(overview.stack[(slice(None), *crop)], _corner(crop), inner, radii, overview.factor)
        residual = _explain_scene(cluster, overview, findings.camera)
        start = (*cluster.centre, 1.5 * cluster.radius)
        if residual(start) < 1:
            # Where the scene tells which circle it must be, edges are looked for along that one, too.
            found = minimize(residual, start, method="Nelder-Mead", options={"maxfev": 150, "xatol": 1}).x
            again = propose_near(cluster, found, (0.88 * found[2], 1.14 * found[2]))
            circles += [c for c in again if np.hypot(c.column - found[0], c.row - found[1]) < 0.25 * found[2]][:4]
        if good := examine(cluster, circles):
            candidates.append((cluster, good))
        else:
            best = max(circles, key=lambda each: each.support, default=Circle(*cluster.centre, cluster.radius, 0.0))
            findings.rejected.append((best, f"no outline: edges along {100 * best.support:.0f} % of a circle"))
    # Balls are often of one size: edges are looked for along circles as large as those of the other balls.
    for k, (cluster, circles) in enumerate(candidates):
        others = [c[0].radius for j, (_, c) in enumerate(candidates) if j != k and min(left[c[0]], 1) < 1]
        for radius in others[:MOST_SIZES]:
            if all(abs(np.log(radius / c.radius)) > SAME_SIZE for c in circles) and radius > cluster.radius:
                near = (radius / (1 + SAME_SIZE), radius * (1 + SAME_SIZE))
                circles = [*circles, *propose_near(cluster, (*cluster.centre, 1.3 * radius), near)[:4]]
        candidates[k] = (cluster, examine(cluster, circles, LEAST_OF_SAME))
    chosen = []
    for circle in _choose(candidates, left, overview, findings):
        share = _lit_share(circle, overview)
        if share > max(MATT_SHARE, 1.8 / len(overview.stack)):
            why = f"a matt ball: places on it are bright in {100 * share:.0f} % of the photographs"
            findings.rejected.append((circle, why))
        else:
            chosen.append(circle)
    return chosen, list(fine.values())


def _lit_share(circle: Circle, overview: Overview) -> float:
    """Mean share of the photographs in which a place on a ball's middle is bright, less what it shows always.

    A mirror shows a spot in one photograph here and in another there; on a matt ball, glossy or not, the whole follows
    the lamp.
    """
    rows, columns = np.indices(overview.stack.shape[1:])
    column, row = ((v + 0.5) / overview.factor - 0.5 for v in circle[:2])
    light = overview.stack[:, np.hypot(columns - column, rows - row) < 0.6 * circle.radius / overview.factor]
    light = np.maximum(light - np.percentile(light, 25, axis=0), 0)  # a flash may have failed
    return float((light.sum(axis=0) ** 2).sum() / max(len(light) * (light**2).sum(), 1e-12))


def _choose(
    candidates: list[tuple[Cluster, list[Circle]]], left: dict[Circle, float], overview: Overview, findings: Findings
) -> list[Circle]:
    """Choose one circle for each ball such that all agree about the lamps under one lens.

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
            if min(_disagreement(pair, lens, findings.camera) for lens in LENSES[::4]) < 3 * AGREEMENT:
                angle, best = min((_disagreement(pair, lens, findings.camera), -k) for k, lens in enumerate(LENSES))
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
                angle = _disagreement(pair, lens, findings.camera)
                if apart and angle < min(AGREEMENT, 2 * least + np.radians(2)):
                    fitting.append((left[circle], angle, circle))
            if fitting:
                chosen[k] = min(fitting)[2]
    why = "its highlights do not agree with the other spheres" if pairs else "another circle has clearer highlights"
    taken = list(chosen.values())
    findings.rejected += [
        (circles[0], why)
        for k, (_, circles) in enumerate(candidates)
        if k not in chosen
        and all(np.hypot(circles[0].column - c.column, circles[0].row - c.row) > c.radius for c in taken)
    ]
    return sorted(taken)


def _explain_scene(cluster: Cluster, overview: Overview, camera: SphereCamera) -> Callable[[Sequence[float]], float]:
    """Function of a circle (column, row, radius): share of the scene's light that the lamps leave which it tells.

    A turn of all lamps leaves it as it is, so that the ball may be seen as if from afar. 1 without a scene.
    """
    import cv2

    seen = sorted(cluster.places)
    places = np.array([cluster.places[i] for i in seen])
    free = np.ones(overview.stack.shape[1:], np.uint8)
    at = [int((v + 0.5) / overview.factor) for v in cluster.centre]
    cv2.circle(free, at, int(2.5 * cluster.radius / overview.factor), 0, -1)
    light = bright_blocks(overview.stack[seen], free > 0)

    def residual(circle: Sequence[float]) -> float:
        if light is None or (np.hypot(*(places - circle[:2]).T) >= circle[2]).mean() > OUTSIDE:
            return 1.0
        shown = (
            np.asarray(circle[:2])
            + (places - circle[:2]) * np.minimum(1, 0.999 * circle[2] / np.hypot(*(places - circle[:2]).T))[:, None]
        )
        return residual_of(light, reflected_rays(shown, np.array(circle[:3]), camera, 1.0)[1])

    return residual


def _disagreement(pair, lens: float | None, camera: SphereCamera) -> float:
    """Median angle in radians by which rays from two balls miss each other; pair: circle and highlights of each."""
    return _meet(pair, lens, camera)[1]


def _meet(pair, lens: float | None, camera: SphereCamera) -> tuple[np.ndarray, float]:
    """Directions (lamps, 3) from between two balls, and the median angle in radians by which rays miss each other."""
    both = sorted(set(pair[0][1]) & set(pair[1][1]))
    if len(both) < LEAST_LAMPS:
        return np.zeros((0, 3)), np.inf
    points, directions = [], []
    seen = _camera_with(camera, lens)
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
    """Move the circles of two balls to where their rays meet best and explain the scene best.

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
    x = minimize(cost, start, method="Nelder-Mead", options={"maxfev": 400, "initial_simplex": simplex}).x
    return Circle(*map(float, x[:3]), circles[0].support), Circle(*map(float, x[3:6]), circles[1].support)


def _camera_with(camera: SphereCamera, lens: float | None) -> SphereCamera:
    """The camera with a focal length in longer sides of the photograph."""
    side = max(camera.rows, camera.columns)
    return SphereCamera.of(camera.rows, camera.columns, None if lens is None else lens * side)


def _under(lens: float | None, findings: Findings) -> tuple[SphereCamera, list[Outline]]:
    """The camera and the outlines, fitted to the same edges, under a focal length in longer sides."""
    camera = _camera_with(findings.camera, lens)
    return camera, [each.under(camera) for each in findings.outlines]


def _crop(circle, shape: tuple[int, int]) -> tuple[slice, slice]:
    column, row, radius = circle[:3]
    reach = MARGIN * radius
    return (
        slice(max(0, int(row - reach)), min(shape[0], int(row + reach) + 2)),
        slice(max(0, int(column - reach)), min(shape[1], int(column + reach) + 2)),
    )


def _cut(crop: tuple[slice, slice], read: list[Crop]) -> np.ndarray | None:
    """Cut a crop from one of those that were read; None where none contains it."""
    for outer, stack in read:
        if all(o.start <= c.start and c.stop <= o.stop for o, c in zip(outer, crop, strict=True)):
            rows, columns = (slice(c.start - o.start, c.stop - o.start) for o, c in zip(outer, crop, strict=True))
            return stack[:, rows, columns]
    return None


def _corner(crop: tuple[slice, slice]) -> tuple[int, int]:
    return crop[1].start, crop[0].start


def _read_crops(photographs: Sequence[Path], crops: Sequence[tuple[slice, slice]]) -> list[np.ndarray]:
    """Read each photograph once and cut all crops from it: (n, rows, columns) for each crop."""

    def cut(path: Path) -> list[np.ndarray]:
        light = read_light(path)
        return [light[crop].copy() for crop in crops]

    with ThreadPoolExecutor(2) as pool:
        cuts = list(pool.map(cut, photographs))
    return [np.array([each[k] for each in cuts]) for k in range(len(crops))]


def _measure_sphere(given: SphereInput, circle: Circle, crop, stack: np.ndarray, findings: Findings) -> None:
    """Add outline, brightest crop and highlights of a sphere to the findings."""
    camera, corner, k = findings.camera, _corner(crop), len(findings.outlines)
    try:
        if given.mask is not None:
            painted = read_mask(given.mask)[crop].astype(np.float32)[None]
            outline = fit_outline(painted, circle, camera, corner)
        else:
            outline = fit_outline(stack, circle, camera, corner)
    except ValueError as e:
        where = f"row {circle.row:.0f}, column {circle.column:.0f}, radius {circle.radius:.0f}"
        raise SpheresError(
            f"sphere at {where}: {e}. Remedy: correct --sphere, or paint the sphere in a picture for --mask", findings
        ) from e
    column, row, radius = outline.circle(camera)
    rows, columns = np.ogrid[crop]
    inside = np.hypot(rows - row, columns - column) < INSIDE * radius
    rest = subtract_surroundings(stack)
    shown = rest[:, inside]
    noise = max(float(1.4826 * np.median(np.abs(shown - np.median(shown)))), 1 / 65535)
    findings.outlines.append(outline)
    findings.crops.append((stack.max(axis=0), corner))
    for i, picture in enumerate(rest):
        findings.highlights[i, k] = find_highlight(picture, noise, outline.parameters, camera, corner)


def _sightings(findings: Findings, names: list[str]) -> tuple[list[Sighting], list[str]]:
    """Highlights that can be used, and warnings; lamps without one are noted in `findings.left_out`."""
    sightings, warnings = [], []
    reasons: dict[str, list[str]] = {name: [] for name in names}
    found = findings.highlights
    for k in range(len(findings.outlines)):
        known = [found[i, k] for i in range(len(names)) if found[i, k] is not None]
        peak = float(np.median([h.peak for h in known])) if known else 0.0
        area = float(np.median([h.area_px for h in known])) if known else 0.0
        for i, name in enumerate(names):
            highlight = found[i, k]
            if highlight is None or highlight.peak < FAINT * peak:
                reasons[name].append("no highlight")
            elif highlight.cut:
                reasons[name].append("its highlight is cut off by the outline")
            elif highlight.second > DOUBLED:
                reasons[name].append(f"two highlights, the second with {100 * highlight.second:.0f} % of the light")
            else:
                sightings.append(Sighting(i, k, highlight.pixel, highlight.sigma_px))
                ratio = highlight.area_px / area
                if not 1 / AREA_RANGE < ratio < AREA_RANGE:
                    why = "it may be partly hidden" if ratio < 1 else "it may be a glare or two lamps"
                    where = f"{name}, sphere {k + 1}"
                    warnings.append(f"{where}: the highlight has {ratio:.2g} times the area of the others; {why}")
    seen = {s.lamp for s in sightings}
    for i, name in enumerate(names):
        if i not in seen:
            findings.left_out[name] = reasons[name][0]
        elif reasons[name]:
            warnings.append(f"{name}: measured without {len(reasons[name])} of the spheres ({reasons[name][0]})")
    return sightings, warnings


def _estimate_lens(
    given: SphereInput, findings: Findings, sightings: list[Sighting], lamps: int, stack: np.ndarray
) -> tuple[float | None, np.ndarray]:
    """Focal length in longer sides (None: seen from afar), and what directions are uncertain by it (lamps,) radians.

    Given; else, of two spheres and more, the one under which their rays meet best; else as Exif states it; else, of one
    sphere, the one under which what lies beside it is level on average; else seen from afar.
    """
    camera = findings.camera
    side = max(camera.rows, camera.columns)
    if given.focal_px is not None:
        return (given.focal_px / side if np.isfinite(given.focal_px) else None), np.zeros(lamps)
    lamp, sphere = np.array([s.lamp for s in sightings]), np.array([s.sphere for s in sightings])
    pixels = np.array([s.pixel for s in sightings])

    def directions_under(lens: float | None) -> tuple[np.ndarray, float]:
        seen, outlines = _under(lens, findings)
        points, rays = np.empty((2, len(pixels), 3))
        radii = _radii([each.parameters for each in outlines], seen, given)
        for k, outline in enumerate(outlines):
            of = sphere == k
            points[of], rays[of] = reflected_rays(pixels[of], outline.parameters, seen, radii[k])
        points -= _origin([each.parameters for each in outlines], seen, given)[0]
        lights, _, miss = triangulate(points, rays, lamp, lamps)
        return lights, float(np.median(miss[np.isfinite(miss)])) if np.isfinite(miss).any() else np.inf

    stated = read_exif(given.photographs[0]).focal_35mm
    trials = {lens: directions_under(lens) for lens in LENSES}
    if len(findings.outlines) > 1 and np.isfinite(min(miss for _, miss in trials.values())):
        best = min(trials, key=lambda lens: trials[lens][1])
        bound = 1.3 * trials[best][1] + np.radians(0.1)
        as_good = [lens for lens in LENSES if trials[lens][1] <= bound]
        if stated is not None:
            lens = stated / FILM_DIAGONAL_MM * np.hypot(camera.rows, camera.columns) / side
            if directions_under(lens)[1] <= bound:
                return lens, _angles(directions_under(1.1 * lens)[0], directions_under(lens)[0])
        elif best is not None:
            # The middle of those that fit as well, by the angle under which the photograph's edge is seen.
            middle = np.mean([np.arctan(0.5 / (lens or np.inf)) for lens in as_good])
            best = float(0.5 / np.tan(middle)) if middle > 0.02 else None
        lights = directions_under(best)[0]
        ends = [_angles(trials[lens][0], lights) for lens in (as_good[0], as_good[-1])]
        return best, np.maximum(*ends) / np.sqrt(3)
    if stated is not None:
        lens = stated / FILM_DIAGONAL_MM * np.hypot(camera.rows, camera.columns) / side
        return lens, _angles(directions_under(1.1 * lens)[0], directions_under(lens)[0])
    light = bright_blocks(stack, _without_spheres(findings))
    scenes = {lens: fit_scene(light, lights) for lens, (lights, _) in trials.items()}
    level = {lens: scene.tilt_deg for lens, scene in scenes.items() if scene is not None and scene.agrees}
    if level and min(level.values()) < LEVEL_DEG:
        best = min(level, key=lambda lens: level[lens])
        return best, np.full(lamps, np.radians(LEVEL_SIGMA_DEG))
    return None, _angles(trials[None][0], directions_under(USUAL_LENS)[0])


def _angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Angles in radians between unit vectors (n, 3)."""
    return np.arccos(np.clip((one * other).sum(axis=1), -1, 1))


def _without_spheres(findings: Findings) -> np.ndarray:
    """Pixels (rows, columns) of the reduced photographs that show no sphere."""
    import cv2

    free = np.ones(findings.mean.shape, np.uint8)
    for outline in findings.outlines:
        edge = (outline_points(outline.parameters, findings.camera) + 0.5) / findings.factor - 0.5
        cv2.fillPoly(free, [np.round(edge.mean(axis=0) + 1.1 * (edge - edge.mean(axis=0))).astype(np.int32)], 0)
    return free > 0


def _origin(outlines: list[np.ndarray], camera: SphereCamera, given: SphereInput) -> tuple[np.ndarray, float]:
    """Point (3,) that lamps are seen from, in the camera's frame, and millimetres a pixel in the object's plane.

    outlines: their parameters. With one sphere lamps are seen from its centre; with more from the point of the object's
    plane in the middle of the photograph. That plane faces the camera and passes the spheres' lowest points, raised by
    the object's height.
    """
    radii = _radii(outlines, camera, given)
    spheres = [sphere_of(each, camera, radius)[0] for each, radius in zip(outlines, radii, strict=True)]
    middle = np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2]) - camera.centre
    if camera.focal_px is None:
        pitch = float(np.mean([radius / each[2] for each, radius in zip(outlines, radii, strict=True)]))
        plane = given.object_height_mm
    else:
        plane = (
            float(np.mean([centre[2] - radius for centre, radius in zip(spheres, radii, strict=True)]))
            + given.object_height_mm
        )
        pitch = -plane / camera.focal_px
    if len(outlines) == 1 and not given.board:
        return spheres[0], pitch
    return np.array([middle[0] * pitch, -middle[1] * pitch, plane]), pitch


def _radii(outlines: list[np.ndarray], camera: SphereCamera, given: SphereInput) -> list[float]:
    """Radius of each sphere: given, else in proportion to those in the photograph, as of balls on one plane."""
    if given.radius_mm is not None:
        return [given.radius_mm] * len(outlines)
    pixels = np.array([circle_of(each, camera)[2] for each in outlines])
    return list(pixels / pixels.mean())


def _falloff(given: SphereInput, camera: SphereCamera, seen: list[int]) -> Falloff:
    """Logarithm of the light on blocks of the board, under the lamps that were measured."""
    top = 0.98 * full_scale_of(given.board[0])
    side = max(1, max(camera.rows, camera.columns) // BOARD_BLOCKS)
    rows, columns = camera.rows // side, camera.columns // side
    values = []
    for path in (given.board[i] for i in seen):
        grey = read_grey(path)
        if grey.shape != (camera.rows, camera.columns):
            raise UserError(f"{path}: expected the size of the photographs of the spheres")
        blocks = grey[: rows * side, : columns * side].reshape(rows, side, columns, side)
        mean, brightest = blocks.mean(axis=(1, 3)), blocks.max(axis=(1, 3))
        values.append(np.where((brightest < top) & (mean > 0.02 * top), np.log(np.maximum(mean, 1e-9)), np.nan))
    row, column = np.mgrid[:rows, :columns] * side + (side - 1) / 2
    right, above = column - (camera.columns - 1) / 2, (camera.rows - 1) / 2 - row
    log_light = np.array(values).reshape(len(values), -1)
    if np.isfinite(log_light).mean() < 0.3:
        raise UserError("--board: less than a third of the board is neither dark nor saturated. Remedy: expose again")
    return Falloff(np.column_stack([right.ravel(), above.ravel()]), log_light)


def _positioned(fit: LampFit, given: SphereInput) -> bool:
    """Whether all lamps have positions worth writing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = fit.inverse_distance_sigma / fit.inverse_distance
    usable = (fit.inverse_distance > 0) & (relative < POSITION_SHARE) & (fit.directions[:, 2] > 0)
    return bool(given.radius_mm is not None and usable.all())


def _fit_warnings(fit: LampFit, names: list[str], near: bool, given: SphereInput) -> list[str]:
    warnings = []
    behind = [name for name, u in zip(names, fit.directions, strict=True) if u[2] <= 0]
    if behind:
        warnings.append(f"in or behind the object's plane, so that no capture of a plane can use them: {behind[:8]}")
    worst = sorted(fit.residuals_px.items(), key=lambda item: -item[1])[:3]
    if near and fit.chi_square > AGREEMENT_SIGMAS**2 / 4:
        shown = ", ".join(f"{names[i]} on sphere {k + 1} {px:.2g} px" for (i, k), px in worst)
        warnings.append(
            f"the spheres disagree: residuals are {np.sqrt(fit.chi_square):.1f} times their uncertainty (largest: "
            f"{shown}); all uncertainties were raised by that. Check that radius and focal length are right"
        )
    if near and given.radius_mm is None:
        warnings.append("positions need the spheres' radius (--radius-mm); only directions were written")
    elif (near or given.board) and not _positioned(fit, given):
        warnings.append(
            f"the distance of at least one lamp is uncertain by more than {100 * POSITION_SHARE:.0f} %; only "
            "directions were written. Spheres further apart, or a board, determine distances"
        )
    return warnings
