"""Gloss, body and pigments of the simulator against slow, obvious forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nishiki.simulate.painting.settings import (
    INNER_REFLECTION,
    OUTER_REFLECTION,
    PIGMENTS,
    REGIONS,
    grey,
    make_palette,
    mixture,
)
from nishiki.simulate.reflection import fresnel, ggx_gloss, rough_body

cosines = st.floats(1e-6, 1.0)


def slow_fresnel(cosine, index):
    """Snell's law, then the amplitudes of both polarisations."""
    inside = math.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return 0.5 * (s * s + p * p)


def slow_gloss(light, view, alpha, index):
    """π D F G/(4 n·l n·v) n·l with G from the two Smith lambdas, normal = z."""
    half = light + view
    half = half / np.linalg.norm(half)
    tangent_2 = (1 - half[2] ** 2) / half[2] ** 2
    d = 1.0 / (math.pi * alpha**2 * half[2] ** 4 * (1 + tangent_2 / alpha**2) ** 2)

    def smith_lambda(w):
        return 0.5 * (math.sqrt(1 + alpha**2 * (1 - w[2] ** 2) / w[2] ** 2) - 1)

    g = 1.0 / (1.0 + smith_lambda(light) + smith_lambda(view))
    f = slow_fresnel(float(half @ view), index)
    return math.pi * d * f * g / (4 * light[2] * view[2]) * light[2]


def direction(theta, phi):
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


def test_fresnel_known_values_and_slow_form():
    assert fresnel(1.0, 1.5) == pytest.approx(0.04, rel=1e-12)
    assert fresnel(0.0, 1.5) == pytest.approx(1.0, rel=1e-12)
    brewster = math.cos(math.atan(1.5))
    assert fresnel(brewster, 1.5) == pytest.approx(0.5 * ((1.5**2 - 1) / (1.5**2 + 1)) ** 2, rel=1e-12)
    for cosine in np.linspace(0.01, 1, 37):
        assert fresnel(cosine, 1.37) == pytest.approx(slow_fresnel(cosine, 1.37), rel=1e-11)


def test_gloss_equals_slow_form():
    random = np.random.default_rng(3)
    for _ in range(400):
        light = direction(random.uniform(0, 1.5), random.uniform(0, 6.3))
        view = direction(random.uniform(0, 1.5), random.uniform(0, 6.3))
        alpha, index = random.uniform(0.02, 1.0), random.uniform(1.2, 2.0)
        half = (light + view) / np.linalg.norm(light + view)
        fast = ggx_gloss(light[2], view[2], half[2], float(half @ view), alpha, index)
        assert fast == pytest.approx(slow_gloss(light, view, alpha, index), rel=1e-10)


@pytest.mark.parametrize("alpha", [0.11, 0.42])
def test_gloss_is_reciprocal_and_loses_energy(alpha):
    a, b = direction(0.4, 0.1), direction(1.2, 2.0)
    half = (a + b) / np.linalg.norm(a + b)
    cosine = float(half @ b)
    forth = ggx_gloss(a[2], b[2], half[2], cosine, alpha, 1.5) / a[2]
    assert forth == pytest.approx(ggx_gloss(b[2], a[2], half[2], cosine, alpha, 1.5) / b[2], rel=1e-12)
    # Light along `a` spread over all views: albedo = ∫ π f cosθ_v dω/π, midpoint rule.
    theta = (np.arange(400) + 0.5) / 400 * math.pi / 2
    phi = (np.arange(400) + 0.5) / 400 * 2 * math.pi
    for light in (direction(0.0, 0.0), direction(0.8, 0.0), direction(1.3, 0.0)):
        total = 0.0
        for t in theta:
            views = np.stack(
                [math.sin(t) * np.cos(phi), math.sin(t) * np.sin(phi), np.full(phi.shape, math.cos(t))], axis=1
            )
            halves = light + views
            halves /= np.linalg.norm(halves, axis=1, keepdims=True)
            for view, h in zip(views[::4], halves[::4], strict=True):
                gloss = ggx_gloss(light[2], view[2], h[2], float(h @ view), alpha, 1.5) / light[2]
                total += gloss / math.pi * math.cos(t) * math.sin(t)
        total *= (math.pi / 2 / 400) * (2 * math.pi / 100)
        surface = slow_fresnel(light[2], 1.5)
        assert total <= 1.0
        if light[2] == 1.0:  # facets beyond 45° send their light into the surface: tan²/(α² + tan²) of them do not
            assert 0.85 / (1 + alpha**2) < total / surface < 1.05


@given(n_l=cosines, n_v=cosines, n_h=cosines, v_h=cosines, alpha=st.floats(1e-3, 1.0), index=st.floats(1.001, 4.0))
def test_gloss_is_finite_everywhere(n_l, n_v, n_h, v_h, alpha, index):
    value = ggx_gloss(n_l, n_v, n_h, v_h, alpha, index)
    assert math.isfinite(value)
    assert value >= 0.0


def test_gloss_is_dark_behind_the_surface():
    assert ggx_gloss(-0.1, 0.5, 0.5, 0.5, 0.1, 1.5) == 0.0
    assert ggx_gloss(0.5, 0.0, 0.5, 0.5, 0.1, 1.5) == 0.0


def test_body_is_lambert_along_the_normal_and_darkens_towards_grazing():
    assert rough_body(1.0, 1.0, 1.0, 0.2, 1.5) == pytest.approx(1.0, rel=1e-14)
    assert rough_body(0.3, 1.0, 0.3, 0.2, 1.0) == pytest.approx(1.0, rel=1e-14)  # without a surface: no change
    expected = (1 - slow_fresnel(0.5, 1.5)) / 0.96
    assert rough_body(0.5, 1.0, 0.5, 0.2, 1.5) == pytest.approx(expected, rel=1e-12)


def test_body_equals_slow_oren_nayar():
    random = np.random.default_rng(4)
    for _ in range(200):
        theta_l, theta_v, phi = random.uniform(0, 1.5), random.uniform(0, 1.5), random.uniform(0, 6.3)
        light, view = direction(theta_l, phi), direction(theta_v, 0.0)
        sigma = random.uniform(0.05, 0.6)
        a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
        b = 0.45 * sigma**2 / (sigma**2 + 0.09)
        spread = math.sin(max(theta_l, theta_v)) * math.tan(min(theta_l, theta_v))
        expected = (a + b * max(0.0, math.cos(phi)) * spread) / a
        value = rough_body(light[2], view[2], float(light @ view), sigma, 1.0)
        assert value == pytest.approx(expected, rel=1e-9)


def test_thick_layer_solves_kubelka_munk():
    wavelengths = np.array([420.0, 550.0, 680.0])
    white, black = PIGMENTS["white"], PIGMENTS["black"]
    for share in (0.0, 0.01, 0.5, 1.0):
        seen = mixture({"white": 1 - share, "black": share}, wavelengths)
        inside = seen / ((1 - OUTER_REFLECTION) * (1 - INNER_REFLECTION) + INNER_REFLECTION * seen)
        absorbed, scattered = (
            (1 - share) * getattr(white, name)(wavelengths) + share * getattr(black, name)(wavelengths)
            for name in ("absorption", "scatter")
        )
        assert (1 - inside) ** 2 / (2 * inside) == pytest.approx(absorbed / scattered, rel=1e-9)


def test_grey_hits_its_reflectance():
    for target in (0.02, 0.2, 0.5, 0.8):
        assert mixture(grey(target), np.array([550.0]))[0] == pytest.approx(target, rel=1e-6)


def test_paints_are_physical_smooth_and_various():
    nm = np.arange(400.0, 701.0, 5.0)
    palette = make_palette(nm, alpha=0.11, seed=1)
    assert len(REGIONS) >= 24
    assert palette.spectra.shape == (palette.region.size, 61)
    assert palette.region.size <= 256  # labels are bytes
    assert palette.spectra.min() > 0.0
    assert palette.spectra.max() < 1.0
    assert np.abs(np.diff(palette.spectra, axis=1)).max() < 0.16  # no line spectra
    assert palette.spectra[:, 30].max() > 0.8  # a white
    assert palette.spectra.max(axis=1).min() < 0.03  # a black
    chroma = palette.spectra.max(axis=1) - palette.spectra.min(axis=1)
    assert (chroma > 0.3).sum() >= 24
    assert np.linalg.matrix_rank(palette.spectra, tol=0.05 * np.linalg.norm(palette.spectra, 2)) > 3
    assert np.ptp(palette.roughness) > 0.02
    for name, pigment in PIGMENTS.items():
        assert (pigment.absorption(nm) > 0).all(), name
