"""Cameras around a body, and the exact silhouettes of bodies that have a formula."""

from dataclasses import replace

import numpy as np

from nishiki.geometry.camera import Camera

ROWS, COLUMNS = 120, 160


def turn(views=12, *, elevation=0.35, distance=5.0, focal=260.0, distortion=(0.0,) * 5, spread=1.0):
    """Cameras on a circle about z, looking at the origin."""
    found = []
    for index in range(views):
        angle = spread * 2 * np.pi * index / views
        centre = distance * np.array(
            [np.cos(angle) * np.cos(elevation), np.sin(angle) * np.cos(elevation), np.sin(elevation)]
        )
        z = -centre / np.linalg.norm(centre)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        rotation = np.array([x, np.cross(z, x), z])
        matrix = np.array([[focal, 0, COLUMNS / 2 - 3], [0, 1.1 * focal, ROWS / 2 + 2], [0, 0, 1.0]])
        found.append(Camera(f"v{index}", matrix, rotation, -rotation @ centre, ROWS, COLUMNS, tuple(distortion)))
    return found


def enlarged(camera, times):
    """The same view in more, smaller pixels."""
    matrix = np.diag([times, times, 1.0]) @ camera.intrinsics
    matrix[:2, 2] += (times - 1) / 2
    rows, columns = camera.rows * times, camera.columns * times
    return Camera(camera.name, matrix, camera.rotation, camera.translation, rows, columns)


def rays(camera):
    """Directions (rows, columns, 3) through the pixel centres, in the world."""
    column, row = np.meshgrid(np.arange(camera.columns), np.arange(camera.rows))
    k = camera.intrinsics
    y = (row - k[1, 2]) / k[1, 1]
    x = (column - k[0, 2]) / k[0, 0]
    return np.stack([x, y, np.ones(x.shape)], axis=-1) @ camera.rotation


def sphere(camera, radius=0.7, centre=(0.1, -0.05, 0.08)):
    """Silhouette of a sphere: rays that pass nearer to its centre than its radius."""
    direction = rays(camera)
    to = np.asarray(centre) - camera.centre
    along = direction @ to / np.linalg.norm(direction, axis=-1)
    return (to @ to - along**2 <= radius**2) & (along > 0)


def box(camera, half=(0.5, 0.35, 0.6)):
    """Silhouette of a box, by slabs."""
    direction = rays(camera)
    with np.errstate(divide="ignore"):
        first = (-np.asarray(half) - camera.centre) / direction
        second = (np.asarray(half) - camera.centre) / direction
    near, far = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
    return (near <= far) & (far > 0)


def torus(camera, large=0.65, small=0.22):
    """Silhouette of a torus about z, by marching along the rays with its distance function."""
    direction = rays(camera)
    direction = direction.reshape(-1, 3) / np.linalg.norm(direction, axis=-1).reshape(-1, 1)
    t = np.full(len(direction), np.linalg.norm(camera.centre) - 1.0)
    hit, open_ = np.zeros(len(direction), bool), np.arange(len(direction))
    for _ in range(150):
        point = camera.centre + t[open_, None] * direction[open_]
        distance = np.hypot(np.hypot(point[:, 0], point[:, 1]) - large, point[:, 2]) - small
        hit[open_[distance < 1e-3]] = True
        t[open_] += distance
        going = (distance >= 1e-3) & (t[open_] < np.linalg.norm(camera.centre) + 1.0)
        open_ = open_[going]
    return hit.reshape(camera.rows, camera.columns)


FOCAL, TILT = 560.0, 0.35
SQUARE = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]])
BALLS = (((0.0, 0.0, -0.3), 0.55), ((0.62, 0.1, 0.1), 0.3), ((-0.25, 0.55, 0.5), 0.25), ((0.1, -0.3, 0.62), 0.2))


def cameras_at(angles_deg):
    """Cameras with square pixels at angles of a turn, of 240 x 320 pixels."""
    return [
        replace(
            turn(2, elevation=TILT, spread=2 * angle / 360)[1], intrinsics=SQUARE, rows=240, columns=320, name=str(k)
        )
        for k, angle in enumerate(angles_deg)
    ]


def outlines(angles_deg, balls=BALLS):
    """Silhouettes of some balls from these cameras."""
    return [np.any([sphere(camera, radius, at) for at, radius in balls], axis=0) for camera in cameras_at(angles_deg)]
