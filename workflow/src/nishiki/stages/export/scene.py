"""Read the inputs of a painting's formats: its maps with their colours, the relief as a mesh, its photographs."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.colour.colour import (
    adaptation_matrix,
    encode,
    illuminant,
    srgb_matrix,
    white_xyz,
    xyz_matrix,
    xyz_to_srgb_linear,
)
from nishiki.evaluate.camera_colour import CameraColour, read_camera_colour
from nishiki.formats.coding import D50
from nishiki.formats.relight import gaussian_weights, grid_directions
from nishiki.observations.plane import Observations
from nishiki.render.plane.scene import Light
from nishiki.render.plane.shade import PlaneMaps, predict_observations
from nishiki.stages.export.light_models import GRID_SIDE, grid_weights
from nishiki.stages.painting_maps import PaintingMaps, each_map

D65 = np.linalg.inv(srgb_matrix()).sum(axis=1)
"""White of sRGB."""


class ExportedScene(PaintingMaps):
    """The maps of one painting and the colours of its coefficients."""

    def __init__(self, inputs: Mapping[str, Artifact]):
        super().__init__(inputs)
        self._inputs = inputs

    def camera_colour(self) -> CameraColour:
        """Return the map from camera channels to XYZ: fitted where the capture has spectra, else assumed."""
        channels = self.maps.group["reflectance"].shape[-1]
        to_srgb = Observations(self._inputs["ingest"].folder).to_srgb
        return read_camera_colour(self._inputs["ingest"].path("curves.npz"), channels, to_srgb)

    def to_srgb(self) -> np.ndarray:
        """Compute (3, K) from coefficients to linear sRGB: spectra under D65, else camera channels with white kept."""
        if self.basis is not None:
            lamp = illuminant("D65")
            return srgb_matrix() @ adaptation_matrix(white_xyz(lamp), D65) @ xyz_matrix(lamp, self.basis)
        colour = self.camera_colour()
        return srgb_matrix() @ adaptation_matrix(colour.white, D65) @ colour.matrix

    def srgb(self, rows: slice) -> np.ndarray:
        """Compute (r, columns, 3) diffuse colour in linear sRGB; 0 where there is no estimate."""
        return np.where(self.read_known(rows)[..., None], np.nan_to_num(self.coefficients(rows)) @ self.to_srgb().T, 0)

    def body_terms(self, rows: slice) -> np.ndarray:
        """Return (r, columns, 3) terms a, b, d of the body shading, (1, 0, 0) for Lambert's law."""
        terms = self.shading(rows)
        return np.full((*self.read_known(rows).shape, 3), [1, 0, 0], np.float32) if terms is None else terms[..., :3]

    def to_xyz_d50(self) -> tuple[np.ndarray, str]:
        """Compute (3, K) from coefficients to XYZ under D50, white (0.9642, 1, 0.8249); return its source in words."""
        if self.basis is not None:
            lamp = illuminant("D50")
            matrix, how = xyz_matrix(lamp, self.basis), "spectra under D50"
            white = xyz_matrix(lamp, np.eye(lamp.size)).sum(axis=1)
        else:
            colour = self.camera_colour()
            matrix, white, how = colour.matrix, colour.white, colour.how
        return adaptation_matrix(white, np.array(D50)) @ matrix, how


def block_mean(values: np.ndarray, step: int) -> np.ndarray:
    """Average squares of pixels (the last ones may be smaller), float64."""
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
    """Pad values (rows, columns, ...) by the first and last column, and so many first and last rows."""
    return np.pad(values, [edges, (1, 1), *[(0, 0)] * (values.ndim - 2)], mode="edge")


CODED_STEPS = 65535  # of the table of coded values: at most .0001 off the curve


class CodedPhotographs:
    """The photographs as sRGB-coded colours relative to a white that faces the lamp."""

    pixels: int | None = None
    """Approximate number of pixels at a time; None: as many as are read at a time."""

    def __init__(self, frames: Observations, scene: ExportedScene):
        colour = scene.camera_colour()
        self.frames = frames
        self.matrix = np.float32(CODED_STEPS * xyz_to_srgb_linear(colour.matrix.T, white=colour.white).T)
        self.table = np.float32(encode(np.arange(CODED_STEPS + 1) / CODED_STEPS, "srgb"))

    def code(self, observations: np.ndarray) -> np.ndarray:
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
                yield part, *self.render_fit(model, pixels, self.code(here), known)

    def fitted_model(self, band: slice) -> Any:
        """Return the data that `seen` requires of a band besides its photographs."""
        return None

    def render_fit(
        self, model: Any, pixels: slice | np.ndarray, values: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the fitted values of some pixels of a band; values (lights, 3, n), validity of the photographs."""
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
                read = ((row, self.frames.decode(codes[:, row : row + 1], lights, band.start + row)) for row in rows)
                pieces = [[each[:, 0, chosen[band.start + row]] for each in arrays] for row, arrays in read]
                each, usable = (np.concatenate(arrays, axis=1) for arrays in zip(*pieces, strict=True))
                here = np.flatnonzero(chosen[band])
                found.append(self.render_fit(self.fitted_model(band), here, self.code(each), usable))
        values, valid = (np.concatenate(arrays, axis=-1) for arrays in zip(*found, strict=True))
        return values, valid


WIDTH = 0.3  # of the Gaussians, as distances of unit vectors
STIFFNESS = 0.1  # s: weight of x0 beside the photographs
LOWEST_Z = 0.1  # before normalising, of the lights that the model draws: 6 degrees above the plane
BEYOND = 0.5  # below 0 and above 1 that values at nodes may be


class GridPictures(CodedPhotographs):
    """Pictures under the lights of a grid.

        x0 = m_G + W (p - m_L),    x = x0 + (A'A + s I)^-1 A' (p - A x0)

    p are the photographs, m_L and m_G what the fitted model (stages normals and brdf, without cast shadows) draws under
    the captured lights and those of the grid, all coded for the screen, W Gaussians between the lights, sum 1, and A
    the weights by which a viewer interpolates between the nodes of the grid: what is shown under a captured light is
    nearly its photograph. The correction by A is that of F. Ponchio, M. Corsini and R. Scopigno (2018), A compact
    representation of relightable images for the web, whose x0 is W p. lights : indices of the captured ones.
    """

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
        return flat, self._scene.read_known(band).ravel()

    def render_fit(
        self, model: tuple[PlaneMaps, np.ndarray], pixels: slice | np.ndarray, values: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (nodes, 3, n) values and (nodes, n) bool of some pixels, known or photographed under every light."""
        drawn = self.render_model(model[0], pixels)
        rest = (values - drawn[: len(values)]) * valid[:, None]
        both = np.concatenate([drawn, rest]).reshape(self._of_both.shape[1], -1)
        nodes = (self._of_both @ both).reshape(-1, *drawn.shape[1:])
        known = model[1][pixels] | valid.all(axis=0)
        return np.clip(nodes, -BEYOND, 1 + BEYOND, out=nodes), np.broadcast_to(known, (len(nodes), len(known)))

    def render_model(self, model: PlaneMaps, pixels: slice | np.ndarray) -> np.ndarray:
        """Render (captured lights and nodes, 3, n) of the fitted model."""
        seen = predict_observations(each_map(model, lambda values: values[:, pixels]), self._lamps)
        return np.concatenate([self.code(each.values) for each in seen])
