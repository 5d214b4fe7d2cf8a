"""What the tables of a capture folder and of a truth folder say: values and text, no files."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from nishiki.simulate.lamp import Lamp, direction_error_deg, planck_spectrum
from nishiki.simulate.palette import REGIONS
from nishiki.simulate.photographs import BOARD_REFLECTANCE
from nishiki.simulate.sensor import channel_names, sensitivities
from nishiki.simulate.settings import SimulationSettings


def capture_description(settings: SimulationSettings, *, lights_as: str) -> dict:
    """The contents of capture.yaml; `lights_as` is "direction" or "position"."""
    camera = settings.camera
    directions = lights_as == "direction"
    return {
        "format": 1,
        "title": f"Simulated {settings.scene} (seed {settings.seed})",
        "geometry": "plane",
        "camera": {
            "model": "simulated camera",
            "channels": list(channel_names(camera.channels)),
            "encoding": "linear",
            "bits": camera.bits,
            "saturation": 0.98,
            "black_level": camera.black_level,
            "sensitivities": "spectra/camera.csv",
        },
        "illuminant": "spectra/illuminant.csv",
        "lights": {
            "file": "lights.lp" if directions else "lights.csv",
            "kind": "direction" if directions else "position_mm",
        },
        "white": {"reflectance": BOARD_REFLECTANCE, "normal": [0, 0, 1]},
        "pixel_pitch_mm": settings.pitch_mm,
    }


def light_lines(lamps: tuple[Lamp, ...]) -> list[str]:
    """Lines of lights.lp: the count, then name and unit direction."""
    return [str(len(lamps)), *(f"{lamp.name} " + " ".join(f"{v:.6f}" for v in lamp.direction) for lamp in lamps)]


def light_table(lamps: tuple[Lamp, ...]) -> list[tuple]:
    """Rows of lights.csv, header first: name and position in mm."""
    return [("light", "x", "y", "z"), *((lamp.name, *(f"{v:.3f}" for v in lamp.position_mm)) for lamp in lamps)]


def spectra_tables(settings: SimulationSettings) -> dict[str, list[tuple]]:
    """Rows of the two tables of spectra by file name, header first, 380 to 780 nm every 5 nm."""
    nm = np.arange(380.0, 780.5, 5.0)
    curves = sensitivities(nm, settings.camera.channels)
    power = planck_spectrum(nm, settings.lights.colour_temperature_k)
    names = channel_names(settings.camera.channels)
    return {
        "camera.csv": [
            ("wavelength_nm", *names),
            *((f"{w:g}", *(f"{v:.6f}" for v in column)) for w, column in zip(nm, curves.T, strict=True)),
        ],
        "illuminant.csv": [
            ("wavelength_nm", "power"),
            *((f"{w:g}", f"{p:.6f}") for w, p in zip(nm, power, strict=True)),
        ],
    }


def truth_attributes(settings: SimulationSettings, lamps: tuple[Lamp, ...]) -> dict:
    """Attributes of truth.zarr: names of lights, checks and regions, lamp positions, the settings."""
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


def truth_readme(settings: SimulationSettings, lamps: tuple[Lamp, ...]) -> str:
    """Text of the README in a truth folder."""
    mean, largest = direction_error_deg(settings)
    checks = ", ".join(lamp.name for lamp in lamps if lamp.role == "check") or "none"
    return f"""# Truth of a simulated capture

Scene {settings.scene}, seed {settings.seed}, {settings.rows} × {settings.columns} pixels of {settings.pitch_mm:g} mm,
relief {settings.relief}, finish {settings.gloss}. Use it to judge results, never to fit.

`truth.zarr` (Zarr v3; rows and columns are camera pixels, row 0 at the top):

| array | shape | meaning |
|---|---|---|
| `normals` | rows, columns, 3 | unit normal (x right, y up, z to the camera): normalised mean over the pixel's area |
| `height_mm` | rows, columns | height, mean over the pixel |
| `steepest` | rows, columns | steepest slope inside the pixel, radians |
| `labels` | rows, columns, {settings.supersampling**2} | paint of each sample inside the pixel |
| `regions` | rows, columns | region of the paint at the pixel's centre; names in the attribute `regions` |
| `spectra` | paints, 61 | reflectance of each paint at `wavelengths_nm`; a pixel's is the mean over its `labels` |
| `roughness` | paints | GGX alpha of the varnish over each paint |
| `lit` | lights, rows, columns | percent of the pixel that the lamp lights (0 = in shadow); all lights |
| `xyz_lamp`, `xyz_d65` | checks, rows, columns, 3 | noise-free colour under the check light: lamp's spectrum, D65 |
| `gloss`, `body` | checks, rows, columns | mirror reflection (the same at all wavelengths) and body reflection (as Y) |

Colours are relative to a perfect white diffuser facing the lamp (Y = 1), like white-normalised observations.
Check lights: {checks}. Other attributes: lights, directions, positions in mm, settings.

Where the capture gives one direction a lamp, it is that from the centre of the object. The lamps stand
{settings.distance_mm:.0f} mm away, so the true direction at a pixel differs from it by {mean:.2f}° in the mean
and by {largest:.2f}° at most.
"""
