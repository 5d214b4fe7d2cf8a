"""The reflection model against its textbook form in 50 digits, its limits, and its compiled form."""

import mpmath
import numpy as np
import pytest
from compiled_lobe import specular_scalar
from hypothesis import given, settings
from hypothesis import strategies as st

from nishiki.brdf import torrance_sparrow
from nishiki.brdf import torrance_sparrow as ts
from nishiki.errors import UserError

mpmath.mp.dps = 50


def exact_specular(normal, light, view, gamma, index):
    """D F G / cos_r as printed in Tominaga and Tanaka (2004), eq. 10-13 (with the corrected g), 50 digits; not
    simplified."""
    n, light, view = ([mpmath.mpf(float(x)) for x in v] for v in (normal, light, view))
    dot = lambda a, b: sum(x * y for x, y in zip(a, b, strict=True))  # noqa: E731
    h = [a + b for a, b in zip(light, view, strict=True)]
    h = [x / mpmath.sqrt(dot(h, h)) for x in h]
    cos_i, cos_r, cos_q, cos_phi = dot(n, light), dot(n, view), dot(view, h), dot(n, h)
    if cos_i <= 0 or cos_r <= 0:
        return mpmath.mpf(0)
    length = mpmath.sqrt(dot(n, n))  # float64 normals are unit to 1e-16 only: phi from the true angle
    phi = mpmath.acos(min(cos_phi / length, mpmath.mpf(1)))
    d = mpmath.exp(-mpmath.log(2) * phi**2 / mpmath.mpf(gamma) ** 2)
    g = min(1, 2 * cos_phi * cos_r / cos_q, 2 * cos_phi * cos_i / cos_q)
    return d * exact_fresnel(cos_q, index) * g / cos_r


def exact_fresnel(c, index):
    """The textbook's formula, cancellation and all, in 50 digits."""
    c, g = mpmath.mpf(c), mpmath.sqrt(mpmath.mpf(index) ** 2 + mpmath.mpf(c) ** 2 - 1)
    return ((g - c) / (g + c)) ** 2 / 2 * (1 + ((c * (g + c) - 1) / (c * (g - c) + 1)) ** 2)


def at(theta, phi=0.0):
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


UP = np.array([0.0, 0.0, 1.0])
upper = st.tuples(st.floats(0, 1.57), st.floats(-3.14, 3.14))


@given(upper, upper, upper, st.floats(1e-3, 10), st.floats(1.0001, 4))
@settings(max_examples=150, deadline=None)
def test_array_and_compiled_forms_equal_fifty_digits(n, light, view, gamma, index):
    n, light, view = at(*n), at(*light), at(*view)
    cos_i, cos_r = n @ light, n @ view
    if min(abs(cos_i), abs(cos_r)) < 1e-6:  # the rounding of the given directions decides on which side they are
        return
    expected = float(exact_specular(n, light, view, gamma, index))
    array = ts.specular(n, light, view, beta=1.0, gamma=gamma, refractive_index=index)
    scalar = specular_scalar(*n, *light, *view, gamma, index)
    # an angle rounded to 1e-16 changes D by 2 ln 2 phi / gamma^2 of that
    tolerance = 1e-11 * (1 + 1 / gamma**2 * 1e-3)
    assert array == pytest.approx(expected, rel=1e-9, abs=tolerance)
    assert scalar == pytest.approx(float(array), rel=1e-11, abs=1e-12)


@pytest.mark.parametrize("gamma", [0.003, 0.07, 0.5])
def test_compiled_form_equals_array_form_at_many_points(gamma):
    rng = np.random.default_rng(3)
    n, light, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(3, 4000, 3)))
    light[:500] = light[:500] * 1e-3 + n[:500]  # close to the mirror direction
    view[:500] = 2 * np.sum(n[:500] * light[:500], axis=1, keepdims=True) * n[:500] - light[:500]
    light, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (light, view))
    array = ts.specular(n, light, view, beta=1.0, gamma=gamma, refractive_index=1.45)
    compiled = [specular_scalar(*a, *b, *c, gamma, 1.45) for a, b, c in zip(n, light, view, strict=True)]
    np.testing.assert_allclose(compiled, array, rtol=1e-11, atol=1e-13)
    assert np.count_nonzero(array) > 500


@given(st.floats(1e-12, 1), st.floats(1 + 1e-12, 1e3))
@settings(max_examples=200, deadline=None)
def test_fresnel_equals_the_textbook_formula_in_fifty_digits(c, index):
    # cond: near Brewster's angle nothing is lost, F is a sum of squares
    assert float(ts.fresnel(c, index)) == pytest.approx(float(exact_fresnel(c, index)), rel=1e-12)
    assert torrance_sparrow.fresnel_scalar(c, index) == pytest.approx(float(ts.fresnel(c, index)), rel=1e-13)


def test_fresnel_known_values():
    assert float(ts.fresnel(1.0, 1.5)) == pytest.approx(0.04, rel=1e-14)
    assert float(ts.fresnel(0.0, 1.5)) == 1.0
    brewster = 1 / np.sqrt(1 + 1.5**2)
    assert float(ts.fresnel(brewster, 1.5)) == pytest.approx(0.5 * ((1.5**2 - 1) / (1.5**2 + 1)) ** 2, rel=1e-13)
    np.testing.assert_array_equal(ts.fresnel(np.linspace(0, 1, 5), 1.0), 0)
    with pytest.raises(UserError, match="n >= 1"):
        ts.fresnel(0.5, 0.7)


def test_lobe_known_values_and_limits():
    assert float(ts.facet_distribution(0.07, 0.07)) == 0.5
    assert float(ts.facet_distribution(0.14, 0.07)) == pytest.approx(1 / 16)
    # roughness -> 0 and -> infinity
    np.testing.assert_array_equal(ts.facet_distribution(np.array([0.0, 1e-8, 1.0]), 1e-160), [1, 0, 0])
    np.testing.assert_array_equal(ts.facet_distribution(np.array([0.0, 1.5]), np.inf), 1)
    assert float(ts.facet_distribution(1e-9, 1e-9)) == 0.5
    with pytest.raises(UserError, match="gamma"):
        ts.facet_distribution(0.1, 0.0)
    assert float(ts.facet_distribution(0.3, 0.3 * ts.GAMMA_PER_SIGMA)) == pytest.approx(np.exp(-0.5))


def test_small_angles_keep_their_digits():
    for tilt in (1e-12, 1e-9, 1e-5):
        geometry = ts.half_vector_geometry(at(tilt), at(0.4), at(0.4, np.pi))
        assert float(geometry.phi) == pytest.approx(tilt, abs=2e-16)
        y = np.sin(tilt / 2) ** 2
        assert torrance_sparrow.phi_squared(y) == pytest.approx(tilt**2, rel=1e-13)
    for phi in np.linspace(0.01, np.pi / 2, 50):
        assert torrance_sparrow.phi_squared(np.sin(phi / 2) ** 2) == pytest.approx(phi**2, rel=5e-15)


def test_masking_over_cos_r_equals_the_quotient_and_stays_finite_at_grazing_view():
    rng = np.random.default_rng(0)
    n, light, view = UP, at(0.3), np.stack([at(t, 1.0) for t in rng.uniform(0, 1.5, 50)])
    g = ts.half_vector_geometry(n, light, view)
    masking = np.clip(2 * g.cos_phi * np.minimum(g.cos_i, g.cos_r) / g.cos_q, 0, 1)  # eq. 13
    quotient = masking / g.cos_r
    np.testing.assert_allclose(ts.masking_over_cos_r(g.cos_phi, g.cos_i, g.cos_r, g.cos_q), quotient, rtol=1e-14)
    limit = ts.half_vector_geometry(n, light, np.array([1.0, 0.0, 1e-300]))
    assert float(ts.attenuation(limit, 1.45)) == pytest.approx(
        float(ts.fresnel(limit.cos_q, 1.45) * 2 * limit.cos_phi / limit.cos_q), rel=1e-12
    )


@pytest.mark.parametrize("tilt", [1e-3, 1e-6, 1e-9])
def test_grazing_light_and_view_against_fifty_digits(tilt):
    light, view = np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([-np.cos(tilt), 0, np.sin(tilt)])
    for light_k, view_k in ((light, view), (light, at(0.2)), (at(0.2), view), (light, at(np.pi / 2 - tilt, 2.0))):
        value = float(ts.specular(UP, light_k, view_k, beta=1.0, gamma=0.3, refractive_index=1.45))
        assert value == pytest.approx(float(exact_specular(UP, light_k, view_k, 0.3, 1.45)), rel=1e-6)
        assert specular_scalar(*UP, *light_k, *view_k, 0.3, 1.45) == pytest.approx(value, rel=1e-12)


def test_reciprocity_and_nothing_behind_the_surface():
    light, view, n = at(0.7, 0.2), at(1.1, 2.0), at(0.1, 1.0)
    one = ts.specular(n, light, view, beta=2.0, gamma=0.3, refractive_index=1.45) / (n @ light)
    two = ts.specular(n, view, light, beta=2.0, gamma=0.3, refractive_index=1.45) / (n @ view)
    assert float(one) == pytest.approx(float(two), rel=1e-13)
    for pair in ((-light, view), (light, -view), (light, -light)):
        assert float(ts.specular(n, *pair, beta=1.0, gamma=1.0, refractive_index=1.45)) == 0
        assert specular_scalar(*n, *pair[0], *pair[1], 1.0, 1.45) == 0


def test_float32_stays_float32_and_agrees():
    rng = np.random.default_rng(1)
    n, light, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal((0, 0, 3), size=(3, 500, 3)))
    wide = ts.specular(n, light, view, beta=1.0, gamma=0.3, refractive_index=1.45)
    narrow = ts.specular(*(v.astype(np.float32) for v in (n, light, view)), beta=1.0, gamma=0.3, refractive_index=1.45)
    assert narrow.dtype == np.float32
    np.testing.assert_allclose(narrow, wide, rtol=3e-5, atol=1e-6)


def test_shapes_broadcast():
    n = np.broadcast_to(UP, (4, 5, 3))
    lights = np.stack([at(0.2), at(0.4)])[:, None, None]
    assert ts.specular(n, lights, UP, beta=1.0, gamma=0.1, refractive_index=1.45).shape == (2, 4, 5)
