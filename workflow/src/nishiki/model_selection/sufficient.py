"""Decide on the spectral bases, reflection parameters and views of a cloth that a capture supports."""

from dataclasses import dataclass

import numpy as np

from nishiki.colour.sampling import principal_basis
from nishiki.errors import UserError, require
from nishiki.goniometry.directions import disc, reduce_pairs
from nishiki.goniometry.hemisphere import complete
from nishiki.goniometry.table import ReflectanceSet
from nishiki.model_selection.decision import Decision
from nishiki.model_selection.lights import spread_order

LOSS = 0.002  # of the expected error: with ordinary cameras the measured paints ask for no less (docs/notes/economy.md)
MOST_BASES = 16  # that a fit may have


@dataclass(frozen=True)
class Bases:
    """Choice of bases."""

    count: int  # sufficient number of bases
    loss: float  # its addition to the expected error, as a part of it
    counts: tuple[int, ...]  # counts, losses: of every number tried
    losses: tuple[float, ...]


def output_bases(estimates: np.ndarray, mean_square: float, *, limit: float = LOSS, most: int = MOST_BASES) -> Bases:
    """Find the fewest output bases (with the constant) whose expected error is within `limit` of that of all.

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
    """Find the number of principal bases with the least expected error for the inverse of H.

    Tominaga and Tanaka 2004, eq. 8.

    spectra (M, 61) of the training set, weights (N, 61) of the channels, noise: standard deviation of a response. With
    K <= N bases B and their map onto coefficients H+, the expected mean square over the bands is

        mean |S - B' H+ W S|^2 + noise^2 |B' H+|^2 / 61:

    what the bases lack, and the noise that the inverse amplifies. Losses are relative to the least of them.
    """
    counts = tuple(range(1, min(most, len(weights), len(spectra)) + 1))
    responses, errors = spectra @ weights.T, []
    for count in counts:
        vectors = principal_basis(spectra, count)
        onto = vectors.T @ np.linalg.pinv(weights @ vectors.T, rcond=1e-12)
        left = np.mean((spectra - responses @ onto.T) ** 2)
        errors.append(float(left + noise**2 * np.sum(onto**2) / spectra.shape[1]))
    losses = tuple(float(np.sqrt(error / max(min(errors), 1e-30)) - 1) for error in errors)
    return _first(counts, losses, 0.0)


def decide_bases(bases: Bases, *, method: str, limit: float = LOSS) -> Decision:
    """Decide the number of bases, for the log and the diagnostics."""
    paper = method == "paper"
    criterion = "expected error above that of " + ("the best number" if paper else f"{bases.counts[-1]} bases")
    return Decision(
        "bases",
        f"{bases.count} spectral bases",
        f"{criterion}, relative",
        bases.loss,
        0.0 if paper else limit,
        f"expected rms error of a spectrum {100 * bases.loss:.2g} % larger",
        "spectra.bases: a number",
    )


def _first(counts: tuple[int, ...], losses: tuple[float, ...], limit: float) -> Bases:
    """Return the smallest number within the limit; the last where there is none."""
    within = [k for k, loss in enumerate(losses) if loss <= limit]
    place = within[0] if within else len(counts) - 1
    return Bases(counts[place], losses[place], counts, losses)


LIMIT = 0.1  # share of what is left that its neighbours tell
MARGIN_DB = 0.2  # a sample of tiles is not the object
REACH = 2.0  # texels to a neighbour
NEIGHBOURS = 16  # texels that predict one
MOST_PIXELS = 4000  # pixels of a tile that are looked at
STEP = 0.5  # of the parameters' quantiser, in standard deviations of what is left: adds 2 % to it


@dataclass(frozen=True)
class Left:
    """Residual on a sample: mean square (full scale 1), structure: share common to neighbours, pixels."""

    mean_square: float
    structure: float
    pixels: int

    @property
    def psnr_db(self) -> float:
        """PSNR of the model alone; 200 without residual."""
        return min(200.0, float(-10 * np.log10(max(self.mean_square, 1e-20))))

    @property
    def step(self) -> float:
        """Quantiser step at which coding the parameters adds a negligible error."""
        return max(STEP * float(np.sqrt(self.mean_square)), 1e-5)


def summarise_residual(tiles) -> Left:
    """Summarise (left (channels, n), observation (n,), s (n,), t (n,)) of some tiles; s, t: places in texels.

    structure: correlation of what is left at a pixel with what is left at its nearest neighbour, in the same picture
    and, where another picture sees the place within REACH, in that one; the larger of the two (J. von Neumann, Ratio of
    the mean square successive difference to the variance, Ann. Math. Stat. 12, 1941, is 2 less twice the first).
    Noise has none. If what is left is a structure that neighbours share and noise that they do not, it is the share of
    the structure in its energy: the most that coding can take off without coding noise.
    """
    sums, squares, count = np.zeros((2, 3)), 0.0, 0
    for left, observation, s, t in tiles:
        squares += float(np.sum(left.astype(np.float64) ** 2))
        count += left.size
        for k, (texel, other) in enumerate(_pairs(observation, s, t)):
            a, b = left[:, texel].astype(np.float64), left[:, other].astype(np.float64)
            sums[k] += np.sum(a * b), np.sum(a * a), np.sum(b * b)
    energy = np.sqrt(sums[:, 1] * sums[:, 2])
    correlation = np.where(energy > 0, sums[:, 0] / np.where(energy > 0, energy, 1), 0.0)
    return Left(squares / max(count, 1), float(max(correlation.max(), 0.0)), count)


def _pairs(observation: np.ndarray, s: np.ndarray, t: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pair the indices (texel, neighbour) of nearest neighbours: in the same picture, and in another one."""
    from scipy.spatial import cKDTree

    places = np.column_stack([s, t]).astype(np.float64)
    texels = np.arange(0, len(places), max(1, len(places) // MOST_PIXELS))
    if len(places) < 2:
        return []
    distance, near = cKDTree(places).query(places[texels], k=min(NEIGHBOURS, len(places)))
    apart = near != texels[:, None]
    same = observation[near] == observation[texels][:, None]
    pairs = []
    for group in (apart & same, apart & ~same):
        eligible = group & (distance <= REACH)
        first, there = np.argmax(eligible, axis=1), eligible.any(axis=1)
        pairs.append((texels[there], near[there, first[there]]))
    return pairs


def model_suffices(left: Left, target: str, amount: float, *, limit: float = LIMIT) -> bool:
    """Check whether storing the model suffices: it reaches a required PSNR, or its residual is noise."""
    if left.pixels == 0:
        return False
    if target == "psnr":
        return left.psnr_db >= amount + MARGIN_DB
    return left.structure <= limit


def decide_residual(left: Left, target: str, amount: float, setting: str, *, limit: float = LIMIT) -> Decision:
    """Decide whether a residual is worth coding, for the log and the diagnostics."""
    enough = setting == "auto" and model_suffices(left, target, amount, limit=limit)
    words = "model alone: no residual stored" if enough else "residual stored"
    if target == "psnr":
        return Decision(
            "residual", words, "PSNR of the model alone on a sample of tiles, dB", left.psnr_db, amount,
            "the target is reached; a few percent more bytes" if enough else "nothing", "residual.sufficient: never",
        )  # fmt: skip
    most = -10 * np.log10(max(1 - left.structure, 1e-3))
    loss = f"at most {most:.2g} dB beside the noise, the model reaching {left.psnr_db:.1f} dB" if enough else "nothing"
    criterion = "share of the model's residual that neighbouring pixels predict (noise: 0)"
    return Decision("residual", words, criterion, left.structure, limit, loss, "residual.sufficient: never")


VIEWS_LIMIT = 0.01  # relative error at the views not used; a sixth of what a cloth's model is expected to miss
FEWEST = 48  # views
GROWTH = 1.4  # from one number that is tried to the next


def normal_order(measured: ReflectanceSet) -> np.ndarray:
    """Sort the usable normal-incidence views; every beginning is evenly spread over the reduced hemisphere.

    Usable: valid in every region. The distance is that on the azimuthal equidistant disc, where they are interpolated.
    """
    rows = np.flatnonzero(measured.normal_incidence & measured.valid.all(axis=1))
    along = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
    places = disc(reduce_pairs(along, measured.outgoing[rows], measured.symmetry)[1])
    return rows[spread_order(places)]


def with_normal_rows(measured: ReflectanceSet, rows: np.ndarray) -> ReflectanceSet:
    """Restrict the views at normal incidence to `rows`; numbers of rows stay the same."""
    kept = ~measured.normal_incidence
    kept[rows] = True
    names = ("incident", "outgoing", "values", "noise", "regions", "channels", "symmetry", "weave", "normal_deg")
    fields = {name: getattr(measured, name) for name in names}
    return ReflectanceSet(**fields, valid=measured.valid & kept[:, None], basic=measured.basic)


def static_choice(measured: ReflectanceSet, setting: str | int) -> tuple[np.ndarray | None, Decision | None]:
    """Choose rows of normal incidence, or None for all, for 'all' or a number; return the decision too."""
    if setting == "all":
        return None, None
    order = normal_order(measured)
    if int(setting) >= len(order):
        return None, None
    decision = Decision(
        "measurements",
        f"{int(setting)} of {len(order)} views at normal incidence, evenly spread",
        "number set",
        None,
        None,
        "not measured; evaluate compares with the views left out",
        "cloth_brdf.measurements: all, auto or a number",
    )
    return np.sort(order[: int(setting)]), decision


def measured_choice(measured: ReflectanceSet, *, grid_deg: float) -> tuple[np.ndarray | None, Decision | None]:
    """Choose as `static_choice`, but the fewest views that predict the others within the limit.

    Numbers grow by GROWTH from FEWEST; of each the hemisphere is completed from the views used on a grid
    of `grid_deg` degrees (`hemisphere.complete`) and compared with the measured values of the others (`unseen_error`).
    None decided where there are not more than FEWEST views.
    """
    order = normal_order(measured)
    error, number = np.inf, min(FEWEST, len(order))
    while number < len(order):
        error = unseen_error(measured, order, number, grid_deg=grid_deg)
        if error <= VIEWS_LIMIT:
            break
        number = min(len(order), int(np.ceil(GROWTH * number)))
    if len(order) <= FEWEST:
        return None, None
    saved = number < len(order)
    words = f"{number} of {len(order)} views at normal incidence" + ", evenly spread" * saved
    loss = f"unused views are predicted within {100 * error:.2g} % (rms, cosine-weighted)" if saved else "nothing"
    criterion = "relative error at the views at normal incidence that are not used"
    decision = Decision(
        "measurements",
        words,
        criterion,
        float(error),
        VIEWS_LIMIT,
        loss,
        "cloth_brdf.measurements: all, auto or a number",
    )
    return np.sort(order[:number]) if saved else None, decision


def unseen_error(measured: ReflectanceSet, order: np.ndarray, number: int, *, grid_deg: float) -> float:
    """Compute the cosine-weighted relative RMS error of views order[number:] from order[:number]; worst region.

    order: rows of the views at normal incidence. Infinite where the views used do not span the hemisphere.
    """
    used, rest = order[:number], order[number:]
    try:
        basic = require(complete(with_normal_rows(measured, np.sort(used)), grid_deg=grid_deg)[0].basic)
    except UserError:
        return float("inf")
    cosine, errors = measured.outgoing[rest, 2][:, None], []
    for region in range(len(measured.regions)):
        values = measured.values[rest, region]
        error = basic.evaluate(measured.outgoing[rest], region) - values
        errors.append(np.sqrt(np.sum(cosine * error**2) / max(np.sum(cosine * values**2), 1e-300)))
    return float(max(errors))
