"""Smoothing of polariser series: slow references, known noise, edges, masks, colours, exposure times."""

import numpy as np
import pytest
from scipy.fft import dctn, idctn

from nishiki.polarisation import noise as noise_module
from nishiki.polarisation import smoothing
from nishiki.polarisation.noise import differences_of
from nishiki.polarisation.polarisation import components, sum_planes
from nishiki.polarisation.polariser_states import sums_of
from nishiki.polarisation.smoothing import smooth_differences, smooth_planes

BETA = np.array([0.4, 0.35, 0.45])
LAMP = np.array([0.8, 1.0, 0.7])
SLOPE, FLOOR = 1 / 20_000, 1e-6


def light(rows=160, columns=144):
    """Diffuse light with fine texture, specular light with a soft lobe, a sharp highlight and an edge."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:rows, :columns]
    texture = 1 + 0.3 * rng.uniform(-1, 1, (rows, columns, 1))
    diffuse = (0.1 + 0.5 * x / columns)[..., None] * texture * [0.6, 0.8, 0.5]
    specular = 0.06 * np.exp(-((x - 50) ** 2 + (y - 60) ** 2) / 900) + 0.2 * np.exp(
        -((x - 90) ** 2 + (y - 30) ** 2) / 4
    )
    specular = np.where(y + x / 2 > 150, 0.04, specular)
    return diffuse, specular[..., None] * LAMP


def intensity(diffuse, specular, state):
    """By optics: circular states, analyser angles before a lamp at 20 degrees, generator/analyser angles."""
    if state in ("off", "on"):
        return diffuse + specular if state == "off" else BETA * diffuse
    *generator, analyser = map(float, state.split("/"))
    turn = np.radians(analyser - (generator[0] if generator else 20.0))
    return specular * np.cos(turn) ** 2 + diffuse / 2


def noisy(values, rng, scale=1.0):
    """A photograph of an exposure shorter by `scale`, brought to the longest."""
    return values + rng.normal(size=values.shape) * np.sqrt(scale * SLOPE * values + scale**2 * FLOOR)


LAYOUTS = {
    "circular": ("off", "on"),
    "crossed": ("20", "110"),
    "linear": ("0", "45", "90", "135"),
    "uneven angles": ("3", "40", "77", "101", "160"),
    "pairs": ("0/0", "0/90", "45/45", "45/135"),
    "mueller": tuple(f"{g}/{a}" for g in (0, 60, 120) for a in (20, 80, 140)),
}


def series(states, seed=1, scales=None, shape=(160, 144)):
    """planes, sums, settings of `components`, truth."""
    diffuse, specular = light(*shape)
    rng = np.random.default_rng(seed)
    scales = np.ones(len(states)) if scales is None else scales
    photographs = [noisy(intensity(diffuse, specular, s), rng, k) for s, k in zip(states, scales, strict=True)]
    sums = sums_of(states)
    valid = np.ones(shape, bool)
    planes, _ = sum_planes(((each.astype(np.float32), valid) for each in photographs), sums.weights)
    return planes, sums, {"beta": BETA} if sums.method == "circular" else {}, (diffuse, specular)


def errors(planes, sums, rest, truth):
    """Root mean squares of diffuse and specular error."""
    view = components(planes, np.ones(planes.shape[1:3], bool), sums, **rest)
    return [
        float(np.sqrt(np.mean((each - true) ** 2)))
        for each, true in zip((view.diffuse, view.specular), truth, strict=True)
    ]


def smoothed(*arguments, **rest):
    """Planes and noise."""
    made = smooth_planes(*arguments, **rest)
    return made.planes, made.noise


def measured(noise):
    """Variance at 0.3 of full scale, mean of the channels."""
    return float(np.mean(noise.slope * 0.3 + noise.floor))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_both_parts_are_closer_to_the_truth(layout):
    planes, sums, rest, truth = series(LAYOUTS[layout])
    smooth, noise = smoothed(planes, np.ones(planes.shape[1:3], bool), sums, **rest)
    plain, better = errors(planes, sums, rest, truth), errors(smooth, sums, rest, truth)
    assert better[0] < 0.8 * plain[0]
    assert better[1] < 0.4 * plain[1]
    assert measured(noise) == pytest.approx(SLOPE * 0.3 + FLOOR, rel=0.2)


def slow_squares(q, variance, usable, colour):
    """`smooth_differences` square by square, with a general transform and an orthonormal basis by QR."""
    n, size = q.shape[2], smoothing.PATCH
    sums, weights = np.zeros(q.shape), np.zeros((*q.shape[:2], 1))
    down, across = ([*range(0, m - size + 1, smoothing.STEP), m - size] for m in q.shape[:2])
    for y in sorted(set(down)):
        for x in sorted(set(across)):
            place = np.s_[y : y + size, x : x + size]
            good = usable[place]
            if good.sum() < smoothing.FEWEST:
                continue
            sizes = np.sqrt(variance[place][good].mean(axis=0))
            values = np.where(good[..., None], q[place], q[place][good].mean(axis=0)) / sizes
            basis, _ = np.linalg.qr(np.column_stack([colour / sizes, *np.eye(n)]))
            # only the first axis is determined; a threshold on the others depends on the choice, so the kernel's own
            # reflection is rebuilt here
            first = basis[:, 0] * (1 if basis[0, 0] >= 0 else -1)
            mirror = (first + np.eye(n)[0] * (1 if first[0] >= 0 else -1))[:, None]
            basis = np.eye(n) - 2 * mirror @ mirror.T / (mirror.T @ mirror)
            coefficients = dctn(values, axes=(0, 1), norm="ortho") @ basis
            small = np.abs(coefficients) < np.sqrt(2 * np.log(size * size * n))
            small[0, 0, 0] = False
            coefficients[small] = 0
            back = idctn(coefficients @ basis.T, axes=(0, 1), norm="ortho") * sizes
            weight = 1 / ((~small).sum() * (sizes**2).sum())
            sums[place] += weight * back
            weights[place] += weight
    smooth = np.where((weights > 0) & usable[..., None], sums / np.where(weights > 0, weights, 1), q)
    reach = smoothing.FARTHEST * np.sqrt(variance)
    return np.clip(smooth, q - reach, q + reach)


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_squares_against_a_slow_reference(channels):
    rng = np.random.default_rng(channels)
    shape = (29, 34, channels)
    variance = rng.uniform(0.5, 2, shape)
    q = 3 * rng.normal(size=(29, 34, 1)).cumsum(axis=0) + rng.normal(size=shape) * np.sqrt(variance)
    usable = rng.random(shape[:2]) < 0.9
    usable[:9, :12] = False
    colour = rng.uniform(0.3, 1, channels)
    smooth = smooth_differences(q, variance, usable, colour)
    np.testing.assert_allclose(smooth, slow_squares(q, variance, usable, colour), atol=2e-4)
    q[~usable] = variance[~usable] = np.nan
    np.testing.assert_array_equal(smooth_differences(q, variance, usable, colour)[usable], smooth[usable])


@pytest.mark.parametrize("layout", ["circular", "crossed", "pairs", "mueller"])
def test_planes_are_the_most_likely_that_have_the_smoothed_difference(layout):
    """At single pixels: I' = I + C A' (A C A')^-1 (q' - A I), least squares with a constraint."""
    planes, sums, rest, _ = series(LAYOUTS[layout])
    smooth, noise = smoothed(planes, np.ones(planes.shape[1:3], bool), sums, **rest)
    kinds = differences_of(sums)
    rows = kinds.of_planes @ sums.weights
    for y, x, k in ((20, 30, 0), (77, 100, 1), (110, 9, 2)):
        of_planes = np.diag([1, 1 / BETA[k]]) if layout == "circular" else np.eye(len(planes))
        before, after = (of_planes @ each[:, y, x, k].astype(np.float64) for each in (planes, smooth))
        expected = noise_module._photographs_by_planes(sums) @ planes[:, y, x, k].astype(np.float64)
        covariance = np.diag(noise.slope[k] * np.maximum(expected, 0) + noise.floor[k])
        from_photographs = of_planes @ sums.weights
        row = kinds.of_planes @ from_photographs if layout == "circular" else rows
        gain = from_photographs @ covariance @ row.T @ np.linalg.inv(row @ covariance @ row.T)
        wanted = before + gain @ (kinds.of_planes @ (after - before))
        np.testing.assert_allclose(after, wanted, atol=2e-6)


def test_noise_of_shorter_exposures():
    """A state exposed a quarter as long: four times the slope, 16 times the floor, in its photograph only."""
    scales = np.array([1.0, 4.0])
    planes, sums, rest, truth = series(("off", "on"), scales=scales)
    good = np.ones(planes.shape[1:3], bool)
    smooth, noise = smoothed(planes, good, sums, scales=scales, **rest)
    assert measured(noise) == pytest.approx(SLOPE * 0.3 + FLOOR, rel=0.2)
    unaware, _ = smoothed(planes, good, sums, **rest)
    assert errors(smooth, sums, rest, truth)[0] < 0.95 * errors(unaware, sums, rest, truth)[0]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_without_noise_nothing_is_lost(layout):
    diffuse, specular = light()
    states = LAYOUTS[layout]
    sums = sums_of(states)
    good = np.ones(diffuse.shape[:2], bool)
    photographs = ((intensity(diffuse, specular, s).astype(np.float32), good) for s in states)
    planes, _ = sum_planes(photographs, sums.weights)
    rest = {"beta": BETA} if sums.method == "circular" else {}
    smooth, _ = smoothed(planes, good, sums, **rest)
    np.testing.assert_allclose(smooth, planes, atol=3e-6)


def test_sharp_highlight_and_fine_texture_stay():
    planes, sums, rest, (diffuse, specular) = series(("off", "on"))
    smooth, _ = smoothed(planes, np.ones(planes.shape[1:3], bool), sums, **rest)
    view = components(smooth, np.ones(planes.shape[1:3], bool), sums, **rest)
    assert view.specular[30, 90, 1] == pytest.approx(specular[30, 90, 1], rel=0.05)
    error = view.diffuse - diffuse
    texture = diffuse - diffuse.mean(axis=0)
    assert abs(np.sum(error * texture) / np.sum(texture**2)) < 0.002  # none of the texture is taken away


def test_doubtful_values_are_below_their_own_noise():
    """Noise grows with brightness: one threshold for the picture would call the bright parts doubtful."""
    planes, sums, rest, _ = series(("off", "on"))
    good = np.ones(planes.shape[1:3], bool)
    assert smooth_planes(planes, good, sums, **rest).doubtful < 0.003
    assert smooth_planes(planes, good, sums, beta=0.8 * BETA).doubtful > 0.3
    amplitudes, sums, rest, _ = series(LAYOUTS["linear"])
    assert smooth_planes(amplitudes, good, sums).doubtful is None


def test_reflections_of_another_colour_stay():
    """A gilded half and a silver half."""
    diffuse, specular = light()
    specular = specular * np.where(np.arange(144)[:, None] < 72, [1.0, 0.7, 0.3], 1.0)
    rng = np.random.default_rng(3)
    sums = sums_of(("off", "on"))
    good = np.ones(diffuse.shape[:2], bool)
    photographs = [noisy(intensity(diffuse, specular, s), rng).astype(np.float32) for s in ("off", "on")]
    planes, _ = sum_planes(((each, good) for each in photographs), sums.weights)
    smooth, _ = smoothed(planes, good, sums, beta=BETA)
    plain = errors(planes, sums, {"beta": BETA}, (diffuse, specular))
    better = errors(smooth, sums, {"beta": BETA}, (diffuse, specular))
    assert better[0] < 0.7 * plain[0]
    assert better[1] < 0.4 * plain[1]


def test_pixels_that_take_no_part_stay_and_do_not_count():
    planes, sums, rest, _ = series(("off", "on"))
    usable = np.ones(planes.shape[1:3], bool)
    usable[:, 70:] = False
    smooth, _ = smoothed(planes, usable, sums, **rest)
    np.testing.assert_array_equal(smooth[:, :, 70:], planes[:, :, 70:])
    assert (smooth[:, :, :70] != planes[:, :, :70]).mean() > 0.9
    other = planes.copy()
    other[:, :, 70:] = np.random.default_rng(0).uniform(0, 9, other[:, :, 70:].shape)
    other[:, 5, 80] = np.nan
    again, _ = smoothed(other, usable, sums, **rest)
    np.testing.assert_array_equal(again[:, :, :70], smooth[:, :, :70])


@pytest.mark.parametrize("workers", ["1", "3"])
def test_bands_and_threads_give_the_same(workers, monkeypatch):
    planes, sums, rest, _ = series(("off", "on"))
    good = np.ones(planes.shape[1:3], bool)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    before, _ = smoothed(planes, good, sums, **rest)
    monkeypatch.setenv("NUMBA_NUM_THREADS", workers)
    monkeypatch.setattr(smoothing, "BAND", 23)
    after, _ = smoothed(planes, good, sums, **rest)
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_little_to_work_with():
    """No noise measured: the planes come back as they are."""
    sums = sums_of(("off", "on"))
    small = np.ones((2, 5, 40, 3), np.float32)
    assert smoothed(small, np.ones((5, 40), bool), sums, beta=BETA)[0] is small
    flat = np.ones((2, 40, 40, 3), np.float32)
    for usable in (np.ones((40, 40), bool), np.zeros((40, 40), bool)):
        same, noise = smoothed(flat, usable, sums, beta=BETA)
        assert same is flat
        assert noise is None
    one = sums_of(("",))
    assert smoothed(flat[:1], np.ones((40, 40), bool), one)[0].base is flat


def test_beta_that_is_unknown_divides_nothing():
    planes, sums, _, _ = series(("off", "on"))
    beta = np.broadcast_to(BETA, planes.shape[1:]).copy()
    beta[40:44, 50:60] = np.nan
    good = np.isfinite(beta).all(axis=-1)
    smooth, _ = smoothed(planes, good, sums, beta=beta)
    assert np.isfinite(smooth).all()
    np.testing.assert_array_equal(smooth[:, ~good], planes[:, ~good])


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_equivariant_under_exposure(scale):
    planes, sums, rest, _ = series(("off", "on"))
    good = np.ones(planes.shape[1:3], bool)
    plain, _ = smoothed(planes, good, sums, **rest)
    scaled, _ = smoothed((planes * scale).astype(np.float32), good, sums, **rest)
    np.testing.assert_allclose(scaled / scale, plain, atol=3e-6)
