"""Locate lamps from rays reflected by mirror spheres, and from the fall-off of their light on a flat surface.

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.capture.spheres.optics import SphereCamera, circle_of, outline_points, reflected_rays, sphere_of
from nishiki.capture.spheres.outline import Outline
from nishiki.capture.spheres.search import Findings, SphereInput, bright_blocks, fit_scene
from nishiki.formats.images import read_exif

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
    """Light on a flat surface."""

    # (n, 2) of the surface, which is the object's plane: to the right of and above the photograph's middle
    pixels: np.ndarray
    log_light: np.ndarray  # (lamps, n), NaN where saturated or dark


@dataclass(frozen=True)
class LampFit:
    """Result of `fit_lamps`, in the unit of the spheres' radius; relative to the origin."""

    directions: np.ndarray  # (lamps, 3): unit vectors
    direction_sigma: np.ndarray  # (lamps,): root mean square error of the direction that the fit expects, radians
    # inverse_distance, inverse_distance_sigma: (lamps,): 0 where one sphere alone was given
    inverse_distance: np.ndarray
    inverse_distance_sigma: np.ndarray
    # (lamps,): root mean square error of the position; infinite where the distance is not determined
    position_sigma: np.ndarray
    # distance of each highlight from where the fit expects it, by (lamp, sphere), pixels
    residuals_px: dict[tuple[int, int], float]
    # mean squared residual of the highlights in units of their uncertainty, by degree of freedom; 1 where the
    # uncertainties are right. NaN without redundancy.
    chi_square: float
    falloff_rms: float  # root mean square of the relative residuals on the surface; NaN without one
    pitch: float  # length of a pixel in the object's plane

    @property
    def positions(self) -> np.ndarray:
        """(lamps, 3); infinite where the distance is not determined."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.directions / self.inverse_distance[:, None]

    def widen(self, sigma: np.ndarray) -> "LampFit":
        """Add a further uncertainty of the directions (lamps,) in radians that the fit does not cover."""
        wider = np.hypot(self.direction_sigma, sigma)
        with np.errstate(divide="ignore", invalid="ignore"):
            positions = np.hypot(self.position_sigma, sigma / self.inverse_distance)
        return replace(self, direction_sigma=wider, position_sigma=np.where(sigma > 0, positions, self.position_sigma))


def fit_lamps(
    sightings: list[Sighting],
    outlines: list[Outline],
    camera: SphereCamera,
    radii: Sequence[float],
    origin_of: Callable[[list[np.ndarray]], tuple[np.ndarray, float]],
    *,
    lamps: int,
    near: bool,
    falloff: Falloff | None = None,
) -> LampFit:
    """Fit directions and, where `near`, distances of all lamps.

    sightings of `lamps` lamps on the spheres with these outlines; radii: of the
    spheres, set the unit; origin_of: gives, from the outlines' parameters, the origin (3,) of the scene in the
    camera's frame and the length of a pixel in the object's plane; near: fit the distances (two spheres or more, or a
    surface), else lamps are taken to be far away. The distance of a lamp that one sphere alone shows is held loosely
    at the median of the others.
    """
    from scipy.optimize import least_squares

    spheres, parameters = len(outlines), [each.parameters for each in outlines]
    roots = [np.linalg.cholesky(c + 1e-18 * np.trace(c) * np.eye(3)) for c in [each.covariance for each in outlines]]
    which = np.array([s.lamp for s in sightings])
    seen_by = np.array([s.sphere for s in sightings])
    pixels = np.array([s.pixel for s in sightings])
    sigma_px = np.array([s.sigma_px for s in sightings])

    def rays(outlines: list[np.ndarray], at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points, directions = np.empty((2, len(at), 3))
        for k in range(spheres):
            of = seen_by == k
            points[of], directions[of] = reflected_rays(at[of], outlines[k], camera, radii[k])
        return points - origin_of(outlines)[0], directions

    points, directions = rays(parameters, pixels)
    # Radians on the mirror's picture of the surroundings for a pixel, in both directions.
    steps = [
        np.linalg.norm(rays(parameters, pixels + step)[1] - directions, axis=1) for step in ([0.1, 0.0], [0.0, 0.1])
    ]
    per_pixel = 10 * np.sqrt((steps[0] ** 2 + steps[1] ** 2) / 2)
    start, start_inverse, _ = triangulate(points, directions, which, lamps, near=near)
    typical = float(np.median(start_inverse[start_inverse > 0])) if (start_inverse > 0).any() else 0.0
    alone = np.bincount(which, minlength=lamps) < 2
    once = np.flatnonzero(alone & (typical > 0 and falloff is None))
    start_inverse[once] = typical
    across = np.stack([np.linalg.svd(u[None])[2][1:] for u in start])
    unknowns = 3 if near else 2
    scale = float(np.linalg.norm(points, axis=1).max()) or radii[0]  # rho is fitted in units of 1 / scale

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

    def surface_residuals(x: np.ndarray, falloff: Falloff) -> np.ndarray:
        u, inverse = lamp_of(x)
        places = np.column_stack([falloff.pixels * origin_of(outlines_of(x))[1], np.zeros(len(falloff.pixels))])
        towards = u[:, None, :] - inverse[:, None, None] * places
        expected = np.log(np.maximum(towards[..., 2], 1e-9)) - 1.5 * np.log((towards**2).sum(axis=-1))
        return _centre(falloff.log_light - expected)

    spread = 0.01

    def residuals(x: np.ndarray) -> np.ndarray:
        parts = [highlight_residuals(x), x[lamps * unknowns :]]
        if len(once):
            parts.append(lamp_of(x)[1][once] / typical - 1)
        if falloff is not None:
            parts.append(surface_residuals(x, falloff) / spread)
        return np.concatenate(parts)

    x = np.zeros(lamps * unknowns + 3 * spheres)
    freedom = 2 * len(sightings) - lamps * unknowns + len(once)
    chi = float("nan")
    for _ in range(3 if falloff is not None or freedom >= LEAST_FREEDOM else 1):
        fit = least_squares(residuals, x, x_scale="jac", method="trf", ftol=1e-8, xtol=1e-8, max_nfev=15)
        x = fit.x
        if falloff is not None:
            spread = max(float(np.sqrt((surface_residuals(x, falloff) ** 2).mean())), 1e-4)
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


def triangulate(
    points: np.ndarray, directions: np.ndarray, which: np.ndarray, lamps: int, *, near: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the point nearest to the rays of each lamp, else their mean direction.

    Parameters
    ----------
    points, directions : (n, 3)
        Origins and unit directions of the rays.
    which : (n,)
        Lamp of each ray.
    lamps : int
    near : bool
        Whether distances may be finite.

    Returns
    -------
    towards : (lamps, 3)
        Unit vectors from the origin.
    inverse : (lamps,)
        Inverse distances; 0 where rays do not meet in front of their points.
    miss : (lamps,)
        Largest angle in radians by which a ray misses the lamp; NaN where there is one ray.
    """
    directions = np.nan_to_num(directions)  # of pixels outside of a sphere
    points = np.nan_to_num(points)
    count, total = np.bincount(which, minlength=lamps), np.zeros((lamps, 3))
    np.add.at(total, which, directions)
    far = total / np.maximum(np.linalg.norm(total, axis=1), 1e-12)[:, None]
    projections = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix, right = np.zeros((lamps, 3, 3)), np.zeros((lamps, 3))
    np.add.at(matrix, which, projections)
    np.add.at(right, which, (projections @ points[:, :, None])[:, :, 0])
    place = np.linalg.solve(matrix + 1e-9 * np.eye(3), right[:, :, None])[:, :, 0]
    ahead = ((place[which] - points) * directions).sum(axis=1) > 0
    behind = np.bincount(which[~ahead], minlength=lamps) > 0
    meet = near & (count > 1) & ~behind & ((place * far).sum(axis=1) > 0)
    length = np.maximum(np.linalg.norm(place, axis=1), 1e-12)
    to_lamp = place[which] - points
    to_lamp /= np.maximum(np.linalg.norm(to_lamp, axis=1), 1e-12)[:, None]
    expected = np.where(meet[which, None], to_lamp, far[which])
    miss = np.zeros(lamps)
    angles = np.arccos(np.clip((expected * directions).sum(axis=1), -1, 1))
    np.maximum.at(miss, which, np.nan_to_num(angles, nan=np.pi))
    towards = np.where(meet[:, None], place / length[:, None], far)
    return towards, np.where(meet, 1 / length, 0.0), np.where(count > 1, miss, np.nan)


def _centre(values: np.ndarray) -> np.ndarray:
    """Subtract the means over both axes from values (lamps, places); return the finite ones as a vector."""
    known = np.isfinite(values)
    rest = np.where(known, values, 0.0)
    for _ in range(5):  # settles the means where some are not known; once is exact where all are
        rest -= np.where(known, rest.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1), 0)
        if len(rest) > 2:
            rest -= np.where(known, rest.sum(axis=0) / np.maximum(known.sum(axis=0), 1), 0)
    return rest[known]


LENSES = (None, 12.0, 8.0, 6.0, 4.5, 3.5, 2.8, 2.2, 1.8, 1.5, 1.25, 1.0, 0.8)
"""Candidate focal lengths, in longer sides of the photograph; None: an orthographic camera."""
LEVEL_DEG = 5.0  # tilt of a scene up to which it is taken to be level
LEVEL_SIGMA_DEG = 2.0  # by which a scene that is level on average may be tilted
BEYOND = 1.1  # radii of a ball that are no part of the scene
USUAL_LENS = 2.0  # longer sides: the focal length whose obliqueness is the error where none is known
FILM_DIAGONAL_MM = 43.27


def set_lens(camera: SphereCamera, lens: float | None) -> SphereCamera:
    """Give the camera another focal length, in longer sides of the photograph; None: orthographic."""
    side = max(camera.rows, camera.columns)
    return SphereCamera.of(camera.rows, camera.columns, None if lens is None else lens * side)


def refit_under(lens: float | None, findings: Findings) -> tuple[SphereCamera, list[Outline]]:
    """Fit the outlines again to the same edges under another focal length, in longer sides; None: orthographic."""
    camera = set_lens(findings.camera, lens)
    return camera, [each.under(camera) for each in findings.outlines]


def estimate_lens(
    given: SphereInput, findings: Findings, sightings: list[Sighting], lamps: int, stack: np.ndarray
) -> tuple[float | None, np.ndarray]:
    """Estimate the focal length, and the uncertainty of the directions that it makes.

    Given; else, of two spheres and more, the one under which their rays meet best; else as Exif states it; else, of one
    sphere, the one under which what lies beside it is level on average; else seen from afar.

    Parameters
    ----------
    given : SphereInput
        Photographs, and the focal length where it is given.
    findings : Findings
        Camera and outlines.
    sightings : list of Sighting
        Highlights, of lamps that are counted from 0.
    lamps : int
        Number of the lamps.
    stack : (lamps, rows, columns) float32
        Light of their reduced photographs, 1 at full scale.

    Returns
    -------
    lens : float or None
        Focal length in longer sides of the photograph; None: seen from afar.
    sigma : (lamps,) float64
        Standard deviation of the directions that follows from the focal length, radians.
    """
    camera = findings.camera
    side = max(camera.rows, camera.columns)
    if given.focal_px is not None:
        return (given.focal_px / side if np.isfinite(given.focal_px) else None), np.zeros(lamps)
    lamp, sphere = np.array([s.lamp for s in sightings]), np.array([s.sphere for s in sightings])
    pixels = np.array([s.pixel for s in sightings])

    def directions_under(lens: float | None) -> tuple[np.ndarray, float]:
        seen, outlines = refit_under(lens, findings)
        points, rays = np.empty((2, len(pixels), 3))
        radii = scale_radii([each.parameters for each in outlines], seen, given)
        for k, outline in enumerate(outlines):
            of = sphere == k
            points[of], rays[of] = reflected_rays(pixels[of], outline.parameters, seen, radii[k])
        points -= locate_origin([each.parameters for each in outlines], seen, given)[0]
        lights, _, miss = triangulate(points, rays, lamp, lamps)
        return lights, float(np.median(miss[np.isfinite(miss)])) if np.isfinite(miss).any() else np.inf

    stated = read_exif(given.photographs[0]).focal_35mm
    lens = stated and stated / FILM_DIAGONAL_MM * np.hypot(camera.rows, camera.columns) / side
    trials = {lens: directions_under(lens) for lens in LENSES}
    if len(findings.outlines) > 1 and np.isfinite(min(miss for _, miss in trials.values())):
        best = min(trials, key=lambda lens: trials[lens][1])
        bound = 1.3 * trials[best][1] + np.radians(0.1)
        as_good = [lens for lens in LENSES if trials[lens][1] <= bound]
        if lens is not None:
            if directions_under(lens)[1] <= bound:
                return lens, _angles(directions_under(1.1 * lens)[0], directions_under(lens)[0])
        elif best is not None:
            # The middle of those that fit as well, by the angle under which the photograph's edge is seen.
            middle = np.mean([np.arctan(0.5 / (lens or np.inf)) for lens in as_good])
            best = float(0.5 / np.tan(middle)) if middle > 0.02 else None
        lights = directions_under(best)[0]
        ends = [_angles(trials[lens][0], lights) for lens in (as_good[0], as_good[-1])]
        return best, np.maximum(*ends) / np.sqrt(3)
    if lens is not None:
        return lens, _angles(directions_under(1.1 * lens)[0], directions_under(lens)[0])
    light = bright_blocks(stack, find_free_pixels(findings))
    scenes = {lens: fit_scene(light, lights) for lens, (lights, _) in trials.items()}
    level = {lens: scene.tilt_deg for lens, scene in scenes.items() if scene is not None and scene.agrees}
    if level and min(level.values()) < LEVEL_DEG:
        best = min(level, key=lambda lens: level[lens])
        return best, np.full(lamps, np.radians(LEVEL_SIGMA_DEG))
    return None, _angles(trials[None][0], directions_under(USUAL_LENS)[0])


def _angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Compute the angles in radians between unit vectors (n, 3)."""
    return np.arccos(np.clip((one * other).sum(axis=1), -1, 1))


def find_free_pixels(findings: Findings, *, whole: bool = False) -> np.ndarray:
    """Find the pixels (rows, columns) bool that show no sphere, of the reduced photographs or of the whole ones."""
    import cv2

    factor, camera = 1.0 if whole else findings.factor, findings.camera
    free = np.ones((camera.rows, camera.columns) if whole else findings.mean.shape, np.uint8)
    for outline in findings.outlines:
        edge = (outline_points(outline.parameters, camera) + 0.5) / factor - 0.5
        cv2.fillPoly(free, [np.round(edge.mean(axis=0) + BEYOND * (edge - edge.mean(axis=0))).astype(np.int32)], 0)
    return free > 0


def locate_origin(outlines: list[np.ndarray], camera: SphereCamera, given: SphereInput) -> tuple[np.ndarray, float]:
    """Locate the origin of lamp directions, and compute the width of a pixel in the object's plane.

    With one sphere lamps are seen from its centre; with more from the point of the object's plane in the middle of the
    photograph. That plane faces the camera and passes the spheres' lowest points, raised by the object's height.

    Parameters
    ----------
    outlines : list of (3,)
        Parameters of the spheres' outlines.
    camera : SphereCamera
        Under which they were fitted.
    given : SphereInput
        With the spheres' radius and the object's height.

    Returns
    -------
    origin : (3,) float64
        In the camera's frame, in millimetres where the radius is given, else in radii.
    pitch : float
        Width of a pixel in that unit.
    """
    radii = scale_radii(outlines, camera, given)
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


def scale_radii(outlines: list[np.ndarray], camera: SphereCamera, given: SphereInput) -> list[float]:
    """Scale the radii of the spheres: as given, else in proportion to those in the photograph.

    Parameters
    ----------
    outlines : list of (3,)
        Parameters of the spheres' outlines.
    camera : SphereCamera
        Under which they were fitted.
    given : SphereInput
        With the spheres' radius in millimetres, or None.

    Returns
    -------
    list of float
        Radius of each sphere, in millimetres or in mean radii, as of balls on one plane.
    """
    if given.radius_mm is not None:
        return [given.radius_mm] * len(outlines)
    pixels = np.array([circle_of(each, camera)[2] for each in outlines])
    return list(pixels / pixels.mean())
