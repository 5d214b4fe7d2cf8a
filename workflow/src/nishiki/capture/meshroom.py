"""Cameras that Meshroom (AliceVision) found: `cameras.sfm` or another `.sfm` file, which is JSON.

A point X of the world is seen at R (X - C): `rotation` holds R column by column, `center` C; x right, y down, z into
the scene. The point x, y on the plane at depth 1 is moved by the lens' distortion and falls on the pixel
(fx x + w/2 + cx, fy y + h/2 + cy), which counts from the centre of the top left one: AliceVision reads the pixel (i, j)
of a picture at (i, j). fx is `focalLength` w / `sensorWidth`. Older versions of the file state pixels: see `_lens`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nishiki.capture.registered import RegisteredView, Registration, finite, positive, reading_cameras, rigid, whole
from nishiki.capture.turntable_schema import Intrinsics
from nishiki.formats.files import files_with, read_text
from nishiki.formats.problems import CaptureError, error, expect_one
from nishiki.formats.text_tables import expect_rows

REMEDY = "Take the file that the node StructureFromMotion wrote; ConvertSfMFormat saves it as .sfm (JSON)"
# Names of the distortions that are read, and where Brown's k1, k2, p1, p2, k3 stand among their parameters.
NONE, RADIAL1, RADIAL3, BROWN = (), (0, None, None, None, None), (0, 1, None, None, 2), (0, 1, 3, 4, 2)
DISTORTIONS = {
    **{name: NONE for name in ("pinhole", "none")},
    **{name: RADIAL1 for name in ("radial1", "radialk1")},
    **{name: RADIAL3 for name in ("radial3", "radialk3")},
    "brown": BROWN,
}


def meshroom_file(source: Path) -> Path | None:
    """`cameras.sfm` in a folder of photographs, else the only `.sfm` there; None without.

    CaptureError (layout-unknown) where there are several and none of this name.
    """
    files = files_with(source, (".sfm",))
    named = [path for path in files if path.name == "cameras.sfm"] or files
    remedy = "Keep the one that StructureFromMotion wrote, or call it cameras.sfm"
    return expect_one(named, source, "several .sfm files", remedy)


def read_meshroom(path: Path) -> Registration:
    """The photographs that have a pose.

    Raises CaptureError: cameras-unreadable, cameras-many; cameras-distorted where a lens cannot be said by Brown's five
    numbers.
    """
    with reading_cameras(path.name, "Meshroom", REMEDY):
        content = json.loads(read_text(path, "json_bytes"))
        version = tuple(whole(each) for each in content["version"])
        lenses = {str(each["intrinsicId"]): _lens(each, version, path.name) for each in content["intrinsics"]}
        poses = {str(each["poseId"]): _pose(each["pose"]["transform"]) for each in content.get("poses", [])}
        expect_rows(len(content["views"]), "views", path.name, "cameras")
        views = [
            _view(view, lenses, poses[str(view["poseId"])])
            for view in content["views"]
            if str(view.get("poseId")) in poses
        ]
        if not views:
            raise ValueError("no photograph has a pose")
    return Registration(tuple(views))


def _view(view: dict, lenses: dict, pose: np.ndarray) -> RegisteredView:
    name = view["path"]
    if "rigId" in view or view.get("isPoseIndependant") in (False, "false", "0"):
        raise ValueError(f"'{name}' belongs to a rig of cameras, whose poses are not read")
    rows, columns, lens = lenses[str(view["intrinsicId"])]
    return RegisteredView.of(name, (rows, columns), lens, pose)


def _pose(transform: dict) -> np.ndarray:
    """(3, 4): R and -R C."""
    rotation = np.array([finite(each) for each in transform["rotation"]]).reshape(3, 3).T
    centre = np.array([finite(each) for each in transform["center"]]).reshape(3)
    return np.column_stack([rigid(rotation), -rotation @ centre])


def _lens(intrinsic: dict, version: tuple[int, ...], file: str) -> tuple[int, int, Intrinsics]:
    """Rows, columns, and the lens in pixels, by the version of the file.

    Before 1.2 there is one focal length in pixels, in 1.2.0 and 1.2.1 two; from 1.2.2 on one in millimetres and
    `pixelRatio`, which is fx / fy before 1.2.5 and fy / fx from then on. The principal point counts from the corner
    before 1.2.1, from the middle from then on.
    """
    columns, rows = whole(intrinsic["width"]), whole(intrinsic["height"])
    if version < (1, 2):
        fx = fy = finite(intrinsic["pxFocalLength"])
    elif version < (1, 2, 2):
        fx, fy = map(finite, intrinsic["pxFocalLength"])
    else:
        fx = finite(intrinsic["focalLength"]) / positive(intrinsic["sensorWidth"], "sensorWidth") * columns
        ratio = positive(intrinsic.get("pixelRatio", 1), "pixelRatio")
        fy = fx / ratio if version < (1, 2, 5) else fx * ratio
    cx, cy = map(finite, intrinsic["principalPoint"])
    if version >= (1, 2, 1):
        cx, cy = cx + columns / 2, cy + rows / 2
    if min(rows, columns, fx, fy) <= 0:
        raise ValueError(f"a camera of {columns} x {rows} pixels with focal lengths {fx:g} and {fy:g}")
    return rows, columns, Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, distortion=_distortion(intrinsic, file))


def _distortion(intrinsic: dict, file: str) -> tuple[float, ...]:
    """Brown's k1, k2, p1, p2, k3. CaptureError (cameras-distorted) where the lens has another kind of distortion."""
    model = intrinsic["type"]
    kind = intrinsic.get("distortionType", model) if model == "pinhole" else model
    undone = intrinsic.get("undistortionType", "none") not in ("none", "")
    parameters = [finite(each) for each in intrinsic.get("distortionParams") or []]
    if kind not in DISTORTIONS or undone:
        what, expected = f"a lens of the model '{model}', distortion '{kind}'", "none, radial (1 or 3 terms) or Brown's"
        remedy = "Let Meshroom find the cameras again with one of these models (CameraInit: allowed models)"
        raise CaptureError(error("cameras-distorted", file, what, expected=expected, remedy=remedy))
    places = DISTORTIONS[kind]
    if not any(parameters):
        return (0.0,) * 5
    needed = 1 + max((place for place in places if place is not None), default=-1)
    if len(parameters) != needed:
        raise ValueError(f"distortion '{kind}' with {len(parameters)} parameters")
    return tuple(0.0 if place is None else parameters[place] for place in places)
