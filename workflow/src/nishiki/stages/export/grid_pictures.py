"""A painting under the lights of a grid over the hemisphere: the fitted model, put right by the photographs.

    x0 = m_G + W (p - m_L),    x = x0 + (A'A + s I)^-1 A' (p - A x0)

p are the photographs, m_L and m_G what the fitted model (stages normals and brdf, without cast shadows) draws under
the captured lights and those of the grid, all coded for the screen, W Gaussians between the lights, sum 1, and A the
weights by which a viewer interpolates between the nodes of the grid: what is shown under a captured light is nearly its
photograph. The correction by A is that of F. Ponchio, M. Corsini and R. Scopigno (2018), A compact
representation of relightable images for the web, whose x0 is W p.
"""

import numpy as np

from nishiki.formats.relight_weights import gaussian_weights, grid_directions
from nishiki.observations.plane import Observations
from nishiki.render.plane.relight import predict_observations
from nishiki.render.plane.scene import Light
from nishiki.stages.export.light_models import GRID_SIDE, grid_weights
from nishiki.stages.export.photographs import Photographs
from nishiki.stages.export.scene import ExportedScene

WIDTH = 0.3  # of the Gaussians, as distances of unit vectors
STIFFNESS = 0.1  # s: weight of x0 beside the photographs
LOWEST_Z = 0.1  # before normalising, of the lights that the model draws: 6 degrees above the plane
BEYOND = 0.5  # below 0 and above 1 that values at nodes may be


class GridPictures(Photographs):
    """Pictures under the lights of the grid. lights : indices of the captured ones."""

    pixels = 1 << 13

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

    def seen(
        self, rows: slice, pixels: slice | np.ndarray, values: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(nodes, 3, n) values and (nodes, n) bool of some pixels, known or photographed under every light."""
        drawn = self.drawn(rows, pixels)
        rest = (values - drawn[: len(values)]) * valid[:, None]
        both = np.concatenate([drawn, rest]).reshape(self._of_both.shape[1], -1)
        nodes = (self._of_both @ both).reshape(-1, *drawn.shape[1:])
        known = self._scene.known(rows).ravel()[pixels] | valid.all(axis=0)
        return np.clip(nodes, -BEYOND, 1 + BEYOND, out=nodes), np.broadcast_to(known, (len(nodes), len(known)))

    def drawn(self, rows: slice, pixels: slice | np.ndarray) -> np.ndarray:
        """(captured lights and nodes, 3, n) of the fitted model."""
        model = self._scene.fitted_model(rows)

        def some(maps: np.ndarray | None) -> np.ndarray | None:
            return None if maps is None else maps.reshape(-1, *maps.shape[2:])[pixels][None]

        normals, reflectance, labels, shading, slopes = map(
            some, (model.normals, model.reflectance, model.labels, model.shading, model.slopes)
        )
        seen = predict_observations(
            normals, reflectance, self._lamps, shading=shading, slopes=slopes, gloss=model.gloss, labels=labels
        )
        return np.stack([self.coded(each.observations[0]) for each in seen])
