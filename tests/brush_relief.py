"""Reliefs of brush strokes, knife strokes and canvas with paints on them, as meshes of four vertices a pixel side."""

import numpy as np
from scipy.ndimage import gaussian_filter

VERTICES = 4  # of the mesh, a pixel and side
PITCH_MM = 0.2


def noise(rng, shape, length) -> np.ndarray:
    """Smooth random field of standard deviation 1; correlation length in vertices."""
    field = gaussian_filter(rng.standard_normal(shape), length, mode="wrap")
    return (field - field.mean()) / field.std()


def surface(painting, rows: int, columns: int, paints: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights in mm and paint numbers on the vertices (rows VERTICES + 1, columns VERTICES + 1)."""
    rng = np.random.default_rng(painting.seed)
    shape, step = (rows * VERTICES + 1, columns * VERTICES + 1), PITCH_MM / VERTICES
    y, x = (axis * step for axis in np.indices(shape, float))
    area = noise(rng, shape, 60) + 0.5 * noise(rng, shape, 20)
    label = np.clip(((area - area.min()) / np.ptp(area) * paints * 0.999).astype(int), 0, paints - 1)
    label = rng.permutation(paints)[label]
    height = 0.12 * noise(rng, shape, 90)
    if painting.relief == "canvas":
        height = height * 0.3 + weave(x, y, 0.9 + 0.2 * rng.random(), 0.055)
        size, thick, count, bristles = (6.0, 1.6), 0.02, 260, 0.003
    elif painting.relief == "impasto":
        size, thick, count, bristles = (7.0, 2.6), 0.16, 330, 0.010
    else:
        size, thick, count, bristles = (9.0, 2.0), 0.06, 420, 0.011
    turn = np.pi * noise(rng, shape, 150)
    for _ in range(count):
        stroke(rng, height, label, turn, step, size, thick, bristles, paints)
    height = painting.gain * gaussian_filter(height, 0.09 / step) + 0.0006 * noise(rng, shape, 1.5)
    return height, label


def weave(x, y, pitch, depth) -> np.ndarray:
    """Plain weave: yarns over and under each other."""
    i, j = np.round(x / pitch), np.round(y / pitch)
    over = 1 - 2 * ((i + j) % 2)
    u, v = np.cos(np.pi * (x / pitch - i)), np.cos(np.pi * (y / pitch - j))
    return depth * np.maximum(u * (1 + 0.6 * over * v), v * (1 - 0.6 * over * u))


def stroke(rng, height, label, turn, step, size, thick, bristles, paints) -> None:
    """One stroke of the brush or knife over what lies there: raised edges, furrows of the bristles, its own paint."""
    rows, columns = height.shape
    row, column = rng.integers(rows), rng.integers(columns)
    long, wide = size[0] * rng.uniform(0.5, 1.4) / 2, size[1] * rng.uniform(0.6, 1.3) / 2
    reach = int(np.hypot(long, wide) / step) + 2
    r0, r1, c0, c1 = max(row - reach, 0), min(row + reach, rows), max(column - reach, 0), min(column + reach, columns)
    yy, xx = np.mgrid[r0:r1, c0:c1].astype(float)
    angle = turn[row, column] + rng.normal(0, 0.35)
    dx, dy = (xx - column) * step, (yy - row) * step
    u = (np.cos(angle) * dx + np.sin(angle) * dy) / long
    v = (-np.sin(angle) * dx + np.cos(angle) * dy) / wide + rng.normal(0, 0.25) * u**2
    ragged = 0.12 * np.interp(v, np.linspace(-1.5, 1.5, 40), rng.standard_normal(40))
    inside = 1 / (1 + np.exp((np.abs(v) - 1) * 18)) / (1 + np.exp((np.abs(u + ragged) - 1) * 18))
    furrows = np.interp(v, np.linspace(-1.5, 1.5, 64), gaussian_filter(rng.standard_normal(64), 0.8))
    fade = 0.6 + 0.4 * np.cos(2.2 * u + rng.uniform(0, 6))
    edge = 0.35 * np.exp(-(((np.abs(v) - 0.85) / 0.14) ** 2)) + 0.5 * np.exp(-(((u - 0.85) / 0.12) ** 2))
    body = thick * rng.uniform(0.5, 1.2) * (0.7 * (1 - 0.4 * v**2) + edge) + bristles * furrows * fade
    patch = height[r0:r1, c0:c1]
    patch[...] = patch * (1 - 0.55 * inside) + inside * body
    if rng.random() < 0.75:
        label[r0:r1, c0:c1][inside > 0.5] = rng.integers(paints)


def vertex_normals(height: np.ndarray) -> np.ndarray:
    """(.., 3), x right, y up, z to the viewer."""
    step = PITCH_MM / VERTICES
    down, right = np.gradient(height, step)
    found = np.stack([-right, down, np.ones_like(height)], axis=-1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def split(height, label, shape) -> dict:
    """Meshes {paint: (points, normals, faces)}; a quadrangle belongs to the paint of its first corner."""
    step, (rows, columns) = PITCH_MM / VERTICES, height.shape
    y, x = np.indices(height.shape) * step
    points = np.stack([x, -y, height], axis=-1).reshape(-1, 3)
    normals = vertex_normals(height).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None, :]).ravel()
    faces = np.stack(
        [corner, corner + columns, corner + 1, corner + 1, corner + columns, corner + columns + 1], axis=-1
    )
    own, found = label[:-1, :-1].ravel(), {}
    for number in np.unique(own):
        picked = faces[own == number].reshape(-1, 3)
        used, index = np.unique(picked, return_inverse=True)
        found[int(number)] = (points[used], normals[used], index.reshape(-1, 3))
    return found
