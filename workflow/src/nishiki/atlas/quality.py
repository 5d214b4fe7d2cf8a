"""How good an atlas is: stretch of its charts, texels for each pixel; and a picture of it."""

import numpy as np

from nishiki.atlas.atlas import Atlas
from nishiki.atlas.density import facing_areas
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh


def texel_areas(atlas: Atlas) -> np.ndarray:
    """Area (f,) float64 of each triangle in texels."""
    corners = atlas.corners.astype(np.float64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2


def stretch_percentiles(mesh: Mesh, atlas: Atlas, percentiles=(50, 90, 99, 100)) -> list[float]:
    """Percentiles, by surface area, of the ratio of the longest to the shortest length on the surface that one texel
    has in any two directions; 1 is a chart without distortion."""
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
    return weighted_percentiles(ratio, area[usable], percentiles)


def weighted_percentiles(values: np.ndarray, weights: np.ndarray, percentiles) -> list[float]:
    """Smallest values that at least so many percent of the weight do not exceed."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    places = np.searchsorted(below, np.asarray(percentiles) / 100 * below[-1] * (1 - 1e-12))
    return [float(values[order[min(k, len(order) - 1)]]) for k in places]


def texels_per_pixel(mesh: Mesh, atlas: Atlas, camera: Camera, triangle: np.ndarray) -> float | None:
    """Median over pixels of the linear number of texels that a pixel covers; triangle (n,): what the pixels show."""
    pixels, depths = camera.project(mesh.vertices)
    areas = np.empty(len(mesh.triangles), np.float32)
    corners = np.ascontiguousarray(mesh.triangles, np.int32)
    facing_areas(np.ascontiguousarray(pixels), depths, corners, camera.rows, camera.columns, areas)
    ratio = np.sqrt(texel_areas(atlas) / np.where(areas > 0, areas, np.inf))[triangle]
    ratio = ratio[ratio > 0]
    return float(np.median(ratio)) if len(ratio) else None


def atlas_picture(atlas: Atlas, texels: np.ndarray, *, width: int = 2048) -> np.ndarray:
    """Tiles (tiles, T, T, channels) float32 put together chart by chart; NaN between them. Charts stand in rows."""
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
