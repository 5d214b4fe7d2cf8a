"""Lamps of a dome from photographs of mirror spheres: one sphere gives directions, two or more give positions.

Every photograph shows the same spheres under one lamp. Steps: outlines from the edges that all photographs share,
highlights from what each photograph has more than the others, one fit of all lamps and outlines (`lamps`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.calibrate.lamps import Falloff, LampFit, Sighting, fit_lamps
from nishiki.calibrate.photographs import full_scale_of, read_grey
from nishiki.calibrate.sphere_outline import Outline, find_circles, fit_outline
from nishiki.capture.lights import light_name
from nishiki.capture.mirror_sphere import INSIDE, Highlight, SphereCamera, find_highlight, sphere_of
from nishiki.errors import UserError
from nishiki.formats.masks import read_mask

MARGIN = 1.65  # of the radius: half the side of the crop around a sphere
SEARCH_SIDE = 1000  # pixels of the picture in which spheres are looked for
DOUBLED = 0.35  # light of the second highlight relative to the first, from which it is doubtful which is the lamp
FAINT = 0.15  # of the median peak: below there is no highlight
AREA_RANGE = 2.8  # a highlight this many times larger or smaller than the others is doubtful
POSITION_SHARE = 0.05  # relative uncertainty of a distance up to which positions are written
BOARD_BLOCKS = 12  # along the longer side of the board's photographs
AGREEMENT_SIGMAS = 4.0


@dataclass(frozen=True)
class SphereInput:
    """What the user says of the spheres.

    seeds: circles (row, column, radius) in pixels, or none; mask: picture, non-zero on the spheres; count: of spheres
    to look for; focal_px: None for an orthographic camera; radius_mm: of every sphere, or None; object_height_mm:
    of the object's surface above the plane on which the spheres lie; board: photographs of a flat board in the
    object's plane, one a lamp in the same order.
    """

    photographs: Sequence[Path]
    seeds: Sequence[tuple[float, float, float]] = ()
    mask: Path | None = None
    count: int = 1
    focal_px: float | None = None
    radius_mm: float | None = None
    object_height_mm: float = 0.0
    board: Sequence[Path] = ()
    compare: Path | None = None


@dataclass(frozen=True)
class MeasuredSpheres:
    """What the photographs show.

    Attributes
    ----------
    names : list of str
        Of the lamps, by their photographs.
    camera : SphereCamera
    mean : (rows, columns) float32
        Of all photographs.
    outlines : list of Outline
        One a sphere.
    crops : list of (picture, (column, row))
        Brightest of all photographs around each sphere, and the crop's corner.
    highlights : dict
        By (lamp, sphere); None where there is none.
    fit : LampFit
        In millimetres where the spheres' radius is known, else in radii.
    positioned : bool
        Whether all lamps have positions worth writing.
    warnings : list of str
    """

    names: list[str]
    camera: SphereCamera
    mean: np.ndarray
    outlines: list[Outline]
    crops: list[tuple[np.ndarray, tuple[int, int]]]
    highlights: dict[tuple[int, int], Highlight | None]
    fit: LampFit
    positioned: bool
    warnings: list[str]


def measure_spheres(given: SphereInput) -> MeasuredSpheres:
    """Lamps of all photographs. UserError where one cannot be measured."""
    _refuse(given)
    names = [light_name(path.name) for path in given.photographs]
    doubled_names = sorted({name for name in names if names.count(name) > 1})
    if doubled_names:
        raise UserError(f"photographs: names appear twice: {', '.join(doubled_names[:5])}. Remedy: rename the files")
    mean, brightest = _overview(given.photographs)
    camera = SphereCamera.of(*mean.shape, given.focal_px)
    outlines = _outlines(given, camera, mean, brightest)
    highlights, crops = _highlights(given, names, outlines, camera)
    sightings, warnings = _sightings(highlights, names, len(outlines))
    near = len(outlines) > 1
    falloff = _falloff(given, camera) if given.board else None
    fit = fit_lamps(
        sightings,
        [each.parameters for each in outlines],
        [each.covariance for each in outlines],
        camera,
        given.radius_mm or 1.0,
        lambda parameters: _origin(parameters, camera, given),
        lamps=len(names),
        near=near or falloff is not None,
        falloff=falloff,
    )
    warnings += _fit_warnings(fit, names, near, given)
    positioned = _positioned(fit, given)
    return MeasuredSpheres(names, camera, mean, outlines, crops, highlights, fit, positioned, warnings)


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


def _overview(photographs: Sequence[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and brightest of all photographs (rows, columns) float32."""
    mean, brightest = None, None
    for path in photographs:
        grey = read_grey(path)
        mean = grey if mean is None else mean + grey
        brightest = grey.copy() if brightest is None else np.maximum(brightest, grey)
    return mean / len(photographs), brightest


def _crop(circle, shape: tuple[int, int]) -> tuple[slice, slice]:
    column, row, radius = circle
    reach = MARGIN * radius
    return (
        slice(max(0, int(row - reach)), min(shape[0], int(row + reach) + 2)),
        slice(max(0, int(column - reach)), min(shape[1], int(column + reach) + 2)),
    )


def _outlines(given: SphereInput, camera: SphereCamera, mean: np.ndarray, brightest: np.ndarray) -> list[Outline]:
    """Outlines of all spheres: near the seeds, of the mask's parts, or the best of the circles that Hough proposes."""
    import cv2

    if given.mask is not None:
        mask = read_mask(given.mask)
        if mask.shape != mean.shape:
            raise UserError(
                f"{given.mask}: expected the photographs' size {mean.shape[1]} x {mean.shape[0]}, found "
                f"{mask.shape[1]} x {mask.shape[0]}"
            )
        shapes = mask.astype(np.uint8)
        count, _, parts, _ = cv2.connectedComponentsWithStats(shapes)
        seeds = [(x + (w - 1) / 2, y + (h - 1) / 2, (w + h) / 4) for x, y, w, h, area in parts[1:count] if area > 100]
        if not seeds:
            raise UserError(f"{given.mask}: no sphere, all pixels are zero. Remedy: paint the spheres non-zero")
        return [_outline(shapes.astype(np.float32)[None], seed, camera) for seed in sorted(seeds)]
    if given.seeds:
        seeds = [(column, row, radius) for row, column, radius in given.seeds]
        return [_outline_of_all(given, seed, camera) for seed in seeds]
    factor = max(1.0, max(mean.shape) / SEARCH_SIDE)
    size = (int(mean.shape[1] / factor), int(mean.shape[0] / factor))
    small = np.stack([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (mean, brightest)])
    candidates: list[Outline] = []
    for column, row, radius in find_circles(small, given.count):
        seed = (column * factor, row * factor, radius * factor)
        crop = _crop(seed, mean.shape)
        try:
            candidates.append(fit_outline(np.stack([mean[crop], brightest[crop]]), seed, camera, _corner(crop)))
        except ValueError:
            continue
    candidates.sort(key=lambda each: -each.support / max(each.rms_px, 0.2) ** 0.5)
    chosen: list[Outline] = []
    for candidate in candidates:
        column, row, radius = candidate.circle(camera)
        others = [each.circle(camera) for each in chosen]
        if all(np.hypot(column - c, row - r) > 0.9 * (radius + s) for c, r, s in others):
            chosen.append(candidate)
    if len(chosen) < given.count:
        raise UserError(
            f"{len(chosen)} of {given.count} mirror spheres were found. Remedy: say where each is with --sphere ROW "
            "COLUMN RADIUS (pixels, roughly), or paint them in a picture for --mask"
        )
    seeds = sorted(each.circle(camera) for each in chosen[: given.count])
    return [_outline_of_all(given, seed, camera) for seed in seeds]


def _outline_of_all(given: SphereInput, seed, camera: SphereCamera) -> Outline:
    """Outline by the edges of every photograph: in their mean, sphere and surroundings may be equally bright."""
    crop = _crop(seed, (camera.rows, camera.columns))
    return _outline(_stack(given.photographs, crop), seed, camera, _corner(crop))


def _outline(stack: np.ndarray, seed, camera: SphereCamera, corner=(0, 0)) -> Outline:
    try:
        return fit_outline(stack, seed, camera, corner)
    except ValueError as e:
        where = f"row {seed[1]:.0f}, column {seed[0]:.0f}, radius {seed[2]:.0f}"
        raise UserError(
            f"sphere at {where}: {e}. Remedy: correct --sphere, or paint the sphere in a picture for --mask"
        ) from e


def _stack(photographs: Sequence[Path], crop: tuple[slice, slice]) -> np.ndarray:
    return np.stack([read_grey(path)[crop] for path in photographs])


def _corner(crop: tuple[slice, slice]) -> tuple[int, int]:
    return crop[1].start, crop[0].start


def _highlights(
    given: SphereInput, names: list[str], outlines: list[Outline], camera: SphereCamera
) -> tuple[dict[tuple[int, int], Highlight | None], list[tuple[np.ndarray, tuple[int, int]]]]:
    """Highlight of each (lamp, sphere), and for each sphere the brightest of its crops with its corner."""
    found: dict[tuple[int, int], Highlight | None] = {}
    crops = []
    for k, outline in enumerate(outlines):
        crop = _crop(outline.circle(camera), (camera.rows, camera.columns))
        stack = _stack(given.photographs, crop)
        column, row, radius = outline.circle(camera)
        rows, columns = np.ogrid[crop]
        rest, noise = _lamp_light(stack, np.hypot(rows - row, columns - column) < INSIDE * radius)
        noise = max(noise, full_scale_of(given.photographs[0]) / 65535)
        crops.append((stack.max(axis=0), _corner(crop)))
        for i in range(len(names)):
            found[i, k] = find_highlight(rest[i], noise, outline.parameters, camera, _corner(crop))
    return found, crops


def _sightings(
    found: dict[tuple[int, int], Highlight | None], names: list[str], spheres: int
) -> tuple[list[Sighting], list[str]]:
    """Highlights that can be trusted, and warnings; UserError where a lamp has none."""
    sightings, warnings, lost = [], [], []
    for k in range(spheres):
        known = [found[i, k] for i in range(len(names)) if found[i, k] is not None]
        peak = float(np.median([h.peak for h in known])) if known else 0.0
        area = float(np.median([h.area_px for h in known])) if known else 0.0
        for i, name in enumerate(names):
            highlight = found[i, k]
            where = f"{name}, sphere {k + 1}"
            if highlight is None or highlight.peak < FAINT * peak:
                warnings.append(f"{where}: no highlight; not used")
            elif highlight.cut:
                warnings.append(f"{where}: the highlight is cut off by the outline; not used")
            elif highlight.second > DOUBLED:
                warnings.append(
                    f"{where}: two highlights, the second with {100 * highlight.second:.0f} % of the light; not used"
                )
            else:
                sightings.append(Sighting(i, k, highlight.pixel, highlight.sigma_px))
                ratio = highlight.area_px / area
                if not 1 / AREA_RANGE < ratio < AREA_RANGE:
                    why = "it may be partly hidden" if ratio < 1 else "it may be a glare or two lamps"
                    warnings.append(f"{where}: the highlight has {ratio:.2g} times the area of the others; {why}")
    seen = {s.lamp for s in sightings}
    lost = [f"{name} ({_reason(found, i, spheres)})" for i, name in enumerate(names) if i not in seen]
    if lost:
        raise UserError(
            f"{len(lost)} of {len(names)} lamps have no highlight that can be used: {', '.join(lost[:8])}. Remedy: "
            "photograph these lamps again, shade what else shines on the spheres, or leave the photographs out"
        )
    return sightings, warnings


def _reason(found: dict[tuple[int, int], Highlight | None], lamp: int, spheres: int) -> str:
    highlights = [found[lamp, k] for k in range(spheres)]
    if any(h is not None and h.cut for h in highlights):
        return "cut off by the outline"
    return "two of similar strength" if any(h is not None and h.second > DOUBLED for h in highlights) else "none"


def _lamp_light(stack: np.ndarray, on_sphere: np.ndarray) -> tuple[np.ndarray, float]:
    """Crops less what they show without their own lamp, and the noise that remains on the sphere.

    From five photographs on, the median over the photographs is what the sphere shows of its surroundings; of fewer,
    the median of each crop.
    """
    dark = np.median(stack, axis=0) if len(stack) >= 5 else np.median(stack, axis=(1, 2), keepdims=True)
    rest = (stack - dark).astype(np.float32)
    shown = rest[:, on_sphere]
    return rest, float(1.4826 * np.median(np.abs(shown - np.median(shown))))


def _origin(outlines: list[np.ndarray], camera: SphereCamera, given: SphereInput) -> tuple[np.ndarray, float]:
    """Point (3,) that lamps are seen from, in the camera's frame, and millimetres a pixel in the object's plane.

    outlines: their parameters. With one sphere lamps are seen from its centre; with more from the point of the object's
    plane in the middle of the photograph. That plane faces the camera and passes the spheres' lowest points, raised by
    the object's height.
    """
    radius = given.radius_mm or 1.0
    spheres = [sphere_of(each, camera, radius)[0] for each in outlines]
    middle = np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2]) - camera.centre
    if camera.focal_px is None:
        pitch = radius / float(np.mean([each[2] for each in outlines]))
        plane = given.object_height_mm
    else:
        plane = float(np.mean([centre[2] - radius for centre in spheres])) + given.object_height_mm
        pitch = -plane / camera.focal_px
    if len(outlines) == 1 and not given.board:
        return spheres[0], pitch
    return np.array([middle[0] * pitch, -middle[1] * pitch, plane]), pitch


def _falloff(given: SphereInput, camera: SphereCamera) -> Falloff:
    """Logarithm of the light on blocks of the board."""
    top = 0.98 * full_scale_of(given.board[0])
    side = max(1, max(camera.rows, camera.columns) // BOARD_BLOCKS)
    rows, columns = camera.rows // side, camera.columns // side
    values = []
    for path in given.board:
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
