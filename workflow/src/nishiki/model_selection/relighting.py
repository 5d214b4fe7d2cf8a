"""Decide by held-out lamps which normals and which gloss predict photographs best.

Lamps of the fit are left out by fifths, the others fit every candidate on a sample of the pixels, and the CIEDE2000 of
predictions against photographs is compared: normals by the selection alone (`plain`), with directional terms
(`nishiki.photometric.relighting`), or fitted jointly with the gloss. Gloss is fitted to what a body leaves. Shadows
that objects throw, and gloss that is not what the joint fit takes it for, show nowhere else: a residual of the fit
falls with every term.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.gloss_profile import (
    LADDER,
    GlossProfile,
    SpecularHistogram,
    fit_gloss,
    predicted_radiance,
    specular_samples,
    unit_of,
)
from nishiki.errors import require
from nishiki.evaluate.camera_colour import assumed_colour
from nishiki.evaluate.relighting import difference_of
from nishiki.model_selection.decision import Decision
from nishiki.observations.plane import Parcel
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.photometric.gloss import LARGEST_SIGMA

FOLDS = 5  # of cross-validation, over lamps
FEWEST = 8  # lights: with fewer, what the rest of them says differs too much from what all of them say
MARGIN = 0.05  # part of the plain model's error that the directional terms must take off
ERRORS = 3.0  # and standard errors of that gain over the lamps: one lamp of a wrong strength outweighs nine others
BESIDE = 0.5  # of the distance to the nearest other lamp: one nearer to the hull of the others is not extrapolated
SURE = 1e3  # weight with which shares of the others sum to one
DARKEST = float(np.finfo(np.float32).tiny)  # median sample: a black scene has no level
MID_GREY = 0.2  # that the median sample becomes: a colour difference depends on the level, which may have any unit


@dataclass(frozen=True)
class RelightingSample:
    """Sampled pixels under one set of directions."""

    # (lights, 1, pixels, channels), usable and valid (lights, 1, pixels) bool, and their parcel
    observations: np.ndarray
    usable: np.ndarray
    valid: np.ndarray
    parcel: Parcel
    cells: np.ndarray | None = None  # (1, pixels): numbers of cells of the picture, or of regions

    def only(self, chosen: np.ndarray) -> "RelightingSample":
        """Select some of the pixels: numbers, or bool (pixels,)."""
        names = ("observations", "usable", "valid")
        cells = require(self.cells)[:, chosen]
        return replace(self, **{name: getattr(self, name)[:, :, chosen] for name in names}, cells=cells)

    def under(self, lights: np.ndarray) -> "RelightingSample":
        """Select some of the lights."""
        parcel = replace(self.parcel, directions=self.parcel.directions[lights], scale=self.parcel.scale[lights])
        return replace(
            self,
            observations=self.observations[lights],
            usable=self.usable[lights],
            valid=self.valid[lights],
            parcel=parcel,
        )

    @property
    def scaled(self) -> np.ndarray:
        """Observations as if the lamps were as far from the parcel as from the centre."""
        return self.observations * self.parcel.scale[:, None, None, None]


@dataclass(frozen=True)
class CandidateFit:
    """One candidate: maps of `nishiki.stages.normals`, and the gloss of their fit, or None."""

    maps: dict
    gloss: GlossProfile | None = None

    @property
    def normals(self) -> np.ndarray:
        """Normals that shade (1, pixels, 3)."""
        return self.maps.get("shading_normals", self.maps["normals"])

    @property
    def known(self) -> np.ndarray:
        """Pixels with an estimate (1, pixels)."""
        return (self.maps["flags"] & NO_ESTIMATE) == 0


def choose_model(errors: dict[str, np.ndarray]) -> tuple[str, Decision]:
    """Choose the model of relighting, and return the decision; "plain" unless directional terms are clearly better.

    errors : of `left_out_errors`, of "plain" and "directional".
    """
    plain, directional = errors["plain"], errors["directional"]
    gains = plain - directional
    gain, deviation = gains.mean(), gains.std(ddof=1) / np.sqrt(gains.size)
    limit = max(MARGIN * plain.mean(), ERRORS * deviation)
    model = "directional" if gain > limit else "plain"
    decision = Decision(
        "relighting",
        f"lamps are predicted {'with' if model == 'directional' else 'without'} directional terms (captured lamps left "
        f"out: mean CIEDE2000 {plain.mean():.2f} without, {directional.mean():.2f} with them)",
        "CIEDE2000 of captured lamps left out that directional terms take off",
        float(gain),
        float(limit),
        "nothing" if model == "directional" or gain <= 0 else f"at most {gain:.2g} CIEDE2000",
        "normals.relighting: plain",
    )
    return model, decision


def left_out_errors(
    pieces: Sequence[RelightingSample],
    fit: Callable[[RelightingSample], dict[str, CandidateFit]],
    scene: Sequence[RelightingSample] = (),
) -> dict[str, np.ndarray]:
    """Compute mean CIEDE2000 (lights,) over each light's valid samples, held out in turn, by candidate.

    scene : pieces that tell the level of the scene, where it is not that of `pieces`.
    """
    lights = np.arange(len(pieces[0].valid))
    levels = np.concatenate([piece.scaled[piece.valid] for piece in scene or pieces])
    unit, brightest = max(float(np.median(levels.mean(axis=-1))), DARKEST) / MID_GREY, float(levels.max())
    sums: dict[str, np.ndarray] = {}
    for fold in range(FOLDS):
        kept, left_out = lights[lights % FOLDS != fold], lights[fold::FOLDS]
        seen, unseen = ([piece.under(part) for piece in pieces] for part in (kept, left_out))
        fits = [fit(piece) for piece in seen]
        for name in fits[0]:
            candidates = [fitted[name] for fitted in fits]
            gloss = candidates[0].gloss or remaining_gloss(seen, candidates)
            total = sums.setdefault(name, np.zeros((2, lights.size)))
            for piece, candidate in zip(unseen, candidates, strict=True):
                predicted = predicted_radiance(
                    piece.parcel.directions,
                    candidate.normals,
                    candidate.maps["reflectance"],
                    gloss,
                    shading=candidate.maps.get("shading"),
                )
                compared = piece.valid & candidate.known
                predicted = np.fmin(np.fmax(predicted, 0), brightest)  # no photograph shows more
                differences = colour_differences(predicted / unit, piece.scaled / unit, compared)
                total[:, left_out] += differences.sum(axis=(1, 2), dtype=np.float64), compared.sum(axis=(1, 2))
    return {name: total / np.maximum(count, 1) for name, (total, count) in sums.items()}


def select_surrounded(directions: np.ndarray) -> np.ndarray:
    """Select the lights (n, 3) that those of other folds surround, or nearly; all if fewer than FEWEST / 2 are."""
    from scipy.optimize import nnls

    fold, near = np.arange(len(directions)) % FOLDS, np.zeros(len(directions), bool)
    corners = np.column_stack([directions[:, :2], np.full(fold.size, SURE)])
    for light, place in enumerate(corners):
        others = corners[fold != fold[light]]
        apart = np.linalg.norm(nnls(others.T, place)[0] @ others - place)
        near[light] = apart <= BESIDE * np.linalg.norm(others - place, axis=1).min()
    return near | (near.sum() < FEWEST / 2)


def remaining_gloss(pieces: Sequence[RelightingSample], candidates: Sequence[CandidateFit]) -> GlossProfile:
    """Fit the gloss of all pieces together to the residual of a candidate's body."""
    unit = unit_of([candidate.maps["reflectance"] for candidate in candidates])
    nothing = GlossProfile(np.zeros(LADDER.size), LADDER, transmission=0.0, unit=unit)
    histogram = SpecularHistogram.empty(value_unit=unit)
    for piece, candidate in zip(pieces, candidates, strict=True):
        samples = specular_samples(
            piece.scaled,
            piece.parcel.directions,
            candidate.normals,
            candidate.maps["reflectance"],
            nothing,
            valid=piece.valid & candidate.known,
            shading=candidate.maps.get("shading"),
        )
        sigma = np.minimum(candidate.maps["sigma"], LARGEST_SIGMA) / np.sqrt(2)
        histogram = histogram.add_samples(*samples, sigma=sigma)
    return fit_gloss(histogram, transmission=0.0)


def colour_differences(first: np.ndarray, second: np.ndarray, compared: np.ndarray) -> np.ndarray:
    """Compute CIEDE2000 of pictures (lights, rows, columns, channels) as linear sRGB, 0 where not compared."""
    colour = assumed_colour(first.shape[-1])
    differences = np.zeros(compared.shape, np.float32)
    for one, other, where, values in zip(first, second, compared, differences, strict=True):
        difference_of(one, other, colour.matrix, colour.white, where.astype(np.uint8), values)
    return differences


LEAST_GAIN = 0.02  # part of the error of left-out lamps that a finish more has to take off


def joint_fit_counts(errors: dict[str, np.ndarray]) -> bool:
    """Decide whether the joint fit predicts held-out lamps better than the normals of the selection, by ERRORS.

    On surfaces whose gloss it takes for another, and on matt ones with interreflections, it does not, and its normals
    are worse. Ratios of the errors are compared, for one lamp near the mirror direction outweighs all differences, and
    scatter is that below their mean: such a lamp may gain much more than the others.

    errors : of `left_out_errors`, of "normals" and "joint".
    """
    gains = np.log(np.maximum(errors["normals"], DARKEST) / np.maximum(errors["joint"], DARKEST))
    below = np.minimum(gains - gains.mean(), 0)
    return bool(gains.mean() > ERRORS * np.sqrt(2 * np.mean(below**2) / (gains.size - 1)))
