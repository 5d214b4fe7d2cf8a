"""Cameras that Agisoft Metashape exported: its XML (File, Export, Export Cameras), and that of PhotoScan.

`transform` of a camera takes its points to the chunk's own world: x right, y down, z into the scene. The transform of
the camera's component, else of the chunk, takes these to the world that meshes are exported in: s R x + t. A point x, y
on the plane at depth 1 falls, distorted, on u = w/2 + cx + x (f + b1) + y b2, v = h/2 + cy + y f, pixels from the
corner of the first one. p1 and p2 are exchanged against OpenCV's. Files of PhotoScan before 1.2 state fx, fy, skew and
a principal point from the corner, with p1 and p2 in OpenCV's order.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nishiki.capture.registered import (
    CORNER,
    RegisteredView,
    Registration,
    finite,
    positive,
    reading_cameras,
    rigid,
    whole,
)
from nishiki.capture.turntable_schema import Intrinsics
from nishiki.formats.files import files_with, read_bytes
from nishiki.formats.problems import CaptureError, Problem, error, expect_one, left_out, warning
from nishiki.formats.text_tables import expect_rows

HEAD = 1 << 16  # bytes in which a file of cameras tells what it is
OTHERS = ("k4", "p3", "p4")  # of the distortion, beyond Brown's five numbers
TERMS = ("f", "fx", "fy", "cx", "cy", "b1", "b2", "skew", "k1", "k2", "k3", "p1", "p2", *OTHERS)
FAR = 1e4  # distance from the world's origin, in extents of the cameras: geocentric coordinates
REMEDY = "Export the cameras again (File, Export, Export Cameras, Agisoft XML)"


def metashape_file(source: Path) -> Path | None:
    """The only XML file with a chunk's sensors and cameras in a folder; None without.

    CaptureError (layout-unknown) where there are several.
    """
    found = []
    for path in files_with(source, (".xml",)):
        with path.open("rb") as stream:
            head = stream.read(HEAD)
        if b"<chunk" in head and b"<sensors" in head:
            found.append(path)
    what, remedy = "several files of Metashape's cameras", "Keep the one that belongs to these photographs"
    return expect_one(found, source, what, remedy)


def read_metashape(path: Path) -> Registration:
    """The photographs that are enabled and aligned; notes name the others.

    Raises CaptureError: cameras-unreadable, cameras-many; cameras-distorted where a lens cannot be said by Brown's five
    numbers.
    """
    with reading_cameras(path.name, "Metashape", REMEDY):
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
    for camera in chunk.find("cameras").iter("camera"):
        if camera.get("enabled", "true").lower() in ("false", "0"):
            off.append(camera.get("label"))
        elif camera.find("transform") is None:
            unaligned.append(camera.get("label"))
        else:
            enabled.append(camera)
            numbers = np.array([finite(word) for word in camera.find("transform").text.split()])
            placed.append(numbers.reshape(4, 4)[:3])
    if not enabled:
        raise ValueError(f"no camera is aligned, of {len(off) + len(unaligned)}")
    expect_rows(len(enabled), "views", file, "cameras")
    notes = left_out(off, file, "photographs that are switched off in Metashape")
    notes += left_out(unaligned, file, "photographs that have no place in Metashape")
    components = [camera.get("component_id") for camera in enabled]
    placed, more = _in_world(placed, components, worlds, own, file)
    lenses = {number: _lens(sensors[number], file) for number in dict.fromkeys(c.get("sensor_id") for c in enabled)}
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
    """Cameras (3, 4) in the world of the component's transform, else of the chunk's, else in their own."""
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
    """Scale, rotation (3, 3) and translation (3,); None where the file has none."""
    if element is None or element.find("rotation") is None:
        return None
    rotation, translation = (
        np.array([finite(word) for word in element.findtext(name).split()]) for name in ("rotation", "translation")
    )
    scale = positive(element.findtext("scale") or 1, "scale")
    return scale, rigid(rotation.reshape(3, 3)), translation.reshape(3)


def _lens(sensor: ElementTree.Element, file: str) -> tuple[tuple[int, int], Intrinsics]:
    """Rows and columns, and the lens in pixels from the centre of the first one, as adjusted if it was."""
    label, kind = sensor.get("label"), sensor.get("type", "frame")
    lenses = sensor.findall("calibration")
    lens = next((each for each in lenses if each.get("class") == "adjusted"), lenses[-1] if lenses else None)
    if lens is None:
        raise ValueError(f"the sensor '{label}' has no calibration")
    values = {name: finite(lens.findtext(name)) for name in TERMS if lens.find(name) is not None}
    if kind != "frame" or lens.get("type", "frame") != "frame" or any(values.get(name, 0.0) for name in OTHERS):
        what = f"the sensor '{label}' is of type {kind}, with the terms {', '.join(sorted(values))}"
        remedy = "Optimise the cameras without k4, p3 and p4, or export undistorted photographs with their cameras"
        expected = "frame, with k1, k2, k3, p1 and p2"
        raise CaptureError(error("cameras-distorted", file, what, expected=expected, remedy=remedy))
    resolution = lens.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    rows, columns = whole(resolution.get("height")), whole(resolution.get("width"))
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
