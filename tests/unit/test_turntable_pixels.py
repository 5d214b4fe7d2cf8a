"""Kernels between texels and pixels against slow, obvious ones."""

import numpy as np

from nishiki.render.object.pixels import bilinear, extend, mix
from nishiki.stages.evaluate.object import difference, structural_similarity, summary


def slow_look_up(texture, s, t):
    size = texture.shape[0]
    i, j = min(int(s), size - 2), min(int(t), size - 2)
    y, x = s - i, t - j
    return (
        texture[i, j] * (1 - y) * (1 - x)
        + texture[i, j + 1] * (1 - y) * x
        + texture[i + 1, j] * y * (1 - x)
        + texture[i + 1, j + 1] * y * x
    )


def test_look_up_is_bilinear_up_to_the_border():
    rng = np.random.default_rng(0)
    texture = rng.normal(size=(5, 5, 3)).astype(np.float32)
    s = np.concatenate([rng.uniform(0, 4, 40), [0, 4, 4, 0]]).astype(np.float32)
    t = np.concatenate([rng.uniform(0, 4, 40), [0, 4, 0, 4]]).astype(np.float32)
    chosen, place, weights = bilinear(s, t, 5)
    assert len(set(chosen.tolist())) == len(chosen) == place.max() + 1
    out = np.einsum("kn,knc->nc", weights, texture.reshape(-1, 3)[chosen][place])
    for p in range(len(s)):
        np.testing.assert_allclose(out[p], slow_look_up(texture.astype(np.float64), s[p], t[p]), atol=1e-5)
    assert bilinear(s, t, 1)[0].tolist() == [0]


def slow_mix(residual, visible, weights):
    out = np.zeros(residual.shape[1:])
    for j in range(residual.shape[1]):
        share = weights * visible[:, j] if (weights * visible[:, j]).sum() > 1e-6 else weights
        out[j] = sum(w * values for w, values in zip(share / share.sum(), residual[:, j], strict=True))
    return out


def test_mixing_heeds_what_each_view_sees():
    rng = np.random.default_rng(1)
    residual = rng.normal(size=(4, 49, 2)).astype(np.float32)
    visible = np.clip(rng.uniform(-1, 3, (4, 49)), 0, 1).astype(np.float32)
    visible[:, 0], visible[:, 8] = 0, 1
    weights = np.float32([0, 0.5, 0.3, 0.2])
    np.testing.assert_allclose(mix(residual, visible, weights), slow_mix(residual, visible, weights), atol=1e-5)


def test_the_rim_continues_the_surface():
    y, x = np.mgrid[:40, :40]
    disc = (y - 20) ** 2 + (x - 20) ** 2 < 12**2
    ramp = (0.2 + 0.01 * x + 0.005 * y)[..., None].astype(np.float32)
    values = np.where(disc[..., None], ramp, 0).astype(np.float32)
    wide = values.copy()
    reached = extend(wide, disc, rings=2)
    np.testing.assert_array_equal(wide[disc], values[disc])
    rim = reached & ~disc
    distance = np.sqrt((y - 20.0) ** 2 + (x - 20) ** 2)
    assert rim[(distance >= 12) & (distance < 13.4)].all()
    assert not rim[distance > 15.5].any()
    assert np.abs(wide[rim] - ramp[rim]).max() < 0.02
    assert not wide[~reached].any()
    same = values.copy()
    assert not extend(same, np.zeros_like(disc), rings=2).any()
    np.testing.assert_array_equal(same, values)
    np.testing.assert_array_equal(extend(same, disc, rings=0), disc)


def test_the_rim_stays_inside_the_picture():
    values, covered = np.ones((3, 5, 1), np.float32), np.zeros((3, 5), bool)
    covered[0, 0] = covered[2, 4] = True
    assert extend(values, covered, rings=9).all()
    np.testing.assert_allclose(values, 1)


def test_psnr_of_known_noise():
    rng = np.random.default_rng(2)
    photograph = rng.uniform(0, 1, (60, 50, 3)).astype(np.float32)
    inside = np.zeros((60, 50), bool)
    inside[10:50, 5:45] = True
    covered = inside.copy()
    covered[10, :] = False
    wrong = photograph + np.float32(0.01)
    wrong[~inside] = 99
    every = np.ones_like(inside)
    found = difference(wrong, photograph, inside, covered, every)
    assert abs(found["psnr_db"] - 40) < 1e-3
    assert (found["pixels"], found["uncovered_pixels"], found["superfluous_pixels"]) == (1600, 40, 0)
    beyond = covered.copy()
    beyond[20, 45] = True
    wide = difference(wrong, photograph, inside, beyond, every)
    assert (wide["pixels"], wide["superfluous_pixels"]) == (1601, 1)
    assert wide["psnr_db"] < 0  # a pixel of 99 where the photograph shows the background
    assert difference(wrong, photograph, inside, beyond, inside) == found
    both = summary([found, {**found, "psnr_db": 30.0}, {**found, "psnr_db": None}])
    assert abs(both["mean_psnr_db"] - 35) < 1e-3
    assert abs(both["worst_psnr_db"] - 30) < 1e-3
    assert both["views"] == 2
    assert summary([])["pooled_psnr_db"] is None


def test_similarity_is_one_for_equal_pictures_and_falls_with_noise():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:64, :64] / 64
    photograph = np.stack([y, x, 0.5 + 0.3 * np.sin(9 * x)], axis=-1).astype(np.float32)
    inside = (y - 0.5) ** 2 + (x - 0.5) ** 2 < 0.16
    assert structural_similarity(photograph, photograph, inside) > 1 - 1e-9
    little, much = (
        structural_similarity(
            photograph + np.float32(s) * rng.normal(size=photograph.shape).astype(np.float32), photograph, inside
        )
        for s in (0.01, 0.1)
    )
    assert 0 < much < little < 1
    assert structural_similarity(photograph, photograph, np.zeros_like(inside)) is None
