"""PLY and OBJ files in and out, and what is said about broken ones."""

import numpy as np
import pytest
import trimesh

from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.mesh_files import read_points, read_triangles, write_ply


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(2, 12.5)


@pytest.mark.parametrize("kind", ["ply", "ascii", "obj"])
def test_read_what_others_write(ball, tmp_path, kind):
    path = tmp_path / f"ball.{'obj' if kind == 'obj' else 'ply'}"
    if kind == "obj":
        path.write_text(trimesh.exchange.obj.export_obj(ball, digits=9))
    else:
        path.write_bytes(trimesh.exchange.ply.export_ply(ball, encoding="ascii" if kind == "ascii" else "binary"))
    vertices, triangles = read_triangles(path)
    np.testing.assert_allclose(vertices, ball.vertices, atol=1e-5)
    np.testing.assert_array_equal(triangles, ball.faces)


def test_what_is_written_is_read_again_exactly(ball, tmp_path):
    mesh = Mesh.of(ball.vertices * np.pi, ball.faces)
    path = tmp_path / "mesh.ply"
    write_ply(path, mesh, stamp={"scene": "a ball", "key": "0123"}, unit="mm")
    vertices, triangles = read_triangles(path)
    np.testing.assert_array_equal(vertices, mesh.vertices)
    np.testing.assert_array_equal(triangles, mesh.triangles)
    heading = path.read_bytes().split(b"end_header")[0].decode()
    assert "comment scene a ball" in heading
    assert "comment key 0123" in heading
    assert "comment unit mm" in heading


def test_squares_become_triangles(tmp_path):
    path = tmp_path / "square.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    vertices, triangles = read_triangles(path)
    assert len(vertices) == 4
    assert len(triangles) == 2
    path = tmp_path / "square.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
    )
    assert len(read_triangles(path)[1]) == 2


def test_points_without_faces_are_a_scan_but_no_mesh(tmp_path):
    path = tmp_path / "cloud.ply"
    lines = "\n".join(f"{x} {x * x} 1" for x in range(20))
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 20\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        + lines
        + "\n"
    )
    points, faces = read_points(path)
    assert points.shape == (20, 3)
    assert faces is None
    with pytest.raises(UserError, match=r"20 points without faces.*turntable\.scans"):
        read_triangles(path)


HEADING = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEADING + "0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n", "1 of 3 vertices are not finite, the first is number 1"),
        (HEADING + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "vertex 7, expected 0 to 2"),
        (HEADING[:60], "damaged PLY"),
        ("hello", "damaged PLY"),
        (HEADING + "0 0 0\n1 0", "damaged PLY"),
    ],
)
def test_broken_files_are_reported(tmp_path, text, said):
    path = tmp_path / "broken.ply"
    path.write_text(text)
    with pytest.raises(UserError, match=said):
        read_triangles(path)


def test_cut_off_and_foreign_files_are_reported(ball, tmp_path):
    path = tmp_path / "cut.ply"
    data = trimesh.exchange.ply.export_ply(ball)
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match=r"cut\.ply: damaged PLY"):
        read_triangles(path)
    with pytest.raises(UserError, match=r"expected a \.ply or \.obj"):
        read_triangles(tmp_path / "mesh.stl")
    with pytest.raises(UserError, match="not found"):
        read_triangles(tmp_path / "nowhere.ply")
    few = tmp_path / "few.obj"
    few.write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(UserError):
        read_points(few)
