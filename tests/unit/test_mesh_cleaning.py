"""Degenerate, doubled, crowded, touching and turned triangles."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from turned_cameras import turn

from nishiki.geometry.cleaning import clean
from nishiki.geometry.surface import shape_of


def cube():
    found = trimesh.creation.box((1.0, 1.0, 1.0))
    return np.asarray(found.vertices, float), np.asarray(found.faces, int)


def test_a_sound_mesh_stays_as_it_is():
    vertices, faces = cube()
    mesh, defects = clean(vertices, faces)
    assert set(defects.as_dict().values()) == {0}
    np.testing.assert_array_equal(mesh.vertices[mesh.triangles], vertices[faces])


def test_every_defect_is_counted_and_mended():
    vertices, faces = cube()
    doubled = np.concatenate([vertices, vertices[:1] * 1.0, [[9, 9, 9.0]]])  # 8: as 0; 9: of no triangle
    faces = faces.copy()
    place = np.argwhere(faces == 0)[0]
    faces[place[0], place[1]] = 8
    faces = np.concatenate([faces, faces[3:4, [1, 2, 0]], [[1, 1, 2]], [[0, 8, 3]], [[0, 1, 1]]])
    mesh, defects = clean(doubled, faces)
    assert (defects.merged_vertices, defects.duplicates, defects.degenerate, defects.unreferenced) == (1, 1, 3, 1)
    facts = shape_of(mesh)
    assert facts.watertight
    assert facts.triangles == 12
    assert facts.vertices == 8
    assert facts.volume == pytest.approx(1.0)


def test_triangles_in_one_line_have_no_area():
    vertices, faces = cube()
    vertices = np.concatenate([vertices * 3 + 1e3, [[1e3, 1e3, 1e3], [1e3 + 1, 1e3, 1e3], [1e3 + 2, 1e3, 1e3]]])
    mesh, defects = clean(vertices, np.concatenate([faces, [[8, 9, 10]]]))
    assert defects.degenerate == 1
    assert len(mesh.triangles) == 12


@given(st.integers(0, 2**12 - 1))
@settings(max_examples=40, deadline=None)
def test_any_turned_triangles_are_turned_back(pattern):
    vertices, faces = cube()
    flipped = np.array([bool(pattern >> k & 1) for k in range(12)])
    faces[flipped] = faces[flipped][:, ::-1]
    mesh, defects = clean(vertices, faces)
    facts = shape_of(mesh)
    assert facts.watertight
    assert facts.volume == pytest.approx(1.0)
    assert defects.turned == min(flipped.sum(), 12 - flipped.sum())


def test_an_open_surface_faces_the_cameras():
    found = trimesh.creation.icosphere(3)
    upper = found.faces[found.triangles_center[:, 0] > 0.2]
    camera = turn(1, elevation=0.0)  # on the x axis
    for faces in (upper, upper[:, ::-1]):
        mesh, defects = clean(found.vertices, faces, cameras=camera)
        assert (np.einsum("ij,ij->i", mesh.normals, mesh.vertices) > 0).all()
        assert defects.turned_parts == (faces is not upper)


def test_a_body_with_a_hole_is_turned_by_what_the_cameras_see():
    found = trimesh.creation.icosphere(3, 0.6)
    holed = found.faces[found.triangles_center[:, 2] > -0.5]
    for faces in (holed, holed[:, ::-1]):
        mesh, _ = clean(found.vertices + np.array([0.0, 0.0, 0.2]), faces, cameras=turn(5))
        assert (np.einsum("ij,ij->i", mesh.normals, mesh.vertices - [0.0, 0.0, 0.2]) > 0).all()


def test_edges_of_more_than_two_triangles_keep_the_largest_two():
    vertices, faces = cube()
    edge = faces[0, :2]
    vertices = np.concatenate([vertices, [vertices[edge].mean(axis=0) + np.array([0.02, 0.03, 0.01])]])
    mesh, defects = clean(vertices, np.concatenate([faces, [[*edge, 8]]]))
    assert (defects.crowded_edges, defects.crowded_triangles) == (1, 1)
    assert shape_of(mesh).watertight
    assert len(mesh.triangles) == 12


def test_two_bodies_that_touch_in_a_point_are_parted():
    vertices, faces = cube()
    other = vertices + 1.0  # the corners (0.5, 0.5, 0.5) meet
    mesh, defects = clean(np.concatenate([vertices, other]), np.concatenate([faces, faces + 8]))
    assert (defects.merged_vertices, defects.split_vertices) == (1, 1)
    facts = shape_of(mesh)
    assert facts.watertight
    assert facts.parts == 2
    assert facts.genus == 0
    assert facts.vertices == 16


def test_nothing_left_is_an_error():
    with refused(ValueError, by="clean"):
        clean(np.zeros((3, 3)), np.array([[0, 1, 2]]))


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_any_soup_becomes_a_surface(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.integers(0, 4, (20, 3)).astype(float)
    faces = rng.integers(0, 20, (30, 3))
    try:
        mesh, _ = clean(vertices, faces, cameras=turn(2))
    except ValueError:
        return
    facts = shape_of(mesh)
    assert facts.crowded_edges == 0
    assert facts.vertices == len(np.unique(mesh.triangles))
    assert np.isfinite(mesh.normals).all()
    again, defects = clean(mesh.vertices, mesh.triangles, cameras=turn(2))
    assert (defects.degenerate, defects.duplicates, defects.crowded_triangles, defects.unreferenced) == (0, 0, 0, 0)
    assert len(again.triangles) == len(mesh.triangles)
