"""Range scans of a known shape, moved by known motions, brought together again."""

import numpy as np
import pytest
import trimesh
from refusals import refused
from scipy.spatial.transform import Rotation

from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.scans import (
    APT_LINE,
    FILTERS,
    Motion,
    cloud_of,
    merge,
    mesh_set,
    missing_filters,
    register,
    thin_points,
)
from nishiki.geometry.surface import distances, shape_of, without_small_parts


@pytest.fixture
def filters():
    """The test needs MeshLab's filters."""
    if missing_filters():
        pytest.skip(f"pymeshlab lacks {', '.join(missing_filters())}; {APT_LINE}")


def body(subdivisions=5):
    """A lumpy potato without symmetry."""
    found = trimesh.creation.icosphere(subdivisions)
    x, y, z = found.vertices.T
    radius = 10 * (1 + 0.25 * x + 0.2 * np.sin(3 * y + 1) + 0.15 * np.cos(4 * z) * x + 0.1 * np.sin(5 * x + 2 * z))
    return Mesh.of(found.vertices * radius[:, None] * [1.0, 1.3, 0.8], found.faces)


def scans_of(mesh, views, rng, noise=0.0):
    """Halves of a mesh seen from several sides, each with its own triangles."""
    found = []
    for angle in np.linspace(0, 2 * np.pi, views, endpoint=False):
        side = np.array([np.cos(angle), np.sin(angle), 0.3])
        facing = (mesh.normals @ side > -0.1)[mesh.triangles].all(axis=1)
        used, faces = np.unique(mesh.triangles[facing], return_inverse=True)
        points = mesh.vertices[used] + noise * rng.normal(size=(len(used), 3))
        found.append((points, faces.reshape(-1, 3)))
    return found


def motion_of(rng, degrees, shift):
    return Motion(Rotation.from_rotvec(np.radians(degrees) * unit(rng)).as_matrix(), shift * unit(rng))


def unit(rng):
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "shift", "noise"), [(8.0, 1.0, 0.0), (8.0, 1.0, 0.03)])
def test_scans_nearly_in_place_are_brought_together(degrees, shift, noise):
    rng = np.random.default_rng(0)
    scans = scans_of(body(), 5, rng, noise)
    moves = [Motion.none()] + [motion_of(rng, degrees, shift) for _ in scans[1:]]
    found = register([move.apply(points) for move, (points, _) in zip(moves, scans, strict=True)])
    assert found.moved == ()
    for motion, move, (points, _) in zip(found.motions, moves, scans, strict=True):
        off = motion.apply(move.apply(points)) - points
        assert np.sqrt((off**2).sum(axis=1)).mean() < 0.05 + noise


@pytest.mark.slow
def test_scans_anywhere_are_found_again():
    rng = np.random.default_rng(3)
    scans = scans_of(body(4), 3, rng, 0.01)
    moves = [Motion.none(), motion_of(rng, 150, 40.0), motion_of(rng, 110, 60.0)]
    found = register([move.apply(points) for move, (points, _) in zip(moves, scans, strict=True)])
    assert len(found.moved) >= 1
    for motion, move, (points, _) in zip(found.motions, moves, scans, strict=True):
        off = motion.apply(move.apply(points)) - points
        assert np.sqrt((off**2).sum(axis=1)).mean() < 0.15


@pytest.mark.slow
def test_scans_of_different_things_are_reported():
    plate = np.random.default_rng(5).uniform(-30, 30, (3000, 3)) * [1, 1, 0.3]
    with refused(UserError, by="register"):
        register([body(4).vertices, plate], overlap=0.9)


def test_thinning_is_even_and_normals_are_right():
    points = body(5).vertices
    few = thin_points(points, 500)
    assert 400 < len(few) < 650
    cloud = cloud_of(trimesh.creation.icosphere(5).vertices, most=800)
    assert (np.abs(np.einsum("ij,ij->i", cloud.normals, cloud.points)) > 0.99).all()


@pytest.mark.slow
@pytest.mark.parametrize("triangles", [True, False])
def test_merged_scans_are_the_body_again(filters, triangles):
    rng = np.random.default_rng(7)
    whole = body(5)
    scans = scans_of(whole, 6, rng, 0.01)
    faces = [each if triangles else None for _, each in scans]
    vertices, found, facts = merge([points for points, _ in scans], faces, cells=48)
    mesh, _ = without_small_parts(Mesh.of(vertices, found), smallest=0.1)
    assert facts["merged"]
    covered = np.concatenate([points for points, _ in scans])
    assert np.percentile(distances(covered, mesh), 95) < 0.25
    assert np.percentile(distances(mesh.vertices, whole), 95) < 0.25
    # Towards the outside, as the scans' triangles.
    assert np.median(np.einsum("ij,ij->i", mesh.normals, mesh.vertices)) > 0


@pytest.mark.slow
def test_scans_coarser_than_the_cells_are_merged_without_holes(filters):
    # What lies inside a measured triangle was measured, even where the merged surface's cells are far smaller.
    whole = body(3)
    scans = scans_of(whole, 6, np.random.default_rng(7), 0.0)
    vertices, found, facts = merge([points for points, _ in scans], [faces for _, faces in scans], cells=128)
    mesh = Mesh.of(vertices, found)
    covered = np.concatenate([points[faces].mean(axis=1) for points, faces in scans])
    assert distances(covered, mesh).max() < 0.1
    assert facts["guessed_triangles"] < 0.1 * len(found)


def test_one_scan_with_triangles_stays_as_it_is():
    mesh = body(3)
    vertices, faces, facts = merge([mesh.vertices], [mesh.triangles])
    assert vertices is mesh.vertices
    assert faces is mesh.triangles
    assert not facts["merged"]


def test_missing_filters_are_named_with_the_remedy(monkeypatch):
    monkeypatch.setattr("nishiki.geometry.scans.FILTERS", (*FILTERS, "a_filter_that_nobody_has"))
    assert "a_filter_that_nobody_has" in missing_filters()
    with pytest.raises(UserError, match=f"a_filter_that_nobody_has.*{APT_LINE}"):
        mesh_set()


def test_body_of_the_tests_is_closed():
    assert shape_of(body(3)).watertight


@pytest.mark.parametrize(("user", "status"), [(1000, 0), (0, 0), (0, 100)])
def test_the_test_command_installs_what_meshlab_needs_where_it_may(monkeypatch, capsys, user, status):
    import subprocess
    from types import SimpleNamespace

    from nishiki.commands import project

    called = []

    def command(arguments, **_):
        called.append(arguments[1:])
        return SimpleNamespace(returncode=status, stderr="no network\n")

    monkeypatch.setattr("nishiki.geometry.scans.missing_filters", lambda: FILTERS)
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr("os.geteuid", lambda: user)
    monkeypatch.setattr(subprocess, "run", command)
    project.install_for_meshlab()
    said = capsys.readouterr().err
    assert called == ([] if user else [["-qq", "-y", "update"], ["-qq", "-y", *APT_LINE.split()[1:]]])
    assert (APT_LINE in said) == (user != 0 or status != 0)
    assert ("no network" in said) == (status != 0)
