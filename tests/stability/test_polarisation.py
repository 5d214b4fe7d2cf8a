"""Separation by polarisation where the polarisers hardly tell the components apart."""

import mpmath
import numpy as np
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over

from nishiki.errors import UserError
from nishiki.polarisation.polarisation import board_ratio, common_phase, components, reflected_sense, sum_planes
from nishiki.polarisation.polariser_states import Arm, design_matrix, solvable, sums_of
from nishiki.polarisation.series import statistics_of

SHAPE = (5, 7, 3)


def photographs(seed: int = 0, shape: tuple = SHAPE) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 1, shape).astype(np.float32), rng.uniform(0.1, 1, shape).astype(np.float32)


def separate(states, series, **rest):
    sums = sums_of(states)
    planes, valid = sum_planes(((each, np.ones(each.shape[:2], bool)) for each in series), sums.weights)
    return components(planes, valid, sums, **rest)


def exact_circular(off, on, beta):
    """I_d = I_on / beta, I_s = I_off - I_d in 50 digits."""
    with mpmath.workdps(50):
        diffuse = [mpmath.mpf(float(a)) / mpmath.mpf(float(b)) for a, b in zip(on.ravel(), beta.ravel(), strict=True)]
        specular = [mpmath.mpf(float(a)) - d for a, d in zip(off.ravel(), diffuse, strict=True)]
    return np.array(diffuse, float).reshape(off.shape), np.array(specular, float).reshape(off.shape)


@case(
    "Circular polariser that lets almost nothing through",
    hazard="I_d = I_on / beta with beta from 1 to 1e-30, 0, below 0, NaN",
    treatment="a pixel whose beta is not positive, or whose quotient leaves float32, is invalid and holds 0",
    reference="mpmath, 50 digits",
    bound=2e-7,
    unit="of the larger component",
    outcome="finite everywhere; exact to float32 where valid",
)
def test_beta_towards_zero():
    off, on = photographs()
    beta = np.logspace(0, -45, off.size).reshape(SHAPE)
    beta[0, 0], beta[1, 1, 0], beta[2, 2, 1] = 0.0, -0.1, np.nan
    found = separate(("off", "on"), (off, on), beta=beta)
    usable = (beta.astype(np.float32) > 0).all(axis=-1)
    diffuse, specular = exact_circular(off, on, np.where(beta.astype(np.float32) > 0, beta.astype(np.float32), 1))
    usable &= (np.abs(diffuse) < 3.4e38).all(axis=-1)
    wrong = (found.valid != usable).any() or not np.isfinite(found.diffuse).all() or found.diffuse[~usable].any()
    scale = np.maximum(np.abs(diffuse), np.abs(specular))[usable]
    error = np.maximum(np.abs(found.diffuse - diffuse), np.abs(found.specular - specular))[usable] / scale
    return np.inf if wrong else float(error.max())


@case(
    "White board through crossed polarisers",
    hazard="beta of a channel goes to 0: noise divided by almost nothing",
    treatment="below beta_least never divided; a whole channel below it stops with the channel and a remedy",
    outcome="exit status 2 below the limit, beta above it",
    bound=0,
    unit="wrong outcomes of 60",
)
def test_board_without_light():
    wrong = 0
    for exponent in np.linspace(-30, 0, 60):
        beta = np.array([0.3, 10.0**exponent, 0.3])
        under = np.full((32, 32, 3), 2.0)
        try:
            found = board_ratio(under * beta, under, block=8, least=0.02)
            wrong += not (beta[1] >= 0.02 and np.allclose(found.channel, beta, rtol=1e-12))
        except UserError:
            wrong += beta[1] >= 0.02
    return wrong


@case(
    "White board with dark, empty and burnt places",
    hazard="0/0 and inf/inf in blocks that the board does not fill",
    treatment="blocks that are not lit take the channel's value; values that are not finite count as dark",
    outcome="beta of the channel everywhere, none NaN",
    bound=1e-6,
)
def test_board_partly_dark():
    rng = np.random.default_rng(3)
    under = rng.uniform(1, 2, (64, 48, 2))
    over = 0.25 * under
    under[:20], over[:20] = 0.0, 0.0
    over[30, 30], under[31, 31], under[40, 1] = np.nan, np.inf, np.nan
    found = board_ratio(over, under, block=16, least=0.02)
    return relative(found.field, np.full(under.shape, 0.25))


@case(
    "Analyser pictures that are all equal",
    hazard="amplitude of the cosine is 0 and its phase undefined",
    treatment="the amplitude is a length and needs no phase; the common phase states an agreement of 0",
    outcome="no specular light, all diffuse, valid",
    bound=1e-6,
)
def test_equal_states():
    one, _ = photographs(1)
    states = ("0", "60", "120")
    found = separate(states, (one, one, one))
    sums = sums_of(states)
    flat = np.full(SHAPE, 0.5, np.float32)
    planes, valid = sum_planes(((flat, np.ones(SHAPE[:2], bool)) for _ in states), sums.weights)
    _, agreement = common_phase(np.zeros_like(planes), valid)
    assert agreement == 0.0
    assert found.valid.all()
    return max(relative(found.diffuse, 2 * one), float(np.abs(found.specular).max()))


def _angles_case(angles, values):
    """Error of diffuse and specular of drawn well-spread angles against least squares in 50 digits, over condition."""
    angles, values = np.array(angles), np.array(values, np.float32)
    try:
        sums = sums_of([f"{angle:.6f}" for angle in angles])
    except UserError:
        return 0.0
    if sums.method != "linear":
        return 0.0
    series = [np.full((1, 1, 1), value, np.float32) for value in values]
    planes, valid = sum_planes(((each, np.ones((1, 1), bool)) for each in series), sums.weights)
    found = components(planes, valid, sums)
    with mpmath.workdps(50):
        design = mpmath.matrix(
            [
                [1, mpmath.cos(2 * mpmath.radians(f)), mpmath.sin(2 * mpmath.radians(f))]
                for f in (mpmath.mpf(float(a[0])) for a in sums.angles_deg)
            ]
        )
        a, c, s = mpmath.lu_solve(design.T * design, design.T * mpmath.matrix([mpmath.mpf(float(v)) for v in values]))
        amplitude = mpmath.sqrt(c * c + s * s)
        exact = np.array([float(2 * (a - amplitude)), float(2 * amplitude)])
    error = np.abs(np.array([found.diffuse.item(), found.specular.item()]) - exact).max()
    return error / (np.abs(values).max() * sums.condition) if found.valid.all() else np.inf


@case(
    "Few analyser angles, badly spread",
    hazard="the cosine is fitted to angles that lie close together: cond -> infinity",
    treatment="the condition is computed before any picture is read; beyond 1000 the states are refused",
    reference="least squares in mpmath, 50 digits",
    outcome="refused with a remedy, or an error below float32 times the condition",
    bound=1e-6,
    unit="of the brightest value, over the condition",
)
def test_few_angles():
    angles = st.lists(st.floats(-360, 360), min_size=3, max_size=5, unique=True)
    values = st.lists(st.floats(0, 100, width=32), min_size=5, max_size=5)
    return worst_over(lambda a, v: _angles_case(a, v[: len(a)]) if max(v[: len(a)]) > 1e-6 else 0.0, angles, values)


@case(
    "Polariser states that determine nothing",
    hazard="singular least squares",
    treatment="refused by name before any picture is read",
    outcome="exit status 2",
    bound=0,
    unit="states that passed",
)
def test_wrong_states():
    hopeless = [
        ("0", "30"), ("0", "180", "360"), ("0", "0.5", "1"), ("on", "45"), ("0/0", "0/45"), ("0/0", "10/20", "30/70"),
        ("nan", "0", "60"), ("inf", "0", "60"), ("0/nan", "0/90"), ("", "off"), ("0", "1e-9", "90", "90.000001"),
        ("0/0/0", "0/90/0"), ("0", "60/0", "120"),
    ]  # fmt: skip
    passed = 0
    for states in hopeless:
        try:
            sums_of(states)
            passed += 1
        except UserError:
            continue
    return passed


def _scaled(exponent, seed):
    rng = np.random.default_rng(seed)
    scale = np.float32(10.0**exponent)
    worst = 0.0
    for states, rest in (
        (("off", "on"), {"beta": np.array([0.3, 0.2, 0.4])}),
        (("0", "60", "120"), {}),
        (("0", "90"), {}),
        (("0/0", "0/90"), {}),
    ):
        series = [rng.uniform(0.01, 1, SHAPE).astype(np.float32) for _ in states]
        plain = separate(states, series, **rest)
        scaled = separate(states, [each * scale for each in series], **rest)
        assert (plain.valid == scaled.valid).all()
        for each in ("diffuse", "specular"):
            worst = max(worst, relative(getattr(scaled, each) / np.float64(scale), getattr(plain, each)))
    return worst


@case(
    "Polarisation under 60 orders of magnitude of brightness",
    hazard="squares of the amplitude leave float32 beyond 1e-19 and 1e19",
    treatment="the amplitude is computed in float64",
    reference="the same at scale 1",
    outcome="equivariant",
    bound=1e-6,
)
def test_equivariance_of_polarisation():
    return worst_over(_scaled, st.floats(-30, 30), st.integers(0, 5), examples=60)


@case(
    "A photograph with a value that is not finite",
    hazard="NaN or infinity in a pixel that is called valid",
    treatment="the pixel becomes invalid, in every method",
    outcome="flagged; neighbours unchanged",
    bound=0,
    unit="wrong pixels",
)
def test_values_that_are_not_finite():
    wrong = 0
    for states, rest in ((("off", "on"), {"beta": np.full(3, 0.3)}), (("0", "60", "120"), {}), (("0/0", "0/90"), {})):
        series = [photographs(k)[0] for k in range(len(states))]
        good = separate(states, series, **rest)
        for bad in (np.nan, np.inf, -np.inf):
            broken = [each.copy() for each in series]
            broken[-1][2, 3, 1] = bad
            found = separate(states, broken, **rest)
            expected = good.valid.copy()
            expected[2, 3] = False
            wrong += int((found.valid != expected).sum() + (found.diffuse != good.diffuse)[expected].sum())
            wrong += int(not np.isfinite(found.diffuse).all()) + int(found.diffuse[2, 3].any())
    return wrong


@case(
    "Mueller series close to singular",
    hazard="retarders near 0 or a half turn leave elements undetermined: cond -> infinity",
    treatment="solved only where the condition is below 1000; reported as polarise: condition",
    outcome="refused, or a condition that is true to the singular values",
    bound=1e-6,
    reference="singular values in mpmath, 50 digits",
)
def test_mueller_condition():
    worst = 0.0
    angles = np.radians([(g, a) for g in (0, 36, 72, 108, 144) for a in (0, 36, 72, 108, 144)])
    for retardance in (np.pi / 2, 1.0, 0.1, 1e-2, 1e-3):
        design = design_matrix(Arm(retardance), Arm(retardance), angles)
        found = solvable(design)
        if found is None:
            continue
        elements, condition = found
        with mpmath.workdps(50):
            sizes = mpmath.svd_r(mpmath.matrix(design[:, elements].tolist()), compute_uv=False)
            exact = float(sizes[0] / sizes[len(elements) - 1])
        if exact < 1e9:
            worst = max(worst, abs(condition / exact - 1))
    return worst


@case(
    "No pixel valid, a picture of one pixel, a black picture",
    hazard="percentiles and means over nothing",
    treatment="a mean over nothing is absent from the diagnostics, not NaN",
    outcome="finite figures or none",
    bound=0,
    unit="figures that are not finite",
)
def test_nothing_to_count():
    wrong = 0
    for shape in ((4, 4, 3), (1, 1, 1)):
        for filled in (0.0, 1.0):
            for every in (False, True):
                series = [np.full(shape, filled, np.float32)] * 2
                sums = sums_of(("0", "90"))
                planes, valid = sum_planes(((each, np.full(shape[:2], every)) for each in series), sums.weights)
                view = components(planes, valid, sums)
                told = statistics_of(view)
                wrong += sum(value is not None and not np.isfinite(value) for value in vars(told).values())
                phase, agreement = common_phase(np.zeros((3, *shape), np.float32), valid)
                wrong += not (np.isfinite(phase) and agreement == 0)
                wrong += reflected_sense(view.diffuse, view.specular) not in (1, -1)
    return wrong


@case(
    "Board ratio under 24 orders of magnitude of exposure",
    hazard="thresholds that are not relative",
    treatment="everything is relative to the board's bright end",
    reference="the same at scale 1",
    outcome="equivariant",
    bound=1e-6,
)
def test_board_scale():
    rng = np.random.default_rng(0)
    under = rng.uniform(0.2, 1, (40, 40, 3))
    over = under * rng.uniform(0.2, 0.3, (40, 40, 3))
    plain = board_ratio(over, under, block=8, least=0.02)
    return worst_over(
        lambda scale: relative(board_ratio(over * scale, under * scale, block=8, least=0.02).field, plain.field),
        powers_of_ten(-12, 12),
        examples=30,
    )
