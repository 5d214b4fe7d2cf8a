"""What captured views see of the surface, and where points lie in them."""

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import rotation_matrix
from nishiki.render.object.pixels import STEEP, DepthMaps


def plates():
    """A large plate at z = 0 and a small one before it at z = 1; both face +z."""
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([2 * square, 0.5 * square + [0, 0, 1]])
    return Mesh.of(vertices, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))


def above(angle=0.0, name="a", distortion=(0.0,) * 5):
    rotation = np.diag([1.0, -1, -1]) @ rotation_matrix(np.array([0, -angle, 0]))
    intrinsics = np.array([[150.0, 0.2, 80], [0, 155, 60], [0, 0, 1]])
    return Camera(name, intrinsics, rotation, np.array([0, 0, 5.0]), 120, 160, distortion)


def test_hidden_and_turned_away_points_are_not_seen():
    maps = DepthMaps(plates())
    points = np.array([[0, 0, 1], [0, 0, 0], [1.2, 0, 0], [1.2, 0, 0], [9, 0, 0]], float)
    normals = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, 1]], float)
    assert maps.visible(points, normals, above()).tolist() == [1, 0, 1, 0, 0]
    aside = maps.visible(points, normals, above(0.6, "b"))
    assert aside[1] == 1  # seen past the small plate


def test_steep_views_count_less():
    maps = DepthMaps(plates())
    point = np.array([[1.2, 0.9, 0.0]])
    for tilt in (70, 78, 85):
        camera = above(np.radians(tilt), f"{tilt}")
        towards = camera.centre - point[0]
        cosine = towards[2] / np.linalg.norm(towards)
        found = maps.visible(point, np.array([[0, 0, 1.0]]), camera)[0]
        assert np.isclose(found, min(1, cosine / STEEP), atol=1e-6)


def test_only_the_latest_depth_maps_are_kept():
    maps = DepthMaps(plates())
    cameras = [above(0.05 * k, f"{k}") for k in range(12)]
    maps.prepare(cameras)
    assert len(maps._maps) == 12
    maps.prepare(cameras[:1])
    assert len(maps._maps) == 8
    assert "0" in maps._maps
