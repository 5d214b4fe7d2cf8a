"""Separation by polarisation: slow references by optics, extreme states, negative values, white boards."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.errors import UserError
from nishiki.polarisation.polarisation import (
    Components,
    ComponentWriter,
    SeparatedView,
    board_ratio,
    common_phase,
    components,
    reflected_sense,
    sum_planes,
)
from nishiki.polarisation.polariser_states import (
    Arm,
    design_matrix,
    equal_steps,
    polariser,
    retarder,
    solvable,
    sums_of,
)
from nishiki.polarisation.series import Thinned, diagnose, noise_of, statistics_of
from nishiki.stages.polarise import OUTPUTS

SHAPE = (13, 17, 3)


def parts(seed=0, shape=SHAPE):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.05, 1, shape), rng.uniform(0, 2, shape) * (rng.random(shape) < 0.6)


def separate(states, photograph, *, noise=0.0, seed=1, **rest):
    """Photographs by photograph(state) -> (rows, columns, channels), through the sums."""
    rng = np.random.default_rng(seed)
    sums = sums_of(states, **{k: rest.pop(k) for k in ("generator", "analyser", "method") if k in rest})
    series = [(photograph(state) + rng.normal(0, noise, SHAPE)).astype(np.float32) for state in sums.states]
    planes, valid = sum_planes(((values, np.ones(SHAPE[:2], bool)) for values in series), sums.weights)
    return components(planes, valid, sums, **rest), sums, planes


def surface_intensity(diffuse, specular, generator_deg, analyser_deg, *, mirror_deg=0.0):
    """Jones calculus, nothing shared with the code: unit linearly polarised lamp; the specular part keeps its field,
    the diffuse one is the mean over all directions of vibration. Angles seen from the camera's side."""
    field = np.array([np.cos(np.radians(generator_deg)), np.sin(np.radians(generator_deg))])
    analyser = np.array([np.cos(np.radians(analyser_deg)), np.sin(np.radians(analyser_deg))])
    return specular * (analyser @ field) ** 2 + diffuse * 0.5


@pytest.mark.parametrize(
    "states",
    [
        ("0/0", "0/90"),
        ("0/0", "0/90", "45/45", "45/135"),
        ("30/30", "30/-60", "30/120", "75/75", "75/165", "10/40"),
        ("90/0", "90/90"),
    ],
)
def test_parallel_and_crossed_pairs(states):
    diffuse, specular = parts()
    found, sums, _ = separate(states, lambda s: surface_intensity(diffuse, specular, *map(float, s.split("/"))))
    assert sums.method == "pairs"
    np.testing.assert_allclose(found.diffuse, diffuse, atol=2e-6)
    np.testing.assert_allclose(found.specular, specular, atol=2e-6)


@pytest.mark.parametrize(
    "states", [("0", "60", "120"), ("0", "45", "90", "135"), ("3", "40", "77", "101", "160"), ("0", "1", "90", "-20")]
)
@pytest.mark.parametrize("phase", [None, 25.0])
def test_analyser_angles(states, phase):
    diffuse, specular = parts(2)
    at = None if phase is None else np.radians(phase)
    found, sums, planes = separate(states, lambda s: surface_intensity(diffuse, specular, 25.0, float(s)), phase=at)
    assert sums.method == "linear"
    np.testing.assert_allclose(found.diffuse, diffuse, atol=1e-4 * sums.condition)
    np.testing.assert_allclose(found.specular, specular, atol=1e-4 * sums.condition)
    angle, agreement = common_phase(planes, found.valid)
    assert np.degrees(angle) == pytest.approx(25, abs=0.01 * sums.condition)
    assert agreement > 0.999


def test_analyser_angles_against_a_slow_fit_of_the_cosine():
    """Noisy samples of one pixel; the sums give the least-squares a, b, psi0 of a general optimiser."""
    from scipy.optimize import least_squares

    angles = np.array([0, 20, 50, 85, 110, 150.0])
    rng = np.random.default_rng(4)
    samples = 1.3 + 0.4 * np.cos(2 * np.radians(angles - 33)) + rng.normal(0, 0.05, 6)
    sums = sums_of([f"{a:g}" for a in angles])
    a, c, s = sums.weights @ samples

    def residuals(x):
        return x[0] + x[1] * np.cos(2 * (np.radians(angles) - x[2])) - samples

    fit = least_squares(residuals, [1.0, 0.3, 0.5], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert a == pytest.approx(fit.x[0], abs=1e-9)
    assert np.hypot(c, s) == pytest.approx(abs(fit.x[1]), abs=1e-8)
    assert sums.condition == pytest.approx(np.linalg.cond(sums.design))


def test_two_analyser_angles_are_parallel_and_crossed():
    diffuse, specular = parts(3)
    found, sums, _ = separate(("20", "110"), lambda s: surface_intensity(diffuse, specular, 20.0, float(s)))
    assert sums.method == "crossed"
    np.testing.assert_allclose(found.specular, specular, atol=2e-6)
    np.testing.assert_allclose(found.diffuse, diffuse, atol=2e-6)


@pytest.mark.parametrize(
    "states", [("0", "30"), ("0", "180"), ("0", "0.5", "1"), ("0/0", "0/45"), ("0/0", "10/20", "30/70"), ("on", "45")]
)
def test_states_that_cannot_be_separated(states):
    with pytest.raises(UserError, match=r"Remedy|expected"):
        sums_of(states)


def test_circular_states_with_beta_of_each_channel():
    """A circular polariser passes beta of unpolarised light and nothing of what a mirror returns (Miyazaki et al. 2007,
    eq. 2-5, A.4)."""
    diffuse, specular = parts(5)
    beta = np.array([0.31, 0.27, 0.4])
    found, sums, _ = separate(("off", "on"), lambda s: diffuse + specular if s == "off" else beta * diffuse, beta=beta)
    assert sums.method == "circular"
    np.testing.assert_allclose(found.diffuse, diffuse, atol=2e-6)
    np.testing.assert_allclose(found.specular, specular, atol=3e-6)
    swapped, _, _ = separate(("on", "off"), lambda s: diffuse + specular if s == "off" else beta * diffuse, beta=beta)
    np.testing.assert_array_equal(swapped.specular, found.specular)


def test_one_state_is_not_separated():
    diffuse, specular = parts(6)
    found, sums, _ = separate(("",), lambda s: diffuse + specular)
    assert sums.method == "none"
    np.testing.assert_allclose(found.diffuse, diffuse + specular, rtol=1e-6)
    assert not found.specular.any()
    assert sums_of(("on", "off"), method="none").weights.tolist() == [[0.0, 1.0]]


def fresnel_like_mueller(seed: int) -> np.ndarray:
    """A depolariser plus a mirror, as the light sees them: m22 and m33 reversed by the reflection."""
    rng = np.random.default_rng(seed)
    diffuse, specular = rng.uniform(0.1, 1, 2)
    return diffuse * np.diag([1.0, 0, 0, 0]) + specular * np.diag([1.0, 1, -1, -1]), diffuse, specular


@pytest.mark.parametrize("retardance", [72.3, 94.6, 90.0, 130.0])
def test_rotating_retarders(retardance):
    """Intensities by explicit matrices of every element; the sums give the surface's own parts back."""
    angles = np.arange(8) * 22.5
    delta = np.radians(retardance)
    matrix, diffuse, specular = fresnel_like_mueller(3)

    def photograph(state):
        g, a = (np.radians(22.5 * round(float(part) / 22.5)) for part in state.split("/"))
        lamp = retarder(delta, g) @ polariser(0.0) @ [2, 0, 0, 0]
        seen = polariser(0.0) @ retarder(delta, a) @ matrix @ lamp
        return np.full(SHAPE, seen[0])

    names = [f"{np.rint(g):g}/{np.rint(a):g}" for g in angles for a in angles]
    arm = Arm(retardance=delta)
    planes = separate(names, photograph, generator=arm, analyser=arm)[2]
    assert reflected_sense(planes[1], planes[2]) == -1
    found, sums, _ = separate(names, photograph, generator=arm, analyser=arm, sense=-1)
    assert sums.method == "mueller"
    assert len(sums.elements) == 16
    np.testing.assert_allclose(found.specular, specular, atol=1e-6 * sums.condition)
    np.testing.assert_allclose(found.diffuse, diffuse, atol=1e-6 * sums.condition)


def test_linear_series_without_pairs_uses_nine_elements():
    diffuse, specular = parts(7)
    states = [f"{g}/{a}" for g in (0, 60, 120) for a in (20, 80, 140)]
    found, sums, planes = separate(states, lambda s: surface_intensity(diffuse, specular, *map(float, s.split("/"))))
    assert sums.method == "mueller"
    assert len(sums.elements) == 9
    assert reflected_sense(planes[1], planes[2]) == 1
    np.testing.assert_allclose(found.specular, specular, atol=1e-5)
    np.testing.assert_allclose(found.diffuse, diffuse, atol=1e-5)


def test_optics_that_are_known():
    """A quarter-wave plate at 45 degrees makes circular light; crossed polarisers block; two halves make a whole."""
    np.testing.assert_allclose(polariser(0.3) @ polariser(0.3 + np.pi / 2), 0, atol=1e-15)
    circular = retarder(np.pi / 2, np.pi / 4) @ [1, 1, 0, 0]
    np.testing.assert_allclose(np.abs(circular), [1, 0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(retarder(0.4, 0.2) @ retarder(0.7, 0.2), retarder(1.1, 0.2), atol=1e-14)
    for matrix in (retarder(1.0, 0.3), retarder(3.0, -1.0)):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(4), atol=1e-14)
    few = design_matrix(Arm(), Arm(), np.radians([[0, 0], [0, 90], [90, 0.0]]))
    assert solvable(few) is None


def test_rounded_names_of_equal_steps():
    assert equal_steps(np.array([0, 23, 45, 68, 90, 113, 135, 158])).tolist() == (np.arange(8) * 22.5).tolist()
    assert equal_steps(np.array([0, 20, 90.0])).tolist() == [0, 20, 90]
    assert equal_steps(np.array([0, 22.0, 45, 68])).tolist() == [0, 22, 45, 68]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 999), scale=st.sampled_from([1e-6, 1.0, 1e6]), planes=st.integers(1, 4))
def test_kernel_against_numpy_over_twelve_orders(seed, scale, planes):
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(planes, 5)) * (rng.random((planes, 5)) < 0.7)
    stack = (scale * rng.normal(size=(5, *SHAPE))).astype(np.float32)
    valid = rng.random((5, *SHAPE[:2])) < 0.9
    found, good = sum_planes(zip(stack, valid, strict=True), weights)
    expected = np.einsum("ps,s...->p...", weights, stack.astype(np.float64))
    np.testing.assert_allclose(found, expected, atol=3e-6 * scale)
    np.testing.assert_array_equal(good, valid[weights.any(axis=0)].all(axis=0))


def slow_components(planes, valid, sums, *, beta=None, phase=None, sense=1, gain=1.0):
    """The formulas one by one, in float64."""
    p = planes.astype(np.float64)
    if sums.method == "none":
        diffuse, specular = p[0], 0 * p[0]
    elif sums.method == "circular":
        diffuse = p[1] / beta
        specular = p[0] - diffuse
    elif sums.method in ("crossed", "pairs"):
        diffuse, specular = 2 * p[1], p[0] - p[1]
    elif sums.method == "linear":
        b = np.hypot(p[1], p[2]) if phase is None else p[1] * np.cos(2 * phase) + p[2] * np.sin(2 * phase)
        diffuse, specular = 2 * (p[0] - b), 2 * b
    else:
        specular = (p[1] + sense * p[2]) / 2
        diffuse = p[0] - specular
    diffuse, specular = diffuse * gain, specular * gain
    known = valid & np.isfinite(diffuse).all(axis=-1) & np.isfinite(specular).all(axis=-1)
    return np.where(known[..., None], diffuse, 0), np.where(known[..., None], specular, 0), known


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("states", "rest"),
    [
        (("",), {}),
        (("off", "on"), {"beta": "field"}),
        (("off", "on"), {"beta": "channel"}),
        (("0", "90"), {"gain": "field"}),
        (("0/0", "0/90"), {}),
        (("0", "45", "90", "135"), {}),
        (("0", "45", "90", "135"), {"phase": 0.7, "gain": "channel"}),
        (tuple(f"{g}/{a}" for g in (0, 60, 120) for a in (20, 80, 140)), {"sense": -1}),
    ],
)
def test_last_step_against_the_formulas(states, rest, scale):
    rng = np.random.default_rng(11)
    sums = sums_of(states)
    planes = (scale * rng.normal(size=(len(sums.weights), *SHAPE))).astype(np.float32)
    valid = rng.random(SHAPE[:2]) < 0.8
    field = rng.uniform(0.1, 0.9, SHAPE)
    field[3, 4, 1] = field[5, 6, 0] = np.nan
    fields = {"field": field.astype(np.float32), "channel": np.array([0.2, 0.5, 0.7], np.float32)}
    rest = {key: fields.get(value, value) if isinstance(value, str) else value for key, value in rest.items()}
    found = components(planes, valid, sums, **rest)
    diffuse, specular, known = slow_components(planes, valid, sums, **rest)
    np.testing.assert_array_equal(found.valid, known)
    np.testing.assert_allclose(found.diffuse, diffuse, rtol=1e-5, atol=3e-6 * scale)
    np.testing.assert_allclose(found.specular, specular, rtol=1e-5, atol=3e-6 * scale)


def test_beta_goes_with_circular_states_only():
    planes, valid = np.ones((2, *SHAPE), np.float32), np.ones(SHAPE[:2], bool)
    with refused(ValueError, by="components"):
        components(planes, valid, sums_of(("off", "on")))
    with refused(ValueError, by="components"):
        components(planes, valid, sums_of(("0", "90")), beta=np.array(0.3))


def test_values_that_are_not_finite_add_nothing():
    values = np.array([1, np.nan, np.inf, -2], np.float32).reshape(1, 4, 1)
    planes, valid = sum_planes([(values, np.ones((1, 4), bool))], np.array([[1.0], [-1.0]]))
    assert valid.tolist() == [[True, False, False, True]]
    assert planes[0].ravel().tolist() == [1, 0, 0, -2]
    assert planes[1].ravel().tolist() == [-1, 0, 0, 2]


def test_negative_specular_values_are_kept_and_counted():
    rng = np.random.default_rng(0)
    diffuse = np.full((120, 160, 3), 0.5)
    off, on = (factor * diffuse + rng.normal(0, 0.01, diffuse.shape) for factor in (1.0, 0.3))
    sums = sums_of(("off", "on"))
    good = np.ones(diffuse.shape[:2], bool)
    planes, valid = sum_planes([(each.astype(np.float32), good) for each in (off, on)], sums.weights)
    told = statistics_of(components(planes, valid, sums, beta=np.array(0.3)))
    sigma = 0.01 * np.hypot(1, 1 / 0.3)
    assert told.negative == pytest.approx(0.5, abs=0.02)
    assert told.specular == pytest.approx(0, abs=4 * sigma / np.sqrt(diffuse.size))
    assert told.noise == pytest.approx(sigma, rel=0.05)
    assert told.doubtful < 0.004
    assert told.negative_mean == pytest.approx(-sigma * np.sqrt(2 / np.pi), rel=0.05)


def test_noise_ignores_slopes_and_needs_room():
    rows, columns = np.mgrid[:60, :80]
    slope = (0.3 * rows - 0.7 * columns + 0.01 * rows * 0)[..., None]
    assert noise_of(slope, np.ones((60, 80), bool)) == pytest.approx(0, abs=1e-12)
    assert noise_of(slope[:2], np.ones((2, 80), bool)) is None
    assert noise_of(slope, np.zeros((60, 80), bool)) is None
    nothing = statistics_of(SeparatedView(slope, slope, np.zeros((60, 80), bool)))
    assert nothing.specular is None


def board(beta, *, rows=64, columns=96, noise=0.0):
    """A board lit unevenly, with polarisers whose transmission varies over the picture."""
    row, column = np.mgrid[:rows, :columns] / 100
    lamp = (0.4 + 0.5 * np.exp(-((row - 0.3) ** 2 + (column - 0.4) ** 2) * 5))[..., None] * [1.0, 0.9, 0.8]
    local = np.asarray(beta) * (1 + 0.1 * column - 0.05 * row)[..., None]
    rng = np.random.default_rng(0)
    return lamp * local + rng.normal(0, noise, lamp.shape), lamp + rng.normal(0, noise, lamp.shape), local


def test_beta_by_place():
    on, off, local = board([0.3, 0.25, 0.35], noise=0.003)
    found = board_ratio(on, off, block=8, least=0.02)
    inner = np.s_[8:-8, 8:-8]
    np.testing.assert_allclose(found.field[inner], local[inner], rtol=0.01)
    np.testing.assert_allclose(found.channel, (on.sum((0, 1)) / off.sum((0, 1))), rtol=1e-9)
    assert found.low == 0
    assert found.covered == 1
    whole = board_ratio(on, off, block=8, least=0.02, local=False)
    assert np.ptp(whole.field, axis=(0, 1)).max() == 0


@pytest.mark.parametrize("block", [1, 7, 64, 200])
def test_any_block_size_covers_the_picture(block):
    on, off, _ = board([0.3, 0.25, 0.35])
    found = board_ratio(on, off, block=block, least=0.02)
    assert found.field.shape == on.shape
    assert np.isfinite(found.field).all()
    if block == 1:
        np.testing.assert_allclose(found.field, on / off, rtol=1e-6)


def test_a_board_that_fills_a_part_of_the_picture():
    on, off, local = board([0.3, 0.25, 0.35])
    on[:, 48:], off[:, 48:] = 1e-4, 1e-3
    found = board_ratio(on, off, block=8, least=0.02)
    assert found.covered == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(found.field[:, 64:], np.broadcast_to(found.channel, (64, 32, 3)), rtol=1e-6)
    np.testing.assert_allclose(found.field[8:-8, 8:36], local[8:-8, 8:36], rtol=0.02)


def test_beta_to_zero_is_flagged_and_never_divided_by():
    on, off, _ = board([0.3, 0.25, 0.35])
    on[:16, :24] = 0
    found = board_ratio(on, off, block=8, least=0.02)
    assert found.low > 100
    assert np.isnan(found.field[:12, :20]).all()
    sums = sums_of(("off", "on"))
    good = np.ones(on.shape[:2], bool)
    planes, valid = sum_planes([(each.astype(np.float32), good) for each in (off, on)], sums.weights)
    view = components(planes, valid, sums, beta=found.field)
    assert not view.valid[:12, :20].any()
    assert view.valid[24:, 32:].all()
    assert np.isfinite(view.diffuse).all()
    assert not view.diffuse[~view.valid].any()
    with refused(UserError, "1", "0.02"):
        board_ratio(on * [1, 1e-6, 1], off, block=8, least=0.02)
    with refused(UserError, "2", by="board_ratio"):
        board_ratio(on, off * [1, 1, 0], block=8, least=0.02)


def test_transmission_scales_both_parts():
    diffuse, specular = parts(8)
    photograph = lambda s: 0.7 * surface_intensity(diffuse, specular, 0.0, float(s))  # noqa: E731
    gain = np.full((*SHAPE[:2], 1), 1 / 0.7)
    gain[0, 0] = np.nan
    found, _, _ = separate(("0", "60", "120"), photograph, gain=gain)
    assert not found.valid[0, 0]
    np.testing.assert_allclose(found.diffuse[1:], diffuse[1:], atol=1e-5)
    np.testing.assert_allclose(found.specular[1:], specular[1:], atol=1e-5)


def test_residual_of_a_series_tells_its_noise():
    diffuse, specular = parts(9, (40, 50, 1))
    sums = sums_of([str(a) for a in range(0, 180, 15)])
    thinned = Thinned(sums, (40, 50), 1)
    rng = np.random.default_rng(3)
    level = []
    for state in sums.states:
        values = surface_intensity(diffuse, specular, 10.0, float(state)) + rng.normal(0, 0.02, diffuse.shape)
        level.append(values.mean())
        thinned.add(values.astype(np.float32), np.ones((40, 50), bool))
    told = diagnose(sums, thinned)
    assert told["residual"] * np.mean(level) == pytest.approx(0.02 * np.sqrt(9 / 12), rel=0.03)
    assert told["pixels_used"] == 2000
    assert diagnose(sums_of(("off", "on")), Thinned(sums_of(("off", "on")), (40, 50), 1)) == {}


def test_large_pictures_are_thinned():
    sums = sums_of(("0", "60", "120"))
    assert Thinned(sums, (3000, 4000), 3).step == 9
    assert Thinned(sums, (480, 640), 1).step == 1


def test_components_on_disk(tmp_path):
    rng = np.random.default_rng(1)
    views, lights = ("a", "b", "c"), ("left", "right")
    writer = ComponentWriter(
        tmp_path, OUTPUTS, views=views, lights=lights, shape=(6, 5), channels=("red", "green"), stamp={"scene": "x"}
    )
    made = []
    for number in range(6):
        pair = rng.normal(size=(2, 6, 5, 2)).astype(np.float32)
        made.append(SeparatedView(pair[0], pair[1], rng.random((6, 5)) < 0.5))
        writer.write(number, made[-1])
    found = Components(tmp_path)
    assert (found.views, found.lights, found.channels, found.shape, found.observations) == (
        views,
        lights,
        ("red", "green"),
        (6, 5),
        6,
    )
    for number, view in enumerate(made):
        for values, expected in zip(found.read(number), (view.diffuse, view.specular, view.valid), strict=True):
            np.testing.assert_array_equal(values, expected)
    import zarr

    whole = zarr.open_group(tmp_path / "components.zarr", mode="r")["specular"][...]
    np.testing.assert_array_equal(whole[3], made[3].specular)
    chunk = tmp_path / "components.zarr/diffuse/c/2/0/0/0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(data)
    with pytest.raises(UserError, match="damaged"):
        found.read(2)
    with refused(UserError, "6", by="read"):
        found.read(6)
    with refused(UserError, "components.zarr"):
        Components(tmp_path / "nowhere")
