"""Photographs of a relief under the lamps of a dome, by laws other than those that the test of consistency fits."""

import numpy as np

ROWS, COLUMNS = 60, 80


def dome(rings=((8, 35), (4, 65)), start=7.0):
    """Directions (lamps, 3) on rings of (lamps, elevation in degrees)."""
    azimuth = np.concatenate([start + i + np.arange(n) * 360 / n for i, (n, _) in enumerate(rings)])
    azimuth, elevation = np.radians(azimuth), np.radians(np.concatenate([np.full(n, e) for n, e in rings]))
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )


def relief(seed=0, steep=6.0):
    """Height (rows, columns) in pixels: a few smooth hills, and none of the symmetries of the square."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    height = np.zeros((ROWS, COLUMNS))
    for _ in range(14):
        row, column, size = rng.uniform(0, ROWS), rng.uniform(0, COLUMNS), rng.uniform(5, 12)
        distance = np.hypot(x - column, y - row) / size
        height += rng.choice([-1, 1]) * steep * size / 10 * np.exp(-(distance**2) / 2)
    return height


def photographs(directions, *, seed=0, gloss=0.0, albedo=(0.2, 0.8), noise=0.002, steep=6.0, width=0.0):
    """Values (lamps, rows, columns) of a relief by Oren and Nayar's rough diffuse law (1994, first term, sigma 0.3)
    and a Phong highlight, with shadows cast along the height; photon and reading noise.

    width: of the picture in distances of the lamps, which light its middle by 1; 0 of far lamps.
    """
    rng = np.random.default_rng(seed + 1000)
    height = relief(seed, steep)
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(height)], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    colour = rng.uniform(*albedo, (6, 8)).repeat(10, axis=0).repeat(10, axis=1)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    place = np.stack([x - (COLUMNS - 1) / 2, (ROWS - 1) / 2 - y, height], axis=2) / COLUMNS
    stack = []
    for lamp in directions:
        direction = lamp - width * place
        distance = np.linalg.norm(direction, axis=2)
        direction /= distance[..., None]
        cosine = np.maximum((normals * direction).sum(axis=2), 0)
        seen = normals[..., 2]
        across = np.clip(direction[..., 2] - cosine * seen, 0, None) / np.maximum(np.maximum(cosine, seen), 0.05)
        shading = cosine * (0.83 + 0.25 * across)
        mirrored = np.maximum(2 * cosine * seen - direction[..., 2], 0)
        lit = np.ones_like(height)
        for step in np.arange(1, 24):
            r, c = (
                (axis + step * towards).round().astype(int)
                for axis, towards in ((y, -direction[..., 1]), (x, direction[..., 0]))
            )
            inside = (r >= 0) & (r < ROWS) & (c >= 0) & (c < COLUMNS)
            other = height[np.clip(r, 0, ROWS - 1), np.clip(c, 0, COLUMNS - 1)]
            lit[inside & (other > height + step * direction[..., 2] + 0.05)] = 0
        value = lit / distance**2 * (colour * shading + gloss * mirrored**20 * (cosine > 0))
        stack.append(value + rng.normal(0, 1, value.shape) * noise * np.sqrt(0.05 + value))
    return np.array(stack)


def degrees(first, second):
    return np.degrees(np.arccos(np.clip((first * second).sum(axis=-1), -1, 1)))
