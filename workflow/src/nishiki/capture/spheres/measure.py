"""Measure the lamps of photographs that show mirror balls: one ball gives directions, two or more give positions.

Every photograph shows the same balls under one lamp. Steps: balls from highlights that move (`search`, `circles`),
outlines from the edges that all photographs share (`outline`), highlights from what each photograph has more than most
others, the lens from the agreement of the balls, one fit of all lamps and outlines (`lamps`). Photographs of an object
beside balls and without a lights file are converted by the lamps that were measured.
"""

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.capture.folder import MIRROR_BALLS
from nishiki.capture.layouts import Layout, find_mask, photographs_in, settle_directions
from nishiki.capture.lights import light_name, lights_from_vectors
from nishiki.capture.options import ConvertOptions
from nishiki.capture.spheres import lamps, search
from nishiki.capture.spheres.circles import locate_given, search_circles
from nishiki.capture.spheres.optics import INSIDE, SphereCamera, find_highlight
from nishiki.capture.spheres.outline import Circle, fit_outline
from nishiki.capture.taking import SATURATED, full_scale_of, read_grey
from nishiki.errors import UserError
from nishiki.formats.banded_pictures import png_bytes
from nishiki.formats.images import read_header
from nishiki.formats.masks import read_mask
from nishiki.formats.problems import CaptureError, Problem, error, name_some, warning

DOUBLED = 0.35  # light of the second highlight relative to the first, from which it is doubtful which is the lamp
AREA_RANGE = 2.8  # a highlight this many times larger or smaller than the others is doubtful
POSITION_SHARE = 0.05  # relative uncertainty of a distance up to which positions are written
BOARD_BLOCKS = 12  # along the longer side of the board's photographs
AGREEMENT_SIGMAS = 4.0  # standard deviations


@dataclass(frozen=True)
class MeasuredSpheres:
    """Lamps of all photographs with a highlight."""

    photographs: list[Path]  # those whose lamp was measured
    names: list[str]  # of their lamps
    # its highlights count all photographs that were given; `numbers` are those of the measured
    findings: search.Findings
    numbers: list[int]
    fit: lamps.LampFit  # in millimetres where the spheres' radius is known, else in radii
    # (lamps,): part of the uncertainty of the directions that the unknown lens makes, radians; within
    # fit.direction_sigma
    lens_sigma: np.ndarray
    positioned: bool  # whether all lamps have positions worth writing
    scene: search.SceneFit | None  # how well the lamps explain what lies beside the spheres
    warnings: list[str]


def measure_spheres(given: search.SphereInput) -> MeasuredSpheres:
    """Find mirror spheres in photographs and measure the lamp of each photograph.

    Parameters
    ----------
    given : SphereInput
        Photographs, and what is known of the spheres.

    Returns
    -------
    MeasuredSpheres
        Lamps of the photographs on which a highlight was measured.

    Raises
    ------
    SpheresError
        Where no spheres are found, or too few lamps are measured.
    UserError
        Where the input is not usable.
    """
    _refuse(given)
    names = [light_name(path.name) for path in given.photographs]
    doubled_names = sorted({name for name in names if names.count(name) > 1})
    if doubled_names:
        raise UserError(
            f"photographs: expected a name of its own for each, found several named {name_some(doubled_names)}. "
            "Remedy: rename the files"
        )
    overview = search.read_overview(given.photographs, search.read_light)
    header = read_header(given.photographs[0])
    rows, columns = header.rows, header.columns
    findings = search.Findings(
        overview.stack.mean(axis=0), overview.stack.max(axis=0), overview.factor, SphereCamera.of(rows, columns)
    )
    circles, read = (
        (locate_given(given, findings), []) if given.seeds or given.mask else search_circles(given, overview, findings)
    )
    if not circles or (given.count is not None and len(circles) != given.count):
        expected = "at least one" if given.count is None else f"{given.count}"
        raise search.SpheresError(
            f"mirror spheres: expected {expected}, found {len(circles)}. Remedy: give the place of each with --sphere "
            "ROW COLUMN RADIUS (in pixels, roughly), or paint the spheres in a picture and give it with --mask",
            findings,
        )
    crops = [search.crop_around(circle, (rows, columns)) for circle in circles]
    stacks = [search.cut_crop(crop, read) for crop in crops]
    whole = [stack for stack in stacks if stack is not None]
    if len(whole) < len(stacks):
        whole = search.read_crops(given.photographs, crops)
    for circle, crop, stack in zip(circles, crops, whole, strict=True):
        _measure_sphere(given, circle, crop, stack, findings)
    sightings, warnings = _sightings(findings, names)
    seen = sorted({s.lamp for s in sightings})
    if len(seen) < max(search.LEAST_LAMPS, search.LEAST_SHARE * len(names)):
        reasons = "; ".join(f"{name}: {why}" for name, why in list(findings.left_out.items())[:8])
        raise search.SpheresError(
            f"{len(names) - len(seen)} of {len(names)} lamps have no highlight that can be used ({reasons}). Remedy: "
            "photograph these lamps again, shade other sources of light, or correct --sphere",
            findings,
        )
    numbers = {lamp: i for i, lamp in enumerate(seen)}
    sightings = [lamps.Sighting(numbers[s.lamp], s.sphere, s.pixel, s.sigma_px) for s in sightings]
    stack = overview.stack[seen]
    lens, lens_sigma = lamps.estimate_lens(given, findings, sightings, len(seen), stack)
    findings.camera, findings.outlines = lamps.refit_under(lens, findings)
    falloff = _falloff(given, findings.camera, seen) if given.board else None
    near = len(findings.outlines) > 1
    fit = lamps.fit_lamps(
        sightings,
        findings.outlines,
        findings.camera,
        lamps.scale_radii([each.parameters for each in findings.outlines], findings.camera, given),
        lambda parameters: lamps.locate_origin(parameters, findings.camera, given),
        lamps=len(seen),
        near=near or falloff is not None,
        falloff=falloff,
    )
    fit = fit.widen(lens_sigma)
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
        _positions_are_accurate(fit, given),
        search.fit_scene(search.bright_blocks(stack, lamps.find_free_pixels(findings)), fit.directions),
        warnings,
    )


def _refuse(given: search.SphereInput) -> None:
    if given.focal_px is not None and not given.focal_px > 0:
        raise UserError(f"--focal-px: expected a number of pixels above 0, found {given.focal_px:g}")
    if given.radius_mm is not None and not given.radius_mm > 0:
        raise UserError(f"--radius-mm: expected a number above 0, found {given.radius_mm:g}")
    if given.board and given.radius_mm is None:
        raise UserError("--board: the fall-off needs lengths. Remedy: give the spheres' radius with --radius-mm")
    if given.board and len(given.board) != len(given.photographs):
        raise UserError(
            f"--board: expected {len(given.photographs)} photographs, one for every lamp in the same order, found "
            f"{len(given.board)}. Remedy: give the folder of all photographs of the board"
        )
    if len(given.photographs) < search.LEAST_LAMPS:
        raise UserError(
            f"photographs: expected at least {search.LEAST_LAMPS}, one a lamp, found {len(given.photographs)}. Remedy: "
            "give the folder of all photographs"
        )


def _measure_sphere(
    given: search.SphereInput, circle: Circle, crop, stack: np.ndarray, findings: search.Findings
) -> None:
    """Add outline, brightest crop and highlights of a sphere to the findings."""
    camera, corner, k = findings.camera, search.corner_of(crop), len(findings.outlines)
    try:
        if given.mask is not None:
            painted = 1 - read_mask(given.mask)[crop].astype(np.float32)[None]
            outline = fit_outline(painted, circle, camera, corner)
        else:
            outline = fit_outline(stack, circle, camera, corner)
    except ValueError as e:
        where = f"row {circle.row:.0f}, column {circle.column:.0f}, radius {circle.radius:.0f}"
        raise search.SpheresError(
            f"sphere at {where}: expected an outline, found {e}. Remedy: correct --sphere, or paint the sphere in a "
            "picture and give it with --mask",
            findings,
        ) from e
    column, row, radius = outline.circle(camera)
    rows, columns = np.ogrid[crop]
    inside = np.hypot(rows - row, columns - column) < INSIDE * radius
    rest = search.subtract_surroundings(stack)
    shown = rest[:, inside]
    noise = max(float(1.4826 * np.median(np.abs(shown - np.median(shown)))), 1 / 65535)
    findings.outlines.append(outline)
    findings.crops.append((stack.max(axis=0), corner))
    for i, picture in enumerate(rest):
        findings.highlights[i, k] = find_highlight(picture, noise, outline.parameters, camera, corner)


def _sightings(findings: search.Findings, names: list[str]) -> tuple[list[lamps.Sighting], list[str]]:
    """Select usable highlights and list warnings; record lamps without one in `findings.left_out`."""
    sightings, doubtful, warnings = [], [], []
    reasons: dict[str, list[str]] = {name: [] for name in names}
    found = findings.highlights
    for k in range(len(findings.outlines)):
        known = [highlight for i in range(len(names)) if (highlight := found[i, k]) is not None]
        peak = float(np.median([h.peak for h in known])) if known else 0.0
        area = float(np.median([h.area_px for h in known])) if known else 0.0
        for i, name in enumerate(names):
            highlight = found[i, k]
            if highlight is None or highlight.peak < search.LEAST_PEAK * peak:
                reasons[name].append("no highlight")
            elif highlight.cut:
                reasons[name].append("its highlight is cut off by the outline")
            elif highlight.second > DOUBLED:
                reasons[name].append(f"two highlights, the second with {100 * highlight.second:.0f} % of the light")
            elif not 1 / AREA_RANGE < (ratio := highlight.area_px / area) < AREA_RANGE:
                why = "it may be partly hidden" if ratio < 1 else "it may be a glare or two lamps"
                reasons[name].append(f"a highlight has {ratio:.2g} times the area of the others; {why}")
                doubtful.append(lamps.Sighting(i, k, highlight.pixel, highlight.sigma_px))
            else:
                sightings.append(lamps.Sighting(i, k, highlight.pixel, highlight.sigma_px))
    sure = {s.lamp for s in sightings}
    sightings += [s for s in doubtful if s.lamp not in sure]
    seen = {s.lamp for s in sightings}
    for i, name in enumerate(names):
        if i not in seen:
            findings.left_out[name] = reasons[name][0]
        elif reasons[name]:
            warnings.append(f"{name}: measured badly on {len(reasons[name])} of the spheres ({reasons[name][0]})")
    return sightings, warnings


def _falloff(given: search.SphereInput, camera: SphereCamera, seen: list[int]) -> lamps.Falloff:
    """Compute the logarithm of the light on blocks of the board, under the measured lamps."""
    top = SATURATED * full_scale_of(given.board[0])
    side = max(1, max(camera.rows, camera.columns) // BOARD_BLOCKS)
    rows, columns = camera.rows // side, camera.columns // side
    values = []
    for path in (given.board[i] for i in seen):
        grey = read_grey(path)
        if grey.shape != (camera.rows, camera.columns):
            raise UserError(
                f"{path}: expected {camera.columns} x {camera.rows} pixels, as in the photographs of the spheres, "
                f"found {grey.shape[1]} x {grey.shape[0]}. Remedy: photograph the board with the same camera"
            )
        blocks = grey[: rows * side, : columns * side].reshape(rows, side, columns, side)
        mean, brightest = blocks.mean(axis=(1, 3)), blocks.max(axis=(1, 3))
        values.append(np.where((brightest < top) & (mean > 0.02 * top), np.log(np.maximum(mean, 1e-9)), np.nan))
    row, column = np.mgrid[:rows, :columns] * side + (side - 1) / 2
    right, above = column - (camera.columns - 1) / 2, (camera.rows - 1) / 2 - row
    log_light = np.array(values).reshape(len(values), -1)
    if (usable := np.isfinite(log_light).mean()) < 0.3:
        raise UserError(
            "--board: expected at least 30 % of the board to be neither dark nor saturated, found "
            f"{100 * usable:.0f} %. Remedy: photograph the board again with another exposure"
        )
    return lamps.Falloff(np.column_stack([right.ravel(), above.ravel()]), log_light)


def _positions_are_accurate(fit: lamps.LampFit, given: search.SphereInput) -> bool:
    """Check whether the positions of all lamps are accurate enough to write."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = fit.inverse_distance_sigma / fit.inverse_distance
    usable = (fit.inverse_distance > 0) & (relative < POSITION_SHARE) & (fit.directions[:, 2] > 0)
    return bool(given.radius_mm is not None and usable.all())


def _fit_warnings(fit: lamps.LampFit, names: list[str], near: bool, given: search.SphereInput) -> list[str]:
    warnings = []
    behind = [name for name, u in zip(names, fit.directions, strict=True) if u[2] <= 0]
    if behind:
        what = "these lamps stand in or behind the object's plane, so a capture of a plane cannot use them"
        warnings.append(f"{name_some(behind)}: {what}")
    worst = sorted(fit.residuals_px.items(), key=lambda item: -item[1])[:3]
    if near and fit.chi_square > AGREEMENT_SIGMAS**2 / 4:
        shown = ", ".join(f"{names[i]} on sphere {k + 1} {px:.2g} px" for (i, k), px in worst)
        warnings.append(
            f"the highlights on the spheres do not agree: their residuals are {np.sqrt(fit.chi_square):.1f} times "
            f"their uncertainty (largest: {shown}). All uncertainties were raised by this factor. Check the radius and "
            "the focal length"
        )
    if near and given.radius_mm is None:
        warnings.append("positions need the spheres' radius (--radius-mm); only directions were written")
    elif (near or given.board) and not _positions_are_accurate(fit, given):
        warnings.append(
            f"the distance of at least one lamp is uncertain by more than {100 * POSITION_SHARE:.0f} %; only "
            "directions were written. Place the spheres further apart, or photograph a board (--board), to measure "
            "distances"
        )
    return warnings


MASK = "mask.png"
MOST_SIGMA_DEG = 10.0  # median uncertainty of the directions up to which lamps are believed
MOST_TILT_DEG = 35.0  # of the scene under the lamps; near lamps tilt it, too
MOST_LEVEL_DEG = 2.5  # tilt of a level scene: .2 to 1.3 under sound balls, 3 to 6 where normals were off by 3 to 5
LEAST_Z = 0.02  # of a direction: lamps below graze the object


def find_photographs(source: Path, options: ConvertOptions) -> list[Path] | None:
    """Find photographs of one size on which balls can be searched; None where there are too few."""
    present = photographs_in(source) if source.is_dir() else []
    sizes = {(header.rows, header.columns) for header in map(read_header, present)}
    return present if len(present) >= search.LEAST_LAMPS and len(sizes) == 1 else None


def read_with_balls(source: Path, photographs: list[Path], options: ConvertOptions) -> Layout:
    """Measure the lamps on mirror balls in the photographs.

    Photographs without a highlight are left out. Where no mask is given, all but the balls is the object. A picture of
    what was found goes into the capture. Raises CaptureError: layout-unknown without balls, lamps-unmeasured
    where they do not tell of the lamps.
    """
    try:
        measured = measure_spheres(search.SphereInput(photographs))
    except search.SpheresError as e:
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
    files = {MIRROR_BALLS: png_bytes(search.draw_findings(measured.findings))}
    if mask is None:
        files[MASK] = png_bytes(255 * lamps.find_free_pixels(measured.findings, whole=True).astype(np.uint8))
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


def _notes(source: Path, measured: MeasuredSpheres, mask: Path | None, count: int) -> list[Problem]:
    """Report what was found and omitted, and the mask that excludes the balls from the object."""
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
            f"there is no lights file; {count} lamps were measured on {len(circles)} mirror balls with an "
            f"uncertainty of {np.median(sigma):.1f} degrees (largest {sigma.max():.1f}); {lens}",
            found=places,
            remedy=f"Look at {MIRROR_BALLS} in the capture: green outlines must lie on balls, red crosses on lights",
        )
    ]
    if measured.scene is not None and measured.scene.tilt_deg > MOST_LEVEL_DEG:
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
