"""What the formats of a painting are made from: the finished maps with their colours, the relief as a mesh."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.colour.colour import adaptation_matrix, illuminant, srgb_matrix, white_xyz, xyz_matrix
from nishiki.evaluate.camera_colour import CameraColour, read_camera_colour
from nishiki.formats.coding import D50
from nishiki.observations.plane import Observations
from nishiki.stages.painting_maps import PaintingMaps

D65 = np.linalg.inv(srgb_matrix()).sum(axis=1)
"""White of sRGB."""


class ExportedScene(PaintingMaps):
    """The maps of one painting and the colours of its coefficients."""

    def __init__(self, inputs: Mapping[str, Artifact]):
        super().__init__(inputs)
        self._inputs = inputs

    def camera_colour(self) -> CameraColour:
        """From the camera's channels to XYZ: fitted where the capture has spectra of camera and lamp, else assumed."""
        channels = self.maps.group["reflectance"].shape[-1]
        to_srgb = Observations(self._inputs["ingest"].folder).to_srgb
        return read_camera_colour(self._inputs["ingest"].path("curves.npz"), channels, to_srgb)

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
