"""Fit the weave model to reflectances in the two symmetry planes of a cloth.

Unknowns: theta_a and the ratios of lengths of both sections, the widths of both gloss lobes, and the strengths k_s, k_d
(eliminated). See `search` for how the jumps in theta_a are dealt with.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.weave.intervals import Identifiability, identify, profile_intervals
from nishiki.weave.model import PAPER, SHADED, SIZE, columns, plane_rows, shape_of
from nishiki.weave.search import UNKNOWNS, SectionProblem, at_bounds, search
from nishiki.weave.section import HALF_PI, WarpSection, WeftSection

PLANE_DEG = 1.5  # how far from the plane a view may lie
GRAZING_DEG = 89.5  # lamps and views beyond are left out
STEP_DEG = 3.0
LEAST = 8  # finite reflectances of a plane


@dataclass(frozen=True)
class Plane:
    """Reflectances with views in one plane, lit along the normal."""

    theta_r: np.ndarray  # (n,) signed radians from the normal, below pi/2
    values: np.ndarray  # (n, channels) sr^-1
    sigma: np.ndarray  # (n,) standard deviation of the mean over channels
    measured: bool = True  # False where taken from the interpolated hemisphere

    @property
    def mean(self) -> np.ndarray:
        """Mean over channels (n,)."""
        return self.values.mean(axis=1)


def make_plane(theta_r, values, *, relative_error: float = 0.02, noise=None, measured: bool = True) -> Plane:
    """Build a plane from signed angles (n,) and values (n,) or (n, channels).

    noise : standard deviation of the values, same shape, or None. Weights follow from it and from relative_error of the
    value, which stands for everything that the model leaves out.
    """
    theta_r, values = np.asarray(theta_r, np.float64), np.asarray(values, np.float64)
    values = values[:, None] if values.ndim == 1 else values
    noise = np.zeros_like(values) if noise is None else np.asarray(noise, np.float64).reshape(values.shape)
    inside = np.abs(theta_r) < np.pi / 2
    if theta_r.size < LEAST or not np.all(np.isfinite(values)) or not np.all(inside):
        raise UserError(
            f"weave: expected at least {LEAST} finite reflectances below 90 degrees in each plane, found "
            f"{theta_r.size}. Remedy: measure views along the warp and along the weft, light along the normal."
        )
    mean = values.mean(axis=1)
    if not mean.max() > 0:
        raise UserError(
            f"weave: expected reflectances above 0, found at most {mean.max():g} among {mean.size}. Remedy: expose "
            "longer, or check the dark frames"
        )
    floor = 1e-4 * max(float(np.abs(mean).max()), 1e-300)
    sigma = np.sqrt(np.sum(noise**2, axis=1) / values.shape[1] ** 2 + (relative_error * mean) ** 2 + floor**2)
    order = np.argsort(theta_r, kind="stable")
    return Plane(theta_r[order], values[order], sigma[order], measured)


def planes_of(reflectances, *, region: int = 0, relative_error: float = 0.02) -> tuple[Plane, Plane]:
    """Make weft and warp plane of a set of reflectances (see goniometry.table.ReflectanceSet), lit along the normal.

    Views within PLANE_DEG of a plane. Where there are too few of them, values are read from the interpolated hemisphere
    every STEP_DEG degrees, up to the outermost view that was measured.
    """
    weft, warp = (_plane(reflectances, axis, region, relative_error) for axis in (0, 1))
    return weft, warp


def _plane(reflectances, axis: int, region: int, relative_error: float) -> Plane:
    known = reflectances.valid[:, region] & reflectances.normal_incidence
    lamp, view = reflectances.incident[known], reflectances.outgoing[known]
    inside = _in_plane(lamp, axis) & _in_plane(view, axis)
    measured = bool(inside.sum() >= LEAST)
    if measured:
        angles = np.arctan2(view[:, axis], view[:, 2])[inside]
        values, noise = (each[known][inside, region] for each in (reflectances.values, reflectances.noise))
    else:
        angles, values = _interpolate(reflectances, axis, region, view, int(inside.sum()))
        noise = None
    return make_plane(angles, values, noise=noise, relative_error=relative_error, measured=measured)


def _in_plane(directions: np.ndarray, axis: int) -> np.ndarray:
    aside = np.abs(np.arcsin(np.clip(directions[:, 1 - axis], -1, 1)))
    along = np.arctan2(np.abs(directions[:, axis]), directions[:, 2])
    return (aside < np.radians(PLANE_DEG)) & (along < np.radians(GRAZING_DEG))


def _interpolate(reflectances, axis, region, view, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample angles and values (n, channels) of one plane from the hemisphere; one side where both are equal."""
    if reflectances.basic is None or not len(view):
        raise UserError(
            f"weave: expected {LEAST} views along the {('weft', 'warp')[axis]} with the light along the normal, found "
            f"{views}. Remedy: measure them, or run reflectance so that the hemisphere is interpolated."
        )
    theta = np.arctan2(np.hypot(view[:, 0], view[:, 1]), view[:, 2])
    last = min(float(theta.max()), np.radians(87.0))
    at = np.arange(0.0, last + 1e-9, np.radians(STEP_DEG))
    at = at if reflectances.symmetry == "quarter" else np.concatenate([-at[:0:-1], at])
    direction = np.zeros((at.size, 3))
    direction[:, axis], direction[:, 2] = np.sin(at), np.cos(at)
    return at, np.asarray(reflectances.basic.evaluate(direction, region=region))


READINGS = {"paper": PAPER, "shaded": SHADED}
START_INDEX = 1.5  # refractive
NOTHING = 1e-6  # a length over the period, or a strength, that is left out of what is told apart


@dataclass(frozen=True)
class WeaveModel:
    """Both sections and the reflection of their surface."""

    weft: WeftSection  # weft, warp: sections, each scaled to a period of 1
    warp: WarpSection
    a_weft: float  # a_weft, a_warp: widths of D = exp(-theta_h^2 / a^2) (the paper's e and a)
    a_warp: float
    index: float  # refractive index
    # k_s, k_d (channels,): strengths of gloss and body (k_d stands for the paper's k_d d), one pair for both planes
    k_s: np.ndarray
    k_d: np.ndarray
    reading: str = "paper"  # "paper" or "shaded"

    @property
    def f0(self) -> float:
        """Reflectance at normal incidence, ((n - 1) / (n + 1))^2."""
        return ((self.index - 1.0) / (self.index + 1.0)) ** 2

    def parts(self, plane: str, theta_r) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate gloss and body (..., channels) sr^-1 in a plane ("weft", "warp") at signed angles (...,), rad."""
        rows = plane_rows(0 if plane == "weft" else 1, theta_r)
        widths, reading = (self.a_weft, self.a_warp), READINGS[self.reading]
        both = columns(self.weft.shape, self.warp.shape, widths, rows, f0=self.f0, reading=reading)
        return both[..., :1] * (self.k_s * self.f0), both[..., 1:] * self.k_d

    def predict(self, plane: str, theta_r) -> np.ndarray:
        """Predict reflectance (..., channels) sr^-1: Takeda and Tanaka, eq. 15 (reading "paper"), or shaded."""
        gloss, body = self.parts(plane, theta_r)
        return gloss + body

    def parameters(self) -> dict[str, float]:
        """Return all parameters by name, strengths as means over channels; lengths in periods."""
        return {
            **{f"{name}_weft": value for name, value in self.weft.as_dict().items()},
            **{f"{name}_warp": value for name, value in self.warp.as_dict().items()},
            "a_weft": self.a_weft,
            "a_warp": self.a_warp,
            "index": self.index,
            "k_s": float(np.mean(self.k_s)),
            "k_d": float(np.mean(self.k_d)),
        }


@dataclass(frozen=True)
class WeaveFit:
    """A fitted model and the quality of its fit."""

    model: WeaveModel
    # per plane, root of the summed squares of the misfit over those of the data (mean over channels)
    rms_rel: dict[str, float]
    variance: float  # of the residuals over sigma
    intervals: dict[str, tuple[float, float]]  # name -> (low, high), see `intervals.profile_intervals`
    identifiability: Identifiability
    at_bounds: list[str]  # unknowns that ended at the end of their range


def fit_weave(
    weft: Plane,
    warp: Plane,
    *,
    reading: str = "shaded",
    contact: float | None = HALF_PI,
    harness: int | None = None,
    index: float | None = START_INDEX,
    confidence: float | None = 0.95,
) -> WeaveFit:
    """Fit the weave model to both planes; deterministic.

    reading : "paper" (Takeda and Tanaka, eq. 15) or "shaded". contact : angle of the weft section's contacts; None:
    searched. harness : yarns of a repeat, of which one is bound, where the weave is known: then n = harness - 1;
    None: n is searched. index : refractive index; None: searched (strongly correlated
    with k_s). confidence : of the intervals; None: no intervals, for speed.
    """
    problem, start = _problem(weft, warp, READINGS[reading], contact, harness, index)
    p, cost = search(problem, start)
    model = model_of(p, weft, warp, reading)
    variance = cost / problem.freedom
    ranges = profile_intervals(problem, p, cost, confidence=confidence, variance=variance) if confidence else {}
    rms_rel = {}
    for name, plane in (("weft", weft), ("warp", warp)):
        missed = model.predict(name, plane.theta_r).mean(axis=-1) - plane.mean
        rms_rel[name] = float(np.sqrt(np.sum(missed**2) / max(np.sum(plane.mean**2), 1e-300)))
    return WeaveFit(
        model=model,
        rms_rel=rms_rel,
        variance=variance,
        intervals=ranges,
        identifiability=_identifiability(model, weft, warp, problem, variance),
        at_bounds=at_bounds(p, problem.free),
    )


def _problem(weft: Plane, warp: Plane, reading: int, contact, harness, index) -> tuple[SectionProblem, np.ndarray]:
    start = np.array([0.5, 0.5, 0.5, -1.0, HALF_PI] * 2 + [2 * np.log((START_INDEX - 1) / (START_INDEX + 1))])
    assert start.size == UNKNOWNS
    if index is not None:
        start[-1] = 2 * np.log((index - 1) / (index + 1))
    if harness is not None:
        start[2] = -harness
    start[4] = HALF_PI if contact is None else contact
    touching = contact is None and harness != 2  # single yarns have no contact
    searched = [*[True] * 2, harness is None, True, touching, *[True] * 4, False, index is None]
    problem = SectionProblem(
        rows=_rows(weft, warp),
        split=weft.theta_r.size,
        y=np.concatenate([weft.mean, warp.mean]),
        weight=1.0 / np.concatenate([weft.sigma, warp.sigma]),
        reading=reading,
        free=np.flatnonzero(searched),
    )
    return problem, start


def model_of(p: np.ndarray, weft: Plane, warp: Plane, reading: str) -> WeaveModel:
    """Build the model at the solver's unknowns, with non-negative strengths of each channel over both planes."""
    from scipy.optimize import nnls

    f0 = float(np.exp(p[-1]))
    sigma = np.concatenate([weft.sigma, warp.sigma])[:, None]
    values = np.concatenate([weft.values, warp.values]) / sigma
    shapes, widths = (shape_of(p, 0), shape_of(p[SIZE:], 1)), np.exp(p[[3, SIZE + 3]])
    matrix = columns(*shapes, widths, _rows(weft, warp), f0=f0, reading=READINGS[reading]) / sigma
    strengths = np.array([nnls(matrix, column)[0] for column in values.T])
    root = np.sqrt(f0)
    theta_a, length, radius, _, yarns, contact = (float(value) for value in shape_of(p, 0))
    of_weft = WeftSection(theta_a, length, radius, yarns, contact)
    of_warp = WarpSection(*map(float, shape_of(p[SIZE:], 1)[:4]))
    return WeaveModel(
        of_weft.scale(1 / of_weft.period),
        of_warp.scale(1 / of_warp.period),
        a_weft=float(np.exp(p[3])),
        a_warp=float(np.exp(p[SIZE + 3])),
        index=float((1 + root) / (1 - root)),
        k_s=strengths[:, 0] / f0,
        k_d=strengths[:, 1],
        reading=reading,
    )


def _identifiability(
    model: WeaveModel, weft: Plane, warp: Plane, problem: SectionProblem, variance: float
) -> Identifiability:
    """Determine the identifiability of all physical parameters, also those that were held."""
    known = {name: value for name, value in model.parameters().items() if value > NOTHING}
    if 4 not in problem.free:
        known.pop("contact_weft", None)

    rows, kind = _rows(weft, warp), READINGS[model.reading]

    def predict(values: dict[str, float]) -> np.ndarray:
        """Predict reflectance (n,) for parameters by name; lengths need no common scale."""
        contact = values.get("contact_weft", model.weft.contact)
        weft = (*(values.get(f"{name}_weft", 0.0) for name in ("theta_a", "l", "r")), 0.0, values["n_weft"], contact)
        warp = (*(values.get(f"{name}_warp", 0.0) for name in ("theta_a", "l", "r", "m")), 1.0, HALF_PI)
        f0 = ((values["index"] - 1) / (values["index"] + 1)) ** 2
        both = columns(weft, warp, (values["a_weft"], values["a_warp"]), rows, f0=f0, reading=kind)
        return both @ [values.get("k_s", 0.0) * f0, values.get("k_d", 0.0)]

    return identify(predict, known, problem.weight, variance=variance)


def _rows(weft: Plane, warp: Plane) -> np.ndarray:
    return np.concatenate([plane_rows(k, plane.theta_r) for k, plane in enumerate((weft, warp))])
