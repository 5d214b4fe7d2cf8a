"""Files of a simulated goniometer capture, and of the truth behind it (see `nishiki.simulate.command`)."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.cloth.presets import DYES, FILAMENTS, PRESETS, GoniometerSettings, preset
from nishiki.simulate.settings import CameraSettings

DARK_FRAMES = 3
# Options that mean something else, or nothing, on a goniometer.
FOREIGN = ("scene", "relief", "relief_gain", "gloss", "roughness", "body", "rings", "ring_lights", "no_top", "checks")
FOREIGN += ("distance_mm", "lights_as", "lamp_diameter_deg", "channels", "supersampling", "views", "polariser")
FOREIGN += ("silhouettes", "mesh", "mesh_noise_mm", "triangles", "scan_triangles")
OWN = ("harness", "flatness", "arch_deg", "filaments", "dye", "two_cloths")  # options of cloths only
CHOICES = {"filaments": tuple(FILAMENTS), "dye": tuple(DYES)}


def settings_from(options, defaults) -> GoniometerSettings:
    """The settings that the command line asks for; `defaults` are the values of options that were not given."""
    for name in FOREIGN:
        if getattr(options, name) != getattr(defaults, name):
            option = f"--{name.replace('_', '-')}"
            raise UserError(f"{option} does not belong to cloths, found with --preset {options.preset}; leave it out")
    values = {"seed": options.seed, "regions": options.two_cloths}
    for name in ("rows", "columns", "harness", "flatness", "arch_deg", "filaments", "dye"):
        if getattr(options, name) is not None:
            values[name] = getattr(options, name)
    if options.pitch_mm != defaults.pitch_mm:
        values["pitch_mm"] = options.pitch_mm
    if options.no_bounce:
        values["bounces"] = 0
    camera = CameraSettings(bits=options.bits, noise=not options.no_noise)
    if options.white_level is not None:
        camera = dataclasses.replace(camera, white_level=options.white_level)
    if options.harness is not None and PRESETS[options.preset] == "plain":
        raise UserError("--harness: a plain weave has 2, found another number; leave it out")
    return preset(options.preset, **values, camera=camera)


def write_all(settings: GoniometerSettings, capture: Path, truth: Path, options, report, write_image, write_csv):
    """Both folders. report(text) tells the progress; write_image, write_csv are those of `nishiki.simulate.command`."""
    import yaml

    from nishiki.simulate.cloth import describe
    from nishiki.simulate.cloth.photographs import dark_frame, photographs, region_labels, white_board
    from nishiki.simulate.cloth.reflectance import make_cloth

    image_format = options.format or "png"
    quality = {name: getattr(settings, name) for name in ("candidates", "chains", "bounces")}
    cloths = tuple(make_cloth(cloth, **quality) for cloth in settings.cloths)
    report(f"cloth: {sum(len(cloth.points.area) for cloth in cloths)} points")
    angles = settings.angles_deg
    rows, reflectance = [None] * len(angles), np.zeros((len(angles), len(cloths), len(settings.cloths[0].channels)))
    for done, shot in enumerate(photographs(cloths, settings), start=1):
        file = f"frames/{shot.row + 1:05d}.{image_format}"
        write_image(capture / file, shot.codes)
        rows[shot.row] = describe.frame_row(file, "sample", angles[shot.row], shot.exposure_s)
        reflectance[shot.row] = shot.reflectance
        if done % 100 == 0:
            report(f"{done} of {len(angles)} photographs")
    for number, (theta, phi) in enumerate(np.unique(angles[:, :2], axis=0), start=1):
        codes, exposure = white_board(number, theta, settings)
        write_image(capture / f"white/{number}.{image_format}", codes)
        rows.append(describe.frame_row(f"white/{number}.{image_format}", "white", (theta, phi, None, None), exposure))
    for number in range(1, DARK_FRAMES + 1):
        write_image(capture / f"dark/{number}.{image_format}", dark_frame(number, settings))
        rows.append(describe.frame_row(f"dark/{number}.{image_format}", "dark", (None,) * 4, None))
    write_csv(capture / "frames.csv", [describe.HEADING, *rows])
    pitch = None
    if len(cloths) > 1:
        labels, pitch = region_labels(settings)
        write_labels(capture / "regions.png", labels)
    text = describe.capture_description(settings, regions_pitch_mm=pitch)
    (capture / "capture.yaml").write_text(yaml.safe_dump(text, sort_keys=False))
    write_truth(settings, cloths, truth, reflectance)
    report("capture and truth written", end="\n")


def write_labels(path: Path, labels: np.ndarray) -> None:
    """A label picture as 8-bit PNG."""
    import cv2

    if not cv2.imwrite(str(path), labels.astype(np.uint8)):
        raise UserError(f"{path}: could not be written; is the disk full?")


def write_truth(settings: GoniometerSettings, cloths, truth: Path, reflectance: np.ndarray) -> None:
    """Everything that no laboratory knows."""
    from nishiki.simulate.cloth import describe

    np.savez(truth / "truth.npz", angles_deg=settings.angles_deg, reflectance=reflectance)
    for number, cloth in enumerate(cloths, start=1):
        suffix = "" if number == 1 else f"-{number}"
        (truth / f"geometry{suffix}.json").write_text(json.dumps(describe.geometry(cloth)) + "\n")
        write_picture(truth / f"cloth{suffix}.png", cloth)
    (truth / "README.md").write_text(describe.truth_readme(settings))


def write_picture(path: Path, cloth) -> None:
    """The cloth through a microscope, some repeats of it: from above on the left, obliquely on the right."""
    import cv2

    from nishiki.simulate.cloth.closeup import close_up
    from nishiki.simulate.cloth.directions import unit

    solids, size = cloth.solids, 240
    pitch = 1.2 * max(solids.warp.length, solids.weft.length) / size
    views = [
        close_up(cloth, unit(theta_i, 120.0), unit(theta_r, 250.0), rows=size, columns=size, pitch_mm=pitch, samples=2)
        for theta_i, theta_r in ((25.0, 0.0), (50.0, 40.0))
    ]
    picture = np.hstack([view / max(np.quantile(view, 0.995), 1e-9) for view in views])
    codes = np.rint(255.0 * np.clip(picture, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)
    if not cv2.imwrite(str(path), codes[..., ::-1]):
        raise UserError(f"{path}: could not be written; is the disk full?")
