"""What the formats of a painting are made from: the finished maps by bands of rows, the relief as a mesh."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, directional_shading, maps_with, shading_normals
from nishiki.brdf.scene import gloss_table
from nishiki.brdf.slopes import products, slope_covariance, slopes_of
from nishiki.colour.colour import adaptation_matrix, illuminant, srgb_matrix, white_xyz, xyz_matrix
from nishiki.errors import UserError
from nishiki.evaluate.camera_colour import CameraColour, read_camera_colour
from nishiki.formats.coding import D50
from nishiki.observations.plane import Observations
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.render.plane.scene import Gloss
from nishiki.render.plane.shade import PlaneMaps
from nishiki.report.page import read_json
from nishiki.threads import strips

D65 = np.linalg.inv(srgb_matrix()).sum(axis=1)
"""White of sRGB."""


class ExportedScene:
    """The maps of one painting.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns.
    band_rows : int
        Rows that are read at a time.
    pitch_mm : float or None
        Distance of two pixels; None where the capture states no scale.
    """

    def __init__(self, inputs: Mapping[str, Artifact]):
        self._inputs = inputs
        self._frames = Observations(inputs["ingest"].folder)
        self._maps = Maps(inputs["normals"].folder)
        self._height = Maps(inputs["height"].folder) if "height" in inputs else None
        self._spectra = Maps(inputs["spectra"].folder) if "spectra" in inputs else None
        self._labels = maps_with(inputs.get("brdf"), "labels")
        self.shape: tuple[int, int] = self._maps.group["normals"].shape[:2]
        self.band_rows: int = self._maps.group["normals"].chunks[0]
        self.pitch_mm: float | None = self._maps.group.attrs.get("pixel_pitch_mm")

    @property
    def pitch(self) -> float:
        """Distance of two pixels in the unit of lengths."""
        return self.pitch_mm or 1.0

    @property
    def unit(self) -> str:
        """Unit of lengths."""
        return "mm" if self.pitch_mm else "pixels"

    def bands(self) -> Iterator[slice]:
        """Yield bands of rows from top to bottom."""
        return strips(self.shape[0], self.band_rows)

    def known(self, rows: slice) -> np.ndarray:
        """Return (r, columns) bool: pixels with an estimate."""
        return (self._maps.read("flags", rows) & NO_ESTIMATE) == 0

    def normals(self, rows: slice) -> np.ndarray:
        """Return (r, columns, 3) float32 unit normals, x right, y up, z to the camera; 0 where there is no estimate."""
        return np.where(self.known(rows)[..., None], self._maps.read("normals", rows), np.float32(0))

    def shading_normals(self, rows: slice) -> np.ndarray:
        """As `normals`, those that predict lamps: few lamps have their own (stage normals)."""
        return np.where(self.known(rows)[..., None], shading_normals(self._maps, rows), np.float32(0))

    def slopes(self, rows: slice, step: int = 1) -> np.ndarray:
        """Covariance of the slopes inside squares of pixels: xx, xy, yy.

        Parameters
        ----------
        rows : slice
            Beginning with a square's first row.
        step : int
            Pixels along the side of a square. Of 1 it is the covariance inside a pixel, as the stage render takes it.

        Returns
        -------
        (r / step, columns / step, 3) ndarray: the mean of the covariances inside the square's known pixels, and the
        covariance of these pixels' slopes (Olano and Baker 2010); 0 where none is known.
        """
        first, last = max(rows.start - 1, 0), min(rows.stop + 1, self.shape[0])
        normals, inside = self.shading_normals(slice(first, last)), slice(rows.start - first, rows.stop - first)
        covariance = slope_covariance(normals)[inside]
        if step == 1:
            return covariance
        slopes, known = slopes_of(normals[inside])
        share = np.maximum(block_mean(known, step), 1e-9)[..., None]
        mean = block_mean(slopes * known[..., None], step) / share
        squares = block_mean((covariance + products(slopes)) * known[..., None], step) / share
        return squares - products(mean)

    def slope_variance(self, rows: slice, step: int = 1) -> np.ndarray:
        """Return (r / step, columns / step): mean over the directions of what `slopes` has."""
        return self.slopes(rows, step)[..., ::2].mean(axis=-1)

    def relief_normals(self, rows: slice) -> np.ndarray:
        """As `normals`, of the relief: flattened where the height is."""
        if self._height is None or "normals" not in self._height:
            return self.normals(rows)
        return self._height.read("normals", rows)

    def height(self, rows: slice) -> np.ndarray:
        """Return (r, columns) float32 height towards the camera in the unit of lengths, NaN where there is none."""
        if self._height is None:
            raise UserError("export: the height is left out of this scene. Remedy: see ./nishiki plan for the reason")
        return self._height.read("height", rows)

    @property
    def basis(self) -> np.ndarray | None:
        """(K, 61) basis of the spectra, or None where there are none."""
        return None if self._spectra is None else np.array(self._spectra.attributes("coefficients")["basis"])

    def coefficients(self, rows: slice) -> np.ndarray:
        """(r, columns, K) coefficients of the spectra, or the reflectance in the camera's channels without spectra."""
        if self._spectra is None:
            return self._maps.read("reflectance", rows)
        return self._spectra.read("coefficients", rows)

    def camera_colour(self) -> CameraColour:
        """From the camera's channels to XYZ: fitted where the capture has spectra of camera and lamp, else assumed."""
        channels = self._maps.group["reflectance"].shape[-1]
        return read_camera_colour(self._inputs["ingest"].path("curves.npz"), channels, self._frames.to_srgb)

    def to_srgb(self) -> np.ndarray:
        """(3, K) from coefficients to linear sRGB: spectra under D65, else the camera's channels with white kept."""
        if self.basis is not None:
            lamp = illuminant("D65")
            return srgb_matrix() @ adaptation_matrix(white_xyz(lamp), D65) @ xyz_matrix(lamp, self.basis)
        colour = self.camera_colour()
        return srgb_matrix() @ adaptation_matrix(colour.white, D65) @ colour.matrix

    def srgb(self, rows: slice) -> np.ndarray:
        """Return (r, columns, 3) diffuse colour in linear sRGB; 0 where there is no estimate."""
        return np.where(self.known(rows)[..., None], np.nan_to_num(self.coefficients(rows)) @ self.to_srgb().T, 0)

    def regions(self, rows: slice) -> np.ndarray | None:
        """Return (r, columns) uint8 region of gloss of each pixel; None where the painting has one finish."""
        return None if self._labels is None else self._labels.read("labels", rows)

    def fitted_model(self, rows: slice) -> PlaneMaps:
        """Return what predicts photographs of these rows; without gloss where it is left out."""
        parameters = read_json(self._inputs.get("brdf"), "parameters.json")
        labels = self.regions(rows) if parameters is not None and len(gloss_table(parameters)[0]) > 1 else None
        return PlaneMaps(
            self.shading_normals(rows),
            np.nan_to_num(self._maps.read("reflectance", rows)),
            Gloss.none() if parameters is None else Gloss(*gloss_table(parameters)),
            self._maps.read("shading", rows) if "shading" in self._maps else None,
            self.slopes(rows) if parameters is not None else None,
            labels,
        )

    def shading(self, rows: slice) -> np.ndarray:
        """Return (r, columns, 3) terms a, b, d of the body shading, (1, 0, 0) for Lambert's law."""
        if "shading" in self._maps:
            return self._maps.read("shading", rows)[..., :3]
        return np.broadcast_to(np.array([1, 0, 0], np.float32), (*self.known(rows).shape, 3))

    @property
    def has_directional_shading(self) -> bool:
        """Whether the body shading holds the shadows of a pixel's surroundings: no others are cast on top of it."""
        return directional_shading(self._maps)

    def directional_terms(self, rows: slice) -> np.ndarray:
        """Return (r, columns, 2) terms e_x, e_y of such a body shading."""
        return self._maps.read("shading", rows)[..., 3:]

    def to_xyz_d50(self) -> tuple[np.ndarray, str]:
        """(3, K) from coefficients to XYZ under D50, white (0.9642, 1, 0.8249); where it comes from, in words."""
        if self.basis is not None:
            lamp = illuminant("D50")
            matrix, how = xyz_matrix(lamp, self.basis), "spectra under D50"
            white = xyz_matrix(lamp, np.eye(lamp.size)).sum(axis=1)
        else:
            colour = self.camera_colour()
            matrix, white, how = colour.matrix, colour.white, colour.how
        return adaptation_matrix(white, np.array(D50)) @ matrix, how


def block_mean(values: np.ndarray, step: int) -> np.ndarray:
    """Return means over squares of pixels (the last ones may be smaller), float64."""
    if step == 1:
        return values.astype(np.float64)
    sums = np.asarray(values, np.float64)
    for axis in (0, 1):
        starts = np.arange(0, values.shape[axis], step)
        counts = np.diff([*starts, values.shape[axis]])
        shape = [1] * values.ndim
        shape[axis] = len(starts)
        sums = np.add.reduceat(sums, starts, axis=axis) / counts.reshape(shape)
    return sums


@dataclass(frozen=True)
class Relief:
    """Some rows of vertices of the mesh, and the triangles between them and the row above."""

    step: int  # pixels along the side of the square that a vertex stands for
    # places, normals: (v, 3) float32 ndarray: positions in the scene's unit, origin in the middle of the picture; unit
    # normals
    places: np.ndarray
    normals: np.ndarray
    colours: np.ndarray  # (v, 3) float32 ndarray: linear sRGB, 0 where none was asked for
    texture: np.ndarray  # (v, 2) float32 ndarray: place in the picture, 0 to 1, from its left and its top
    # (t, 3) int64 ndarray: numbers of vertices, counted from the first of the whole mesh; counter-clockwise seen from
    # the camera
    triangles: np.ndarray


def reliefs(scene: ExportedScene, most: int, *, colours: np.ndarray | None) -> Iterator[Relief]:
    """Yield the mesh from top to bottom, at most `most` vertices, each the mean over a square of pixels with height.

    Vertices stand in the middles of their squares. So that the mesh is as large as the picture, there is one more row
    or column of them on each of its edges, with the heights of their neighbours. At the edge of an object inside the
    picture the mesh ends at the middles of the outer squares.

    colours : (3, K) from the coefficients to linear sRGB; None: they are not read.
    """
    rows, columns = scene.shape
    longest = max(rows, columns)
    step = next((n for n in range(1, longest) if (-(-rows // n) + 2) * (-(-columns // n) + 2) <= most), longest)
    across = -(-columns // step)
    high = max(1, scene.band_rows // step) * step
    places_across = np.minimum((np.arange(across) + 0.5) * step, (np.arange(across) * step + columns) / 2)
    right = np.concatenate([[0], places_across, [columns]])
    above = np.full(len(right), -1, np.int64)
    count = 0
    for top in range(0, rows, high):
        band = slice(top, min(top + high, rows))
        height = scene.height(band)
        known = np.isfinite(height)
        share = block_mean(known, step)
        weight = np.where(share > 0, share, 1)
        middles = top + (np.arange(len(share)) + 0.5) * step
        down = np.minimum(middles, (np.minimum(middles + step / 2, rows) + middles - step / 2) / 2)
        edges = (int(top == 0), int(band.stop == rows))
        down = np.concatenate([[0] * edges[0], down, [rows] * edges[1]])
        here = _with_edges(share >= 0.5, edges)
        x = np.broadcast_to((right - columns / 2) * scene.pitch, here.shape)
        y = np.broadcast_to(((rows / 2 - down) * scene.pitch)[:, None], here.shape)
        z = _with_edges(block_mean(np.where(known, height, 0), step) / weight, edges)
        normals = block_mean(np.where(known[..., None], scene.relief_normals(band), 0), step)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.where(length > 0, normals / np.where(length > 0, length, 1), [0, 0, 1])
        linear = np.zeros_like(normals)
        if colours is not None:
            values = np.where(known[..., None], np.nan_to_num(scene.coefficients(band)), 0)
            linear = (block_mean(values, step) / weight[..., None]) @ colours.T
        normals, linear = (_with_edges(values, edges) for values in (normals, linear))
        numbers = np.where(here, count + np.cumsum(here).reshape(here.shape) - 1, -1)
        count += int(here.sum())
        u = np.broadcast_to(right / columns, here.shape)
        v = np.broadcast_to((down / rows)[:, None], here.shape)
        places = np.concatenate([above[None], numbers]) if top else numbers
        corners = np.stack([places[:-1, :-1], places[:-1, 1:], places[1:, :-1], places[1:, 1:]], axis=-1)
        corners = corners[corners.min(axis=-1) >= 0]  # two triangles between four neighbours that are all there
        triangles = corners[:, [0, 2, 1, 1, 2, 3]].reshape(-1, 3)
        above = numbers[-1]
        yield Relief(
            step,
            np.stack([x, y, z], axis=-1)[here].astype(np.float32),
            normals[here].astype(np.float32),
            linear[here].astype(np.float32),
            np.stack([u, v], axis=-1)[here].astype(np.float32),
            triangles,
        )


def _with_edges(values: np.ndarray, edges: tuple[int, int]) -> np.ndarray:
    """Values (rows, columns, ...) with the first and last column once more, and so many more first and last rows."""
    return np.pad(values, [edges, (1, 1), *[(0, 0)] * (values.ndim - 2)], mode="edge")
