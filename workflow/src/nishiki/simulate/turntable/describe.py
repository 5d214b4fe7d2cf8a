"""What the tables of a turntable capture and of its truth say: values and text, no files."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from nishiki.simulate.turntable import settings as constants
from nishiki.simulate.turntable.settings import TurntableSettings
from nishiki.simulate.turntable.shape import PARTS
from nishiki.simulate.turntable.viewpoints import Viewpoint

LAMP = "lamp"


def capture_description(settings: TurntableSettings, *, lights_as: str, with_mesh: bool) -> dict:
    """The contents of capture.yaml; `lights_as` is "position" (of the lamp) or "camera" (beside the camera)."""
    camera = settings.camera
    position = lights_as == "position"
    return {
        "format": 1,
        "title": f"Simulated jar on a turntable (seed {settings.seed})",
        "geometry": "turntable",
        "camera": {
            "model": "simulated camera",
            "channels": ["red", "green", "blue"],
            "encoding": "linear",
            "bits": camera.bits,
            "saturation": 0.98,
            "black_level": camera.black_level,
        },
        "lights": {"file": "lights.csv", "kind": "position_mm"} if position else {"kind": "camera"},
        "white": {"reflectance": constants.BOARD_REFLECTANCE, "normal": [0, 0, 1]},
        "turntable": {
            "full_turn": True,
            "unit": "mm",
            "cameras": "cameras.csv",
            **({"mesh": "object.ply"} if with_mesh else {}),
            "background": "dark",
        },
    }


def camera_table(views: tuple[Viewpoint, ...]) -> list[tuple]:
    """Rows of cameras.csv, header first: the view, then its 3x4 projection matrix row by row."""
    header = ("view", *(f"p{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4)))
    return [header, *((view.name, *(f"{value:.17g}" for value in view.matrix.ravel())) for view in views)]


def light_table() -> list[tuple]:
    """Rows of lights.csv, header first: the lamp in the camera's frame (x right, y up, z towards the photographer)."""
    return [("light", "x", "y", "z"), (LAMP, *(f"{value:.3f}" for value in constants.LAMP_MM))]


def mesh_bytes(vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    """A binary PLY file of a triangle mesh, millimetres, float32."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment simulated scan, millimetres\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, triangles
    return header.encode("ascii") + np.ascontiguousarray(vertices, "<f4").tobytes() + faces.tobytes()


def truth_attributes(settings: TurntableSettings, views: tuple[Viewpoint, ...]) -> dict:
    """Attributes of truth.zarr."""
    return {
        "views": [view.name for view in views],
        "parts": list(PARTS),
        "cameras": {view.name: view.matrix.tolist() for view in views},
        "lamp_in_camera_mm": list(constants.LAMP_MM),
        "lamp_radius_mm": constants.LAMP_RADIUS_MM,
        "beta": list(constants.BETA),
        "leak": list(constants.LEAK),
        "board_reflectance": constants.BOARD_REFLECTANCE,
        "settings": asdict(settings),
    }


def truth_readme(settings: TurntableSettings) -> str:
    """Text of the README in a truth folder."""
    return f"""# Truth of a simulated turntable capture

Seed {settings.seed}, {settings.views} views of {settings.rows} × {settings.columns} pixels, lengths in mm.
Use it to judge results, never to fit.

`truth.zarr` (Zarr v3; views in the order of the turn; row 0 at the top):

| array | shape | meaning |
|---|---|---|
| `diffuse` | views, rows, columns, 3 | light that has lost its polarisation, stray light and cloth included |
| `specular` | views, rows, columns, 3 | the lamp's mirror reflection |
| `total` | views, rows, columns, 3 | their sum: what the camera sees without crossed polarisers |
| `coverage` | views, rows, columns | share of the pixel that the object fills |
| `depth` | views, rows, columns | along the optical axis; 0 where there is no object |
| `normals` | views, rows, columns, 3 | unit normal of the smooth surface, in the object's frame |
| `albedo` | views, rows, columns, 3 | albedo of the body below its surface |
| `part` | views, rows, columns | part of the object, names in the attribute `parts`; 255 = none |
| `sensitivity` | rows, columns, 3 | share of full scale that a perfect white at the axis gives |
| `board` | rows, columns | light from the white board |
| `beta` | rows, columns, 3 | factor of the second polariser |
| `vertices`, `triangles`, `vertex_normals` | | the object itself; the mesh in the capture is a noisy scan of it |

Light is relative to a perfect white on the axis that faces the lamp, without noise, behind the lens's blur. The codes
of a photograph are (full scale − black) × sensitivity × total + black, with crossed polarisers
(full scale − black) × sensitivity × beta × (diffuse + leak × specular) + black, plus noise; those of the board likewise
with sensitivity × (board + {constants.STRAY}). Where observations are divided by the board, the truth to compare them
with is total / (board + {constants.STRAY}) × {constants.BOARD_REFLECTANCE}.
"""
