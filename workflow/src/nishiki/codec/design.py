"""What encoder and decoder have to agree on: the header of a store, as a frozen value that goes through plain data."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields

import numpy as np

from nishiki.codec.extent import Extent
from nishiki.codec.observations import view_matrix
from nishiki.codec.transform import Block, Plane, plane_transform
from nishiki.errors import UserError

GROUPS = ("kd", "ks", "sigma")


@dataclass(frozen=True)
class Design:
    """tile_size T; views, lights, channels of the capture; full_turn; encoding; components: coded apart ("total",) or
    ("diffuse", "specular"). wavelet, levels, mirrored: of the planes; view_transform, light_transform: along the
    observations; arcs: whether a tile's block spans only the views that see it; model: False for image-based coding.
    step: of the residual's quantiser; parameter_steps: of kd, ks, log sigma. colour: one (C, C) matrix per component;
    parameter_colour: of kd, ks; parameter_means: of kd (C), ks (C), log sigma (1). parameter_wavelet, parameter_levels,
    parameter_mirrored: of the parameter planes.
    """

    tile_size: int
    views: int
    lights: int
    channels: int
    full_turn: bool
    encoding: str
    components: tuple[str, ...] = ("total",)
    wavelet: str = "bior4.4"
    levels: int = 4
    mirrored: bool = False
    view_transform: str = "db2"
    light_transform: str = "cosine"
    arcs: bool = True
    model: bool = True
    step: float = 0.02
    parameter_steps: tuple[float, ...] = (0.01, 0.01, 0.1)
    colour: tuple = field(default=())
    parameter_colour: tuple = field(default=())
    parameter_means: tuple = field(default=())
    parameter_wavelet: str = "bior4.4"
    parameter_levels: int = 5
    parameter_mirrored: bool = True

    def as_dict(self) -> dict:
        """Plain data, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict) -> Design:
        """Inverse of `as_dict`. UserError where keys are missing or unknown: another version wrote them."""
        names = {f.name for f in fields(cls)}
        if set(values) != names:
            wrong = sorted(set(values) ^ names)
            raise UserError(f"residual: header with unexpected or missing entries {wrong}; run the stage again")
        return cls(**{name: _tuples(value) for name, value in values.items()})

    def plane(self, extent: Extent) -> Plane:
        """Transform of the residual's planes."""
        return plane_transform(self.wavelet, extent.rows, extent.columns, self.levels, mirrored=self.mirrored)

    def parameter_plane(self, extent: Extent) -> Plane:
        """Transform of the parameters' planes."""
        levels, mirrored = self.parameter_levels, self.parameter_mirrored
        return plane_transform(self.parameter_wavelet, extent.rows, extent.columns, levels, mirrored=mirrored)

    def block(self, extent: Extent) -> Block:
        """Transform of a tile."""
        along_lights = view_matrix(self.light_transform, self.lights)
        return Block(self.plane(extent), view_matrix(self.view_transform, extent.length), along_lights)

    def shape(self, extent: Extent) -> tuple[int, int, int, int, int]:
        """Of a tile's block: (channels, lights, views, rows, columns)."""
        return self.channels, self.lights, extent.length, extent.rows, extent.columns

    def residual_shape(self, extent: Extent) -> tuple[int, int, int, int]:
        """Of a tile's coded residual: (channels, lights * views, rows, columns)."""
        return self.channels, self.lights * extent.length, extent.rows, extent.columns

    def parameter_shape(self, extent: Extent) -> tuple[int, int, int, int]:
        """Of a tile's coded parameters: (channels, 3, rows, columns)."""
        return self.channels, len(GROUPS), extent.rows, extent.columns

    def mix(self, component: int) -> np.ndarray:
        """(C, C) float64: new channels from old, of one component."""
        return np.array(self.colour[component]) if self.colour else np.eye(self.channels)

    def parameter_mix(self, group: int) -> np.ndarray:
        """(C, C) float64 of kd (0) or ks (1); (1, 1) of log sigma."""
        if group == 2:
            return np.eye(1)
        return np.array(self.parameter_colour[group]) if self.parameter_colour else np.eye(self.channels)

    def parameter_mean(self, group: int) -> np.ndarray:
        """Means that are taken off before the transform."""
        count = 1 if group == 2 else self.channels
        return np.array(self.parameter_means[group]) if self.parameter_means else np.zeros(count)


def _tuples(value):
    return tuple(_tuples(v) for v in value) if isinstance(value, (list, tuple)) else value
