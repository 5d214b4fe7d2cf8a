"""The photographs as a screen shows them, also under the lights of a grid, and errors against them.

    x0 = m_G + W (p - m_L),    x = x0 + (A'A + s I)^-1 A' (p - A x0)

p are the photographs, m_L and m_G what the fitted model (stages normals and brdf, without cast shadows) draws under
the captured lights and those of the grid, all coded for the screen, W Gaussians between the lights, sum 1, and A the
weights by which a viewer interpolates between the nodes of the grid: what is shown under a captured light is nearly its
photograph. The correction by A is that of F. Ponchio, M. Corsini and R. Scopigno (2018), A compact
representation of relightable images for the web, whose x0 is W p.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from nishiki.colour.colour import encode, xyz_to_srgb_linear
from nishiki.formats.relight import gaussian_weights, grid_directions
from nishiki.observations.plane import Observations
from nishiki.render.plane.scene import Light
from nishiki.render.plane.shade import PlaneMaps, predict_observations
from nishiki.stages.export.light_models import GRID_SIDE, grid_weights
from nishiki.stages.export.scene import ExportedScene
from nishiki.stages.painting_maps import each_map

CODED_STEPS = 65535  # of the table of coded values: at most .0001 off the curve


class Photographs:
    """The photographs as sRGB-coded colours relative to a white that faces the lamp."""

    pixels: int | None = None
    """At a time, about; None: as many as are read at a time."""

    def __init__(self, frames: Observations, scene: ExportedScene):
        colour = scene.camera_colour()
        self.frames = frames
        self.matrix = np.float32(CODED_STEPS * xyz_to_srgb_linear(colour.matrix.T, white=colour.white).T)
        self.table = np.float32(encode(np.arange(CODED_STEPS + 1) / CODED_STEPS, "srgb"))

    def coded(self, observations: np.ndarray) -> np.ndarray:
        """Code observations (pictures, pixels, channels) as sRGB: (pictures, 3, pixels) float32, 0 to 1."""
        from nishiki.colour.kernels import code_pixels

        out = np.empty((len(observations), 3, observations.shape[1]), np.float32)
        code_pixels(np.ascontiguousarray(observations, np.float32), self.matrix, self.table, out)
        return out

    def strips(self, band: slice, lights: np.ndarray) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield some rows of a band at a time: (lights, 3, n) values in 0 to 1 and (lights, n) bool of their pixels."""
        model = self.fitted_model(band)
        for rows, values, valid in self.frames.strips(band, lights=lights):
            step = max(self.pixels // values.shape[2], 1) if self.pixels else values.shape[1]
            for top in range(0, values.shape[1], step):
                part = slice(rows.start + top, min(rows.start + top + step, rows.stop))
                pixels = slice(*(values.shape[2] * (row - band.start) for row in (part.start, part.stop)))
                here, known = (
                    each[:, top : top + step].reshape(len(lights), -1, *each.shape[3:]) for each in (values, valid)
                )
                yield part, *self.seen(model, pixels, self.coded(here), known)

    def fitted_model(self, band: slice) -> Any:
        """Return what `seen` needs of a band besides its photographs."""
        return None

    def seen(
        self, model: Any, pixels: slice | np.ndarray, values: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what is fitted of some pixels of a band; values (lights, 3, n), validity of the photographs there."""
        return values, valid

    def samples(self, lights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return values and validity of about `count` pixels evenly spread over the object."""
        mask = self.frames.mask
        step = max(1, int(np.count_nonzero(mask)) // count)
        apart = math.isqrt(step)  # rows
        numbers = np.cumsum(mask[apart // 2 :: apart]).reshape(-1, mask.shape[1]) - 1
        chosen = np.zeros(mask.shape, bool)
        chosen[apart // 2 :: apart] = mask[apart // 2 :: apart] & (numbers % (step // apart) == 0)
        found = []
        for band in self.frames.bands():
            rows = np.flatnonzero(chosen[band].any(axis=1))
            if len(rows):
                codes, _ = self.frames.codes(band, lights=lights)
                read = ((row, self.frames.decoded(codes[:, row : row + 1], lights, band.start + row)) for row in rows)
                pieces = [[each[:, 0, chosen[band.start + row]] for each in arrays] for row, arrays in read]
                each, usable = (np.concatenate(arrays, axis=1) for arrays in zip(*pieces, strict=True))
                here = np.flatnonzero(chosen[band])
                found.append(self.seen(self.fitted_model(band), here, self.coded(each), usable))
        values, valid = (np.concatenate(arrays, axis=-1) for arrays in zip(*found, strict=True))
        return values, valid


class CodedErrors:
    """Squared errors of coded pictures against photographs, by light."""

    def __init__(self, lights: int):
        self._squares, self._counts = np.zeros(lights), np.zeros(lights, np.int64)

    def add(self, number: int, shown: np.ndarray, values: np.ndarray, valid: np.ndarray) -> None:
        """Add pixels (n, 3) under one light: what a viewer shows, the photograph, and where it counts (n,) bool."""
        self._squares[number] += np.sum((np.clip(shown[valid], 0, 1) - values[valid]) ** 2)
        self._counts[number] += 3 * np.count_nonzero(valid)

    @classmethod
    def of_strip(cls, shown: np.ndarray, values: np.ndarray, valid: np.ndarray) -> "CodedErrors":
        """Compare pixels (lights, 3, n) under all lights where valid (lights, n); `shown` is overwritten."""
        errors = cls(len(values))
        np.clip(shown, 0, 1, out=shown)
        shown -= values
        shown *= valid[:, None]
        errors._squares[:] = np.einsum("lkn,lkn->l", shown, shown)
        errors._counts[:] = 3 * valid.sum(axis=1)
        return errors

    def include(self, others: "CodedErrors") -> None:
        """Add the errors of other pixels."""
        self._squares += others._squares
        self._counts += others._counts

    def decibels(self, lights: slice = slice(None)) -> dict[str, float]:
        """Return the PSNR, dB, peak 1, at most 120: some lights together and the worst; the number of lights."""
        squares, counts = self._squares[lights], self._counts[lights]
        means = squares / np.maximum(counts, 1)
        together = squares.sum() / max(counts.sum(), 1)
        all_db, worst_db = -10 * np.log10(np.maximum([together, means.max()], 1e-12))
        return {"all": float(all_db), "worst": float(worst_db), "lights": len(means)}


WIDTH = 0.3  # of the Gaussians, as distances of unit vectors
STIFFNESS = 0.1  # s: weight of x0 beside the photographs
LOWEST_Z = 0.1  # before normalising, of the lights that the model draws: 6 degrees above the plane
BEYOND = 0.5  # below 0 and above 1 that values at nodes may be


class GridPictures(Photographs):
    """Pictures under the lights of the grid. lights : indices of the captured ones."""

    pixels = 1 << 14

    def __init__(self, frames: Observations, scene: ExportedScene, lights: np.ndarray):
        super().__init__(frames, scene)
        captured = frames.directions[lights]
        nodes = grid_directions(GRID_SIDE)
        drawn = nodes * [1, 1, 0] + np.maximum(nodes, LOWEST_Z) * [0, 0, 1]
        drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
        self._scene = scene
        self._lamps = [Light(direction=tuple(light)) for light in (*captured, *drawn)]
        between = np.stack([gaussian_weights(captured, node, WIDTH) for node in drawn])
        shown, every = grid_weights(captured), np.eye(len(nodes))
        correction = np.linalg.solve(shown.T @ shown + STIFFNESS * every, shown.T)
        of_model = np.concatenate([correction, every - correction @ shown], axis=1)
        of_rest = correction + between - correction @ shown @ between
        self._of_both = np.concatenate([of_model, of_rest], axis=1).astype(np.float32)

    def fitted_model(self, band: slice) -> tuple[PlaneMaps, np.ndarray]:
        """Return the maps of the fitted model at the pixels (1, n) of a band, and (n,) bool where they are known."""
        model = self._scene.model(band)
        flat = each_map(model, lambda values: values.reshape(1, -1, *values.shape[2:]))
        return flat, self._scene.known(band).ravel()

    def seen(
        self, model: tuple[PlaneMaps, np.ndarray], pixels: slice | np.ndarray, values: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (nodes, 3, n) values and (nodes, n) bool of some pixels, known or photographed under every light."""
        drawn = self.drawn(model[0], pixels)
        rest = (values - drawn[: len(values)]) * valid[:, None]
        both = np.concatenate([drawn, rest]).reshape(self._of_both.shape[1], -1)
        nodes = (self._of_both @ both).reshape(-1, *drawn.shape[1:])
        known = model[1][pixels] | valid.all(axis=0)
        return np.clip(nodes, -BEYOND, 1 + BEYOND, out=nodes), np.broadcast_to(known, (len(nodes), len(known)))

    def drawn(self, model: PlaneMaps, pixels: slice | np.ndarray) -> np.ndarray:
        """Return (captured lights and nodes, 3, n) of the fitted model."""
        seen = predict_observations(each_map(model, lambda values: values[:, pixels]), self._lamps)
        return np.concatenate([self.coded(each.observations) for each in seen])
