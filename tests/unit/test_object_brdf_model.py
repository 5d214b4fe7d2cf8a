"""The model at points: against the equations in float64, at its limits; lamps; what stands for unknown lighting."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.environment import fit_environment, fit_highlight, harmonics, hemisphere
from nishiki.brdf.texels.model import DISTANT, ENVIRONMENT, POINT, CaptureLamps, ViewLamp, factors, predict
from nishiki.brdf.texels.neighbours import Lattice, Neighbourhood, fill, spread
from nishiki.brdf.texels.texel_fit import WIDTHS, LobeProfile, TileSamples, gather, lambert, lobes_of
from nishiki.colour.colour import encoding_slope
from nishiki.errors import UserError
from nishiki.geometry.camera import Camera

EYE = np.eye(3, dtype=np.float32)
DARK = np.zeros((9, 1), np.float32)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def lamp_at(*place, form=POINT, reference=0.0):
    return ViewLamp(form, np.array(place, np.float32), EYE, DARK, reference)


def slow(kd, ks, sigma, positions, normals, centre, place):
    """Miyazaki et al. (2007), eq. 6, and eq. 8 with the lobe of Trowbridge and Reitz, in float64."""
    to_lamp, to_camera = unit(place - positions), unit(centre - positions)
    cos_i, cos_r = (np.sum(normals * v, axis=-1) for v in (to_lamp, to_camera))
    half = unit(to_lamp + to_camera)
    alpha = 2 * np.arcsin(np.clip(np.linalg.norm(normals - half, axis=-1) / 2, 0, 1))
    lobe = (1 + alpha**2 / (4 * sigma**2)) ** -2 / np.maximum(cos_r, GRAZING)
    lobe = np.where((cos_i > 0) & (cos_r > 0), lobe, 0)
    return kd * np.maximum(cos_i, 0)[..., None], ks * lobe[..., None]


def points(n=2000, seed=0):
    rng = np.random.default_rng(seed)
    normals = unit(rng.normal(size=(n, 3)))
    kd, ks = rng.uniform(0, 1, (2, n, 3))
    return kd, ks, rng.uniform(0.05, 1, n), 40 * normals + rng.normal(size=(n, 3)), normals


def test_equals_the_equations():
    values = points()
    centre, place = np.array([30.0, 50, 500]), np.array([-80.0, 200, 450])
    expected = slow(*values, centre, place)
    for found, wanted in zip(predict(*values, centre, lamp_at(*place)), expected, strict=True):
        assert found.dtype == np.float32
        assert found.shape == (2000, 3)
        np.testing.assert_allclose(found, wanted, atol=4e-6)
    assert expected[1].max() > 1


def test_a_distant_lamp_and_any_shape():
    kd, ks, sigma, positions, normals = (a.reshape(40, 50, *a.shape[1:]) for a in points())
    direction = unit(np.array([0.3, 0.4, 0.8]))
    centre = np.array([0.0, 0, 500])
    found = predict(kd, ks, sigma, positions, normals, centre, lamp_at(*direction, form=DISTANT))
    wanted = slow(kd, ks, sigma, positions, normals, centre, positions + direction)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=4e-6)


def test_known_values():
    flat = dict(positions=np.zeros((1, 3)), normals=np.array([[0.0, 0, 1]]), camera_centre=np.array([0.0, 0, 9]))
    half, fifth = np.full((1, 3), 0.5), np.full((1, 3), 0.2)
    diffuse, specular = predict(half, fifth, np.array([0.1]), **flat, lamp=lamp_at(0, 0, 9))
    np.testing.assert_allclose(diffuse, 0.5, rtol=1e-6)
    np.testing.assert_allclose(specular, 0.2, rtol=1e-6)
    tilted = lamp_at(np.sin(0.6), 0, np.cos(0.6), form=DISTANT)
    diffuse, specular = predict(half, fifth, np.array([0.3]), **flat, lamp=tilted)
    np.testing.assert_allclose(diffuse, 0.5 * np.cos(0.6), rtol=1e-6)
    np.testing.assert_allclose(specular, 0.2 * 0.8**2, rtol=1e-5)
    near = lamp_at(0, 0, 4.5, reference=9.0)
    np.testing.assert_allclose(predict(half, fifth, np.array([0.1]), **flat, lamp=near)[0], 2.0, rtol=1e-6)


@pytest.mark.parametrize(("sigma", "at_mirror", "beside"), [(0.0, 1, 0), (1e-30, 1, 0), (np.inf, 1, 1), (1e30, 1, 1)])
def test_limits_of_the_width(sigma, at_mirror, beside):
    normals = np.array([[0.0, 0, 1], [np.sin(0.2), 0, np.cos(0.2)]])
    ones = np.ones((2, 1))
    _, specular = predict(ones, ones, np.full(2, sigma), np.zeros((2, 3)), normals, np.array([0.0, 0, 9]),
                          lamp_at(0, 0, 9))  # fmt: skip
    np.testing.assert_allclose(specular[:, 0], [at_mirror, beside / np.cos(0.2)], rtol=1e-5)


def test_grazing_and_behind():
    angle = np.radians([80, 89.9, 90.1, 180])
    normals = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    ones = np.ones((4, 1))
    light = lamp_at(1, 0, 0, form=DISTANT)
    diffuse, specular = predict(ones, ones, np.full(4, np.inf), np.zeros((4, 3)), normals, np.array([0.0, 0, 9]), light)
    np.testing.assert_allclose(diffuse[:, 0], [np.sin(a) if np.sin(a) > 1e-9 else 0 for a in angle], atol=1e-6)
    np.testing.assert_allclose(specular[:, 0], [1 / np.cos(angle[0]), 1 / GRAZING, 0, 0], rtol=1e-4)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=13, max_size=13),
    st.sampled_from([POINT, DISTANT, ENVIRONMENT]),
)
def test_never_a_nan(numbers, form):
    v = np.array(numbers, np.float32)
    lamp = ViewLamp(form, np.array([0, 1, 0], np.float32), EYE, np.ones((9, 1), np.float32), 0.0)
    with np.errstate(all="ignore"):
        found = predict(v[None, :3], v[None, 3:6], v[6:7], v[None, 7:10], v[None, 10:13], np.zeros(3), lamp)
    assert all(np.isfinite(part).all() for part in found)


def test_environment_is_a_quadratic_form_of_the_normal():
    kd, ks, sigma, positions, normals = points()
    rng = np.random.default_rng(1)
    coefficients = rng.normal(size=(9, 3)).astype(np.float32)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32)
    lamp = ViewLamp(ENVIRONMENT, np.zeros(3, np.float32), rotation, coefficients)
    diffuse, specular = predict(kd, ks, sigma, positions, normals, np.array([0.0, 0, 500]), lamp)
    wanted = kd * np.maximum(harmonics(normals @ rotation.T.astype(float)) @ coefficients, 0)
    np.testing.assert_allclose(diffuse, wanted, atol=1e-5)
    assert np.all(specular == 0)


def test_factors_are_what_predict_multiplies():
    kd, ks, sigma, positions, normals = points()
    centre, lamp = np.array([0.0, 0, 500]), lamp_at(100, 90, 500, reference=450.0)
    irradiance, angles = factors(positions, normals, centre, lamp, 3)
    diffuse, specular = predict(kd, ks, sigma, positions, normals, centre, lamp)
    np.testing.assert_allclose(kd * irradiance, diffuse, rtol=1e-5, atol=1e-7)
    lobe = angles[:, 0] / np.maximum(angles[:, 1], GRAZING) * (1 + angles[:, 2] / (4 * sigma**2)) ** -2
    np.testing.assert_allclose(ks * lobe[:, None], specular, rtol=1e-4, atol=1e-6)


def camera():
    back = unit(np.array([0.5, 0.2, 1.0]))
    right = unit(np.cross([0.0, 1, 0], back))
    rotation = np.stack([right, -np.cross(back, right), -back])
    return Camera("a", np.eye(3), rotation, -rotation @ (300 * back), 10, 10)


def test_lamps_turn_with_the_camera():
    seen = camera()
    beside = CaptureLamps.from_capture({"kind": "camera", "vectors": None}, lights=2, unit="mm").lamp(seen, 1)
    np.testing.assert_allclose(beside.vector, seen.centre, rtol=1e-6)
    ahead = CaptureLamps.from_capture({"kind": "direction", "vectors": [[0, 0, 2]]}, lights=1, unit="mm").lamp(seen)
    np.testing.assert_allclose(ahead.vector, unit(seen.centre), atol=1e-6)
    above = CaptureLamps.from_capture({"kind": "position_mm", "vectors": [[0, 50, 0]]}, lights=1, unit="cm").lamp(seen)
    up = above.vector - seen.centre
    assert np.linalg.norm(up) == pytest.approx(5, rel=1e-4)
    assert up[1] > 4  # y up in the picture is the world's y here
    np.testing.assert_allclose(up @ seen.centre, 0, atol=1e-2)


def test_lighting_round_trip_and_errors():
    e = tuple((float(k),) for k in range(9))
    lighting = CaptureLamps("environment", ((0.1, 0.2, 0.3),), (e,), 2.5)
    assert CaptureLamps.from_dict(json.loads(json.dumps(lighting.as_dict()))) == lighting
    for kind, vectors, unit_name, words in (
        ("position_mm", [[1, 2, 3]], "arbitrary", "unit"),
        ("direction", [[0, 0, 0]], "mm", "light"),
        ("direction", [[0, 0, 1], [0, 1, 0]], "mm", "1"),
    ):
        with pytest.raises(UserError, match=words):
            CaptureLamps.from_capture({"kind": kind, "vectors": vectors}, lights=1, unit=unit_name)
    with pytest.raises(UserError, match="unknown"):
        CaptureLamps("unknown").lamp(camera())
    with pytest.raises(UserError, match="light 1"):
        CaptureLamps("camera").lamp(camera(), 1)
    with refused(UserError, "candle"):
        CaptureLamps("candle")


def turned_texels(n=1500, views=24, seed=3):
    """Normals of texels in the lamp frame of each view of a turn, and what each view sees of them."""
    rng = np.random.default_rng(seed)
    normals = unit(rng.normal(size=(n, 3)))
    turns = 2 * np.pi * np.arange(views) / views
    about_y = np.array([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in turns])
    seen = np.einsum("oij,nj->noi", about_y, normals)
    return rng, seen, np.maximum(seen[..., 2], 0) * (seen[..., 2] > 0.1)


def test_unknown_lighting_is_found_through_shadows():
    rng, normals, weights = turned_texels()
    lamps = 0.2 + 0.8 * np.maximum(normals @ unit(np.array([0.5, 0.6, 0.6])), 0)
    albedo = rng.uniform(0.1, 0.9, (len(normals), 3))
    clean = albedo[:, None] * lamps[..., None]
    shadow = rng.random(weights.shape) < 0.1
    values = np.where(shadow[..., None], 0.4, 1) * clean + 0.005 * rng.normal(size=clean.shape)
    fit = fit_environment(values, normals, weights)
    lit = harmonics(normals) @ np.array(fit.coefficients)
    usable = weights * ~shadow
    below = np.sum(usable * lit**2, axis=1)
    good = below > 0
    kd = np.einsum("to,to,toc->tc", usable, lit, clean)[good] / below[good, None]
    left = np.average((clean[good] - kd[:, None] * lit[good, :, None]) ** 2, weights=_three(usable[good]))
    flat = np.einsum("to,toc->tc", usable, clean)[good] / usable.sum(axis=1)[good, None]
    constant = np.average((clean[good] - flat[:, None]) ** 2, weights=_three(usable[good]))
    assert np.sqrt(left) < 0.02
    assert left < constant / 40
    assert np.quantile(lit[weights > 0], 0.01) > -0.02
    assert 0.9 < fit.explained <= 1


def _three(weights):
    return np.repeat(weights[..., None], 3, axis=-1)


def test_too_few_texels_mean_a_lamp_at_the_camera():
    _, normals, weights = turned_texels(n=5)
    fit = fit_environment(np.ones((*weights.shape, 3)), normals, weights)
    assert fit.coefficients == (0, 0, 0, 1, 0, 0, 0, 0, 0)


@pytest.mark.parametrize("strength", [0.0, 0.3])
def test_a_highlight_is_accepted_only_where_there_is_one(strength):
    rng, normals, weights = turned_texels(n=800)
    to_camera = np.broadcast_to(np.array([0.0, 0, 1]), normals.shape)
    towards = hemisphere(120)[40]
    half = unit(to_camera + towards)
    alpha = np.arccos(np.clip(np.sum(normals * half, axis=-1), -1, 1))
    left = strength * np.exp(-(alpha**2) / (2 * 0.2**2)) + 0.05 * rng.normal(size=weights.shape)
    found = fit_highlight(left, normals.astype(np.float32), to_camera.astype(np.float32), weights)
    if strength:
        assert np.dot(found.direction, towards) > 0.98
        assert found.gain > 0.02
    else:
        assert found.direction == (0, 0, 0)


def test_fill_keeps_what_is_known_and_is_smooth():
    rng = np.random.default_rng(0)
    row, column = np.mgrid[0:37, 0:50]
    values = np.stack([row + column, 3.0 * row - column], axis=-1).astype(np.float32)
    known = rng.random((37, 50)) < 0.3
    filled = fill(np.where(known[..., None], values, 1e9), known)
    np.testing.assert_array_equal(filled[known], values[known])
    assert np.abs(filled - values)[~known].mean() < 2
    assert np.all(fill(values, np.zeros((37, 50), bool)) == 0)
    np.testing.assert_array_equal(fill(values, np.ones((37, 50), bool)), values)
    one = np.zeros((37, 50), bool)
    one[5, 7] = True
    np.testing.assert_allclose(fill(values, one), np.broadcast_to(values[5, 7], values.shape), rtol=1e-6)


def test_field_of_the_neighbours():
    rng = np.random.default_rng(0)
    normals = unit(rng.normal(size=(20000, 3)))
    positions = 50 * normals
    truth = np.stack([0.02 * positions[:, 0], np.sin(0.05 * positions[:, 1])], axis=1)
    certain = rng.random(20000) < 0.5
    certain[positions[:, 2] > 20] = False
    values = truth + 0.1 * rng.normal(size=truth.shape)
    values[~certain] = 1e6
    precision = np.where(certain, 100.0, 0)
    halves = [spread(positions[h], values[h], precision[h], Lattice(4.0)) for h in (slice(0, 9000), slice(9000, None))]
    field = Neighbourhood(Lattice(4.0), 2, halves).field(25.0, np.zeros(2))
    found = field.at(positions)
    assert np.sqrt(np.mean((found - truth)[positions[:, 2] <= 20] ** 2)) < 0.06
    assert np.abs(found).max() < 1.6
    assert np.abs(found - truth)[positions[:, 2] > 20].mean() < 0.5
    part = spread(positions, values, precision, Lattice(4.0))
    whole = Neighbourhood(Lattice(4.0), 2, [part]).field(25.0, np.zeros(2))
    np.testing.assert_allclose(whole.at(positions), found, rtol=1e-5, atol=1e-6)


def test_a_field_of_nothing_is_the_default():
    positions = np.random.default_rng(0).normal(size=(50, 3))
    part = spread(positions, np.full((50, 1), np.nan), np.zeros(50), Lattice(1.0))
    np.testing.assert_allclose(Neighbourhood(Lattice(1.0), 1, [part]).field(2.0, np.array([0.7])).at(positions), 0.7)
    np.testing.assert_allclose(Neighbourhood(Lattice(1.0), 1, []).field(2.0, np.array([0.7])).at(positions), 0.7)


def test_observed_gathers_the_visible_only():
    rng = np.random.default_rng(0)
    values = rng.uniform(0.1, 0.9, (5, 6, 7, 3)).astype(np.float32)
    visible = rng.random((5, 6, 7)) < 0.4
    values[3, 2, 2] = np.nan
    visible[3, 2, 2] = True
    positions = rng.normal(size=(6, 7, 3))
    normals = np.broadcast_to([0.0, 0, 1], positions.shape)
    centres = np.array([[0.0, 0, 100], [30, 0, 100], [0, 40, 90], [-20, 0, 100], [0, 0, 80]])
    lamps = [lamp_at(*centre) for centre in centres]
    data = gather(values, visible, positions, normals, centres, lamps, encoding="srgb")
    np.testing.assert_array_equal(np.sort(data.texel), np.flatnonzero(visible.reshape(5, -1).any(axis=0)))
    for p, texel in enumerate(data.texel):
        views = data.view[p][data.view[p] >= 0]
        np.testing.assert_array_equal(views, np.flatnonzero(visible.reshape(5, -1)[:, texel]))
        for slot, o in enumerate(views):
            value = values[o].reshape(-1, 3)[texel]
            np.testing.assert_array_equal(data.values[p, slot], np.nan_to_num(value))
            cosine = unit(centres[o] - positions.reshape(-1, 3)[texel])[2]
            if np.isfinite(value).all():
                wanted = cosine * encoding_slope(value.mean(), "srgb") ** 2
                assert data.weights[p, slot] == pytest.approx(wanted, rel=1e-4)
                assert data.diffuse[p, slot] == pytest.approx(cosine, rel=1e-4)
                assert data.attenuation[p, slot] == pytest.approx(1 / cosine, rel=1e-4)
            else:
                assert data.weights[p, slot] == 0
        assert np.all(data.weights[p, len(views) :] == 0)


def test_slope_of_the_srgb_curve():
    from nishiki.colour.colour import encode

    x = np.array([0.0, 0.001, 0.01, 0.2, 1.0, 1.4])
    differences = (encode(x + 1e-7, "srgb") - encode(x - 1e-7, "srgb")) / 2e-7
    np.testing.assert_allclose(encoding_slope(x.astype(np.float32), "srgb"), differences, rtol=1e-3)


def texels(rng, points=40, slots=16, sigma=0.3, noise=0.02):
    """Texels under one lobe, with K_d and noise of their own and three unused slots."""
    alpha = rng.uniform(0, 1, (points, slots)).astype(np.float32)
    diffuse, weights = (rng.uniform(0.3, 1, (points, slots)).astype(np.float32) for _ in range(2))
    weights[:, -3:] = 0
    lobe = (1 + alpha.astype(float) ** 2 / (4 * sigma**2)) ** -2
    kd, ks = rng.uniform(0.1, 0.8, (points, 1, 2)), np.array([0.3, 0.2])
    values = kd * diffuse[..., None] + ks * lobe[..., None] + rng.normal(0, noise, (points, slots, 2))
    rest = (diffuse, np.ones_like(alpha), alpha, weights, np.zeros((points, slots), int))
    return TileSamples(np.arange(points), values.astype(np.float32), *rest), kd[:, 0], ks


def test_profiles_add_up_to_one_least_squares_problem():
    """The gain of a shared lobe is what dense least squares in all K_d and one K_s take off the squared error."""
    data, _, _ = texels(np.random.default_rng(3))
    profile, (points, slots) = LobeProfile.of(data), data.alpha.shape
    power, match = profile.power.sum(axis=0), profile.match.sum(axis=0)
    root = np.sqrt(data.weights.astype(float)).ravel()
    own = np.zeros((points, slots, points))
    own[np.arange(points), :, np.arange(points)] = data.diffuse
    for place in (6, 12, 18):
        lobe = (1 + (data.alpha.astype(float) / (2 * WIDTHS[place])) ** 2).ravel() ** -2
        columns = np.column_stack([lobe, own.reshape(-1, points)]) * root[:, None]
        for channel in range(2):
            values = data.values[..., channel].astype(float).ravel() * root
            found, left = np.linalg.lstsq(columns, values)[:2]
            alone = np.linalg.lstsq(columns[:, 1:], values)[1]
            assert match[place, channel] / power[place, 0] == pytest.approx(found[0], rel=1e-3)
            assert match[place, channel] ** 2 / power[place, 0] == pytest.approx((alone - left)[0], rel=3e-3)


@pytest.mark.parametrize("sigma", [0.05, 0.13, 0.3])
def test_a_shared_lobe_is_found_whatever_the_texels_colours(sigma):
    data, kd, ks = texels(np.random.default_rng(4), points=400, sigma=sigma, noise=1e-4)
    columns = LobeProfile.of(data).columns.sum(axis=0, keepdims=True)
    width, strength = LobeProfile.from_columns(columns, 2).solve()
    assert width[0] == pytest.approx(sigma, rel=3e-3)
    np.testing.assert_allclose(strength[0], ks, rtol=5e-3)
    gloss = lobes_of(data, np.repeat(width, 400))[..., None] * strength
    np.testing.assert_allclose(lambert(data, gloss), kd, atol=5e-3)


def test_lobes_seen_from_their_tails_alone_are_not_extrapolated():
    data, _, _ = texels(np.random.default_rng(5))
    far = replace(data, alpha=data.alpha + 3)
    assert LobeProfile.of(far).solve()[1].max() < 8  # hundreds without TAIL
