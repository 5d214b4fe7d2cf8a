"""A camera from an exposure series, and lens, axis of a turntable and centre of a goniometer from a ChArUco board.

Exposure series of an even surface: linearity, dark level, noise, shading, defective pixels. Every exposure is
photographed twice with nothing changed. Half the variance of the difference of two equal frames is the noise alone,
whatever the surface looks like, and for a camera that counts electrons it rises with the signal m,

    variance = read_noise^2 + m / gain,

with gain in electrons a code (photon transfer: Janesick, Photon Transfer, 2007; EMVA Standard 1288).

Board: the camera stands still and sees it in poses R_i, t_i. The point c of the board that stays where it is while the
stage turns fulfils

    R_i c + t_i = p    for all i,

with p its place in the camera's frame. For one axis all points of the axis fulfil it: the direction that the equations
leave open is the axis. For two axes or more that meet, c is the one point where they do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml

from nishiki.calibrate.result import SATURATED_SHARE, Calibration, finite, list_photographs
from nishiki.capture.taking import SATURATED, channel_names, full_scale_of, read_channels, read_grey
from nishiki.errors import UserError
from nishiki.formats.banded_pictures import png_bytes
from nishiki.formats.images import read_header
from nishiki.formats.text_tables import number_of, table_rows
from nishiki.geometry.board import BoardCorners, BoardShape, board_of, calibrate, detect_boards
from nishiki.geometry.board import LensCalibration as LensFit
from nishiki.observations.linearise import check_linearity
from nishiki.report.page import Figure, Figures, PageSection, Table
from nishiki.report.pictures import encode_picture, heat, scalar_picture
from nishiki.report.svg import PALETTE, ChartCurve, chart

LEAST_LEVELS = 3  # exposures
WINDOW = 0.5  # share of each side, in the middle, from which means and variances are taken
HOT_SIGMAS = 8.0  # of the dark frame's own scatter
DEAD_SHARE = 0.5  # of the light of its neighbours
NONLINEAR = 0.01  # largest deviation from the line, of the largest value, that is not warned about
RESPONSE = 0.5  # of white: the response at which the noise for the stage spectra is stated


@dataclass(frozen=True)
class PhotonTransfer:
    """Noise of a channel: gain in electrons per code, read noise in codes; each with its standard deviation."""

    gain: float
    gain_sigma: float
    read_noise: float
    read_noise_sigma: float


def fit_photon_transfer(signals: np.ndarray, variances: np.ndarray, samples: int) -> PhotonTransfer:
    """Fit variance = read_noise^2 + signal / gain, weighted by the scatter of variances of `samples` samples.

    signals, variances (levels,) in codes, the dark level subtracted from the signals. A variance v of n samples has
    the standard deviation v sqrt(2 / n); where the levels scatter more, the uncertainties grow with it.
    ValueError where the variance does not rise with the signal.
    """
    signals, variances = np.asarray(signals, float), np.asarray(variances, float)
    sigma = np.maximum(variances, 1e-9) * np.sqrt(2 / samples)
    for _ in range(3):  # the weights are those of the fitted variances, which no single low one pulls
        design = np.column_stack([np.ones_like(signals), signals]) / sigma[:, None]
        covariance = np.linalg.inv(design.T @ design)
        floor, slope = covariance @ design.T @ (variances / sigma)
        sigma = np.maximum(floor + slope * signals, 1e-3 * variances.max()) * np.sqrt(2 / samples)
    if not slope > 0:
        raise ValueError("the noise does not rise with the signal")
    residual = (variances - floor - slope * signals) / sigma
    freedom = len(signals) - 2
    covariance = covariance * max(1.0, float(residual @ residual) / freedom if freedom > 0 else 1.0)
    floor_sigma, slope_sigma = np.sqrt(np.diag(covariance))
    read = float(np.sqrt(max(floor, 0.0)))
    read_sigma = float(floor_sigma / (2 * read)) if floor > floor_sigma else float(np.sqrt(floor_sigma))
    return PhotonTransfer(float(1 / slope), float(slope_sigma / slope**2), read, read_sigma)


def read_series(table: Path) -> dict[float, list[Path]]:
    """Read photographs by exposure time from a table `file,exposure_s`; 0 stands for the closed lens."""
    if not table.is_file():
        raise UserError(f"{table}: no such file. Remedy: write a table with the columns file,exposure_s")
    columns, *rows = [cells for _, cells in table_rows(table, table.name)] or [[]]
    if not {"file", "exposure_s"} <= set(columns):
        raise UserError(f"{table}: expected the columns file,exposure_s, found {','.join(columns)[:80]}")
    series: dict[float, list[Path]] = {}
    for cells in rows:
        row = dict(zip(columns, cells, strict=False))
        exposure = number_of(row.get("exposure_s", ""))
        if not (0 <= exposure < 1e6) or not row.get("file"):
            raise UserError(f"{table}: expected a file and an exposure time in seconds, found {cells}")
        series.setdefault(exposure, []).append(table.parent / row["file"])
    list_photographs([str(path) for paths in series.values() for path in paths])
    return dict(sorted(series.items()))


def calibrate_camera(table: Path, *, bits: int | None = None) -> Calibration:
    """Measure linearity, dark level, noise, shading and defects from a series. UserError where it is too short."""
    series = read_series(table)
    pairs = {exposure: paths for exposure, paths in series.items() if len(paths) >= 2 and exposure > 0}
    if 0 not in series or len(series[0]) < 2 or len(pairs) < LEAST_LEVELS:
        raise UserError(
            f"{table}: expected two frames or more with the lens closed (exposure_s 0) and two for each of at least "
            f"{LEAST_LEVELS} exposures, found {len(series.get(0, []))} and {len(pairs)} such exposures"
        )
    first = series[0][0]
    full = float(2**bits - 1) if bits else full_scale_of(first)
    channels = channel_names(read_header(first))
    dark = np.mean([read_channels(path) for path in series[0]], axis=0)
    middle = tuple(slice(int(n * (1 - WINDOW) / 2), int(n * (1 + WINDOW) / 2)) for n in dark.shape[:2])
    samples = dark[middle].shape[0] * dark[middle].shape[1]
    black = np.median(dark, axis=(0, 1))
    listed: tuple[list, ...] = ([], [], [], [])
    brightest: np.ndarray | None = None
    for exposure, paths in {0.0: series[0], **pairs}.items():
        one, two = read_channels(paths[0]), read_channels(paths[1])
        a, b = one[middle], two[middle]
        difference = a - b
        difference -= difference.mean(axis=(0, 1))
        usable = ((a > SATURATED * full) | (b > SATURATED * full)).mean(axis=(0, 1)) < SATURATED_SHARE
        level = (a + b).mean(axis=(0, 1)) / 2 - dark[middle].mean(axis=(0, 1))
        for values, value in zip(listed, (exposure, level, (difference**2).mean(axis=(0, 1)) / 2, usable), strict=True):
            values.append(value)
        if usable.all():
            brightest = (one + two) / 2 - dark
    exposures, levels, variances, usable = (np.array(each) for each in listed)
    results, warnings, rows, noise_of_white = {}, [], [], []
    for c, channel in enumerate(channels):
        good = usable[:, c]
        if good.sum() < LEAST_LEVELS + 1:
            raise UserError(
                f"channel {channel}: expected {LEAST_LEVELS} unsaturated exposures, found {good.sum() - 1}. Remedy: "
                "add shorter ones"
            )
        lit = good & (exposures > 0)
        line = check_linearity(levels[lit, c], exposures[lit])
        try:
            noise = fit_photon_transfer(levels[good, c], variances[good, c], samples)
        except ValueError as e:
            raise UserError(f"channel {channel}: {e}. Remedy: give raw frames without noise reduction") from e
        if line.worst_deviation > NONLINEAR:
            at = exposures[lit][line.worst_patch]
            warnings.append(
                f"{channel}: not linear: {100 * line.worst_deviation:.1f} % of the largest value off the line at "
                f"{at:g} s"
            )
        # White just below saturation, and a surface half as bright: the noise of its response relative to white.
        white = SATURATED * full - black[c]
        response = np.sqrt(noise.read_noise**2 + RESPONSE * white / noise.gain) / white
        noise_of_white.append(float(response))
        results[channel] = {
            "dark_level": finite(black[c]),
            "slope_codes_per_s": finite(line.slope),
            "intercept_codes": finite(line.intercept),
            "r_squared": finite(line.r_squared, 9),
            "worst_deviation": finite(line.worst_deviation),
            "gain_e_per_code": finite(noise.gain),
            "gain_sigma": finite(noise.gain_sigma),
            "read_noise_codes": finite(noise.read_noise),
            "read_noise_sigma": finite(noise.read_noise_sigma),
            "full_well_e": finite(noise.gain * white),
        }
        read = noise.read_noise
        deviation = 100 * line.worst_deviation
        numbers = (black[c], deviation, noise.gain, noise.gain_sigma, read, noise.read_noise_sigma, read * noise.gain)
        rows.append((channel, *(float(v) for v in numbers)))
    hot, dead, shading = _defects(dark, brightest)
    if hot.sum() + dead.sum() > 1e-3 * hot.size:
        warnings.append(f"{int(hot.sum())} hot and {int(dead.sum())} dead samples: more than one in a thousand")
    lines: dict = {"camera": {"black_level": finite(float(np.mean(black)))}}
    if bits:
        lines["camera"]["bits"] = bits
    spectra_noise = finite(max(noise_of_white), 3)
    content = {
        "channels": results,
        "exposures_s": exposures.tolist(),
        "levels": np.round(levels, 4).tolist(),
        "variances": np.round(variances, 5).tolist(),
        "used": usable.tolist(),
        "spectra_noise": spectra_noise,
        "hot_samples": int(hot.sum()),
        "dead_samples": int(dead.sum()),
        "defects_row_column_channel": np.argwhere(hot | dead)[:1000].tolist(),
        "darkest_corner": finite(float(np.nanmin(shading))),
    }
    sections = _sections(rows, channels, exposures, levels, variances, usable, shading, content)
    inputs = [table, *(path for paths in series.values() for path in paths)]
    subtitle = f"{len(pairs)} exposures, {len(channels)} channels."
    files = {"config-lines.yaml": f"spectra: {{noise: {spectra_noise:g}}}\n"}
    return Calibration("camera", content, inputs, lines, sections, subtitle, files, warnings)


def _defects(dark: np.ndarray, light: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find hot and dead samples (rows, columns, channels) bool, and the shading (rows, columns), at most 1."""
    import cv2

    away = dark - np.median(dark, axis=(0, 1))
    scatter = np.maximum(1.4826 * np.median(np.abs(away), axis=(0, 1)), 0.5)
    hot = away > HOT_SIGMAS * scatter
    if light is None:
        return hot, np.zeros_like(hot), np.full(dark.shape[:2], np.nan)
    around = np.stack([cv2.medianBlur(np.ascontiguousarray(light[..., c]), 5) for c in range(light.shape[2])], axis=-1)
    dead = light < DEAD_SHARE * around
    smooth = cv2.GaussianBlur(around.mean(axis=2), (0, 0), max(1.0, max(dark.shape[:2]) / 50))
    return hot, dead, smooth / smooth.max()


def _sections(rows, channels, exposures, levels, variances, usable, shading, content) -> list[PageSection]:
    head = ("channel", "dark level", "off the line %", "gain e/code", "±", "read noise codes", "±", "read noise e")
    linear = _plot(exposures, levels, usable, channels, "exposure, s", "code above dark", "linearity")
    transfer = _plot(levels, variances, usable, channels, "code above dark", "variance, codes²", "photon transfer")
    picture = scalar_picture(shading, heat(), unit="of the brightest", low=0.0, high=1.0)
    figures = [
        Figure(
            "Linearity", "Mean code against exposure time. The points of a linear camera lie on a line.", svg=linear
        ),
        Figure("Noise", "Variance of equal frames against their level: a line, if the camera counts.", svg=transfer),
        Figure("Shading", "Lens and light together; white boards of a capture correct both.", picture),
    ]
    text = (
        f"Hot samples: {content['hot_samples']}, dead: {content['dead_samples']}. Noise of a response of {RESPONSE:g} "
        f"relative to white: {content['spectra_noise']:g}; config-lines.yaml has it for the stage spectra."
    )
    return [PageSection("camera", "Camera", [Table(head, rows, "lrrrrrrr"), text, Figures(figures, 2)])]


def _plot(x, y, usable, channels, x_label, y_label, title) -> str:
    """Draw the used points of every channel, and lines between them."""
    x = np.broadcast_to(x[:, None] if x.ndim == 1 else x, y.shape)
    curves = [
        ChartCurve(channel, x[usable[:, c], c], y[usable[:, c], c], PALETTE[c % len(PALETTE)], dots=dots)
        for dots in (False, True)
        for c, channel in enumerate(["" if dots else name for name in channels])
    ]
    return chart(curves, x_label=x_label, y_label=y_label, title=title, size=(460, 300))


ONE_AXIS = 0.05  # smallest singular value relative to the next, below which the stage has turned about one axis
LEAST_TURN_DEG = 5.0
ARROW = 20.0  # residuals are drawn so many times longer
PRINT_PX_PER_MM = 12.0


def print_board(shape: BoardShape) -> tuple[str, bytes]:
    """Draw the board as SVG in millimetres and as PNG; print without scaling and measure a square afterwards."""
    width, height = shape.squares_x * shape.square, shape.squares_y * shape.square
    cell = round(shape.square * PRINT_PX_PER_MM)
    picture = board_of(shape).generateImage((shape.squares_x * cell, shape.squares_y * cell), marginSize=0)
    scale_x, scale_y = width / picture.shape[1], height / picture.shape[0]
    dark, parts = picture < 128, []
    starts = [0, *(np.flatnonzero((dark[1:] != dark[:-1]).any(axis=1)) + 1), len(dark)]
    for top, end in pairwise(starts):  # equal rows are one bar
        edges = np.flatnonzero(np.diff(np.concatenate([[0], dark[top], [0]]))).reshape(-1, 2)
        up, down = f"{top * scale_y:.4f}", f"{end * scale_y:.4f}"
        parts += [f"M{a * scale_x:.4f} {up}H{b * scale_x:.4f}V{down}H{a * scale_x:.4f}z" for a, b in edges]
    svg = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}"><path d="{"".join(parts)}"/></svg>\n'
    )
    return svg, png_bytes(picture)


def board_poses(pictures: Sequence[BoardCorners], lens: LensFit) -> tuple[np.ndarray, np.ndarray]:
    """Compute rotations (n, 3, 3) and translations (n, 3) of the board in camera axes (x right, y down, z forward)."""
    import cv2

    rotations, translations = [], []
    for each in pictures:
        _, turn, shift = cv2.solvePnP(each.points, each.pixels, lens.intrinsics, np.array(lens.distortion))
        turn, shift = cv2.solvePnPRefineLM(
            each.points, each.pixels, lens.intrinsics, np.array(lens.distortion), turn, shift
        )
        rotations.append(cv2.Rodrigues(turn)[0])
        translations.append(shift[:, 0])
    return np.array(rotations), np.array(translations)


def resting_point(rotations: np.ndarray, translations: np.ndarray) -> dict:
    """Compute the point of a stage that does not move, and its axis where it has one.

    Returns
    -------
    dict
        point (3,): in the camera's frame, for one axis that nearest to the board's mean place; axis (3,): unit, None
        where the poses turn about several axes; turn_deg: largest turn between two poses; rms: root mean square
        distance by which the point moves, in the unit of the translations.

    Raises UserError where the poses hardly turn.
    """
    count = len(rotations)
    steps = np.einsum("nij,kij->nk", rotations, rotations)
    turn = float(np.degrees(np.arccos(np.clip((steps.min() - 1) / 2, -1, 1))))
    if count < 3 or turn < LEAST_TURN_DEG:
        raise UserError(
            f"stage: expected at least 3 pictures turned by {LEAST_TURN_DEG:g} degrees or more, found {count} and "
            f"{turn:.1f} degrees. Remedy: photograph more positions of the stage"
        )
    mean_rotation, mean_translation = rotations.mean(axis=0), translations.mean(axis=0)
    design = (rotations - mean_rotation).reshape(-1, 3)  # p is eliminated: it is the mean of R_i c + t_i
    target = -(translations - mean_translation).ravel()
    left, sizes, right = np.linalg.svd(design, full_matrices=False)
    one_axis = sizes[2] < ONE_AXIS * sizes[1]
    keep = 2 if one_axis else 3
    point = right[:keep].T @ ((left[:, :keep].T @ target) / sizes[:keep])
    away = (design @ point - target).reshape(-1, 3)
    axis = None
    if one_axis:
        axis = mean_rotation @ right[2]
        axis = axis / np.linalg.norm(axis)
    place = mean_rotation @ point + mean_translation
    if axis is not None:
        place = place + axis * (axis @ (mean_translation - place))
    return {"point": place, "axis": axis, "turn_deg": turn, "rms": float(np.sqrt((away**2).sum(axis=1).mean()))}


def resting_point_with_sigma(rotations: np.ndarray, translations: np.ndarray) -> dict:
    """Compute `resting_point` with point_sigma and axis_sigma_deg, by the jackknife over the poses."""
    full = resting_point(rotations, translations)
    count = len(rotations)
    full |= {"point_sigma": float("nan"), "axis_sigma_deg": float("nan")}
    if count < 4:
        return full
    parts = [resting_point(np.delete(rotations, i, axis=0), np.delete(translations, i, axis=0)) for i in range(count)]
    factor = (count - 1) / count
    moved = np.array([part["point"] - full["point"] for part in parts])
    if full["axis"] is not None:  # a place along the axis is arbitrary
        moved -= (moved @ full["axis"])[:, None] * full["axis"]
        cosines = [abs(part["axis"] @ full["axis"]) if part["axis"] is not None else 0.0 for part in parts]
        tilts = np.arccos(np.clip(cosines, 0, 1))
        full["axis_sigma_deg"] = float(np.degrees(np.sqrt(factor * (tilts**2).sum())))
    full["point_sigma"] = float(np.sqrt(factor * (moved**2).sum()))
    return full


def calibrate_geometry(
    lens_pictures: Sequence[Path], shape: BoardShape, *, stage: Sequence[Path] = (), distortion: str = "tangential"
) -> Calibration:
    """Calibrate intrinsics from pictures of a board in many poses; axis or centre from others on a moving stage."""
    header = read_header(lens_pictures[0])

    def grey(path: Path) -> np.ndarray:
        picture = read_grey(path)
        if picture.shape != (header.rows, header.columns):
            raise UserError(f"{path}: expected the size of the other pictures, {header.columns} x {header.rows}")
        top = float(np.percentile(picture, 99.5)) or full_scale_of(path)
        return np.round(255 * np.clip(picture / top, 0, 1)).astype(np.uint8)

    detection = detect_boards(((str(path), grey(path)) for path in lens_pictures), shape)
    fit = calibrate(detection.pictures, rows=header.rows, columns=header.columns, distortion=distortion)
    matrix = fit.intrinsics
    intrinsics = {
        "fx": float(matrix[0, 0]),
        "fy": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
        "distortion": [float(v) for v in fit.distortion],
    }
    board = {
        "squares_x": shape.squares_x,
        "squares_y": shape.squares_y,
        "square_mm": shape.square,
        "marker_mm": shape.marker,
        "dictionary": shape.dictionary,
    }
    numbers: dict = {
        "intrinsics": intrinsics,
        "focal_sigma_px": finite(fit.focal_sigma * matrix[0, 0]),
        "principal_point_sigma_px": finite(fit.middle_sigma_px),
        "rms_px": finite(fit.rms_px),
        "picture_px": {name: finite(value) for name, value in fit.picture_px.items()},
        "outliers": list(fit.outliers),
        "not_seen": [*detection.unseen, *fit.sparse],
        "largest_tilt_deg": finite(fit.tilt_deg),
        "board": board,
    }
    warnings = [f"{name}: the board was not seen" for name in detection.unseen]
    warnings += [f"{name}: left out, it fits far worse than the others" for name in fit.outliers]
    rows = [("focal length px", float(matrix[0, 0]), numbers["focal_sigma_px"])]
    rows += [("principal point px", float(matrix[0, 2]), fit.middle_sigma_px), ("", float(matrix[1, 2]), None)]
    rows += [
        (f"distortion {name}", value, None)
        for name, value in zip("k1 k2 p1 p2 k3".split(), fit.distortion, strict=False)
    ]
    if stage:
        on_stage = detect_boards(((str(path), grey(path)) for path in stage), shape)
        if len(on_stage.pictures) < 3:
            raise UserError(f"stage: the board was seen in {len(on_stage.pictures)} pictures, expected 3 or more")
        resting = resting_point_with_sigma(*board_poses(on_stage.pictures, fit))
        name = "centre" if resting["axis"] is None else "axis"
        numbers["stage"] = {
            "kind": name,
            "point_mm": [finite(v) for v in resting["point"]],
            "point_sigma_mm": finite(resting["point_sigma"]),
            "axis": None if resting["axis"] is None else [finite(v, 8) for v in resting["axis"]],
            "axis_sigma_deg": finite(resting["axis_sigma_deg"]),
            "rms_mm": finite(resting["rms"]),
            "turn_deg": finite(resting["turn_deg"]),
            "not_seen": list(on_stage.unseen),
        }
        rows += [(f"{name}: x, y, z of its point, mm", float(v), resting["point_sigma"]) for v in resting["point"]]
        if resting["axis"] is not None:
            rows += [("direction of the axis", float(v), None) for v in resting["axis"]]
            rows += [("error of the direction, degrees", resting["axis_sigma_deg"], None)]
        rows += [("movement of the point, mm", resting["rms"], None)]
    picture = _residual_picture(detection.pictures, fit, header.rows, header.columns)
    caption = (
        f"Corners of all pictures (dots) and, {ARROW:g} times longer, how far the fit misses them. Lines must point in "
        f"all directions alike and dots must reach the corners. Root mean square {fit.rms_px:.2g} px."
    )
    pictures = [(Path(name).name, float(value)) for name, value in fit.picture_px.items()]
    sections = [
        PageSection(
            "geometry",
            "Lens and stage",
            [
                Table(("", "value", "±"), rows, "lrr"),
                Figures([Figure("Residuals", caption, picture)], 1),
                Table(("picture", "error px"), pictures, "lr"),
            ],
        )
    ]
    files = {"intrinsics.yaml": yaml.safe_dump(intrinsics, sort_keys=False)}
    lines = {"turntable": {"intrinsics": "intrinsics.yaml", "board": board}}
    subtitle = f"Lens from {len(fit.picture_px) - len(fit.outliers)} pictures of a board."
    return Calibration("geometry", numbers, [*lens_pictures, *stage], lines, sections, subtitle, files, warnings)


def _residual_picture(pictures: Sequence[BoardCorners], fit: LensFit, rows: int, columns: int):
    """Draw all corners in the frame of the photographs, with their residuals enlarged."""
    import cv2

    scale = min(1.0, 800 / max(rows, columns))
    canvas = np.full((int(rows * scale), int(columns * scale), 3), 255, np.uint8)
    kept = [each for each in pictures if each.name in fit.picture_px]
    for each, rotation, shift in zip(kept, *board_poses(kept, fit), strict=True):
        turn = cv2.Rodrigues(rotation)[0]
        expected = cv2.projectPoints(each.points, turn, shift, fit.intrinsics, np.array(fit.distortion))[0][:, 0]
        for pixel, away in zip(each.pixels, each.pixels - expected, strict=True):
            start = tuple(int(v) for v in np.round(pixel * scale))
            end = tuple(int(v) for v in np.round((pixel + ARROW * away) * scale))
            cv2.line(canvas, start, end, (181, 84, 43), 1, cv2.LINE_AA)
            cv2.circle(canvas, start, 1, (31, 78, 121), -1)
    return encode_picture(canvas, lossless=True)
