"""The compact mesh: what is coded comes back, in few bytes, whatever the triangles."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.codec.compact import decode_mesh, encode_mesh, grid_step, mesh_step, shift
from nishiki.codec.range_coder import begin, code_bit, finish
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, compute_tangents, measure_tilts, tilt_normals


def sphere(rows=24, columns=48, bump=0.1):
    """Closed sphere with bumps: rows of vertices between two poles."""
    theta = np.pi * np.arange(1, rows) / rows
    phi = 2 * np.pi * np.arange(columns) / columns
    ring = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.cos(theta), np.ones(columns)),
            np.outer(np.sin(theta), -np.sin(phi)),
        ],
        axis=-1,
    )
    vertices = np.concatenate([ring.reshape(-1, 3), [[0, 1, 0], [0, -1, 0]]])
    vertices *= 1 + bump * np.sin(5 * vertices[:, :1]) * np.cos(3 * vertices[:, 1:2])
    triangles = []
    for i in range(rows - 2):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            triangles += [[a, a + columns, b], [b, a + columns, b + columns]]
    north, south, last = len(vertices) - 2, len(vertices) - 1, (rows - 2) * columns
    for j in range(columns):
        triangles += [[north, j, (j + 1) % columns], [south, last + (j + 1) % columns, last + j]]
    return Mesh.of(vertices, np.array(triangles))


def same(mesh, step):
    """Code a mesh, decode it, compare points and turn of every triangle; the coded form."""
    coded = encode_mesh(mesh, step=step)
    decoded, restored = decode_mesh(coded.data), coded.restore(mesh)
    assert len(set(coded.order)) == len(coded.order) == len(decoded.triangles)
    there = decoded.vertices[decoded.triangles]
    here = restored.vertices[restored.triangles[coded.order]]
    turns = [np.roll(here, k, axis=1) for k in range(3)]
    assert np.any([(turn == there).all(axis=(1, 2)) for turn in turns], axis=0).all()
    left_out = np.setdiff1d(np.arange(len(mesh.triangles)), coded.order)
    assert (
        (np.linalg.norm(np.diff(restored.vertices[mesh.triangles[left_out]][:, [0, 1, 2, 0]], axis=1), axis=2) == 0)
        .any(axis=1)
        .all()
    )
    np.testing.assert_array_equal(restored.vertices, np.round(mesh.vertices / step) * step)
    return coded


def test_carries_run_through_bytes_of_255():
    # long runs of the less probable symbol push the low end up to the edge of the interval
    for length in range(1, 400, 7):
        bits = np.array(([0] * 50 + [1] * 3) * length)[:1500]
        state, data = np.zeros(4, np.int64), np.empty(1600, np.uint8)
        begin(state, data, False)
        for bit in bits:
            code_bit(bit, 4, state, data, False)
        data = data[: finish(state, data)]
        begin(state, data, True)
        np.testing.assert_array_equal([code_bit(0, 4, state, data, True) for _ in bits], bits)


def test_a_closed_surface_comes_back_in_few_bytes():
    mesh = sphere(48, 96)
    coded = same(mesh, 2.0**-12)
    assert 8 * len(coded.data) < 17 * len(mesh.vertices)
    assert coded.data == encode_mesh(mesh, step=2.0**-12).data


@given(st.integers(3, 30), st.integers(0, 60), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_any_set_of_triangles_comes_back(vertices, triangles, seed):
    rng = np.random.default_rng(seed)
    faces = np.concatenate([[[0, 1, 2]], rng.integers(0, vertices, (triangles, 3))])
    same(Mesh.of(rng.normal(size=(vertices, 3)), faces), 2.0**-8)


def test_open_permuted_and_separate_surfaces_come_back():
    rng = np.random.default_rng(3)
    mesh = sphere()
    kept = mesh.triangles[rng.random(len(mesh.triangles)) < 0.8]
    same(Mesh.of(mesh.vertices, kept), 2.0**-10)
    shuffled = mesh.triangles[rng.permutation(len(mesh.triangles))]
    same(Mesh.of(mesh.vertices, shuffled), 2.0**-10)
    two = np.concatenate([mesh.triangles, mesh.triangles + len(mesh.vertices)])
    same(Mesh.of(np.concatenate([mesh.vertices, mesh.vertices + 3]), two), 2.0**-10)


def test_a_mesh_on_the_grid_comes_back_exactly_with_its_normals():
    mesh, step = sphere(), 2.0**-9
    snapped = Mesh.of(np.round(mesh.vertices / step) * step, mesh.triangles)
    restored = encode_mesh(snapped, step=step).restore(snapped)
    np.testing.assert_array_equal(restored.vertices, snapped.vertices)
    np.testing.assert_array_equal(restored.normals, snapped.normals)


def test_tilted_normals_come_back_with_the_mesh():
    mesh, step = sphere(), 2.0**-9
    grid = np.round(mesh.vertices / step) * step
    steps = np.random.default_rng(4).integers(-127, 128, (len(grid), 2)).astype(np.int8)
    steps[:5] = 0
    turned = tilt_normals(grid, mesh.triangles, steps)
    np.testing.assert_array_equal(measure_tilts(turned), steps)
    coded = encode_mesh(turned, step=step)
    np.testing.assert_array_equal(coded.restore(turned).normals, turned.normals)
    decoded = decode_mesh(coded.data)
    by_place = dict(zip(map(tuple, turned.vertices), turned.normals, strict=True))
    expected = np.array([by_place[tuple(place)] for place in decoded.vertices])
    np.testing.assert_allclose(decoded.normals, expected, atol=1e-6)
    across = compute_tangents(mesh.normals.astype(float))
    np.testing.assert_allclose(across @ across.swapaxes(1, 2), np.broadcast_to(np.eye(2), (len(grid), 2, 2)), atol=1e-6)
    np.testing.assert_allclose(np.einsum("vki,vi->vk", across, mesh.normals), 0, atol=1e-6)


def test_unused_vertices_are_left_out():
    mesh = sphere()
    more = Mesh.of(np.concatenate([[[9.0, 9, 9]], mesh.vertices]), mesh.triangles + 1)
    assert same(more, 2.0**-10).data == encode_mesh(mesh, step=2.0**-10).data


def test_meshes_far_from_the_origin_keep_their_grid():
    mesh = sphere()
    same(Mesh.of(mesh.vertices + np.array([2.0**20, -(2.0**20), 0]), mesh.triangles), 2.0**-10)
    with refused(ValueError, by="encode_mesh"):
        encode_mesh(mesh, step=2.0**-30)


def test_the_step_moves_no_vertex_too_far():
    mesh = sphere()
    camera = Camera(
        "a", np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]), np.eye(3), np.array([0, 0, 4.0]), 480, 640
    )
    step = grid_step(mesh, [camera], shift_px=0.05)
    moved = np.round(mesh.vertices / step) * step
    assert 0.005 < shift(mesh.vertices, moved, [camera]) <= 0.05
    coarser = np.round(mesh.vertices / (2 * step)) * 2 * step
    assert shift(mesh.vertices, coarser, [camera]) > 0.05


def test_a_mesh_on_a_grid_is_coded_on_that_grid():
    mesh = sphere()
    intrinsics = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    camera = Camera("a", intrinsics, np.eye(3), np.array([0, 0, 4.0]), 480, 640)
    needed = grid_step(mesh, [camera])
    assert mesh_step(mesh, [camera]) == needed
    for step in (needed * 8, needed, needed / 4):
        snapped = Mesh.of(np.round(mesh.vertices / step) * step, mesh.triangles)
        assert mesh_step(snapped, [camera]) == step


def test_bad_bytes_are_refused():
    data = encode_mesh(sphere(6, 8), step=2.0**-8).data
    for bad in (b"something else, long enough to hold a header", data[:40], data[:7]):
        with refused(ValueError, by="decode_mesh"):
            decode_mesh(bad)
    with refused(ValueError, "0", by="encode_mesh"):
        encode_mesh(sphere(6, 8), step=0.3)
