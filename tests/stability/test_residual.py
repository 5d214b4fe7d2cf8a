"""The residual's transform, solver, quantiser and coder on blocks of nothing, of one texel, and at extreme steps."""

import mpmath
import numpy as np
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over
from texel_domain import keep_largest

from nishiki.codec.allocate import psnr
from nishiki.codec.design import extent_of
from nishiki.codec.entropy import Model, decode, encode, pack, train, unpack
from nishiki.codec.rate import expected_bits, quantise
from nishiki.codec.solve import Footprints, Operator, Pursuit, curvatures, pursue, samples_of
from nishiki.codec.transform import Block, analysis_matrix, cosine_matrix, family, plane_transform
from nishiki.errors import UserError


def exact_daubechies() -> list[mpmath.mpf]:
    """db2 in 50 digits: (1 + s, 3 + s, 3 - s, 1 - s) / (4 sqrt 2), s = sqrt 3 (I. Daubechies, 1988), reversed."""
    with mpmath.workdps(50):
        s = mpmath.sqrt(3)
        return [x / (4 * mpmath.sqrt(2)) for x in (1 - s, 3 - s, 3 + s, 1 + s)]


def exact_level(low: list, length: int) -> mpmath.matrix:
    """One periodic level in 50 digits, rows as `pywt.dwt(mode='periodization')` orders them."""
    high = [(-1) ** (k + 1) * tap for k, tap in enumerate(reversed(low))]
    out = mpmath.zeros(length)
    for row, taps in ((0, low), (length // 2, high)):
        for i in range(length // 2):
            for k, tap in enumerate(taps):
                out[row + i, (2 * i + len(taps) // 2 - k) % length] += tap
    return out


@case(
    "Wavelets at the border of the smallest blocks",
    hazard="filters longer than the signal wrap around it: an inverse that is not the transpose",
    treatment="periodic rows as a matrix, orthonormal at any even length, 2 included",
    reference="db2 and Haar in mpmath, 50 digits, products of exact matrices",
    bound=1e-14,
    outcome="analysis equal to the exact one; M M' = 1",
)
def test_orthonormal_borders():
    worst = 0.0
    with mpmath.workdps(50):
        half = mpmath.sqrt(mpmath.mpf(1) / 2)
        banks = {"haar": [half, half], "db2": exact_daubechies()}
        for wavelet, low in banks.items():
            assert np.allclose([float(x) for x in low], family(wavelet).dec_lo, atol=1e-12)
            for length in (2, 4, 6, 8, 16):
                levels, total, size = 0, mpmath.eye(length), length
                while size % 2 == 0 and levels < 2:
                    part = mpmath.eye(length)
                    level = exact_level(low, size)
                    for i in range(size):
                        for k in range(size):
                            part[i, k] = level[i, k]
                    total, size, levels = part * total, size // 2, levels + 1
                found = analysis_matrix(wavelet, length, levels)
                exact = np.array(total.tolist(), float)
                departure = np.array((total * total.T - mpmath.eye(length)).tolist(), float)
                errors = [relative(found, exact), np.abs(departure).max(), relative(found @ found.T, np.eye(length))]
                worst = max(worst, *errors)
    return worst


BLOCKS = st.tuples(*(st.sampled_from(sizes) for sizes in ([1, 3], [1, 2], [1, 2, 5], [1, 2, 3, 4, 7, 8], [1, 2, 3, 8])))


def block_of(shape, wavelet="db2", mirrored=False):
    _, lights, views, rows, columns = shape
    plane = plane_transform(wavelet, rows, columns, 3, mirrored=mirrored)
    return Block(plane, cosine_matrix(views), cosine_matrix(lights))


def _round_trip(shape, exponent, kind, precision):
    rng = np.random.default_rng(3)
    scale = 10.0**exponent
    values = {"noise": rng.normal(size=shape), "constant": np.ones(shape), "zero": np.zeros(shape)}[kind] * scale
    values = values.astype(precision)
    block = block_of(shape)
    coefficients = block.forward(values)
    if kind == "zero":
        return float(np.abs(coefficients).max(initial=0))
    energy = abs(np.sum(coefficients.astype(float) ** 2) / np.sum(values.astype(float) ** 2) - 1)
    error = max(relative(block.inverse(coefficients), values), energy)
    return error / np.finfo(precision).eps


@case(
    "Blocks of one texel, one view, one value, or nothing",
    hazard="levels of an axis that cannot be halved; axes of length 1; energy lost at ends",
    treatment="as many levels as both sides allow, none for odd sides; axes of length 1 pass",
    reference="the samples themselves; Parseval's energy",
    bound=20,
    unit="roundings, float32 and float64",
    outcome="perfect reconstruction from 1e-30 to 1e30",
)
def test_small_blocks():
    kinds = st.sampled_from(["noise", "constant", "zero"])
    return worst_over(
        _round_trip, BLOCKS, st.floats(-15, 15), kinds, st.sampled_from([np.float32, np.float64]), examples=150
    )


@case(
    "Biorthogonal wavelets on small blocks",
    hazard="the synthesis is an inverse that is ill-conditioned at short lengths, mirrored ends above all",
    treatment="inverted as a whole, its gains divided out",
    reference="the samples themselves",
    bound=1e-12,
    outcome="perfect reconstruction in float64",
)
def test_biorthogonal_blocks():
    worst = 0.0
    for wavelet, mirrored in (("bior4.4", False), ("bior4.4", True), ("bior2.2", True)):
        for rows, columns in ((2, 2), (4, 2), (8, 16), (6, 10)):
            values = np.random.default_rng(0).normal(size=(1, 1, 2, rows, columns))
            block = block_of(values.shape, wavelet, mirrored)
            worst = max(worst, relative(block.inverse(block.forward(values)), values))
    return worst


@case(
    "Quantiser steps towards 0 and infinity",
    hazard="integers that do not hold value / step; steps that are 0 or subnormal",
    treatment="a value of more than 2^30 steps is refused, with the step to change; a step must be positive",
    reference="rounding in exact integers",
    bound=0,
    unit="wrong integers",
    outcome="exact to 2^30 steps, all 0 for huge steps, exit status 2 beyond",
)
def test_extreme_steps():
    values = np.array([0.0, 1.0, -1.0, 0.3, -123.456, 1e-20], np.float32)
    wrong = 0
    for exponent in np.linspace(-45, 30, 76):
        step = float(10.0**exponent)
        try:
            found = quantise(values, step)
        except UserError:
            wrong += float(np.abs(values).max()) < 2.0**30 * step
            continue
        wrong += float(np.abs(values).max()) > 2.0**30 * step
        exact = [0 if abs(float(v)) / step < 0.6 else max(int(abs(float(v)) / step + 0.42), 1) for v in values]
        wrong += int((np.abs(found) != exact).sum()) + int((np.sign(found) * values < 0).sum())
    for step in (0.0, -1.0, np.nan):
        try:
            quantise(values, step)
            wrong += 1
        except (UserError, ValueError):
            continue
    return wrong


@case(
    "Values that are not finite, before the quantiser",
    hazard="a NaN becomes an arbitrary integer",
    treatment="refused as a defect",
    bound=0,
    unit="values that passed of 3",
    outcome="an error, never an integer",
)
def test_quantising_what_is_not_finite():
    passed = 0
    for value in (np.nan, np.inf, -np.inf):
        try:
            quantise(np.array([1.0, value], np.float32), 0.1)
            passed += 1
        except (UserError, ValueError):
            continue
    return passed


def _coded(shape, kind, seed):
    channels, lights, views, rows, columns = shape
    rng = np.random.default_rng(seed)
    largest = 2**30
    size = (channels, lights * views, rows, columns)
    values = {
        "zero": np.zeros(size),
        "one": np.where(np.arange(int(np.prod(size))).reshape(size) == seed % max(1, int(np.prod(size))), 1, 0),
        "sparse": rng.integers(-3, 4, size) * (rng.random(size) < 0.1),
        "dense": rng.integers(-(2**15), 2**15, size),
        "extreme": rng.integers(-largest, largest + 1, size),
        "largest": np.full(size, largest) * rng.choice([-1, 1], size),
    }[kind].astype(np.int32)
    levels = plane_transform("db2", rows, columns, 3).levels
    coded = encode(values, levels, Model.initial())
    again = decode(coded.data, values.shape, levels, Model.initial())
    return float((again != values).sum())


@case(
    "Coding blocks of zeros, of one value, and of the largest values",
    hazard="magnitudes of 2^30 in every place need more bytes than a value has: a buffer that overflows",
    treatment="the buffer holds what the worst probabilities cost",
    reference="the integers themselves",
    bound=0,
    unit="integers that differ",
    outcome="decoded equal; zeros cost next to nothing",
)
def test_coding_of_extremes():
    kinds = st.sampled_from(["zero", "one", "sparse", "dense", "extreme", "largest"])
    return worst_over(_coded, BLOCKS, kinds, st.integers(0, 5), examples=30)


@case(
    "A coder trained on nothing, and bytes cut short",
    hazard="counts of 0 as probabilities; a stream that ends early",
    treatment="counts lean on a start; missing bytes read as zeros, within the block",
    bound=0,
    unit="failures",
    outcome="a usable coder; integers of the block's shape, no other memory touched",
)
def test_training_on_nothing():
    failures = 0
    shape = (3, 4, 8, 8)
    empty = encode(np.zeros(shape, np.int32), 2, Model.initial())
    for coded in ([], [empty], [empty] * 3):
        model = train(coded)
        values = np.random.default_rng(0).integers(-5, 6, shape).astype(np.int32)
        stream = encode(values, 2, model).data
        failures += not (decode(stream, shape, 2, model) == values).all()
        failures += not (decode(stream, shape, 2, unpack(pack(model))) == values).all()
        for length in (0, 1, len(stream) // 2):
            failures += decode(stream[:length], shape, 2, model).shape != shape
    return failures


def _pursued(shape, pixels, exponent, kind):
    """Worst of the solution's scale error and of its energy beyond that of the data."""
    channels, lights, views, rows, columns = shape
    rng = np.random.default_rng(pixels)
    observation = rng.integers(0, lights * views, pixels)
    s, t = rng.uniform(0, rows - 1, pixels), rng.uniform(0, columns - 1, pixels)
    feet = Footprints.of(observation, s.astype(np.float32), t.astype(np.float32), (lights * views, rows, columns))
    data = {"noise": rng.normal(size=(channels, pixels)), "constant": np.ones((channels, pixels))}.get(
        kind, np.zeros((channels, pixels))
    )
    block, found = block_of(shape), []
    for scale in (1.0, 10.0**exponent):
        curvature, step = curvatures(block, feet.density()), 0.1 * scale
        solution = pursue(
            (data * scale).astype(np.float32), Operator.of_pixels(feet), block, curvature,
            price=0.05 * step**2, effort=Pursuit(),
            bits=lambda c, step=step: expected_bits(c, step, block.plane.levels),
        )  # fmt: skip
        solution = solution.astype(float) / scale
        found.append((solution, np.sum((data - feet.look_up(samples_of(block, solution))) ** 2)))
    (plain, error), (scaled, other) = found
    if not np.isfinite(scaled).all() or error > np.sum(data**2) * (1 + 1e-5):
        return np.inf
    return max(abs(error - other) / max(np.sum(data**2), 1e-30), 0.0) if plain.any() else float(np.abs(scaled).max())


@case(
    "Pursuit over empty, single-view and single-texel blocks, at any brightness",
    hazard="no pixel, a block where nothing is seen, data of zeros, squares of 1e-6 and 1e6 in float32",
    treatment="nothing is chosen where nothing pays; steps of length 0/0 are not taken",
    reference="the same at scale 1; the energy of the data",
    bound=1e-3,
    unit="of the energy",
    outcome="finite, never worse than storing nothing, equivariant over 12 orders of magnitude",
)
def test_pursuit_over_little():
    shapes = st.tuples(
        st.sampled_from([1, 3]), st.just(1), st.sampled_from([1, 4]), st.sampled_from([2, 8]), st.sampled_from([2, 8])
    )
    pixels = st.sampled_from([0, 1, 2, 40])
    return worst_over(
        _pursued,
        shapes,
        pixels,
        st.sampled_from([-6.0, -3.0, 3.0, 6.0]),
        st.sampled_from(["noise", "constant", "zero"]),
        examples=50,
    )


@case(
    "Expected bits of zeros and at extreme steps",
    hazard="log of a share of nothing; values of 1e30 steps",
    treatment="shares lean on all levels; magnitudes are counted up to 15",
    bound=0,
    unit="wrong values",
    outcome="finite, at least 1",
)
def test_expected_bits():
    wrong = 0
    rng = np.random.default_rng(1)
    for shape in ((1, 1, 1, 1, 1), (3, 1, 2, 8, 4)):
        for scale in (0.0, 1e-30, 1.0, 1e30):
            for step in (1e-30, 1.0, 1e30):
                values = (rng.normal(size=shape) * scale).astype(np.float32)
                levels = plane_transform("db2", *shape[-2:], 3).levels
                bits = expected_bits(values, step, levels)
                wrong += not np.isfinite(bits).all() or bits.min() < 1
    return wrong


@case(
    "Samples that no view shows, in all or all but one place",
    hazard="a block that is all missing",
    treatment="invisible samples take what the kept coefficients give; with none visible all is 0",
    reference="the visible samples",
    bound=1e-5,
    unit="of the visible energy",
    outcome="finite; everything kept reproduces what is visible",
)
def test_missing_samples():
    worst = 0.0
    shape = (1, 1, 4, 8, 8)
    rng = np.random.default_rng(0)
    values = rng.normal(size=shape).astype(np.float32)
    for seen in (np.zeros(shape[1:], bool), np.arange(256).reshape(shape[1:]) == 77, rng.random(shape[1:]) < 0.3):
        for count in (0, 1, values.size):
            found = keep_largest([values], [seen], [block_of(shape)], count=count)
            energy = float((values[0][seen] ** 2).sum()) or 1.0
            finite = np.isfinite(found.coefficients[0]).all() and np.isfinite(found.error)
            worst = max(worst, (found.error / energy if count == values.size else 0.0) if finite else np.inf)
    return worst


@case(
    "Extents of tiles that nothing sees",
    hazard="minima over nothing",
    treatment="length 0 and the smallest rectangle",
    bound=0,
    unit="wrong extents",
    outcome="within the tile, holding all that is used",
)
def test_extents():
    wrong = 0
    for size in (4, 8, 50, 64):
        for used in ([], [(0, 0)], [(size - 1, size - 1)], [(0, size - 1), (size - 1, 0)]):
            inside = np.zeros((size, size), bool)
            for place in used:
                inside[place] = True
            for seen in (np.zeros(5, bool), np.eye(5, dtype=bool)[4], np.ones(5, bool)):
                found = extent_of(seen, inside, full_turn=True, arcs=True)
                part = inside[found.texels]
                wrong += part.shape != (found.rows, found.columns) or part.sum() != inside.sum()
                wrong += (found.length == 0) != (not seen.any())
    return wrong


@case(
    "PSNR of no error and of no samples",
    hazard="log of 0, 0/0",
    treatment="200 dB",
    bound=0,
    unit="wrong values of 3",
    outcome="200 dB at most, finite",
)
def test_psnr_of_nothing():
    return sum(psnr(error, samples) != 200.0 for error, samples in ((0.0, 5), (0.0, 0), (1e-300, 5)))


@case(
    "Cosine transform of many views",
    hazard="orthonormality of a matrix made of cosines",
    treatment="evaluated in float64",
    reference="mpmath, 50 digits",
    bound=1e-14,
    outcome="orthonormal at 1 to 64 views",
)
def test_cosine_matrix():
    worst = 0.0
    for length in (1, 2, 3, 7, 36, 64):
        found = cosine_matrix(length)
        with mpmath.workdps(50):
            half = mpmath.mpf(1) / 2
            turn = [[mpmath.pi * k * (m + half) / length for m in range(length)] for k in range(length)]
            scale = [mpmath.sqrt(mpmath.mpf(2 if k else 1) / length) for k in range(length)]
            exact = np.array([[float(s * mpmath.cos(t)) for t in row] for s, row in zip(scale, turn, strict=True)])
        worst = max(worst, np.abs(found - exact).max(), np.abs(found @ found.T - np.eye(length)).max())
    return worst


@case(
    "Reconstruction after leaving small coefficients out",
    hazard="an error that is not the energy left out, as with symmetric ends",
    treatment="orthonormal ends",
    reference="the energy of what was left out",
    bound=1e-12,
    outcome="error = discarded energy, at any threshold",
)
def test_parseval():
    values = np.random.default_rng(8).normal(size=(2, 1, 4, 16, 12))
    block = block_of(values.shape)
    coefficients = block.forward(values)

    def measure(threshold):
        kept = np.where(np.abs(coefficients) >= threshold, coefficients, 0)
        error = np.sum((block.inverse(kept) - values) ** 2)
        return abs(error - np.sum((coefficients - kept) ** 2)) / np.sum(values**2)

    return worst_over(measure, powers_of_ten(-6, 2), examples=30)
