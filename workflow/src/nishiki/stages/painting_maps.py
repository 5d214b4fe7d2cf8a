"""Read the finished maps of a painting, the input of pictures, pages, evaluations and exports."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, shading_normals, shrink
from nishiki.brdf.scene import gloss_table
from nishiki.brdf.slopes import products, slope_covariance, slopes_of
from nishiki.brdf.torrance_sparrow import MIRROR
from nishiki.colour.colour import white_xyz, xyz_matrix
from nishiki.errors import UserError, require
from nishiki.evaluate.camera_colour import CameraColour, display_map, displayed_colours
from nishiki.formats.files import read_json
from nishiki.observations.plane import Observations, point_mm
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.render.plane.scene import Gloss, Light
from nishiki.render.plane.shade import PlaneMaps, predict_observations
from nishiki.threads import strips


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
    model: PlaneMaps, light: Light, *, visibility: np.ndarray | None = None, pitch: float = 1.0
) -> PredictedLight:
    """Predict I' = (rho c f + beta D F G / cos_r) E with c = max(n.l, 0), frontal view, in camera channels.

    Tominaga and Tanaka (2004), eq. 10, with the factor f of the body shading (1: Lambert). light : with a direction, or
    a position relative to the centre of the maps in the unit of `pitch`; E is 1 but for a lamp with fall-off, where no
    white board has divided it out. visibility : (1, rows, columns) of cast shadows, if there are any.
    """
    (seen,) = predict_observations(model, [light], visibility=visibility, pitch=pitch)
    white = np.ones((*model.normals.shape[:2], 1), np.float32)
    metal = model.gloss.refractive_index >= MIRROR  # sends back its reflectance like a body
    body_only = replace(model.gloss, beta=model.gloss.beta * metal[:, None])
    matte_maps = model._replace(coefficients=white, gloss=body_only)
    (matte,) = predict_observations(matte_maps, [light], pitch=pitch)
    body = matte.values[..., 0]
    lit = ((body > 0) | model.mirrors).astype(np.float32)
    if visibility is not None:
        lit *= visibility[0]
        body *= visibility[0]
    diffuse = model.coefficients.mean(axis=-1) * body
    specular = np.maximum(seen.values.mean(axis=-1) - diffuse, 0.0)
    return PredictedLight(seen.values, diffuse, specular, lit, body)


def lower_light(light: Light, down: float) -> Light:
    """Return a lamp in the frame of maps whose middle lies so much below, in the unit of its position."""
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
    """Return the lamp of a captured light, as used in the normals stage.

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
    """Conversion of diffuse and specular light to XYZ under one lamp."""

    white: np.ndarray  # (3,) XYZ of the perfect white facing the lamp
    # (3, K) for spectral coefficients, or None: then `camera` carries the predicted channels to XYZ
    matrix: np.ndarray | None
    camera: CameraColour | None

    def xyz(self, band: PredictedLight, coefficients: np.ndarray | None) -> np.ndarray:
        """Compute XYZ (rows, columns, 3) float32.

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


class PaintingMaps:
    """The maps of one painting, read by bands of rows.

    Attributes
    ----------
    maps : Maps
        Maps of the stage normals.
    shape : (int, int)
        Rows and columns.
    band_rows : int
        Rows that are read at a time.
    pitch_mm : float or None
        Distance of two pixels; None where the capture states no scale.
    basis : (K, 61) ndarray or None
        Basis of the spectra; None where coefficients are the reflectance in the camera's channels.
    heights, labels : Maps or None
        With the map `height`, and with `labels`, regions of the gloss.
    glossy : bool
        Whether gloss was fitted.
    gloss : Gloss
        Gloss of every region; none where it was not fitted.
    terms : int
        Terms of the body shading: 0, 3 or 5.
    casts_shadows : bool
        Whether the height casts shadows: not where the body shading holds those of a pixel's surroundings.
    """

    def __init__(self, inputs: Mapping[str, Artifact]):
        brdf = inputs.get("brdf")
        self.maps = Maps(inputs["normals"].folder)
        self.heights, self._spectra = (
            Maps(inputs[name].folder) if name in inputs else None for name in ("height", "spectra")
        )
        maps = Maps(brdf.folder) if brdf and brdf.path("maps.zarr").is_dir() else None
        self.labels = maps if maps and "labels" in maps else None
        group, parameters = self.maps.group, None if brdf is None else read_json(brdf.path("parameters.json"))
        self.shape: tuple[int, int] = group["normals"].shape[:2]
        self.band_rows: int = group["normals"].chunks[0]
        self.pitch_mm: float | None = group.attrs.get("pixel_pitch_mm")
        self.basis = None if self._spectra is None else np.array(self._spectra.attributes("coefficients")["basis"])
        self.glossy = parameters is not None
        self.gloss = Gloss(*gloss_table(parameters)) if self.glossy else Gloss.none()
        self.terms = group["shading"].shape[-1] if "shading" in self.maps else 0
        # with more terms the body shading of normals holds the shadows that surroundings throw
        self.casts_shadows = self.terms <= 3

    @property
    def pitch(self) -> float:
        """Distance of two pixels in the unit of lengths."""
        return self.pitch_mm or 1.0

    @property
    def unit(self) -> str:
        """Unit of lengths."""
        return "mm" if self.pitch_mm else "pixels"

    @cached_property
    def _to_srgb(self) -> list[list[float]] | None:
        return display_map(self.maps)  # which is found over the whole painting

    def bands(self) -> Iterator[slice]:
        """Yield bands of rows from top to bottom."""
        return strips(self.shape[0], self.band_rows)

    def read_known(self, rows: slice) -> np.ndarray:
        """Return (r, columns) bool: pixels with an estimate."""
        return (self.maps.read("flags", rows) & NO_ESTIMATE) == 0

    def normals(self, rows: slice) -> np.ndarray:
        """Return (r, columns, 3) float32 unit normals, x right, y up, z to the camera; 0 where there is no estimate."""
        return np.where(self.read_known(rows)[..., None], self.maps.read("normals", rows), np.float32(0))

    def shading_normals(self, rows: slice) -> np.ndarray:
        """Read the normals that predict lamps, as `normals`; with few lights they differ (stage normals)."""
        return np.where(self.read_known(rows)[..., None], shading_normals(self.maps, rows), np.float32(0))

    def relief_normals(self, rows: slice) -> np.ndarray:
        """Read the normals of the relief, as `normals`: flattened where the height is."""
        if self.heights is None or "normals" not in self.heights:
            return self.normals(rows)
        return self.heights.read("normals", rows)

    def height(self, rows: slice) -> np.ndarray:
        """Return (r, columns) float32 height towards the camera in the unit of lengths, NaN where there is none."""
        if self.heights is None:
            raise UserError("export: the height is left out of this scene. Remedy: see ./nishiki plan for the reason")
        return self.heights.read("height", rows)

    def coefficients(self, rows: slice) -> np.ndarray:
        """Read (r, columns, K) coefficients of the spectra, or without spectra the reflectance in camera channels."""
        if self._spectra is None:
            return self.maps.read("reflectance", rows)
        return self._spectra.read("coefficients", rows)

    def display_colours(self, rows: slice) -> np.ndarray:
        """Read (r, columns, K) coefficients of the spectra, or without spectra linear sRGB."""
        colours = self.coefficients(rows)
        return colours if self._spectra else displayed_colours(colours, self._to_srgb)

    def shading(self, rows: slice) -> np.ndarray | None:
        """Read (r, columns, terms) terms of the body shading; None for Lambert's law."""
        return self.maps.read("shading", rows) if self.terms else None

    def regions(self, rows: slice) -> np.ndarray | None:
        """Return (r, columns) uint8 region of gloss of each pixel; None where the painting has one finish."""
        return None if self.labels is None else self.labels.read("labels", rows)

    def slopes(self, rows: slice) -> np.ndarray:
        """Compute the slope covariance inside the pixels, (r, columns, 3): xx, xy, yy; with the rows beside them."""
        first, last = max(rows.start - 1, 0), min(rows.stop + 1, self.shape[0])
        covariance = slope_covariance(self.shading_normals(slice(first, last)))
        return covariance[rows.start - first :][: rows.stop - rows.start]

    def block_slopes(self, block: int) -> np.ndarray:
        """Compute the slope covariance inside squares of pixels of the whole map, within and between the pixels.

        It is the mean of the covariances inside the square's known pixels, and the covariance of these pixels' slopes
        (Olano and Baker 2010); 0 where none is known.
        """
        if block == 1:
            return self.slopes(slice(0, self.shape[0]))

        def read(rows: slice) -> np.ndarray:
            slopes, known = slopes_of(self.shading_normals(rows))
            moments = np.concatenate([slopes, products(slopes) + self.slopes(rows)], axis=-1)
            return np.where(known[..., None], moments, np.float32(np.nan))

        moments = np.nan_to_num(shrink(read, self.shape, block))
        return moments[..., 2:] - products(moments[..., :2])

    def mean(self, read: Callable[[slice], np.ndarray], block: int) -> np.ndarray:
        """Average the known pixels of squares of the whole map, 0 where there are none; read: (r, columns, n)."""

        def read_known(rows: slice) -> np.ndarray:
            return np.where(self.read_known(rows)[..., None], read(rows), np.float32(np.nan))

        return np.nan_to_num(shrink(read_known, self.shape, block))

    def mean_normals(self, read: Callable[[slice], np.ndarray], block: int) -> np.ndarray:
        """Return unit normals of squares of pixels, 0 where there is no estimate."""
        mean = self.mean(read, block)
        if block == 1:
            return mean
        length = np.linalg.norm(mean, axis=-1, keepdims=True)
        return np.divide(mean, length, out=np.zeros_like(mean), where=length > 0)

    def model(self, rows: slice) -> PlaneMaps:
        """Return the model that predicts photographs of these rows; without gloss where it is omitted."""
        return PlaneMaps(
            self.shading_normals(rows),
            np.nan_to_num(self.maps.read("reflectance", rows)),
            self.gloss,
            self.shading(rows),
            self.slopes(rows) if self.glossy else None,
            self.regions(rows),
        )


def each_map(model: PlaneMaps, change: Callable[[np.ndarray], np.ndarray]) -> PlaneMaps:
    """Return a model with a function applied to each of its maps."""
    maps = {name: each for name, each in model._asdict().items() if name != "gloss" and each is not None}
    changed: dict[str, Any] = {name: change(each) for name, each in maps.items()}
    return model._replace(**changed)


def captured_lamp(frames: Observations, number: int, angular_radius: float = 0.0) -> Light:
    """Return the lamp of a captured light, at its position where the capture gives one; its radius in radians."""
    rows, columns = frames.shape
    position, centre = None, None
    if frames.positions_mm is not None:
        position, centre = frames.positions_mm[number], point_mm(frames, (rows - 1) / 2, (columns - 1) / 2)
    return light_of(
        frames.directions[number],
        position,
        centre=centre,
        white_board=frames.white_board,
        angular_radius=angular_radius,
    )
