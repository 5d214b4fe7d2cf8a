"""The paints of the painting: every region is a short ramp of pigment mixtures, every step of a ramp is one label."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.simulate.pigments import grey, mixture
from nishiki.simulate.randomness import subkey

GREYS = (0.85, 0.55, 0.36, 0.20, 0.09, 0.012)  # 0.85 and 0.012 lie close to the pure white and black paints

_RAMPS: dict[str, tuple[dict, dict, int]] = {
    "ground": ({"sienna": 1.0, "white": 0.5}, {"sienna": 1.0, "white": 0.9}, 3),
    "sky high": ({"ultramarine": 1.0, "cobalt": 0.8, "white": 0.35}, {"cobalt": 1.0, "white": 0.9}, 7),
    "sky middle": ({"cerulean": 1.0, "cobalt": 0.4, "white": 0.6}, {"cerulean": 1.0, "white": 2.2}, 7),
    "sky low": ({"white": 1.0, "orange": 0.02, "madder": 0.25}, {"white": 1.0, "yellow": 0.10}, 7),
    "halo": ({"yellow": 1.0, "white": 0.7}, {"orange": 0.7, "yellow": 1.0, "white": 0.3}, 6),
    "sun": ({"lemon": 1.0, "white": 2.0}, {"yellow": 1.0, "white": 0.3}, 4),
    "cloud": ({"white": 1.0, "madder": 0.10}, {"white": 1.0, "ochre": 0.02}, 5),
    "gold cloud": ({"ochre": 1.0, "yellow": 0.25}, {"ochre": 0.6, "yellow": 0.5, "white": 0.5}, 4),
    "mountain lit": ({"violet": 1.0, "white": 0.7, "madder": 0.5}, {"violet": 1.0, "white": 1.6, "ochre": 0.3}, 5),
    "mountain shade": ({"ultramarine": 1.0, "violet": 0.6, "white": 0.12}, {"ultramarine": 1.0, "white": 0.45}, 5),
    "snow lit": ({"white": 1.0, "ochre": 0.01}, {"white": 1.0}, 3),
    "snow shade": ({"white": 1.0, "ultramarine": 0.5}, {"white": 1.0, "ultramarine": 0.2}, 4),
    "far hills": ({"cobalt": 1.0, "viridian": 0.5, "white": 0.8}, {"viridian": 0.8, "cerulean": 1.0, "white": 1.6}, 5),
    "middle hills": (
        {"viridian": 1.0, "cerulean": 0.6, "lemon": 0.4, "white": 0.2},
        {"viridian": 1.0, "lemon": 0.9, "white": 0.5},
        5,
    ),
    "near hills": ({"viridian": 1.0, "umber": 0.3, "lemon": 0.2}, {"viridian": 0.7, "lemon": 1.0}, 5),
    "lake": ({"cobalt": 1.0, "ultramarine": 0.5, "white": 0.12}, {"cerulean": 1.0, "white": 1.0}, 8),
    "glitter": ({"orange": 0.5, "yellow": 0.5, "white": 0.7}, {"yellow": 1.0, "white": 1.6}, 5),
    "meadow": ({"viridian": 1.0, "umber": 0.2, "lemon": 0.3}, {"viridian": 0.35, "lemon": 1.0, "white": 0.1}, 6),
    "rape field": ({"yellow": 1.0, "ochre": 0.5}, {"lemon": 1.0, "yellow": 0.4}, 5),
    "poppies": ({"vermilion": 1.0, "madder": 0.15}, {"vermilion": 0.4, "orange": 1.0, "white": 0.05}, 4),
    "blossom": ({"white": 1.0, "madder": 1.3}, {"white": 1.0, "madder": 0.06}, 6),
    "branch": ({"umber": 1.0, "black": 0.4}, {"umber": 1.0, "sienna": 0.6}, 4),
    "torii": ({"vermilion": 1.0, "sienna": 0.15}, {"vermilion": 0.6, "orange": 1.0}, 4),
    "black line": ({"black": 1.0}, {"black": 1.0, "umber": 0.3}, 2),
    "brocade red": ({"madder": 0.5, "vermilion": 1.0}, {"vermilion": 1.0, "madder": 0.08}, 4),
    "brocade indigo": ({"ultramarine": 1.0, "black": 0.03}, {"ultramarine": 1.0, "cobalt": 0.8}, 4),
    "brocade green": ({"viridian": 1.0, "white": 0.1}, {"viridian": 1.0, "white": 0.3, "lemon": 0.3}, 4),
    "brocade violet": ({"violet": 1.0, "madder": 0.3}, {"violet": 1.0, "white": 0.25}, 4),
    "brocade gold": ({"ochre": 1.0, "yellow": 0.2}, {"ochre": 1.0, "yellow": 0.7, "white": 0.2}, 5),
    "brocade cream": ({"white": 1.0, "ochre": 0.06}, {"white": 1.0, "ochre": 0.02}, 3),
    **{f"grey {index + 1}": (grey(value), grey(value), 1) for index, value in enumerate(GREYS)},
    "patch red": ({"vermilion": 1.0}, {"vermilion": 1.0}, 1),
    "patch orange": ({"orange": 1.0}, {"orange": 1.0}, 1),
    "patch yellow": ({"yellow": 1.0, "lemon": 0.3}, {"yellow": 1.0, "lemon": 0.3}, 1),
    "patch green": ({"viridian": 1.0, "lemon": 1.2}, {"viridian": 1.0, "lemon": 1.2}, 1),
    "patch blue": ({"cobalt": 1.0, "white": 0.3}, {"cobalt": 1.0, "white": 0.3}, 1),
    "patch violet": ({"violet": 1.0, "white": 0.3}, {"violet": 1.0, "white": 0.3}, 1),
}

REGIONS = tuple(_RAMPS)
REGION = {name: index for index, name in enumerate(REGIONS)}


@dataclass(frozen=True)
class Palette:
    """first, steps : (regions,) first label of a region and how many it has; region : (labels,) region of a label;
    names : (labels,) text; spectra : (labels, wavelengths) reflectance; roughness : (labels,) GGX alpha."""

    first: np.ndarray
    steps: np.ndarray
    region: np.ndarray
    names: tuple[str, ...]
    spectra: np.ndarray
    roughness: np.ndarray


def make_palette(wavelengths_nm: np.ndarray, *, alpha: float, seed: int) -> Palette:
    """All paints at the given wavelengths; roughness varies by ±20 % between regions and ±5 % within one."""
    steps = np.array([ramp[2] for ramp in _RAMPS.values()])
    first = np.concatenate([[0], np.cumsum(steps)[:-1]])
    region = np.repeat(np.arange(steps.size), steps)
    names, spectra = [], []
    for name, (start, end, count) in _RAMPS.items():
        for step in range(count):
            share = step / max(count - 1, 1)
            parts = {
                pigment: (1.0 - share) * start.get(pigment, 0.0) + share * end.get(pigment, 0.0)
                for pigment in {**start, **end}
            }
            spectra.append(mixture(parts, wavelengths_nm))
            names.append(f"{name} {step + 1}/{count}" if count > 1 else name)
    random = np.random.default_rng(subkey(seed, "roughness"))
    between = random.uniform(0.8, 1.2, steps.size)[region]
    roughness = alpha * between * random.uniform(0.95, 1.05, region.size)
    return Palette(first, steps, region, tuple(names), np.array(spectra), np.clip(roughness, 0.0, 1.0))
