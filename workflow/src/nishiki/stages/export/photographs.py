"""The photographs as a screen would show them, and errors of what a viewer shows against them."""

from collections.abc import Iterator

import numpy as np

from nishiki.colour.colour import srgb_encode, xyz_to_srgb_linear
from nishiki.observations.plane import Observations
from nishiki.stages.export.scene import ExportedScene


class Photographs:
    """The photographs as sRGB-coded colours relative to a white that faces the lamp."""

    pixels: int | None = None
    """At a time, about; None: as many as are read at a time."""

    def __init__(self, frames: Observations, scene: ExportedScene):
        colour = scene.camera_colour()
        self.frames = frames
        self.matrix = xyz_to_srgb_linear(colour.matrix.T, white=colour.white).T

    def coded(self, observations: np.ndarray) -> np.ndarray:
        """sRGB-coded colours (..., 3), 0 to 1, of observations in the camera's channels (..., channels)."""
        return srgb_encode(observations @ self.matrix.T)

    def strips(self, band: slice, lights: np.ndarray) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Some rows of a band at a time: (n, lights, 3) values in 0 to 1 and (n, lights) bool of their pixels."""
        for rows, values, valid in self.frames.strips(band, lights=lights):
            step = max(self.pixels // values.shape[2], 1) if self.pixels else values.shape[1]
            for top in range(0, values.shape[1], step):
                part = slice(rows.start + top, min(rows.start + top + step, rows.stop))
                inner = slice(top, top + step)
                yield part, *self.seen(part, slice(None), *self._by_pixel(values[:, inner], valid[:, inner]))

    def seen(
        self, rows: slice, pixels: slice | np.ndarray, values: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What is fitted of some pixels of rows, of the photographs' values (n, lights, 3) and validity there."""
        return values[pixels], valid[pixels]

    def _by_pixel(self, values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, lights, 3) coded and (n, lights) bool of observations (lights, rows, columns, channels)."""
        coded = self.coded(values).reshape(len(values), -1, 3).transpose(1, 0, 2)
        return coded.astype(np.float64), valid.reshape(len(values), -1).T

    def samples(self, lights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Values and validity of about `count` pixels evenly spread over the object."""
        step = max(1, int(np.count_nonzero(self.frames.mask)) // count)
        values, valid, passed = [], [], 0
        for band in self.frames.bands():
            for rows, each, usable in self.frames.strips(band, lights=lights):
                of_object = np.flatnonzero(self.frames.mask[rows])
                chosen = of_object[-passed % step :: step]
                passed += len(of_object)
                if len(chosen):
                    sampled = self.seen(rows, chosen, *self._by_pixel(each, usable))
                    values.append(sampled[0])
                    valid.append(sampled[1])
        return np.concatenate(values), np.concatenate(valid)


class CodedErrors:
    """Squared errors of coded pictures against photographs, by light."""

    def __init__(self, lights: int):
        self._squares, self._counts = np.zeros(lights), np.zeros(lights)

    def add(self, number: int, shown: np.ndarray, values: np.ndarray, valid: np.ndarray) -> None:
        """Pixels (n, 3) under one light: what a viewer shows, the photograph, and where it counts (n,) bool."""
        self._squares[number] += np.sum((np.clip(shown[valid], 0, 1) - values[valid]) ** 2)
        self._counts[number] += 3 * np.count_nonzero(valid)

    def decibels(self) -> dict[str, float]:
        """PSNR, dB, peak 1, at most 120: all lights together and the worst; the number of lights."""
        means = self._squares / np.maximum(self._counts, 1)
        together = self._squares.sum() / max(self._counts.sum(), 1)
        all_db, worst_db = -10 * np.log10(np.maximum([together, means.max()], 1e-12))
        return {"all": float(all_db), "worst": float(worst_db), "lights": len(means)}
