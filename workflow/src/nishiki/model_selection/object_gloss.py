"""Whether an object on a turntable shows gloss: observations predicted from the others, with a lobe and without."""

from dataclasses import dataclass

import numpy as np

from nishiki.model_selection.decision import Decision

LIMIT_DB = 0.1  # by which a lobe has to bring unseen observations nearer
SIGMAS = tuple(np.geomspace(0.03, 0.8, 9))  # radians
FOLDS = 3
FEWEST = 30  # texels below which nothing is said
OVERRIDE = "object_brdf.specular: keep"


@dataclass(frozen=True)
class Gain:
    """keep: whether the specular part is worth having; gain_db: of unseen observations; sigma: of the lobe, radians;
    error: root mean square weighted error of unseen observations with Lambert's term alone; texels."""

    keep: bool
    gain_db: float
    sigma: float
    error: float
    texels: int


def unseen_gain(
    values: np.ndarray,
    diffuse: np.ndarray,
    attenuation: np.ndarray,
    alpha: np.ndarray,
    weights: np.ndarray,
) -> Gain:
    """How much better a lobe predicts observations that its fit has not seen (cross-validation in FOLDS parts; M.
    Stone, Cross-validatory choice and assessment of statistical predictions, J. R. Stat. Soc. B 36, 1974).

    values (texels, observations, channels); diffuse, attenuation, alpha (texels, observations): what multiplies K_d and
    the lobe, and the angle to the mirror direction, radians; weights (texels, observations): 0 where not visible.

    Every texel's K_d and K_s are fitted to two thirds of its observations, sigma being one for the object, the best in
    those; the rest is predicted. Noise and misfit can be fitted but not predicted: on a matt object a lobe
    gains nothing, or costs. Texels count that were observed 2 FOLDS times or more.
    """
    part = _parts(weights > 0)
    enough = (weights > 0).sum(axis=1) >= 2 * FOLDS
    if enough.sum() < FEWEST:
        return Gain(True, 0.0, 0.0, 0.0, int(enough.sum()))
    values, diffuse, attenuation = (array[enough].astype(np.float64) for array in (values, diffuse, attenuation))
    alpha, weights, part = alpha[enough].astype(np.float64), weights[enough].astype(np.float64), part[enough]
    level = np.sum(weights[..., None] * values, axis=(1, 2)) / np.maximum(weights.sum(axis=1), 1e-30)
    weights = weights * (level > 0)[:, None]
    with np.errstate(under="ignore"):
        lobes = [attenuation * np.exp(-0.5 * (alpha / sigma) ** 2) for sigma in SIGMAS]
    inside, outside = np.zeros(len(SIGMAS) + 1), np.zeros(len(SIGMAS) + 1)
    for fold in range(FOLDS):
        seen, unseen = weights * (part != fold), weights * (part == fold)
        for k, lobe in enumerate([np.zeros_like(alpha), *lobes]):
            left = values - _fitted(values, diffuse, lobe, seen)
            inside[k] += np.sum(seen[..., None] * left**2)
            outside[k] += np.sum(unseen[..., None] * left**2)
    best = 1 + int(np.argmin(inside[1:]))
    gain = 10 * np.log10(max(outside[0], 1e-30) / max(outside[best], 1e-30))
    error = np.sqrt(outside[0] / max(weights.sum() * values.shape[2], 1e-30))
    return Gain(bool(gain > LIMIT_DB), float(gain), float(SIGMAS[best - 1]), float(error), len(values))


def _parts(seen: np.ndarray) -> np.ndarray:
    """Part (0 .. FOLDS - 1) of each observation, in turn among those that are seen."""
    return (np.cumsum(seen, axis=1) - 1) % FOLDS


def _fitted(values: np.ndarray, diffuse: np.ndarray, lobe: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """K_d q + K_s s at all observations, every texel and channel, K_d and K_s >= 0.

    K_s is the texel's own, drawn towards that of the object by as much as an average texel knows of it: a texel that is
    not seen near the mirror direction takes the object's.
    """
    a, b, d = (np.sum(weights * x * y, axis=1)[:, None] for x, y in ((lobe, lobe), (lobe, diffuse), (diffuse, diffuse)))
    u, v = (np.einsum("to,toc->tc", weights * x, values) for x in (lobe, diffuse))
    lit = np.where(d > 0, d, 1)
    information, correlation = np.maximum(a - b * b / lit, 0), u - b * v / lit  # K_d eliminated
    mean_ks = np.maximum(correlation.sum(axis=0) / max(information.sum(), 1e-30), 0)
    pull = information.mean() + 1e-30
    ks = np.maximum((correlation + pull * mean_ks) / (information + pull), 0)
    kd = np.maximum((v - b * ks) / lit, 0)
    return diffuse[..., None] * kd[:, None] + lobe[..., None] * ks[:, None]


def decided(gain: Gain | None, setting: str, *, limit_db: float = LIMIT_DB) -> Decision:
    """What was decided, for the log and the diagnostics; gain: None where a setting decided."""
    if gain is None:
        words = {"keep": "specular part kept", "drop": "no gloss: Lambert"}[setting]
        return Decision("specular", words, "set", None, None, "not measured", OVERRIDE)
    criterion = "decibels by which a lobe predicts unseen observations of a sample of texels better"
    if gain.keep:
        words, loss = "specular part kept", "nothing"
    else:
        words = "no gloss: Lambert"
        loss = f"{max(gain.gain_db, 0.0):.2g} dB of the model alone on unseen observations"
    return Decision("specular", words, criterion, gain.gain_db, limit_db, loss, OVERRIDE)
