"""The coder's start state: trained on the object's own tiles, stored once, the same for every tile."""

from __future__ import annotations

import zlib

import numpy as np

from nishiki.codec.entropy import CONTEXTS, GROUPS, Coded, Model
from nishiki.codec.range_coder import INPUTS
from nishiki.errors import UserError

CONFIDENCE = np.array([0, 4, 12, 24], np.int64)
LOGIT_STEPS = 2  # finer steps save fewer bytes of the tiles than they cost in the header
WEIGHT_UNIT = 4096
RARE = 80  # contexts used less often in the whole object are left untrained


def train(coded: list[Coded], *, share: float = 0.25, limit: int = 24) -> Model:
    """The common start state after a round of coding: frequencies under each context, mean mixer weights.

    A context starts as sure as if it had been seen `share` of its mean uses a tile, at most `limit` times. The result
    goes through `pack`'s rounding, so that encoder and decoder start alike.
    """
    model = Model.untrained()
    if not coded:
        return model
    tally = sum(part.tally for part in coded)
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
    chance = np.where(known, np.clip(chance, 64, 2**22 - 64), Model.untrained().chance).astype(np.int64)
    seen = np.where(known, CONFIDENCE[grades], 0)
    return Model(chance, seen, weights.astype(np.int64) * WEIGHT_UNIT, (logits, grades, weights))


def pack(model: Model) -> bytes:
    """A trained model as bytes, compressed; no bytes for an untrained one."""
    if not model.rounded:
        return b""
    return zlib.compress(b"".join(part.tobytes() for part in model.rounded), 9)


def unpack(data: bytes) -> Model:
    """Inverse of `pack`. UserError where the bytes are not those of a model of this version."""
    if not data:
        return Model.untrained()
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
