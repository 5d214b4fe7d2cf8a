"""Cameras: intrinsics, distortion and pose of every view, with reprojection errors."""

from dataclasses import replace

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.capture.tables import read_points
from nishiki.errors import UserError
from nishiki.geometry.board import BoardShape, Detection, LensCalibration, calibrate, detect_boards
from nishiki.geometry.camera import NO_DISTORTION, Camera, cameras_of_matrices, save_cameras
from nishiki.geometry.pose import Pose, Sight, choose_poses, estimate_pose
from nishiki.geometry.silhouettes import display, segment
from nishiki.geometry.turn import turn_of
from nishiki.geometry.turn_estimate import estimate_turn, reduce_grey
from nishiki.observations.views import Views
from nishiki.stages.cameras import CamerasSettings


def run(context: Context) -> dict:
    """Compute the poses from matrices, boards or correspondences, and their errors."""
    folder = context.inputs["ingest"].folder
    views = Views(folder)
    name = views.geometry.get("correspondences")
    points = read_points(folder / name, name, views.views) if name else None
    source = source_of(context.settings.source, views, points)
    if source == "matrices":
        (cameras, errors, mirror), diagnostics = use_given_cameras(views, points), {}
    else:
        locate = estimate_cameras if source == "photographs" else locate_cameras
        (cameras, errors, diagnostics), mirror = locate(context, views, source, points), None
    save_cameras(
        context.output.path("cameras.json"),
        cameras,
        unit=views.unit,
        full_turn=views.full_turn,
        source=source,
        reprojection_px=errors,
        mirror=mirror,
    )
    known = [error for error in errors if error is not None]
    turn = turn_of(np.array([camera.centre for camera in cameras]))
    return {
        "source": source,
        "views": len(cameras),
        "unit": views.unit,
        "full_turn": views.full_turn,
        "reprojection_px": {camera.name: error for camera, error in zip(cameras, errors, strict=True)},
        "reprojection_mean_px": float(np.mean(known)) if known else None,
        "reprojection_worst_px": max(known) if known else None,
        "mirror": mirror,
        "circle": turn.as_dict() if turn else None,
        **diagnostics,
    }


def source_of(source: str, views: Views, points: dict[str, np.ndarray] | None) -> str:
    """Return the source of the poses. UserError where the capture lacks the requested one, or any."""
    boards = {picture["view"] for picture in views.attributes["calibration"] if picture["view"]}
    there = {
        "matrices": views.matrices is not None,
        "boards": boards >= set(views.views),
        "correspondences": points is not None,
        "photographs": views.attributes.get("estimates_cameras", False),
    }
    if source == "auto":
        source = next((name for name, available in there.items() if available), "")
    if there.get(source):
        return source
    missing = sorted(set(views.views) - boards)
    detail = f" (no board picture of view {', '.join(missing[:5])})" if boards and missing else ""
    raise UserError(
        f"cameras: the capture has no {source or 'camera matrices, boards or correspondences'}{detail}. Remedy: give "
        "turntable.cameras (3x4 matrices), a board picture for every view, or turntable.correspondences; or state "
        "full_turn: true and turntable.height (or unit: arbitrary), by which views once round are estimated"
    )


def use_given_cameras(
    views: Views, points: dict[str, np.ndarray] | None
) -> tuple[list[Camera], list[float | None], tuple | None]:
    """Return the given matrices with the distortion of a given lens, and their error on correspondences, if any."""
    rows, columns = views.shape
    matrices = views.matrices or {}
    missing = [name for name in views.views if name not in matrices]
    if missing:
        raise UserError(
            f"cameras: no matrix for view {', '.join(missing[:8])}. Remedy: one row of cameras.csv for every view"
        )
    decomposed = cameras_of_matrices({name: matrices[name] for name in views.views}, rows=rows, columns=columns)
    shared = views.intrinsics["distortion"] if views.intrinsics else NO_DISTORTION
    distortions = views.attributes.get("distortions") or {}
    cameras = [replace(c, distortion=tuple(distortions.get(c.name, shared))) for c in decomposed.cameras]
    errors: list[float | None] = [None] * len(cameras)
    if points:
        mirror = np.array(decomposed.mirror or (1, 1, 1))
        for place, camera in enumerate(cameras):
            table = points[camera.name]
            pixels, depth = camera.project(table[:, 2:] * mirror)
            if (depth <= 0).any():
                raise UserError(
                    f"cameras: {int((depth <= 0).sum())} correspondences of view {camera.name!r} lie behind its "
                    "camera. "
                    "Remedy: matrices and points must be of one world; check unit and order of the axes"
                )
            errors[place] = float(np.sqrt(((pixels - table[:, :2]) ** 2).sum(axis=1).mean()))
    return cameras, errors, decomposed.mirror


def locate_cameras(
    context: Context, views: Views, source: str, points: dict | None
) -> tuple[list[Camera], list[float], dict]:
    """Estimate poses from boards or correspondences."""
    settings = context.settings
    rows, columns = views.shape
    limit = settings.outlier_px or 0.005 * max(rows, columns)
    boards = find_boards(views)
    diagnostics: dict = {"outlier_px": limit}
    if boards:
        diagnostics["boards"] = {"seen": len(boards.pictures), "unseen": list(boards.unseen), "legacy": boards.legacy}
    matrix, distortion, calibration = lens_of(views, boards, settings)
    diagnostics["calibration"] = calibration.as_dict() if calibration else None
    sights = (
        board_sights(views, boards)
        if boards and source == "boards"
        else {name: Sight(name, table[:, 2:], table[:, :2]) for name, table in (points or {}).items()}
    )
    poses = [
        estimate_pose(sights[name], matrix, distortion, rows=rows, columns=columns, outlier_px=limit)
        for name in context.progress.over(views.views, "view")
    ]
    diagnostics["points"] = {pose.camera.name: int(pose.inliers.sum()) for pose in poses}
    diagnostics["outliers"] = {pose.camera.name: int((~pose.inliers).sum()) for pose in poses}
    used = [
        Sight(name, sights[name].points[pose.inliers], sights[name].pixels[pose.inliers])
        for name, pose in zip(views.views, poses, strict=True)
    ]
    cameras, diagnostics["turntable"] = on_one_axis(settings, views, used, poses)
    errors = [rms(camera, sight) for camera, sight in zip(cameras, used, strict=True)]
    return cameras, errors, diagnostics


def estimate_cameras(
    context: Context, views: Views, source: str, points: dict | None
) -> tuple[list[Camera], list[None], dict]:
    """Estimate poses from the photographs alone, with their standard deviations."""
    greys, masks = [], []
    for place in context.progress.over(range(len(views.views)), "view"):
        picture, given = display(views.mean_light(place)), views.silhouette(place)
        greys.append(reduce_grey(picture))
        background = views.attributes.get("background") or "auto"
        masks.append(segment(picture, background=background).mask if given is None else given)
    lens = views.intrinsics
    found = estimate_turn(
        greys,
        masks,
        views.views,
        intrinsics=np.array(lens["matrix"], float) if lens else None,
        distortion=tuple(lens["distortion"]) if lens else NO_DISTORTION,
        steps=context.settings.steps,
        height=views.attributes.get("height"),
    )
    diagnostics = {key: value for key, value in found.as_dict().items() if key != "cameras"}
    return found.cameras, [None] * len(masks), {"estimate": diagnostics}


def rms(camera: Camera, sight: Sight) -> float:
    """Compute the root mean square distance in pixels."""
    projected, _ = camera.project(sight.points)
    return float(np.sqrt(((projected - sight.pixels) ** 2).sum(axis=1).mean()))


def find_boards(views: Views) -> Detection | None:
    """Find board corners in calibration pictures; None without pictures. UserError without the board's measures."""
    if not views.attributes["calibration"]:
        return None
    board = views.board_description
    if not board:
        raise UserError("cameras: there are board pictures but no turntable.board. Remedy: give the board's measures")
    unit = views.unit_mm or 1.0
    shape = BoardShape(
        board["squares_x"],
        board["squares_y"],
        board["square_mm"] / unit,
        board["marker_mm"] / unit,
        board.get("dictionary", "DICT_4X4_50"),
    )
    return detect_boards(((picture["name"], image) for picture, image in views.board_pictures()), shape)


def lens_of(
    views: Views, boards: Detection | None, settings: CamerasSettings
) -> tuple[np.ndarray, tuple[float, ...], LensCalibration | None]:
    """Return given intrinsics, or those from the boards. UserError where there is neither."""
    if views.intrinsics:
        return np.array(views.intrinsics["matrix"], float), tuple(views.intrinsics["distortion"]), None
    if boards is None:
        raise UserError(
            "cameras: the lens is unknown. Remedy: photograph the board at least three times (role board), or give "
            "turntable.intrinsics"
        )
    rows, columns = views.shape
    calibration = calibrate(boards.pictures, rows=rows, columns=columns, distortion=settings.distortion)
    return calibration.intrinsics, calibration.distortion, calibration


def board_sights(views: Views, boards: Detection) -> dict[str, Sight]:
    """Return corners by view. UserError where a view shows no board."""
    view_of = {picture["name"]: picture["view"] for picture in views.attributes["calibration"]}
    sights = {view_of[each.name]: Sight(view_of[each.name], each.points, each.pixels) for each in boards.pictures}
    missing = [name for name in views.views if name not in sights]
    if missing:
        raise UserError(
            f"cameras: no board found in the picture of view {', '.join(missing[:8])}. Remedy: another picture of "
            "these views, with the board sharp and not glossy; or correspondences"
        )
    return sights


def on_one_axis(
    settings: CamerasSettings, views: Views, sights: list[Sight], poses: list[Pose]
) -> tuple[list[Camera], dict | None]:
    """Move all views to one axis where requested, or where held-out points are then predicted better."""
    free = [pose.camera for pose in poses]
    if settings.turntable == "off" or len(free) < 3:
        return free, None
    choice = choose_poses(sights, free, steps=settings.steps, full_turn=views.full_turn)
    on_axis = choice.on_axis or settings.turntable == "on"
    diagnostics = {
        "used": on_axis,
        "left_out_own_px": choice.free_px,
        "left_out_axis_px": choice.turn_px,
        "axis": choice.turn.axis.tolist(),
        "point": choice.turn.point.tolist(),
        "angles_deg": choice.turn.angles_deg.tolist(),
        "axis_px": choice.turn.rms_px,
        "own_px": float(np.sqrt(np.mean([rms(c, s) ** 2 for c, s in zip(free, sights, strict=True)]))),
    }
    return (list(choice.turn.cameras) if on_axis else free), diagnostics
