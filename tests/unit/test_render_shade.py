"""Shading against the explicit 61-band path, the limits of the model, and extreme input."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from nishiki.brdf.slopes import slope_covariance
from nishiki.brdf.torrance_sparrow import (
    body_factor,
    exp2_negative,
    fresnel,
    half_vector_geometry,
    specular,
    transmittance,
)
from nishiki.colour.colour import cie_1931_cmfs, illuminant, white_xyz
from nishiki.errors import UserError
from nishiki.render.plane.kernel import COLOUR_MISSING, NORMAL_MISSING, OVERFLOW, TURNED_AWAY
from nishiki.render.plane.scene import Ambient, Gloss, Light, PlaneScene
from nishiki.render.plane.shade import FRONTAL_EYE, pixel_to_plane, shade_xyz


def unit(vectors):
    vectors = np.asarray(vectors, dtype=np.float64)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def make_scene(rows=9, columns=150, bands=3, seed=0, steepness=0.4, **changes):
    """Random maps; 150 columns are more than one block of the kernel and no multiple of it."""
    rng = np.random.default_rng(seed)
    normals = unit(rng.normal(size=(rows, columns, 3)) * [steepness, steepness, 0] + [0, 0, 1]).astype(np.float32)
    wavelengths = np.linspace(0, 1, 61)
    basis = np.array([np.cos(np.pi * k * wavelengths) for k in range(bands)])
    coefficients = (rng.uniform(0.1, 0.9, (rows, columns, bands)) / (1 + np.arange(bands)) ** 2).astype(np.float32)
    gloss = Gloss(
        beta=[[0.8, 0.1], [3.0, 0.0], [0.0, 0.0]],
        gamma=[[0.15, 0.6], [0.05, 1.0], [0.3, 0.3]],
        refractive_index=[1.45, 1.6, 1.33],
    )
    labels = rng.integers(0, 3, (rows, columns)).astype(np.uint8)
    scene = PlaneScene(normals, coefficients, basis=basis, labels=labels, gloss=gloss, pitch=0.7)
    return dataclasses.replace(scene, **changes)


def many_lights():
    return [
        Light(direction=(1, 1, 1), spectrum=illuminant("D65"), intensity=0.7),
        Light(position_mm=(-80, 20, 60), spectrum=illuminant("A"), intensity=2.0, falloff=True),
        Light(direction=(0, -1, 0.05), spectrum=illuminant("D65"), intensity=0.2),
        Light(position_mm=(10, 0, 100), spectrum=illuminant("FL11")),
    ]


def slow_xyz(scene, lights, *, eye=FRONTAL_EYE, ambient=None, visibility=None):
    """All 61 bands, in float64, one light at a time, with the array form of Torrance-Sparrow."""
    rows, columns = scene.shape
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    x = (column - (columns - 1) / 2) * scene.pitch
    y = ((rows - 1) / 2 - row) * scene.pitch
    points = np.stack([x, y, np.zeros_like(x)], axis=-1)
    normals = scene.normals.astype(np.float64)
    reflectance = scene.coefficients.astype(np.float64) @ scene.basis
    views = unit(np.broadcast_to(eye[:3] - eye[3] * points, points.shape))
    labels = np.zeros(scene.shape, int) if scene.labels is None else scene.labels
    radiance = np.zeros((rows, columns, 61))
    for j, light in enumerate(lights):
        source = light.homogeneous()
        to_light = np.broadcast_to(source[:3] - source[3] * points, points.shape)
        power = light.intensity * light.spectrum / (cie_1931_cmfs()[1] @ light.spectrum)
        irradiance = np.full(scene.shape, 1.0 if visibility is None else visibility[j])
        if light.falloff:
            irradiance *= source[:3] @ source[:3] / np.sum(to_light**2, axis=-1)
        directions = unit(to_light)
        gloss = np.zeros(scene.shape)
        for lobe in range(scene.gloss.beta.shape[1]):
            widened = widening(scene, directions, views, scene.gloss.gamma[labels, lobe])
            gloss += widened * specular(
                normals,
                directions,
                views,
                beta=scene.gloss.beta[labels, lobe],
                gamma=scene.gloss.gamma[labels, lobe],
                refractive_index=scene.gloss.refractive_index[labels],
            )
        cosine = np.maximum(np.sum(normals * directions, axis=-1), 0)
        if scene.shading is not None:
            half_cosine = np.sum(normals * unit(directions + views), axis=-1)
            cosine = cosine * body_factor(scene.shading, cosine, half_cosine, directions[..., :2])
        cosine = cosine * passed(scene, np.sum(normals * directions, axis=-1), labels)
        cosine = cosine * passed(scene, np.sum(normals * views, axis=-1), labels)
        radiance += (irradiance * cosine)[..., None] * reflectance * power
        radiance += (irradiance * gloss)[..., None] * power
    if ambient is not None:
        power = ambient.level * ambient.spectrum / (cie_1931_cmfs()[1] @ ambient.spectrum)
        seen = 0.5 * (1 + normals[..., 2:]) * ambient_factor(scene)
        cosine = (np.arange(20000) + 0.5) / 20000
        table = [2 * np.mean(cosine * transmittance(cosine, index)) for index in scene.gloss.refractive_index]
        entering = 1 - scene.gloss.transmission * (1 - np.array(table))
        seen = seen * (entering[labels] * passed(scene, np.sum(normals * views, axis=-1), labels))[..., None]
        radiance += seen * reflectance * power
    return radiance @ cie_1931_cmfs().T


def passed(scene, cosine, labels):
    """What the surface lets through, region by region."""
    index = scene.gloss.refractive_index[labels]
    lost = 1 - (1 - fresnel(np.clip(cosine, 1e-6, 1), index)) / (1 - fresnel(np.ones(cosine.shape), index))
    return 1 - scene.gloss.transmission[labels] * lost


def widening(scene, directions, views, gamma):
    """Lobe over Gaussian slopes relative to the lobe itself, by 2 x 2 matrices of each pixel."""
    if scene.slopes is None:
        return 1.0
    normals, half = scene.normals.astype(np.float64), unit(directions + views)
    offset = normals[..., :2] / np.maximum(normals[..., 2:], 0.2) - half[..., :2] / half[..., 2:]
    phi = half_vector_geometry(normals, directions, views).phi
    square = np.sum(offset**2, axis=-1)
    q = np.where(square > 1e-12, phi**2 / np.maximum(square, 1e-12), normals[..., 2] ** 3)[..., None, None]
    xx, xy, yy = np.moveaxis(scene.slopes.astype(np.float64), -1, 0)
    spread = q * np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    width = (gamma**2 / (2 * np.log(2)))[..., None, None] * np.eye(2)
    offset = (np.sqrt(q[..., 0]) * offset)[..., None]
    exponent = [np.squeeze(np.swapaxes(offset, -1, -2) @ np.linalg.solve(m, offset)) for m in (width + spread, width)]
    return np.sqrt(np.linalg.det(width) / np.linalg.det(width + spread)) * np.exp((exponent[1] - exponent[0]) / 2)


def ambient_factor(scene):
    """Mean of the body factor over a half space of light in front of a facet that faces the eye, by quadrature."""
    if scene.shading is None:
        return 1.0
    cosine = (np.arange(20000) + 0.5) / 20000
    a, b, d, *e = np.moveaxis(scene.shading.astype(np.float64), -1, 0)
    means = [np.mean(2 * cosine * values) for values in (cosine, ((1 + cosine) / 2) ** 4)]
    if e:  # the mean direction of that light is along the normal
        b = b + e[0] * scene.normals[..., 0] + e[1] * scene.normals[..., 1]
    return np.maximum(a + b * means[0] + d * means[1], 0)[..., None]


def assert_close(values, reference, tolerance=1e-6):
    scale = np.abs(reference).max(axis=-1, keepdims=True)
    assert np.all(np.abs(values - reference) <= tolerance * scale + 1e-15)


@pytest.mark.parametrize("bands", [1, 3, 8])
@pytest.mark.parametrize("eye", [(0, 0, 1, 0), (40, -30, 90, 1), (300, 0, 20, 1)])
@pytest.mark.parametrize("terms", [0, 3, 5])
def test_matrix_form_equals_61_bands(bands, eye, terms):
    scene = make_scene(bands=bands)
    if terms:  # some factors below 0, which count as 0
        shading = np.random.default_rng(2).normal([0.8, -0.3, 0.5, 0.2, -0.1][:terms], 0.5, (*scene.shape, terms))
        shading = shading.astype(np.float32)
        gloss = dataclasses.replace(scene.gloss, transmission=[0.8, 0.0, 0.3])
        scene = dataclasses.replace(scene, shading=shading, gloss=gloss)
    ambient = Ambient(illuminant("FL2"), 0.3)
    visibility = np.random.default_rng(1).uniform(0, 1, (4, *scene.shape)).astype(np.float32)
    eye = np.array(eye, float)
    result = shade_xyz(scene, many_lights(), eye=eye, ambient=ambient, visibility=visibility)
    assert_close(result.values, slow_xyz(scene, many_lights(), eye=eye, ambient=ambient, visibility=visibility))
    turned = result.flags == TURNED_AWAY
    assert set(np.unique(result.flags)) <= {0, TURNED_AWAY}
    if eye[3] == 0:
        assert not turned.any()
    if eye[2] == 20:
        assert turned.any()


@pytest.mark.parametrize("eye", [(0, 0, 1, 0), (40, -30, 90, 1)])
def test_blurred_gloss_equals_61_bands(eye):
    scene = make_scene(steepness=0.2)
    scene = dataclasses.replace(scene, slopes=slope_covariance(scene.normals) / 10)
    values = shade_xyz(scene, many_lights(), eye=np.array(eye, float)).values
    assert_close(values, slow_xyz(scene, many_lights(), eye=np.array(eye, float)))


@given(
    gamma=st.floats(0.003, 10.0),
    beta=st.floats(0, 1e6),
    index=st.floats(1.0, 3.0),
    elevation=st.floats(1e-4, np.pi / 2),
    azimuth=st.floats(0, 6.3),
    steepness=st.sampled_from([0.0, 1e-4, 0.02, 0.5, 20.0]),
)
@settings(max_examples=60, deadline=None)
def test_gloss_equals_61_bands_over_extremes(gamma, beta, index, elevation, azimuth, steepness):
    scene = make_scene(rows=2, columns=40, steepness=steepness, labels=None, gloss=Gloss([[beta]], [[gamma]], [index]))
    direction = (np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation))
    lights = [Light(direction=direction)]
    result = shade_xyz(scene, lights)
    reference = slow_xyz(scene, lights)
    assert np.all(np.isfinite(result.values))
    # the slow form is exp2(-(phi / gamma)^2) down to 1e-300; the kernel drops lobes below 2^-60 of their peak
    floor = np.full((*scene.shape, 1), beta * 2.0**-60 * 1e4)
    assert np.all(np.abs(result.values - reference) <= 1e-6 * np.abs(reference).max(-1, keepdims=True) + floor)


def test_exp2_against_the_library():
    e = np.linspace(0, 60, 4001)
    ours = np.array([exp2_negative(x) for x in e])
    assert np.max(np.abs(ours / np.exp2(-e) - 1)) < 4e-12
    assert np.max(np.abs(ours / np.exp2(-e) - 1)[e < 40]) < 1e-14 * 4
    assert exp2_negative(0.0) == 1.0


def test_flat_white_facing_the_lamp_is_the_white_of_the_lamp():
    normals = np.zeros((4, 5, 3), np.float32) + np.float32([0, 0, 1])
    scene = PlaneScene(normals, np.ones((4, 5, 1), np.float32), basis=np.ones((1, 61)))
    for name in ("A", "D65", "FL11"):
        result = shade_xyz(scene, [Light(direction=(0, 0, 3), spectrum=illuminant(name), intensity=1.0)])
        np.testing.assert_allclose(result.values[2, 2], white_xyz(illuminant(name)), rtol=1e-6)
        assert result.values[2, 2, 1] == pytest.approx(1, abs=1e-6)
    slanted = shade_xyz(scene, [Light(direction=(np.sqrt(3), 0, 1))]).values
    np.testing.assert_allclose(slanted[..., 1], 0.5, rtol=1e-6)
    ambient = shade_xyz(scene, [], ambient=Ambient(illuminant("A"), 0.25)).values
    np.testing.assert_allclose(ambient[..., 1], 0.25, rtol=1e-6)


def test_channels_without_a_basis_keep_white_white():
    normals = np.zeros((2, 2, 3), np.float32) + np.float32([0, 0, 1])
    scene = PlaneScene(normals, np.ones((2, 2, 3), np.float32))
    for name in ("A", "D65"):
        result = shade_xyz(scene, [Light(direction=(0, 0, 1), spectrum=illuminant(name))])
        np.testing.assert_allclose(result.values[0, 0], white_xyz(illuminant(name)), rtol=2e-3)


def test_lights_add_up_and_scale():
    scene, lights = make_scene(), many_lights()
    together = shade_xyz(scene, lights).values.astype(np.float64)
    apart = sum(shade_xyz(scene, [light]).values.astype(np.float64) for light in lights)
    assert_close(together, apart)
    for scale in (1e-6, 1e6):
        scaled = [dataclasses.replace(light, intensity=light.intensity * scale) for light in lights]
        assert_close(shade_xyz(scene, scaled).values / scale, together)


def test_fall_off_is_the_inverse_square():
    normals = np.zeros((1, 3, 3), np.float32) + np.float32([0, 0, 1])
    scene = PlaneScene(normals, np.ones((1, 3, 1), np.float32), basis=np.ones((1, 61)), pitch=10.0)
    light = Light(position_mm=(0, 0, 20), falloff=True)
    values = shade_xyz(scene, [light]).values[0, :, 1]
    distance2 = 20**2 + np.array([10, 0, 10]) ** 2
    np.testing.assert_allclose(values, 20**2 / distance2 * 20 / np.sqrt(distance2), rtol=1e-6)


def test_slopes_inside_a_pixel_are_those_of_interpolated_normals():
    slopes = np.random.default_rng(4).normal(0, 0.2, (5, 6, 2))
    normals = unit(np.dstack([slopes, np.ones((5, 6))]))
    found, t = slope_covariance(normals), (np.arange(400) + 0.5) / 400 - 0.5
    for row, column in ((2, 3), (0, 0), (4, 2)):
        total = np.zeros((2, 2))
        for line, place in ((slopes[:, column], row), (slopes[row], column)):
            line = np.array([np.interp(place + t, np.arange(len(line)), line[:, k]) for k in range(2)]).T - line[place]
            total += line.T @ line / len(t)
        np.testing.assert_allclose(found[row, column], [total[0, 0], total[0, 1], total[1, 1]], rtol=1e-3, atol=1e-6)
    normals[2, 3] = 0  # unknown: its neighbours do not see it
    assert np.isfinite(slope_covariance(normals)).all()
    assert (slope_covariance(normals)[2, 3] == 0).all()


def test_gloss_of_a_relief_is_the_mean_over_the_normals_inside_the_pixel():
    """Against 7 x 7 interpolated normals a pixel: the closed form takes off most of the error of one normal."""
    random = np.random.default_rng(8)
    fine = gaussian_filter(random.normal(0, 1, (7 * 24, 7 * 30, 2)), (14, 14, 0))
    fine *= 0.25 / fine.std()
    light, gloss = Light(direction=(0.3, 0.2, 0.9)), Gloss([[8.0, 1.0]], [[0.06, 0.2]], [1.45])

    def shine(fields, blur):
        normals = unit(np.dstack([fields, np.ones(fields.shape[:2])])).astype(np.float32)
        slopes = slope_covariance(normals) if blur else None
        scene = PlaneScene(normals, np.zeros((*normals.shape[:2], 3), np.float32), gloss=gloss, slopes=slopes)
        return shade_xyz(scene, [light]).values[..., 1]

    expected = shine(fine, False).reshape(24, 7, 30, 7).mean(axis=(1, 3))
    means = fine.reshape(24, 7, 30, 7, 2).mean(axis=(1, 3))
    one, blurred = (np.sqrt(np.mean((shine(means, blur) - expected) ** 2)) for blur in (False, True))
    assert blurred < 0.35 * one


def test_bytes_do_not_depend_on_the_number_of_threads(monkeypatch):
    scene, lights = make_scene(rows=33, columns=301), many_lights()
    gloss = dataclasses.replace(scene.gloss, transmission=1.0)
    scene = dataclasses.replace(scene, gloss=gloss, slopes=slope_covariance(scene.normals))
    results = []
    for count in (1, 2, 5):
        monkeypatch.setattr("nishiki.threads.threads", lambda count=count: count)
        results.append(shade_xyz(scene, lights, eye=np.array([40.0, -30, 90, 1])))
    assert all(r.values.tobytes() == results[0].values.tobytes() for r in results)
    assert all(r.flags.tobytes() == results[0].flags.tobytes() for r in results)


def test_pixels_do_not_depend_on_where_a_block_begins():
    scene = make_scene(rows=2, columns=300)
    lights = [Light(direction=(1, 1, 1))]
    whole = shade_xyz(scene, lights).values
    for start in (1, 127, 128, 129):
        part = PlaneScene(
            scene.normals[:, start:].copy(), scene.coefficients[:, start:].copy(), basis=scene.basis,
            labels=scene.labels[:, start:].copy(), gloss=scene.gloss,
        )  # fmt: skip
        np.testing.assert_array_equal(shade_xyz(part, lights).values, whole[:, start:])


def test_missing_input_is_flagged_and_zero():
    scene = make_scene(rows=1, columns=140)
    scene.normals[0, 0] = 0
    scene.normals[0, 1] = np.nan
    scene.normals[0, 2] *= 2
    scene.coefficients[0, 3, 1] = np.inf
    scene.coefficients[0, 130, 0] = np.nan
    scene.coefficients[0, 4] = 0
    result = shade_xyz(scene, many_lights())
    assert np.all(result.flags[0, :3] == NORMAL_MISSING)
    assert np.all(result.flags[0, [3, 130]] == COLOUR_MISSING)
    assert np.all(result.values[0, [0, 1, 2, 3, 130]] == 0)
    assert np.count_nonzero(result.flags) == 5
    assert np.all(np.isfinite(result.values))
    intact = make_scene(rows=1, columns=140)
    intact.coefficients[0, 4] = 0  # zero albedo: gloss alone, not flagged
    clean = np.flatnonzero(result.flags[0] == 0)
    assert_close(result.values[:, clean], slow_xyz(intact, many_lights())[:, clean])


def test_overflow_is_flagged():
    scene = make_scene(rows=1, columns=5)
    result = shade_xyz(scene, [Light(direction=(0, 0, 1), intensity=1e39), Light(direction=(0, 0, 1), intensity=1e300)])
    assert np.all(result.flags == OVERFLOW)
    assert np.all(result.values == 0)


def test_grazing_light_and_view_stay_finite():
    scene = make_scene(rows=3, columns=200, steepness=30.0)
    for z in (1e-3, 1e-6, 1e-12, 1e-200):
        lights = [Light(direction=(1, 0, z)), Light(position_mm=(1000, 3, z))]
        for eye in ((-1000.0, 0, z, 1), (0.0, 1000.0, z, 1)):
            result = shade_xyz(scene, lights, eye=np.array(eye))
            assert np.all(np.isfinite(result.values))
            assert np.all((result.flags == 0) | (result.flags == TURNED_AWAY))
            assert_close(result.values, slow_xyz(scene, lights, eye=np.array(eye)), 3e-6)


def test_pixel_to_plane_puts_the_first_row_at_the_top():
    scene = make_scene(rows=3, columns=5)
    plane = pixel_to_plane(scene.pitch, scene.shape)
    np.testing.assert_allclose(plane @ [0, 0, 1], [-1.4, 0.7, 1], atol=1e-12)
    np.testing.assert_allclose(plane @ [2, 1, 1], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Light(direction=(0, 0, -1)), "-1"),
        (lambda: Light(direction=(0, 0, 1), position_mm=(0, 0, 1)), "position"),
        (lambda: Light(direction=(0, np.nan, 1)), "finite"),
        (lambda: Light(direction=(0, 0, 1), spectrum=np.ones(31)), "61"),
        (lambda: Light(direction=(0, 0, 1), spectrum=np.zeros(61)), "0"),
        (lambda: Light(direction=(0, 0, 1), intensity=-1), "intensity"),
        (lambda: Light(direction=(0, 0, 1), falloff=True), "position_mm"),
        (lambda: Light(direction=(0, 0, 1), angular_radius=1.0), "radius"),
        (lambda: Ambient(level=np.nan), "ambient"),
        (lambda: Gloss([[1.0]], [[0.0]], [1.4]), "gamma"),
        (lambda: Gloss([[-1.0]], [[0.1]], [1.4]), "beta"),
        (lambda: Gloss([[1.0]], [[0.1]], [0.9]), "index"),
        (lambda: make_scene(pitch=0.0), "pitch"),
        (lambda: shade_xyz(make_scene(), []), "light"),
    ],
)
def test_mistakes_are_named(make, words):
    with pytest.raises(UserError, match=words):
        make()
