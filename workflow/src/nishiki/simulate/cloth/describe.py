"""What the tables of a goniometer capture and of its truth say: values and text, no files."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from nishiki.simulate.cloth.presets import GoniometerSettings
from nishiki.simulate.cloth.reflectance import Cloth
from nishiki.simulate.cloth.sections import sections, slopes

REGION_NAMES = ("ground", "figure")
HEADING = ("file", "role", "theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg", "exposure_s")


def capture_description(settings: GoniometerSettings, *, regions_pitch_mm: float | None = None) -> dict:
    """The contents of capture.yaml; regions_pitch_mm where there is a label picture regions.png."""
    cloth, camera = settings.cloths[0], settings.camera
    block = {
        "white_reflectance": settings.white_reflectance,
        "crop_px": min(settings.rows, settings.columns),
        "symmetry": "quarter",
        "weave": cloth.weave,
    }
    if regions_pitch_mm is not None:
        block |= {
            "regions": "regions.png",
            "region_names": {name: label + 1 for label, name in enumerate(REGION_NAMES)},
            "regions_pitch_mm": regions_pitch_mm,
            "pixel_pitch_mm": settings.pitch_mm,
            "upright": "cloth",
        }
    return {
        "format": 1,
        "title": f"Simulated {cloth.harness}-harness {cloth.weave} (seed {settings.seed})",
        "geometry": "goniometer",
        "camera": {
            "model": "simulated camera",
            "channels": list(cloth.channels),
            "encoding": "linear",
            "bits": camera.bits,
            "saturation": 0.98,
            "black_level": camera.black_level,
        },
        "goniometer": block,
    }


def frame_row(file: str, role: str, angles_deg, exposure_s: float | None) -> tuple:
    """A row of frames.csv; angles_deg : four numbers, those that are not given are empty."""
    angles = ["" if angle is None else f"{angle:g}" for angle in angles_deg]
    return (file, role, *angles, "" if exposure_s is None else f"{exposure_s:.9g}")


def geometry(cloth: Cloth) -> dict:
    """Contents of a geometry file of the truth folder: settings, how the yarns were laid, sections, slopes."""
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
        "sections": sections(cloth.solids),
        "slopes": slopes(cloth),
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
| `sections` | weft plane (x, z) along weft yarns, warp plane (y, z) along warp yarns of a repeat: outline of the yarn \
that runs `along`, outlines of those `across`, and the `surface`, the highest point of the cloth at each place |
| `slopes` | share of the cell's area, seen from above, by the slope of its facets in either plane |

`cloth.png` (`cloth-2.png`): the cloth through a microscope, lit from the upper left.
"""
