"""All models of a cloth by name, each fitted to the measurements that it may use."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nishiki.brdf.cloth.interface import incidences, solid_angles
from nishiki.brdf.cloth.normal_incidence import GreatCircleBard, LinearBard, ScaledBard, read_facets
from nishiki.brdf.cloth.yarn_facets import NAMES
from nishiki.brdf.cloth.yarn_fit import Measured, choose_oblique, fit_normal, fit_yarn_facets
from nishiki.errors import UserError

DEFAULT = "yarn_facets"
NORMAL_ONLY = ("bard_linear", "bard_great_circle", "facets")  # they read the table of normal incidence
REFERENCE = ("bard_scaled",)  # uses every oblique measurement
MODELS = (DEFAULT, *NORMAL_ONLY, *REFERENCE)


@dataclass(frozen=True)
class Fitted:
    """A model, the rows of the measurements that it used, and facts about the fit (finite plain values)."""

    brdf: Any
    used: np.ndarray
    facts: dict = field(default_factory=dict)


def fit_models(measured: Measured, basic, names, *, oblique: int = 20, index: float = 1.5) -> dict[str, Fitted]:
    """Fit the models named to one region.

    basic: a `goniometry.table.BasicReflectance` of it as a function of views and its grid, (evaluate, values (nt, np,
    channels)), or None where nothing was measured at normal incidence, which is an error.  oblique: how many oblique
    measurements `yarn_facets` may use.
    """
    valid = np.flatnonzero(np.isfinite(measured.values).all(axis=1))
    normal = valid[measured.normal[valid]]
    if basic is None:
        raise UserError(
            f"{', '.join(names)}: expected the reflectances of normal incidence on a grid, found none. Remedy: measure "
            "with light along the normal and interpolate"
        )
    out = {}
    for name in names:
        if name == DEFAULT:
            out[name] = _yarns(measured, normal, valid[~measured.normal[valid]], basic[0], oblique)
        elif name in REFERENCE:
            out[name] = Fitted(_scaled(measured, valid, basic[1]), valid)
        else:
            out[name] = Fitted(_read(name, basic, index), normal)
    return out


def _yarns(measured: Measured, normal: np.ndarray, oblique: np.ndarray, basic, count: int) -> Fitted:
    """Fit to the rows of normal incidence and to `count` of the oblique ones, which the fit to the former chooses."""
    first = fit_normal(measured.take(normal))
    chosen = oblique[choose_oblique(first, measured.incident[oblique], measured.outgoing[oblique], count)]
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
    return Fitted(fit.brdf, fit.used, facts)


def _scaled(measured: Measured, valid: np.ndarray, grid: np.ndarray) -> ScaledBard:
    selected = measured.take(valid)
    weights = np.empty(valid.size)
    groups = []
    for _, _, rows in incidences(selected.incident):
        groups.append((selected.incident[rows[0]], rows))
        weights[rows] = selected.outgoing[rows, 2] * solid_angles(selected.outgoing[rows])
    return ScaledBard.fit(grid, groups, selected.outgoing, selected.values, weights)


def _read(name: str, basic, index: float):
    if name == "facets":
        return read_facets(basic[0], index=index)
    return (LinearBard if name == "bard_linear" else GreatCircleBard).of(basic[1])
