"""The simulated turntable: shape, rays, reflection, interreflection, polarisers and noise against slow references."""

import dataclasses
import math

import numpy as np
import pytest

from nishiki import threads
from nishiki.errors import UserError
from nishiki.geometry.visibility import cast, make_tree
from nishiki.simulate.capture import BOARD_REFLECTANCE, CameraSettings
from nishiki.simulate.turntable.materials import INDEX, NUMBERS, describe, reflect
from nishiki.simulate.turntable.photographs import components, make_optics, photograph, signal, white_board
from nishiki.simulate.turntable.render import cosine_directions, irradiance, look_around, make_scene, see, trace_bounces
from nishiki.simulate.turntable.shape import (
    BETA,
    LAMP_MM,
    LEAK,
    SimulatedSurface,
    TurntableSettings,
    distance,
    make_surface,
    place_views,
    scan,
)

SMALL = TurntableSettings(rows=64, columns=64, views=4, triangles=4000, samples=3, directions=64)
QUIET = dataclasses.replace(SMALL, camera=CameraSettings(bits=16, black_level=1024, noise=False, white_level=0.3))


@pytest.fixture(scope="module")
def scene():
    return make_scene(SMALL)


@pytest.fixture(scope="module")
def light(scene):
    return see(scene, place_views(SMALL)[1], SMALL)


def material(albedo=0.6, metal=0.0, along=0.3, across=0.3, sigma=0.25):
    m = np.zeros(NUMBERS)
    m[:3], m[3:6], m[6], m[7], m[8] = albedo, metal, along, across, sigma
    m[9:12], m[12:15] = (0, 0, 1), (1, 0, 0)
    return m


MATERIALS = (
    material(),
    material(0.9, sigma=0.0, along=0.1, across=0.1),
    material(0.0, metal=0.95, along=0.45, across=0.2),
    material(0.9, sigma=0.6, along=0.9, across=0.9),
)


def hemisphere(random, count):
    d = random.standard_normal((count, 3))
    d[:, 2] = np.abs(d[:, 2])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("m", MATERIALS)
def test_reflection_is_the_same_both_ways(m):
    random = np.random.default_rng(1)
    light, view = hemisphere(random, 500), hemisphere(random, 500)
    there, back = (reflect(np.tile(m, (500, 1)), a, b) for a, b in ((light, view), (view, light)))
    for one, other in zip(there, back, strict=True):
        np.testing.assert_allclose(one / light[:, 2:], other / view[:, 2:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("m", MATERIALS)
@pytest.mark.parametrize("angle", [0.0, 30.0, 60.0, 80.0, 88.0])
def test_never_more_light_leaves_than_arrives(m, angle):
    """Furnace: under light 1 from everywhere no surface is brighter than 1; a white metal hardly darker."""
    cosine, turn = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(256) + 0.5) / 256 * 2 * np.pi)
    sine = np.sqrt(1 - cosine**2)
    light = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=-1).reshape(-1, 3)
    view = np.array([math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))])
    body, gloss = reflect(np.tile(m, (len(light), 1)), light, np.tile(view, (len(light), 1)))
    total = 2.0 * (body + gloss).mean(axis=0)  # mean over the hemisphere of pi f cos, times 2 pi / pi
    assert (total <= 1.0).all()
    if m[3] > 0 and angle <= 60:
        assert (total > 0.75).all()


def test_reflection_agrees_with_the_formulas_written_out():
    random = np.random.default_rng(2)
    m = material(0.5, along=0.35, across=0.15, sigma=0.3)
    light, view = hemisphere(random, 200), hemisphere(random, 200)
    body, gloss = reflect(np.tile(m, (200, 1)), light, view)
    half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
    scale = np.array([0.35, 0.15])
    density = 1 / (np.pi * 0.35 * 0.15 * (np.sum((half[:, :2] / scale) ** 2, axis=1) + half[:, 2] ** 2) ** 2)

    def hidden(d):  # Smith's lambda
        return 0.5 * (np.sqrt(1 + np.sum((d[:, :2] * scale) ** 2, axis=1) / d[:, 2] ** 2) - 1)

    def mirror(cosine):  # Fresnel's amplitudes for the two polarisations
        inner = np.sqrt(1 - (1 - cosine**2) / INDEX**2)
        s, p = (cosine - INDEX * inner) / (cosine + INDEX * inner), (inner - INDEX * cosine) / (inner + INDEX * cosine)
        return 0.5 * (s**2 + p**2)

    expected = np.pi * density * mirror(np.sum(half * view, axis=1)) / (1 + hidden(light) + hidden(view))
    np.testing.assert_allclose(gloss[:, 0], expected / (4 * view[:, 2]), rtol=1e-9)
    theta_i, theta_r = np.arccos(light[:, 2]), np.arccos(view[:, 2])
    turn = np.arctan2(light[:, 1], light[:, 0]) - np.arctan2(view[:, 1], view[:, 0])
    a, b = 1 - 0.5 * 0.09 / (0.09 + 0.33), 0.45 * 0.09 / (0.09 + 0.09)
    nayar = a + b * np.maximum(np.cos(turn), 0) * np.sin(np.maximum(theta_i, theta_r)) * np.tan(
        np.minimum(theta_i, theta_r)
    )
    passing = (1 - mirror(light[:, 2])) * (1 - mirror(view[:, 2]))
    np.testing.assert_allclose(body[:, 0], 0.5 * light[:, 2] * nayar * passing, rtol=1e-9)


def test_rays_agree_with_every_triangle_tried():
    surface = make_surface(3600)
    tree = make_tree(surface.vertices, surface.triangles)
    random = np.random.default_rng(3)
    count = 120
    directions = random.standard_normal((count, 3))
    origins = random.uniform(-60, 60, (count, 3)) + np.array([0, 70, 0])
    origins[::2] -= 300 * directions[::2]
    found = cast(tree, origins, directions)
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    for ray in range(count):
        # t, u, v of  a + u (b − a) + v (c − a) = o + t d, by Cramer's rule on every triangle
        system = np.stack([np.broadcast_to(-directions[ray], a.shape), b - a, c - a], axis=-1)
        t, u, v = np.linalg.solve(system, (origins[ray] - a)[..., None])[..., 0].T
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if not hit.any():
            assert found.triangle[ray] == -1
            continue
        nearest = np.flatnonzero(hit)[t[hit].argmin()]
        assert found.distance[ray] == pytest.approx(t[nearest], rel=1e-9)
        assert found.triangle[ray] == nearest
        np.testing.assert_allclose(found.weights[ray], [u[nearest], v[nearest]], atol=1e-9)
    blocked = cast(tree, origins, directions, far=1.0, any_hit=True).triangle >= 0
    np.testing.assert_array_equal(blocked, (found.triangle >= 0) & (found.distance < 1.0))


@pytest.mark.parametrize("wanted", [4000, 12000])
def test_mesh_is_closed_even_and_of_the_wanted_size(wanted):
    surface = make_surface(wanted)
    faces, vertices = surface.triangles, surface.vertices
    assert abs(len(faces) / wanted - 1) < 0.12
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = np.sort(edges[:, 0] * len(vertices) + edges[:, 1])
    np.testing.assert_array_equal(forward, np.sort(edges[:, 1] * len(vertices) + edges[:, 0]))  # closed
    assert (np.diff(forward) > 0).all()  # every edge twice, once in each direction
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 6 * 1.2e6  # outside is outside: the volume is positive
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-9)
    off = distance(vertices[::7].T)
    assert np.percentile(np.abs(off), 95) < 0.02
    moved, same = scan(surface, noise_mm=0.02, seed=4)
    assert same is faces
    offset = np.einsum("ij,ij->i", moved - vertices, surface.normals)
    assert offset.std() == pytest.approx(0.02, rel=0.1)


def ball(inwards):
    """A sphere of radius 10 as triangles, its normals (and sides) inwards or outwards."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, 25)[1:-1], np.linspace(0, 2 * np.pi, 48, endpoint=False), indexing="ij"
    )
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1)
    vertices = np.concatenate([ring.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    index = np.arange(23 * 48).reshape(23, 48)
    right = np.roll(index, -1, axis=1)
    quads = [(index[:-1], index[1:], right[1:]), (index[:-1], right[1:], right[:-1])]
    caps = [(np.full(48, 1104), index[0], right[0]), (np.full(48, 1105), right[-1], index[-1])]
    faces = np.concatenate([np.stack([x.ravel() for x in part], axis=1) for part in (*quads, *caps)])
    sign = -1.0 if inwards else 1.0
    faces = np.ascontiguousarray(faces[:, ::-1] if inwards else faces, np.int32)
    return SimulatedSurface(10 * vertices, faces, sign * vertices, np.zeros((len(vertices), 6)))


def test_light_inside_a_ball_adds_up_as_a_geometric_series():
    surface = ball(inwards=True)
    around = look_around(surface, make_tree(surface.vertices, surface.triangles), directions=64, seed=1)
    assert (around.seen >= 0).all()
    around = dataclasses.replace(around, albedo=np.tile([0.5, 0.8, 1.0], (len(surface.vertices), 1)))
    for bounces, expected in ((0, [0, 0, 0]), (1, [0.5, 0.8, 1]), (3, [0.875, 0.8 + 0.64 + 0.512, 3])):
        indirect, leaving = trace_bounces(around, np.ones(len(surface.vertices)), bounces)
        np.testing.assert_allclose(indirect, np.tile(expected, (len(indirect), 1)), rtol=1e-12)
        np.testing.assert_allclose(leaving, around.albedo * (1 + indirect), rtol=1e-12)
    # Half of the ball lit: the form factor between any two places is the same, so everything gets half of it.
    lit = (surface.vertices[:, 2] > 0).astype(float)
    indirect, _ = trace_bounces(around, lit, 1)
    assert indirect[:, 0].mean() == pytest.approx(0.25, abs=0.02)
    assert indirect[:, 0].std() < 0.04


def test_nothing_convex_sees_itself():
    surface = ball(inwards=False)
    around = look_around(surface, make_tree(surface.vertices, surface.triangles), directions=64, seed=1)
    assert np.mean(around.seen >= 0) < 0.02  # rays near the tangent plane of a corner may graze the flat triangles


def test_directions_have_the_moments_of_the_cosine():
    d = cosine_directions(1024)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1)
    np.testing.assert_allclose(d.mean(axis=0), [0, 0, 2 / 3], atol=2e-3)
    np.testing.assert_allclose((d**2).mean(axis=0), [0.25, 0.25, 0.5], atol=2e-3)


def test_silhouettes_are_those_of_the_projected_mesh(scene, light):
    import cv2

    view = place_views(SMALL)[1]
    seen = np.column_stack([scene.surface.vertices, np.ones(len(scene.surface.vertices))]) @ view.matrix.T
    pixels = seen[:, :2] / seen[:, 2:]
    assert (seen[:, 2] > 0).all()
    assert pixels.min() > -0.5
    assert pixels.max() < 63.5
    fine = np.zeros((64 * 8, 64 * 8), np.uint8)
    for corners in np.rint((pixels[scene.surface.triangles] + 0.5) * 8 - 0.5).astype(np.int32):
        cv2.fillConvexPoly(fine, corners, 1)
    share = fine.reshape(64, 8, 64, 8).mean(axis=(1, 3))
    # A coverage from 9 random samples is off by up to sqrt(1/4/9), the filled polygons by half of a fine pixel.
    assert np.abs(light.coverage - share).max() < 0.6
    assert np.sqrt(np.mean((light.coverage - share) ** 2)) < 0.05
    assert light.coverage.sum() == pytest.approx(share.sum(), rel=0.02)
    assert 0.3 < light.coverage.mean() < 0.6


def test_depth_and_normals_lie_on_the_object(scene, light):
    view = place_views(SMALL)[1]
    inner = np.argwhere((light.coverage == 1.0) & (light.part == 0))
    k = view.matrix[:, :3] @ view.rotation.T
    places = np.column_stack([inner[:, 1], inner[:, 0], np.ones(len(inner))]) @ np.linalg.inv(k).T
    points = (places * light.depth[tuple(inner.T)][:, None]) @ view.rotation + view.centre
    off = distance(points.T)
    assert np.median(np.abs(off)) < 0.5  # a pixel is 3 mm wide here
    assert (np.einsum("ij,ij->i", light.normals[tuple(inner.T)], view.centre - points) > 0).mean() > 0.99


def test_board_and_object_obey_the_polariser_relation(light):
    optics = make_optics(place_views(QUIET)[0], QUIET)
    full, black = 65535 - 1024, 1024
    off, on = ((photograph(light, optics, QUIET, view="x", state=s) - 1024.0) / full for s in ("off", "on"))
    board_off, board_on = (white_board(1, optics, QUIET, state=s).astype(float) - black for s in ("off", "on"))
    beta = board_on / board_off
    np.testing.assert_allclose(beta, optics.beta, rtol=1e-3)
    np.testing.assert_allclose(beta.mean(axis=(0, 1)), BETA, rtol=0.02)
    assert 0.005 < np.ptp(beta[..., 0]) / beta[..., 0].mean() < 0.1  # uneven, but not by much
    diffuse, specular = components(light, QUIET)
    tol = 2.0 / full
    np.testing.assert_allclose(on / beta, optics.sensitivity * (diffuse + np.array(LEAK) * specular), atol=4 * tol)
    rest = 1 - np.array(LEAK)
    np.testing.assert_allclose(off - on / beta, optics.sensitivity * rest * specular, atol=4 * tol)
    assert specular.max() > 0.2
    assert (signal(light, optics, QUIET, "") == signal(light, optics, QUIET, "off")).all()
    assert board_off.max() / full < 0.3 * 1.01 * BOARD_REFLECTANCE


def test_noise_of_photographs_has_the_stated_variance(light):
    optics = make_optics(place_views(SMALL)[0], SMALL)
    camera = SMALL.camera
    electrons = camera.full_well / (2**camera.bits - 1 - camera.black_level)
    expected = signal(light, optics, SMALL, "off") * camera.full_well
    draws = np.stack([photograph(light, optics, SMALL, view=str(n), state="off") for n in range(40)])
    counts = (draws.astype(float) - camera.black_level) * electrons
    free = (draws < 4095).all(axis=0)
    variance = expected + camera.read_noise**2 + electrons**2 / 12
    z = ((counts - expected) / np.sqrt(variance))[:, free]
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert z.var() == pytest.approx(1, abs=0.01)
    assert abs(np.mean(z[::2] * z[1::2])) < 5 / np.sqrt(z.size / 2)  # other views, other noise
    assert not np.array_equal(
        photograph(light, optics, SMALL, view="0", state="off"), photograph(light, optics, SMALL, view="0", state="on")
    )


def test_shadows_and_bounced_light(scene):
    view = place_views(SMALL)[0]
    direct = irradiance(scene, view)
    towards = np.einsum("ij,ij->i", scene.surface.normals, view.lamp - scene.surface.vertices)
    assert (direct[towards < -30] == 0).all()
    assert 0 < np.mean((direct == 0) & (towards > 100)) < 0.3  # some of what faces the lamp lies in shadow
    with_light = see(scene, view, SMALL)
    without = see(scene, view, dataclasses.replace(SMALL, bounces=0))
    added = with_light.diffuse - without.diffuse
    assert added.min() > -1e-6
    assert 0.01 < added.mean() / without.diffuse.mean() < 0.5
    np.testing.assert_array_equal(with_light.specular, without.specular)
    assert (with_light.diffuse >= 0).all()
    assert np.isfinite(with_light.diffuse).all()


def test_materials_are_possible(scene):
    m = describe(scene.surface.parts, scene.surface.vertices, scene.surface.normals, key=scene.key)
    assert (m[:, :3] >= 0).all()
    assert (m[:, :3] <= 0.9).all()
    assert (m[:, 6:8] > 0.05).all()
    assert (m[:, 6:8] < 1.0).all()
    n, t = m[:, 9:12], m[:, 12:15]
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(np.einsum("ij,ij->i", n, t), 0, atol=1e-9)
    assert 0.03 < np.mean(m[:, 3] > 0) < 0.4  # gilded
    assert np.mean(np.einsum("ij,ij->i", n, scene.surface.normals) < 0.98) < 0.2
    assert set(np.unique(scene.surface.parts.argmin(axis=1))) == set(range(6))


def test_bytes_do_not_depend_on_threads(light, monkeypatch):
    monkeypatch.setattr(threads, "threads", lambda: 1)
    again = see(make_scene(SMALL), place_views(SMALL)[1], SMALL)
    for name, values in vars(light).items():
        np.testing.assert_array_equal(getattr(again, name), values)


def test_camera_goes_round_the_object():
    views = place_views(TurntableSettings(views=36))
    matrix = views[9].matrix
    column, row, depth = matrix @ [0, 86, 0, 1]
    assert (column / depth, row / depth) == pytest.approx(views[9].principal)
    assert depth == pytest.approx(1200)
    up = matrix @ [0, 96, 0, 1]
    assert up[1] / up[2] < row / depth  # y up is towards row 0
    for view in views:
        assert np.linalg.det(view.rotation) == pytest.approx(1)
        lamp = view.rotation @ (view.lamp - view.centre)
        np.testing.assert_allclose(lamp * [1, -1, -1], LAMP_MM)
    turns = [math.degrees(math.atan2(v.centre[0], v.centre[2])) for v in views]
    np.testing.assert_allclose(np.diff(np.unwrap(turns, period=360)), -10, atol=1e-9)


@pytest.mark.parametrize("wrong", [{"views": 1}, {"triangles": 10}, {"samples": 9}, {"bounces": 7}, {"rows": 2}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(UserError, match="simulation: "):
        TurntableSettings(**wrong)
