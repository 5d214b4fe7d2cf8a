"""Lens, axis of a turntable and centre of a goniometer from photographs of a ChArUco board; boards to print.

The camera stands still and sees the board in poses R_i, t_i. The point c of the board that stays where it is while the
stage turns fulfils

    R_i c + t_i = p    for all i,

with p its place in the camera's frame. For one axis all points of the axis fulfil it: the direction that the equations
leave open is the axis. For two axes or more that meet, c is the one point where they do.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml

from nishiki.calibrate.result import Calibration, finite
from nishiki.capture.taking import full_scale_of, read_grey
from nishiki.errors import UserError
from nishiki.formats.images import read_header
from nishiki.geometry.board import BoardCorners, BoardShape, board_of, calibrate, detect_boards
from nishiki.geometry.board import Calibration as LensFit
from nishiki.report.page import Figure, Figures, Section, Table
from nishiki.report.pictures import encoded

ONE_AXIS = 0.05  # smallest singular value relative to the next, below which the stage has turned about one axis
LEAST_TURN_DEG = 5.0
ARROW = 20.0  # residuals are drawn so many times longer
PRINT_PX_PER_MM = 12.0


def print_board(shape: BoardShape) -> tuple[str, bytes]:
    """Draw the board as SVG in millimetres and as PNG; print without scaling and measure a square afterwards."""
    import cv2

    width, height = shape.squares_x * shape.square, shape.squares_y * shape.square
    cell = round(shape.square * PRINT_PX_PER_MM)
    picture = board_of(shape).generateImage((shape.squares_x * cell, shape.squares_y * cell), marginSize=0)
    done, data = cv2.imencode(".png", picture)
    if not done:
        raise RuntimeError("the board could not be encoded as PNG")
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
    return svg, data.tobytes()


def board_poses(pictures: Sequence[BoardCorners], lens: LensFit) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (n, 3, 3) and translations (n, 3) of the board in the camera's frame (x right, y down, z forward)."""
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
    """Point of a stage that does not move, and its axis where it has one.

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
    """`resting_point` with point_sigma and axis_sigma_deg, by the jackknife over the poses."""
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
    """Intrinsics from pictures of a board held in many ways; axis or centre from pictures of it on a moving stage."""
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
        Section(
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
    """All corners in the frame of the photographs, with their residuals enlarged."""
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
    return encoded(canvas, lossless=True)
