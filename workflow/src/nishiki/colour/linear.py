"""Linear estimators of reflectance: the paper's matrix inverse (Tominaga and Tanaka 2004, eq. 6-8) and Wiener's."""

from __future__ import annotations

import numpy as np

from nishiki.colour.basis import principal_basis
from nishiki.errors import UserError


def paper_map(weights: np.ndarray, basis: np.ndarray, *, condition_limit: float) -> tuple[np.ndarray, bool]:
    """(K, N) map from white-normalised responses to the paper's coefficients, sigma = H^-1 rho' (Tominaga and Tanaka
    2004, eq. 8).

    weights : (N, 61) from `channel_weights`; basis : (K, 61), K <= N (least squares for K < N).
    Singular values of H below the largest / `condition_limit` are left out (minimum-norm solution), in which case the
    second value returned is True: part of sigma is then zero for want of information, not because it was measured so.
    Raises UserError for K > N, where H has no inverse.
    """
    if basis.shape[0] > weights.shape[0]:
        raise UserError(
            f"method 'paper': expected at most as many bases as camera channels ({weights.shape[0]}), found "
            f"{basis.shape[0]}; ask for fewer bases, or use method 'wiener' or 'local'"
        )
    left, singular, right = np.linalg.svd(weights @ basis.T, full_matrices=False)
    kept = singular > singular[0] / condition_limit
    return (right[kept].T / singular[kept]) @ left[:, kept].T, not bool(kept.all())


def wiener_map(weights: np.ndarray, training: np.ndarray, *, noise: float) -> np.ndarray:
    """(61, N) Wiener estimator C W^T (W C W^T + noise^2 I)^-1 with the uncentred second moments C of the training set.

    Uncentred, so that a black response returns black. noise : standard deviation of a white-normalised response, >= 0;
    the noise term also keeps the inverse finite where lamp or camera make channels alike. For noise = 0 rounding error
    takes its place. Source: Haneishi et al., Appl. Opt. 39 (2000) 6621-6632.
    """
    responses = training @ weights.T
    count = training.shape[0]
    gram = responses.T @ responses / count
    floor = noise**2 + 1e-13 * np.trace(gram)
    return np.linalg.solve(gram + floor * np.eye(gram.shape[0]), responses.T @ training / count).T


def condition_number(weights: np.ndarray, training: np.ndarray, count: int | None = None) -> float:
    """cond(H) for the first K = min(count, N) uncentred principal bases: how well camera and lamp tell them apart."""
    size = min(count or weights.shape[0], weights.shape[0], training.shape[0])
    system = weights @ principal_basis(training, size).vectors.T
    singular = np.linalg.svd(system, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")
