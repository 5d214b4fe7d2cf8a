"""What goes into and comes out of the fit of a tile, and the capture's part in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.reflection.lighting import Lamp
from nishiki.reflection.model import predict
from nishiki.reflection.stack import Observed, observed


@dataclass(frozen=True)
class Tile:
    """What a tile's texels show: values (M, T, T, channels) linear of the total radiance or, with `specular` given, of
    the diffuse component; visible (M, T, T); positions, normals (T, T, 3); inside (T, T)."""

    values: np.ndarray
    visible: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    inside: np.ndarray
    specular: np.ndarray | None = None

    @property
    def spacing(self) -> float:
        """Median distance of texels side by side, in the object's unit; NaN where there are none."""
        both = self.inside[:, 1:] & self.inside[:, :-1]
        steps = np.linalg.norm(np.diff(self.positions, axis=1)[both], axis=-1)
        return float(np.median(steps)) if steps.size else float("nan")


@dataclass(frozen=True)
class Parameters:
    """Of one tile: kd, ks (T, T, channels), sigma (T, T) radians, flags (T, T) uint8 of TexelFlag; none is NaN."""

    kd: np.ndarray
    ks: np.ndarray
    sigma: np.ndarray
    flags: np.ndarray


@dataclass(frozen=True)
class Capture:
    """Of every observation: the camera's centre (M, 3) and the lamp; `encoding` in which errors count."""

    centres: np.ndarray
    lamps: list[Lamp]
    encoding: str = "linear"

    def observe(self, tile: Tile) -> tuple[Observed, Observed | None]:
        """The tile's observations, and those of its specular component where it has one."""
        area = tile.visible & tile.inside[None]
        arguments = (area, tile.positions, tile.normals, self.centres, self.lamps)
        if tile.specular is None:
            return observed(tile.values, *arguments, encoding=self.encoding), None
        bright = tile.values + tile.specular
        first, second = (
            observed(part, *arguments, encoding=self.encoding, bright=bright) for part in (tile.values, tile.specular)
        )
        return first, second

    def predicted(self, parameters: Parameters, tile: Tile, observation: int) -> np.ndarray:
        """Total radiance (T, T, channels) that the model gives for one observation of a tile."""
        p = parameters
        diffuse, specular = predict(
            p.kd, p.ks, p.sigma, tile.positions, tile.normals, self.centres[observation], self.lamps[observation]
        )
        return diffuse + specular
