"""A small turntable object whose tiles are known exactly: a bumpy, painted sphere with a gloss no model here fits.

Its chart is longitude by latitude, cut into tiles that share their edge rows and columns. Pixels are averages over
their area, so that point-sampled texels differ from what a picture needs, as on real captures.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Tile:
    """samples: observation, s, t (n,), values (n, 3) linear; visible (M, T, T); texels (M, T, T, 3) point-sampled;
    prediction (M, T, T, 3): Lambert and one lobe; positions, normals (T, T, 3); kd, ks (T, T, 3), width (T, T)."""

    observation: np.ndarray
    s: np.ndarray
    t: np.ndarray
    values: np.ndarray
    visible: np.ndarray
    texels: np.ndarray
    prediction: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    kd: np.ndarray
    ks: np.ndarray
    width: np.ndarray


def value_noise(points, frequency, seed):
    """Smooth noise in [-1, 1] at points (..., 3): trilinear between random values on a lattice."""
    lattice = np.random.default_rng(seed).uniform(-1, 1, (32, 32, 32)).astype(np.float32)
    scaled = points * frequency + 100.0
    base = np.floor(scaled).astype(np.int32)
    f = (scaled - base).astype(np.float32)
    f = f * f * (3 - 2 * f)
    total = np.zeros(points.shape[:-1], np.float32)
    for corner in range(8):
        d = np.array([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
        i = (base + d) & 31
        total += np.prod(np.where(d, f, 1 - f), axis=-1) * lattice[i[..., 0], i[..., 1], i[..., 2]]
    return total


def albedo(p):
    """(..., 3) reflectance at points on the sphere: paint, stains, and a fine pattern with sharp edges."""
    broad, fine = value_noise(p, 3.0, 1), value_noise(p, 17.0, 2)
    lines = (np.sin(40 * np.arctan2(p[..., 0], p[..., 2]) + 6 * broad) * np.sin(30 * p[..., 1]) > 0.6).astype(
        np.float32
    )
    tone = 0.45 + 0.25 * broad + 0.1 * fine + 0.05 * value_noise(p, 60.0, 3)
    colour = np.stack([tone, tone * (0.8 + 0.15 * fine), tone * (0.6 + 0.25 * broad)], axis=-1)
    return np.clip(colour * (1 - 0.6 * lines[..., None]), 0.02, 0.95)


def bumped(p):
    """Unit normals (..., 3) of the bumpy surface at points of the sphere."""
    slope = np.stack([value_noise(p, 9.0, seed) for seed in (4, 5, 6)], axis=-1)
    n = p + 0.12 * slope
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def radiance(p, camera):
    """(..., 3) radiance towards the camera, lamp beside it: bumpy Lambert, a two-width gloss, light from below."""
    n, v = bumped(p), camera - p
    v = v / np.linalg.norm(v, axis=-1, keepdims=True)
    lamp = camera + np.array([0.3, 0.5, 0.0])
    light = lamp - p
    light = light / np.linalg.norm(light, axis=-1, keepdims=True)
    half = light + v
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    alpha = np.arccos(np.clip(np.sum(n * half, -1), -1, 1))
    gloss = 0.25 * np.exp(-((alpha / 0.12) ** 2)) + 0.1 / (1 + (alpha / 0.25) ** 4)
    gloss = gloss * (1 + 0.5 * value_noise(p, 5.0, 7))
    diffuse = np.maximum(np.sum(n * light, -1), 0) + 0.08 * (1 - n[..., 1])
    return albedo(p) * diffuse[..., None] + gloss[..., None] * (np.sum(n * light, -1) > 0)[..., None]


def predict(kd, ks, width, positions, normals, camera):
    """(..., 3): Miyazaki et al. (2007), eq. 6 and 8 with the sphere's own normals, lamp at the camera."""
    v = camera - positions
    v = v / np.linalg.norm(v, axis=-1, keepdims=True)
    cosine = np.sum(normals * v, -1)
    alpha = np.arccos(np.clip(cosine, -1, 1))
    lobe = np.exp(-(alpha**2) / (2 * width**2)) / np.maximum(cosine, 0.1)
    return np.where(cosine[..., None] > 0, kd * np.maximum(cosine, 0)[..., None] + ks * lobe[..., None], 0)


def camera_of(view, views):
    """Place of a view's camera, and its axes (right, down, into the scene) as rows."""
    angle, height = 2 * np.pi * view / views, 0.25
    place = 6.0 * np.array([np.sin(angle) * np.cos(height), np.sin(height), np.cos(angle) * np.cos(height)])
    ahead = -place / np.linalg.norm(place)
    right = np.cross(ahead, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return place, np.stack([right, np.cross(ahead, right), ahead])


def hit(rays, place):
    """Points (..., 3) where rays meet the unit sphere, and which do."""
    b = rays @ place
    inside = b * b - (place @ place - 1)
    return place + rays * (-b - np.sqrt(np.maximum(inside, 0)))[..., None], inside > 0


def picture(view, views, pixels, sub):
    """(pixels, pixels, 3) averages over each pixel; points at the centres; which centres are on the sphere."""
    place, axes = camera_of(view, views)
    focal = 0.47 * pixels * np.sqrt(place @ place - 1)

    def rays(columns, rows):
        plane = np.stack([(columns - (pixels - 1) / 2) / focal, (rows - (pixels - 1) / 2) / focal], -1)
        local = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], -1) @ axes
        return local / np.linalg.norm(local, axis=-1, keepdims=True)

    columns, rows = np.meshgrid(np.arange(pixels), np.arange(pixels))
    total = np.zeros((pixels, pixels, 3))
    for i in range(sub):
        for j in range(sub):
            p, on = hit(rays(columns + (j + 0.5) / sub - 0.5, rows + (i + 0.5) / sub - 0.5), place)
            total[on] += radiance(p[on], place)
    p, on = hit(rays(columns, rows), place)
    return (total / sub**2).astype(np.float32), p, on


def tiles_of_sphere(*, views=36, pixels=96, size=32, around=9, high=3, sub=3, noise=0.002, seed=0):
    """Tiles of the band around the equator, (around * high) of them, texels about as fine as the pixels."""
    rng = np.random.default_rng(seed)
    pitch = 2 * np.pi / (around * (size - 1))
    gathered = [[] for _ in range(around * high)]
    shots = []
    for view in range(views):
        image, p, on = picture(view, views, pixels, sub)
        image = np.round(np.clip(image + noise * rng.standard_normal(image.shape), 0, 4) * 4095) / 4095
        shots.append(image.astype(np.float32))
        s, t = chart(p[on], pitch, size, high)
        inside = (s >= 0) & (s < high * (size - 1))
        s, t, values = s[inside], t[inside], shots[-1][on][inside]
        row, column = (s // (size - 1)).astype(int), np.minimum((t // (size - 1)).astype(int), around - 1)
        for number in np.unique(row * around + column):
            mine = row * around + column == number
            local = s[mine] - row[mine] * (size - 1), t[mine] - column[mine] * (size - 1)
            gathered[number].append((np.full(mine.sum(), view), *local, values[mine]))
    return [
        _tile(parts, number // around, number % around, shots, pitch=pitch, size=size, high=high)
        for number, parts in enumerate(gathered)
    ]


def chart(p, pitch, size, high):
    """Row and column on the whole chart of points on the sphere."""
    s = (high * (size - 1)) / 2 - np.arcsin(np.clip(p[:, 1], -1, 1)) / pitch
    return s, np.mod(np.arctan2(p[:, 0], p[:, 2]), 2 * np.pi) / pitch


def _tile(parts, row, column, shots, *, pitch, size, high):
    observation, s, t, values = (np.concatenate(v) for v in zip(*parts, strict=True))
    i, j = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    latitude = ((high * (size - 1)) / 2 - (i + row * (size - 1))) * pitch
    longitude = (j + column * (size - 1)) * pitch
    p = np.stack([np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)], -1)
    views = len(shots)
    texels, visible = np.zeros((views, size, size, 3), np.float32), np.zeros((views, size, size), bool)
    for view, image in enumerate(shots):
        texels[view], visible[view] = _sampled(p, image, view, views)
    cosines = np.stack([_cosine(p, view, views) for view in range(views)])
    weight = visible * cosines
    kd = np.sum((weight * cosines)[..., None] * texels, 0) / np.maximum(np.sum(weight * cosines**2, 0), 1e-6)[..., None]
    width, ks = np.full((size, size), 0.2), np.full((size, size, 3), 0.12)
    kd = np.clip(kd - 0.08, 0.01, 1)
    prediction = np.stack([predict(kd, ks, width, p, p, camera_of(view, views)[0]) for view in range(views)])
    single = [values.astype(np.float32) for values in (s, t, values)]
    shape = [a.astype(np.float32) for a in (prediction, p, p, kd, ks, width)]
    return Tile(observation.astype(np.int32), *single, visible, texels, *shape)


def _cosine(p, view, views):
    v = camera_of(view, views)[0] - p
    return np.maximum(np.sum(p * v, -1) / np.linalg.norm(v, axis=-1), 0)


def _sampled(p, image, view, views):
    place, axes = camera_of(view, views)
    local = (p - place) @ axes.T
    pixels = len(image)
    focal = 0.47 * pixels * np.sqrt(place @ place - 1)
    x, y = (local[..., k] / local[..., 2] * focal + (pixels - 1) / 2 for k in (0, 1))
    j, i = (np.clip(np.floor(v).astype(int), 0, pixels - 2) for v in (x, y))
    fx, fy = (x - j)[..., None], (y - i)[..., None]
    top = image[i, j] * (1 - fx) + image[i, j + 1] * fx
    low = image[i + 1, j] * (1 - fx) + image[i + 1, j + 1] * fx
    seen = _cosine(p, view, views) > 0.1
    return np.where(seen[..., None], top * (1 - fy) + low * fy, 0), seen
