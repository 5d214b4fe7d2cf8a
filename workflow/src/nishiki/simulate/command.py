"""Simulate the capture of a painting, of sphere caps, of a jar on a turntable, of a cloth: photographs and the truth.

    python scripts/simulate.py --output captures/painting --truth captures/painting-truth
    python scripts/simulate.py --output captures/small --truth captures/small-truth --preset tiny
    python scripts/simulate.py --output captures/tray --truth captures/tray-truth --scene spheres --gloss satin --seed 7
    python scripts/simulate.py --output captures/jar --truth captures/jar-truth --preset object
    python scripts/simulate.py --output captures/satin --truth captures/satin-truth --preset satin

The capture folder is what a studio would hand over: photographs of the object and of a white board under each lamp,
dark frames, and tables of the lamps, of the camera's sensitivities and of the lamp's spectrum. The truth folder holds
what no studio knows: normals, height, spectra, roughness, shadows, and noise-free colours under the check lights. A
turntable capture holds two pictures a view (circular polarisers not crossed and crossed), camera matrices and a scan;
that of a cloth small photographs from a gonioreflectometer.
"""

import argparse
import csv
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from nishiki.capture.seal import seal
from nishiki.errors import UserError
from nishiki.simulate.cloth import capture_folder as cloth_folder
from nishiki.simulate.cloth.presets import PRESETS as CLOTHS
from nishiki.simulate.cloth.presets import GoniometerSettings
from nishiki.simulate.settings import (
    BODIES,
    PRESETS,
    RELIEFS,
    ROUGHNESS,
    SCENES,
    CameraSettings,
    LightSettings,
    SimulationSettings,
)
from nishiki.simulate.turntable import capture_folder as turntable_folder
from nishiki.simulate.turntable.settings import PRESETS as OBJECTS
from nishiki.simulate.turntable.settings import TurntableSettings

DARK_FRAMES = 3
_FINISHES = ", ".join(f"{name} {alpha:g}" for name, alpha in ROUGHNESS.items())
_POLARISERS = ("circular", "none")
_NUMBER, _COUNT, _FLAG = {"type": float}, {"type": int}, {"action": "store_true"}
OPTIONS = {
    "size": (
        (
            "preset",
            "painting 384×512 (default), tiny 64×96, large 1536×2048, full 3000×4000; on a turntable: object "
            "36 views of 384×384, object-tiny 12 of 96×96, object-large 36 of 3000×4000; cloths: satin, twill, plain "
            "5940 photographs of 48×48, satin-tiny 176 of 24×24",
            {"choices": (*PRESETS, *OBJECTS, *CLOTHS), "default": "painting"},
        ),
        ("rows", "camera pixels, instead of the preset's", _COUNT),
        ("columns", "camera pixels, instead of the preset's", _COUNT),
        ("pitch-mm", "size of a camera pixel on the object (0.2; cloths 0.25)", {**_NUMBER, "default": 0.2}),
        ("supersampling", "points a pixel in each direction (2; object 4)", _COUNT),
    ),
    "object": (
        ("scene", "what is photographed (painting)", {"choices": SCENES, "default": "painting"}),
        ("relief", "flat, thin paint on canvas, or thick paint (impasto)", {"choices": RELIEFS, "default": "impasto"}),
        ("relief-gain", "all heights times this (1)", {**_NUMBER, "default": 1.0}),
        ("gloss", f"finish, by GGX roughness: {_FINISHES} (varnish)", {"choices": ROUGHNESS, "default": "varnish"}),
        ("roughness", "GGX roughness instead of the finish's, 0.02 to 1", _NUMBER),
        (
            "body",
            "rough: Oren-Nayar under a refracting surface; lambert: ideal (rough)",
            {"choices": BODIES, "default": "rough"},
        ),
        ("no-bounce", "leave out light reflected from one part of the relief to another", _FLAG),
    ),
    "lamps": (
        ("rings", "rings of lamps; one stands at 45°, more at 30° to 60° (1)", {**_COUNT, "default": 1}),
        ("ring-lights", "lamps in a ring (8)", {**_COUNT, "default": 8}),
        ("no-top", "no lamp beside the camera", _FLAG),
        (
            "checks",
            "incidence of the lamps that are kept for evaluation (20 30 50 60); none: no values",
            {**_NUMBER, "nargs": "*", "default": [20.0, 30.0, 50.0, 60.0], "metavar": "DEGREES"},
        ),
        ("distance-mm", "from the lamp to the centre of the object (80 half diagonals)", _NUMBER),
        (
            "lights-as",
            "what the capture tells of the lamps (direction; on a turntable position, or camera: beside the camera)",
            {"choices": ("direction", "position", "camera")},
        ),
        ("lamp-diameter-deg", "size of the lamp seen from the object (1.5)", {**_NUMBER, "default": 1.5}),
    ),
    "camera": (
        ("channels", "3 = red, green, blue; up to 8 bands (3)", {**_COUNT, "default": 3}),
        ("bits", "of the converter (12)", {**_COUNT, "default": 12}),
        (
            "white-level",
            "share of full scale of a white facing the lamp; more saturates more highlights (0.7; object 0.5)",
            _NUMBER,
        ),
        ("no-noise", "quantised, but without shot and read noise", _FLAG),
        ("format", "of the photographs (png for 3 channels, tiff for more)", {"choices": ("png", "tiff")}),
    ),
    "turntable": (
        ("views", "over a full turn, instead of the preset's", _COUNT),
        ("polariser", "circular: two pictures a view (default)", {"choices": _POLARISERS, "default": "circular"}),
        ("silhouettes", "of every view: given (default) or not", {"choices": ("given", "none"), "default": "given"}),
        ("mesh", "in the capture: a scan (default) or none", {"choices": ("scan", "none"), "default": "scan"}),
        ("mesh-noise-mm", "of the scan, along the normal (0.02)", _NUMBER),
        ("triangles", "of the object, instead of the preset's", _COUNT),
        ("scan-triangles", "of the scan, where not the object's own", _COUNT),
    ),
    "cloth": (
        ("harness", "yarns of a repeat (satin 5: 5 and 7 to 10 or 12; twill 4)", _COUNT),
        ("flatness", "exponent of the warp's section, 2 = ellipse (satin about 2.6)", _NUMBER),
        ("arch-deg", "steepest slope of the arch of a float (satin 8)", _NUMBER),
        ("filaments", "roughness along and across them (silk)", {"choices": cloth_folder.CHOICES["filaments"]}),
        ("dye", "of the first cloth (black)", {"choices": cloth_folder.CHOICES["dye"]}),
        ("two-cloths", "a second one beside the first, weft on top, dyed gold, with a picture of the regions", _FLAG),
    ),
}


def main(arguments: list[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    try:
        defaults = parser().parse_args(["--output", "", "--truth", ""])
        given = [name for name in cloth_folder.OWN if getattr(options, name) != getattr(defaults, name)]
        if given and options.preset not in CLOTHS:
            option = f"--{given[0].replace('_', '-')}"
            raise UserError(f"{option} with --preset {options.preset}: expected one of {', '.join(CLOTHS)}")
        if options.preset in OBJECTS:
            settings = turntable_folder.settings_from(options, defaults)
        elif options.preset in CLOTHS:
            settings = cloth_folder.settings_from(options, defaults)
        else:
            settings = settings_from(options)
        simulate(settings, Path(options.output), Path(options.truth), options)
    except UserError as error:
        print(f"simulate: {error}", file=sys.stderr)
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    text = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    text.add_argument("--output", required=True, metavar="FOLDER", help="capture folder to make; must not exist yet")
    text.add_argument("--truth", required=True, metavar="FOLDER", help="folder for the truth; must not exist yet")
    text.add_argument("--seed", type=int, default=1, help="another seed: another object, lamps, noise (default 1)")
    for title, rows in OPTIONS.items():
        group = text.add_argument_group(title)
        for name, help_text, extra in rows:
            group.add_argument(f"--{name}", help=help_text, **extra)
    return text


def settings_from(options) -> SimulationSettings:
    """The settings that the command line asks for."""
    if options.lights_as == "camera" or any(getattr(options, name) is not None for name in turntable_folder.OWN):
        raise UserError(
            f"options of the turntable with --preset {options.preset}: expected one of {', '.join(OBJECTS)}"
        )
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
        pitch_mm=options.pitch_mm,
        supersampling=2 if options.supersampling is None else options.supersampling,
        bounce=not options.no_bounce,
        camera=CameraSettings(
            channels=options.channels,
            bits=options.bits,
            white_level=0.7 if options.white_level is None else options.white_level,
            noise=not options.no_noise,
        ),
        lights=LightSettings(
            rings=options.rings,
            ring_lights=options.ring_lights,
            top=not options.no_top,
            checks_deg=tuple(options.checks),
            distance_mm=options.distance_mm,
            angular_diameter_deg=options.lamp_diameter_deg,
        ),
    )


def simulate(
    settings: SimulationSettings | TurntableSettings | GoniometerSettings, output: Path, truth: Path, options
) -> None:
    """Make both folders under temporary names, then rename them: a killed run leaves no half capture."""
    for folder in (output, truth):
        if folder.exists() or folder.is_symlink():
            raise UserError(f"{folder}: expected no such folder yet, found one; remove it or choose another name")
    if truth.resolve().is_relative_to(output.resolve()):
        raise UserError(f"{truth}: the truth must lie outside the capture {output}; choose another folder")
    image_format = options.format or ("png" if settings.camera.channels == 3 else "tiff")
    if image_format == "png" and settings.camera.channels != 3:
        raise UserError(f"--format png holds 3 channels, found {settings.camera.channels}; use --format tiff")
    drafts = []
    try:
        for folder in (output, truth):
            folder.parent.mkdir(parents=True, exist_ok=True)
            drafts.append(folder.with_name(f".{folder.name}.{os.getpid()}.part"))
            drafts[-1].mkdir()
        if isinstance(settings, TurntableSettings):
            turntable_folder.write_all(settings, *drafts, options, Progress(), write_image, write_csv)
        elif isinstance(settings, GoniometerSettings):
            cloth_folder.write_all(settings, *drafts, options, Progress(), write_image, write_csv)
        else:
            lights_as = options.lights_as or "direction"
            write_all(settings, *drafts, image_format=image_format, lights_as=lights_as)
        seal(drafts[0])
        drafts[1].rename(truth)
        drafts[0].rename(output)
    finally:
        for draft in drafts:
            shutil.rmtree(draft, ignore_errors=True)


def write_all(settings, capture: Path, truth: Path, *, image_format: str, lights_as: str) -> None:
    from nishiki.simulate.lamp import place_lamps
    from nishiki.simulate.objects import make_object
    from nishiki.simulate.photographs import dark_frame, make_tables, photograph, white_board

    report = Progress()
    thing = make_object(settings)
    report(f"object: {settings.rows}×{settings.columns} pixels, relief {thing.ceiling_mm:.2f} mm")
    lamps = place_lamps(settings)
    plain, full = (make_tables(thing, settings, with_truth=flag) for flag in (False, True))
    store = TruthStore(truth, settings, thing, lamps)
    frames = []
    for lamp in lamps:
        shot = photograph(thing, lamp, settings, full if lamp.role == "check" else plain)
        store.add(lamp, shot)
        for role, codes in ((lamp.role, shot.codes), ("white", white_board(lamp, settings, plain))):
            file = f"{'white' if role == 'white' else 'frames'}/{lamp.name}.{image_format}"
            write_image(capture / file, codes)
            frames.append((file, role, lamp.name))
        report(f"light {lamp.name}")
    for index in range(1, DARK_FRAMES + 1):
        file = f"dark/{index}.{image_format}"
        write_image(capture / file, dark_frame(index, settings))
        frames.append((file, "dark", ""))
    write_tables(capture, settings, lamps, frames, lights_as)
    store.finish()
    report("capture and truth written", end="\n")


class Progress:
    """One line on the terminal that is written over."""

    def __init__(self):
        self.start = time.monotonic()

    def __call__(self, text: str, end: str = "") -> None:
        print(f"\r\033[K{time.monotonic() - self.start:5.1f} s  {text}", end=end, file=sys.stderr, flush=True)


def write_image(path: Path, codes: np.ndarray) -> None:
    """16-bit PNG of RGB, or TIFF with one page a channel."""
    import cv2

    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".png":
        done = cv2.imwrite(str(path), codes[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    else:
        pages = [np.ascontiguousarray(codes[..., channel]) for channel in range(codes.shape[2])]
        done = cv2.imwritemulti(str(path), pages, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    if not done:
        raise UserError(f"{path}: could not be written; is the disk full?")


def write_tables(capture: Path, settings, lamps, frames, lights_as: str) -> None:
    """capture.yaml, frames.csv, the lamps and the spectra."""
    import yaml

    from nishiki.simulate.describe import capture_description, light_lines, light_table, spectra_tables

    text = yaml.safe_dump(capture_description(settings, lights_as=lights_as), sort_keys=False)
    (capture / "capture.yaml").write_text(text)
    write_csv(capture / "frames.csv", [("file", "role", "light"), *frames])
    if lights_as == "direction":
        (capture / "lights.lp").write_text("\n".join(light_lines(lamps)) + "\n")
    else:
        write_csv(capture / "lights.csv", light_table(lamps))
    (capture / "spectra").mkdir()
    for name, rows in spectra_tables(settings).items():
        write_csv(capture / "spectra" / name, rows)


def write_csv(path: Path, rows) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


class TruthStore:
    """truth.zarr, filled light by light, and a README that says what is in it."""

    def __init__(self, folder: Path, settings, thing, lamps):
        import zarr

        from nishiki.simulate.photographs import WAVELENGTHS_NM, true_spectra

        self.folder, self.settings, self.lamps = folder, settings, lamps
        self.checks = [lamp.name for lamp in lamps if lamp.role == "check"]
        self.names = [lamp.name for lamp in lamps]
        self.group = zarr.open_group(folder / "truth.zarr", mode="w", zarr_format=3)
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

    def make(self, name: str, shape, dtype):
        chunks = (1, min(256, shape[1]), *shape[2:]) if len(shape) > 2 else shape
        return self.group.create_array(name, shape=shape, dtype=dtype, chunks=chunks)

    def put(self, name: str, values: np.ndarray) -> None:
        chunks = (min(256, values.shape[0]), *values.shape[1:])
        self.group.create_array(name, shape=values.shape, dtype=values.dtype, chunks=chunks)[...] = values

    def add(self, lamp, shot) -> None:
        self.group["lit"][self.names.index(lamp.name)] = shot.lit
        if lamp.role == "check":
            for name in ("xyz_lamp", "xyz_d65", "gloss", "body"):
                self.group[name][self.checks.index(lamp.name)] = getattr(shot, name)

    def finish(self) -> None:
        from nishiki.simulate.describe import truth_attributes, truth_readme

        self.group.attrs.update(truth_attributes(self.settings, self.lamps))
        (self.folder / "README.md").write_text(truth_readme(self.settings, self.lamps))
