"""Measure the density of pixels on each triangle, and how well an atlas serves it."""

from dataclasses import dataclass

import numpy as np

from nishiki.atlas.atlas import Atlas
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh


@dataclass(frozen=True)
class Density:
    """The sampling of triangles by the pictures."""

    # (f,) float64: area in pixels of each triangle in its chosen view, 0 where too few views face it
    pixels: np.ndarray
    # (f, 2) float64: squared pixels there for one unit along (down, right) of the triangle's plane coordinates
    along: np.ndarray


def sampling_density(mesh: Mesh, plane: np.ndarray, cameras: list[Camera], *, percentile: float = 90) -> Density:
    """Measure each triangle's sampling in the view at the percentile of its areas over all views.

    plane (f, 3, 2): as of `flatten`. Occlusion is not asked: whoever faces a triangle counts.
    """
    seen = np.array([facing_areas(mesh, camera) for camera in cameras])
    place = round(percentile / 100 * (len(cameras) - 1))
    chosen = np.argpartition(seen, place, axis=0)[place]
    down, right = np.moveaxis(plane[:, 1:] - plane[:, :1], 2, 0)  # of two edges each
    det = down[:, 0] * right[:, 1] - down[:, 1] * right[:, 0]
    areas, along = np.zeros(len(mesh.triangles)), np.zeros((len(mesh.triangles), 2))
    for index, camera in enumerate(cameras):
        some = np.flatnonzero((chosen == index) & (seen[index] > 0) & (det != 0))
        corners = camera.project(mesh.vertices)[0][mesh.triangles[some]]
        first, second = (corners[:, k] - corners[:, 0] for k in (1, 2))
        (d1, d2), (r1, r2), area = down[some].T[..., None], right[some].T[..., None], det[some, None]
        areas[some] = seen[index, some]
        along[some, 0] = (((first * r2 - second * r1) / area) ** 2).sum(axis=1)
        along[some, 1] = (((second * d1 - first * d2) / area) ** 2).sum(axis=1)
    return Density(areas, along)


def facing_areas(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Compute areas (f,) float32 in pixels of triangles that face a camera with their middle in the picture, else 0."""
    pixels, depths = camera.project(mesh.vertices)
    a, b, c = (pixels[mesh.triangles[:, corner]] for corner in range(3))
    x, y = ((a + b + c) / 3).T
    area = (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]) - (c[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    inside = (-0.5 <= x) & (x < camera.columns - 0.5) & (-0.5 <= y) & (y < camera.rows - 0.5)
    shown = inside & (area > 0) & (depths[mesh.triangles] > 0).all(axis=1)
    return np.where(shown, area / 2, 0).astype(np.float32)


def texels_per_unit(
    density: Density, plane: np.ndarray, chart: np.ndarray, *, texels_per_pixel: float, least: float = 0.1
) -> np.ndarray:
    """Compute texels (charts, 2) float64 for one unit along (down, right) of each chart.

    A chart gets as many texels as its triangles have pixels, times the square of texels_per_pixel; the two directions
    share them as the pixels do. Charts that hardly any view faces get `least` of the whole surface's mean.
    """
    inside = chart >= 0
    count = int(chart.max(initial=-1)) + 1
    first, second = plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 0]
    areas = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2

    def total(values):
        return np.bincount(chart[inside], values[inside], minlength=count)

    area, pixels = total(areas), total(density.pixels)
    down, right = (total(areas * density.along[:, k]) for k in range(2))
    mean = pixels.sum() / max(area.sum(), 1e-300)
    square = np.maximum(pixels / np.maximum(area, 1e-300), least**2 * mean)
    ratio = np.sqrt(np.where((down > 0) & (right > 0), down / np.where(right > 0, right, 1), 1.0))
    ratio = np.sqrt(np.clip(ratio, 0.25, 4.0))
    side = texels_per_pixel * np.sqrt(square)
    return np.stack([side * ratio, side / ratio], axis=1)


def stretch_percentiles(mesh: Mesh, atlas: Atlas, percentiles=(50, 90, 99, 100)) -> list[float]:
    """Compute percentiles, by surface area, of the stretch of the texels.

    The stretch is the ratio of the longest to the shortest length on the surface that one texel has in any two
    directions; 1 is a chart without distortion.
    """
    corners = mesh.vertices[mesh.triangles]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    flat = atlas.corners.astype(np.float64)
    columns = np.stack([flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]], axis=2)
    gram = np.stack([(one * one).sum(1), (one * two).sum(1), (one * two).sum(1), (two * two).sum(1)], axis=1)
    det = columns[:, 0, 0] * columns[:, 1, 1] - columns[:, 0, 1] * columns[:, 1, 0]
    area = np.sqrt(np.maximum(gram[:, 0] * gram[:, 3] - gram[:, 1] ** 2, 0)) / 2
    usable = (atlas.chart >= 0) & (np.abs(det) > 0) & (area > 1e-12 * area.max(initial=0.0))
    if not usable.any():
        return [1.0] * len(percentiles)
    inverse = np.linalg.inv(columns[usable])
    metric = inverse.transpose(0, 2, 1) @ gram[usable].reshape(-1, 2, 2) @ inverse
    half, product = (metric[:, 0, 0] + metric[:, 1, 1]) / 2, np.linalg.det(metric)
    root = np.sqrt(np.maximum(half**2 - product, 0))
    ratio = np.sqrt((half + root) ** 2 / np.maximum(product, 1e-300))
    return np.percentile(ratio, percentiles, weights=area[usable], method="inverted_cdf").tolist()


def texels_per_pixel(mesh: Mesh, atlas: Atlas, camera: Camera, triangle: np.ndarray) -> float | None:
    """Compute the median linear number of texels that a pixel covers; triangle (n,): those that the pixels show."""
    areas = facing_areas(mesh, camera)
    texels = atlas.corners.astype(np.float64)
    first, second = texels[:, 1] - texels[:, 0], texels[:, 2] - texels[:, 0]
    in_texels = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    ratio = np.sqrt(in_texels / np.where(areas > 0, areas, np.inf))[triangle]
    ratio = ratio[ratio > 0]
    return float(np.median(ratio)) if len(ratio) else None


def atlas_picture(atlas: Atlas, texels: np.ndarray, *, width: int = 2048) -> np.ndarray:
    """Put tiles (tiles, T, T, channels) float32 together chart by chart, charts in rows; NaN between them."""
    stride, shelves, room = atlas.size - 1, [], 0
    wide = int(max(atlas.chart_grid[:, 2].max(initial=1), np.ceil(np.sqrt(1.3 * len(atlas.cells)))))
    drawn = np.unique(atlas.tile_chart)  # small charts are in the tile of the first of their group
    for chart in drawn[np.argsort(-atlas.chart_grid[drawn, 1], kind="stable")]:
        columns = atlas.chart_grid[chart, 2]
        if not shelves or room < columns:
            shelves.append([])
            room = wide
        shelves[-1].append((chart, wide - room))
        room -= columns
    heights = [atlas.chart_grid[shelf[0][0], 1] for shelf in shelves]
    step = max(1, -(-wide * stride // width))
    side = -(-stride // step)
    picture = np.full((max(1, sum(heights)) * side, wide * side, texels.shape[3]), np.nan, np.float32)
    for shelf, top in zip(shelves, np.cumsum([0, *heights]), strict=False):
        for chart, left in shelf:
            for tile in np.flatnonzero(atlas.tile_chart == chart):
                row, column = atlas.tile_place[tile] + (top, left)
                part = texels[tile, :stride:step, :stride:step]
                picture[row * side : (row + 1) * side, column * side : (column + 1) * side] = part
    return picture
