"""Photographs of mirror spheres on a matt plane, by tracing a ray through every part of a pixel. Shares nothing with
what is fitted: rays are cut with spheres by the quadratic formula, and lamps are balls that a reflected ray hits."""

import cv2
import numpy as np


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def nearest_cut(origins, directions, centre, radius):
    """Distance along each ray to a ball, inf where it misses."""
    away = origins - centre
    half = (away * directions).sum(axis=-1)
    discriminant = half**2 - ((away**2).sum(axis=-1) - radius**2)
    with np.errstate(invalid="ignore"):
        first = -half - np.sqrt(discriminant)
    return np.where((discriminant >= 0) & (first > 1e-6), first, np.inf)


class Scene:
    """Spheres (centre, radius) lying on the plane z = floor; z towards the camera; lengths in mm.

    focal_px: camera at the origin looking along -z; None: orthographic with `pitch` mm a pixel. Pixels around spheres
    are the mean of samples x samples rays, those of the plane one ray. The lens blurs before pixels gather the light: a
    highlight smaller than a pixel keeps its place.
    """

    def __init__(self, spheres, *, rows, columns, floor, focal_px=None, pitch=None, samples=6):
        self.samples = samples
        self.spheres = [(np.array(c, float), r) for c, r in spheres]
        self.rows, self.columns, self.floor = rows, columns, floor
        self.focal_px, self.pitch = focal_px, pitch
        row, column = np.mgrid[:rows, :columns].astype(float)
        self.plane = self._trace(row, column)
        steps = (np.arange(samples) - (samples - 1) / 2) / samples
        self.boxes = []
        for k in range(len(self.spheres)):
            at = np.argwhere(self.plane[0] == k)
            (top, left), (bottom, right) = np.maximum(at.min(axis=0) - 5, 0), at.max(axis=0) + 6
            box = (slice(top, bottom), slice(left, right))
            fine_row = (row[box][:, :1] + steps).reshape(-1, 1)
            fine_column = (column[box][0][:, None] + steps).reshape(1, -1)
            self.boxes.append((box, self._trace(*np.broadcast_arrays(fine_row, fine_column))))

    def _rays(self, row, column):
        x, y = column - (self.columns - 1) / 2, (self.rows - 1) / 2 - row
        if self.focal_px is None:
            origins = np.stack([x * self.pitch, y * self.pitch, np.full_like(x, 1e4)], axis=-1)
            return origins, np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
        directions = unit(np.stack([x, y, np.full_like(x, -self.focal_px)], axis=-1))
        return np.zeros_like(directions), directions

    def _trace(self, row, column):
        origins, directions = self._rays(row, column)
        distances = np.stack([nearest_cut(origins, directions, c, r) for c, r in self.spheres])
        which = np.where(np.isfinite(distances.min(axis=0)), distances.argmin(axis=0), -1)
        ground = origins + directions * ((self.floor - origins[..., 2]) / directions[..., 2])[..., None]
        points, mirrored = ground.copy(), directions.copy()
        blocked = np.zeros(row.shape, bool)
        for k, (centre, radius) in enumerate(self.spheres):
            on = which == k
            point = origins[on] + directions[on] * distances[k][on][:, None]
            normal = (point - centre) / radius
            points[on] = point
            mirrored[on] = directions[on] - 2 * (directions[on] * normal).sum(axis=1)[:, None] * normal
            for j, (other, size) in enumerate(self.spheres):
                if j != k:
                    blocked[on] |= np.isfinite(nearest_cut(point, mirrored[on], other, size))
        return which, points, mirrored, blocked

    def photograph(self, lamp, *, size=3.0, glare=6.0, blur=0.7, noise=0.004, seed=0, extra=None):
        """(rows, columns) float, clipped at 1: a ball of radius `size` at `lamp` shines `glare` times full scale."""
        lamps = [(np.asarray(lamp, float), 1.0), *((np.asarray(at, float), share) for at, share in extra or [])]
        picture = self._light(self.plane, lamps, size, glare)
        for box, traced in self.boxes:
            fine = cv2.GaussianBlur(self._light(traced, lamps, size, glare), (0, 0), blur * self.samples)
            height, width = picture[box].shape
            picture[box] = fine.reshape(height, self.samples, width, self.samples).mean(axis=(1, 3))
        random = np.random.default_rng(seed)
        picture = picture + random.normal(0, 1, picture.shape) * np.hypot(
            noise, noise * np.sqrt(np.maximum(picture, 0))
        )
        return np.clip(picture, 0, 1)

    def _light(self, traced, lamps, size, glare):
        which, points, mirrored, blocked = traced
        light = np.zeros(which.shape)
        ground, lamp = which < 0, lamps[0][0]
        towards = lamp - points[ground]
        reference = np.linalg.norm(lamp - np.array([0, 0, self.floor])) ** 2
        light[ground] = 0.25 * reference * np.maximum(towards[:, 2], 0) / np.linalg.norm(towards, axis=1) ** 3
        shown, at = mirrored[~ground], points[~ground]
        room = 0.03 + 0.02 * shown[:, 1] + 0.12 * (shown[:, 2] < 0) + 0.02 * np.sin(9 * shown[:, 0])
        for place, strength in lamps:
            hits = np.isfinite(nearest_cut(at, shown, place, size)) & ~blocked[~ground]
            room = np.where(hits, glare * strength, room)
        light[~ground] = room
        return light


def dome(count, distance, middle, *, lowest_deg=15.0, seed=1):
    """Lamps on a spiral over the hemisphere above a point."""
    k = np.arange(count)
    z = np.sin(np.radians(lowest_deg)) + (0.97 - np.sin(np.radians(lowest_deg))) * (k + 0.5) / count
    turn = k * np.pi * (3 - np.sqrt(5))
    directions = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    lengths = distance * (1 + 0.1 * np.random.default_rng(seed).uniform(-1, 1, count))
    return np.asarray(middle, float) + directions * lengths[:, None]
