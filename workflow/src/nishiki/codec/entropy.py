"""Code the quantised coefficients of a tile, coarse bands first, from a start state trained on the object.

A block (channels, frequencies, rows, columns) of integers is sent band by band from the coarsest to the finest; inside
a band frequency by frequency and channel by channel, so that a decoder may stop after any band. A band of one
frequency and channel that is all zero costs one flag. Otherwise each coefficient sends zero or not, its sign, and its
magnitude in unary. Contexts are neighbours in the plane, the parent in the coarser band, the frequency before, the
channels before, the bands of the same level before, and the place of the band. The learnt state at the start of every
tile is the same, trained on the object itself and stored once (`train`), so that tiles are independent.
"""

import zlib
from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.codec.range_coder import INPUTS, PLACE, UNIT, Coder, begin, code_bit, code_mixed, finish
from nishiki.errors import UserError

ZERO_SIZES = (128, 240, 144, 108, 720, 128)
MORE_SIZES = (24 * 8, 720 * 3, 25 * 6 * 3)
FLAG_SIZES = (36 * 8, 720, 36)
GROUPS = 8 * 3 * 3
OFFSETS = np.cumsum((0, *FLAG_SIZES, *ZERO_SIZES, *MORE_SIZES)).astype(np.int64)
CONTEXTS = int(OFFSETS[-1])
UNARY = 18  # decisions of a magnitude before its code goes on otherwise


@dataclass(frozen=True)
class Model:
    """The state at the start of a tile."""

    chance: np.ndarray  # (contexts,) int64 22-bit probabilities
    seen: np.ndarray  # (contexts,) int64 their weight
    weights: np.ndarray  # (groups, inputs) int64 of the mixers
    rounded: tuple = ()  # what `pack` stores

    @classmethod
    def initial(cls) -> "Model":
        """Return the initial assumption: ones are rare."""
        chance = np.full(CONTEXTS, 1 << 20, np.int64)
        weights = np.zeros((GROUPS, INPUTS), np.int64)
        weights[:, : INPUTS - 1] = int(0.3 * UNIT)
        return cls(chance, np.zeros(CONTEXTS, np.int64), weights)

    def coder(self, data: np.ndarray, *, decoding: bool) -> Coder:
        """Return a coder of bytes (n,) uint8 that starts in this state."""
        tally, state = np.zeros((CONTEXTS, 2), np.int32), np.zeros(4, np.int64)
        start = self.chance.astype(np.int32), self.seen.astype(np.uint8), tally, self.weights.copy()
        return Coder(*start, state, data, decoding)


@dataclass(frozen=True)
class CodedBlock:
    """A coded block."""

    data: bytes
    ends: np.ndarray  # (bands,) int64: bytes needed for each band and all before it
    tally: np.ndarray  # (contexts, 2) int32 zeros and ones coded under each context
    weights: np.ndarray  # (groups, inputs) and uses (groups,): mixers at the end


def bands_of(rows: int, columns: int, levels: int) -> np.ndarray:
    """List the bands, (bands, 7) int64, from coarse to fine.

    Columns: first row and column, rows, columns, level (1 finest), orientation (0 coarsest, 1 columns, 2 rows, 3 both),
    and the band of the parent or -1.
    """
    out = [(0, 0, rows >> levels, columns >> levels, levels + 1, 0, -1)]
    for level in range(levels, 0, -1):
        h, w = rows >> level, columns >> level
        for orientation, (row, column) in enumerate(((0, w), (h, 0), (h, w)), start=1):
            parent = len(out) - 3 if level < levels else -1
            out.append((row, column, h, w, level, orientation, parent))
    return np.array(out, np.int64)


def encode(values: np.ndarray, levels: int, model: Model) -> CodedBlock:
    """Encode integers (channels, frequencies, rows, columns) int32, magnitudes below 2^31."""
    values = np.ascontiguousarray(values, np.int32)
    coded, length = _encode_values(values, levels, model, 4 * values.size + 4096)
    if length > 4 * values.size + 4096:  # large magnitudes everywhere; the coder says what they take
        coded, _ = _encode_values(values, levels, model, length)
    return coded


def _encode_values(values: np.ndarray, levels: int, model: Model, size: int) -> tuple[CodedBlock, int]:
    """Encode into a buffer of `size` bytes; also return the bytes it takes: the coding is void where these are more."""
    bands = bands_of(values.shape[-2], values.shape[-1], levels)
    ends = np.zeros(len(bands), np.int64)
    coder = model.coder(np.empty(size, np.uint8), decoding=False)
    length = code_block(values, bands, len(bands), coder, ends)
    return CodedBlock(coder.data[:length].tobytes(), np.minimum(ends, length), coder.tally, coder.weights), length


def decode(data: bytes, shape: tuple[int, int, int, int], levels: int, model: Model, *, drop: int = 0) -> np.ndarray:
    """Invert `encode`: (channels, frequencies, rows, columns) int32; the `drop` finest levels stay zero, unread."""
    bands = bands_of(*shape[-2:], levels)
    bands_read = len(bands) - 3 * min(drop, levels)
    values = np.zeros(shape, np.int32)
    coder = model.coder(np.frombuffer(data, np.uint8).copy(), decoding=True)
    code_block(values, bands, bands_read, coder, np.zeros(len(bands), np.int64))
    return values


@njit(cache=True, nogil=True, error_model="numpy")
def code_block(values, bands, count, coder, ends):
    """Code the first `count` bands; return the number of bytes written (encoding)."""
    begin(coder.state, coder.data, coder.decoding)
    channels, frequencies = values.shape[0], values.shape[1]
    filled = np.zeros((bands.shape[0], frequencies, channels), np.int64)
    for b in range(count):
        for k in range(frequencies):
            for c in range(channels):
                band = bands[b]
                inside = values[c, k, band[0] : band[0] + band[2], band[1] : band[1] + band[3]]
                some = 0 if coder.decoding or not inside.any() else 1
                some = code_flag(some, filled, bands, b, k, c, coder)
                filled[b, k, c] = some
                if some:
                    code_plane(values, filled, bands, b, k, c, coder)
        ends[b] = coder.state[PLACE] + 4
    return coder.state[PLACE] if coder.decoding else finish(coder.state, coder.data)


@njit(cache=True, nogil=True, error_model="numpy")
def place_class(k, c, level, orientation):
    """Combine frequency (10 classes), channel (3), level (8), orientation (3) in one number below 720."""
    f = k
    if k >= 4:
        f = 4 if k < 6 else 5 if k < 9 else 6 if k < 13 else 7 if k < 20 else 8 if k < 36 else 9
    turn = 0 if orientation == 0 else 1 if orientation < 3 else 2
    return ((f * 3 + min(c, 2)) * 8 + min(level, 7)) * 3 + turn


@njit(cache=True, nogil=True, error_model="numpy")
def code_flag(some, filled, bands, b, k, c, coder):
    """Code whether the band has any coefficient at this frequency and channel."""
    parent = bands[b, 6]
    before = filled[b, k - 1, c] if k > 0 else 2
    earlier = filled[b, k - 2, c] if k > 1 else 1
    above = filled[parent, k, c] if parent >= 0 else 2
    beside = filled[b, k, c - 1] if c > 0 else 2
    turned = filled[b - 1, k, c] if bands[b, 5] > 1 else 2
    contexts = np.empty(INPUTS, np.int64)
    contexts[0] = OFFSETS[0] + ((before * 3 + above) * 4 + beside) * 8 + min(bands[b, 4], 7)
    contexts[1] = OFFSETS[1] + place_class(k, c, bands[b, 4], bands[b, 5])
    contexts[2] = OFFSETS[2] + ((turned * 3 + before) * 2 + earlier) * 2 + min(c, 1)
    return code_mixed(some, contexts, 3, 0, coder)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _around(plane, band, i, j):
    """Sum twice the magnitude at (i, j) of a band and those of its four neighbours inside the band."""
    r, c = band[0], band[1]
    total = 2 * abs(plane[r + i, c + j])
    if i > 0:
        total += abs(plane[r + i - 1, c + j])
    if i + 1 < band[2]:
        total += abs(plane[r + i + 1, c + j])
    if j > 0:
        total += abs(plane[r + i, c + j - 1])
    if j + 1 < band[3]:
        total += abs(plane[r + i, c + j + 1])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _grade(value):
    """Return one of six grades of a sum of magnitudes: 0, 1, 2, 3-4, 5-8, above."""
    if value < 3:
        return value
    return 3 if value < 5 else 4 if value < 9 else 5


@njit(cache=True, nogil=True, error_model="numpy")
def fine_grade(value):
    """Return one of 24 grades of a sum of magnitudes, four an octave."""
    if value < 4:
        return value
    octave = 0
    while (value >> octave) >= 8:
        octave += 1
    return min(4 * octave + (value >> octave), 23)


@njit(cache=True, nogil=True, error_model="numpy")
def code_plane(values, filled, bands, b, k, c, coder):
    """Code one band of one frequency and channel, row by row."""
    state, data, decoding = coder.state, coder.data, coder.decoding
    band = bands[b]
    r, q, height, width, level, orientation, parent = band
    plane = values[c, k]
    place = place_class(k, c, level, orientation)
    contexts = np.empty(INPUTS, np.int64)
    has_parent = parent >= 0 and filled[parent, k, c] == 1
    has_before, has_earlier = k > 0 and filled[b, k - 1, c] == 1, k > 1 and filled[b, k - 2, c] == 1
    has_first, has_second = c > 0 and filled[b, k, 0] == 1, c > 1 and filled[b, k, c - 1] == 1
    has_turned = orientation > 1 and (filled[b - 1, k, c] == 1 or (orientation == 3 and filled[b - 2, k, c] == 1))
    grain = min(level, 7)
    turn = 0 if orientation == 0 else 1 if orientation < 3 else 2
    for i in range(height):
        for j in range(width):
            w = abs(plane[r + i, q + j - 1]) if j > 0 else 0
            n = abs(plane[r + i - 1, q + j]) if i > 0 else 0
            nw = abs(plane[r + i - 1, q + j - 1]) if i > 0 and j > 0 else 0
            ne = abs(plane[r + i - 1, q + j + 1]) if i > 0 and j + 1 < width else 0
            far = (abs(plane[r + i, q + j - 2]) if j > 1 else 0) + (abs(plane[r + i - 2, q + j]) if i > 1 else 0)
            above = _around(plane, bands[parent], i >> 1, j >> 1) if has_parent else 0
            before = _around(values[c, k - 1], band, i, j) if has_before else 0
            earlier = _around(values[c, k - 2], band, i, j) if has_earlier else 0
            beside = _around(values[0, k], band, i, j) if has_first else 0
            if has_second:
                beside += _around(values[c - 1, k], band, i, j)
            turned = 0
            if has_turned:
                turned = _around(plane, bands[b - 1], i, j)
                if orientation == 3:
                    turned += _around(plane, bands[b - 2], i, j)
            near, diagonal = w + n, nw + ne
            total = 6 * near + 3 * diagonal + 2 * far + 2 * above + 3 * before + earlier + 2 * beside + 2 * turned
            amount = fine_grade(total)
            close = min(near, 2)
            # zero or not
            contexts[0] = OFFSETS[3] + ((min(w, 3) * 4 + min(n, 3)) * 4 + min(diagonal, 3)) * 2 + min(far, 1)
            contexts[1] = OFFSETS[4] + ((_grade(above) * 6 + _grade(turned)) * 3 + close) * 2 + (1 if grain < 2 else 0)
            contexts[2] = OFFSETS[5] + ((_grade(before) * 4 + min(earlier, 3)) * 3 + close) * 2 + (1 if k < 4 else 0)
            contexts[3] = OFFSETS[6] + ((_grade(beside) * 3 + close) * 3 + min(c, 2)) * 2 + (1 if grain < 2 else 0)
            contexts[4] = OFFSETS[7] + place
            contexts[5] = OFFSETS[8] + amount * 5 + min(grain - 1, 4)
            group = (1 + (1 if total > 0 else 0)) * 24 + grain * 3 + turn
            value = plane[r + i, q + j]
            bit = code_mixed(1 if value != 0 else 0, contexts, 6, group, coder)
            if bit == 0:
                continue
            negative = code_bit(1 if value < 0 else 0, 32768, state, data, decoding)
            size = abs(value)
            if decoding:
                size = 1
            magnitude = 1
            while magnitude < UNARY:
                step = min(magnitude - 1, 7)
                contexts[0] = OFFSETS[9] + amount * 8 + step
                contexts[1] = OFFSETS[10] + place * 3 + min(step, 2)
                contexts[2] = OFFSETS[11] + ((min(w, 4) * 5 + min(n, 4)) * 6 + _grade(before)) * 3 + min(step, 2)
                more = code_mixed(1 if size > magnitude else 0, contexts, 3, 1 + min(step, 2) * 3 + turn, coder)
                if more == 0:
                    break
                magnitude += 1
            if magnitude == UNARY:
                magnitude = code_rest(size, state, data, decoding)
            if decoding:
                plane[r + i, q + j] = -magnitude if negative else magnitude


@njit(cache=True, nogil=True, error_model="numpy")
def code_rest(size, state, data, decoding):
    """Code magnitudes from UNARY on, by Elias' gamma code of the excess."""
    rest = size - UNARY + 1
    bits = 0
    if not decoding:
        while (rest >> (bits + 1)) > 0:
            bits += 1
    length = 0
    # Magnitudes have 31 bits: a longer run of ones is no stream of ours, and zeros beyond its end would never stop.
    while length < 31 and code_bit(1 if length < bits else 0, 32768, state, data, decoding):
        length += 1
    value = 1
    for k in range(length - 1, -1, -1):
        value = 2 * value + code_bit((rest >> k) & 1, 32768, state, data, decoding)
    return value + UNARY - 1


CONFIDENCE = np.array([0, 4, 12, 24], np.int64)
LOGIT_STEPS = 2  # finer steps save fewer bytes of the tiles than they cost in the header
WEIGHT_UNIT = 4096  # by which stored weights of 8 bits are coarser than those in use
RARE = 80  # contexts used less often in the whole object are left untrained


def train(coded: list[CodedBlock], *, share: float = 0.25, limit: int = 24) -> Model:
    """Estimate the common start state after a round of coding: frequencies of each context, mean mixer weights.

    A context starts as sure as if it had been seen `share` of its mean uses a tile, at most `limit` times. The result
    goes through `pack`'s rounding, so that encoder and decoder start alike.
    """
    model = Model.initial()
    if not coded:
        return model
    tally = sum(part.tally.astype(np.int64) for part in coded)
    uses = tally.sum(axis=1)
    logit = np.log((tally[:, 1] + 0.4) / (tally[:, 0] + 0.4))
    sure = np.minimum(uses / len(coded) * share, limit)
    grade = np.searchsorted(CONFIDENCE, sure, side="right") - 1
    logits = np.where(uses > RARE, np.clip(np.round(logit * LOGIT_STEPS), -110, 110), 127).astype(np.int8)
    mean = np.mean([part.weights for part in coded], axis=0)
    weights = np.clip(np.round(mean / WEIGHT_UNIT), -127, 127).astype(np.int8)
    return _model_of(logits, np.where(uses > RARE, grade, 0).astype(np.uint8), weights)


def _model_of(logits: np.ndarray, grades: np.ndarray, weights: np.ndarray) -> Model:
    known = logits != 127
    chance = np.round(2**22 / (1 + np.exp(-logits.astype(np.float64) / LOGIT_STEPS)))
    chance = np.where(known, np.clip(chance, 64, 2**22 - 64), Model.initial().chance).astype(np.int64)
    seen = np.where(known, CONFIDENCE[grades], 0)
    return Model(chance, seen, weights.astype(np.int64) * WEIGHT_UNIT, (logits, grades, weights))


def pack(model: Model) -> bytes:
    """Pack a trained model as compressed bytes; no bytes for an untrained one."""
    if not model.rounded:
        return b""
    return zlib.compress(b"".join(part.tobytes() for part in model.rounded), 9)


def unpack(data: bytes) -> Model:
    """Invert `pack`. UserError where the bytes are not those of a model of this version."""
    if not data:
        return Model.initial()
    try:
        raw = zlib.decompress(data)
    except zlib.error as error:
        raise UserError(f"residual: the coder's start state is damaged ({error}); run the stage again") from None
    if len(raw) != 2 * CONTEXTS + GROUPS * INPUTS:
        raise UserError("residual: the coder's start state is of another version; run the stage again")
    values = np.frombuffer(raw, np.int8)
    return _model_of(
        values[:CONTEXTS],
        values[CONTEXTS : 2 * CONTEXTS].astype(np.uint8),
        values[2 * CONTEXTS :].reshape(GROUPS, INPUTS),
    )
