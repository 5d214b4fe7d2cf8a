"""What goes into the fit of a tile, and the capture's part in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.texels.lighting import Lamp
from nishiki.brdf.texels.model import predict
from nishiki.brdf.texels.parameters import Parameters
from nishiki.brdf.texels.stack import Observed, observed
from nishiki.colour.encoding import encode


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
    def joined(self) -> Tile:
        """The same with the total radiance instead of its components."""
        return self if self.specular is None else replace(self, values=self.values + self.specular, specular=None)

    @property
    def spacing(self) -> float:
        """Median distance of texels side by side, in the object's unit; NaN where there are none."""
        both = self.inside[:, 1:] & self.inside[:, :-1]
        steps = np.linalg.norm(np.diff(self.positions, axis=1)[both], axis=-1)
        return float(np.median(steps)) if steps.size else float("nan")


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

    def squares(self, parameters: Parameters, tile: Tile) -> tuple[float, int]:
        """Sum of the squared errors of the model alone in the capture's encoding, and how many samples these are, of
        those that are finite."""
        total, count = 0.0, 0
        joined = tile.joined.values
        for o in np.flatnonzero(tile.visible.reshape(len(tile.visible), -1).any(axis=1)):
            seen = tile.visible[o] & tile.inside
            error = encode(self.predicted(parameters, tile, o, seen), self.encoding)
            error = error - encode(joined[o][seen], self.encoding)
            error = error[np.isfinite(error)]
            total += float(np.sum(error.astype(np.float64) ** 2))
            count += error.size
        return total, count

    def predicted(self, parameters: Parameters, tile: Tile, observation: int, texels=...) -> np.ndarray:
        """Total radiance (..., channels) that the model gives for one observation of a tile, or of some of its texels
        (an index into (T, T))."""
        of_texels = (parameters.kd, parameters.ks, parameters.sigma, tile.positions, tile.normals)
        picked = (array[texels] for array in of_texels)
        diffuse, specular = predict(*picked, self.centres[observation], self.lamps[observation])
        return diffuse + specular
