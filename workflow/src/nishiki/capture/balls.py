"""Photographs of an object beside mirror balls and without a lights file: the lamps are measured on the balls."""

import shlex
from pathlib import Path

import numpy as np

from nishiki.capture.folder import MIRROR_BALLS
from nishiki.capture.layouts import Layout, find_mask, photographs_in, settle_directions
from nishiki.capture.lights import lights_from_vectors
from nishiki.capture.options import ConvertOptions
from nishiki.capture.spheres.findings import LEAST_LAMPS, SphereInput, SpheresError, draw_findings
from nishiki.capture.spheres.measure import MeasuredSpheres, measure_spheres
from nishiki.capture.spheres.optics import outline_points
from nishiki.errors import UserError
from nishiki.formats.images import read_header
from nishiki.formats.problems import CaptureError, Problem, error, warning

MASK = "mask.png"
MOST_SIGMA_DEG = 10.0  # median uncertainty of the directions up to which lamps are believed
MOST_TILT_DEG = 35.0  # of the scene under the lamps; near lamps tilt it, too
LEVEL_DEG = 2.5  # tilt of a scene that sound balls have shown: .2 to 1.3, and 3 to 6 where normals were off by 3 to 5
LEAST_Z = 0.02  # of a direction: lamps below graze the object
BEYOND = 1.1  # radii of a ball that are left out of the mask


def find_photographs(source: Path, options: ConvertOptions) -> list[Path] | None:
    """Find photographs of one size on which balls can be searched; None where there are too few."""
    present = photographs_in(source) if source.is_dir() else []
    sizes = {(header.rows, header.columns) for header in map(read_header, present)}
    return present if len(present) >= LEAST_LAMPS and len(sizes) == 1 else None


def read_with_balls(source: Path, photographs: list[Path], options: ConvertOptions) -> Layout:
    """Measure the lamps on mirror balls in the photographs.

    Photographs without a highlight are left out. Where no mask is given, all but the balls is the object. A picture of
    what was found goes into the capture. Raises CaptureError: layout-unknown without balls, lamps-unmeasured
    where they do not tell of the lamps.
    """
    try:
        measured = measure_spheres(SphereInput(photographs))
    except SpheresError as e:
        raise _refusal(source, str(e), "lamps-unmeasured" if len(e.findings.outlines) > 1 else "layout-unknown") from e
    except UserError as e:
        raise CaptureError(error("lamps-unmeasured", str(source), str(e))) from e
    scene, sigma = measured.scene, np.degrees(np.median(measured.fit.direction_sigma))
    if scene is None or not scene.agrees:
        what = "the lamps measured on what look like mirror balls do not explain what the photographs show besides"
        raise _refusal(source, what)
    if sigma > MOST_SIGMA_DEG or scene.tilt_deg > MOST_TILT_DEG:
        what = (
            f"expected lamps measured to {MOST_SIGMA_DEG:.0f} degrees under which the scene is tilted by at most "
            f"{MOST_TILT_DEG:.0f} degrees, found {sigma:.1f} and {scene.tilt_deg:.0f} degrees on the mirror balls"
        )
        raise _refusal(source, what)
    mask = options.mask or find_mask(source)
    files = {MIRROR_BALLS: _png(draw_findings(measured.findings)[..., ::-1])}
    if mask is None:
        files[MASK] = _png(_mask_without(measured))
    ahead = [i for i, towards in enumerate(measured.fit.directions) if towards[2] > LEAST_Z]
    for name in (name for i, name in enumerate(measured.names) if i not in ahead):
        measured.findings.left_out[name] = "its lamp stands in or behind the object's plane"
    names = [measured.names[i] for i in ahead]
    lights = lights_from_vectors(names, measured.fit.directions[ahead], file="mirror balls")
    layout = Layout(
        "mirror balls",
        tuple(measured.photographs[i] for i in ahead),
        lights,
        None,
        mask,
        (*_notes(source, measured, mask, len(names)), *lights.warnings),
        files=files,
        notes=f"Lamps measured on {len(measured.findings.outlines)} mirror balls in the photographs: {MIRROR_BALLS}",
    )
    return settle_directions(layout, options)


def _refusal(source: Path, text: str, kind: str = "lamps-unmeasured") -> CaptureError:
    remedy = (
        "Give a lights file with --lights. Or give the places of the balls in pixels: ./nishiki calibrate spheres "
        f"{shlex.quote(str(source))} CALIBRATION --sphere ROW COLUMN RADIUS (without --sphere, its page shows which "
        "circles were examined), then convert with --lights CALIBRATION/lamps.lp"
    )
    return CaptureError(error(kind, str(source), text.split(" Remedy:")[0], remedy=remedy))


def _notes(source: Path, measured: MeasuredSpheres, mask: Path | None, lamps: int) -> list[Problem]:
    """Say what was found, what was left out, and by which mask the balls are no part of the object."""
    found, sigma = measured.findings, np.degrees(measured.fit.direction_sigma)
    circles = [each.circle(found.camera) for each in found.outlines]
    places = "; ".join(f"column {x:.0f}, row {y:.0f}, radius {r:.1f}" for x, y, r in circles)
    lens = "the camera is taken to be far away"
    if found.camera.focal_px is not None:
        lens = f"the focal length is {found.camera.focal_px:.0f} pixels"
    notes = [
        warning(
            "lamps-from-balls",
            source.name,
            f"there is no lights file; {lamps} lamps were measured on {len(circles)} mirror balls with an "
            f"uncertainty of {np.median(sigma):.1f} degrees (largest {sigma.max():.1f}); {lens}",
            found=places,
            remedy=f"Look at {MIRROR_BALLS} in the capture: green outlines must lie on balls, red crosses on lights",
        )
    ]
    if measured.scene is not None and measured.scene.tilt_deg > LEVEL_DEG:
        what = "the scene is tilted under the lamps measured on the balls: unless it is, they are off by that angle"
        said = f"{measured.scene.tilt_deg:.0f} degrees"
        remedy = "Photograph again with the balls on black cloth, well inside the picture, or give --lights FILE"
        notes.append(warning("balls-tilted", source.name, what, found=said, remedy=remedy))
    notes += [warning("lamp-unmeasured", name, f"photograph left out: {why}") for name, why in found.left_out.items()]
    if mask is None:
        what = f"the balls are not part of the object: {MASK} excludes them"
    else:
        what = f"whether the balls are part of the object depends on the mask {mask.name}"
    return [*notes, warning("balls-masked", source.name, what)]


def _mask_without(measured: MeasuredSpheres) -> np.ndarray:
    """Picture (rows, columns) uint8 that is 0 on the balls and 255 elsewhere."""
    import cv2

    camera = measured.findings.camera
    picture = np.full((camera.rows, camera.columns), 255, np.uint8)
    for outline in measured.findings.outlines:
        rim = outline_points(outline.parameters, camera)
        cv2.fillPoly(picture, [np.round(rim.mean(axis=0) + BEYOND * (rim - rim.mean(axis=0))).astype(np.int32)], 0)
    return picture


def _png(codes: np.ndarray) -> bytes:
    import cv2

    return cv2.imencode(".png", codes)[1].tobytes()
