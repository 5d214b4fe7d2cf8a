"""How many spectral bases camera and lamp support."""

from dataclasses import dataclass

import numpy as np

from nishiki.colour.basis import principal_basis
from nishiki.model_selection.decision import Decision

LOSS = 0.002  # of the expected error: with ordinary cameras the measured paints ask for no less (docs/economy.md)
MOST = 16
OVERRIDE = "spectra.bases: a number"


@dataclass(frozen=True)
class Bases:
    """count: bases that are enough; loss: what they add to the expected error, as a part of it; counts, losses: of
    every number that was looked at."""

    count: int
    loss: float
    counts: tuple[int, ...]
    losses: tuple[float, ...]


def output_bases(estimates: np.ndarray, mean_square: float, *, limit: float = LOSS, most: int = MOST) -> Bases:
    """Fewest output bases (the constant included) whose expected error is within `limit` of that of all.

    estimates (M, 61): of the training spectra, from their noise-free responses; mean_square: of the estimator's error
    on them (each left out in turn), averaged over the bands. What K bases lose of the estimates is the energy of the
    singular values from the K-th on (Eckart and Young, Psychometrika 1, 1936), and errors add as squares:

        loss(K) = sqrt(1 + lost(K) / mean_square) - 1.

    A camera that cannot tell two stimuli apart says the same of both: its estimates fill fewer dimensions, the more so
    the more its noise is amplified (Wiener's term takes those directions out), and fewer bases hold them.
    """
    coloured = estimates - estimates.mean(axis=1, keepdims=True)
    energy = np.linalg.svd(coloured, compute_uv=False) ** 2
    rest = np.append(np.cumsum(energy[::-1])[::-1], 0.0) / estimates.size  # rest[k]: energy from the k-th vector on
    counts = range(2, min(most, estimates.shape[1], len(energy) + 1) + 1)
    losses = [float(np.sqrt(1 + rest[k - 1] / max(mean_square, 1e-30)) - 1) for k in counts]
    return _first(tuple(counts), tuple(losses), limit)


def principal_bases(spectra: np.ndarray, weights: np.ndarray, *, noise: float, most: int = 3) -> Bases:
    """Number of principal bases with the least expected error, for the inverse of H (Tominaga and Tanaka 2004, eq. 8).

    spectra (M, 61) of the training set, weights (N, 61) of the channels, noise: standard deviation of a response. With
    K <= N bases B and their map onto coefficients H+, the expected mean square over the bands is

        mean |S - B' H+ W S|^2 + noise^2 |B' H+|^2 / 61:

    what the bases lack, and the noise that the inverse amplifies. Losses are relative to the least of them.
    """
    counts = tuple(range(1, min(most, len(weights), len(spectra)) + 1))
    responses, errors = spectra @ weights.T, []
    for count in counts:
        vectors = principal_basis(spectra, count).vectors
        onto = vectors.T @ np.linalg.pinv(weights @ vectors.T, rcond=1e-12)
        left = np.mean((spectra - responses @ onto.T) ** 2)
        errors.append(float(left + noise**2 * np.sum(onto**2) / spectra.shape[1]))
    losses = tuple(float(np.sqrt(error / max(min(errors), 1e-30)) - 1) for error in errors)
    return _first(counts, losses, 0.0)


def decided(bases: Bases, *, method: str, limit: float = LOSS) -> Decision:
    """What was decided, for the log and the diagnostics."""
    paper = method == "paper"
    criterion = "expected error above that of " + ("the best number" if paper else f"{bases.counts[-1]} bases")
    return Decision(
        "bases",
        f"{bases.count} spectral bases",
        f"{criterion}, relative",
        bases.loss,
        0.0 if paper else limit,
        f"expected rms error of a spectrum {100 * bases.loss:.2g} % larger",
        OVERRIDE,
    )


def _first(counts: tuple[int, ...], losses: tuple[float, ...], limit: float) -> Bases:
    """The smallest number within the limit; the last where none is."""
    within = [k for k, loss in enumerate(losses) if loss <= limit]
    place = within[0] if within else len(counts) - 1
    return Bases(counts[place], losses[place], counts, losses)
