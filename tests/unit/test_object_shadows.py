"""Shadows of an object's own lamps against a slow reference, triangle by triangle; and the pictures that have them."""

from dataclasses import replace

import numpy as np
import pytest
from coded_dome import coded_dome
from refusals import refused

from nishiki.brdf.texels.model import CaptureLamps, predict
from nishiki.errors import UserError
from nishiki.geometry.camera import look_at
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import disc_points
from nishiki.render.object.shots import FreeLamp, FreeLighting, LitObject
from nishiki.stages.render import ObjectRenderSettings
from nishiki.stages.render.object import own_lamps

LAMP = FreeLamp(azimuth=0.7, elevation=0.1, radius=0.4)


@pytest.fixture(scope="module")
def decoded(tmp_path_factory):
    """A bumpy ball, whose bumps shade each other."""
    return coded_dome(tmp_path_factory.mktemp("object"))


def slow_visible(mesh: Mesh, start, end, near: bool) -> bool:
    """Whether nothing stands between a point and a place (near), or in a direction: every triangle is tried."""
    along = end - start if near else end
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    matrices = np.stack([np.broadcast_to(-along, a.shape), b - a, c - a], axis=-1)
    sound = abs(np.linalg.det(matrices)) > 1e-14
    t, u, v = np.linalg.solve(matrices[sound], (start - a[sound])[..., None])[..., 0].T
    return not ((t > 0) & ((t < 1) | (not near)) & (u >= 0) & (v >= 0) & (u + v <= 1)).any()


@pytest.mark.parametrize("distance", [None, 0.8])
def test_visible_share_of_a_lamp_against_every_triangle(decoded, distance):
    mesh, rays = decoded.mesh, 5
    lamp = FreeLamp(LAMP.azimuth, LAMP.elevation, radius=LAMP.radius, distance=distance)
    lit = LitObject(mesh, FreeLighting((lamp,), rays=rays))
    view = lit.seen_by(decoded.cameras[2])
    front = decoded.cameras[2].rotation * [[1], [-1], [-1]]  # right, up, to the camera
    towards = front.T @ lamp.towards
    chosen = np.random.default_rng(1).choice(len(mesh.vertices), 90, replace=False)
    points, normals = mesh.vertices[chosen], mesh.normals[chosen].astype(float)
    across = np.linalg.svd(towards[None])[2][1:]
    near = distance is not None
    middle = lit.centre + 2 * lit.radius * distance * towards if near else towards
    length = np.linalg.norm(middle - lit.centre) if near else 1.0
    got = view.visible(lamp, points, normals)
    reference = []
    for point, normal in zip(points, normals, strict=True):
        if normal @ (middle - point if near else middle) <= 0:
            reference.append(0.0)
            continue
        ends = view._disc(lamp, rays)[1]
        reference.append(np.mean([slow_visible(mesh, point + lit.lift * normal, end, near) for end in ends]))
    np.testing.assert_array_equal(got, np.float32(reference))
    assert 0 < (got == 0).sum() < len(got)
    assert ((got > 0) & (got < 1)).any()
    # the disc: across the direction to its middle, as wide as the lamp's angle says
    off = view._disc(lamp, 400)[1] - middle
    if not near:
        off = view._disc(lamp, 400)[1] / (view._disc(lamp, 400)[1] @ towards)[:, None] - towards
    np.testing.assert_allclose(off @ towards, 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(off @ across.T, axis=1).max(), length * np.tan(lamp.radius), rtol=2e-3)


def test_points_cover_the_disc_evenly():
    points = disc_points(500)
    reach = np.linalg.norm(points, axis=1)
    assert reach.max() <= 1
    assert abs((reach < 0.5).mean() - 0.25) < 0.01
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.01)
    assert (disc_points(1) == 0).all()


def test_a_picture_without_shadows_is_that_of_a_captured_lamp_at_the_same_place(decoded):
    plain = decoded.renderer(model_only=True, rim=0)
    plain.lighting = CaptureLamps("direction", (tuple(map(float, LAMP.towards)),))
    own = decoded.renderer(own_lamps=FreeLighting((LAMP,), shadows=False), rim=0)
    want, got = (next(each.render([each.captured(3)])) for each in (plain, own))
    np.testing.assert_allclose(got.linear, want.linear, atol=1e-6)


def test_a_shaded_texel_shows_the_light_from_around_alone(decoded):
    """Two lamps, of which one is hidden: what is left is the other and the even light, at texels."""
    lamps = (LAMP, FreeLamp(2.5, 0.9, intensity=0.4, distance=1.5))
    lit = LitObject(decoded.mesh, FreeLighting(lamps, around=0.1, rays=4))
    camera = decoded.cameras[0]
    view, count = lit.seen_by(camera), len(decoded.mesh.vertices)
    kd, ks = np.full((count, 3), 0.5, np.float32), np.full((count, 3), 0.1, np.float32)
    sigma = np.full(count, 0.2, np.float32)
    points = decoded.mesh.vertices.astype(np.float32), decoded.mesh.normals.astype(np.float32)
    body, gloss = view.predict(kd, ks, sigma, *points)
    want_body, want_gloss = np.full((count, 3), 0.05), np.zeros((count, 3))
    for lamp in lamps:
        parts = predict(kd, ks, sigma, *points, camera.centre, view._in_object_frame(lamp))
        share = lamp.intensity * view.visible(lamp, *points)[:, None]
        want_body, want_gloss = want_body + share * parts[0], want_gloss + share * parts[1]
    np.testing.assert_allclose(body, want_body, atol=1e-5)
    np.testing.assert_allclose(gloss, want_gloss, atol=1e-5)


def test_shadows_of_a_post_on_a_plate_lie_where_geometry_says():
    """A wall of height 1 on a plate throws a shadow of 1 / tan(elevation), at the far side of the lamp."""
    x, y = np.meshgrid(np.linspace(-3, 3, 121), np.linspace(-3, 3, 121))
    plate = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    a = (np.arange(120)[:, None] * 121 + np.arange(120)).reshape(-1)
    faces = np.concatenate([np.stack([a, a + 1, a + 122], 1), np.stack([a, a + 122, a + 121], 1)])
    wall = np.array([[0.01, -3, 0], [0.01, 3, 0], [0.01, 3, 1], [0.01, -3, 1]])
    mesh = Mesh.of(
        np.concatenate([plate, wall]), np.concatenate([faces, [[14641, 14642, 14643], [14641, 14643, 14644]]])
    )
    camera = look_at((0, 0, 10), (0, 0, 0), rows=10, columns=10, field_of_view=0.5, up=(0, 1, 0))
    elevation = np.radians(40)
    view = LitObject(mesh, FreeLighting((), rays=1)).seen_by(camera)
    points = np.stack([np.linspace(-2.9, 2.9, 59), np.full(59, 0.02), np.zeros(59)], axis=1)
    seen = view.visible(FreeLamp(0.0, elevation), points, np.tile([0, 0, 1.0], (59, 1)))
    reach = (1 - view.lit.lift) / np.tan(elevation)
    np.testing.assert_array_equal(seen == 0, (points[:, 0] < 0.01) & (points[:, 0] > 0.01 - reach))
    view = LitObject(mesh, FreeLighting((), rays=256)).seen_by(camera)
    soft = view.visible(FreeLamp(0.0, elevation, radius=np.radians(5)), points, np.tile([0, 0, 1.0], (59, 1)))
    np.testing.assert_allclose(soft[np.argmin(abs(points[:, 0] + 1 / np.tan(elevation)))], 0.5, atol=0.35)
    assert len(np.unique(soft)) > 4


def test_the_ceiling_of_the_capture_does_not_bind_other_lamps(decoded):
    assert decoded.ceiling == 1
    lighting = FreeLighting((replace(LAMP, intensity=4.0),), shadows=False)
    renderers = [each.renderer(own_lamps=lighting) for each in (decoded, replace(decoded, ceiling=None))]
    got, want = (next(each.render([each.captured(3)])).linear for each in renderers)
    assert got.max() > 1.5
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("name", ["around", "shadows", "shadow_rays"])
def test_what_goes_with_lamps_is_refused_without_them(name):
    changed = {"around": 0.2, "shadows": False, "shadow_rays": 4}[name]
    with refused(UserError, name):
        own_lamps(ObjectRenderSettings(**{name: changed}))
    assert own_lamps(ObjectRenderSettings(**{name: changed}, lamps={"dark": {"intensity": 0}}))


def test_settings_name_one_kind_of_light():
    settings = ObjectRenderSettings(lamps={"left": {"azimuth_deg": 180, "elevation_deg": 30, "distance": 1.5}})
    lighting = own_lamps(settings)
    np.testing.assert_allclose(lighting.lamps[0].towards, [-np.cos(np.pi / 6), 0, 0.5], atol=1e-12)
    assert (lighting.around, lighting.shadows, lighting.lamps[0].distance) == (0.05, True, 1.5)
    assert own_lamps(ObjectRenderSettings()) is None
    with refused(UserError, "object_render"):
        own_lamps(settings.model_copy(update={"lights": {"a": 1.0}}))
