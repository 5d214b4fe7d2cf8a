"""Predicted XYZ of a scene under a lamp, from its spectra where it has them, otherwise from the camera's channels."""

from dataclasses import dataclass

import numpy as np

from nishiki.colour.colour import white_xyz, xyz_matrix
from nishiki.evaluate.camera_colour import CameraColour
from nishiki.evaluate.prediction import PredictedLight


@dataclass(frozen=True)
class SceneColour:
    """How diffuse and specular light become XYZ under one lamp.

    white : (3,) XYZ of the perfect white facing the lamp; matrix : (3, K) for spectral coefficients, or None: then
    `camera` carries the predicted channels to XYZ.
    """

    white: np.ndarray
    matrix: np.ndarray | None
    camera: CameraColour | None

    def xyz(self, band: PredictedLight, coefficients: np.ndarray | None) -> np.ndarray:
        """(rows, columns, 3) float32.

        coefficients : (rows, columns, K) of the same rows. Gloss has the colour of the lamp.
        """
        if self.matrix is None or coefficients is None:
            return self.camera.xyz(band.channels).astype(np.float32)
        diffuse = (coefficients @ self.matrix.T.astype(np.float32)) * band.body[..., None]
        return diffuse + band.specular[..., None] * self.white.astype(np.float32)


def spectral_colour(lamp: np.ndarray, basis: np.ndarray) -> SceneColour:
    """Colour from spectral coefficients on `basis` (K, 61) under a lamp (61,)."""
    return SceneColour(white_xyz(lamp), xyz_matrix(lamp, basis), None)


def channel_colour(camera: CameraColour) -> SceneColour:
    """Colour from the camera's channels, under the lamp of the capture only."""
    return SceneColour(camera.white, None, camera)
