"""Fit each method of spectral estimation, and bring it to one form: a basis, a linear map, a correction.

The correction is local: a kernel regression of the residual of the linear map.

Real reflectances fill a curved sheet of spectrum space; a linear map can only return a plane through it. Among training
spectra whose camera responses resemble the pixel's, the residual of the linear map is much alike, and a smooth function
of the response predicts it. Kernel ridge regression with a compact kernel learns that function; away from the training
responses it returns exactly zero, which leaves the Wiener estimate.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.colour import kernels
from nishiki.colour.kernels import DARK, TAPER_END, TAPER_START
from nishiki.colour.sampling import BANDS, principal_basis
from nishiki.errors import UserError

CONDITION_LIMIT = 1e6  # of the paper's system matrix: singular values below the largest over it are left out
RADIUS = 6.0  # of the kernels of the local correction, in whitened standard deviations, for three channels
NOISE_SEED = 61
DARK_NOISE = 0.05  # noise of a black response, relative to what the brightness of white adds to it
RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0)
RIDGE_TOLERANCE = 0.01  # the smoothest correction whose left-out error is within this part of the least


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


@dataclass(frozen=True)
class ResponseSpace:
    """Whitened coordinates z = whiten @ (sqrt(response) - mean) and the box that the training set fills.

    The square root spreads dark colours as noise and eye do; whitening measures distance in standard deviations, so
    that the small chromatic differences count as much as the large one of lightness.
    """

    mean: np.ndarray  # (N,)
    whiten: np.ndarray  # (N, N)
    low: np.ndarray  # (N,) smallest z of the training set
    high: np.ndarray  # (N,) largest

    def coordinates(self, responses: np.ndarray) -> np.ndarray:
        """Compute z (P, N) of responses (P, N); negative responses count as zero."""
        return (np.sqrt(np.maximum(responses, 0.0)) - self.mean) @ self.whiten.T

    def taper(self, z: np.ndarray) -> np.ndarray:
        """Compute the taper (P,): 1 within 1 standard deviation of the training box, 0 beyond 3, smooth between."""
        outside = np.maximum(np.maximum(self.low - z, z - self.high), 0.0)
        t = np.clip((TAPER_END - outside) / (TAPER_END - TAPER_START), 0.0, 1.0)
        return np.prod(t * t * (3.0 - 2.0 * t), axis=-1)


@dataclass(frozen=True)
class LocalCorrection:
    """Correction = taper(z) * dark(response) * sum_m kernel(|z - centre_m| / radius) * weights_m."""

    centres: np.ndarray  # (M, N) in z
    weights: np.ndarray  # (M, B) per centre, B bands or coefficients
    radius: float
    variance: np.ndarray  # (M,) mean square error of the estimate near each centre, from leaving samples out
    far_variance: float  # mean square error of the linear map alone
    gamut_distance: float  # z distance to the nearest centre beyond which a response counts as unlike the training set
    left_out: np.ndarray  # (61,) mean square error over the training set, each sample left out in turn


def response_space(responses: np.ndarray, *, noise: float) -> ResponseSpace:
    """Whiten the space of training responses (M, N). Directions whose spread is below the noise are not blown up."""
    roots = np.sqrt(np.maximum(responses, 0.0))
    mean = roots.mean(axis=0)
    spread = roots - mean
    values, vectors = np.linalg.eigh(spread.T @ spread / max(len(spread), 1))
    # Noise of the root: d sqrt(r) = dr / (2 sqrt(r)); 1e-6 keeps channels that are copies of each other harmless.
    floor = max(noise / (2.0 * max(float(mean.mean()), 1e-3)), 1e-6)
    whiten = (vectors / np.sqrt(np.maximum(values, 0.0) + floor**2)).T
    z = spread @ whiten.T
    return ResponseSpace(mean=mean, whiten=whiten, low=z.min(axis=0), high=z.max(axis=0))


def compact_kernel(ratio: np.ndarray) -> np.ndarray:
    """Evaluate Wendland's C2 function (1 - r)^4 (4 r + 1) for r < 1, else 0: positive definite up to three dimensions.

    Source: Wendland, Adv. Comput. Math. 4 (1995) 389-396. In more dimensions the ridge keeps the system definite.
    """
    rest = np.maximum(1.0 - ratio, 0.0)
    return rest**4 * (4.0 * ratio + 1.0)


def dark_weight(responses: np.ndarray) -> np.ndarray:
    """Compute b / (b + 0.05) (P,) of the mean non-negative response b."""
    brightness = np.maximum(responses, 0.0).mean(axis=-1)
    return brightness / (brightness + DARK)


def fit_correction(
    residuals: np.ndarray,
    responses: np.ndarray,
    space: ResponseSpace,
    *,
    centres: int,
    radius: float,
    ridge: float | None,
) -> LocalCorrection:
    """Fit the correction to residuals (M, 61) of a linear estimator at training responses (M, N).

    centres : kernels, at most M; placed by k-means from farthest-point starts, so deterministic.
    radius : support of a kernel in whitened standard deviations. ridge : > 0, weight of smoothness against the
    data; None takes the largest of `RIDGES` whose error, when each training sample is left out in turn, is within 1 %
    of the least: real surfaces are never exactly those of the training set, and smooth functions extrapolate better.
    """
    z = space.coordinates(responses)
    chosen = place_centres(z, min(centres, len(z)))
    weight = dark_weight(responses)
    design = compact_kernel(distances(z, chosen) / radius) * weight[:, None]  # (M, centres)
    smooth = compact_kernel(distances(chosen, chosen) / radius)
    scale = float(np.mean(weight**2))
    ridges = np.array(RIDGES if ridge is None else [ridge]) * scale
    solution, squared = _ridge_regression(residuals, design, smooth, ridges)
    mean_square = squared.mean(axis=1)
    nearest = distances(z, chosen).min(axis=1)
    # the mean square error around each centre is that of the nearest training samples
    count = min(8, len(z))
    near = np.argpartition(distances(chosen, z), count - 1, axis=1)[:, :count]
    return LocalCorrection(
        centres=chosen,
        weights=solution,
        radius=radius,
        variance=mean_square[near].mean(axis=1),
        far_variance=float(np.mean(residuals**2)),
        gamut_distance=float(2.0 * np.percentile(nearest, 99.0) + 0.1),
        left_out=squared.mean(axis=0),
    )


def _ridge_regression(residuals, design, smooth, ridges):
    """Compute solution (centres, 61) and squared left-out errors (M, 61) of the largest ridge near the least of them.

    Minimises |residuals - design x|^2 + ridge x' smooth x. One pair of eigendecompositions makes both forms diagonal,
    so that every further ridge costs next to nothing. Leaving sample m out changes its residual by 1 / (1 - h_m), with
    h_m its leverage (Allen, Technometrics 16 (1974) 125-127); the floor of 0.05 keeps a sample that alone decides a
    centre from counting without bound.
    """
    values, vectors = np.linalg.eigh(smooth)
    kept = values > 1e-10 * values[-1]  # in many dimensions the kernel is not definite: leave those directions out
    root = vectors[:, kept] / np.sqrt(values[kept])
    values, vectors = np.linalg.eigh(root.T @ (design.T @ design) @ root)
    values, root = np.maximum(values, 0.0), root @ vectors
    modes = design @ root  # (M, J)
    target = modes.T @ residuals
    candidates = []
    for ridge in ridges:
        shrink = 1.0 / (values + ridge)
        leverage = modes**2 @ shrink
        error = (residuals - modes @ (shrink[:, None] * target)) / np.maximum(1.0 - leverage, 0.05)[:, None]
        candidates.append((root @ (shrink[:, None] * target), error**2))
    limit = (1.0 + RIDGE_TOLERANCE) ** 2 * min(squared.mean() for _, squared in candidates)
    return next(candidate for candidate in reversed(candidates) if candidate[1].mean() <= limit)


def evaluate_correction(
    correction: LocalCorrection, space: ResponseSpace, responses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate the correction: values (P, B), variance (P,), distance to the nearest centre (P,); float64."""
    responses = np.asarray(responses, dtype=float)
    z = space.coordinates(responses)
    apart = distances(z, correction.centres)
    kernel = compact_kernel(apart / correction.radius)
    # The fourth power makes the smoother of the variance narrower than that of the values, at no further square root.
    share = kernel**4
    variance = (share @ correction.variance + 1e-2 * correction.far_variance) / (share.sum(axis=1) + 1e-2)
    values = (kernel @ correction.weights) * (space.taper(z) * dark_weight(responses))[:, None]
    return values, variance, apart.min(axis=1)


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute Euclidean distances (P, M) between rows of a (P, N) and b (M, N), by differences (no cancellation)."""
    total = np.zeros((len(a), len(b)))
    for axis in range(a.shape[1]):
        total += (a[:, axis, None] - b[None, :, axis]) ** 2
    return np.sqrt(total)


def place_centres(z: np.ndarray, count: int) -> np.ndarray:
    """Place k-means centres (count, N) of z (M, N), started from farthest points; deterministic."""
    if count == len(z):
        return z.copy()
    first = int(np.argmin(np.sum(z**2, axis=1)))
    picked, far = [first], np.sum((z - z[first]) ** 2, axis=1)
    for _ in range(count - 1):
        picked.append(int(np.argmax(far)))
        far = np.minimum(far, np.sum((z - z[picked[-1]]) ** 2, axis=1))
    centres = z[picked].copy()
    for _ in range(8):
        label = np.argmin(distances(z, centres), axis=1)
        members = np.bincount(label, minlength=count)
        for axis in range(z.shape[1]):
            total = np.bincount(label, weights=z[:, axis], minlength=count)
            centres[:, axis] = np.where(members > 0, total / np.maximum(members, 1), centres[:, axis])
    return centres


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
class SpectralProblem:
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


def fit_paper(problem: SpectralProblem, bases: int | None, *, white: bool) -> Parts:
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


def fit_regression(problem: SpectralProblem, bases: int | BasesRule | None, centres: int | None) -> Parts:
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
