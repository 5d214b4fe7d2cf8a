"""The plan of a picture: which paint, tone, brush direction and amount of relief belong where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.simulate.palette import REGION


@dataclass
class CanvasMap:
    """What a painter has in mind, per camera pixel (rows, columns).

    region : uint8 index of the paint. tone : float32 0..1 along its ramp. direction : float32 radians, brush direction
    from the right, clockwise in the picture. body : float32, thickness of the strokes relative to usual. group : uint8;
    a stroke never crosses from one group into another. size : float32, stroke width relative to usual.
    """

    region: np.ndarray
    tone: np.ndarray
    direction: np.ndarray
    body: np.ndarray
    group: np.ndarray
    size: np.ndarray

    @classmethod
    def blank(cls, rows: int, columns: int) -> CanvasMap:
        """A plan of bare ground."""
        shape = (rows, columns)
        return cls(
            np.zeros(shape, np.uint8),
            np.full(shape, 0.5, np.float32),
            np.zeros(shape, np.float32),
            np.ones(shape, np.float32),
            np.zeros(shape, np.uint8),
            np.ones(shape, np.float32),
        )

    def rows_of(self, band: slice) -> CanvasMap:
        """A view of some rows."""
        return CanvasMap(*(getattr(self, name)[band] for name in self.__dataclass_fields__))

    def paint(self, where, region, *, tone=None, direction=None, body=None, group=None, size=None) -> None:
        """Assign values where the boolean array `where` is set; arrays are taken at those pixels."""
        values = {"tone": tone, "direction": direction, "body": body, "group": group, "size": size}
        self.region[where] = REGION[region] if isinstance(region, str) else region[where]
        for name, value in values.items():
            if value is not None:
                getattr(self, name)[where] = value[where] if isinstance(value, np.ndarray) else value
