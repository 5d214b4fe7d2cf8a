"""Declare the settings of cloths and sessions, by name, checked when they are made."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.capture import CameraSettings, check_choice, check_ranges, declare_range
from nishiki.simulate.randomness import subkey


@dataclass(frozen=True)
class YarnSettings:
    """The yarns of one system, warp or weft.

    spacing_mm : from yarn to yarn. fill : width of a yarn over the spacing, below 1. thickness_mm : full thickness.
    flatness : exponent e of the section (2z/thickness)² + |2v/width|^e = 1; 2 is an ellipse, more has a flatter top.
    along, across : roughness (√2 times the slopes' deviation) of the filaments' facets along and across the filaments.
    twist_deg : angle between filaments and yarn on the surface. dye : albedo of the body per channel, 0 to 1.
    """

    spacing_mm: float = declare_range(1e-3, 10.0)
    fill: float = declare_range(0.3, 0.99)
    thickness_mm: float
    flatness: float = declare_range(1.5, 6.0)
    along: float = declare_range(0.03, 1.0)
    across: float = declare_range(0.03, 1.0)
    twist_deg: float = declare_range(-60.0, 60.0)
    dye: tuple[float, ...]


@dataclass(frozen=True)
class ClothSettings:
    """Everything that decides how a simulated cloth reflects."""

    weave: str  # plain, twill or satin
    harness: int = declare_range(2, 16)  # yarns of a repeat (plain: 2)
    step: int  # shift of the binding from one yarn to the next
    # _crimp : share of the warp in the sum of both amplitudes, which is that of two yarns that touch
    warp: YarnSettings
    weft: YarnSettings
    warp_crimp: float = declare_range(0.05, 0.95, 0.35)
    # shape of the way from one side to the other: 0 straight with kinks, 1 two arcs without a straight part
    bend: float = declare_range(0.0, 1.0, 0.6)
    rest: float = declare_range(0.0, 0.6, 0.05)  # share of a crossing's length on which a yarn lies level
    arch_deg: float = declare_range(0.0, 30.0, 8.0)  # steepest slope of the arch of a float
    irregularity: float = declare_range(0.0, 3.0, 1.0)  # 0 = all yarns alike; 1 = as in a filament cloth
    repeats: int = declare_range(1, 8, 2)  # the irregular cell holds repeats × repeats repeats of the weave
    index: float = declare_range(1.05, 3.0, 1.57)  # refractive, of the filaments
    seed: int = declare_range(0, 2**53, 1)
    face: str = "warp"  # warp or weft, which is on top mostly
    channels: tuple[str, ...] = field(default=("red", "green", "blue"))

    def __post_init__(self):
        check_choice("weave", self.weave, ("plain", "twill", "satin"))
        check_choice("face", self.face, ("warp", "weft"))
        check_ranges(self)
        for name, yarn in (("warp", self.warp), ("weft", self.weft)):
            thickness = ("thickness_mm", yarn.thickness_mm, 0.05 * yarn.spacing_mm, 1.5 * yarn.spacing_mm)
            check_ranges(yarn, thickness, *(("dye", value, 0.0, 1.0) for value in yarn.dye), prefix=f"{name} ")
            if len(yarn.dye) != len(self.channels):
                raise UserError(
                    f"simulation: {name} dye expected {len(self.channels)} numbers (channels), found {len(yarn.dye)}"
                )


OBLIQUE_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)
AZIMUTHS_DEG = (0.0, 45.0, 90.0)  # of the lamp: weft, bias, warp


def unit(theta_deg, phi_deg) -> np.ndarray:
    """Compute unit vectors (..., 3) from polar angle and azimuth in degrees; exact on the axes and in the plane."""
    theta, phi = np.radians(np.asarray(theta_deg, float)), np.radians(np.asarray(phi_deg, float))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi], axis=-1)


def quarter_views(polar_step: float = 3.0, azimuth_step: float = 5.0) -> np.ndarray:
    """List views (n, 2) under normal incidence in the quarter between weft and warp: polar angle, azimuth in degrees.

    Rings below 87°, both planes of symmetry included, the normal once; the ring at 87° every third azimuth. With the
    default steps 540 views.
    """
    azimuths = np.arange(0.0, 90.0 + 1e-9, azimuth_step)
    rings = np.arange(polar_step, 87.0 - 1e-9, polar_step)
    theta, phi = np.meshgrid(rings, azimuths, indexing="ij")
    full = np.column_stack([theta.ravel(), phi.ravel()])
    last = azimuths[::3]
    return np.concatenate([[[0.0, 0.0]], full, np.column_stack([np.full(len(last), 87.0), last])])


def hemisphere_views(polar_step: float = 6.0, azimuth_step: float = 15.0) -> np.ndarray:
    """List views (n, 2), degrees, of the whole hemisphere: rings in the middle of equal polar steps (3°, 9° .. 87°)."""
    theta, phi = np.meshgrid(
        np.arange(0.5 * polar_step, 90.0, polar_step), np.arange(0.0, 360.0, azimuth_step), indexing="ij"
    )
    return np.column_stack([theta.ravel(), phi.ravel()])


def session(normal: np.ndarray, oblique: np.ndarray, *, incidences=OBLIQUE_DEG, azimuths=AZIMUTHS_DEG) -> np.ndarray:
    """List (n, 4) theta_i, phi_i, theta_r, phi_r in degrees: views under normal incidence, then those of every lamp."""
    rows = [np.column_stack([np.zeros((len(normal), 2)), normal])]
    for phi in azimuths:
        for theta in incidences:
            rows.append(np.column_stack([np.tile([theta, phi], (len(oblique), 1)), oblique]))
    return np.concatenate(rows)


# Albedo of the body in red, green and blue.
DYES = {
    "black": (0.020, 0.018, 0.022),
    "crimson": (0.42, 0.05, 0.06),
    "indigo": (0.05, 0.09, 0.30),
    "gold": (0.55, 0.36, 0.08),
    "raw": (0.62, 0.57, 0.48),
}
# Roughness along and across the filaments: continuous bright filaments, silk-like, spun.
FILAMENTS = {"bright": (0.08, 0.26), "silk": (0.12, 0.30), "spun": (0.24, 0.42)}
# harness, step; warp: spacing, thickness, flatness; weft likewise; share of the crimp in the warp, bend, arch.
_WEAVES = {
    "satin": (5, 2, (0.10, 0.055, 2.6), (0.13, 0.060, 2.2), 0.35, 0.6, 8.0),
    "twill": (4, 1, (0.12, 0.070, 2.4), (0.14, 0.070, 2.2), 0.45, 0.7, 6.0),
    "plain": (2, 1, (0.16, 0.070, 2.3), (0.16, 0.070, 2.3), 0.50, 0.9, 0.0),
}
STEPS = {4: 1, 5: 2, 7: 2, 8: 3, 9: 2, 10: 3, 12: 5}  # of satins
PRESETS = {"satin": "satin", "satin-tiny": "satin", "twill": "twill", "plain": "plain"}


@dataclass(frozen=True)
class GoniometerSettings:
    """Everything that decides the bytes of a simulated goniometer capture.

    cloths : one, or two that lie side by side, each a region. rows, columns : camera pixels. pitch_mm : of a pixel on
    the cloth. angles_deg : (n, 4) theta_i, phi_i, theta_r, phi_r. candidates, chains, bounces : see `make_cloth`.
    white_reflectance, white_texture : of the board, and how much it varies from pixel to pixel (standard deviation).
    """

    cloths: tuple[ClothSettings, ...]
    angles_deg: np.ndarray
    rows: int = declare_range(16, 1024, 48)
    columns: int = declare_range(16, 1024, 48)
    pitch_mm: float = declare_range(1e-3, 10.0, 0.25)
    candidates: int = declare_range(1000, 10_000_000, 150_000)
    chains: int = declare_range(0, 10_000_000, 60_000)
    bounces: int = declare_range(0, 3, 2)
    seed: int = 1
    white_reflectance: float = 0.99
    white_texture: float = 0.006
    camera: CameraSettings = field(default_factory=CameraSettings)

    def __post_init__(self):
        check_ranges(self, ("cloths", len(self.cloths), 1, 2), ("channels", self.camera.channels, 3, 3))


def make_settings(
    weave: str, *, seed: int = 1, dye: str = "black", filaments: str = "silk", harness: int | None = None, **changes
) -> ClothSettings:
    """Make the settings of a weave; each seed varies sizes by some percent, roughness and yarns.

    `changes` are fields of ClothSettings, or `flatness` of the warp.
    """
    standard, step, warp, weft, crimp, bend, arch = _WEAVES[weave]
    harness = harness or standard
    if weave == "satin" and harness != standard:
        if harness not in STEPS or harness < 5:
            raise UserError(
                f"simulation: a satin of 5, 7, 8, 9, 10 or 12 harnesses expected, found {harness}; choose one"
            )
        step = STEPS[harness]
    random = np.random.default_rng(subkey(seed, "cloth sizes"))
    vary = lambda value, share: float(value * (1.0 + share * random.uniform(-1.0, 1.0)))  # noqa: E731
    along, across = FILAMENTS[filaments]
    spun = filaments == "spun"
    flatness = changes.pop("flatness", None)
    of_warp, of_weft = (
        YarnSettings(
            spacing_mm=vary(spacing, 0.08),
            fill=0.96 if system == "warp" else 0.92,
            thickness_mm=vary(thickness, 0.08),
            flatness=flatness if flatness and system == "warp" else vary(flat, 0.04),
            along=vary(along, 0.1) * (1.0 if system == "warp" else 1.25),
            across=vary(across, 0.1),
            twist_deg=(12.0 if system == "warp" else -12.0) if spun else 0.0,
            dye=DYES[dye],
        )
        for system, (spacing, thickness, flat) in (("warp", warp), ("weft", weft))
    )
    values = {"warp_crimp": crimp, "bend": bend, "arch_deg": arch, "repeats": max(10 // harness, 1), "seed": seed}
    return ClothSettings(weave, harness, step, of_warp, of_weft, **(values | changes))


def preset(name: str, *, regions: bool = False, **options) -> GoniometerSettings:
    """Build the session of a preset; regions: with a second cloth beside the first, weft on top and dyed gold.

    options : those of `make_settings`, and fields of GoniometerSettings.
    """
    overrides = {key: options.pop(key) for key in list(options) if key in GoniometerSettings.__dataclass_fields__}
    seed = overrides.get("seed", 1)
    values: dict[str, Any] = {"angles_deg": session(quarter_views(), hemisphere_views())}
    if name.endswith("-tiny"):
        few = session(
            quarter_views(9.0, 22.5), hemisphere_views(20.0, 45.0), incidences=(30.0, 60.0), azimuths=(0.0, 90.0)
        )
        values = {"angles_deg": few, "rows": 24, "columns": 24, "candidates": 20_000, "chains": 6_000}
        options.setdefault("repeats", 1)
    cloth = make_settings(PRESETS[name], seed=seed, **options)
    cloths: tuple[ClothSettings, ...] = (cloth,)
    if regions:
        figure = make_settings(PRESETS[name], seed=seed + 1, **(options | {"dye": "gold"}))
        cloths = (cloth, replace(figure, face="weft" if PRESETS[name] != "plain" else "warp"))
    return GoniometerSettings(cloths=cloths, **(values | overrides))
