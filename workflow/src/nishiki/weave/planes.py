"""Reflectances in the two symmetry planes of a cloth: what the weave model is fitted to."""

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError

PLANE_DEG = 1.5  # how far from the plane a view may lie
GRAZING_DEG = 89.5  # lamps and views beyond are left out
STEP_DEG = 3.0
LEAST = 8


@dataclass(frozen=True)
class Plane:
    """Lamps and views in one plane: theta_i, theta_r (n,) signed radians from the normal, below pi/2; values
    (n, channels) sr^-1; sigma (n,) standard deviation of the mean over channels; measured: False where taken from the
    interpolated hemisphere."""

    theta_i: np.ndarray
    theta_r: np.ndarray
    values: np.ndarray
    sigma: np.ndarray
    measured: bool = True

    @property
    def mean(self) -> np.ndarray:
        """Mean over channels (n,)."""
        return self.values.mean(axis=1)


def make_plane(
    theta_r, values, *, theta_i=0.0, relative_error: float = 0.02, noise=None, measured: bool = True
) -> Plane:
    """A plane from signed angles (n,) and values (n,) or (n, channels); theta_i is broadcast.

    noise : standard deviation of the values, same shape, or None. Weights follow from it and from relative_error of the
    value, which stands for everything that the model leaves out.
    """
    theta_r, values = np.asarray(theta_r, np.float64), np.asarray(values, np.float64)
    theta_i = np.broadcast_to(np.asarray(theta_i, np.float64), theta_r.shape)
    values = values[:, None] if values.ndim == 1 else values
    noise = np.zeros_like(values) if noise is None else np.asarray(noise, np.float64).reshape(values.shape)
    inside = (np.abs(theta_i) < np.pi / 2) & (np.abs(theta_r) < np.pi / 2)
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
    order = np.lexsort((theta_r, theta_i))
    return Plane(theta_i[order], theta_r[order], values[order], sigma[order], measured)


def planes_of(reflectances, *, region: int = 0, relative_error: float = 0.02, oblique: bool = True):
    """Weft and warp plane of a set of reflectances (see goniometry.table.ReflectanceSet).

    Lamps and views within PLANE_DEG of a plane; oblique: False leaves out lamps off the normal. Where there are too few
    of them lit along the normal, those are read from the interpolated hemisphere every STEP_DEG degrees, up to the
    outermost view that was measured.
    """
    return tuple(_plane(reflectances, axis, region, relative_error, oblique) for axis in (0, 1))


def _plane(reflectances, axis: int, region: int, relative_error: float, oblique: bool) -> Plane:
    known = reflectances.valid[:, region]
    lamp, view = reflectances.incident[known], reflectances.outgoing[known]
    normal = reflectances.normal_incidence[known]
    inside = _in_plane(lamp, axis) & _in_plane(view, axis) & (oblique | normal)
    rows = {
        "theta_i": np.where(normal, 0.0, np.arctan2(lamp[:, axis], lamp[:, 2]))[inside],
        "theta_r": np.arctan2(view[:, axis], view[:, 2])[inside],
        "values": reflectances.values[known][inside, region],
        "noise": reflectances.noise[known][inside, region],
    }
    measured = (inside & normal).sum() >= LEAST
    if not measured:
        at, read = _interpolated(reflectances, axis, region, view[normal], int((inside & normal).sum()))
        more = {"theta_i": np.zeros(at.size), "theta_r": at, "values": read, "noise": np.zeros_like(read)}
        kept = ~normal[inside]
        rows = {name: np.concatenate([values[kept], more[name]]) for name, values in rows.items()}
    return make_plane(**rows, relative_error=relative_error, measured=bool(measured))


def _in_plane(directions: np.ndarray, axis: int) -> np.ndarray:
    aside = np.abs(np.arcsin(np.clip(directions[:, 1 - axis], -1, 1)))
    along = np.arctan2(np.abs(directions[:, axis]), directions[:, 2])
    return (aside < np.radians(PLANE_DEG)) & (along < np.radians(GRAZING_DEG))


def _interpolated(reflectances, axis, region, view, views: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles and values (n, channels) of one plane from the hemisphere; one side where both are equal."""
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
