"""Normals of a mesh by the shading of an object that turns: against true ones, and against slow derivatives."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from unit.test_object_brdf import DISTANCE, ring

from nishiki.brdf.texels.model import CaptureLamps
from nishiki.brdf.texels.shading import CURVE, ShadedTexels, _compute_pull, fit_shading, refine_normals
from nishiki.brdf.texels.texel_fit import Sample
from nishiki.geometry.mesh import Mesh, compute_tangents
from nishiki.model_selection.decision import decide_normals

PLACE = (0.3 * DISTANCE / 4, 0.35 * DISTANCE / 4, 0.0)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def photographed(*, off=3.0, noise=0.01, count=6000, gloss=True, place=PLACE):
    """A ball of few triangles whose normals are off by `off` degrees, seen as Oren-Nayar with GGX gloss and shadows."""
    rng, ball = np.random.default_rng(7), trimesh.creation.icosphere(subdivisions=3)
    mesh = Mesh.of(np.array(ball.vertices), np.array(ball.faces, np.int32))
    waves = np.radians(off) * np.sin(3 * mesh.vertices[:, [1, 2, 0]] + [0, 1, 2])
    wrong = Mesh(mesh.vertices, mesh.triangles, unit(mesh.normals + waves).astype(np.float32))
    triangles = rng.integers(0, len(mesh.triangles), count)
    shares = rng.dirichlet((1, 1, 1), count)
    places = np.einsum("nk,nki->ni", shares, mesh.vertices[mesh.triangles[triangles]])
    true, cameras, albedo = unit(places), ring(), rng.uniform(0.2, 0.8, (count, 3))
    lamps = [CaptureLamps("position", (place,)).lamp(camera) for camera in cameras]
    values, visible = np.zeros((count, len(cameras), 3), np.float32), np.zeros((count, len(cameras)), bool)
    for view, (camera, lamp) in enumerate(zip(cameras, lamps, strict=True)):
        towards, facing = unit(lamp.vector - places), unit(camera.centre - places)
        cos_i, cos_r = (np.clip((true * each).sum(axis=1), 0, 1) for each in (towards, facing))
        steeper = np.sqrt((1 - cos_i**2) * (1 - cos_r**2)) / np.maximum(np.maximum(cos_i, cos_r), 1e-3)
        plain = albedo * (cos_i * (0.93 + 0.07 * steeper))[:, None]
        cosine = (true * unit(towards + facing)).sum(axis=1)
        lobe = 0.02 / ((cosine**2 * (0.02 - 1) + 1) ** 2 * 4 * np.maximum(cos_r, 0.1))
        values[:, view] = plain + gloss * 0.15 * lobe[:, None] * (cos_i > 0)[:, None]
        visible[:, view] = cos_r > 0.15
    values[rng.random(visible.shape) < 0.03] *= 0.1
    values += (noise * rng.normal(size=values.shape)).astype(np.float32)
    mixed = unit(np.einsum("nk,nki->ni", shares, wrong.normals[mesh.triangles[triangles]]))
    sample = Sample(places.astype(np.float32), mixed.astype(np.float32), values, visible, np.arange(count))
    return wrong, sample, triangles, np.array([camera.centre for camera in cameras]), lamps


def errors(mesh):
    return np.degrees(np.arccos(np.clip((mesh.normals * unit(mesh.vertices)).sum(axis=1), -1, 1)))


@pytest.mark.parametrize("gloss", [True, False])
def test_normals_are_found_by_shading(gloss):
    wrong, *seen = photographed(gloss=gloss)
    found, hidden = refine_normals(wrong, *seen)
    assert hidden[1] < 0.8 * hidden[0]
    assert decide_normals(hidden)[0]
    assert np.median(errors(wrong)) > 2
    assert np.median(errors(found)) < 0.6 * np.median(errors(wrong))
    np.testing.assert_array_equal(found.vertices, wrong.vertices)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_brightness_and_unit_of_length_do_not_matter(factor):
    wrong, sample, triangles, centres, lamps = photographed()
    found, hidden = refine_normals(wrong, sample, triangles, centres, lamps)
    bright = replace(sample, values=np.float32(factor) * sample.values)
    far = replace(bright, positions=np.float32(factor) * bright.positions)
    large = Mesh(factor * wrong.vertices, wrong.triangles, wrong.normals)
    lamps = [replace(lamp, vector=np.float32(factor) * lamp.vector) for lamp in lamps]
    again, share = refine_normals(large, far, triangles, factor * centres, lamps)
    assert np.median(np.linalg.norm(again.normals - found.normals, axis=1)) < 0.005
    assert share == pytest.approx(hidden, rel=0.01)


def test_a_view_is_hidden_under_all_its_lights():
    """Two lights, of which the second repeats the first: hidden photographs would give themselves away."""
    wrong, sample, triangles, centres, lamps = photographed()
    one = refine_normals(wrong, sample, triangles, centres, lamps)[1]
    values, visible = (np.concatenate([each, each], axis=1) for each in (sample.values, sample.visible))
    both = replace(sample, values=values, visible=visible)
    two = refine_normals(wrong, both, triangles, np.concatenate([centres, centres]), lamps + lamps)[1]
    assert two == pytest.approx(one, rel=0.1)


def test_true_normals_stay_near():
    wrong, *seen = photographed(off=0.0)
    found, hidden = refine_normals(wrong, *seen)
    assert np.quantile(errors(found), 0.9) < 3
    assert not decide_normals(hidden)[0]


def test_normals_stay_without_a_lamp_or_texels():
    wrong, sample, triangles, centres, lamps = photographed(count=400)
    around = CaptureLamps("environment", ((0.0, 0.0, 0.0),), (((1.0,),) * 9,))
    of_light = [around.lamp(camera) for camera in ring()]
    assert refine_normals(wrong, sample, triangles, centres, of_light) == (wrong, None)
    few = Sample(*(values[:5] for values in vars(sample).values()))
    assert refine_normals(wrong, few, triangles[:5], centres, lamps)[0] is wrong


def test_texels_ask_for_the_turn_that_lowers_their_deviations():
    """The slow reference: each normal turned by hand, K_d solved anew."""
    _, sample, _, centres, lamps = photographed(count=300, noise=0.0)
    seen = ShadedTexels.of(sample, centres, lamps)
    normals = unit(sample.normals.astype(float))
    fit = fit_shading(seen, normals)
    information, pull = _compute_pull(seen, normals, fit.shading)

    def squares(turned):
        cosine, lit, lobes, _, _ = seen.compute_angles(turned)
        lit = lit * np.interp(cosine, CURVE, fit.shading.curve)
        left, weights = seen.values - lobes @ fit.shading.gloss, fit.weights
        total = np.zeros(len(normals))
        for texel in range(len(normals)):
            own = seen.texel == texel
            a, y, w = (each[own] / seen.scale[own] for each in (lit, left, seen.scale * weights))
            w = w * max(fit.spread, 0.04) ** -2
            total[texel] = np.sum(w * (y - a * (w @ (a * y) / max(w @ a**2, 1e-30))) ** 2)
        return total

    step, across = 1e-4, compute_tangents(normals)
    for axis in range(2):
        ahead, behind = (squares(unit(normals + sign * step * across[:, axis])) for sign in (1, -1))
        slope = -(ahead - behind) / (4 * step)
        steady = np.abs(slope - pull[:, axis]) < 0.02 * np.abs(slope) + 0.02 * np.sqrt(information[:, axis, axis])
        assert np.mean(steady) > 0.9  # elsewhere an observation enters or leaves the light
    assert np.linalg.eigvalsh(information).min() > -1e-9 * information.max()
