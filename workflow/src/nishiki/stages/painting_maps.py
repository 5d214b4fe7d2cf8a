"""Read the finished maps of a painting, from which pictures, pages, evaluations and exports are made."""

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, directional_shading, maps_with, shading_normals, shrink
from nishiki.brdf.scene import gloss_table
from nishiki.brdf.slopes import products, slope_covariance, slopes_of
from nishiki.errors import UserError
from nishiki.evaluate.camera_colour import display_map, displayed_colours
from nishiki.evaluate.prediction import light_of
from nishiki.observations.parcels import point_mm
from nishiki.observations.plane import Observations
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.render.plane.scene import Gloss, Light
from nishiki.render.plane.shade import PlaneMaps
from nishiki.report.page import read_json
from nishiki.threads import strips


class PaintingMaps:
    """The maps of one painting, read by bands of rows.

    Attributes
    ----------
    maps : Maps
        Of the stage normals.
    shape : (int, int)
        Rows and columns.
    band_rows : int
        Rows that are read at a time.
    pitch_mm : float or None
        Distance of two pixels; None where the capture states no scale.
    basis : (K, 61) ndarray or None
        Of the spectra; None where coefficients are the reflectance in the camera's channels.
    heights, labels : Maps or None
        With the map `height`, and with `labels`, regions of the gloss.
    glossy : bool
        Whether gloss was fitted.
    gloss : Gloss
        Of every region; none where it was not fitted.
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
        self.labels = maps_with(brdf, "labels")
        group, parameters = self.maps.group, read_json(brdf, "parameters.json")
        self.shape: tuple[int, int] = group["normals"].shape[:2]
        self.band_rows: int = group["normals"].chunks[0]
        self.pitch_mm: float | None = group.attrs.get("pixel_pitch_mm")
        self.basis = None if self._spectra is None else np.array(self._spectra.attributes("coefficients")["basis"])
        self.glossy = parameters is not None
        self.gloss = Gloss(*gloss_table(parameters)) if self.glossy else Gloss.none()
        self.terms = group["shading"].shape[-1] if "shading" in self.maps else 0
        self.casts_shadows = not directional_shading(self.maps)

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

    def known(self, rows: slice) -> np.ndarray:
        """Return (r, columns) bool: pixels with an estimate."""
        return (self.maps.read("flags", rows) & NO_ESTIMATE) == 0

    def normals(self, rows: slice) -> np.ndarray:
        """Return (r, columns, 3) float32 unit normals, x right, y up, z to the camera; 0 where there is no estimate."""
        return np.where(self.known(rows)[..., None], self.maps.read("normals", rows), np.float32(0))

    def shading_normals(self, rows: slice) -> np.ndarray:
        """As `normals`, those that predict lamps: few lamps have their own (stage normals)."""
        return np.where(self.known(rows)[..., None], shading_normals(self.maps, rows), np.float32(0))

    def relief_normals(self, rows: slice) -> np.ndarray:
        """As `normals`, of the relief: flattened where the height is."""
        if self.heights is None or "normals" not in self.heights:
            return self.normals(rows)
        return self.heights.read("normals", rows)

    def height(self, rows: slice) -> np.ndarray:
        """Return (r, columns) float32 height towards the camera in the unit of lengths, NaN where there is none."""
        if self.heights is None:
            raise UserError("export: the height is left out of this scene. Remedy: see ./nishiki plan for the reason")
        return self.heights.read("height", rows)

    def coefficients(self, rows: slice) -> np.ndarray:
        """(r, columns, K) coefficients of the spectra, or the reflectance in the camera's channels without spectra."""
        if self._spectra is None:
            return self.maps.read("reflectance", rows)
        return self._spectra.read("coefficients", rows)

    def display_colours(self, rows: slice) -> np.ndarray:
        """(r, columns, K) coefficients of the spectra, or without spectra linear sRGB."""
        colours = self.coefficients(rows)
        return colours if self._spectra else displayed_colours(colours, self._to_srgb)

    def shading(self, rows: slice) -> np.ndarray | None:
        """(r, columns, terms) terms of the body shading; None for Lambert's law."""
        return self.maps.read("shading", rows) if self.terms else None

    def regions(self, rows: slice) -> np.ndarray | None:
        """Return (r, columns) uint8 region of gloss of each pixel; None where the painting has one finish."""
        return None if self.labels is None else self.labels.read("labels", rows)

    def slopes(self, rows: slice) -> np.ndarray:
        """Covariance of the slopes inside the pixels, (r, columns, 3): xx, xy, yy; with the rows beside them."""
        first, last = max(rows.start - 1, 0), min(rows.stop + 1, self.shape[0])
        covariance = slope_covariance(self.shading_normals(slice(first, last)))
        return covariance[rows.start - first :][: rows.stop - rows.start]

    def block_slopes(self, block: int) -> np.ndarray:
        """Covariance of the slopes inside squares of pixels of the whole map, of their pixels and between these.

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
        """Means over the known pixels of squares of the whole map, 0 where there are none; read: (r, columns, n)."""

        def known(rows: slice) -> np.ndarray:
            return np.where(self.known(rows)[..., None], read(rows), np.float32(np.nan))

        return np.nan_to_num(shrink(known, self.shape, block))

    def mean_normals(self, read: Callable[[slice], np.ndarray], block: int) -> np.ndarray:
        """Return unit normals of squares of pixels, 0 where there is no estimate."""
        mean = self.mean(read, block)
        if block == 1:
            return mean
        length = np.linalg.norm(mean, axis=-1, keepdims=True)
        return np.divide(mean, length, out=np.zeros_like(mean), where=length > 0)

    def model(self, rows: slice) -> PlaneMaps:
        """Return what predicts photographs of these rows; without gloss where it is left out."""
        return PlaneMaps(
            self.shading_normals(rows),
            np.nan_to_num(self.maps.read("reflectance", rows)),
            self.gloss,
            self.shading(rows),
            self.slopes(rows) if self.glossy else None,
            self.regions(rows),
        )


def each_map(model: PlaneMaps, change: Callable[[np.ndarray], np.ndarray]) -> PlaneMaps:
    """Return a model with each of its maps changed."""
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
