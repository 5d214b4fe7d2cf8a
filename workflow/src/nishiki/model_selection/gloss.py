"""Decide whether a plane scene or an object on a turntable shows gloss."""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.fit import FitFlag
from nishiki.brdf.gloss_profile import SpecularHistogram
from nishiki.brdf.scene import fit_scene
from nishiki.model_selection.decision import Decision

LIMIT = 1.0  # specular radiance of the brightest hundredth, in standard deviations of the samples about the model
BRIGHTEST = 0.01
NEAR = 0.15  # radians from the mirror direction: where a highlight would be looked for, and may be saturated
SPOILT, BESIDE = 0.05, 2.0  # share of unusable samples there that leaves the question open, and times that elsewhere
FEWEST_SAMPLES = 200  # samples below which nothing is said


@dataclass(frozen=True)
class Evidence:
    """What a sample of pixels says of gloss; radiances relative to a white diffuser that faces the lamp.

    keep: whether the specular part is worth having; why, in words; ratio: `brightest` / `noise`; brightest: root mean
    square of the fitted specular radiance over the hundredth of the samples where it is largest; everywhere: over all;
    noise: standard deviation of the samples about Lambert's law and that lobe, robust; samples.
    """

    keep: bool
    why: str
    ratio: float
    brightest: float
    everywhere: float
    noise: float
    samples: int


def gloss_evidence(
    phi: np.ndarray,
    residual: np.ndarray,
    attenuation: np.ndarray,
    usable: np.ndarray,
    *,
    sigma: np.ndarray | float = 0.0,
    refractive_index: float = 1.45,
) -> Evidence:
    """Evidence from samples of any shape.

    phi: angle of normal and half vector, radians; residual: observation minus Lambert's term; attenuation: F G / cos
    theta_r (Tominaga and Tanaka 2004, eq. 10), 0 where the sample is neither lit nor seen; usable: False where it is
    saturated or masked;
    sigma: deviation of the normals per tangent axis, radians.

    A lobe is fitted to the sample as to a scene (`nishiki.brdf.scene`); it has to pass that fit's F test (12) and to
    reach LIMIT standard deviations of the residuals in the hundredth of the samples where it is brightest. Below
    that, leaving it out adds less than the samples scatter anyway. Where many samples near the mirror direction are
    unusable, gloss may have saturated them: the specular part is kept.
    """
    lit = attenuation > 0
    samples = lit & usable
    noise = float(1.4826 * np.median(np.abs(residual[samples]))) if samples.any() else 0.0
    if samples.sum() < FEWEST_SAMPLES:
        return Evidence(True, "too few samples to decide", 0.0, 0.0, 0.0, noise, int(samples.sum()))
    near = lit & (phi < NEAR)
    spoilt, beside = (1 - float(usable[part].mean()) if part.any() else 0.0 for part in (near, lit & ~near))
    if spoilt > SPOILT and spoilt > BESIDE * beside:
        why = (
            f"{100 * spoilt:.0f} % of the samples near the mirror direction are unusable: gloss may have saturated them"
        )
        return Evidence(True, why, 0.0, 0.0, 0.0, noise, int(samples.sum()))
    at, deviation = np.asarray(attenuation)[samples], np.broadcast_to(sigma, phi.shape)[samples]
    histogram = SpecularHistogram.empty(refractive_index=refractive_index)
    fit = fit_scene(histogram.add_samples(phi[samples], residual[samples], at, sigma=deviation), lobes=1)[0]
    if fit.flags & (FitFlag.NO_HIGHLIGHT | FitFlag.TOO_FEW):
        return Evidence(False, "no lobe is significant", 0.0, 0.0, 0.0, noise, int(samples.sum()))
    with np.errstate(under="ignore"):
        specular = fit.beta[0] * np.exp2(-((phi[samples] / fit.gamma[0]) ** 2)) * at
    noise = float(1.4826 * np.median(np.abs(residual[samples] - specular)))  # a wide lobe is no scatter
    strongest = np.sort(specular)[-max(1, int(BRIGHTEST * specular.size)) :]
    brightest, everywhere = (float(np.sqrt(np.mean(values**2))) for values in (strongest, specular))
    ratio = brightest / max(noise, 1e-30)
    return Evidence(
        ratio > LIMIT,
        "a lobe stands out" if ratio > LIMIT else "its lobe does not stand out of the scatter",
        float(min(ratio, 1e6)),
        brightest,
        everywhere,
        noise,
        int(samples.sum()),
    )


def decide_gloss(evidence: list[Evidence], setting: str, *, limit: float = LIMIT) -> Decision:
    """Decide whether a scene shows gloss, with the strongest region's figures for log and diagnostics."""
    kept = sum(e.keep for e in evidence)
    strongest = max(evidence, key=lambda e: (e.keep, e.ratio))
    if setting != "auto":
        words = {"keep": "specular part kept", "drop": "no gloss: Lambert"}[setting]
        return Decision("specular", words, "set", None, None, "not measured", "brdf.specular: keep")
    if kept:
        part = "" if kept == len(evidence) else f" in {kept} of {len(evidence)} regions"
        words, loss = f"specular part kept{part}: {strongest.why}", "nothing"
    else:
        words = f"no gloss: Lambert ({strongest.why})"
        loss = (
            f"radiance of {strongest.brightest:.2g} of white in the hundredth of the samples where gloss is brightest, "
            f"{strongest.everywhere:.2g} over all (rms); they scatter by {strongest.noise:.2g}"
        )
    criterion = "specular radiance of the brightest hundredth of a sample, in standard deviations of its scatter"
    return Decision("specular", words, criterion, strongest.ratio, limit, loss, "brdf.specular: keep")


LIMIT_DB = 0.1  # by which a lobe has to bring unseen observations nearer
SIGMAS = tuple(np.geomspace(0.03, 0.8, 9))  # radians
FOLDS = 3
FEWEST_TEXELS = 30  # texels below which nothing is said


@dataclass(frozen=True)
class Gain:
    """Hold the gain of a lobe.

    keep: whether the specular part is worth having; gain_db: of unseen observations; sigma: of the lobe, radians;
    error: root mean square weighted error of unseen observations with Lambert's term alone; texels.
    """

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
    """Measure by cross-validation in FOLDS parts how much better a lobe predicts unseen observations.

    M. Stone, Cross-validatory choice and assessment of statistical predictions, J. R. Stat. Soc. B 36, 1974.

    values (texels, observations, channels); diffuse, attenuation, alpha (texels, observations): what multiplies K_d and
    the lobe, and the angle to the mirror direction, radians; weights (texels, observations): 0 where not visible.

    Every texel's K_d and K_s are fitted to two thirds of its observations, sigma being one for the object, the best in
    those; the rest is predicted. Noise and misfit can be fitted but not predicted: on a matt object a lobe
    gains nothing, or costs. Texels count that were observed 2 FOLDS times or more.
    """
    part = (np.cumsum(weights > 0, axis=1) - 1) % FOLDS  # observations that count, in turn
    enough = (weights > 0).sum(axis=1) >= 2 * FOLDS
    if enough.sum() < FEWEST_TEXELS:
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


def decide_object_gloss(gain: Gain | None, setting: str, *, limit_db: float = LIMIT_DB) -> Decision:
    """Decide whether an object shows gloss; gain: None where the setting decides."""
    if gain is None:
        words = {"keep": "specular part kept", "drop": "no gloss: Lambert"}[setting]
        return Decision("specular", words, "set", None, None, "not measured", "object_brdf.specular: keep")
    criterion = "decibels by which a lobe predicts unseen observations of a sample of texels better"
    if gain.keep:
        words, loss = "specular part kept", "nothing"
    else:
        words = "no gloss: Lambert"
        loss = f"{max(gain.gain_db, 0.0):.2g} dB of the model alone on unseen observations"
    return Decision("specular", words, criterion, gain.gain_db, limit_db, loss, "object_brdf.specular: keep")
