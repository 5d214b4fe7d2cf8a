"""A mesh in another unit or with other axes than its cameras is recognised, with the keys that bring it back."""

import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from turned_cameras import turn

from nishiki.capture.folder import load_capture
from nishiki.capture.tables import MATRIX_COLUMNS
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.placement import AXES, measure_placement, move_mesh, outline_of
from nishiki.observations.check import check_capture
from nishiki.observations.views import Views
from nishiki.observations.views_store import write_views
from nishiki.stages.ingest import IngestSettings
from nishiki.stages.mesh.run import read_file

CAMERAS = turn(8)


@pytest.fixture(scope="module")
def stairs():
    """A body without any symmetry, about 1 across."""
    parts = [
        trimesh.creation.box((0.8, 0.5, 0.3), trimesh.transformations.translation_matrix((0, 0, -0.3))),
        trimesh.creation.box((0.3, 0.5, 0.4), trimesh.transformations.translation_matrix((-0.25, 0, 0.05))),
        trimesh.creation.box((0.3, 0.2, 0.3), trimesh.transformations.translation_matrix((-0.25, 0.15, 0.4))),
    ]
    body = trimesh.util.concatenate(parts)
    return np.asarray(body.vertices, float), np.asarray(body.faces)


@pytest.fixture(scope="module")
def silhouettes(stairs):
    mesh = Mesh.of(*stairs)
    return [outline_of(mesh, camera) for camera in CAMERAS]


def test_a_mesh_in_its_place_is_left_there(stairs, silhouettes):
    found = measure_placement(Mesh.of(*stairs), silhouettes, CAMERAS)
    assert (found.scale, found.order, found.signs) == (1, (0, 1, 2), (1, 1, 1))
    assert found.overlap == found.best > 0.97


@pytest.mark.parametrize(
    ("scale", "axes"),
    [
        (0.001, AXES[0]),
        (1.0, AXES[1]),
        (1.0, AXES[2]),
        (10.0, AXES[2]),
        (1 / 25.4, ((2, 0, 1), (1, 1, 1))),
        (1.0, ((0, 1, 2), (-1, -1, 1))),
    ],
)
def test_units_and_axes_are_recognised(stairs, silhouettes, scale, axes):
    moved = move_mesh(*stairs, scale, *axes)
    found = measure_placement(Mesh.of(*moved), silhouettes, CAMERAS)
    assert found.overlap < 0.8
    assert found.best > 0.97
    again, triangles = move_mesh(*moved, found.scale, found.order, found.signs)
    np.testing.assert_allclose(again, stairs[0], atol=1e-12)
    np.testing.assert_array_equal(triangles, stairs[1])


def test_axes_that_mirror_a_mesh_keep_its_outside(stairs):
    vertices, triangles = move_mesh(*stairs, 2.0, (0, 1, 2), (-1, 1, 1))
    volumes = [
        np.einsum("ij,ij->", v[t[:, 0]], np.cross(v[t[:, 1]], v[t[:, 2]])) for v, t in ((vertices, triangles), stairs)
    ]
    assert volumes[0] == pytest.approx(8 * volumes[1])


@pytest.fixture
def capture(tmp_path, stairs, silhouettes):
    """A capture with silhouettes and a mesh in metres with its second axis upwards."""
    folder = tmp_path / "c"
    lines = ["file,role,view,silhouette"]
    for camera, mask in zip(CAMERAS, silhouettes, strict=True):
        for kind, picture in (("frames", 40 + 150 * mask), ("outlines", 255 * mask)):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{camera.name}.png"), picture.astype(np.uint8))
        lines.append(f"frames/{camera.name}.png,sample,{camera.name},outlines/{camera.name}.png")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    rows = [",".join([camera.name, *map(repr, camera.matrix.ravel().tolist())]) for camera in CAMERAS]
    (folder / "cameras.csv").write_text(",".join(["view", *MATRIX_COLUMNS]) + "\n" + "\n".join(rows) + "\n")
    vertices, triangles = move_mesh(*stairs, 0.001, *AXES[2])
    trimesh.Trimesh(vertices, triangles, process=False).export(folder / "stairs.ply")
    block = {"full_turn": True, "cameras": "cameras.csv", "mesh": "stairs.ply"}
    settings = {"format": 1, "title": "Stairs", "geometry": "turntable", "turntable": block}
    settings["camera"] = {"channels": ["grey"], "bits": 8}
    (folder / "capture.yaml").write_text(yaml.safe_dump(settings))
    return folder


def test_check_names_the_keys_that_bring_a_mesh_into_its_place_and_the_stage_obeys_them(capture, tmp_path, stairs):
    (problem,) = [p for p in check_capture(capture) if p.kind == "mesh-placement"]
    assert (problem.severity, problem.file) == ("error", "stairs.ply")
    settings = yaml.safe_load((capture / "capture.yaml").read_text())
    for key in ("mesh_scale: [0-9.]+", "mesh_axes: '[xyz,-]+'"):
        settings["turntable"] |= yaml.safe_load(re.search(key, problem.remedy)[0])
    (capture / "capture.yaml").write_text(yaml.safe_dump(settings))
    assert not [p for p in check_capture(capture) if p.kind == "mesh-placement"]
    (tmp_path / "ingest").mkdir()
    write_views(load_capture(capture), tmp_path / "ingest", settings=IngestSettings())
    views = Views(tmp_path / "ingest")
    inputs = {"ingest": SimpleNamespace(path=lambda name: capture / "stairs.ply")}
    vertices, triangles, _ = read_file(SimpleNamespace(inputs=inputs), views, CAMERAS, None)
    np.testing.assert_allclose(vertices, stairs[0], atol=1e-6)
    np.testing.assert_array_equal(triangles, stairs[1])


def test_a_mesh_that_no_unit_brings_there_is_refused_and_a_damaged_one_named(capture):
    mesh = trimesh.load(capture / "stairs.ply", process=False)
    mesh.vertices = mesh.vertices[::-1] * 2000 + 3
    mesh.export(capture / "stairs.ply")
    assert ("mesh-placement", "error") in {(p.kind, p.severity) for p in check_capture(capture)}
    (capture / "stairs.ply").write_bytes(
        (capture / "stairs.ply").read_bytes().replace(b"list uchar int", b"list uchar float")
    )
    assert "mesh-unreadable" in {p.kind for p in check_capture(capture)}
