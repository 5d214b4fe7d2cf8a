"""List the models of a cloth by name, and fit each to the measurements that it may use."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nishiki.brdf.cloth.interface import incidences, prediction_error, solid_angles
from nishiki.brdf.cloth.normal_incidence import GreatCircleBard, LinearBard
from nishiki.brdf.cloth.yarn_facets import NAMES, YarnFacets
from nishiki.brdf.cloth.yarn_fit import (
    Measured,
    ShapeFit,
    brdf_of,
    choose_oblique,
    fit_normal,
    fit_yarn_facets,
    match_measurements,
    refit_facets,
)
from nishiki.errors import UserError

FACETS, YARNS = "yarn_facets", "yarns"
BEST = (YARNS, FACETS)  # what `auto` chooses among
PUBLISHED = {law.KIND: law for law in (LinearBard, GreatCircleBard)}  # they read the table of normal incidence
MODELS = (*BEST, *PUBLISHED)
YARNS_MISS = 0.02  # relative rms at normal incidence that masking leaves: what is beyond it is taken for the facets'


@dataclass(frozen=True)
class Fitted:
    """A model, the rows of the measurements that it used, and facts about the fit (finite plain values).

    alone: the same model from normal incidence only, where it can be had.
    """

    brdf: Any
    used: np.ndarray
    facts: dict = field(default_factory=dict)
    alone: Any = None


def fit_models(
    measured: Measured, basic, names, *, oblique: int = 20, yarns: tuple[YarnFacets, dict] | None = None
) -> dict[str, Fitted]:
    """Fit the models named to one region.

    basic: a `goniometry.table.BasicReflectance` of it as a function of views and its grid, (evaluate, values (nt, np,
    channels)), or None where nothing was measured at normal incidence, which is an error.  oblique: how many oblique
    measurements `yarn_facets` and `yarns` may use; yarns: for the latter, the weave that was found and its fit's facts.
    """
    valid = np.flatnonzero(np.isfinite(measured.values).all(axis=1))
    normal = valid[measured.normal[valid]]
    if basic is None:
        raise UserError(
            f"{', '.join(names)}: expected the reflectances of normal incidence on a grid, found none. Remedy: measure "
            "with light along the normal and interpolate"
        )
    out = {}
    if set(names) & set(BEST):
        first, aside = fit_normal(measured.take(normal)), valid[~measured.normal[valid]]
        chosen = aside[choose_oblique(first, measured.incident[aside], measured.outgoing[aside], oblique)]
    for name in names:
        if name == FACETS:
            out[name] = _facets(measured, normal, chosen, basic[0], first)
        elif name == YARNS:
            if yarns is None:
                raise UserError(
                    "cloth_brdf.model yarns: expected interlaced yarns of the stage weave, found none. Remedy: run "
                    "weave, or set cloth_brdf.model: yarn_facets"
                )
            weave, facts = yarns
            used = np.concatenate([normal, chosen])
            share = max(0.0, 1 - (YARNS_MISS / max(facts["rms_rel_normal"], YARNS_MISS)) ** 2)
            brdf, alone = (
                match_measurements(one, measured.take(normal), basic[0], share=share)
                for one in (refit_facets(weave, measured.take(used)), weave)
            )
            facts = {**facts, "oblique": len(chosen), "body": brdf.body.tolist(), "lambert": brdf.lambert.tolist()}
            out[name] = Fitted(brdf, used, facts, alone)
        else:
            out[name] = Fitted(PUBLISHED[name].of(basic[1]), normal)
    return out


def left_out_error(measured: Measured, fit: Fitted) -> float:
    """Return the mean relative rms error over oblique incidences of the prediction from normal incidence alone.

    Where nothing was measured off the normal it is the error of the uncorrected model at normal incidence.
    """
    aside = np.flatnonzero(~measured.normal & np.isfinite(measured.values).all(axis=1))
    if not len(aside):
        return float(fit.facts["rms_rel_normal"])
    rest = measured.take(aside)
    predicted = fit.alone.evaluate(rest.incident, rest.outgoing)
    errors = [
        prediction_error(rest.outgoing[rows], rest.values[rows], predicted[rows], solid_angles(rest.outgoing[rows]))
        for _, _, rows in incidences(rest.incident)
    ]
    return float(np.mean([error.rms_rel for error in errors]))


def _facets(measured: Measured, normal: np.ndarray, chosen: np.ndarray, basic, first: ShapeFit) -> Fitted:
    """Fit to the rows of normal incidence and to the oblique ones that the fit to the former has chosen."""
    fit = fit_yarn_facets(measured, np.concatenate([normal, chosen]), basic=basic, first=first)
    facts = {
        "rms_rel_normal": fit.rms_rel,
        "misfit": fit.fit.misfit,
        "cost": fit.fit.cost,
        "evaluations": fit.fit.evaluations,
        "oblique": len(chosen),
        "at_bounds": [NAMES[k] for k in fit.fit.at_bounds],
        "parameters": dict(zip(NAMES, fit.fit.x.tolist(), strict=True)),
        "spreads": dict(zip(NAMES, fit.spread.tolist(), strict=True)),
        "body": fit.brdf.body.tolist(),
        "lambert": fit.brdf.lambert.tolist(),
        "correction": [float(fit.brdf.correction.min()), float(fit.brdf.correction.max())],
    }
    return Fitted(fit.brdf, fit.used, facts, match_measurements(brdf_of(first), measured.take(normal), basic))
