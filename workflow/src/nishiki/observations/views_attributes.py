"""What is stored beside the views in words and numbers: lamps, cameras, boards, and where the geometry's files lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nishiki.capture.turntable import TurntableCapture
from nishiki.capture.turntable_rules import UNITS_MM
from nishiki.observations.frames import FrameReader
from nishiki.observations.views_white import Whites

FORMAT = 1


def attributes_of(
    capture: TurntableCapture,
    reader: FrameReader,
    whites: Whites,
    *,
    white_block: int,
    silhouettes: list[str],
    boards: list[list[str]],
) -> dict:
    """Attributes of the store. silhouettes: views that have one; boards: [light, polariser state] of each."""
    block, matrices = capture.settings.turntable, capture.matrices
    finite = np.isfinite(reader.saturated)
    return {
        "format": FORMAT,
        "views": list(capture.views),
        "lights": list(capture.light_names),
        "states": list(capture.states),
        "files": [f.file for f in capture.observed],
        "channels": list(reader.names),
        "shape": [reader.rows, reader.columns],
        "encoding": reader.coding.encoding,
        "full_turn": block.full_turn,
        "unit": block.unit,
        "unit_mm": UNITS_MM[block.unit],
        "background": block.background,
        "lamp": lamp_of(capture),
        "scale": list(whites.scale),
        "saturation_code": reader.saturated.item() if finite else None,
        "white_block": white_block,
        "white_board": whites.normalised,
        "boards": boards,
        "silhouettes": silhouettes,
        "calibration": [{"name": f.file, "view": f.view or None} for f in capture.frames_of("board")],
        "board": block.board.model_dump(mode="json") if block.board else None,
        "intrinsics": capture.intrinsics.as_dict() if capture.intrinsics else None,
        "matrices": {view: matrices[view].tolist() for view in capture.views} if matrices else None,
        "distortions": {view: list(capture.distortion_of(view)) for view in capture.views} if matrices else None,
        "geometry": dict(geometry_files(capture)),
        "mesh_placement": list(block.mesh_placement),
    }


def lamp_of(capture: TurntableCapture) -> dict:
    """{"kind", "vectors"}: unit directions or positions in mm, one a light in the order of the lights, or None."""
    given, lights = capture.settings.lights, capture.lights
    if given is None or lights is None:
        return {"kind": given.kind if given else "unknown", "vectors": None}
    places = [lights.index(name) for name in capture.light_names]
    vectors = lights.vectors if given.kind == "position_mm" else lights.directions
    return {"kind": given.kind, "vectors": vectors[places].tolist()}


def geometry_files(capture: TurntableCapture) -> dict[str, str | list[str] | None]:
    """Where each file of the object's geometry lies in the artifact, by its key in the block `turntable`."""
    block = capture.settings.turntable
    scans = [f"geometry/scans/{i + 1:03d}_{scan.name}" for i, scan in enumerate(capture.scans)]
    return {
        "cameras": "geometry/cameras.csv" if block.cameras else None,
        "correspondences": "geometry/correspondences.csv" if block.correspondences else None,
        "mesh": f"geometry/mesh{capture.mesh.suffix.lower()}" if capture.mesh else None,
        "scans": scans,
        "calibration": f"geometry/calibration{capture.calibration.suffix}" if capture.calibration else None,
    }


def geometry_sources(capture: TurntableCapture) -> list[tuple[Path, str]]:
    """Each file to copy into the artifact: (file of the capture, name in the artifact)."""
    block, places = capture.settings.turntable, geometry_files(capture)
    named = {key: capture.payload / getattr(block, key) for key in ("cameras", "correspondences", "mesh", "calibration")
             if places[key]}  # fmt: skip
    return [(path, places[key]) for key, path in named.items()] + list(zip(capture.scans, places["scans"], strict=True))
