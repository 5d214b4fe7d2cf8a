"""Rendering: against a renderer that loops over samples, known radiances, both sides of the cloth, shadows, layers."""

import numpy as np
import pytest
from benchmarks.cloth_peers import Ward
from exact_dye import exact_dye

from nishiki.brdf.cloth.interface import gloss_of
from nishiki.errors import UserError
from nishiki.geometry.camera import look_at
from nishiki.geometry.mesh import Mesh
from nishiki.render.cloth.models import Surroundings, apply_dyes, disc_point, lookup, openness, share_of, shares
from nishiki.render.cloth.scene import AmbientLight, ClothScene, Lamp, Matte, Surface, together
from nishiki.render.cloth.studio import RenderVariant, frame_camera, linear_colour, render
from nishiki.render.cloth.surfaces import cylinder, paper, sheet, swatch

WARD = Ward(diffuse=np.array([0.1, 0.2, 0.3]), specular=np.array([0.3, 0.3, 0.3]), alpha_x=0.4, alpha_y=0.15)


def wavy():
    u, v = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9), indexing="ij")
    return sheet(np.stack([u, v, 0.3 * np.sin(4 * u) * np.cos(2 * v)], axis=2), side=17)[0]


def camera(size=24, eye=(0.4, 0.6, 4.0)):
    return look_at(eye, (0, 0, 0), rows=size, columns=size, field_of_view=0.7)


def meets(scene, origin, direction, far=np.inf):
    """Nearest triangle along a ray with its weights, by trying all of them."""
    best, found = far, None
    for number, (a, b, c) in enumerate(scene.mesh.vertices[scene.mesh.triangles]):
        matrix = np.column_stack([-direction, b - a, c - a])
        if abs(np.linalg.det(matrix)) < 1e-14:
            continue
        t, u, v = np.linalg.solve(matrix, origin - a)
        if 1e-9 < t < best and u >= 0 and v >= 0 and u + v <= 1:
            best, found = t, (number, np.array([1 - u - v, u, v]))
    return found


def slow(scene, brdf, lamp, view):
    """One sample a pixel, a point-like distant lamp with shadows, nothing else."""
    out = np.zeros((view.rows, view.columns, 3))
    towards = np.asarray(lamp.direction) / np.linalg.norm(lamp.direction)
    for row in range(view.rows):
        for column in range(view.columns):
            k = view.intrinsics
            ray = np.array([(column - k[0, 2]) / k[0, 0], (row - k[1, 2]) / k[1, 1], 1.0]) @ view.rotation
            found = meets(scene, view.centre, ray)
            if found is None:
                continue
            corners = scene.mesh.triangles[found[0]]
            weights = found[1]
            place = weights @ scene.mesh.vertices[corners]
            normal = weights @ scene.mesh.normals[corners].astype(float)
            weft = weights @ scene.weft[corners]
            eye = view.centre - place
            eye /= np.linalg.norm(eye)
            a, b, c = scene.mesh.vertices[corners]
            if np.cross(b - a, c - a) @ eye < 0:
                normal, weft = -normal, -weft
            normal /= np.linalg.norm(normal)
            if normal @ eye < 0.02:
                normal = normal + (0.02 - normal @ eye) * eye
                normal /= np.linalg.norm(normal)
            weft -= (weft @ normal) * normal
            weft /= np.linalg.norm(weft)
            frame = np.stack([weft, np.cross(normal, weft), normal])
            cosine = normal @ towards
            if cosine > 0 and meets(scene, place + 2e-4 * scene.scale * normal, towards) is None:
                out[row, column] = np.pi * brdf.evaluate(frame @ towards, frame @ eye) * cosine * lamp.colour
    return out


@pytest.mark.slow
def test_against_a_loop_over_all_triangles():
    scene = ClothScene.of([wavy()])
    lamp = Lamp(direction=(-0.9, 0.4, 0.6), colour=(1.0, 0.8, 0.6), radius=0.0)
    view = camera(14)
    fast = render(scene, [RenderVariant((WARD,), (1.0,))], [lamp], view, supersampling=1)[0]
    assert fast.evaluated <= fast.samples
    expected = slow(scene, WARD, lamp, view)
    assert 0 < fast.shadowed < 1
    wrong = np.abs(fast.linear - expected).max(axis=2) > 1e-5 * expected.max()
    # A pixel centre on an edge, or a shadow ray along one, may fall on either side.
    assert np.count_nonzero(wrong) <= 2
    assert fast.linear.max() > 0.3


def test_white_paper_that_faces_the_lamp_is_one():
    scene = ClothScene.of([swatch(4, 4)])
    takes = [RenderVariant((Matte((1.0,)),), (1.0,)), RenderVariant((Matte((0.25,)),), (2.0,))]
    pictures = render(scene, takes, [Lamp(direction=(0, 0, 2))], camera(8, (0, 0, 3)), supersampling=2)
    assert np.allclose(pictures[0].linear, 1)
    assert np.allclose(pictures[1].linear, 0.5)
    assert np.all(pictures[0].coverage == 1)


def test_a_near_lamp_falls_off_with_the_square():
    scene = ClothScene.of([swatch(0.02, 0.02)])
    lamps = [Lamp(place=(0, 0, z), distance=2.0) for z in (1.0, 4.0)]
    takes = [RenderVariant((Matte((1.0,)),), weights) for weights in ((1.0, 0.0), (0.0, 1.0))]
    near, far = render(scene, takes, lamps, look_at((0, 0, 3), (0, 0, 0), rows=9, columns=9, field_of_view=0.003))
    assert near.linear[4, 4, 0] == pytest.approx(4, rel=1e-4)
    assert far.linear[4, 4, 0] == pytest.approx(0.25, rel=1e-4)


def test_takes_share_everything_and_add_up():
    scene = ClothScene.of([wavy(), paper(5, 2, 2, 0.5)])
    lamps = [Lamp(direction=(-1, 1, 1), radius=0.05), Lamp(direction=(1, 0.5, 0.3), colour=(0.5, 0.6, 0.7))]
    around = Surroundings.of(scene, AmbientLight(rays=8))
    materials = (WARD, Matte())
    weights = [((1.0, 1.0), 1.0), ((1.0, 0.0), 0.0), ((0.0, 1.0), 0.0), ((0.0, 0.0), 1.0)]
    takes = [RenderVariant(materials, lamp, sky) for lamp, sky in weights]
    whole, left, right, sky = render(scene, takes, lamps, camera(), surroundings=around, supersampling=2)
    assert np.allclose(whole.linear, left.linear + right.linear + sky.linear, atol=1e-5)
    alone = render(scene, takes[1:2], lamps, camera(), surroundings=around, supersampling=2)[0]
    assert np.array_equal(alone.linear, left.linear)


def test_shared_values_differ_little_from_each_sample_its_own():
    scene = ClothScene.of([wavy()])
    lamp = Lamp(direction=(-0.9, 0.4, 0.6), radius=0.1)
    arguments = (scene, [RenderVariant((WARD,), (1.0,))], [lamp], camera(60))
    own = render(*arguments, supersampling=3, within=0.0)[0]
    shared = render(*arguments, supersampling=3)[0]
    assert shared.evaluated < 0.4 * own.evaluated
    assert own.evaluated <= own.samples
    assert np.sqrt(np.mean((own.linear - shared.linear) ** 2)) < 0.012 * np.sqrt(np.mean(own.linear**2))
    assert np.abs(own.linear - shared.linear).max() < 0.05 * own.linear.max()


def test_dyes_share_their_gloss_and_are_what_the_dichromatic_model_says():
    colours = {"red": (0.5, 0.05, 0.1), "blue": (0.05, 0.1, 0.5)}
    made = apply_dyes(WARD, colours)
    assert made["red"].gloss is made["blue"].gloss
    rng = np.random.default_rng(4)
    incident, outgoing = rng.normal(size=(2, 400, 3)) * [1, 1, 0.5] + [0, 0, 1]
    incident, outgoing = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (incident, outgoing))
    found = together([made["red"], WARD, made["blue"]], incident, outgoing)
    assert np.allclose(found[0], made["red"].evaluate(incident, outgoing))
    assert np.allclose(found[1], WARD.evaluate(incident, outgoing))
    for name, values in (("red", found[0]), ("blue", found[2])):
        exact = exact_dye(gloss_of(WARD), colours[name]).evaluate(incident, outgoing)
        assert np.abs(values - exact).max() < 0.02 * exact.max()
    # Of even light a dyed cloth returns a + albedo (1 - a).
    apart = np.abs(share_of(made["red"]) - shares(made["red"])[0])
    assert apart[:-2].max() < 0.01
    assert apart.max() < 0.06  # at grazing views the sum over the light is coarse
    assert apply_dyes(WARD, {}) == {}


def test_bands_do_not_show(monkeypatch):
    scene = ClothScene.of([wavy()])
    lamp = Lamp(direction=(-0.9, 0.4, 0.6), radius=0.1)
    arguments = (scene, [RenderVariant((WARD,), (1.0,))], [lamp], camera(30))
    whole = render(*arguments, supersampling=3)[0]
    assert render(*arguments, supersampling=3)[0].linear.tobytes() == whole.linear.tobytes()
    monkeypatch.setattr("nishiki.render.cloth.studio.BAND_SAMPLES", 1000)
    monkeypatch.setattr("nishiki.render.cloth.studio.AT_ONCE", 77)
    banded = render(*arguments, supersampling=3)[0]
    assert np.array_equal(whole.linear, banded.linear)
    assert whole.samples == banded.samples


def test_the_back_is_cloth_whose_warp_runs_the_same_way():
    front, back = swatch(1, 1), swatch(1, 1)
    back = Surface(Mesh(back.mesh.vertices, back.mesh.triangles[:, ::-1], -back.mesh.normals), back.weft)
    lamp = Lamp(direction=(0.3, 0.5, 0.9), radius=0)
    views = camera(8, (0.5, -0.4, 3.0))
    take = [RenderVariant((WARD,), (1.0,))]
    shown = [render(ClothScene.of([surface]), take, [lamp], views)[0].linear for surface in (front, back)]
    # Ward is the same for (x, y) and (-x, y): the reverse of this cloth looks like its face.
    assert np.allclose(*shown, atol=1e-6)
    turned = swatch(1, 1, turn=np.pi / 2)
    assert not np.allclose(render(ClothScene.of([turned]), take, [lamp], views)[0].linear, shown[0], rtol=0.05)


def test_soft_shadows_are_the_visible_part_of_the_lamp():
    """Behind a half plane the light falls as the lamp goes behind it."""
    scene = ClothScene.of([swatch(3, 3), Surface(swatch(3, 3, centre=(1.5, 0, 1.0)).mesh, swatch(3, 3).weft, 1)])
    radius = 0.2
    takes = [RenderVariant((Matte((1.0,)), Matte((0.0,))), (1.0,))]
    view = look_at((0, -9, 0.9), (0, 0, 0), rows=40, columns=40, field_of_view=0.1, up=(0, 0, 1))
    picture = render(scene, takes, [Lamp(direction=(0, 0, 1), radius=radius)], view, supersampling=6)[0]
    x = (np.arange(40) - 19.5) / 40 * 2 * np.hypot(9, 0.9) * np.tan(0.05)
    edge = np.clip(-x / np.tan(radius), -1, 1)
    expected = 0.5 + (edge * np.sqrt(1 - edge**2) + np.arcsin(edge)) / np.pi
    seen = picture.linear[18:22, :, 0].mean(axis=0)
    assert np.abs(seen - expected).max() < 0.06
    assert seen[0] == 1
    assert seen[-1] == 0


def test_the_disc_is_covered_evenly():
    points = disc_point(np.arange(300)[:, None], np.arange(16), 16).reshape(-1, 2)
    assert np.all(np.hypot(*points.T) <= 1)
    assert np.abs(points.mean(axis=0)).max() < 0.02
    assert np.mean(np.hypot(*points.T) ** 2) == pytest.approx(0.5, abs=0.01)


def test_even_light_on_an_open_matte_surface():
    scene = ClothScene.of([swatch(1, 1)])
    light = AmbientLight((0.4, 0.5, 0.6), (0.4, 0.5, 0.6), rays=16)
    around = Surroundings.of(scene, light)
    assert np.all(around.open == 1)
    picture = render(scene, [RenderVariant((Matte((0.5,)),), ())], [], camera(8, (0, 0, 1)), surroundings=around)[0]
    inside = picture.coverage == 1
    assert np.allclose(picture.linear[inside], np.array([0.2, 0.25, 0.3]), rtol=0.02)


def test_openness_of_a_tube_and_of_a_corner():
    tube = ClothScene.of([cylinder(0.05, 5)])
    free, _ = openness(tube, 64, 50.0)
    middle = np.abs(tube.mesh.vertices[:, 1]) < 1
    assert np.all(free[middle, 0] > 0.99)  # outside
    assert np.all(free[middle, 1] < 0.01)  # inside
    floor, wall = swatch(8, 8), swatch(8, 8)
    upright = Mesh(wall.mesh.vertices[:, [2, 1, 0]], wall.mesh.triangles, wall.mesh.normals[:, [2, 1, 0]])
    corner = ClothScene.of([floor, Surface(upright, np.tile([0.0, 0, 1], (81, 1)))])
    free, _ = openness(corner, 256, 1.0)
    near = np.argmin(np.linalg.norm(corner.mesh.vertices[:81] - [1.0, 0, 0], axis=1))
    far = np.argmin(np.linalg.norm(corner.mesh.vertices[:81] - [3.0, 0, 0], axis=1))
    assert free[far, 0] == 1
    assert free[near, 0] > 0.95
    close = openness(corner, 256, 50.0)[0]
    assert 0.5 < close[near, 0] < 0.9


def test_shares_of_even_light():
    assert np.allclose(shares(Matte((0.3,)))[0], 0.3, rtol=1e-6)
    (table,) = shares(WARD)
    assert table.shape[2] == 3
    assert np.all((table >= 0) & (table <= 1))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(50, 3)) * [1, 1, 0] + [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = lookup(table, directions)
    lights = rng.normal(size=(40_000, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    lights[:, 2] = np.abs(lights[:, 2])
    for k in range(0, 50, 10):
        if directions[k, 2] > 0.3:
            values = WARD.evaluate(lights, directions[k]) * lights[:, 2:] * 2 * np.pi
            assert np.allclose(found[k], values.mean(axis=0), rtol=0.08, atol=0.01)


def test_a_camera_that_holds_everything():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(200, 3)) * [1, 3, 0.5] + [5, 6, 7]
    for elevation in (-0.2, 0.4, 1.4):
        view = frame_camera(points, elevation=elevation, azimuth=0.7, rows=300, columns=400, distance=1.5, margin=1.1)
        pixels, depth = view.project(points)
        assert np.all(depth > 0)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        assert np.all(low > 0)
        assert np.all(high < [399, 299])
        assert np.allclose((low + high) / 2, [199.5, 149.5], atol=3)
        assert max((high - low) / [400, 300]) == pytest.approx(1 / 1.1, abs=0.02)


def test_gloss_without_the_light_from_within():
    gloss = gloss_of(WARD)
    assert np.all(gloss.diffuse == 0)
    assert gloss.alpha_x == WARD.alpha_x
    matte = Matte((0.3,))
    assert gloss_of(matte) is matte
    assert linear_colour("#ffffff") == (1.0, 1.0, 1.0)
    assert linear_colour("#bc0000")[0] == pytest.approx(0.5029, abs=1e-4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Lamp(), "lamp"),
        (lambda: Lamp(direction=(0, 0, 0)), "lamp"),
        (lambda: Lamp(direction=(0, 0, 1), colour=(-1, 0, 0)), "-1"),
        (lambda: Lamp(direction=(0, 0, 1), radius=2.0), "90"),
        (lambda: ClothScene.of([]), "triangle"),
        (lambda: look_at((0, 1, 0), (0, 0, 0), rows=2, columns=2, field_of_view=1), "line"),
        (lambda: render(ClothScene.of([swatch(1, 1)]), [RenderVariant((), ())], [], camera()), "1"),
    ],
)
def test_what_is_wrong_is_named(make, words):
    with pytest.raises(UserError, match=words):
        make()
