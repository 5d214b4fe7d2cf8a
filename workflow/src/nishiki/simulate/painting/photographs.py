"""Photograph a simulated painting, and write the capture's folder with the truth behind it."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate import capture as common
from nishiki.simulate.painting.objects import make_object
from nishiki.simulate.painting.relief import SimulatedObject, shade
from nishiki.simulate.painting.settings import (
    PRESETS,
    REGIONS,
    LampPose,
    LampSettings,
    SimulationSettings,
    beam_strength,
    board_cosine,
    direction_error_deg,
    make_palette,
    place_lamps,
    planck_spectrum,
    vignette,
)
from nishiki.simulate.randomness import subkey
from nishiki.threads import strips

WAVELENGTHS_NM = np.arange(400.0, 700.5, 5.0)


@dataclass(frozen=True)
class SimulatedPhotograph:
    """codes : (rows, columns, channels) uint16. lit : (rows, columns) uint8, percent of the pixel that the lamp lights.

    The following are None for sample lights. They are relative to a perfect white diffuser facing the lamp (Y = 1),
    without noise, and include the correction for the board's tilt that a white-normalised observation carries:
    xyz_lamp, xyz_d65 : (rows, columns, 3) float32 under the lamp's own spectrum and under D65; gloss, body :
    (rows, columns) float32, shares of the mirror reflection and of the body's reflection (as Y) under the lamp.
    """

    codes: np.ndarray
    lit: np.ndarray
    xyz_lamp: np.ndarray | None = None
    xyz_d65: np.ndarray | None = None
    gloss: np.ndarray | None = None
    body: np.ndarray | None = None


@dataclass(frozen=True)
class Tables:
    """Colour tables (labels, n), the same for squared reflectance, and the values of a perfect white (n,).

    Columns: the camera's channels; for check lights XYZ under the lamp and XYZ under D65 follow. `signal` (channels,)
    is what a perfect white facing the lamp gives in each channel, relative to a full well.
    """

    table: np.ndarray
    squared: np.ndarray
    white: np.ndarray
    signal: np.ndarray


def make_tables(thing: SimulatedObject, settings: SimulationSettings, *, with_truth: bool) -> Tables:
    """Make the colour tables for sample lights, or for check lights with their truth."""
    spectrum = planck_spectrum(common.FINE_NM, settings.lights.colour_temperature_k)
    weights = common.sensitivities(common.FINE_NM, settings.camera.channels) * spectrum
    response = weights.sum(axis=1)
    weights = (weights / response[:, None]).T
    signal = response / response.max() * settings.camera.white_level
    spectra = thing.palette.spectra
    parts, squares, whites = [spectra @ weights], [spectra**2 @ weights], [np.ones(len(response))]
    if with_truth:
        from nishiki.colour.colour import illuminant, xyz_matrix

        spectra = true_spectra(settings)
        for lamp in (planck_spectrum(WAVELENGTHS_NM, settings.lights.colour_temperature_k), illuminant("D65")):
            parts.append(xyz_matrix(lamp, spectra).T)
            squares.append(xyz_matrix(lamp, spectra**2).T)
            whites.append(xyz_matrix(lamp, np.ones((1, spectra.shape[1])))[:, 0])
    return Tables(np.hstack(parts), np.hstack(squares), np.concatenate(whites), signal)


def true_spectra(settings: SimulationSettings) -> np.ndarray:
    """Compute the reflectance (labels, 61) of every paint at 400, 405 .. 700 nm."""
    return make_palette(WAVELENGTHS_NM, alpha=settings.alpha, seed=settings.seed).spectra


def photograph(
    thing: SimulatedObject, lamp: LampPose, settings: SimulationSettings, tables: Tables
) -> SimulatedPhotograph:
    """Photograph the object under one lamp. Truth is returned where `tables` carry it."""
    channels = settings.camera.channels
    shape = (settings.rows, settings.columns)
    codes, lit = np.empty((*shape, channels), np.uint16), np.empty(shape, np.uint8)
    truth = None
    if tables.table.shape[1] > channels:
        tails = {"xyz_lamp": (3,), "xyz_d65": (3,), "gloss": (), "body": ()}
        truth = {name: np.empty((*shape, *tail), np.float32) for name, tail in tails.items()}
    key = subkey(settings.seed, f"noise sample {lamp.name}")
    for rows in strips(settings.rows):  # the slices bound the memory and do not change a byte
        shading = shade(thing, lamp, settings, table=tables.table, squared=tables.squared, rows=rows)
        observed = shading.body + shading.gloss[..., None] * tables.white.astype(np.float32)
        strength = (beam_strength(lamp, settings, rows) * vignette(settings, rows)).astype(np.float32)
        signal = observed[..., :channels] * strength[..., None] * tables.signal.astype(np.float32)
        codes[rows] = common.expose(signal, settings.camera, key=key, first_row=rows.start)
        lit[rows] = np.rint(100.0 * shading.lit)
        if truth is not None:
            tilt = (lamp.direction[2] / board_cosine(lamp, settings, rows)).astype(np.float32)
            truth["xyz_lamp"][rows] = observed[..., channels : channels + 3] * tilt[..., None]
            truth["xyz_d65"][rows] = observed[..., channels + 3 :] * tilt[..., None]
            truth["gloss"][rows] = shading.gloss * tilt
            truth["body"][rows] = shading.body[..., channels + 1] * tilt
    return SimulatedPhotograph(codes, lit, **(truth or {}))


def white_board(lamp: LampPose, settings: SimulationSettings, tables: Tables) -> np.ndarray:
    """Photograph the flat, matt white board in the object's place under one lamp: codes (rows, columns, channels)."""
    codes = np.empty((settings.rows, settings.columns, settings.camera.channels), np.uint16)
    key = subkey(settings.seed, f"noise white {lamp.name}")
    for rows in strips(settings.rows):
        light = beam_strength(lamp, settings, rows) * board_cosine(lamp, settings, rows) * vignette(settings, rows)
        signal = common.BOARD_REFLECTANCE * light[..., None] * tables.signal
        codes[rows] = common.expose(signal, settings.camera, key=key, first_row=rows.start)
    return codes


def settings_from(options) -> SimulationSettings:
    """Build the settings from the options of the command line."""
    if options.lights_as == "camera":
        raise UserError("--lights-as: of a painting expected direction or position, found camera; choose one")
    rows, columns = PRESETS[options.preset]
    return SimulationSettings(
        rows=options.rows or rows,
        columns=options.columns or columns,
        seed=options.seed,
        scene=options.scene,
        relief=options.relief,
        gloss=options.gloss,
        body=options.body,
        roughness=options.roughness,
        relief_gain=options.relief_gain,
        pitch_mm=options.pitch_mm or 0.2,
        supersampling=2 if options.supersampling is None else options.supersampling,
        bounce=not options.no_bounce,
        camera=common.camera_from(options, common.CameraSettings(channels=options.channels)),
        lights=LampSettings(
            rings=options.rings,
            ring_lights=options.ring_lights,
            top=not options.no_top,
            checks_deg=tuple(options.checks),
            distance_mm=options.distance_mm,
            angular_diameter_deg=options.lamp_diameter_deg,
        ),
    )


def write_all(settings: SimulationSettings, capture: Path, truth: Path, options, report) -> None:
    """Write both folders; report(text) prints the progress."""
    thing = make_object(settings)
    report(f"object: {settings.rows}×{settings.columns} pixels, relief {thing.ceiling_mm:.2f} mm")
    lamps = place_lamps(settings)
    plain, full = (make_tables(thing, settings, with_truth=flag) for flag in (False, True))
    store = PaintingTruth(truth, settings, thing, lamps)
    frames = []
    for number, lamp in enumerate(lamps, 1):
        shot = photograph(thing, lamp, settings, full if lamp.role == "check" else plain)
        store.add(lamp, shot)
        for role, codes in ((lamp.role, shot.codes), ("white", white_board(lamp, settings, plain))):
            file = f"{'white' if role == 'white' else 'frames'}/{lamp.name}.{options.format}"
            common.write_image(capture / file, codes)
            frames.append((file, role, lamp.name))
        report(f"lamp {number} of {len(lamps)}")
    for index in range(1, common.DARK_FRAMES + 1):
        file = f"dark/{index}.{options.format}"
        key = subkey(settings.seed, f"noise dark {index}")
        common.write_image(capture / file, common.dark_frame(shot.codes.shape, settings.camera, key=key))
        frames.append((file, "dark", ""))
    common.write_csv(capture / "frames.csv", [("file", "role", "light"), *frames])
    write_tables(capture, settings, lamps, directions=options.lights_as != "position")
    attributes = truth_attributes(settings, lamps)
    facts = {"samples": settings.supersampling**2, "checks": ", ".join(attributes["checks"]) or "none"}
    store.finish(
        attributes, common.readme("painting", settings=settings, off=attributes["direction_error_deg"], **facts)
    )


def write_tables(capture: Path, settings: SimulationSettings, lamps: tuple[LampPose, ...], *, directions: bool) -> None:
    """Write capture.yaml, the lamps (directions, or positions in mm), and the spectra, 380 to 780 nm every 5 nm."""
    if directions:
        lines = [f"{lamp.name} " + " ".join(f"{v:.6f}" for v in lamp.direction) for lamp in lamps]
        (capture / "lights.lp").write_text("\n".join([str(len(lamps)), *lines]) + "\n")
    else:
        rows = [(lamp.name, *(f"{v:.3f}" for v in lamp.position_mm)) for lamp in lamps]
        common.write_csv(capture / "lights.csv", [("light", "x", "y", "z"), *rows])
    names = common.channel_names(settings.camera.channels)
    nm = np.arange(380.0, 780.5, 5.0)
    curves = common.sensitivities(nm, settings.camera.channels)
    power = planck_spectrum(nm, settings.lights.colour_temperature_k)
    (capture / "spectra").mkdir()
    for file, heading, columns in (("camera", names, curves), ("illuminant", ("power",), power[None])):
        rows = [(f"{w:g}", *(f"{v:.6f}" for v in values)) for w, values in zip(nm, columns.T, strict=True)]
        common.write_csv(capture / "spectra" / f"{file}.csv", [("wavelength_nm", *heading), *rows])
    common.write_description(
        capture,
        f"Simulated {settings.scene} (seed {settings.seed})",
        "plane",
        names,
        settings.camera,
        sensitivities="spectra/camera.csv",
        illuminant="spectra/illuminant.csv",
        lights={
            "file": "lights.lp" if directions else "lights.csv",
            "kind": "direction" if directions else "position_mm",
        },
        white={"reflectance": common.BOARD_REFLECTANCE, "normal": [0, 0, 1]},
        pixel_pitch_mm=settings.pitch_mm,
    )


class PaintingTruth(common.TruthWriter):
    """The truth of a painting, filled light by light."""

    def __init__(self, folder: Path, settings: SimulationSettings, thing: SimulatedObject, lamps: tuple[LampPose, ...]):
        super().__init__(folder)
        self.checks = [lamp.name for lamp in lamps if lamp.role == "check"]
        self.names = [lamp.name for lamp in lamps]
        palette, s = thing.palette, settings.supersampling
        blocks = thing.label.reshape(settings.rows, s, settings.columns, s).transpose(0, 2, 1, 3)
        labels = np.ascontiguousarray(blocks).reshape(settings.rows, settings.columns, s * s)
        self.put("normals", thing.normals)
        self.put("height_mm", thing.mean_height_mm)
        self.put("steepest", thing.steepest)
        self.put("labels", labels)
        self.put("regions", palette.region.astype(np.uint8)[labels[..., (s * s) // 2]])
        self.put("spectra", true_spectra(settings).astype(np.float32))
        self.put("wavelengths_nm", WAVELENGTHS_NM)
        self.put("roughness", palette.roughness.astype(np.float32))
        shape = (settings.rows, settings.columns)
        self.make("lit", (len(lamps), *shape), np.uint8)
        for name, tail in (("xyz_lamp", (3,)), ("xyz_d65", (3,)), ("gloss", ()), ("body", ())):
            self.make(name, (len(self.checks), *shape, *tail), np.float32)
        self.group.attrs["label_names"] = list(palette.names)

    def add(self, lamp: LampPose, shot: SimulatedPhotograph) -> None:
        """Add one photograph."""
        self.group["lit"][self.names.index(lamp.name)] = shot.lit
        if lamp.role == "check":
            for name in ("xyz_lamp", "xyz_d65", "gloss", "body"):
                self.group[name][self.checks.index(lamp.name)] = getattr(shot, name)


def truth_attributes(settings: SimulationSettings, lamps: tuple[LampPose, ...]) -> dict:
    """Return the attributes of truth.zarr: names of lights, checks and regions, lamp positions, the settings."""
    mean, largest = direction_error_deg(settings)
    return {
        "lights": [lamp.name for lamp in lamps],
        "checks": [lamp.name for lamp in lamps if lamp.role == "check"],
        "directions": [lamp.direction.tolist() for lamp in lamps],
        "positions_mm": [lamp.position_mm.tolist() for lamp in lamps],
        "regions": list(REGIONS),
        "direction_error_deg": {"mean": mean, "max": largest},
        "settings": asdict(settings),
    }
