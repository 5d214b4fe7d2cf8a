"""Whether a plane scene shows gloss: a lobe fitted to a sample of its pixels, judged against chance and noise."""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.flags import FitFlag
from nishiki.brdf.scene import fit_scene
from nishiki.brdf.specular_histogram import SpecularHistogram
from nishiki.model_selection.decision import Decision

LIMIT = 1.0  # specular radiance of the brightest hundredth, in standard deviations of the samples about the model
BRIGHTEST = 0.01
NEAR = 0.15  # radians from the mirror direction: where a highlight would be looked for, and may be saturated
SPOILT, BESIDE = 0.05, 2.0  # share of unusable samples there that leaves the question open, and times that elsewhere
FEWEST = 200  # samples below which nothing is said
OVERRIDE = "brdf.specular: keep"


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
    if samples.sum() < FEWEST:
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


def decided(evidence: list[Evidence], setting: str, *, limit: float = LIMIT) -> Decision:
    """What was decided of a scene's regions, for the log and the diagnostics; the strongest region's figures."""
    kept = sum(e.keep for e in evidence)
    strongest = max(evidence, key=lambda e: (e.keep, e.ratio))
    if setting != "auto":
        words = {"keep": "specular part kept", "drop": "no gloss: Lambert"}[setting]
        return Decision("specular", words, "set", None, None, "not measured", OVERRIDE)
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
    return Decision("specular", words, criterion, strongest.ratio, limit, loss, OVERRIDE)
