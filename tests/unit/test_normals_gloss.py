"""The joint fit of normals, reflectance and gloss: against its slow form, known surfaces, extremes, tiles."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from scipy.linalg import helmert

from nishiki.brdf.gloss_profile import (
    LADDER,
    GlossProfile,
    SpecularHistogram,
    body_shading,
    fit_gloss,
    light_table,
    specular_samples,
)
from nishiki.brdf.torrance_sparrow import MIRROR, attenuation, fresnel, half_vector_geometry
from nishiki.errors import UserError
from nishiki.photometric.body import diffuse_reflectance
from nishiki.photometric.flags import NormalFlag
from nishiki.photometric.gloss import GlossTile, JointScene, JointSettings, refine_normals
from nishiki.photometric.gloss_kernel import NODES, NODES_PER_UNIT, Pixel, predict
from nishiki.photometric.gloss_scene import find_finishes, fit_scene_gloss
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.solve import estimate_normals
from nishiki.stages.normals import NormalsSettings

VIEW = np.array([0.0, 0.0, 1.0])
VARNISH = GlossProfile(np.array([9.0, 0.8]), np.array([0.09, 0.25]))
MATT = GlossProfile(np.zeros(2), np.array([0.1, 0.3]), transmission=0.0)


def ring(count=8, incidence=45.0):
    """One light near the camera and a ring."""
    azimuth = np.arange(count) * 2 * np.pi / count + 0.1
    theta = np.radians(incidence)
    lights = np.stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth)], axis=1)
    lights = np.column_stack([lights, np.full(count, np.cos(theta))])
    top = np.array([[0.0, np.sin(0.07), np.cos(0.07)]])
    return np.vstack([top, lights])


def tilted(pixels, steepest_deg, seed=0):
    """Unit normals (1, pixels, 3), even in tilt."""
    random = np.random.default_rng(seed)
    theta = np.radians(steepest_deg) * np.sqrt(random.uniform(0, 1, pixels))
    phi = random.uniform(0, 2 * np.pi, pixels)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)[None]


def render(normals, reflectance, lights, gloss):
    """Observations (lights, rows, columns, channels) by the array forms of the reflection model."""
    frames = []
    for light in lights:
        geometry = half_vector_geometry(normals, light, VIEW)
        lit = geometry.cos_i > 0
        body = body_shading(geometry.cos_i, geometry.cos_r, gloss)
        shine = gloss.value(geometry.phi) * attenuation(geometry, gloss.refractive_index)
        frames.append(np.where(lit[..., None], body[..., None] * reflectance + shine[..., None], 0))
    return np.array(frames)


def degrees(a, b):
    """Angles between unit vectors."""
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def start_of(observations, lights):
    """Selection and solution without gloss."""
    level = np.ascontiguousarray(observations.mean(axis=-1))
    usable = select_diffuse(level, lights, method="refit").usable
    field = estimate_normals(level, lights, usable=usable, solver="least_squares")
    return field, diffuse_reflectance(observations, lights, field.normals, usable=usable).reflectance


def test_table_is_the_profile():
    phi = np.linspace(0, np.pi / 2, 5001)
    chord, grid = 2 * np.sin(phi / 2), np.arange(NODES) / NODES_PER_UNIT
    value, _, passed, _ = VARNISH.table()
    assert np.allclose(np.interp(chord, grid, value), VARNISH.value(phi), rtol=0, atol=2e-4 * VARNISH.value(0))
    moved = 2 * np.arcsin(np.sqrt(chord[1:] ** 2 + 1e-6) / 2)
    numeric = (VARNISH.value(moved) - VARNISH.value(phi[1:])) / 1e-6
    assert np.allclose(-numeric, VARNISH.slope(phi[1:]), rtol=1e-3, atol=1e-3)
    assert grid[-1] > np.sqrt(2)
    cosine = np.linspace(0, 1, 777)
    lost = (1 - fresnel(cosine, 1.45)) / (1 - fresnel(1.0, 1.45))
    assert np.allclose(np.interp(cosine, grid, passed), lost, rtol=0, atol=5e-6)


@pytest.mark.parametrize("steepest", [5, 70])
def test_prediction_of_the_kernel_is_the_array_form(steepest):
    lights, normals = ring(), tilted(40, steepest)[0]
    table, grid = VARNISH.table(), np.arange(NODES) / NODES_PER_UNIT
    rows, t, gradient = np.zeros((11, 12)), np.zeros(6), np.zeros(4)
    scene = JointScene(light_table(lights, 1.45), table, np.ones((1, 1)))
    setting = JointSettings(0.002, 0.02, 1.0, 1e4, gloss_error=0.25, tilt_error=0.03, tolerance=3.0, iterations=15)
    pixel = Pixel(np.zeros((1, 12)), np.ones(9, bool), rows, np.zeros(1), 1e-4)
    for n in normals:
        predict(n, pixel, scene, setting, t, gradient)
        geometry = half_vector_geometry(n, lights, VIEW)
        lit = geometry.cos_i > 0
        chord = 2 * np.sin(geometry.phi / 2)
        shine = np.interp(chord, grid, table[0]) * attenuation(geometry, 1.45)
        # the same table: agreement to rounding, but for the chord's own near 0
        assert np.allclose(rows[4, :9], np.where(lit, shine, 0), rtol=1e-9, atol=1e-9)
        body = body_shading(geometry.cos_i, geometry.cos_r, VARNISH)
        assert np.allclose(rows[1, :9], np.where(lit, body, 0), rtol=0, atol=5e-6)


def test_slopes_of_the_kernel_are_differences_of_its_predictions():
    lights, step = light_table(ring(), 1.45), 1e-6
    table = GlossProfile(np.array([2.0]), np.array([0.4])).table()
    setting = JointSettings(0.002, 0.02, 1.0, 1e4, gloss_error=0.25, tilt_error=0.03, tolerance=3.0, iterations=15)
    gradient = np.zeros(4)

    def at(n, t):
        rows = np.zeros((11, 12))
        pixel = Pixel(np.zeros((1, 12)), np.ones(9, bool), rows, np.zeros(1), 1e-4)
        predict(n, pixel, JointScene(lights, table, np.ones((1, 1))), setting, t, gradient)
        return rows

    for n in tilted(20, 40, seed=3)[0]:
        t = np.zeros(6)
        rows = at(n, t).copy()
        for axis, (body, gloss) in enumerate(((2, 5), (3, 6))):
            direction = t[3 * axis : 3 * axis + 3].copy()
            pair = []
            for sign in (1, -1):
                moved = n + sign * step * direction
                pair.append(at(moved / np.linalg.norm(moved), np.zeros(6)))
            lit = (pair[0][0] > 0) & (pair[1][0] > 0)
            for slope, value in ((body, 1), (gloss, 4)):
                numeric = (pair[0][value] - pair[1][value]) / (2 * step)
                assert np.allclose(rows[slope][lit], numeric[lit], rtol=2e-3, atol=2e-3)


def slow_fit(y, lights, gloss, n0, rho0, *, noise, model_error):
    """The same estimate for one pixel by scipy, where nothing is an outlier: weighted squares at settled weights."""
    from scipy.optimize import least_squares

    rotation = helmert(y.shape[1], full=True)
    level = y @ rotation[0]
    scale = (level.sum() - level.max()) / (len(level) - 1)
    floor = noise**2 + (model_error * scale) ** 2
    grid, table = np.arange(NODES) / NODES_PER_UNIT, gloss.table()

    def parts(n):
        geometry = half_vector_geometry(n, lights, VIEW)
        shine = np.interp(2 * np.sin(geometry.phi / 2), grid, table[0]) * attenuation(geometry, gloss.refractive_index)
        return body_shading(geometry.cos_i, geometry.cos_r, gloss), shine

    def slopes(n):
        a = np.cross(n, [1.0, 0.3, 0.2])
        a /= np.linalg.norm(a)
        b, step = np.cross(n, a), 1e-5
        return sum(((parts(n + step * v)[1] - parts(n - step * v)[1]) / (2 * step)) ** 2 for v in (a, b))

    def unpack(x):
        n = np.array([x[0], x[1], 1.0])
        return n / np.linalg.norm(n), x[2:]

    x = np.concatenate([n0[:2] / n0[2], rho0])
    for _ in range(15):
        n, rho = unpack(x)
        body, shine = parts(n)
        root = y.shape[1]
        of_level = floor + root * (0.25**2 * shine**2 + 0.03**2 * slopes(n))
        r = (y - body[:, None] * rho - shine[:, None]) @ rotation.T
        a = 1 / (1 + r[:, 0] ** 2 / of_level / 9)
        e = 1 / (1 + (r[:, 1:] ** 2).sum(axis=1) / floor / 9 / (root - 1))
        e = np.where(r[:, 0] < 0, np.minimum(a, e), e)
        weight = np.sqrt(np.column_stack([a**2 / of_level, *[e**2 / floor] * (root - 1)]))

        def residuals(x, weight=weight):
            n, rho = unpack(x)
            body, shine = parts(n)
            return (((y - body[:, None] * rho - shine[:, None]) @ rotation.T) * weight).ravel()

        x = least_squares(residuals, x, xtol=1e-12, ftol=1e-14, gtol=1e-14).x
    return unpack(x)


def test_kernel_finds_the_minimum_that_a_slow_solver_finds():
    lights, truth = ring(), tilted(5, 20, seed=5)
    random = np.random.default_rng(1)
    reflectance = random.uniform(0.1, 0.8, (1, 5, 3))
    clean = render(truth, reflectance, lights, VARNISH)
    observed = (clean + random.normal(0, 0.002, clean.shape)).astype(np.float32)
    found = refine_normals(observed, lights, normals=truth, gloss=VARNISH, settings=JointSettings(second_start=np.inf))
    for p in range(5):
        n, rho = slow_fit(
            observed[:, 0, p].astype(float), lights, VARNISH, truth[0, p], reflectance[0, p],
            noise=0.002, model_error=0.02,
        )  # fmt: skip
        assert degrees(found.normals[0, p].astype(float), n) < 0.02
        assert np.allclose(found.reflectance[0, p], rho, rtol=2e-3)


def test_exact_data_are_recovered_from_the_selection():
    lights, truth = ring(), tilted(1500, 35)
    reflectance = np.random.default_rng(2).uniform(0.05, 0.9, (1, 1500, 3))
    observed = render(truth, reflectance, lights, VARNISH).astype(np.float32)
    field, rho = start_of(observed, lights)
    found = refine_normals(observed, lights, normals=field.normals, gloss=VARNISH, flags=field.flags, reflectance=rho)
    before, after = degrees(field.normals, truth), degrees(found.normals, truth)
    assert after.mean() < 0.05
    assert after.mean() < 0.1 * before.mean()
    good = after[0] < 0.1
    assert good.mean() > 0.99
    assert np.allclose(found.reflectance[0, good], reflectance[0, good], rtol=0.02)


def test_second_start_finds_what_the_first_misses():
    lights, truth = ring(), tilted(800, 35, seed=9)
    reflectance = np.full((1, 800, 3), 0.05)  # dark paint: the highlights dominate
    observed = render(truth, reflectance, lights, VARNISH).astype(np.float32)
    flat = np.broadcast_to(VIEW, truth.shape)
    errors = [
        degrees(
            refine_normals(
                observed, lights, normals=flat, gloss=VARNISH, settings=JointSettings(second_start=s)
            ).normals,
            truth,
        ).mean()
        for s in (np.inf, 1.0)
    ]
    assert errors[1] < 0.5 * errors[0]


def test_cast_shadows_are_left_out():
    lights, truth = ring(), tilted(600, 25, seed=4)
    observed = render(truth, np.full((1, 600, 3), 0.5), lights, VARNISH).astype(np.float32)
    hidden = np.random.default_rng(0).integers(1, 9, 600)
    observed[hidden, 0, np.arange(600)] *= 0.1
    found = refine_normals(observed, lights, normals=truth, gloss=VARNISH)
    assert np.median(degrees(found.normals, truth)) < 0.1
    assert (found.lights_used <= 8).all()


def test_profile_is_found_behind_blurred_normals():
    """Mixture of two lobes, normals off by a known sigma: without undoing the blur the peak comes out too low."""
    random = np.random.default_rng(3)
    truth = tilted(20000, 40)
    sigma = 0.02
    noisy = truth + random.normal(0, sigma, truth.shape)
    noisy /= np.linalg.norm(noisy, axis=-1, keepdims=True)
    reflectance = np.full((*truth.shape[:2], 1), 0.3)
    observed = render(truth, reflectance, ring(), VARNISH)
    histogram = SpecularHistogram.empty()
    samples = specular_samples(observed, ring(), noisy, reflectance, VARNISH, valid=np.ones(observed.shape[:3], bool))
    undone = fit_gloss(histogram.add_samples(*samples, sigma=sigma))
    blurred = fit_gloss(histogram.add_samples(*samples))
    phi = np.array([0.0, 0.05, 0.1, 0.2, 0.4])
    expected = VARNISH.value(phi)
    assert np.allclose(undone.value(phi), expected, rtol=0.15, atol=0.1)
    assert abs(blurred.value(0.0) - expected[0]) > 2 * abs(undone.value(0.0) - expected[0])


def test_scene_gloss_tells_varnish_from_matt():
    lights, truth = ring(), tilted(3000, 30)
    random = np.random.default_rng(6)
    reflectance = random.uniform(0.05, 0.8, (1, 3000, 3))
    for gloss, expected in ((VARNISH, True), (MATT, False)):
        observed = render(truth, reflectance, lights, gloss)
        observed = (observed + random.normal(0, 0.002, observed.shape)).astype(np.float32)
        field, rho = start_of(observed, lights)
        tile = GlossTile(
            observed, np.ones(observed.shape[:3], bool), lights, field.normals, field.flags, field.sigma, rho
        )
        found = fit_scene_gloss([tile])
        assert found.significant is expected
        assert found.pixels == 3000
        assert found.profile.transmission == (1.0 if expected else 0.0)
        if expected:
            phi = np.array([0.03, 0.1, 0.2])
            assert np.allclose(found.profile.value(phi), VARNISH.value(phi), rtol=0.25)
            fit = refine_normals(observed, lights, normals=field.normals, gloss=found.profile)
            assert degrees(fit.normals, truth).mean() < 0.3 * degrees(field.normals, truth).mean()
            assert np.isfinite(list(v for v in found.described.values() if isinstance(v, float))).all()


def test_two_finishes_are_told_apart_and_one_is_not_divided():
    lights, truth = np.vstack([ring(6, 25.0), ring(8, 50.0)[1:]]), tilted(4000, 30)
    random = np.random.default_rng(9)
    reflectance, cells = random.uniform(0.1, 0.8, (1, 4000, 3)), np.arange(4000)[None] // 50
    glossy, matt = (render(truth, reflectance, lights, gloss) for gloss in (VARNISH, MATT))
    varnished = cells < 50
    for finish, count in ((varnished, 2), (varnished | True, 0)):
        observed = np.where(finish[..., None], glossy, matt) + random.normal(0, 0.002, glossy.shape)
        observed = observed.astype(np.float32)
        field, rho = start_of(observed, lights)
        valid = np.ones(observed.shape[:3], bool)
        tile = GlossTile(observed, valid, lights, field.normals, field.flags, field.sigma, rho, cells)
        found = list(find_finishes([tile], fit_scene_gloss([tile]).found))
        if not count:
            assert not found
            continue
        finishes, labels, clear = found[0]
        assert [part.profile.beta.any() for part in finishes] == [True, False]
        assert [part.profile.transmission for part in finishes] == [1.0, 0.0]
        assert np.array_equal(labels, np.arange(80) >= 50)
        assert 0.4 < clear.mean() < 0.6


def test_gilding_is_found_beside_varnish_with_its_colour():
    """A mirror of GGX facets in the colour of gold, without a body, on half of the cells."""
    lights = np.concatenate([ring(8, 48)[1:], ring(5, 25)[1:]])
    normals, colour = tilted(1600, 15), np.array([0.95, 0.75, 0.42])
    reflectance = np.random.default_rng(3).uniform(0.05, 0.6, (1, 1600, 3))
    observations = render(normals, reflectance, lights, VARNISH)
    geometry = half_vector_geometry(normals, lights[:, None, None], VIEW)
    facets = 0.25 / 0.17**2 / (np.cos(geometry.phi) ** 2 * (1 + (np.tan(geometry.phi) / 0.17) ** 2)) ** 2
    mirror = np.where(geometry.cos_i > 0, facets * attenuation(geometry, MIRROR), 0)
    observations[:, :, 800:] = (mirror[..., None] * colour)[:, :, 800:]
    cells = np.arange(1600)[None] // 100
    field, start = start_of(observations, lights)
    valid = np.ones(observations.shape[:3], bool)
    tile = GlossTile(observations, valid, lights, field.normals, field.flags, field.sigma, start, cells)
    finishes, labels, _ = next(find_finishes([tile], fit_scene_gloss([tile]).found))
    gold = finishes[labels[-1]].found
    assert np.array_equal(labels == labels[-1], np.arange(16) >= 8)
    assert [each.found.colour is None for each in finishes].count(False) == 1
    np.testing.assert_allclose(gold.colour / gold.colour[0], colour / colour[0], rtol=0.02)
    fit = refine_normals(observations[:, :, 800:], lights, normals=field.normals[:, 800:], gloss=gold)
    assert np.median(degrees(fit.normals, normals[:, 800:])) < 1
    assert np.allclose(fit.reflectance, gold.colour, rtol=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_lamps_at_several_incidences_tell_the_transmission(share):
    """Gloss over a body that loses none, some or all of the light that a dielectric surface takes."""
    lights, truth = np.vstack([ring(6, 25.0), ring(8, 58.0)[1:]]), tilted(2500, 35)
    random = np.random.default_rng(8)
    reflectance = random.uniform(0.2, 0.8, (1, 2500, 3))
    gloss = replace(VARNISH, transmission=share)
    observed = render(truth, reflectance, lights, gloss) + random.normal(0, 0.002, (len(lights), 1, 2500, 3))
    observed = observed.astype(np.float32)
    field, rho = start_of(observed, lights)
    tile = GlossTile(observed, np.ones(observed.shape[:3], bool), lights, field.normals, field.flags, field.sigma, rho)
    found = fit_scene_gloss([tile])
    assert found.significant
    assert found.profile.transmission == pytest.approx(share, abs=0.1)
    fit = refine_normals(observed, lights, normals=field.normals, gloss=found.profile)
    assert degrees(fit.normals, truth).mean() < 0.4
    if share == 0.0:  # what the measurement saves from
        lossy = refine_normals(observed, lights, normals=field.normals, gloss=replace(found.profile, transmission=1.0))
        assert degrees(lossy.normals, truth).mean() > 2 * degrees(fit.normals, truth).mean()


def test_bytes_do_not_depend_on_tiles_or_threads(monkeypatch):
    lights, truth = ring(), tilted(5000, 30).reshape(50, 100, 3)
    observed = render(truth, np.full((50, 100, 3), 0.4), lights, VARNISH).astype(np.float32)
    observed += np.random.default_rng(0).normal(0, 0.003, observed.shape).astype(np.float32)
    start = np.broadcast_to(VIEW, truth.shape)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    shared = refine_normals(observed, lights, normals=start, gloss=VARNISH)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    whole = refine_normals(observed, lights, normals=start, gloss=VARNISH)
    bands = [
        refine_normals(observed[:, rows], lights, normals=start[rows], gloss=VARNISH)
        for rows in (slice(0, 7), slice(7, 50))
    ]
    for name in ("normals", "reflectance", "sigma", "residual", "condition", "lights_used", "flags", "cost"):
        one = getattr(whole, name)
        assert one.tobytes() == getattr(shared, name).tobytes()
        assert one.tobytes() == np.concatenate([getattr(band, name) for band in bands]).tobytes()


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    channels=st.sampled_from([1, 3]),
    scale=st.floats(-30, 30),
    share=st.floats(0, 1),
)
def test_nothing_leaves_unflagged_that_is_not_finite(seed, channels, scale, share):
    random = np.random.default_rng(seed)
    observed = (10.0**scale * random.normal(0.3, 0.5, (6, 2, 5, channels))).astype(np.float32)
    observed[random.uniform(size=observed.shape) < 0.05] = np.nan
    valid = random.uniform(size=observed.shape[:3]) < share
    found = refine_normals(observed, ring(5), normals=tilted(10, 89, seed).reshape(2, 5, 3), gloss=VARNISH, valid=valid)
    for name in ("normals", "reflectance", "albedo", "sigma", "residual", "condition", "cost"):
        assert np.isfinite(getattr(found, name)).all(), name
    assert np.allclose(np.linalg.norm(found.normals, axis=-1), 1, atol=1e-5)
    assert (found.reflectance >= 0).all()
    few = valid.sum(axis=0) < 4
    assert ((found.flags[few] & NormalFlag.FALLBACK) != 0).all()


def test_pixels_without_an_estimate_keep_what_they_had():
    lights, truth = ring(), tilted(4, 10).reshape(2, 2, 3)
    observed = render(truth, np.full((2, 2, 3), 0.5), lights, VARNISH).astype(np.float32)
    flags = np.array([[NormalFlag.NO_SIGNAL, 0], [0, NormalFlag.TOO_FEW_LIGHTS]], np.uint8)
    start = np.broadcast_to(VIEW, truth.shape)
    found = refine_normals(observed, lights, normals=start, gloss=VARNISH, flags=flags)
    untouched = flags != 0
    assert (found.flags == flags).all()
    assert (found.normals[untouched] == VIEW).all()
    assert (degrees(found.normals, truth)[~untouched] < 0.5).all()


def test_sigma_says_how_wrong_the_normals_are():
    """With noise as the model states it, the errors are of the size that sigma says (within a factor 1.6)."""
    lights, truth = ring(), tilted(4000, 15)
    random = np.random.default_rng(8)
    observed = render(truth, np.full((1, 4000, 3), 0.5), lights, MATT)
    observed = (observed + random.normal(0, 0.01, observed.shape)).astype(np.float32)
    found = refine_normals(
        observed, lights, normals=truth, gloss=MATT, settings=JointSettings(noise=0.01, model_error=0.0)
    )
    rms = np.sqrt(np.mean(np.radians(degrees(found.normals, truth)) ** 2))
    said = np.sqrt(np.mean(found.sigma.astype(float) ** 2))
    assert said / 1.6 < rms < said * 1.6


def test_bad_input_is_reported():
    lights = ring()
    observed = np.ones((9, 2, 2, 3), np.float32)
    with refused(UserError, "(9, 2, 2, 3)"):
        refine_normals(observed, lights[:5], normals=np.zeros((2, 2, 3)), gloss=VARNISH)
    with refused(UserError, "(9, 2, 2, 3)"):
        refine_normals(observed, lights, normals=np.zeros((3, 2, 3)), gloss=VARNISH)
    with pytest.raises(UserError, match="gloss"):
        GlossProfile(np.array([-1.0]), np.array([0.1]))
    with refused(UserError, by="light_table"):
        light_table(np.array([[0.0, 0.0, -1.0]]), 1.45)
    assert fit_gloss(SpecularHistogram.empty()).beta.tolist() == [0.0] * LADDER.size


def test_settings_name_the_choices():
    assert NormalsSettings().refine == "auto"
    with pytest.raises(ValueError, match="refine"):
        NormalsSettings(refine="all")
