"""Photograph a simulated object on the turntable, and write the capture's folder with the truth behind it."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate import capture as common
from nishiki.simulate.randomness import subkey
from nishiki.simulate.turntable.render import Radiance, SimulatedScene, make_scene, see
from nishiki.simulate.turntable.shape import (
    AIM_MM,
    BETA,
    BLUR_PIXELS,
    CLOTH,
    LAMP_MM,
    LAMP_RADIUS_MM,
    LEAK,
    PARTS,
    PRESETS,
    STRAY,
    WHITE_RATIO,
    SimulatedView,
    TurntableSettings,
    make_surface,
    place_views,
    scan,
)


@dataclass(frozen=True)
class Optics:
    """The optics between the light and the converter, without noise."""

    # (rows, columns, 3), share of full scale that a perfect white at the axis gives, first polariser in place
    sensitivity: np.ndarray
    beta: np.ndarray  # (rows, columns, 3), factor of the second polariser
    # (rows, columns), light from the white board, relative to a perfect white at the axis. All float64
    board: np.ndarray


def _plane(settings: TurntableSettings) -> tuple[np.ndarray, np.ndarray]:
    """Compute u (1, columns) to the right and v (rows, 1) upwards, -1..1 along the longer side."""
    longer = 0.5 * max(settings.rows, settings.columns)
    u = (np.arange(settings.columns) + 0.5 - 0.5 * settings.columns) / longer
    v = (0.5 * settings.rows - 0.5 - np.arange(settings.rows)) / longer
    return u[None, :], v[:, None]


def make_optics(view: SimulatedView, settings: TurntableSettings) -> Optics:
    """Model the lens's fall-off (4 % in the corners), unevenness of the polarisers (±3 %) and of the board's light.

    The board stands in the place of the object, facing the camera; the same for every view, as camera and lamp are.
    """
    u, v = _plane(settings)
    falloff = 1.0 - 0.02 * (u * u + v * v)
    sensitivity = settings.camera.white_level * falloff[..., None] * np.array(WHITE_RATIO)
    random = np.random.default_rng(subkey(settings.seed, "turntable polariser"))
    waves = random.uniform(-1.0, 1.0, (3, 5)) * 0.012
    shape = np.stack([u + 0 * v, v + 0 * u, u * v, u * u - 0.3 + 0 * v, v * v - 0.3 + 0 * u], axis=-1)
    beta = np.array(BETA) * (1.0 + np.einsum("ijk,ck->ijc", shape, waves))
    # Points of the board: along the rays through the pixels, in the plane through the axis across the optical axis.
    right, down, into = view.rotation
    reach = float(into @ (np.array(AIM_MM) - view.centre))
    x = (np.arange(settings.columns) - view.principal[0])[None, :, None] / view.focal
    y = (np.arange(settings.rows) - view.principal[1])[:, None, None] / view.focal
    points = view.centre + reach * (into + x * right + y * down)
    to_lamp = view.lamp - points
    square = np.sum(to_lamp**2, axis=-1)
    board = common.BOARD_REFLECTANCE * np.sum((view.lamp - np.array(AIM_MM)) ** 2) / square
    return Optics(sensitivity, beta, board * -np.sum(to_lamp * into, axis=-1) / np.sqrt(square))


def blur(image: np.ndarray) -> np.ndarray:
    """Blur a picture (rows, columns, channels) by the lens: normal point spread of BLUR_PIXELS."""
    from scipy.ndimage import correlate1d

    offsets = np.arange(-3, 4)
    kernel = np.exp(-0.5 * (offsets / BLUR_PIXELS) ** 2)
    kernel /= kernel.sum()
    for axis in range(2):
        image = correlate1d(image, kernel, axis=axis, mode="nearest")
    return image


def components(light: Radiance, settings: TurntableSettings) -> tuple[np.ndarray, np.ndarray]:
    """Compute depolarised and mirrored light (rows, columns, 3) float64 at the sensor: blurred, stray light added."""
    bare = (1.0 - light.coverage)[..., None].astype(np.float64)
    u, v = _plane(settings)
    backdrop = (CLOTH * (1.0 - 0.4 * v + 0.1 * u))[..., None]  # the black cloth: a faint glow that is stronger below
    diffuse = blur(light.diffuse + bare * backdrop)
    return diffuse + STRAY, blur(light.specular.astype(np.float64))


def signal(light: Radiance, optics: Optics, settings: TurntableSettings, state: str) -> np.ndarray:
    """Compute the share of full scale (rows, columns, 3) in a state of the polarisers ("off", "on", or "" if none)."""
    diffuse, specular = components(light, settings)
    if state == "on":
        return optics.sensitivity * optics.beta * (diffuse + np.array(LEAK) * specular)
    return optics.sensitivity * (diffuse + specular)


def photograph(light: Radiance, optics: Optics, settings: TurntableSettings, *, view: str, state: str) -> np.ndarray:
    """Photograph the object: codes (rows, columns, 3) uint16."""
    key = subkey(settings.seed, f"turntable noise {view} {state}")
    return common.expose(signal(light, optics, settings, state).astype(np.float32), settings.camera, key=key)


def white_board(index: int, optics: Optics, settings: TurntableSettings, *, state: str) -> np.ndarray:
    """Photograph the matt white board, which depolarises all that it reflects: codes of one of several pictures."""
    level = optics.sensitivity * (optics.board + STRAY)[..., None]
    if state == "on":
        level = level * optics.beta
    key = subkey(settings.seed, f"turntable noise white {index} {state}")
    return common.expose(level.astype(np.float32), settings.camera, key=key)


LAMP = "lamp"
EXPOSURE_S = "0.25"


def settings_from(options) -> TurntableSettings:
    """Build the settings from the options of the command line."""
    if options.lights_as == "direction":
        raise UserError("--lights-as: on a turntable expected position or camera, found direction; choose one")
    values = dict(PRESETS[options.preset])
    names = {name: name for name in ("rows", "columns", "views", "triangles", "scan_triangles")}
    names |= {"mesh_noise_mm": "scan_noise_mm", "supersampling": "samples"}
    values |= {name: getattr(options, key) for key, name in names.items() if getattr(options, key) is not None}
    if options.no_bounce:
        values["bounces"] = 0
    camera = common.camera_from(options, TurntableSettings().camera)
    return TurntableSettings(**values, seed=options.seed, polariser=options.polariser == "circular", camera=camera)


def write_all(settings: TurntableSettings, capture: Path, truth: Path, options, report) -> None:
    """Write both folders; report(text) prints the progress."""
    views = place_views(settings)
    scene = make_scene(settings)
    report(f"object: {len(scene.surface.triangles)} triangles")
    optics = make_optics(views[0], settings)
    states = ("off", "on") if settings.polariser else ("",)
    lamp = LAMP if options.lights_as != "camera" else ""
    store = ObjectTruthWriter(truth, settings, views, scene, optics)
    frames = []

    def keep(file: str, role: str, codes: np.ndarray, *, view="", light="", state="", silhouette="") -> None:
        common.write_image(capture / file, codes)
        frames.append((file, role, view, light, state, "" if role == "dark" else EXPOSURE_S, silhouette))

    for place, view in enumerate(views):
        light = see(scene, view, settings)
        store.add(place, light)
        outline = f"silhouettes/{view.name}.png" if options.silhouettes == "given" else ""
        if outline:
            mask = np.where(light.coverage >= 0.5, 255, 0).astype(np.uint8)
            common.write_image(capture / outline, np.repeat(mask[..., None], 3, axis=2))
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
    for number in range(1, common.DARK_FRAMES + 1):
        key = subkey(settings.seed, f"turntable dark {number}")
        keep(f"dark/{number}.{options.format}", "dark", common.dark_frame(codes.shape, settings.camera, key=key))
    header = ("file", "role", "view", "light", "polariser", "exposure_s", "silhouette")
    common.write_csv(capture / "frames.csv", [header, *frames])
    header = ("view", *(f"p{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4)))
    rows = [(view.name, *(f"{value:.17g}" for value in view.matrix.ravel())) for view in views]
    common.write_csv(capture / "cameras.csv", [header, *rows])
    if lamp:
        # In the camera's frame: x right, y up, z towards the photographer.
        rows = [("light", "x", "y", "z"), (LAMP, *(f"{value:.3f}" for value in LAMP_MM))]
        common.write_csv(capture / "lights.csv", rows)
    if options.mesh == "scan":
        surface = make_surface(settings.scan_triangles) if settings.scan_triangles else scene.surface
        points, triangles = scan(surface, noise_mm=settings.scan_noise_mm, seed=settings.seed)
        text = (
            "ply\nformat binary_little_endian 1.0\ncomment simulated scan, millimetres\n"
            f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
            f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
        ).encode("ascii")
        corners = np.empty(len(triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
        corners["count"], corners["corners"] = 3, triangles
        values = np.ascontiguousarray(points, "<f4").tobytes() + corners.tobytes()
        (capture / "object.ply").write_bytes(text + values)
    common.write_description(
        capture,
        f"Simulated jar on a turntable (seed {settings.seed})",
        "turntable",
        ("red", "green", "blue"),
        settings.camera,
        lights={"file": "lights.csv", "kind": "position_mm"} if lamp else {"kind": "camera"},
        white={"reflectance": common.BOARD_REFLECTANCE, "normal": [0, 0, 1]},
        turntable={
            "full_turn": True,
            "unit": "mm",
            "cameras": "cameras.csv",
            **({"mesh": "object.ply"} if options.mesh == "scan" else {}),
            "background": "dark",
        },
    )
    store.finish(
        truth_attributes(settings, views),
        common.readme("turntable", settings=settings, stray=STRAY, reflectance=common.BOARD_REFLECTANCE),
    )


class ObjectTruthWriter(common.TruthWriter):
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

    def add(self, place: int, light: Radiance) -> None:
        """Add one view."""
        diffuse, specular = components(light, self.settings)
        for name, values in (("diffuse", diffuse), ("specular", specular), ("total", diffuse + specular)):
            self.group[name][place] = values.astype(np.float32)
        for name in ("coverage", "depth", "normals", "albedo", "part"):
            self.group[name][place] = getattr(light, name)


def truth_attributes(settings: TurntableSettings, views: tuple[SimulatedView, ...]) -> dict:
    """Return the attributes of truth.zarr."""
    return {
        "views": [view.name for view in views],
        "parts": list(PARTS),
        "cameras": {view.name: view.matrix.tolist() for view in views},
        "lamp_in_camera_mm": list(LAMP_MM),
        "lamp_radius_mm": LAMP_RADIUS_MM,
        "beta": list(BETA),
        "leak": list(LEAK),
        "board_reflectance": common.BOARD_REFLECTANCE,
        "settings": asdict(settings),
    }
