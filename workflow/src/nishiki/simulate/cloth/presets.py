"""Cloths and sessions by name."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.cloth.directions import hemisphere_views, quarter_views, session
from nishiki.simulate.cloth.settings import ClothSettings, YarnSettings
from nishiki.simulate.randomness import subkey
from nishiki.simulate.settings import CameraSettings

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
    rows: int = 48
    columns: int = 48
    pitch_mm: float = 0.25
    candidates: int = 150_000
    chains: int = 60_000
    bounces: int = 2
    seed: int = 1
    white_reflectance: float = 0.99
    white_texture: float = 0.006
    camera: CameraSettings = field(default_factory=CameraSettings)

    def __post_init__(self):
        for name, value, low, high in (
            ("rows", self.rows, 16, 1024),
            ("columns", self.columns, 16, 1024),
            ("pitch_mm", self.pitch_mm, 1e-3, 10.0),
            ("candidates", self.candidates, 1000, 10_000_000),
            ("chains", self.chains, 0, 10_000_000),
            ("bounces", self.bounces, 0, 3),
            ("cloths", len(self.cloths), 1, 2),
            ("bits", self.camera.bits, 8, 16),
            ("white_level", self.camera.white_level, 0.01, 1.0),
        ):
            if not low <= value <= high:
                raise UserError(
                    f"simulation: {name} expected {low:g} to {high:g}, found {value!r}; choose a value in that range"
                )


def make_settings(
    weave: str, *, seed: int = 1, dye: str = "black", filaments: str = "silk", harness: int | None = None, **changes
) -> ClothSettings:
    """A cloth of this weave. Each seed varies its sizes by some percent, its roughness, and its yarns; `changes` are
    fields of ClothSettings, or `flatness` of the warp."""
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
    yarns = [
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
    ]
    values = {"warp_crimp": crimp, "bend": bend, "arch_deg": arch, "repeats": max(10 // harness, 1)}
    return ClothSettings(weave, harness, step, *yarns, seed=seed, **(values | changes))


def preset(name: str, *, regions: bool = False, **options) -> GoniometerSettings:
    """The session of a preset; regions : a second cloth beside the first, with the weft on top and dyed gold.

    options : those of `make_settings`, and fields of GoniometerSettings.
    """
    own = {key: options.pop(key) for key in list(options) if key in GoniometerSettings.__dataclass_fields__}
    seed = own.get("seed", 1)
    values = {"angles_deg": session(quarter_views(), hemisphere_views())}
    if name.endswith("-tiny"):
        few = session(
            quarter_views(9.0, 22.5), hemisphere_views(20.0, 45.0), incidences=(30.0, 60.0), azimuths=(0.0, 90.0)
        )
        values = {"angles_deg": few, "rows": 24, "columns": 24, "candidates": 20_000, "chains": 6_000}
        options.setdefault("repeats", 1)
    cloth = make_settings(PRESETS[name], seed=seed, **options)
    cloths = (cloth,)
    if regions:
        figure = make_settings(PRESETS[name], seed=seed + 1, **(options | {"dye": "gold"}))
        cloths = (cloth, replace(figure, face="weft" if PRESETS[name] != "plain" else "warp"))
    return GoniometerSettings(cloths=cloths, **(values | own))
