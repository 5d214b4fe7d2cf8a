"""Rays against the tree of boxes: the same answers as every triangle tried in turn."""

import numpy as np
import pytest

from nishiki.geometry.visibility import cast, make_tree


def occluded(tree, origins, directions, far):
    """Whether each ray meets a triangle nearer than `far`."""
    return cast(tree, origins, np.broadcast_to(directions, np.shape(origins)), far=far, any_hit=True).triangle >= 0


def slow(vertices, triangles, origins, directions, far):
    """Whether any triangle is met, by solving o + t d = a + u (b - a) + v (c - a) for each."""
    found = np.zeros(len(origins), bool)
    for a, b, c in vertices[triangles]:
        for k, (o, d) in enumerate(zip(origins, directions, strict=True)):
            matrix = np.column_stack([-d, b - a, c - a])
            if abs(np.linalg.det(matrix)) < 1e-14:
                continue
            t, u, v = np.linalg.solve(matrix, o - a)
            found[k] |= bool(0 < t < far and u >= 0 and v >= 0 and u + v <= 1)
    return found


@pytest.mark.parametrize("count", [1, 3, 4, 5, 61])
def test_against_every_triangle(count):
    rng = np.random.default_rng(count)
    vertices = rng.normal(size=(3 * count, 3))
    triangles = np.arange(3 * count).reshape(-1, 3)
    origins, directions = rng.normal(size=(2, 150, 3))
    for far in (0.7, 50.0):
        expected = slow(vertices, triangles, origins, directions, far)
        assert np.array_equal(occluded(make_tree(vertices, triangles), origins, directions, far), expected)
        assert far < 1 or count < 60 or 0 < expected.sum() < len(expected)


def test_every_triangle_is_in_the_tree_and_inside_its_boxes():
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(300, 3)) * [1, 100, 1e-3]
    triangles = rng.integers(0, 300, (517, 3))
    tree = make_tree(vertices, triangles)
    assert set(tree.order) == set(range(517))
    leaves = (len(tree.boxes) + 1) // 2
    for leaf in range(leaves):
        corners = vertices[triangles[tree.order[4 * leaf : 4 * leaf + 4]]].reshape(-1, 3)
        node = leaves - 1 + leaf
        while True:
            assert np.all(corners >= tree.boxes[node, :3])
            assert np.all(corners <= tree.boxes[node, 3:])
            if node == 0:
                break
            node = (node - 1) // 2


def test_rays_along_the_axes_and_in_the_plane_of_a_triangle():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    tree = make_tree(vertices, np.array([[0, 1, 2]]))
    origins = np.array([[0.2, 0.2, 1], [0.2, 0.2, 1], [0.9, 0.9, 1], [-1, 0.2, 0]])
    directions = np.array([[0, 0, -1.0], [0, 0, 1], [0, 0, -1], [1, 0, 0]])
    assert occluded(tree, origins, directions, 10.0).tolist() == [True, False, False, False]
    assert occluded(tree, origins[:1], directions[:1], 0.999).tolist() == [False]
    assert occluded(tree, np.zeros((0, 3)), np.zeros((0, 3)), 1.0).shape == (0,)
