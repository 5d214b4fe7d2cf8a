"""Yarn facets read from measurements: those of normal incidence alone, or with a few oblique ones.

First the shape is fitted to normal incidence (its prior says what that leaves open), then to both.  What the shape's
facets still miss at normal incidence is read off them as the facet reading does, at the half vector's tilt theta_r / 2:
a factor c(h) of the mirror reflection at every incidence (h alone, so it stays reciprocal), held to 1 where the body
outshines the mirror reflection. What the model then misses at the oblique images is carried over to the directions
around them (`local_ratio`).
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.cloth.interface import polar
from nishiki.brdf.cloth.local_ratio import fit_ratio, pairs_of
from nishiki.brdf.cloth.measures import hemisphere, incidences, single, solid_angles, together
from nishiki.brdf.cloth.parametric import ShapeFit, fit_shape
from nishiki.brdf.cloth.yarn_facets import CENTRE, SPREAD, YarnFacets, corrected, shape_of, shape_parts, uncorrected
from nishiki.errors import UserError

NORMAL = np.array([0.0, 0.0, 1.0])
MISS = 0.06  # relative deviation that the model is expected to have at normal incidence
WORTH = 40.0  # independent measurements that all views of normal incidence together stand for
MISS_OBLIQUE = 0.12  # of a single oblique measurement
LAMBERT = 0.003  # standard deviation of the Lambert term's albedo about 0
FEWEST = 8
TILTS, TURNS = 16, 72  # grid of the correction
FLOOR = 0.05  # share of the whole below which a mirror reflection is not corrected
MOST = 2.5  # largest factor of the correction


@dataclass(frozen=True)
class Measured:
    """Measurements of one region: directions (n, 3), values (n, channels) 1 / sr, and which are of normal incidence."""

    incident: np.ndarray
    outgoing: np.ndarray
    values: np.ndarray
    normal: np.ndarray  # (n,) bool
    quarter: bool  # two mirror planes

    @classmethod
    def of(cls, measured, region: int = 0) -> "Measured":
        """From a `goniometry.table.ReflectanceSet`; invalid rows are kept, with a value of NaN."""
        values = np.where(measured.valid[:, region, None], measured.values[:, region], np.nan)
        quarter = measured.symmetry == "quarter"
        return cls(measured.incident, measured.outgoing, values, measured.normal_incidence, quarter)

    def take(self, rows: np.ndarray) -> "Measured":
        """Some of them."""
        parts = (self.incident, self.outgoing, self.values, self.normal)
        return Measured(*(np.ascontiguousarray(part[rows]) for part in parts), self.quarter)

    @property
    def grey(self) -> np.ndarray:
        """(n,) mean over the channels."""
        return self.values.mean(axis=1)


def refuse_black(measured: Measured) -> None:
    """UserError where no reflectance is above 0, or there is none at all: weights are relative to them."""
    if not (len(measured.grey) and np.mean(measured.grey) > 0):
        raise UserError(
            f"reflection of the cloth: expected reflectances whose mean is above 0, found {len(measured.grey)} of mean "
            f"{np.mean(measured.grey) if len(measured.grey) else 0:g}. Remedy: expose longer; see reflectance's report"
        )


@dataclass(frozen=True)
class YarnFit:
    """The BRDF and what its fit says of itself."""

    brdf: YarnFacets
    fit: ShapeFit
    used: np.ndarray  # rows of the measurements
    rms_rel: float  # cosine-weighted relative deviation at normal incidence, without the correction
    spread: np.ndarray  # (parameters,) standard deviations of what was fitted, prior included


def parts_of(incident: np.ndarray, outgoing: np.ndarray):
    """The parts that `fit_shape` asks for: mirror reflection, then columns of body and Lambert term."""
    lambert = np.full(len(incident), 1 / np.pi)

    def parts(x):
        terms = shape_parts(shape_of(x), incident, outgoing)
        return terms[:, 0] + terms[:, 2], np.stack([terms[:, 1] + terms[:, 3], lambert], axis=1)

    return parts


def normal_weights(measured: Measured) -> np.ndarray:
    """Inverse standard deviations (n,) of measurements that are all of normal incidence."""
    solid = solid_angles(measured.outgoing, quarter=measured.quarter)
    return together(measured.outgoing, measured.grey, solid, miss=MISS, worth=WORTH)


def levels(brdf, incident: np.ndarray) -> np.ndarray:
    """(n,) cosine-weighted root mean square over all views of the incidences (n, 3), as the model predicts it."""
    views, projected = hemisphere(10, 24)
    out = np.empty(len(incident))
    for _, _, rows in incidences(incident):
        values = brdf.evaluate(incident[rows[0]], views).mean(axis=-1)
        out[rows] = np.sqrt(projected @ values**2 / projected.sum())
    return out


def fit_normal(measured: Measured, *, evaluations: int = 20) -> ShapeFit:
    """The shape from normal incidence alone; every row has to be of it. UserError where all are black."""
    refuse_black(measured)
    weight = normal_weights(measured)
    limits = np.array([np.inf, LAMBERT])
    parts = parts_of(measured.incident, measured.outgoing)
    return fit_shape(
        parts, measured.values, weight, centre=CENTRE, spread=SPREAD, limits=limits, evaluations=evaluations
    )


def fit_yarn_facets(
    measured: Measured, rows: np.ndarray, *, basic=None, first: ShapeFit | None = None, evaluations: int = 20
) -> YarnFit:
    """The BRDF from the rows given, of normal incidence and oblique.

    basic: function of views (..., 3) giving the measured reflectance at normal incidence (..., channels), for the
    correction (default: none); first: what `fit_normal` found, to start from (default: it is called).
    """
    rows = np.asarray(rows)[np.isfinite(measured.values[rows]).all(axis=1)]
    chosen = measured.take(rows)
    if chosen.normal.sum() < FEWEST:
        raise UserError(
            f"yarn_facets: expected at least {FEWEST} measurements lit along the normal, found {chosen.normal.sum()}. "
            "Remedy: photograph the cloth lit along its normal, or fit ggx, ward or ashikhmin_shirley"
        )
    under = chosen.take(chosen.normal)
    refuse_black(under)
    fit = first or fit_normal(under, evaluations=evaluations)
    oblique = np.flatnonzero(~chosen.normal)
    if oblique.size:
        weight = np.empty(len(rows))
        weight[chosen.normal] = normal_weights(under)
        level = levels(brdf_of(fit), chosen.incident[oblique])
        weight[oblique] = single(chosen.grey[oblique], level, miss=MISS_OBLIQUE)
        fit = fit_shape(
            parts_of(chosen.incident, chosen.outgoing),
            chosen.values,
            weight,
            centre=CENTRE,
            spread=SPREAD,
            limits=np.array([np.inf, LAMBERT]),
            start=fit.x,
            evaluations=evaluations,
        )
    brdf = brdf_of(fit)
    error = brdf.evaluate(under.incident, under.outgoing).mean(axis=1) - under.grey
    weight = normal_weights(under)
    rms = np.sqrt(np.sum((weight * error) ** 2) / np.sum((weight * under.grey) ** 2))
    spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
    if basic is not None:
        brdf = replace(brdf, correction=correction(brdf, basic, steepest=float(polar(under.outgoing).max())))
    if oblique.size:
        images = chosen.take(oblique)
        pairs, modelled = pairs_of(images.incident, images.outgoing), brdf.evaluate(images.incident, images.outgoing)
        weights = fit_ratio(pairs, images.grey, modelled.mean(axis=1), measured.quarter)
        brdf = replace(brdf, images=pairs, image_weights=weights, quarter=measured.quarter)
    return YarnFit(brdf, fit, rows, float(rms), spread)


def brdf_of(fit: ShapeFit) -> YarnFacets:
    """The BRDF of a fit, without a correction."""
    return uncorrected(shape_of(fit.x), fit.coefficients[:, 0], fit.coefficients[:, 1])


def correction(brdf: YarnFacets, basic, *, steepest: float) -> np.ndarray:
    """(TILTS, TURNS) factor c(h) that brings the BRDF's mirror reflection to what was measured at normal incidence.

    steepest: largest polar angle measured, radians; views beyond it take its factor.
    """
    tilt, turn = np.linspace(0, np.pi / 4, TILTS), np.arange(TURNS) * (2 * np.pi / TURNS)
    theta, phi = np.meshgrid(np.minimum(2 * tilt, steepest), turn, indexing="ij")
    view = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    modelled = brdf.evaluate(NORMAL, view)
    parts = brdf.parts(NORMAL, view)
    half = view + NORMAL
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    mirror = (parts[..., 0] + parts[..., 2]) * corrected(brdf.correction, half)
    missing = (basic(view) - modelled).mean(axis=-1)
    floor = (FLOOR * modelled.mean(axis=-1)) ** 2
    return np.clip(1 + mirror * missing / (mirror**2 + floor), 1 / MOST, MOST)
