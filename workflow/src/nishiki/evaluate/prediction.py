"""What the fitted model says that the camera would observe under a lamp."""

from dataclasses import dataclass, field, fields

import numpy as np

from nishiki.render.relight import predict_observations
from nishiki.render.scene import Gloss, Light

_BAND_ROWS = 256


@dataclass(frozen=True)
class FittedModel:
    """Maps of the fit, on camera pixels.

    normals : (rows, columns, 3) float32; reflectance : (rows, columns, channels) float32, relative to white; gloss :
    Torrance-Sparrow parameters by region; labels : (rows, columns) uint8 region of each pixel, or None.
    """

    normals: np.ndarray
    reflectance: np.ndarray
    gloss: Gloss = field(default_factory=Gloss.none)
    labels: np.ndarray | None = None


@dataclass(frozen=True)
class PredictedLight:
    """A scene under one lamp, all (rows, columns) float32 but the first.

    channels : (rows, columns, C) as the camera would see them, relative to white; diffuse, specular : their parts, mean
    over channels; lit : share of the lamp that is visible, 0 where n.l <= 0; cosine : max(n.l, 0) times that share.
    """

    channels: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    lit: np.ndarray
    cosine: np.ndarray

    def band(self, rows: slice) -> "PredictedLight":
        """The same, of some rows."""
        return PredictedLight(*(getattr(self, f.name)[rows] for f in fields(self)))


def predict_light(
    model: FittedModel, light: Light, *, height: np.ndarray | None = None, pitch: float = 1.0
) -> PredictedLight:
    """Observation I' = (rho max(n.l, 0) + beta D F G / cos_r) E (P eq. 10, camera channels, frontal view).

    light : with a direction, or a position relative to the centre of the maps in the unit of `pitch`; E is 1 but for a
    lamp with fall-off, where no white board has divided it out. height : (rows, columns) in the unit of `pitch`, for
    cast shadows; None: none are cast.
    """
    (found,) = predict_observations(
        model.normals,
        model.reflectance,
        [light],
        gloss=model.gloss,
        labels=model.labels,
        height=height,
        pitch=pitch,
    )
    cosine = np.empty(model.normals.shape[:2], np.float32)
    for start in range(0, len(cosine), _BAND_ROWS):
        rows = slice(start, min(start + _BAND_ROWS, len(cosine)))
        cosine[rows] = _irradiance(model.normals[rows], light, rows, cosine.shape, pitch)
    lit = (cosine > 0).astype(np.float32)
    if found.visibility is not None:
        lit *= found.visibility
        cosine *= found.visibility
    diffuse = model.reflectance.mean(axis=-1) * cosine
    specular = np.maximum(found.observations.mean(axis=-1) - diffuse, 0.0)
    return PredictedLight(found.observations, diffuse, specular, lit, cosine)


def _irradiance(normals: np.ndarray, light: Light, rows: slice, shape: tuple[int, int], pitch: float) -> np.ndarray:
    """max(n.l, 0) E of some rows of a map of this shape (rows, columns)."""
    source = light.homogeneous()
    if source[3] == 0:
        return light.intensity * np.maximum(normals @ source[:3].astype(np.float32), 0.0)
    x = source[0] - pitch * (np.arange(shape[1]) - (shape[1] - 1) / 2)
    y = source[1] - pitch * ((shape[0] - 1) / 2 - np.arange(rows.start, rows.stop)[:, None])
    square = x**2 + y**2 + source[2] ** 2
    along = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2] * source[2]
    strength = light.intensity * (float(source[:3] @ source[:3]) / square if light.falloff else 1.0)
    return np.maximum(along, 0.0) / np.sqrt(square) * strength


def light_of(
    direction: np.ndarray,
    position: np.ndarray | None,
    *,
    centre: np.ndarray | None = None,
    white_board: bool = True,
    angular_radius: float = 0.0,
) -> Light:
    """The lamp of a captured light, as the normals stage sees it.

    direction : (3,); position : (3,) from the middle of the photograph, or None; centre : (3,) middle of the maps seen
    from there; white_board : whether the observations are free of the lamp's fall-off.
    """
    if position is None:
        return Light(direction=tuple(direction), angular_radius=angular_radius)
    here = np.asarray(position, float) - centre
    intensity = 1.0 if white_board else float(np.sum(np.square(position)) / np.sum(here**2))
    return Light(position_mm=tuple(here), intensity=intensity, falloff=not white_board, angular_radius=angular_radius)
