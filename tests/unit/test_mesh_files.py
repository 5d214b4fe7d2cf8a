"""PLY and OBJ files in and out, and what is said about broken ones."""

import struct

import numpy as np
import pytest
import trimesh
from refusals import refused

from nishiki.errors import UserError
from nishiki.formats.mesh_heading import expect_mesh
from nishiki.geometry.mesh import Mesh, read_points, read_triangles, write_ply
from nishiki.render.cloth.surfaces import read_surface


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
    assert {"comment scene a ball", "comment key 0123", "comment unit mm"} <= set(heading.splitlines())


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
    with refused(UserError, "20", "turntable.scans"):
        read_triangles(path)


HEADING = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEADING + "0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n", "1 of 3"),
        (HEADING + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "7"),
        (HEADING[:60], "PLY"),
        ("hello", "PLY"),
        (HEADING + "0 0 0\n1 0", "PLY"),
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
    with refused(UserError, "nowhere.ply"):
        read_triangles(tmp_path / "nowhere.ply")
    few = tmp_path / "few.obj"
    few.write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(UserError):
        read_points(few)


HOUSE = np.array(
    [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [0, 0, 10], [10, 0, 10], [10, 10, 10], [0, 10, 10], [5, 5, 16]],
    "f4",
)
HOUSE_FACES = [
    [0, 3, 2, 1],
    [0, 1, 5, 4],
    [1, 2, 6, 5],
    [2, 3, 7, 6],
    [3, 0, 4, 7],
    [4, 5, 8],
    [5, 6, 8],
    [6, 7, 8],
    [7, 4, 8],
]


def house(order, count="B", index="i", *, line="\n", colours=False, texture=False):
    """A box of squares under a roof of triangles: area 500 + 4 sqrt(1525) and volume 1200."""
    names = {"B": "uchar", "H": "ushort", "I": "uint", "i": "int"}
    lines = [
        "ply",
        f"format binary_{order}_endian 1.0",
        "element vertex 9",
        *(f"property float {axis}" for axis in "xyz"),
    ]
    lines += ["element face 9", f"property list {names[count]} {names[index]} vertex_indices"]
    lines += ["property uchar red", "property uchar green"] if colours else []
    lines += ["property list uchar float texcoord"] if texture else []
    end = "<" if order == "little" else ">"
    data = HOUSE.astype(f"{end}f4").tobytes()
    for face in HOUSE_FACES:
        data += struct.pack(f"{end}{count}{len(face)}{index}", len(face), *face) + (b"\1\2" if colours else b"")
        pairs = [value for corner in face for value in (corner / 10, 1 - corner / 10)]
        data += struct.pack(f"{end}B{len(pairs)}f", len(pairs), *pairs) if texture else b""
    return line.join([*lines, "end_header", ""]).encode() + data


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize(
    ("count", "index", "more"),
    [
        ("B", "i", {}),
        ("H", "H", {}),
        ("I", "I", {"line": "\r\n"}),
        ("B", "I", {"colours": True}),
        ("B", "i", {"texture": True, "colours": True}),
    ],
)
def test_triangles_and_squares_in_one_binary_file(tmp_path, order, count, index, more):
    path = tmp_path / "house.ply"
    path.write_bytes(house(order, count, index, **more))
    expect_mesh(path, path.name, "capture.yaml", scan=False)
    vertices, triangles = read_triangles(path)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    assert len(triangles) == 14
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(500 + 4 * 1525**0.5)
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(1200)
    if more.get("texture"):
        surface = read_surface(path)
        number = [int(np.flatnonzero((HOUSE == vertex).all(axis=1))[0]) for vertex in surface.mesh.vertices]
        np.testing.assert_allclose(surface.uv, [[n / 10, 1 - n / 10] for n in number], atol=1e-6)


def test_mixed_files_that_end_anywhere_are_refused(tmp_path):
    path = tmp_path / "house.ply"
    content = house("little")
    for length in range(content.index(b"end_header"), len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(UserError):
            read_triangles(path)
