"""Codes to observations, white boards, linearity and the choice of lights, where values are extreme or missing."""

import mpmath
import numpy as np
import pytest
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over
from stability.samples import EXTREME, dome, matt_pixels

from nishiki.colour.colour import decode as uncurve
from nishiki.colour.colour import encode
from nishiki.errors import UserError
from nishiki.formats.coding import LINEAR, SRGB
from nishiki.formats.problems import CaptureError
from nishiki.observations.kernels import ANY_CODE, block_levels, decode_codes
from nishiki.observations.linearise import block_edges, check_linearity, code_table, picture_edges, saturation_code
from nishiki.observations.reference import white_field
from nishiki.photometric.light_selection import METHODS, select_diffuse


def decoded(codes, gain, dark, *, reduced=False, saturated=None):
    """Observations and validity of codes (lights, rows, columns, channels) with fields of one node or more."""
    _, rows, columns, channels = codes.shape
    table = code_table(codes.dtype, LINEAR) if codes.dtype.kind == "u" else np.zeros(2, np.float32)
    edges = [block_edges(n, n // g) for n, g in zip((rows, columns), gain.shape[1:3], strict=True)]
    top = saturation_code(codes.dtype, None) if saturated is None else codes.dtype.type(saturated)
    low = codes.dtype.type(0) if codes.dtype.kind == "u" else np.float32(-np.inf)
    fields = gain, np.asarray(dark), np.ones((rows, columns), np.uint8)
    return decode_codes(codes, (table, top, low), fields, edges, channels=(0, channels, reduced))


@pytest.mark.slow
@case(
    "Gains and dark levels that are NaN, infinite, 0, negative or huge",
    hazard="white boards that gave nothing; intensities of 1e-39: an infinite gain times a code",
    treatment="samples whose gain is not between 0 and 1e30, or whose dark level is no number, are 0 and not valid",
    outcome="finite everywhere; the other samples unchanged to the last bit",
    bound=0,
    unit="wrong samples",
)
def test_fields_of_any_size():
    rng = np.random.default_rng(0)
    wrong = 0
    bad_gain = np.float32([np.nan, np.inf, -np.inf, 0, -1, 3e38, 1e31])
    bad_dark = np.float32([np.nan, np.inf, -np.inf, 3e38, -3e38])
    for dtype in (np.uint8, np.uint16, np.float32):
        codes = rng.integers(1, 200, (14, 4, 6, 3)).astype(dtype)
        gain, dark = np.full((14, 1, 1, 3), 2.0, np.float32), np.full((14, 1, 1, 3), 0.001, np.float32)
        plain = [decoded(codes, gain, dark, reduced=r) for r in (False, True)]
        gain[1:8, 0, 0, 1], dark[8:13, 0, 0, 2] = bad_gain, bad_dark
        for reduced, (values, valid) in zip((False, True), plain, strict=True):
            found, known = decoded(codes, gain, dark, reduced=reduced)
            wrong += int((~np.isfinite(found)).sum() + known[1:13].sum() + (known != valid)[[0, 13]].sum())
            wrong += int((found != values)[[0, 13]].sum())
    return wrong


@case(
    "The same for photographs of a turntable",
    hazard="as above",
    treatment="as above",
    outcome="finite; not valid",
    bound=0,
    unit="wrong samples",
)
def test_views_of_any_size():
    wrong = 0
    table = code_table(np.uint8, SRGB)
    codes = np.random.default_rng(1).integers(1, 200, (6, 8, 3)).astype(np.uint8)
    for gain, dark in ((np.inf, 0), (np.nan, 0), (3e38, 0), (0, 0), (1, np.nan), (1, np.inf), (1, 1e30), (2, 0.01)):
        fields = (np.full((1, 1, 1, 3), f, np.float32) for f in (gain, dark))
        edges, usable = picture_edges((6, 8), 16), np.ones((6, 8), np.uint8)
        with np.errstate(over="ignore"):
            out, valid = decode_codes(codes[None], (table, np.uint8(255), ANY_CODE), (*fields, usable), edges)
        wrong += int((~np.isfinite(out)).sum()) + int(valid.any() != (gain == 2))
    return wrong


@case(
    "Saturated, dark-clipped, NaN and infinite samples; one pixel, one channel",
    hazard="a clipped channel hidden in a mean",
    treatment="saturated in any channel, clipped in all, or not finite: not valid",
    outcome="exactly those; finite",
    bound=0,
    unit="wrong samples",
)
def test_unusable_samples():
    wrong = 0
    for reduced in (False, True):
        codes = np.full((1, 1, 6, 3), 1000, np.uint16)
        codes[0, 0, 1, 2], codes[0, 0, 2], codes[0, 0, 3, 0] = 65535, 0, 0
        gain = np.ones((1, 1, 1, 3), np.float32)
        values, valid = decoded(codes, gain, 0 * gain, reduced=reduced)
        wrong += valid[0, 0].tolist() != [True, False, False, True, True, True] or not np.isfinite(values).all()
        real = np.full((1, 1, 6, 3), 0.3, np.float32)
        real[0, 0, :3, 1] = [np.nan, np.inf, -np.inf]
        values, valid = decoded(real, gain, 0 * gain, reduced=reduced)
        wrong += valid[0, 0].tolist() != [False] * 3 + [True] * 3 or not np.isfinite(values).all()
        one, known = decoded(codes[:, :, :1, :1], gain[..., :1], 0 * gain[..., :1], reduced=reduced)
        wrong += not known.all() or abs(float(one[0, 0, 0, 0]) - 1000 / 65535) > 1e-8
    return wrong


def _negative_error(dark_level, noise):
    """Mean of decoded dark samples against that of their codes, in float64."""
    rng = np.random.default_rng(2)
    codes = np.clip(np.rint(dark_level + noise * rng.normal(size=(1, 16, 16, 1))), 1, 65534).astype(np.uint16)
    gain, dark = np.full((1, 1, 1, 1), 3.0, np.float32), np.full((1, 1, 1, 1), dark_level / 65535, np.float32)
    values, valid = decoded(codes, gain, dark)
    exact = 3.0 * (codes.astype(float) / 65535 - float(dark.ravel()[0]))
    return np.abs(values.astype(float) - exact).max() / (3 * codes.max() / 65535) if valid.all() else np.inf


@case(
    "Observations below 0 after the dark level is subtracted",
    hazard="clamping makes the dark brighter",
    treatment="kept as they are, valid",
    reference="the same in float64",
    outcome="unbiased, to float32's rounding of the code",
    bound=1e-6,
)
def test_negative_after_dark():
    return worst_over(_negative_error, st.floats(10, 3000), st.floats(0.1, 100), examples=40)


@case(
    "Gains and exposures times 2^-40 to 2^40",
    hazard="absolute thresholds in the decoding",
    treatment="none there",
    reference="the same at scale 1",
    outcome="observations times the scale, the same bits; the same validity",
    bound=0,
    unit="values that differ",
)
def test_equivariance_of_decoding():
    codes = np.random.default_rng(3).integers(0, 65535, (3, 8, 8, 3)).astype(np.uint16)
    gain = np.random.default_rng(4).uniform(0.5, 2, (3, 2, 2, 3)).astype(np.float32)
    dark, differ = np.full((1, 2, 2, 3), 0.003, np.float32), 0
    plain, valid = decoded(codes, gain, dark)
    for exponent in (-40, -20, 20, 40):
        found, known = decoded(codes, gain * np.float32(2.0**exponent), dark)
        differ += int((found != plain * np.float32(2.0**exponent)).sum() + (known != valid).sum())
    return differ


@case(
    "Blocks of a board that are saturated, black, or of one pixel",
    hazard="median of nothing",
    treatment="NaN, with a share of 1 that is not usable; the field says so and never divides by it",
    outcome="as stated; the median resists a third of glints",
    bound=1e-6,
)
def test_blocks():
    codes = np.full((12, 12, 1), 0.5, np.float32)
    codes[:4, :4], codes[4:8, :4], codes[8:, 8:] = np.inf, np.nan, -1.0
    codes[0:4, 4:8].ravel()[::3] = 0.95
    edges = np.array([0, 4, 8, 12])
    levels, unusable = block_levels(codes, np.zeros(2, np.float32), edges, edges, 1.0, 0.0)
    empty = np.isnan(levels[..., 0])
    if not (empty == np.array([[1, 0, 0], [1, 0, 0], [0, 0, 1]], bool)).all() or not (unusable[empty] == 1).all():
        return np.inf
    one, _ = block_levels(codes[5:6, 5:6], np.zeros(2, np.float32), np.array([0, 1]), np.array([0, 1]), 1.0, 0.0)
    return max(relative(levels[~empty], np.full(6, 0.5)[:, None]), abs(float(one[0, 0, 0]) - 0.5))


def _board(scale, dtype=np.float32):
    rng = np.random.default_rng(5)
    codes = (scale * rng.uniform(0.5, 0.6, (16, 16, 3))).astype(dtype)
    edges = np.array([0, 8, 16])
    top = np.inf if np.dtype(dtype).kind == "f" else 254.0
    table = code_table(np.dtype(dtype), LINEAR) if np.dtype(dtype).kind == "u" else np.zeros(2, np.float32)
    return white_field(
        codes,
        table,
        np.zeros((1, 1, 3)),
        (edges, edges),
        lit=(0.8, 0.9),
        limits=(top, 0.0),
        name="w",
    )


@case(
    "White board of float samples in units from 1e-20 to 1e20",
    hazard="a least level of 2 % of a full scale that float samples do not have",
    treatment="2 % of the board's own brightest block; of full scale for integer codes",
    reference="the same at scale 1",
    outcome="gain over the scale",
    bound=1e-6,
)
def test_board_units():
    plain = _board(1.0).gain.astype(np.float64)
    return worst_over(
        lambda scale: relative(_board(scale).gain.astype(np.float64) * scale, plain),
        powers_of_ten(-20, 20),
        examples=40,
    )


@case(
    "White board that is black, burnt, grazed or missing",
    hazard="gain 1 / 0",
    treatment="refused by name where less than half can be used; else NaN there, never a number",
    outcome="exit status 2, or a gain that is NaN exactly where the board cannot be used",
    bound=0,
    unit="wrong outcomes",
)
def test_boards_that_cannot_be_used():
    wrong = 0
    edges = np.array([0, 8, 16])
    table = code_table(np.uint8, LINEAR)

    def field(codes, cosine=0.9, dark=0.0):
        return white_field(
            codes, table, np.full((1, 1, 1), dark), (edges, edges), lit=(cosine, 0.9), limits=(254.0, 0.0),
            name="white.tif",
        )  # fmt: skip

    good = np.full((16, 16, 1), 120, np.uint8)
    for codes, cosine, dark in (
        (0 * good, 0.9, 0.0), (0 * good + 255, 0.9, 0.0), (good, 0.01, 0.0), (good, -0.5, 0.0), (good, 0.9, 0.5),
        (good, 0.9, np.nan), (0 * good + 3, 0.9, 0.0),
    ):  # fmt: skip
        try:
            field(codes, cosine, dark)
            wrong += 1
        except CaptureError:
            continue
    part = good.copy()
    part[:8, :8] = 0
    found = field(part).gain[..., 0]
    return wrong + int((np.isnan(found) != np.array([[True, False], [False, False]])).sum())


def _line_error(scale, offset, curve):
    reflectances = np.array([0.03, 0.09, 0.19, 0.36, 0.58, 0.9])
    values = scale * (reflectances + offset + curve * reflectances**2)
    found = check_linearity(values, reflectances)
    with mpmath.workdps(60):
        x, y = ([mpmath.mpf(float(v)) for v in of] for of in (reflectances, values))
        mx, my = sum(x) / 6, sum(y) / 6
        sxx = sum((a - mx) ** 2 for a in x)
        slope = sum((a - mx) * (b - my) for a, b in zip(x, y, strict=True)) / sxx
        rest = [b - (my + slope * (a - mx)) for a, b in zip(x, y, strict=True)]
        r2 = 1 - sum(e * e for e in rest) / sum((b - my) ** 2 for b in y)
        worst = max(abs(e) for e in rest) / max(abs(b) for b in y)
        of_slope = abs(found.slope / float(slope) - 1) / (1 + abs(offset))
        of_r2 = abs(found.r_squared - float(r2)) / (1 + offset**2)
        return max(of_slope, of_r2, abs(found.worst_deviation - float(worst)))


@case(
    "Linearity of a camera in units from 1e-100 to 1e100, with a large offset",
    hazard="differences of nearly equal sums",
    treatment="both sides are centred before anything is multiplied",
    reference="mpmath, 60 digits",
    outcome="slope, r^2 and worst deviation exact to rounding",
    bound=1e-14,
    unit="relative, over the offset",
)
def test_linearity():
    return worst_over(_line_error, powers_of_ten(-100, 100), st.floats(0, 1e4), st.floats(-0.2, 0.2), examples=100)


@case(
    "Patches that are all equal, all black, NaN, or too few",
    hazard="0 / 0 in r^2",
    treatment="refused with ValueError where there is no line; r^2 is 0 where the values do not vary",
    outcome="as stated, finite",
    bound=0,
    unit="wrong outcomes",
)
def test_patches():
    reflectances, wrong = np.array([0.1, 0.3, 0.5, 0.9]), 0
    for values in (np.zeros(4), np.full(4, 0.7), np.full(4, 1e300)):
        found = check_linearity(values, reflectances)
        wrong += not np.isfinite([found.slope, found.intercept, found.r_squared, found.worst_deviation]).all()
        wrong += found.r_squared > 0.5
    for values, known in (
        (np.full(4, np.nan), reflectances), (reflectances, np.full(4, 0.5)), (reflectances[:2], reflectances[:2]),
        (np.array([1, 2, np.inf, 3]), reflectances), (np.empty(0), np.empty(0)),
    ):  # fmt: skip
        try:
            check_linearity(values, known)
            wrong += 1
        except ValueError:
            continue
    return wrong


def _curve_error(value):
    value = float(np.float32(value))
    with mpmath.workdps(40):
        v, join, shift, stretch = (mpmath.mpf(text) for text in (repr(value), "0.04045", "0.055", "1.055"))
        exact = v / mpmath.mpf("12.92") if v <= join else ((v + shift) / stretch) ** mpmath.mpf("2.4")
        error = abs(float(uncurve(value, "srgb")) / float(exact) - 1) if value else 0.0
    there = encode(np.array([value]), "srgb")
    return max(error, abs(float(uncurve(there, "srgb")[0]) - value) / max(abs(value), 1e-300))


@case(
    "sRGB's curve and its inverse from 1e-40 to 1e6",
    hazard="powers of what is nearly 0; the join of straight part and power",
    treatment="the power is taken of what is above the join only",
    reference="mpmath, 40 digits",
    outcome="exact to rounding; back and forth the same",
    bound=1e-7,
)
def test_srgb():
    return worst_over(_curve_error, powers_of_ten(-40, 0), examples=200)


def _selection(seed, share, sizes, count):
    rng = np.random.default_rng(seed)
    stack = (rng.uniform(size=(count, 2, 9)) * 10.0**sizes).astype(np.float32)
    stack = np.where(rng.random(stack.shape) < share, rng.choice(EXTREME, size=stack.shape), stack)
    valid, wrong = rng.random(stack.shape) < 0.8, 0
    for method in METHODS:
        for known in (None, valid):
            found = select_diffuse(stack, dome(count), method=method, valid=known)
            allowed = np.isfinite(stack) if known is None else np.isfinite(stack) & known
            wrong += int((found.usable & ~allowed).sum())
            counted = found.lights_usable.astype(int) + found.highlights + found.shadows + found.invalid
            wrong += int((counted != count).sum() + (found.usable.sum(axis=0) != found.lights_usable).sum())
    return wrong


@case(
    "Choice of lights among samples of any size, NaN and infinity among them",
    hazard="means and ranks of what is no number; squares beyond float32",
    treatment="samples are divided by the pixel's largest; what is not finite is invalid",
    outcome="nothing invalid chosen; chosen, bright, dark and invalid add up to all",
    bound=0,
    unit="wrong samples",
)
def test_selection_of_any_size():
    drawn = st.integers(0, 10**6), st.floats(0, 0.6), st.floats(-44, 38), st.integers(1, 24)
    return worst_over(_selection, *drawn, examples=30)


@case(
    "Choice of lights where every sample is saturated, where one light is left, for one pixel",
    hazard="windows of no ranks",
    treatment="a pixel without a trustworthy fit keeps every valid sample",
    outcome="as stated",
    bound=0,
    unit="wrong pixels",
)
def test_selection_of_little():
    wrong = 0
    stack, lights, _, _ = matt_pixels(10, 4, 1)
    for method in METHODS:
        none = select_diffuse(stack, lights, method=method, valid=np.zeros(stack.shape, bool))
        wrong += int(none.usable.sum() + (none.invalid != 10).sum())
        few = np.zeros(stack.shape, bool)
        few[4] = True
        left = select_diffuse(stack, lights, method=method, valid=few)
        wrong += int((left.lights_usable != (stack[4] > 0)).sum())
        single = select_diffuse(stack[:, :, :1], lights, method=method)
        whole = select_diffuse(stack, lights, method=method)
        wrong += int((single.usable[:, 0, 0] != whole.usable[:, 0, 0]).sum())
    return wrong


@case(
    "Light directions that are no unit vectors",
    hazard="normals scaled or NaN everywhere",
    treatment="refused by light, with a remedy",
    outcome="exit status 2",
    bound=0,
    unit="that passed",
)
def test_directions():
    stack, lights, _, _ = matt_pixels(5, 4, 1)
    passed = 0
    for bad in (np.nan, np.inf, 0.0, 1e-30, 1e30, 2.0):
        broken = lights.copy()
        broken[2] *= bad
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                select_diffuse(stack, broken)
            passed += 1
        except UserError:
            continue
    return passed
