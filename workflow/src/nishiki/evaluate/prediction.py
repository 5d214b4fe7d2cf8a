"""What the fitted model says that the camera would observe under a lamp."""

from dataclasses import dataclass, field, fields

import numpy as np

from nishiki.render.relight import predict_observations
from nishiki.render.scene import Gloss, Light


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
    model: FittedModel, direction: np.ndarray, *, height: np.ndarray | None = None, pitch: float = 1.0
) -> PredictedLight:
    """Observation I' = rho max(n.l, 0) + beta D F G / cos_r (P eq. 10, camera channels, frontal view).

    direction : (3,) unit vector to the lamp; the observations are divided by the white board's, so that the lamp's
    fall-off is gone from them. height : (rows, columns) in the unit of `pitch`, for cast shadows; None: none are cast.
    """
    (found,) = predict_observations(
        model.normals,
        model.reflectance,
        [Light(direction=tuple(direction))],
        gloss=model.gloss,
        labels=model.labels,
        height=height,
        pitch=pitch,
    )
    cosine = np.maximum(model.normals @ np.asarray(direction, np.float32), 0.0)
    lit = (cosine > 0).astype(np.float32)
    if found.visibility is not None:
        lit *= found.visibility
        cosine *= found.visibility
    diffuse = model.reflectance.mean(axis=-1) * cosine
    specular = np.maximum(found.observations.mean(axis=-1) - diffuse, 0.0)
    return PredictedLight(found.observations, diffuse, specular, lit, cosine)


def gloss_from(parameters: dict) -> Gloss:
    """Gloss of the brdf stage's parameters: one entry in `regions` a region, each with beta, gamma, refractive_index.

    beta and gamma may be lists, one value a lobe. A lobe of a width that could not be found (None) counts as matte.
    """
    rows = []
    for region in parameters["regions"]:
        betas, gammas = (np.atleast_1d(np.array(region[name], dtype=object)) for name in ("beta", "gamma"))
        missing = [b is None or g is None for b, g in zip(betas, gammas, strict=True)]
        beta = [0.0 if gap else float(b) for b, gap in zip(betas, missing, strict=True)]
        gamma = [1.0 if gap else float(g) for g, gap in zip(gammas, missing, strict=True)]
        rows.append((beta, gamma, float(region["refractive_index"])))
    beta, gamma, index = zip(*rows, strict=True)
    return Gloss(beta=np.array(beta), gamma=np.array(gamma), refractive_index=np.array(index))
