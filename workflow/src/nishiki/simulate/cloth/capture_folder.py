"""Files of a simulated goniometer capture, and of the truth behind it (see `nishiki.simulate.command`)."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.cloth.photographs import photographs, region_labels, white_board
from nishiki.simulate.cloth.reflectance import Cloth, make_cloth
from nishiki.simulate.cloth.settings import PRESETS, GoniometerSettings, preset
from nishiki.simulate.folders import DARK_FRAMES, write_csv, write_description, write_image
from nishiki.simulate.randomness import subkey
from nishiki.simulate.sensor import dark_frame
from nishiki.simulate.settings import CameraSettings, camera_from

REGION_NAMES = ("ground", "figure")
HEADING = ("file", "role", "theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg", "exposure_s")


def settings_from(options) -> GoniometerSettings:
    """The settings that the command line asks for."""
    values = {"seed": options.seed, "regions": options.two_cloths}
    for name in ("rows", "columns", "pitch_mm", "harness", "flatness", "arch_deg", "filaments", "dye"):
        if getattr(options, name) is not None:
            values[name] = getattr(options, name)
    if options.no_bounce:
        values["bounces"] = 0
    if options.harness is not None and PRESETS[options.preset] == "plain":
        raise UserError("--harness: a plain weave has 2, found another number; leave it out")
    return preset(options.preset, **values, camera=camera_from(options, CameraSettings()))


def write_all(settings: GoniometerSettings, capture: Path, truth: Path, options, report) -> None:
    """Both folders; report(text) tells the progress."""
    quality = {name: getattr(settings, name) for name in ("candidates", "chains", "bounces")}
    cloths = tuple(make_cloth(cloth, **quality) for cloth in settings.cloths)
    report(f"cloth: {sum(len(cloth.points.area) for cloth in cloths)} points")
    angles = settings.angles_deg
    rows, reflectance = [None] * len(angles), np.zeros((len(angles), len(cloths), len(settings.cloths[0].channels)))
    for done, shot in enumerate(photographs(cloths, settings), start=1):
        file = f"frames/{shot.row + 1:05d}.{options.format}"
        write_image(capture / file, shot.codes)
        rows[shot.row] = frame_row(file, "sample", angles[shot.row], shot.exposure_s)
        reflectance[shot.row] = shot.reflectance
        if done % 100 == 0:
            report(f"{done} of {len(angles)} photographs")
    for number, (theta, phi) in enumerate(np.unique(angles[:, :2], axis=0), start=1):
        codes, exposure = white_board(number, theta, settings)
        write_image(capture / f"white/{number}.{options.format}", codes)
        rows.append(frame_row(f"white/{number}.{options.format}", "white", (theta, phi, None, None), exposure))
    for number in range(1, DARK_FRAMES + 1):
        codes = dark_frame(codes.shape, settings.camera, key=subkey(settings.seed, f"cloth dark {number}"))
        write_image(capture / f"dark/{number}.{options.format}", codes)
        rows.append(frame_row(f"dark/{number}.{options.format}", "dark", (None,) * 4, None))
    write_csv(capture / "frames.csv", [HEADING, *rows])
    describe_capture(capture, settings)
    np.savez(truth / "truth.npz", angles_deg=settings.angles_deg, reflectance=reflectance)
    for number, cloth in enumerate(cloths, start=1):
        suffix = "" if number == 1 else f"-{number}"
        (truth / f"geometry{suffix}.json").write_text(json.dumps(geometry(cloth)) + "\n")
    (truth / "README.md").write_text(truth_readme(settings))


def describe_capture(capture: Path, settings: GoniometerSettings) -> None:
    """capture.yaml, and the label picture of two cloths."""
    cloth = settings.cloths[0]
    block = {
        "white_reflectance": settings.white_reflectance,
        "crop_px": min(settings.rows, settings.columns),
        "symmetry": "quarter",
        "weave": cloth.weave,
    }
    if len(settings.cloths) > 1:
        labels, pitch = region_labels(settings)
        write_image(capture / "regions.png", labels.astype(np.uint8))
        block |= {
            "regions": "regions.png",
            "region_names": {name: label + 1 for label, name in enumerate(REGION_NAMES)},
            "regions_pitch_mm": pitch,
            "pixel_pitch_mm": settings.pitch_mm,
            "upright": "cloth",
        }
    title = f"Simulated {cloth.harness}-harness {cloth.weave} (seed {settings.seed})"
    write_description(capture, title, "goniometer", cloth.channels, settings.camera, goniometer=block)


def frame_row(file: str, role: str, angles_deg, exposure_s: float | None) -> tuple:
    """A row of frames.csv; angles_deg : four numbers, those that are not given are empty."""
    angles = ["" if angle is None else f"{angle:g}" for angle in angles_deg]
    return (file, role, *angles, "" if exposure_s is None else f"{exposure_s:.9g}")


def geometry(cloth: Cloth) -> dict:
    """Contents of a geometry file of the truth folder: settings, and how the yarns were laid."""
    systems = {}
    for name, yarns in (("warp", cloth.solids.warp), ("weft", cloth.solids.weft)):
        way = yarns.descent
        systems[name] = {
            "spacing_mm": yarns.spacing,
            "offset_halfwidth_halfthickness_mm": np.round(yarns.shape, 6).tolist(),
            "exponent": yarns.exponent,
            "descent": {
                "width_mm": way.width,
                "height_mm": way.height,
                "angle_deg": float(np.degrees(way.angle)),
                "radius_mm": way.radius,
                "straight_mm": way.straight,
            },
        }
    return {
        "settings": asdict(cloth.settings),
        "pattern": cloth.solids.pattern.astype(int).tolist(),
        "yarns": systems,
    }


def truth_readme(settings: GoniometerSettings) -> str:
    """Text of the README in a truth folder."""
    cloths = "; ".join(f"{c.harness}-harness {c.weave}, {c.face} on top" for c in settings.cloths)
    return f"""# Truth of a simulated goniometer capture

{cloths}. Seed {settings.seed}, {len(settings.angles_deg)} photographs of {settings.rows} × {settings.columns} pixels, \
{settings.pitch_mm:g} mm each. Use it to judge results, never to fit.

`truth.npz`:

| array | shape | meaning |
|---|---|---|
| `angles_deg` | measurements, 4 | theta_i, phi_i, theta_r, phi_r, in the order of frames.csv |
| `reflectance` | measurements, cloths, channels | noise-free BRDF, 1/sr; mean over the whole cell of the cloth |

`geometry.json` (of a second cloth `geometry-2.json`), lengths in mm, x along the weft, y along the warp, z up:

| key | meaning |
|---|---|
| `settings` | the cloth's: weave, yarns, roughness of the filaments, albedo of the dye |
| `pattern` | weft yarns × warp yarns of the cell, 1 where the warp is on top |
| `yarns` | of warp and weft: spacing; sideways offset, half width and half thickness of every yarn; exponent of the \
section; the way from side to side of the cloth (two arcs of `angle_deg` and `radius_mm`, `straight_mm` between) |
"""
