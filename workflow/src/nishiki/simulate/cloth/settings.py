"""What a simulated cloth is made of: one frozen set of settings, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass, field

from nishiki.errors import UserError


@dataclass(frozen=True)
class YarnSettings:
    """The yarns of one system, warp or weft.

    spacing_mm : from yarn to yarn. fill : width of a yarn over the spacing, below 1. thickness_mm : full thickness.
    flatness : exponent e of the section (2z/thickness)² + |2v/width|^e = 1; 2 is an ellipse, more has a flatter top.
    along, across : roughness (√2 times the slopes' deviation) of the filaments' facets along and across the filaments.
    twist_deg : angle between filaments and yarn on the surface. dye : albedo of the body per channel, 0 to 1.
    """

    spacing_mm: float
    fill: float
    thickness_mm: float
    flatness: float
    along: float
    across: float
    twist_deg: float
    dye: tuple[float, ...]


@dataclass(frozen=True)
class ClothSettings:
    """Everything that decides how a simulated cloth reflects.

    weave : plain, twill or satin. face : warp or weft, which is on top mostly. harness : yarns of a repeat (plain: 2).
    step : shift of the binding from one yarn to the next. warp_crimp : share of the warp in the sum of both amplitudes,
    which is that of two yarns that touch. bend : shape of the way from one side to the other: 0 straight with
    kinks, 1 two arcs without a straight part. rest : share of a crossing's length on which a yarn lies level.
    arch_deg : steepest slope of the arch of a float. irregularity : 0 = all yarns alike; 1 = as in a filament cloth.
    repeats : the irregular cell holds repeats × repeats repeats of the weave. index : refractive, of the filaments.
    """

    weave: str
    harness: int
    step: int
    warp: YarnSettings
    weft: YarnSettings
    warp_crimp: float = 0.35
    bend: float = 0.6
    rest: float = 0.05
    arch_deg: float = 8.0
    irregularity: float = 1.0
    repeats: int = 2
    index: float = 1.57
    seed: int = 1
    face: str = "warp"
    channels: tuple[str, ...] = field(default=("red", "green", "blue"))

    def __post_init__(self):
        if self.weave not in ("plain", "twill", "satin"):
            raise UserError(f"simulation: weave expected plain, twill or satin, found {self.weave!r}; choose one")
        if self.face not in ("warp", "weft"):
            raise UserError(f"simulation: face expected warp or weft, found {self.face!r}; choose one")
        rows = [
            ("harness", self.harness, 2, 16),
            ("warp_crimp", self.warp_crimp, 0.05, 0.95),
            ("bend", self.bend, 0.0, 1.0),
            ("rest", self.rest, 0.0, 0.6),
            ("arch_deg", self.arch_deg, 0.0, 30.0),
            ("irregularity", self.irregularity, 0.0, 3.0),
            ("repeats", self.repeats, 1, 8),
            ("index", self.index, 1.05, 3.0),
            ("seed", self.seed, 0, 2**53),
        ]
        for name, yarn in (("warp", self.warp), ("weft", self.weft)):
            rows += [
                (f"{name} spacing_mm", yarn.spacing_mm, 1e-3, 10.0),
                (f"{name} fill", yarn.fill, 0.3, 0.99),
                (f"{name} thickness_mm", yarn.thickness_mm, 0.05 * yarn.spacing_mm, 1.5 * yarn.spacing_mm),
                (f"{name} flatness", yarn.flatness, 1.5, 6.0),
                (f"{name} along", yarn.along, 0.03, 1.0),
                (f"{name} across", yarn.across, 0.03, 1.0),
                (f"{name} twist_deg", yarn.twist_deg, -60.0, 60.0),
                *((f"{name} dye", value, 0.0, 1.0) for value in yarn.dye),
            ]
            if len(yarn.dye) != len(self.channels):
                raise UserError(
                    f"simulation: {name} dye expected {len(self.channels)} numbers (channels), found {len(yarn.dye)}"
                )
        for name, value, low, high in rows:
            if not low <= value <= high:
                raise UserError(
                    f"simulation: {name} expected {low:g} to {high:g}, found {value!r}; choose a value in that range"
                )
