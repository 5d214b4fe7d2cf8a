"""Estimate the spectral reflectance of every pixel from its camera response, with the expected colour error.

`fit_estimator` learns from a training set, `estimate_spectra` applies the result to any number of pixels. Whatever the
method, a spectrum leaves as a few coefficients on an explicit basis, S = coefficients @ basis, so that everything
linear in S (colour under any light, rendering) costs K products instead of 61 bands.

Surfaces of one camera response differ in spectrum. How far their colours then differ under another light is read from
the training set: the colour differences between its spectra and what the estimator makes of their responses, at the
spectra whose responses lie nearest to a pixel's.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from nishiki.colour import fitting, kernels
from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_from_spectra, xyz_to_lab
from nishiki.colour.kernels import SpectralFlag
from nishiki.colour.sampling import channel_weights, checked_spectra
from nishiki.errors import UserError
from nishiki.formats.stored import ArrayFields
from nishiki.threads import over_items, strips
from nishiki.threads import threads as given_threads

UNIT_TOLERANCE = 0.01  # beyond 0 .. 1 at which a reflectance is flagged
METHODS = ("paper", "wiener", "local")


@dataclass(frozen=True)
class SpectralEstimator(ArrayFields):
    """A fitted estimator; every field is an array, a number or a word, so that it can be stored as it is.

    With z the whitened root of the response (`nishiki.colour.fitting.ResponseSpace`):
    `coefficients = linear @ response + anchor * exp(-mean((response - 1)^2) / (2 white_width^2)) + correction(z)`.
    """

    method: str
    basis: np.ndarray  # (K, 61)
    linear: np.ndarray  # (K, N)
    anchor: np.ndarray  # (K,)
    white_width: float
    mean: np.ndarray  # (N,) of the whitened space
    whiten: np.ndarray  # (N, N)
    low: np.ndarray  # (N,)
    high: np.ndarray  # (N,)
    centres: np.ndarray  # (M, N), M = 0 for linear methods
    weights: np.ndarray  # (M, K)
    radius: float
    variance: np.ndarray  # (M,)
    far_variance: float
    gamut_distance: float
    table: np.ndarray  # (n0, n1, n2, K + 2) float32; one node an axis where unused
    table_origin: np.ndarray  # (3,)
    table_step: np.ndarray  # (3,)
    noise: float
    noise_variance: float  # mean over bands of the variance that response noise brings
    unit_tolerance: float
    condition: float  # cond(H)
    ill_conditioned: bool
    training_rmse: float  # over the training set; local: each sample left out in turn
    profile: np.ndarray  # (61,) the same of each band, relative to all


@dataclass(frozen=True)
class SpectralField:
    """Spectra of an array of pixels: S (..., 61) = coefficients @ basis."""

    coefficients: np.ndarray  # (..., K) float32
    # (...) float32, expected root-mean-square error over the bands for a surface like those of the training set
    sigma: np.ndarray
    flags: np.ndarray  # (...) uint8, bits of `SpectralFlag`
    basis: np.ndarray  # (K, 61) float64
    condition: float  # cond(H)
    counts: dict[str, int] = field(default_factory=dict)  # pixels by flag name

    def spectra(self) -> np.ndarray:
        """Compute reflectances (..., 61) float64, not clipped."""
        return self.coefficients.astype(np.float64) @ self.basis


def fit_estimator(
    training: np.ndarray,
    illuminant: np.ndarray,
    sensitivities: np.ndarray,
    *,
    method: str = "local",
    bases: int | fitting.BasesRule | None = None,
    noise: float = 0.005,
    white_width: float = 0.02,
    centres: int = 256,
) -> SpectralEstimator:
    """Learn how to turn camera responses into reflectances.

    Every spectrum is an array over 400 to 700 nm in steps of 5 nm, 61 values
    (`nishiki.colour.sampling.resample` brings measured curves onto them).

    Parameters
    ----------
    training : (M, 61) array_like of float
        Reflectances, 0 to 1, of surfaces like those photographed.
    illuminant : (61,) array_like of float
        Spectral power of the lamp, in any unit.
    sensitivities : (N, 61) array_like of float
        Sensitivity of each channel of the camera, in any unit; N is 1 or more.
    method : {'local', 'wiener', 'paper'}, optional
        `paper`: principal bases and matrix inverse (Tominaga and Tanaka, 2004). `wiener`: linear, from the
        covariance of the training set and the noise. `local`: Wiener and a correction by kernels in the space of the
        responses (`nishiki.colour.fitting`).
    bases : int or rule, optional
        paper: number of principal bases (default 3, at most N). Others: size K of the output basis, the constant
        included (default 12, wiener at most N + 1), or a rule that gives it (`nishiki.colour.fitting.BasesRule`).
    noise : float, optional
        Standard deviation of a response, 0 or more; white is 1.
    white_width : float, optional
        The perfect white returns a reflectance of 1 exactly; the correction that sees to it fades as a Gaussian of
        this width (root mean square over channels) round the white response. 0: none, the method as it is.
    centres : int, optional
        Largest number of kernels of the local correction.

    Returns
    -------
    SpectralEstimator
        Arrays and numbers only; for `estimate_spectra`.

    Raises
    ------
    nishiki.errors.UserError
        For unknown methods, wrong shapes, values that are not finite, too few spectra, and settings out of range.

    References
    ----------
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, eq. 5 to 8.
    H. Haneishi and others (2000), System design for accurately estimating the spectral reflectance of art paintings.

    Examples
    --------
    A camera with three broad channels under light of equal energy:

    >>> import numpy as np
    >>> import nishiki
    >>> nm = np.arange(400, 701, 5)
    >>> camera = np.exp(-(((nm - np.array([[600], [540], [460]])) / 40) ** 2))
    >>> estimator = nishiki.fit_estimator(nishiki.synthetic_reflectances(200), np.ones(61), camera, method="wiener")
    >>> estimator.basis.shape
    (4, 61)
    """
    spectra = checked_spectra(training, "training reflectances")
    if method not in METHODS:
        raise UserError(f"spectra: method expected one of {', '.join(METHODS)}, found {method!r}; use one of them")
    for name, value, least in (("noise", noise, 0.0), ("white_width", white_width, 0.0), ("centres", centres, 1)):
        if not (np.isfinite(value) and value >= least):
            raise UserError(f"spectra: {name} expected a number of at least {least:g}, found {value!r}; correct it")
    weights = channel_weights(illuminant, sensitivities)
    responses = spectra @ weights.T
    problem = fitting.SpectralProblem(
        spectra, weights, responses, fitting.response_space(responses, noise=noise), noise
    )
    if method == "paper":
        if callable(bases):
            raise UserError("spectra: the method paper takes bases as a number, found a rule; give the number")
        parts = fitting.fit_paper(problem, bases, white=white_width > 0)
    else:
        parts = fitting.fit_regression(problem, bases, None if method == "wiener" else centres)
    estimator = _assemble(problem, parts, method, white_width)
    if white_width == 0:
        return estimator
    # The anchor is what the very code that serves pixels lacks at the white response.
    estimated = estimate_spectra(np.ones(estimator.linear.shape[1]), estimator).coefficients
    return replace(estimator, anchor=parts.white - estimated)


def estimate_spectra(
    responses: np.ndarray, estimator: SpectralEstimator, *, threads: int | None = None
) -> SpectralField:
    """Estimate the spectral reflectance of every pixel from its responses in the camera's channels.

    Parameters
    ----------
    responses : (..., N) array_like of float
        Diffuse observations relative to the white reference and divided by the cosine of the incidence: a perfect
        white is 1 in each channel. Responses that are not finite give zero coefficients and the flag NOT_FINITE; zero
        responses give a reflectance of 0; negative ones go through the linear part (noise stays unbiased) and are
        flagged.
    estimator : SpectralEstimator
        From `fit_estimator`.
    threads : int, optional
        How many to use. Default: as many as the process may. The result does not depend on it.

    Returns
    -------
    SpectralField
        `spectra()` gives the (..., 61) float64 reflectances over 400 to 700 nm in steps of 5 nm, not clipped;
        `coefficients` (..., K) float32 on the `basis` (K, 61); `sigma` (...) float32, the expected root mean square
        error over the bands; `flags` (...) uint8, the bits of `nishiki.colour.kernels.SpectralFlag`.

    Raises
    ------
    nishiki.errors.UserError
        Where the number of channels differs from the estimator's.

    References
    ----------
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, eq. 8.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> nm = np.arange(400, 701, 5)
    >>> camera = np.exp(-(((nm - np.array([[600], [540], [460]])) / 40) ** 2))
    >>> estimator = nishiki.fit_estimator(nishiki.synthetic_reflectances(200), np.ones(61), camera, method="wiener")
    >>> responses = np.array([[1.0, 1.0, 1.0], [0.5, 0.2, 0.1], [0.0, 0.0, 0.0]])
    >>> spectra = nishiki.estimate_spectra(responses, estimator).spectra()
    >>> spectra.shape
    (3, 61)
    >>> bool(np.allclose(spectra[0], 1, atol=1e-5)), bool(spectra[1, -1] > spectra[1, 0])
    (True, True)
    """
    observed = np.asarray(responses)
    channels = estimator.linear.shape[1]
    if observed.ndim < 1 or observed.shape[-1] != channels:
        raise UserError(
            f"spectra: expected responses of {channels} channels, as many as the camera sensitivities, found shape "
            f"{observed.shape}; give the camera's own channels in their order"
        )
    shape, size = observed.shape[:-1], len(estimator.basis)
    with np.errstate(over="ignore"):  # beyond float32 becomes infinite, which is flagged
        flat = np.ascontiguousarray(observed.reshape(-1, channels), dtype=np.float32)
    coefficients = np.empty((len(flat), size), np.float32)
    sigma, flags = np.empty(len(flat), np.float32), np.empty(len(flat), np.uint8)
    tables = _tables(estimator)

    def run(part: slice) -> None:
        kernels.apply_estimator(flat[part], tables, coefficients[part], sigma[part], flags[part])

    over_items(run, strips(len(flat)), threads or given_threads())
    counts = {flag.name.lower(): int(np.count_nonzero(flags & flag)) for flag in SpectralFlag}
    return SpectralField(
        coefficients=coefficients.reshape(*shape, size),
        sigma=sigma.reshape(shape),
        flags=flags.reshape(shape),
        basis=estimator.basis,
        condition=estimator.condition,
        counts=counts,
    )


def _tables(e: SpectralEstimator) -> kernels.Tables:
    """Return the estimator as its kernel takes it."""
    precision = 0.5 / e.white_width**2 if e.white_width > 0 else 0.0
    double, single = np.float64, np.float32
    c = np.ascontiguousarray  # one memory layout, hence one compilation, wherever the arrays come from
    return kernels.Tables(
        c(e.linear, double), c(e.anchor, double), precision, c(e.mean, double), c(e.whiten, double), c(e.low, double),
        c(e.high, double), c(e.table, single), c(e.table_origin, double), c(e.table_step, double),
        c(e.centres.T, single), c(e.weights, single), e.radius, c(e.variance, single), e.far_variance,
        e.noise_variance, e.gamut_distance, c(e.basis, single), -e.unit_tolerance, 1.0 + e.unit_tolerance,
        e.ill_conditioned,
    )  # fmt: skip


def _assemble(
    problem: fitting.SpectralProblem, parts: fitting.Parts, method: str, white_width: float
) -> SpectralEstimator:
    space, local, size = problem.space, parts.correction, len(parts.basis)
    channels = problem.weights.shape[0]
    table, origin, step = fitting.correction_table(local, space)
    return SpectralEstimator(
        method=method,
        basis=parts.basis,
        linear=parts.linear,
        anchor=np.zeros(size),
        white_width=float(white_width),
        mean=space.mean,
        whiten=space.whiten,
        low=space.low,
        high=space.high,
        centres=local.centres if local else np.zeros((0, channels)),
        weights=local.weights if local else np.zeros((0, size)),
        radius=local.radius if local else 1.0,
        variance=local.variance if local else np.zeros(0),
        far_variance=parts.far_variance,
        gamut_distance=local.gamut_distance if local else fitting.LINEAR_GAMUT_EXCESS,
        table=table,
        table_origin=origin,
        table_step=step,
        noise=float(problem.noise),
        noise_variance=float(problem.noise**2 * np.mean(np.sum((parts.basis.T @ parts.linear) ** 2, axis=1))),
        unit_tolerance=UNIT_TOLERANCE,
        condition=parts.condition,
        ill_conditioned=parts.ill_conditioned,
        training_rmse=float(np.sqrt(parts.left_out.mean())),
        profile=np.sqrt(parts.left_out / parts.left_out.mean()),
    )


LIGHTS = ("D65", "A", "FL11")  # daylight, incandescent light, a fluorescent lamp of three narrow bands
NEIGHBOURS = 24  # spectra of a mean
SAMPLE = 2000  # pixels


def colour_differences(estimated: np.ndarray, true: np.ndarray, light: str) -> np.ndarray:
    """Compute CIEDE2000 (...) between spectra (..., 61) under a CIE illuminant."""
    lamp = illuminant(light)
    white = white_xyz(lamp)
    return delta_e_2000(*(xyz_to_lab(xyz_from_spectra(lamp, spectra), white) for spectra in (estimated, true)))


def expected_colour_error(
    responses: np.ndarray,
    training: np.ndarray,
    weights: np.ndarray,
    estimator: SpectralEstimator,
    *,
    lights: tuple[str, ...] = LIGHTS,
) -> dict[str, np.ndarray]:
    """Predict the CIEDE2000 of each response under each light.

    Parameters
    ----------
    responses : (P, N) finite white-normalised responses of pixels.
    training : (M, 61) reflectances that the estimator was fitted to.
    weights : (N, 61) from `nishiki.colour.sampling.channel_weights`.
    estimator : fitted to `training`.
    lights : names of CIE illuminants.

    Returns
    -------
    Light -> (P,): mean over the `NEIGHBOURS` training spectra with the nearest responses. It holds for surfaces like
    those of the training set, for responses without noise (what noise adds is in every light's picture alike).
    """
    seen = training @ weights.T
    estimated = estimate_spectra(seen, estimator).spectra()
    errors = np.array([colour_differences(estimated, training, light) for light in lights])
    space = fitting.ResponseSpace(estimator.mean, estimator.whiten, estimator.low, estimator.high)
    apart = fitting.distances(space.coordinates(np.asarray(responses, float)), space.coordinates(seen))
    count = min(NEIGHBOURS, len(training))
    nearest = np.argpartition(apart, count - 1, axis=1)[:, :count]
    return {light: row[nearest].mean(axis=1) for light, row in zip(lights, errors, strict=True)}


def sample_rows(rows: int, columns: int, count: int = SAMPLE) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of a regular grid of at most about `count` pixels."""
    step = max(1, int(np.ceil(np.sqrt(rows * columns / count))))
    return np.arange(step // 2, rows, step), np.arange(step // 2, columns, step)
