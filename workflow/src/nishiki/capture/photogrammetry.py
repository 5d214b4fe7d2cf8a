"""Cameras that photogrammetry programs export: Bundler, Meshroom (AliceVision), Agisoft Metashape, and NeRF programs.

Bundler: a point X is seen at p = R X + t; x, y = -p_x / p_z, -p_y / p_z (x right, y up, looking along -z). Distorted by
1 + k1 r^2 + k2 r^4 it falls on f x, f y: pixels from the middle of the picture, y upwards.

Meshroom: a point X of the world is seen at R (X - C): `rotation` holds R column by column, `center` C; x right, y down,
z into the scene. The point x, y on the plane at depth 1 is moved by the lens' distortion and falls on the pixel
(fx x + w/2 + cx, fy y + h/2 + cy), which counts from the centre of the top left one: AliceVision reads the pixel (i, j)
of a picture at (i, j). fx is `focalLength` w / `sensorWidth`. Older versions of the file state pixels,
see `_meshroom_lens`.

Metashape (File, Export, Export Cameras) and PhotoScan: `transform` of a camera takes its points to the chunk's own
world: x right, y down, z into the scene. The transform of the camera's component, else of the chunk, takes these to the
world that meshes are exported in: s R x + t. A point x, y on the plane at depth 1 falls, distorted, on
u = w/2 + cx + x (f + b1) + y b2, v = h/2 + cy + y f, pixels from the corner of the first one. p1 and p2 are exchanged
against OpenCV's. Files of PhotoScan before 1.2 state fx, fy, skew and a principal point from the corner, with p1 and p2
in OpenCV's order.

NeRF programs: `transforms.json` is as Blender's exporters, instant-ngp, nerfstudio and others write it:
`transform_matrix` takes points of the camera to the world; the camera's axes are OpenGL's (x right, y up, looking along
-z). `fl_x`, `fl_y`, `cx`, `cy` are in pixels from the corner of the first one, `camera_angle_x` is the angle of view
over the whole width in radians; k1, k2, p1, p2, k3 are Brown's, as OpenCV orders them. A frame may have its own.
"""

import json
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nishiki.capture.registered import (
    CORNER,
    GL,
    NEAR,
    UNDISTORT,
    PictureIndex,
    RegisteredView,
    Registration,
    aims_at,
    finite,
    positive,
    reading_cameras,
    rigid,
    whole,
)
from nishiki.capture.tables import LENS_COLUMNS, Intrinsics
from nishiki.formats.files import files_with, read_bytes, read_text
from nishiki.formats.problems import CaptureError, Problem, error, left_out, raise_errors, refuse, warning
from nishiki.formats.text_tables import expect_rows, reading

LINES = 5  # of a camera
POINTS = 1000  # that are compared with the sizes of the photographs
OUTSIDE = 1.0  # pixels by which a point may lie outside of its photograph


def read_bundler(path: Path, pictures: PictureIndex) -> Registration:
    """Read the photographs that have a camera; notes name the others.

    Raises CaptureError: cameras-unreadable, cameras-many, photograph-missing; photographs-count where the list is not
    as long as the cameras; camera-values where points lie outside of their photographs, which are then of another size.
    """
    names = _names(path, pictures.folder)
    with reading_cameras(path.name, "Bundler", "Export them again, as Bundler version 0.3"):
        content = read_bytes(path, "json_bytes")
        lines = content.split(b"\n", 2 + LINES * (len(names) + 1) + 3 * POINTS)
        count = int(lines[1].split()[0])
        expect_rows(count, "views", path.name, "cameras")
        if count != len(names):
            remedy = "Put the list of photographs that Bundler was given beside it (list.txt)"
            what = f"expected {count} names of photographs, one a camera, found {len(names)}"
            refuse("photographs-count", path.name, what, remedy=remedy)
        cameras = []
        for i in range(count):
            words = b" ".join(lines[2 + LINES * i : 2 + LINES * (i + 1)]).split()
            if len(words) != 15:
                start = b" ".join(words)[:60].decode("latin-1")
                raise ValueError(f"{len(words)} numbers where 15 are expected: {start}")
            cameras.append(np.array([finite(word.decode("latin-1")) for word in words]))
        seen = _furthest(lines[2 + LINES * count :], count)
        views, unplaced, problems = [], [], []
        for name, camera, (x, y) in zip(names, cameras, seen, strict=True):
            if not camera[0] > 0:
                unplaced.append(name)
                continue
            rows, columns = pictures.size(name, path.name)
            if 2 * x > columns + OUTSIDE or 2 * y > rows + OUTSIDE:
                what = f"expected the photograph that Bundler was given, of {2 * x:.0f} x {2 * y:.0f} pixels or more"
                problems.append(error("camera-values", name, what, found=f"{columns} x {rows}"))
            pose = GL @ np.column_stack([rigid(camera[3:12].reshape(3, 3)), camera[12:]])
            f, k1, k2 = camera[:3]
            lens = Intrinsics(fx=f, fy=f, cx=(columns - 1) / 2, cy=(rows - 1) / 2, distortion=(k1, k2, 0, 0, 0))
            views.append(RegisteredView.of(name, (rows, columns), lens, pose))
        if not views:
            raise ValueError("no photograph has a camera")
    raise_errors(problems)
    return Registration(tuple(views), tuple(left_out(unplaced, path.name, "photographs without a camera")))


def _names(path: Path, folder: Path) -> list[str]:
    """Read the photographs by camera, from the list beside the file or in the folder of the photographs.

    CaptureError (photographs-count) without a list: nothing else tells which camera took which.
    """
    places = [path.with_name(f"{path.name}.list.txt"), path.with_name("list.txt"), folder / "list.txt"]
    places += [p for p in files_with(path.parent, (".txt",)) if "list" in p.name.lower()]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        what = "no list.txt of the photographs, in the order of the cameras, lies beside it"
        refuse("photographs-count", path.name, what)
    with reading(found.name, "cameras"):
        text = read_bytes(found, "table_bytes").decode("utf-8-sig")
    # a name is followed by 0 and a focal length where that was known
    return [
        " ".join(words[:-2] if len(words) > 2 and words[-2] == "0" else words)
        for words in map(str.split, text.splitlines())
        if words
    ]


def _furthest(lines: list[bytes], count: int) -> np.ndarray:
    """Compute (cameras, 2): largest distance of points from each photograph's middle, across and up; first points."""
    seen = np.zeros((count, 2))
    for line in lines[2 : 3 * POINTS : 3]:
        words = line.split()
        views = np.array(words[1:], np.float64).reshape(-1, 4)
        if int(words[0]) != len(views) or not (0 <= views[:, 0]).all() or not (views[:, 0] < count).all():
            raise ValueError(f"a point's list of photographs: {line[:60].decode('latin-1')}")
        np.maximum.at(seen, views[:, 0].astype(int), np.abs(views[:, 2:]))
    return seen


MESHROOM_REMEDY = "Take the file that the node StructureFromMotion wrote; ConvertSfMFormat saves it as .sfm (JSON)"
# Names of the distortions that are read, and where Brown's k1, k2, p1, p2, k3 stand among their parameters.
NONE, RADIAL1, RADIAL3, BROWN_PLACES = (), (0, None, None, None, None), (0, 1, None, None, 2), (0, 1, 3, 4, 2)
DISTORTIONS = {
    **{name: NONE for name in ("pinhole", "none")},
    **{name: RADIAL1 for name in ("radial1", "radialk1")},
    **{name: RADIAL3 for name in ("radial3", "radialk3")},
    "brown": BROWN_PLACES,
}


def read_meshroom(path: Path, pictures: PictureIndex | None = None) -> Registration:
    """Read the photographs that have a pose.

    Raises CaptureError: cameras-unreadable, cameras-many; cameras-distorted where a lens cannot be said by Brown's five
    numbers.
    """
    with reading_cameras(path.name, "Meshroom", MESHROOM_REMEDY):
        content = json.loads(read_text(path, "json_bytes"))
        version = tuple(whole(each) for each in content["version"])
        lenses = {str(each["intrinsicId"]): _meshroom_lens(each, version, path.name) for each in content["intrinsics"]}
        poses = {}  # (3, 4) each: R and -R C
        for each in content.get("poses", []):
            transform = each["pose"]["transform"]
            rotation = np.array([finite(value) for value in transform["rotation"]]).reshape(3, 3).T
            centre = np.array([finite(value) for value in transform["center"]]).reshape(3)
            poses[str(each["poseId"])] = np.column_stack([rigid(rotation), -rotation @ centre])
        expect_rows(len(content["views"]), "views", path.name, "cameras")
        views = []
        for view in content["views"]:
            if str(view.get("poseId")) not in poses:
                continue
            name = view["path"]
            if "rigId" in view or view.get("isPoseIndependant") in (False, "false", "0"):
                raise ValueError(f"'{name}' belongs to a rig of cameras, whose poses are not read")
            rows, columns, lens = lenses[str(view["intrinsicId"])]
            views.append(RegisteredView.of(name, (rows, columns), lens, poses[str(view["poseId"])]))
        if not views:
            raise ValueError("no photograph has a pose")
    return Registration(tuple(views))


def _meshroom_lens(intrinsic: dict, version: tuple[int, ...], file: str) -> tuple[int, int, Intrinsics]:
    """Compute rows, columns, and the lens in pixels, by the version of the file.

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
    """Return Brown's k1, k2, p1, p2, k3. CaptureError (cameras-distorted) for other kinds of distortion."""
    model = intrinsic["type"]
    kind = intrinsic.get("distortionType", model) if model == "pinhole" else model
    undone = intrinsic.get("undistortionType", "none") not in ("none", "")
    parameters = [finite(each) for each in intrinsic.get("distortionParams") or []]
    if kind not in DISTORTIONS or undone:
        what, expected = f"a lens of the model '{model}', distortion '{kind}'", "none, radial (1 or 3 terms) or Brown's"
        remedy = "Let Meshroom find the cameras again with one of these models (CameraInit: allowed models)"
        refuse("cameras-distorted", file, what, expected=expected, remedy=remedy)
    places = DISTORTIONS[kind]
    if not any(parameters):
        return (0.0,) * 5
    needed = 1 + max((place for place in places if place is not None), default=-1)
    if len(parameters) != needed:
        raise ValueError(f"distortion '{kind}' with {len(parameters)} parameters")
    return tuple(0.0 if place is None else parameters[place] for place in places)


HEAD = 1 << 16  # bytes in which a file of cameras tells what it is
OTHERS = ("k4", "p3", "p4")  # of the distortion, beyond Brown's five numbers
TERMS = ("f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", "k1", "k2", "k3", "p1", "p2", *OTHERS)
FAR = 1e4  # distance from the world's origin, in extents of the cameras: geocentric coordinates
METASHAPE_REMEDY = "Export the cameras again (File, Export, Export Cameras, Agisoft XML)"


def read_metashape(path: Path, pictures: PictureIndex | None = None) -> Registration:
    """Read the photographs that are enabled and aligned; notes name the others.

    Raises CaptureError: cameras-unreadable, cameras-many; cameras-distorted where a lens cannot be said by Brown's five
    numbers.
    """
    with reading_cameras(path.name, "Metashape", METASHAPE_REMEDY):
        content = read_bytes(path, "json_bytes")
        if b"<!DOCTYPE" in content[:HEAD] or b"<!ENTITY" in content[:HEAD]:
            raise ValueError("a declaration of a document type")
        chunks = list(ElementTree.fromstring(content).iter("chunk"))
        chunks = [chunk for chunk in chunks if chunk.find("cameras") is not None]
        if len(chunks) != 1:
            raise ValueError(f"{len(chunks)} chunks with cameras, where one is expected")
        return _chunk(chunks[0], path.name)


def _chunk(chunk: ElementTree.Element, file: str) -> Registration:
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    worlds = {part.get("id"): _transform(part.find("transform")) for part in chunk.iter("component")}
    own = _transform(chunk.find("transform"))
    enabled, off, unaligned, placed = [], [], [], []
    for camera in chunk.iterfind("cameras//camera"):
        if camera.get("enabled", "true").lower() in ("false", "0"):
            off.append(camera.get("label"))
        elif (transform := camera.findtext("transform")) is None:
            unaligned.append(camera.get("label"))
        else:
            enabled.append(camera)
            numbers = np.array([finite(word) for word in transform.split()])
            placed.append(numbers.reshape(4, 4)[:3])
    if not enabled:
        raise ValueError(f"no camera is aligned, of {len(off) + len(unaligned)}")
    expect_rows(len(enabled), "views", file, "cameras")
    notes = left_out(off, file, "photographs that are switched off in Metashape")
    notes += left_out(unaligned, file, "photographs that have no place in Metashape")
    components = [camera.get("component_id") for camera in enabled]
    placed, more = _in_world(placed, components, worlds, own, file)
    lenses = {
        number: _sensor_lens(sensors[number], file) for number in dict.fromkeys(c.get("sensor_id") for c in enabled)
    }
    views = []
    for camera, matrix in zip(enabled, placed, strict=True):
        rotation = rigid(matrix[:, :3]).T
        size, lens = lenses[camera.get("sensor_id")]
        pose = np.column_stack([rotation, -rotation @ matrix[:, 3]])
        views.append(RegisteredView.of(str(camera.get("label")), size, lens, pose))
    return Registration(tuple(views), (*notes, *more))


def _in_world(
    placed: list[np.ndarray], components: list, worlds: dict, own: tuple | None, file: str
) -> tuple[list[np.ndarray], list[Problem]]:
    """Transform cameras (3, 4) to the world of the component, else of the chunk, else leave them in their own."""
    transforms = [worlds.get(component) or own for component in components]
    if None in transforms and len(set(components)) > 1:
        raise ValueError("cameras of several components, not all with a transform: their places are not of one world")
    moved = [
        camera if t is None else np.column_stack([t[1] @ camera[:, :3], t[0] * t[1] @ camera[:, 3] + t[2]])
        for camera, t in zip(placed, transforms, strict=True)
    ]
    centres = np.array([camera[:, 3] for camera in moved])
    middle = centres.mean(axis=0)
    if np.linalg.norm(middle) <= FAR * max(np.ptp(centres, axis=0).max(), 1e-300) or len(centres) < 2:
        return moved, []
    what = "geocentric coordinates, in which a small object has no digits left: the cameras were brought to the origin"
    found = " ".join(f"{value:.3f}" for value in middle)
    note = warning("cameras-far", file, what, found=f"moved by {found}", remedy="Move a mesh of Metashape likewise")
    return [np.column_stack([camera[:, :3], camera[:, 3] - middle]) for camera in moved], [note]


def _transform(element: ElementTree.Element | None) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Parse scale, rotation (3, 3) and translation (3,); None where the file has none."""
    if element is None or element.find("rotation") is None:
        return None
    rotation, translation = (
        np.array([finite(word) for word in element.findtext(name, "").split()]) for name in ("rotation", "translation")
    )
    scale = positive(element.findtext("scale") or 1, "scale")
    return scale, rigid(rotation.reshape(3, 3)), translation.reshape(3)


def _sensor_lens(sensor: ElementTree.Element, file: str) -> tuple[tuple[int, int], Intrinsics]:
    """Read rows, columns and the lens in pixels from the centre of the first one, adjusted values first."""
    label, kind = sensor.get("label"), sensor.get("type", "frame")
    lenses = sensor.findall("calibration")
    lens = next((each for each in lenses if each.get("class") == "adjusted"), lenses[-1] if lenses else None)
    if lens is None:
        raise ValueError(f"the sensor '{label}' has no calibration")
    values = {name: finite(lens.findtext(name)) for name in TERMS if lens.find(name) is not None}
    if kind != "frame" or lens.get("type", "frame") != "frame" or any(values.get(name, 0.0) for name in OTHERS):
        what = f"the sensor '{label}' is of type {kind}, with the terms {', '.join(sorted(values))}"
        remedy = "Optimise the cameras without k4, p3 and p4, or export undistorted photographs with their cameras"
        refuse("cameras-distorted", file, what, expected="frame, with k1, k2, k3, p1 and p2", remedy=remedy)
    resolution = lens.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    sides = {} if resolution is None else resolution.attrib
    rows, columns = whole(sides.get("height")), whole(sides.get("width"))
    k1, k2, k3, p1, p2 = (values.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    if "f" in values:
        fx, fy, skew = values["f"] + values.get("b1", 0.0), values["f"], values.get("b2", 0.0)
        cx, cy = columns / 2 + values.get("cx", 0.0), rows / 2 + values.get("cy", 0.0)
        p1, p2 = p2, p1
    else:
        fx, fy, skew = values.get("fx", 0.0), values.get("fy", 0.0), values.get("skew", 0.0)
        cx, cy = values.get("cx", columns / 2), values.get("cy", rows / 2)
    if min(rows, columns, fx, fy) <= 0:
        raise ValueError(f"the sensor '{label}' of {columns} x {rows} pixels with focal lengths {fx:g} and {fy:g}")
    found = Intrinsics(fx=fx, fy=fy, cx=cx - CORNER, cy=cy - CORNER, skew=skew, distortion=(k1, k2, p1, p2, k3))
    return (rows, columns), found


TRANSFORMS = "transforms.json"
TRANSFORMS_PARTS = "transforms_"  # of a set in parts: transforms_train.json, transforms_val.json, transforms_test.json
NERF_LENSES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
OTHER_NAMES = ("k4", "k5", "k6", "k7", "k8", "p3", "p4", "s1", "s2", "s3", "s4")  # of richer models, and of fish-eyes
SAME_ANGLE = 0.01  # relative difference of a focal length and an angle of view that state the same
MIDDLE = (0.2, 0.8)  # where principal points lie, of the picture's sides


def transforms_file(source: Path) -> Path | None:
    """Find `transforms.json` of a folder, else the first part of a set in parts; None without."""
    names = {path.name: path for path in files_with(source, (".json",))}
    return names.get(
        TRANSFORMS, next((path for name, path in names.items() if name.startswith(TRANSFORMS_PARTS)), None)
    )


def read_transforms(path: Path, pictures: PictureIndex) -> Registration:
    """Read the photographs of all frames, of all parts of a set in parts.

    Raises CaptureError: cameras-unreadable, cameras-many, photograph-missing; cameras-distorted where a lens cannot be
    said by Brown's five numbers; camera-values where the focal length or the principal point is not of the photograph.
    """
    frames: dict[str, dict] = {}
    files = (
        [path]
        if path.name == TRANSFORMS
        else [p for p in files_with(path.parent, (".json",)) if p.name.startswith(TRANSFORMS_PARTS)]
    )
    with reading_cameras(path.name, "NeRF", "Write the file again with the program that made it"):
        for file in files:
            with reading(file.name, "cameras"):
                content = json.loads(read_text(file, "json_bytes"))
            shared = {key: value for key, value in content.items() if key != "frames"}
            expect_rows(len(frames) + len(content["frames"]), "views", path.name, "cameras")
            for frame in content["frames"]:
                before = frames.setdefault(str(frame["file_path"]), {**shared, **frame})
                if before["transform_matrix"] != frame["transform_matrix"]:
                    raise ValueError(f"two cameras of {frame['file_path']}")
        matrices = []
        for frame in frames.values():
            matrix = np.array([[finite(value) for value in row] for row in frame["transform_matrix"]])
            if matrix.shape not in ((4, 4), (3, 4)):
                raise ValueError(f"a transform_matrix of {' x '.join(map(str, matrix.shape))} numbers")
            matrices.append(np.column_stack([rigid(matrix[:3, :3]), matrix[:3, 3]]))
        if not frames:
            raise ValueError("no frames")
    pictures.paths(list(frames), path.name)
    lenses = [_nerf_lens(frame, pictures.size(name, path.name), name) for name, frame in frames.items()]
    poses, notes = _poses(np.array(matrices), path.name)
    views = zip(frames, lenses, poses, strict=True)
    return Registration(tuple(RegisteredView.of(name, *lens, pose) for name, lens, pose in views), notes)


def _poses(matrices: np.ndarray, file: str) -> tuple[np.ndarray, tuple[Problem, ...]]:
    """Return poses (n, 3, 4) from world to camera, and a note where the file deviates from its usual convention.

    Scripts write matrices of OpenCV's axes, or from world to camera, into the same key. The cameras then look away from
    the object, or their lines of sight miss each other; a reading that makes all of them meet is taken where it is the
    only one.
    """
    rotation, place = matrices[:, :, :3], matrices[:, :, 3:]
    inverse = np.concatenate([rotation.transpose(0, 2, 1), -rotation.transpose(0, 2, 1) @ place], axis=2)
    readings = {
        "camera to world, axes of OpenGL": GL @ inverse,
        "camera to world, axes of OpenCV": inverse,
        "world to camera, axes of OpenGL": GL @ matrices,
        "world to camera, axes of OpenCV": matrices,
    }
    usual, *others = readings
    aims = {name: aims_at(poses) for name, poses in readings.items()}
    fitting = [name for name in others if aims[name] is not None and aims[name] < NEAR]
    if len(fitting) != 1 or (aims[usual] is not None and aims[usual] < NEAR):
        return readings[usual], ()
    what = "the cameras would look away from the object: transform_matrix is read otherwise than such files have it"
    note = warning("cameras-convention", file, what, expected=usual, found=fitting[0], remedy="Check the mesh's shape")
    return readings[fitting[0]], (note,)


def _nerf_lens(frame: dict, size: tuple[int, int], name: str) -> tuple[tuple[int, int], Intrinsics]:
    """Parse rows, columns and the lens in pixels from the centre of the first one."""
    try:
        model, fisheye = str(frame.get("camera_model", "OPENCV")).upper(), frame.get("is_fisheye", False)
        if model not in NERF_LENSES or fisheye or any(finite(frame.get(key, 0)) for key in OTHER_NAMES):
            what, expected = f"a lens of the model {'fish-eye' if fisheye else model}", "none, or Brown's distortion"
            refuse("cameras-distorted", name, what, expected=expected, remedy=UNDISTORT)
        rows, columns = whole(frame.get("h", size[0])), whole(frame.get("w", size[1]))
        fx = _focal_length(frame, "x", columns)
        fy = _focal_length(frame, "y", rows) or fx
        fx = fx or fy
        if fx is None:
            raise ValueError("neither fl_x nor camera_angle_x")
        cx, cy = (finite(frame.get(key, side / 2)) for key, side in (("cx", columns), ("cy", rows)))
        if not all(MIDDLE[0] <= at / side <= MIDDLE[1] for at, side in ((cx, columns), (cy, rows))):
            raise ValueError(f"principal point {cx:g}, {cy:g} in a picture of {columns} x {rows} pixels")
        distortion = tuple(finite(frame.get(key, 0)) for key in LENS_COLUMNS)
    except (ValueError, TypeError) as e:
        remedy = "Give the photographs that the file was made for, or mend its numbers"
        raise CaptureError(error("camera-values", name, "camera", found=str(e)[:120], remedy=remedy)) from e
    return (rows, columns), Intrinsics(fx=fx, fy=fy, cx=cx - CORNER, cy=cy - CORNER, distortion=distortion)


def _focal_length(frame: dict, axis: str, side: int) -> float | None:
    """Compute the focal length in pixels, by its key or the angle of view; None without. ValueError if they differ."""
    length, angle = frame.get(f"fl_{axis}"), frame.get(f"camera_angle_{axis}")
    stated = None if length is None else positive(length, f"fl_{axis}")
    if angle is None:
        return stated
    implied = side / 2 / math.tan(min(positive(angle, f"camera_angle_{axis}"), math.pi - 1e-6) / 2)
    if stated and abs(implied / stated - 1) > SAME_ANGLE:
        raise ValueError(f"fl_{axis} {stated:g}, but camera_angle_{axis} makes {implied:g} over {side} pixels")
    return stated or implied
