"""Small goniometer captures for tests: valid by default, broken on request."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml
from captures import CHANNELS, edit_yaml, write_frame

from nishiki.goniometry.directions import unit

HEADING = "file,role,theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,exposure_s"
WHITE = 0.98
LAMP = 0.5  # of full scale in one second, from a perfect white lit along its normal


def cloth(incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """A BRDF (..., 3), sr^-1: dye and an elongated gloss lobe round the half vector; symmetric in both planes."""
    half = incident + outgoing
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    slopes = half[..., :2] / half[..., 2:]
    gloss = 0.5 * np.exp(-((slopes[..., 0] / 0.30) ** 2) - (slopes[..., 1] / 0.12) ** 2)
    return np.array([0.05, 0.03, 0.02]) + gloss[..., None]


def quarter_views(polar: int = 5, azimuth: int = 7, steepest: float = 75.0) -> list[tuple[float, float]]:
    """(theta_r, phi_r) in degrees over a quarter of the hemisphere."""
    thetas, phis = np.linspace(0, steepest, polar), np.linspace(0, 90, azimuth)
    return [(float(t), float(p)) for t in thetas for p in (phis if t > 0 else phis[:1])]


def directions(angles_deg) -> tuple[np.ndarray, np.ndarray]:
    """Incident and outgoing (n, 3) of rows theta_i, phi_i, theta_r, phi_r in degrees."""
    a = np.radians(np.asarray(angles_deg, np.float64))
    return unit(a[:, 0], a[:, 1]), unit(a[:, 2], a[:, 3])


def make_goniometer(
    folder: Path,
    *,
    samples: list[tuple[float, float, float, float]] | None = None,
    whites: list[tuple] = ((0, 0, "", ""),),
    brdf: Callable = cloth,
    picture: Callable | None = None,
    exposure_s: float | None = None,
    white_exposure_s: float | None = None,
    dark: bool = True,
    rows: int = 20,
    columns: int = 24,
    bits: int = 16,
    noise: float = 0.0,
    goniometer: dict | None = None,
    yaml_extra: dict | None = None,
) -> Path:
    """Write an unsealed capture: frames s0, s1 ... of the cloth, w0 ... of a diffuse board of 98 %, 16-bit PNG.

    A sample's code is proportional to brdf * cos(theta_i) * exposure; picture(angles, values) gives (rows, columns, 3)
    BRDF values of a photograph instead of an even one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    samples = [(0.0, 0.0, t, p) for t, p in quarter_views()] if samples is None else samples
    top, level = (1 << bits) - 1, 100 if dark else 0
    rng = np.random.default_rng(5)
    lines = [HEADING]

    def keep(file: str, role: str, radiance: np.ndarray, angles: tuple, seconds: float | None) -> None:
        light = radiance * np.ones((rows, columns, 3)) * LAMP * np.pi * (seconds or 1.0)
        light = light * (1 + noise * rng.standard_normal(light.shape))
        write_frame(folder / file, level + top * light)
        lines.append(",".join([file, role, *(f"{a}" for a in angles), f"{seconds or ''}"]))

    incident, outgoing = directions(samples)
    for i, (angles, values) in enumerate(zip(samples, brdf(incident, outgoing), strict=True)):
        radiance = (values if picture is None else picture(angles, values)) * incident[i, 2]
        keep(f"frames/s{i}.png", "sample", radiance, angles, exposure_s)
    for i, angles in enumerate(whites):
        radiance = np.full(3, WHITE / np.pi * np.cos(np.radians(angles[0])))
        keep(f"white/w{i}.png", "white", radiance, angles, white_exposure_s or exposure_s)
    if dark:
        write_frame(folder / "dark/dark.png", np.full((rows, columns, 3), float(level)))
        lines.append("dark/dark.png,dark,,,,,")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    settings = {
        "format": 1,
        "title": "Test cloth",
        "geometry": "goniometer",
        "camera": {"channels": list(CHANNELS), "encoding": "linear", "bits": bits},
        "goniometer": {"white_reflectance": WHITE, "crop_px": 16, "weave": "satin"} | (goniometer or {}),
    }
    (folder / "capture.yaml").write_text(yaml.safe_dump(settings | (yaml_extra or {}), sort_keys=False))
    return folder


def make_table(folder: Path, *, rows: str | None = None, goniometer: dict | None = None) -> Path:
    """Write an unsealed capture with a table of reflectances instead of photographs."""
    folder.mkdir(parents=True, exist_ok=True)
    angles = [(ti, 0.0, t, p) for ti in (0.0, 30.0) for t, p in quarter_views()]
    values = cloth(*directions(angles))
    lines = [",".join(map(repr, [*a, *map(float, v)])) for a, v in zip(angles, values, strict=True)]
    heading = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,red,green,blue"
    (folder / "reflectances.csv").write_text("\n".join([heading, *lines]) + "\n" if rows is None else rows)
    block = {"table": "reflectances.csv", "weave": "satin"} | (goniometer or {})
    settings = {"format": 1, "title": "Table", "geometry": "goniometer", "goniometer": block}
    (folder / "capture.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    return folder


def edit_goniometer(folder: Path, **changes) -> None:
    """Set keys of the block `goniometer` in capture.yaml (None removes one)."""
    block = yaml.safe_load((folder / "capture.yaml").read_text())["goniometer"] | changes
    edit_yaml(folder, goniometer={k: v for k, v in block.items() if v is not None})
