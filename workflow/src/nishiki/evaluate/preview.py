"""Small pictures of prediction and photograph, both through the same map to display colour."""

import numpy as np

from nishiki.colour.colour import xyz_to_srgb_linear
from nishiki.evaluate.camera_colour import CameraColour
from nishiki.evaluate.kernels import add_blocks

COLUMNS = 720
"""Largest width of a preview, pixels."""


class PreviewPair:
    """Collects both pictures band by band; each pixel of a preview is the mean of a square block in linear light."""

    def __init__(self, shape: tuple[int, int], colour: CameraColour, *, columns: int = COLUMNS):
        self.block = -(-shape[1] // columns)
        self.size = tuple(-(-n // self.block) for n in shape)
        self.colour = colour
        self.sums = None
        self.counts = np.zeros((2, *self.size))

    def add(self, rows: slice, predicted: np.ndarray, observed: np.ndarray, *, inside: np.ndarray) -> None:
        """predicted, observed : (rows, columns, channels) relative to white; pixels outside the object are left out.

        Values that are not finite count as 0.
        """
        if self.sums is None:
            self.sums = np.zeros((2, *self.size, predicted.shape[2]))
        for k, picture in enumerate((predicted, observed)):
            values = np.ascontiguousarray(picture, np.float32)
            add_blocks(values, inside, rows.start, self.block, self.sums[k], self.counts[k])

    def arrays(self) -> dict[str, np.ndarray]:
        """predicted, observed: (rows, columns, 3) float16 linear sRGB, the lamp's white at 1, 1, 1; inside: bool."""
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.where(self.counts[..., None] > 0, self.sums / self.counts[..., None], 0.0)
        rgb = xyz_to_srgb_linear(self.colour.xyz(means), white=self.colour.white)
        rgb = np.clip(rgb, -60000, 60000).astype(np.float16)
        return {"predicted": rgb[0], "observed": rgb[1], "inside": self.counts[0] > 0}
