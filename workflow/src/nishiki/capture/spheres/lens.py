"""Estimate the focal length of photographs of mirror balls, and the point and the scale that follow from it."""

import numpy as np

from nishiki.capture.spheres.findings import Findings, SphereInput
from nishiki.capture.spheres.lamps import Sighting, triangulate
from nishiki.capture.spheres.optics import SphereCamera, circle_of, outline_points, reflected_rays, sphere_of
from nishiki.capture.spheres.outline import Outline
from nishiki.capture.spheres.search import bright_blocks, fit_scene
from nishiki.formats.images import read_exif

LENSES = (None, 12.0, 8.0, 6.0, 4.5, 3.5, 2.8, 2.2, 1.8, 1.5, 1.25, 1.0, 0.8)
"""Focal lengths that are tried, in longer sides of the photograph; None: seen from afar."""
LEVEL_DEG = 5.0  # tilt of a scene up to which it is taken to be level
LEVEL_SIGMA_DEG = 2.0  # by which a scene that is level on average may be tilted
USUAL_LENS = 2.0  # longer sides: the focal length whose obliqueness is the error where none is known
FILM_DIAGONAL_MM = 43.27


def set_lens(camera: SphereCamera, lens: float | None) -> SphereCamera:
    """Give the camera another focal length, in longer sides of the photograph; None: seen from afar."""
    side = max(camera.rows, camera.columns)
    return SphereCamera.of(camera.rows, camera.columns, None if lens is None else lens * side)


def refit_under(lens: float | None, findings: Findings) -> tuple[SphereCamera, list[Outline]]:
    """Fit the outlines again to the same edges under another focal length, in longer sides; None: seen from afar."""
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


def find_free_pixels(findings: Findings) -> np.ndarray:
    """Find the pixels (rows, columns) of the reduced photographs that show no sphere."""
    import cv2

    free = np.ones(findings.mean.shape, np.uint8)
    for outline in findings.outlines:
        edge = (outline_points(outline.parameters, findings.camera) + 0.5) / findings.factor - 0.5
        cv2.fillPoly(free, [np.round(edge.mean(axis=0) + 1.1 * (edge - edge.mean(axis=0))).astype(np.int32)], 0)
    return free > 0


def locate_origin(outlines: list[np.ndarray], camera: SphereCamera, given: SphereInput) -> tuple[np.ndarray, float]:
    """Locate the point that lamps are seen from, and compute the width of a pixel in the object's plane.

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
