"""All models of a cloth by name, each fitted to the measurements that it may use."""

from dataclasses import dataclass, field

import numpy as np

from nishiki.brdf.cloth.interface import incidences, solid_angles
from nishiki.brdf.cloth.normal_incidence import GreatCircleBard, LinearBard, ScaledBard, read_facets
from nishiki.brdf.cloth.peers import PARAMETERS, PRIORS, fit_peer
from nishiki.brdf.cloth.yarn_facets import NAMES
from nishiki.brdf.cloth.yarn_fit import Measured, choose_oblique, fit_normal, fit_yarn_facets
from nishiki.errors import UserError

DEFAULT = "yarn_facets"
NORMAL_ONLY = ("bard_linear", "bard_great_circle", "facets")  # they read the table of normal incidence
REFERENCE = ("bard_scaled",)  # uses every oblique measurement
PEERS = tuple(PRIORS)
MODELS = (DEFAULT, *NORMAL_ONLY, *REFERENCE, *PEERS)


@dataclass(frozen=True)
class Fitted:
    """A model, the rows of the measurements that it used, and facts about the fit (finite plain values)."""

    brdf: object
    used: np.ndarray
    facts: dict = field(default_factory=dict)


def fit_models(
    measured: Measured, basic, names, *, oblique: int = 20, index: float = 1.5, chosen: np.ndarray | None = None
) -> dict[str, Fitted]:
    """Fit the models named to one region.

    basic: a `goniometry.table.BasicReflectance` of it as a function of views and its grid, (evaluate, values (nt, np,
    channels)), or None where nothing was measured at normal incidence (then only the peers can be had).  oblique: how
    many oblique measurements may be used; the choice of `choose_oblique` serves all models that take any.  chosen:
    their rows, where they are chosen already.
    """
    valid = np.flatnonzero(np.isfinite(measured.values).all(axis=1))
    normal = valid[measured.normal[valid]]
    needs = [name for name in names if name in (DEFAULT, *NORMAL_ONLY, *REFERENCE)]
    if basic is None and needs:
        raise UserError(
            f"{', '.join(needs)}: expected the reflectances of normal incidence on a grid, found none. Remedy: measure "
            f"with light along the normal and interpolate, or fit only {', '.join(PEERS)}"
        )
    asked = chosen is None and oblique > 0 and any(name in PEERS for name in names)
    first = fit_normal(measured.take(normal)) if basic is not None and (asked or DEFAULT in names) else None
    if chosen is None:
        chosen = _oblique(measured, valid, first, oblique)
    rows = np.concatenate([normal, chosen])
    out = {}
    for name in names:
        if name == DEFAULT:
            out[name] = _yarns(measured, rows, basic[0], first, chosen)
        elif name in PEERS:
            peer = fit_peer(name, measured, rows)
            facts = {"cost": peer.fit.cost, "evaluations": peer.fit.evaluations, "oblique": len(chosen)}
            facts["at_bounds"] = [PARAMETERS[name][k] for k in peer.fit.at_bounds]
            out[name] = Fitted(peer.brdf, peer.used, facts)
        elif name in REFERENCE:
            out[name] = Fitted(_scaled(measured, valid, basic[1]), valid)
        else:
            out[name] = Fitted(_read(name, basic, index), normal)
    return out


def _oblique(measured: Measured, valid: np.ndarray, first, count: int) -> np.ndarray:
    """Rows of the oblique measurements to be used, in order of what they tell (evenly spread where no fit says)."""
    candidates = valid[~measured.normal[valid]]
    if count == 0 or candidates.size == 0:
        return np.empty(0, int)
    if first is None:
        return candidates[np.unique(np.linspace(0, candidates.size - 1, count).astype(int))]
    return candidates[choose_oblique(first, measured.incident[candidates], measured.outgoing[candidates], count)]


def _yarns(measured: Measured, rows: np.ndarray, basic, first, chosen: np.ndarray) -> Fitted:
    fit = fit_yarn_facets(measured, rows, basic=basic, first=first)
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
