"""Weft directions: from texture coordinates, from an axis, and carried over the surface."""

import numpy as np
import pytest

from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.render.cloth.surfaces import (
    cylinder,
    from_direction,
    from_texture,
    grid_triangles,
    paper,
    sheet,
    swatch,
    transport_tangents,
)


def ball(rows=25, columns=49):
    """A sphere with poles, as a grid of longitude and latitude with double vertices at the seam; and its angles."""
    a, t = np.meshgrid(np.linspace(0, 2 * np.pi, columns), np.linspace(0, np.pi, rows), indexing="ij")
    points = np.stack([np.sin(t) * np.sin(a), np.cos(t), np.sin(t) * np.cos(a)], axis=2).reshape(-1, 3)
    return points, grid_triangles(columns, rows)[:, ::-1], points, np.column_stack([a.ravel(), -t.ravel()])


def sheared():
    """A plane in space whose texture axes are at 60 degrees to each other."""
    u, v = (w.ravel() for w in np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 2, 7), indexing="ij"))
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    flat = np.stack([u + 0.5 * v, np.sqrt(3) / 2 * v, 0 * u], axis=1)
    return flat @ turn.T, grid_triangles(6, 7), np.tile(turn[:, 2], (42, 1)), np.column_stack([u, v]), turn


def test_texture_axes_at_right_angles_are_the_frame():
    tube = cylinder(0.3, 1.0, centre=(1, 2, 3))
    around = np.stack([tube.mesh.normals[:, 2], 0 * tube.mesh.normals[:, 1], -tube.mesh.normals[:, 0]], axis=1)
    assert np.allclose(tube.weft, around, atol=2e-3)
    assert np.allclose(np.sum(tube.weft * tube.mesh.normals, axis=1), 0, atol=1e-6)
    turned = cylinder(0.3, 1.0, turn=np.pi / 2)
    assert np.allclose(turned.weft, np.tile([0.0, 1.0, 0.0], (len(turned.weft), 1)), atol=2e-3)


def test_a_sheared_cloth_shares_the_error_between_weft_and_warp():
    points, triangles, normals, uv, turn = sheared()
    field = from_texture(points, triangles, normals, uv)
    # u at 0 degrees, v at 60: an orthogonal pair with equal errors of 15 degrees starts at -15.
    expected = turn @ np.array([np.cos(np.radians(-15)), np.sin(np.radians(-15)), 0])
    assert np.allclose(field.weft, expected, atol=1e-9)
    assert not field.filled.any()
    assert field.arbitrary == 0


def test_mirrored_texture_keeps_the_weft_along_u():
    points, triangles, normals, uv, turn = sheared()
    field = from_texture(points, triangles, normals, uv * [1, -1])
    assert np.all(field.weft @ turn[:, 0] > 0.9)


def test_degenerate_texture_is_counted_and_carried():
    points, triangles, normals, uv, turn = sheared()
    flat = uv.copy()
    inner = [2 * 7 + 3, 3 * 7 + 3]
    flat[[k for i in inner for k in (i, i - 1, i + 1, i - 7, i + 7, i - 8, i + 8, i - 6, i + 6)]] = 0.3
    field = from_texture(points, triangles, normals, flat)
    assert field.filled.sum() >= 2
    assert field.filled[inner].all()
    assert np.allclose(np.linalg.norm(field.weft, axis=1), 1)
    # The triangles around the collapsed ones are distorted themselves; what they carry in points the same way.
    assert np.all(field.weft @ turn[:, 0] > 0.3)


def test_an_axis_is_laid_on_and_carried_over_the_poles():
    points, triangles, normals, _ = ball()
    field = from_direction(points, triangles, normals, (0, 1, 0))
    pole = np.abs(points[:, 1]) > 1 - 1e-9
    assert np.array_equal(field.filled, pole)
    assert np.allclose(np.linalg.norm(field.weft, axis=1), 1)
    assert np.allclose(np.sum(field.weft * normals, axis=1), 0, atol=1e-6)
    expected = np.array([0, 1.0, 0]) - points[:, 1:2] * points
    expected = expected[~pole] / np.linalg.norm(expected[~pole], axis=1, keepdims=True)
    assert np.allclose(field.weft[~pole], expected, atol=1e-9)


def test_directions_that_are_not_finite_are_filled():
    points, triangles, normals, _, turn = sheared()
    given = np.tile(turn[:, 0], (len(points), 1))
    given[10:20] = np.nan
    given[5] = 0
    field = from_direction(points, triangles, normals, given)
    assert field.filled.sum() == 11
    assert np.allclose(field.weft, turn[:, 0], atol=1e-9)


def test_transport_on_a_cone_is_that_of_its_unrolled_sector():
    """Carried along the surface, a direction keeps its angle in the plane that the cone unrolls to."""
    half, sectors = np.radians(35), 97
    a, r = np.meshgrid(np.linspace(0, 1.6 * np.pi, sectors), np.linspace(0.8, 1.0, 5), indexing="ij")
    points = np.stack([r * np.sin(half) * np.cos(a), r * np.cos(half), r * np.sin(half) * np.sin(a)], axis=2).reshape(
        -1, 3
    )
    out = np.stack([np.cos(half) * np.cos(a), -np.sin(half) + 0 * a, np.cos(half) * np.sin(a)], axis=2).reshape(-1, 3)
    along = np.stack([-np.sin(a), 0 * a, np.cos(a)], axis=2).reshape(-1, 3)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    triangles = grid_triangles(sectors, 5)
    known = a.ravel() == 0
    weft, arbitrary = transport_tangents(len(points), triangles, out, ray, known)
    unrolled = a.ravel() * np.sin(half)
    expected = np.cos(unrolled)[:, None] * ray - np.sin(unrolled)[:, None] * along
    assert arbitrary == 0
    assert np.degrees(np.arccos(np.clip(np.sum(weft * expected, axis=1), -1, 1))).max() < 0.2


def test_a_part_without_any_direction_is_arbitrary_but_sound():
    points, triangles, normals, _, _ = sheared()
    twice = np.concatenate([points, points + 10])
    both = np.concatenate([triangles, triangles + len(points)])
    given = np.zeros_like(twice)
    given[: len(points)] = points[6] - points[0]
    field = from_direction(twice, both, np.tile(normals, (2, 1)), given)
    assert field.arbitrary == len(points)
    assert np.allclose(np.linalg.norm(field.weft, axis=1), 1)
    assert np.allclose(np.sum(field.weft * np.tile(normals, (2, 1)), axis=1), 0, atol=1e-12)


def test_wrong_texture_coordinates_are_named():
    points, triangles, normals, uv, _ = sheared()
    with pytest.raises(UserError, match=r"\(42, 2\)"):
        from_texture(points, triangles, normals, uv[:-1])
    with pytest.raises(UserError, match="finite"):
        from_texture(points, triangles, normals, np.where(uv > 1.9, np.nan, uv))


def test_ready_surfaces_face_outwards_with_unit_tangents():
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9), indexing="ij")
    wavy = np.stack([u, v, 0.1 * np.sin(5 * u + rng.random()) * v], axis=2)
    for surface in (sheet(wavy)[0], cylinder(1, 2, turn=0.4), swatch(1, 2), paper(3, 1, 2, 0.5, turn=0.7)):
        mesh = surface.mesh
        true = Mesh.of(mesh.vertices, mesh.triangles).normals
        assert np.all(np.sum(true * mesh.normals, axis=1) > 0.9)
        assert np.allclose(np.linalg.norm(surface.weft, axis=1), 1, atol=1e-6)
        assert np.abs(np.sum(surface.weft * mesh.normals, axis=1)).max() < 1e-3


def test_a_flat_sheet_has_its_weft_along_the_first_index():
    u, v = np.meshgrid(np.linspace(0, 2, 7), np.linspace(0, 2, 7), indexing="ij")
    surface, uv = sheet(np.stack([u, v, 0 * u], axis=2), side=13)
    assert np.allclose(surface.weft, [1, 0, 0])
    assert np.allclose(surface.mesh.normals, [0, 0, 1])
    assert np.allclose(uv * 2, surface.mesh.vertices[:, :2])
