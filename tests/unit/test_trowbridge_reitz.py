"""The lobe of Trowbridge and Reitz: its facets fill the plane, and both forms are the published ones."""

import numpy as np
import pytest

from nishiki.brdf.slopes import anisotropic_lobe, isotropic_lobe, widened_roughness


def hemisphere(count=400):
    """Unit vectors (count^2, 3) and the solid angle of each, finer towards the normal."""
    edges = np.linspace(0, 1, count + 1) ** 2 * np.pi / 2
    polar, turn = (edges[:-1] + edges[1:]) / 2, (np.arange(count) + 0.5) / count * 2 * np.pi
    area = (np.cos(edges[:-1]) - np.cos(edges[1:])) * 2 * np.pi / count
    polar, turn = np.meshgrid(polar, turn, indexing="ij")
    vectors = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    return vectors.reshape(-1, 3), np.repeat(area, count)


def smith(z, cosine, alpha):
    """G1 of Smith for isotropic facets (Walter et al. 2007, eq. 34)."""
    tangent = np.sqrt(1 - cosine**2) / cosine
    return 2 / (1 + np.sqrt(1 + (alpha * tangent) ** 2)) * (z > 0)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_the_areas_of_the_facets_add_up_to_that_of_the_plane(alpha):
    h, area = hemisphere()
    z = h[:, 2]
    masked = isotropic_lobe(z, 1.0, 1.0, alpha) * 4  # V is 1 / 4 along the normal
    assert np.sum(masked * z * area) == pytest.approx(1, abs=2e-3)
    up = np.broadcast_to([0, 0, 1.0], h.shape)
    narrow = anisotropic_lobe(h, up, up, alpha, alpha / 2) * 4
    assert np.sum(narrow * z * area) == pytest.approx(1, abs=2e-3)


def test_the_isotropic_lobe_is_that_of_walter():
    alpha, light, view = 0.4, np.array([0.6, 0, 0.8]), np.array([-0.3, 0.4, np.sqrt(0.75)])
    half = (light + view) / np.linalg.norm(light + view)
    tangent = np.tan(np.arccos(half[2]))
    d = alpha**2 / (np.pi * half[2] ** 4 * (alpha**2 + tangent**2) ** 2)  # Walter et al. (2007), eq. 33
    g = smith(1, light[2], alpha) * smith(1, view[2], alpha)
    expected = d * g / (4 * light[2] * view[2])
    assert isotropic_lobe(half[2], light[2], view[2], alpha) == pytest.approx(expected, rel=1e-12)


def test_no_lobe_reflects_more_light_than_it_gets():
    light, area = hemisphere(200)
    view = np.array([np.sin(0.5), 0, np.cos(0.5)])
    half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
    separate = isotropic_lobe(half[:, 2], light[:, 2], view[2], 0.5)
    correlated = anisotropic_lobe(half, light, np.broadcast_to(view, light.shape), 0.5, 0.5)
    shares = [np.sum(lobe * light[:, 2] * area) for lobe in (separate, correlated)]
    assert 0.6 < shares[0] < shares[1] < 1  # facets that the light misses, a view near it misses too


@pytest.mark.parametrize(("roughness", "deviation"), [(0.3, 0.03), (0.3, 0.06), (0.5, 0.2)])
def test_a_widened_lobe_is_as_high_as_the_mean_over_facets_of_other_slopes(roughness, deviation):
    slopes = deviation * np.random.default_rng(0).standard_normal((200_000, 2))
    cosine = 1 / np.sqrt(1 + np.sum(slopes**2, axis=1))  # of the normal's half vector with each facet
    narrow, wide = roughness**2, widened_roughness(roughness, deviation**2) ** 2
    mean = isotropic_lobe(cosine, 1.0, 1.0, narrow).mean()
    assert isotropic_lobe(1.0, 1.0, 1.0, wide) == pytest.approx(mean, rel=0.26)
    assert isotropic_lobe(1.0, 1.0, 1.0, narrow) > 1.1 * mean
    assert widened_roughness(roughness, 0.0) == pytest.approx(roughness)
    assert widened_roughness(roughness, 9.0) == 1
