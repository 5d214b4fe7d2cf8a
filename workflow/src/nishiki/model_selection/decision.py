"""State a measured decision in a stage's diagnostics and in its log, and decide whether a scene shows gloss."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from nishiki.brdf.texels.model import facet_lobe


@dataclass(frozen=True)
class Decision:
    """One omission, or inclusion, by a measured criterion."""

    what: str  # the name it has in the diagnostics
    decision: str  # what was decided, in words
    criterion: str  # what was measured, in words
    measured: float | None  # its value, None where a setting decided
    limit: float | None  # what it was compared with, None likewise
    loss: str  # what leaving it out costs, with its unit
    override: str  # the setting that decides otherwise

    def as_dict(self) -> dict[str, dict]:
        """Return {subject: plain values}, to be merged into the block `economy` of a stage's diagnostics."""
        named = asdict(self)
        return {named.pop("what"): {name: _plain(value) for name, value in named.items()}}

    def __str__(self) -> str:
        """Format one line of the log."""
        numbers = ""
        if self.measured is not None:
            numbers = f" ({self.criterion}: {self.measured:.4g}"
            numbers += f", limit {self.limit:.4g})" if self.limit is not None else ")"
        return f"{self.what}: {self.decision}{numbers}; loss: {self.loss}; {self.override}"


def economy(*decisions: Decision | None) -> dict[str, dict]:
    """Build the block `economy` of a stage's diagnostics; None stands for no decision."""
    block: dict[str, dict] = {}
    for decision in decisions:
        if decision is not None:
            block |= decision.as_dict()
    return block


def _plain(value):
    """Round floats to six digits: more would only differ from machine to machine."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def decide_gloss(finishes: Sequence[dict], kept: np.ndarray, setting: str) -> Decision:
    """Decide on the gloss of a scene's finishes, by held-out captured lamps.

    finishes : of the diagnostics of `normals`; kept (finishes,) bool: whether their gloss is.
    """
    part = "" if kept.all() or not kept.any() else f" on {kept.sum()} of {len(kept)} finishes"
    words = f"specular part kept{part}" if kept.any() else "no gloss: Lambert"
    if setting != "auto":
        return Decision("specular", words, "set", None, None, "not measured", "brdf.specular: keep")
    gains = [finish.get("gloss_gain_de00") for finish in finishes]
    told = [(finish["share"], gain) for finish, gain in zip(finishes, gains, strict=True) if gain is not None]
    gain = sum(share * gain for share, gain in told) if told else None
    loss = "nothing" if gain is None or kept.any() or gain <= 0 else f"at most {gain:.2g} CIEDE2000"
    criterion = "CIEDE2000 of captured lamps left out that gloss takes off"
    return Decision("specular", words, criterion, gain, None if gain is None else 0.0, loss, "brdf.specular: keep")


LIMIT_DB = 0.1  # by which a lobe has to bring unseen observations nearer
SIGMAS = tuple(np.geomspace(0.03, 0.8, 9))  # radians
FOLDS = 3  # of cross-validation
FEWEST_TEXELS = 30  # texels below which nothing is said


@dataclass(frozen=True)
class Gain:
    """Gain of a lobe."""

    keep: bool  # whether the specular part is worth having
    gain_db: float  # of unseen observations
    sigma: float  # of the lobe, radians
    error: float  # root mean square weighted error of unseen observations with Lambert's term alone; texels
    texels: int


def unseen_gain(
    values: np.ndarray, diffuse: np.ndarray, attenuation: np.ndarray, alpha: np.ndarray, weights: np.ndarray
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
        lobes = [attenuation * facet_lobe(alpha**2, sigma) for sigma in SIGMAS]
    inside, outside = np.zeros(len(SIGMAS) + 1), np.zeros(len(SIGMAS) + 1)
    for fold in range(FOLDS):
        seen, unseen = weights * (part != fold), weights * (part == fold)
        for k, lobe in enumerate([np.zeros_like(alpha), *lobes]):
            left = values - _fit_strengths(values, diffuse, lobe, seen)
            inside[k] += np.sum(seen[..., None] * left**2)
            outside[k] += np.sum(unseen[..., None] * left**2)
    best = 1 + int(np.argmin(inside[1:]))
    gain = 10 * np.log10(max(outside[0], 1e-30) / max(outside[best], 1e-30))
    error = np.sqrt(outside[0] / max(weights.sum() * values.shape[2], 1e-30))
    return Gain(bool(gain > LIMIT_DB), float(gain), float(SIGMAS[best - 1]), float(error), len(values))


def _fit_strengths(values: np.ndarray, diffuse: np.ndarray, lobe: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit K_d q + K_s s at all observations, every texel and channel, K_d and K_s >= 0.

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


LEAST_TURNED = 0.95  # right normals of a simulated ball gained 4 %, those of hulls 20 to 40


def decide_normals(measured: tuple[float, float] | None) -> tuple[bool, Decision]:
    """Decide whether an object's normals follow its shading; measured: of `refine_normals`, None where none is."""
    override = "object_brdf.normals: mesh"
    if measured is None:
        return False, Decision(
            "normals", "those of the mesh", "set, fitted light, or too few views", None, None, "not measured", override
        )
    before, after = measured
    turned, share = after < LEAST_TURNED * before, after / before if before else 1.0
    words = "turned by shading" if turned else "those of the mesh"
    loss = "nothing" if turned else f"{100 * max(1 - share, 0):.2g} % of the deviation of hidden views"
    criterion = "deviation of hidden views with turned normals, over that with those of the mesh"
    return turned, Decision("normals", words, criterion, share, LEAST_TURNED, loss, override)


def decide_object_gloss(gain: Gain | None, setting: str) -> Decision:
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
    return Decision("specular", words, criterion, gain.gain_db, LIMIT_DB, loss, "object_brdf.specular: keep")
