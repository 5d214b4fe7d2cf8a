"""Files of a simulated turntable capture, and of the truth behind it (see `nishiki.simulate.command`)."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.turntable.settings import PRESETS, TurntableSettings

DARK_FRAMES = 3
EXPOSURE_S = "0.25"
# Options of the painting that mean something else, or nothing, on a turntable.
FOREIGN = ("scene", "relief", "relief_gain", "gloss", "roughness", "body", "pitch_mm", "rings", "ring_lights", "no_top")
FOREIGN += ("checks", "distance_mm", "lamp_diameter_deg", "channels")
OWN = ("views", "mesh_noise_mm", "triangles", "scan_triangles")  # options that mean something on a turntable only


def settings_from(options, defaults) -> TurntableSettings:
    """The settings that the command line asks for; `defaults` are the values of options that were not given."""
    for name in FOREIGN:
        if getattr(options, name) != getattr(defaults, name):
            option = f"--{name.replace('_', '-')}"
            raise UserError(f"{option} belongs to the plane scenes, found with --preset {options.preset}; leave it out")
    if options.lights_as == "direction":
        raise UserError("--lights-as: on a turntable expected position or camera, found direction; choose one")
    values = dict(PRESETS[options.preset])
    for name in ("rows", "columns", "views", "triangles", "scan_triangles", "mesh_noise_mm"):
        if getattr(options, name) is not None:
            values["scan_noise_mm" if name == "mesh_noise_mm" else name] = getattr(options, name)
    if options.supersampling is not None:
        values["samples"] = options.supersampling
    if options.no_bounce:
        values["bounces"] = 0
    camera = TurntableSettings().camera
    changes = {"bits": options.bits, "noise": not options.no_noise}
    if options.white_level is not None:
        changes["white_level"] = options.white_level
    camera = dataclasses.replace(camera, **changes)
    return TurntableSettings(**values, seed=options.seed, polariser=options.polariser == "circular", camera=camera)


def write_all(settings: TurntableSettings, capture: Path, truth: Path, options, report, write_image, write_csv) -> None:
    """Both folders. report(text) tells the progress; write_image, write_csv are those of `nishiki.simulate.command`."""
    import yaml

    from nishiki.simulate.turntable import describe
    from nishiki.simulate.turntable.photographs import dark_frame, make_optics, photograph, white_board
    from nishiki.simulate.turntable.render import make_scene, see
    from nishiki.simulate.turntable.viewpoints import place_views

    image_format = options.format or "png"
    views = place_views(settings)
    scene = make_scene(settings)
    report(f"object: {len(scene.surface.triangles)} triangles")
    optics = make_optics(views[0], settings)
    states = ("off", "on") if settings.polariser else ("",)
    lamp = describe.LAMP if options.lights_as != "camera" else ""
    store = TruthStore(truth, settings, views, scene, optics)
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
            file = f"frames/{view.name}{'-' * bool(state)}{state}.{image_format}"
            codes = photograph(light, optics, settings, view=view.name, state=state)
            keep(file, "sample", codes, view=view.name, light=lamp, state=state, silhouette=outline)
        report(f"view {view.name}")
    for state in states:
        # Without polarisers the capture takes one board a lamp, so this one is the mean of several exposures.
        boards = [white_board(k, optics, settings, state=state) for k in range(settings.white_boards)]
        if not state:
            boards = [np.rint(np.mean(boards, axis=0)).astype(np.uint16)]
        for number, codes in enumerate(boards, start=1):
            keep(f"white/{state or 'board'}-{number}.{image_format}", "white", codes, light=lamp, state=state)
    for number in range(1, DARK_FRAMES + 1):
        keep(f"dark/{number}.{image_format}", "dark", dark_frame(number, settings))
    header = ("file", "role", "view", "light", "polariser", "exposure_s", "silhouette")
    write_csv(capture / "frames.csv", [header, *frames])
    write_csv(capture / "cameras.csv", describe.camera_table(views))
    if lamp:
        write_csv(capture / "lights.csv", describe.light_table())
    if options.mesh == "scan":
        (capture / "object.ply").write_bytes(scan_of(scene, settings))
    lights_as = "camera" if not lamp else "position"
    text = describe.capture_description(settings, lights_as=lights_as, with_mesh=options.mesh == "scan")
    (capture / "capture.yaml").write_text(yaml.safe_dump(text, sort_keys=False))
    store.finish()
    report("capture and truth written", end="\n")


def scan_of(scene, settings: TurntableSettings) -> bytes:
    """The PLY file that a scanner delivers: the object's own triangles or others, with noise."""
    from nishiki.simulate.turntable.describe import mesh_bytes
    from nishiki.simulate.turntable.surface import make_surface, scanned

    surface = make_surface(settings.scan_triangles) if settings.scan_triangles else scene.surface
    return mesh_bytes(*scanned(surface, noise_mm=settings.scan_noise_mm, seed=settings.seed))


class TruthStore:
    """truth.zarr, filled view by view, and a README that says what is in it."""

    def __init__(self, folder: Path, settings: TurntableSettings, views, scene, optics):
        import zarr

        self.folder, self.settings, self.views = folder, settings, views
        self.group = zarr.open_group(folder / "truth.zarr", mode="w", zarr_format=3)
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

    def make(self, name: str, shape, dtype):
        return self.group.create_array(name, shape=shape, dtype=dtype, chunks=(1, *shape[1:]))

    def put(self, name: str, values: np.ndarray) -> None:
        self.group.create_array(name, shape=values.shape, dtype=values.dtype, chunks=values.shape)[...] = values

    def add(self, place: int, light) -> None:
        from nishiki.simulate.turntable.photographs import components

        diffuse, specular = components(light, self.settings)
        for name, values in (("diffuse", diffuse), ("specular", specular), ("total", diffuse + specular)):
            self.group[name][place] = values.astype(np.float32)
        for name in ("coverage", "depth", "normals", "albedo", "part"):
            self.group[name][place] = getattr(light, name)

    def finish(self) -> None:
        from nishiki.simulate.turntable.describe import truth_attributes, truth_readme

        self.group.attrs.update(truth_attributes(self.settings, self.views))
        (self.folder / "README.md").write_text(truth_readme(self.settings))
