"""What the fitted model predicts under a lamp, in the camera's channels and as XYZ."""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.torrance_sparrow import MIRROR
from nishiki.colour.colour import white_xyz, xyz_matrix
from nishiki.errors import require
from nishiki.evaluate.camera_colour import CameraColour
from nishiki.render.plane.scene import Light
from nishiki.render.plane.shade import PlaneMaps, predict_observations


@dataclass(frozen=True)
class PredictedLight:
    """A scene under one lamp, all (rows, columns) float32 but the first.

    channels : (rows, columns, C) as the camera would see them, relative to white; diffuse, specular : their parts, mean
    over channels; lit : share of the lamp that is visible, 0 where n.l <= 0; body : what a reflectance of 1 would send
    back, max(n.l, 0) times the factor of the body shading and that share.
    """

    channels: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    lit: np.ndarray
    body: np.ndarray


def predict_light(
    model: PlaneMaps,
    light: Light,
    *,
    height: np.ndarray | None = None,
    visibility: np.ndarray | None = None,
    pitch: float = 1.0,
) -> PredictedLight:
    """Return observation I' = (rho c f + beta D F G / cos_r) E with c = max(n.l, 0), frontal view, in camera channels.

    Tominaga and Tanaka (2004), eq. 10, with the factor f of the body shading (1: Lambert). light : with a direction, or
    a position relative to the centre of the maps in the unit of `pitch`; E is 1 but for a lamp with fall-off, where no
    white board has divided it out. height : (rows, columns) in the unit of `pitch`, for cast shadows; None: none are
    cast. visibility : (1, rows, columns) computed before, in place of a height.
    """
    (seen,) = predict_observations(model, [light], height=height, visibility=visibility, pitch=pitch)
    white = np.ones((*model.normals.shape[:2], 1), np.float32)
    metal = model.gloss.refractive_index >= MIRROR  # sends back its reflectance like a body
    body_only = replace(model.gloss, beta=model.gloss.beta * metal[:, None])
    matte_maps = model._replace(coefficients=white, gloss=body_only)
    (matte,) = predict_observations(matte_maps, [light], pitch=pitch)
    body = matte.observations[..., 0]
    lit = ((body > 0) | model.mirrors).astype(np.float32)
    if seen.visibility is not None:
        lit *= seen.visibility
        body *= seen.visibility
    diffuse = model.coefficients.mean(axis=-1) * body
    specular = np.maximum(seen.observations.mean(axis=-1) - diffuse, 0.0)
    return PredictedLight(seen.observations, diffuse, specular, lit, body)


def seen_from(light: Light, down: float) -> Light:
    """Return a lamp as maps see it whose middle lies so much below, in the unit of its position."""
    if light.position_mm is None:
        return light
    x, y, z = light.position_mm
    place = (x, y + down, z)
    share = sum(v * v for v in light.position_mm) / sum(v * v for v in place) if light.falloff else 1.0
    return replace(light, position_mm=place, intensity=light.intensity * share)


def light_of(
    direction: np.ndarray,
    position: np.ndarray | None,
    *,
    centre: np.ndarray | None = None,
    white_board: bool = True,
    angular_radius: float = 0.0,
) -> Light:
    """Return the lamp of a captured light, as the normals stage sees it.

    direction : (3,); position : (3,) from the middle of the photograph, or None; centre : (3,) middle of the maps seen
    from there; white_board : whether the observations are free of the lamp's fall-off.
    """
    if position is None:
        return Light(direction=tuple(direction), angular_radius=angular_radius)
    here = np.asarray(position, float) - centre
    intensity = 1.0 if white_board else float(np.sum(np.square(position)) / np.sum(here**2))
    return Light(position_mm=tuple(here), intensity=intensity, falloff=not white_board, angular_radius=angular_radius)


@dataclass(frozen=True)
class SceneColour:
    """How diffuse and specular light become XYZ under one lamp."""

    white: np.ndarray  # (3,) XYZ of the perfect white facing the lamp
    # (3, K) for spectral coefficients, or None: then `camera` carries the predicted channels to XYZ
    matrix: np.ndarray | None
    camera: CameraColour | None

    def xyz(self, band: PredictedLight, coefficients: np.ndarray | None) -> np.ndarray:
        """Return (rows, columns, 3) float32.

        coefficients : (rows, columns, K) of the same rows. Gloss has the colour of the lamp.
        """
        if self.matrix is None or coefficients is None:
            return require(self.camera).xyz(band.channels).astype(np.float32)
        diffuse = (coefficients @ self.matrix.T.astype(np.float32)) * band.body[..., None]
        return diffuse + band.specular[..., None] * self.white.astype(np.float32)


def spectral_colour(lamp: np.ndarray, basis: np.ndarray) -> SceneColour:
    """Return colour from spectral coefficients on `basis` (K, 61) under a lamp (61,)."""
    return SceneColour(white_xyz(lamp), xyz_matrix(lamp, basis), None)


def channel_colour(camera: CameraColour) -> SceneColour:
    """Return colour from the camera's channels, under the lamp of the capture only."""
    return SceneColour(camera.white, None, camera)
