"""Scenes of Mitsuba 3 for objects, rendered by it beside our own formulas."""

import importlib.util
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from glossy_ball import glossy_ball
from refusals import expect_facts
from scipy.spatial.transform import Rotation
from unit.test_patches_charts import around

from nishiki.brdf.texels.model import CaptureLamps, predict
from nishiki.formats.textured_surface import sample
from nishiki.geometry.camera import Camera
from nishiki.report.svg import figure
from nishiki.stages.export.object import lamp_facts, nearest_pinhole, write_folder
from nishiki.stages.export.object_look import SeenPoints, object_mesh
from nishiki.stages.report.capture import lost

STAMP = {"scene": "ball", "key": "0123456789ab"}
UNIT = 0.001


@pytest.fixture(scope="module")
def mi():
    """Mitsuba with a variant that needs nothing else."""
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (group path-tracing)")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A glossy ball with four cameras: its look, textures of the model, and the folder."""
    folder = tmp_path_factory.mktemp("ball")
    look, parameters, context = glossy_ball()
    textured = object_mesh(context, look)
    figures = write_folder(folder, look, textured, parameters, unit=UNIT, stamp=STAMP)
    return SimpleNamespace(look=look, folder=folder, parameters=parameters, figures=figures)


@pytest.fixture(scope="module")
def nishiki_object(exported, mi):
    """The exported module, its model registered."""
    spec = importlib.util.spec_from_file_location("nishiki_object", exported.folder / "nishiki_object.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.define()
    return module


def along_our_rays(mi, scene, camera, points):
    """What a scene of Mitsuba shows along the rays through seen points of a camera, (n, 3)."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    integrator, centre = scene.integrator(), camera.centre * UNIT
    rays = points.positions * UNIT - centre
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.array([
        integrator.sample(scene, sampler, mi.Ray3f(centre.tolist(), ray.tolist()))[0] for ray in rays
    ])  # fmt: skip


def thinned(points, step):
    """Some of the seen points."""
    return replace(
        points, positions=points.positions[::step], normals=points.normals[::step], places=points.places[::step]
    )


def test_mitsuba_shows_our_model_of_an_object(mi, exported, nishiki_object):
    look = exported.look
    camera = look.decoded.cameras[1]
    points = thinned(SeenPoints.of(look, 1), 7)
    stacked = np.concatenate(list(exported.parameters.values()), axis=-1)
    kd, ks, sigma = np.split(sample(stacked, points.places), [3, 6], axis=1)
    expected = sum(predict(kd, ks, sigma[:, 0], points.positions, points.normals, points.centre, points.lamp))
    scene = nishiki_object.description(view="1 é", body="model", folder=exported.folder)
    theirs = along_our_rays(mi, mi.load_dict(scene), camera, points)
    lit = (expected > 1e-4).all(axis=1) & (theirs > 1e-6).all(axis=1)
    assert lit.mean() > 0.5
    assert len(lit) > 100
    np.testing.assert_allclose(theirs[lit], expected[lit], rtol=2e-3)
    assert np.mean((theirs > 1e-6).all(axis=1) != (expected > 1e-4).all(axis=1)) < 0.05


def test_the_cameras_of_the_scenes_are_the_captures(mi, exported, nishiki_object):
    for camera in exported.look.decoded.cameras:
        scene = mi.load_dict(nishiki_object.description(view=camera.name, folder=exported.folder))
        sensor = scene.sensors()[0]
        assert tuple(sensor.film().size()) == (camera.columns, camera.rows)
        for column, row in ((0, 0), (camera.columns - 1, 3), (10, camera.rows - 1)):
            place = [(column + 0.5) / camera.columns, (row + 0.5) / camera.rows]
            ray = sensor.sample_ray(0, 0, place, [0.5, 0.5])[0]
            point = (np.array(ray.o) + 5 * UNIT * np.array(ray.d)) / UNIT
            np.testing.assert_allclose(camera.project(point[None])[0], [[column, row]], atol=0.01)
    assert exported.figures["camera_px"] == pytest.approx(0, abs=1e-6)
    assert "cameras" not in lost(exported.figures)


def test_what_a_pinhole_with_square_pixels_cannot_say_is_told(exported, tmp_path):
    look = exported.look
    wide = np.diag([1, 1.02, 1])
    bent = [
        replace(camera, intrinsics=camera.intrinsics @ wide, distortion=(0.5, 0, 0, 0, 0))
        for camera in look.decoded.cameras
    ]
    other = replace(look, decoded=SimpleNamespace(**{**vars(look.decoded), "cameras": bent}))
    mesh = object_mesh(SimpleNamespace(inputs={"mesh": SimpleNamespace(diagnostics={})}), look)
    figures = write_folder(tmp_path, other, mesh, exported.parameters, unit=1.0, stamp=STAMP)
    assert figures["camera_px"] > 0.5
    expect_facts(lost(figures), figure(figures["camera_px"]))


def test_the_nearest_pinhole_of_a_projective_camera_and_of_a_square_one(exported):
    (camera, *_), points = exported.look.decoded.cameras, exported.look.decoded.mesh.vertices
    assert nearest_pinhole(camera, points) is camera
    skewed = np.array([[1.4, 0.03, 0], [0, 1, 0], [0, 0, 1.0]])
    matrix = (
        camera.intrinsics
        @ skewed
        @ Rotation.from_rotvec([0.4, 0.1, 0]).as_matrix()
        @ np.column_stack([camera.rotation, camera.translation])
    )
    oblong = Camera.from_matrix("oblong", matrix, rows=camera.rows, columns=camera.columns)
    found = nearest_pinhole(oblong, points)
    k = found.intrinsics
    assert k[0, 0] == k[1, 1]
    assert k[0, 1] == 0
    np.testing.assert_allclose(found.centre, oblong.centre, atol=1e-9)
    expected = oblong.project(points)[0]
    apart = np.sum((found.project(points)[0] - expected) ** 2)

    def moved(angles, focal, axis):
        turned = Rotation.from_rotvec(angles).as_matrix() @ found.rotation
        square = k * [[focal, 1, 1], [1, focal, 1], [1, 1, 1]] + np.array([[0, 0, axis[0]], [0, 0, axis[1]], [0, 0, 0]])
        other = replace(found, intrinsics=square, rotation=turned, translation=-turned @ found.centre)
        return np.sum((other.project(points)[0] - expected) ** 2)

    random = np.random.default_rng(4)
    for _ in range(200):  # nothing nearby is nearer
        size = 10 ** random.uniform(-4, -1)
        angles, axis = size * random.normal(size=3), size * k[0, 0] * random.normal(size=2)
        assert moved(angles, np.exp(size * random.normal()), axis) > (1 - 1e-3) * apart


def test_lamps_of_each_kind(mi, nishiki_object):
    known = {"kind": "point", "position": [0, 0, 1], "distance": 2.0, "falloff": True}
    assert nishiki_object.lamp_of(known)["intensity"]["value"] == pytest.approx([4 * np.pi] * 3)
    unknown = {**known, "falloff": False}
    assert nishiki_object.lamp_of(unknown)["type"] == "nishiki_lamp"
    for lamp in ({"kind": "directional", "direction": [0, 0, -1]}, {"kind": "around", "radiance": [0.1, 0.2, 0.3]}):
        assert mi.load_dict(nishiki_object.lamp_of(lamp)) is not None


def test_what_the_scene_says_of_each_kind_of_lamp():
    camera, middle = around(4)[1], np.array([0.1, 0.2, 0.3]) * UNIT
    near = lamp_facts(CaptureLamps("camera", reference=2.0).lamp(camera), middle, UNIT)
    np.testing.assert_allclose(near.pop("position"), camera.centre * UNIT, rtol=1e-6)
    assert near == {"kind": "point", "distance": 2 * UNIT, "falloff": True}
    unknown = lamp_facts(CaptureLamps("camera").lamp(camera), middle, UNIT)
    assert unknown["distance"] == pytest.approx(np.linalg.norm(camera.centre * UNIT - middle))
    assert unknown["falloff"] is False
    far = lamp_facts(CaptureLamps("direction", ((0.0, 0.6, 0.8),)).lamp(camera), middle, UNIT)
    back = camera.rotation @ far["direction"]  # x right, y down, z into the scene
    np.testing.assert_allclose(back, [0, 0.6, 0.8], atol=1e-6)
    harmonics = tuple((0.1 * k, 0.2, 0.3) for k in range(9, 0, -1))
    room = lamp_facts(CaptureLamps("environment", harmonics=(harmonics,)).lamp(camera), middle, UNIT)
    assert room["kind"] == "around"
    assert room["radiance"] == pytest.approx([0.9, 0.2, 0.3])
