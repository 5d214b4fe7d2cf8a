"""Fit each method of spectral estimation, and bring it to one form: a basis, a linear map, a correction."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.colour import kernels
from nishiki.colour.local import TAPER_END, LocalCorrection, ResponseSpace, evaluate_correction, fit_correction
from nishiki.colour.sampling import BANDS, principal_basis
from nishiki.errors import UserError

CONDITION_LIMIT = 1e6  # of the paper's system matrix: singular values below the largest over it are left out
RADIUS = 6.0  # of the kernels of the local correction, in whitened standard deviations, for three channels
NOISE_SEED = 61
DARK_NOISE = 0.05  # noise of a black response, relative to what the brightness of white adds to it


def paper_map(weights: np.ndarray, basis: np.ndarray, *, condition_limit: float) -> tuple[np.ndarray, bool]:
    """Compute the paper's map (K, N) from white-normalised responses, sigma = H^-1 rho'.

    Tominaga and Tanaka (2004), eq. 8.

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
    """Compute Wiener's estimator (61, N) C W^T (W C W^T + noise^2 I)^-1, C the training set's uncentred second moments.

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
    """Compute cond(H) of the first K = min(count, N) uncentred principal bases: how well the system separates them."""
    size = min(count or weights.shape[0], weights.shape[0], training.shape[0])
    system = weights @ principal_basis(training, size).T
    singular = np.linalg.svd(system, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")


LINEAR_GAMUT_EXCESS = 0.5  # whitened standard deviations beyond the training box, for methods without centres
TABLE_STEP, TABLE_CELLS = 0.25, 64


@dataclass(frozen=True)
class Problem:
    """The data of every method: spectra (M, 61), weights (N, 61), responses (M, N), their space, the noise."""

    spectra: np.ndarray
    weights: np.ndarray
    responses: np.ndarray
    space: ResponseSpace
    noise: float


@dataclass(frozen=True)
class Parts:
    """A fitted method. white : (K,) coefficients of S = 1."""

    basis: np.ndarray
    linear: np.ndarray
    white: np.ndarray
    correction: LocalCorrection | None
    far_variance: float
    condition: float
    ill_conditioned: bool
    left_out: np.ndarray  # (61,) mean square error over the training set


def fit_paper(problem: Problem, bases: int | None, *, white: bool) -> Parts:
    """Fit principal bases and sigma = H^-1 rho'; with `white`, one more row for the white anchor.

    Tominaga and Tanaka (2004), eq. 5-8.

    The extra row d = 1 - S(white response) is what the bases cannot say about the perfect white. Where H is inverted
    exactly, no channel sees d (it is a metameric black), so adding any amount of it contradicts no observation.
    """
    channels = problem.weights.shape[0]
    vectors = principal_basis(problem.spectra, min(3, channels) if bases is None else bases)
    sigma, cut = paper_map(problem.weights, vectors, condition_limit=CONDITION_LIMIT)
    residual = problem.spectra - problem.responses @ sigma.T @ vectors
    basis, linear, of_white = vectors, sigma, sigma.sum(axis=1)
    if white:
        basis = np.vstack([vectors, 1.0 - of_white @ vectors])
        linear = np.vstack([sigma, np.zeros(channels)])
        of_white = np.append(of_white, 1.0)
    left_out = np.mean(residual**2, axis=0)
    condition = condition_number(problem.weights, problem.spectra, len(vectors))
    return Parts(basis, linear, of_white, None, float(left_out.mean()), condition, cut, left_out)


BasesRule = Callable[[np.ndarray, float], int]
"""Number of output bases from the estimates (M, 61) of the training spectra and their mean-square error."""


def fit_regression(problem: Problem, bases: int | BasesRule | None, centres: int | None) -> Parts:
    """Fit Wiener's estimator, with a local correction of so many centres unless they are None.

    The correction learns from responses with the noise that those of pixels have. Where channels are nearly alike, as
    those of one camera under two lamps, it would otherwise read their small differences as colours.
    """
    channels = problem.weights.shape[0]
    dense = wiener_map(problem.weights, problem.spectra, noise=problem.noise)
    estimates = problem.responses @ dense.T
    left_out, correction = np.mean((problem.spectra - estimates) ** 2, axis=0), None
    far = float(left_out.mean())
    if centres:
        noise = np.random.default_rng(NOISE_SEED).standard_normal(problem.responses.shape) * problem.noise
        noisy = problem.responses + noise * (problem.responses + DARK_NOISE) / (1 + DARK_NOISE)
        estimates = noisy @ dense.T
        # distances in N whitened dimensions grow like sqrt(N)
        correction = fit_correction(
            problem.spectra - estimates,
            noisy,
            problem.space,
            centres=centres,
            radius=RADIUS * (channels / 3.0) ** 0.5,
            ridge=None,
        )
        estimates = estimates + evaluate_correction(correction, problem.space, noisy)[0]
        left_out = correction.left_out
    count = bases(estimates, float(left_out.mean())) if callable(bases) else bases
    count = count if count is not None else (12 if centres else min(channels + 1, 12))
    basis = output_basis(estimates, count)
    onto = np.linalg.pinv(basis).T  # (K, 61)
    lost = np.mean((estimates - estimates @ onto.T @ basis) ** 2, axis=0)
    if correction:
        correction = replace(
            correction,
            weights=correction.weights @ onto.T,
            variance=correction.variance + float(lost.mean()),
            far_variance=far,
        )
    return Parts(
        basis=basis,
        linear=onto @ dense,
        white=np.eye(len(basis))[0],
        correction=correction,
        far_variance=far,
        condition=condition_number(problem.weights, problem.spectra),
        ill_conditioned=False,
        left_out=left_out + lost,
    )


def output_basis(estimates: np.ndarray, count: int) -> np.ndarray:
    """Compute a basis (K, 61): the constant 1, then the strongest orthonormal vectors of the estimates without it.

    Principal vectors of the *estimates*, not of the training spectra: no coefficient is spent on detail that the
    estimator cannot produce. K is `count`, or less where the estimates span less.
    """
    if not 2 <= count <= BANDS:
        raise UserError(f"number of bases: expected 2 to {BANDS} (the constant included), found {count}; correct it")
    coloured = estimates - estimates.mean(axis=1, keepdims=True)
    _, singular, vectors = np.linalg.svd(coloured, full_matrices=False)
    kept = singular[: count - 1] > 1e-9 * max(singular[0], 1e-300)
    return np.vstack([np.ones(BANDS), vectors[: count - 1][kept]])


def correction_table(
    correction: LocalCorrection | None, space: ResponseSpace
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tabulate kernel sums on a grid over the whitened box of three channels: table, origin (3,), step (3,).

    The last axis holds the K coefficients, the variance and the nearest distance. For other numbers of channels, or no
    correction, a single node that the kernel code takes for "no table".
    """
    if correction is None or correction.centres.shape[1] != 3:
        columns = 2 if correction is None else correction.weights.shape[1] + 2
        return np.zeros((1, 1, 1, columns), np.float32), np.zeros(3), np.ones(3)
    origin = space.low - TAPER_END
    extent = space.high + TAPER_END - origin
    cells = np.clip(np.ceil(extent / TABLE_STEP).astype(int), 1, TABLE_CELLS)
    x, y, z = (origin[i] + extent[i] * np.linspace(0.0, 1.0, cells[i] + 1) for i in range(3))
    table = np.empty((*(cells + 1), correction.weights.shape[1] + 2), np.float32)
    single = np.float32
    centres = np.ascontiguousarray(correction.centres.T, single)
    weights, variance = correction.weights.astype(single), correction.variance.astype(single)
    kernels.fill_table((x, y, z), centres, weights, correction.radius, variance, correction.far_variance, table)
    return table, origin, extent / cells
