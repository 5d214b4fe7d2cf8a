"""Files of a simulated turntable capture, and of the truth behind it (see `nishiki.simulate.command`)."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.folders import DARK_FRAMES, Truth, write_csv, write_description, write_image
from nishiki.simulate.randomness import subkey
from nishiki.simulate.sensor import dark_frame
from nishiki.simulate.settings import camera_from
from nishiki.simulate.turntable import settings as constants
from nishiki.simulate.turntable.photographs import Optics, components, make_optics, photograph, white_board
from nishiki.simulate.turntable.render import Light, SimulatedScene, make_scene, see
from nishiki.simulate.turntable.settings import PRESETS, TurntableSettings, Viewpoint, place_views
from nishiki.simulate.turntable.shape import PARTS
from nishiki.simulate.turntable.surface import make_surface, scanned

LAMP = "lamp"
EXPOSURE_S = "0.25"


def settings_from(options) -> TurntableSettings:
    """The settings that the command line asks for."""
    if options.lights_as == "direction":
        raise UserError("--lights-as: on a turntable expected position or camera, found direction; choose one")
    values = dict(PRESETS[options.preset])
    names = {name: name for name in ("rows", "columns", "views", "triangles", "scan_triangles")}
    names |= {"mesh_noise_mm": "scan_noise_mm", "supersampling": "samples"}
    values |= {name: getattr(options, key) for key, name in names.items() if getattr(options, key) is not None}
    if options.no_bounce:
        values["bounces"] = 0
    camera = camera_from(options, TurntableSettings().camera)
    return TurntableSettings(**values, seed=options.seed, polariser=options.polariser == "circular", camera=camera)


def write_all(settings: TurntableSettings, capture: Path, truth: Path, options, report) -> None:
    """Both folders; report(text) tells the progress."""
    views = place_views(settings)
    scene = make_scene(settings)
    report(f"object: {len(scene.surface.triangles)} triangles")
    optics = make_optics(views[0], settings)
    states = ("off", "on") if settings.polariser else ("",)
    lamp = LAMP if options.lights_as != "camera" else ""
    store = ObjectTruth(truth, settings, views, scene, optics)
    frames = []

    def keep(file: str, role: str, codes: np.ndarray, *, view="", light="", state="", silhouette="") -> None:
        write_image(capture / file, codes)
        frames.append((file, role, view, light, state, "" if role == "dark" else EXPOSURE_S, silhouette))

    for place, view in enumerate(views):
        light = see(scene, view, settings)
        store.add(place, light)
        outline = f"silhouettes/{view.name}.png" if options.silhouettes == "given" else ""
        if outline:
            mask = np.where(light.coverage >= 0.5, 255, 0).astype(np.uint8)
            write_image(capture / outline, np.repeat(mask[..., None], 3, axis=2))
        for state in states:
            file = f"frames/{view.name}{'-' * bool(state)}{state}.{options.format}"
            codes = photograph(light, optics, settings, view=view.name, state=state)
            keep(file, "sample", codes, view=view.name, light=lamp, state=state, silhouette=outline)
        report(f"view {place + 1} of {len(views)}")
    for state in states:
        # Without polarisers the capture takes one board a lamp, so this one is the mean of several exposures.
        boards = [white_board(k, optics, settings, state=state) for k in range(settings.white_boards)]
        if not state:
            boards = [np.rint(np.mean(boards, axis=0)).astype(np.uint16)]
        for number, codes in enumerate(boards, start=1):
            keep(f"white/{state or 'board'}-{number}.{options.format}", "white", codes, light=lamp, state=state)
    for number in range(1, DARK_FRAMES + 1):
        key = subkey(settings.seed, f"turntable dark {number}")
        keep(f"dark/{number}.{options.format}", "dark", dark_frame(codes.shape, settings.camera, key=key))
    header = ("file", "role", "view", "light", "polariser", "exposure_s", "silhouette")
    write_csv(capture / "frames.csv", [header, *frames])
    header = ("view", *(f"p{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4)))
    rows = [(view.name, *(f"{value:.17g}" for value in view.matrix.ravel())) for view in views]
    write_csv(capture / "cameras.csv", [header, *rows])
    if lamp:
        # In the camera's frame: x right, y up, z towards the photographer.
        rows = [("light", "x", "y", "z"), (LAMP, *(f"{value:.3f}" for value in constants.LAMP_MM))]
        write_csv(capture / "lights.csv", rows)
    if options.mesh == "scan":
        (capture / "object.ply").write_bytes(scan_of(scene, settings))
    write_description(
        capture,
        f"Simulated jar on a turntable (seed {settings.seed})",
        "turntable",
        ("red", "green", "blue"),
        settings.camera,
        lights={"file": "lights.csv", "kind": "position_mm"} if lamp else {"kind": "camera"},
        white={"reflectance": constants.BOARD_REFLECTANCE, "normal": [0, 0, 1]},
        turntable={
            "full_turn": True,
            "unit": "mm",
            "cameras": "cameras.csv",
            **({"mesh": "object.ply"} if options.mesh == "scan" else {}),
            "background": "dark",
        },
    )
    store.finish(truth_attributes(settings, views), truth_readme(settings))


def scan_of(scene: SimulatedScene, settings: TurntableSettings) -> bytes:
    """The PLY file that a scanner delivers: the object's own triangles or others, with noise."""
    surface = make_surface(settings.scan_triangles) if settings.scan_triangles else scene.surface
    return mesh_bytes(*scanned(surface, noise_mm=settings.scan_noise_mm, seed=settings.seed))


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


class ObjectTruth(Truth):
    """The truth of an object, filled view by view."""

    def __init__(self, folder: Path, settings: TurntableSettings, views, scene: SimulatedScene, optics: Optics):
        super().__init__(folder)
        self.settings = settings
        self.put("vertices", scene.surface.vertices)
        self.put("triangles", scene.surface.triangles)
        self.put("vertex_normals", scene.surface.normals.astype(np.float32))
        for name in ("sensitivity", "beta", "board"):
            self.put(name, getattr(optics, name).astype(np.float32))
        shape = (len(views), settings.rows, settings.columns)
        for name in ("diffuse", "specular", "total", "normals", "albedo"):
            self.make(name, (*shape, 3), np.float32)
        for name, kind in (("coverage", np.float32), ("depth", np.float32), ("part", np.uint8)):
            self.make(name, shape, kind)

    def add(self, place: int, light: Light) -> None:
        """What one view shows."""
        diffuse, specular = components(light, self.settings)
        for name, values in (("diffuse", diffuse), ("specular", specular), ("total", diffuse + specular)):
            self.group[name][place] = values.astype(np.float32)
        for name in ("coverage", "depth", "normals", "albedo", "part"):
            self.group[name][place] = getattr(light, name)


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
