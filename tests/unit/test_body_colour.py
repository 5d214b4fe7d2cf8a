"""Channels weighted by each pixel's colour: against a slow reference, and what it promises of grey, gloss and scale."""

import numpy as np
import pytest

from nishiki.photometric import body
from nishiki.photometric.body import body_intensity, shading_of_mean
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.normal_kernels import PRIOR, WIDTH
from nishiki.photometric.solve import estimate_normals
from nishiki.stages.normals.parcel import WEIGHTED

DARK_RED = np.array([0.12, 0.015, 0.01])


def reference(samples, valid):
    """One pixel, samples (lights, channels), by the equations of the module, in float64."""
    mean = samples.mean(axis=1)
    lit = valid & (mean > 0)
    lower = mean[lit & (mean <= mean[lit].mean())].mean() if lit.any() else 0.0
    lit &= mean >= body.LIT * lower
    direction = (samples - mean[:, None])[lit].sum(axis=0)
    if lit.sum() < body.AT_LEAST or np.linalg.norm(direction) == 0:
        return mean
    across = samples @ (direction / np.linalg.norm(direction)) / np.sqrt(samples.shape[1])
    kept, saturation = lit, 0.0
    for _ in range(body.CONCENTRATIONS + 1):
        kept = lit & (across >= saturation * mean)
        saturation = max(across[kept].sum() / mean[kept].sum(), 0.0)
    gloss = np.clip((mean - across / saturation)[lit] / lower, 0, 1)
    square, channels = saturation**2, samples.shape[1]
    rest = np.sum((samples - mean[:, None])[lit] ** 2) - channels * np.sum(across[lit] ** 2)
    noise = max(rest, 0) / lower**2 / max((lit.sum() - 1) * max(channels - 2, 1), 1)
    unsure = body.UNSURE * noise * (1 + 1 / square) / channels
    variance = max(np.mean(gloss**2) - unsure, 0)
    t = variance / (variance + body.ERROR**2 + noise) * square / (square + body.FAINT**2)
    return ((1 - t) * mean + saturation * across) / (1 - t + square)


def lamps(count=24, cone=50.0):
    k = np.arange(count) + 0.5
    z = 1 - k / count * (1 - np.cos(np.radians(cone)))
    angle = k * np.pi * (3 - np.sqrt(5))
    return np.column_stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])


def glossy(colour, pixels=300, strength=0.08, seed=1):
    """Dichromatic samples (lights, 1, pixels, C) of tilted facets with a broad white lobe, and their normals."""
    random = np.random.default_rng(seed)
    normals = np.column_stack([random.normal(0, 0.2, (pixels, 2)), np.ones(pixels)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lights = lamps()
    halves = lights + np.array([0.0, 0.0, 1.0])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    body = np.maximum(lights @ normals.T, 0)
    lobe = strength * np.maximum(halves @ normals.T, 0) ** 40
    samples = body[..., None] * colour + lobe[..., None]
    samples += random.normal(0, 2e-4, samples.shape)
    return np.float32(samples[:, None]), normals, lights


def angle(found, truth):
    return np.degrees(np.arccos(np.clip(np.sum(found * truth, axis=-1), -1, 1))).mean()


@pytest.mark.parametrize("channels", [2, 3, 7])
def test_agrees_with_the_reference(channels):
    colour = np.linspace(0.1, 0.01, channels)
    samples, _, _ = glossy(colour, pixels=70)
    valid = np.random.default_rng(2).uniform(size=samples.shape[:3]) > 0.1
    found = body_intensity(samples, valid)
    for p in range(samples.shape[2]):
        expected = reference(samples[:, 0, p].astype(np.float64), valid[:, 0, p])
        assert found[:, 0, p] == pytest.approx(expected, rel=2e-3, abs=2e-5)


def test_grey_bodies_have_the_mean_of_the_channels():
    samples, _, _ = glossy(np.array([0.1, 0.1, 0.1]))
    mean = samples.mean(axis=-1)
    assert np.abs(body_intensity(samples, np.ones(mean.shape, bool)) - mean).max() < 0.02 * mean.max()


def test_one_channel_and_black_pixels_are_left_as_they_are():
    samples = np.random.default_rng(3).uniform(size=(8, 2, 3, 1)).astype(np.float32)
    assert np.array_equal(body_intensity(samples, np.ones(samples.shape[:3], bool)), samples[..., 0])
    assert not body_intensity(np.zeros((8, 2, 3, 3), np.float32), np.ones((8, 2, 3), bool)).any()


def test_gloss_counts_less_and_normals_are_better_on_a_dark_coloured_body():
    samples, normals, lights = glossy(DARK_RED)
    valid = np.ones(samples.shape[:3], bool)
    mean = samples.mean(axis=-1)
    usable = select_diffuse(mean, lights, valid=valid).usable
    before = estimate_normals(mean, lights, usable=usable, valid=valid).normals[0]
    after = estimate_normals(body_intensity(samples, valid), lights, usable=usable, valid=valid).normals[0]
    assert angle(after, normals) < 0.5 * angle(before, normals)


def test_noise_on_dark_matt_paint_is_not_taken_for_gloss():
    """With a constant error in place of the samples' noise the angle is twice that of the mean."""
    samples, normals, lights = glossy(np.array([0.012, 0.008, 0.007]), strength=0)
    samples += np.random.default_rng(4).normal(0, 8e-4, samples.shape).astype(np.float32)
    valid = np.ones(samples.shape[:3], bool)
    mean, weighted = (
        angle(estimate_normals(values, lights, valid=valid, solver="least_squares").normals[0], normals)
        for values in (samples.mean(axis=-1), body_intensity(samples, valid))
    )
    assert weighted < 1.15 * mean


def test_every_radiometric_scale_and_every_tile_gives_the_same():
    samples, _, _ = glossy(DARK_RED, pixels=90)
    valid = np.ones(samples.shape[:3], bool)
    whole = body_intensity(samples, valid)
    assert np.array_equal(body_intensity(samples[:, :, 37:], valid[:, :, 37:]), whole[:, :, 37:])
    for scale in (2.0**-60, 2.0**60):
        assert np.allclose(body_intensity(samples * np.float32(scale), valid) / scale, whole, rtol=1e-5, atol=1e-9)


def test_samples_that_are_not_valid_change_no_other():
    samples, _, _ = glossy(DARK_RED, pixels=40)
    valid = np.ones(samples.shape[:3], bool)
    valid[5] = False
    found = body_intensity(samples, valid)
    samples[5] = np.nan
    others = np.arange(len(samples)) != 5
    assert np.array_equal(body_intensity(samples, valid)[others], found[others])


def dense_terms(mean, usable, lights, normal, noise=0.003):
    """Body shading (a, b, d) of one pixel's normal by dense penalised least squares, samples chosen again once."""
    halves = lights + np.array([0, 0, 1.0])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    c, x = lights @ normal, np.maximum(halves @ normal, 1e-3)
    design = np.stack([c, c**2, c * x**8], axis=1)
    kept = usable & (c > 0)
    for _ in range(2):
        part, values = design[kept], mean[kept].astype(np.float64)
        albedo = part[:, 0] @ values / (part[:, 0] @ part[:, 0])
        scatter = np.mean((values - albedo * part[:, 0]) ** 2) / albedo**2
        prior = PRIOR * kept.sum() / 3 + scatter / WIDTH**2
        terms = np.linalg.solve(part.T @ part + np.diag([0, prior, prior]), part.T @ values)
        limit = 3 * (np.sqrt(np.sum((values - part @ terms) ** 2) / (kept.sum() - 3)) + noise * albedo)
        last, kept = kept, (np.abs(mean - design @ terms) <= limit) & (c > 0)
    weights = last * c**2
    return terms / (weights @ (terms[0] + terms[1] * c + terms[2] * x**8) / weights.sum())


def test_coloured_pixels_have_the_shading_of_the_mean_and_grey_ones_keep_theirs():
    red, _, lights = glossy(DARK_RED, pixels=75)
    grey, _, _ = glossy(np.full(3, 0.1), pixels=30)
    samples = np.concatenate([red, np.repeat(grey.mean(axis=-1, keepdims=True), 3, axis=-1)], axis=2)
    mean, valid = samples.mean(axis=-1), np.ones(samples.shape[:3], bool)
    usable = select_diffuse(mean, lights, valid=valid).usable
    intensity = body_intensity(samples, valid)
    field = estimate_normals(intensity, lights, usable=usable, valid=valid)
    found = shading_of_mean(intensity, mean, lights, field, usable=usable, valid=valid, least_change=WEIGHTED)
    for p in range(75):
        expected = dense_terms(mean[:, 0, p], usable[:, 0, p], lights, field.normals[0, p].astype(np.float64))
        np.testing.assert_allclose(found[0, p], expected, atol=2e-3)
    assert np.array_equal(found[:, 75:], field.shading[:, 75:])
