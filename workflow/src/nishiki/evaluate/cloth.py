"""Compare predicted and measured reflectance of a cloth, by incidence and in the plane of incidence."""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.cloth.interface import incidences, prediction_error, solid_angles

PLANES = ((0.0, "weft"), (90.0, "warp"))
WITHIN_DEG = 2.0
"""An incidence this close to the weft or the warp is in its plane."""
LEAST_VIEWS = 8
"""Fewer views of one incidence than this say nothing about its peak."""


@dataclass(frozen=True)
class Judged:
    """One model at one incidence."""

    theta_i_deg: float  # theta_i_deg, phi_i_deg: of the light
    phi_i_deg: float
    plane: str  # weft, warp, or its azimuth within a quarter
    views: int  # compared
    # root mean square error over root mean square, weighted by cos theta_r and the solid angle of each view's cell
    rms_rel: float
    bias_rel: float  # weighted mean error over weighted mean
    # between the brightest predicted and the brightest measured view; None where there are fewer than 8 views
    peak_direction_deg: float | None
    peak_value_rel: float | None  # predicted over measured brightest value, less 1; None likewise
    noise_rel: float | None  # what rms_rel noise alone would give, None where unknown


def plane_name(phi_deg: float) -> str:
    """Return weft, warp, or the azimuth brought into 0 to 90 degrees, in words."""
    folded = abs((phi_deg + 90) % 180 - 90)
    for azimuth, name in PLANES:
        if abs(folded - azimuth) <= WITHIN_DEG:
            return name
    return "bias" if abs(folded - 45) <= WITHIN_DEG else f"{folded:.0f}°"


def judge(
    incident: np.ndarray,
    outgoing: np.ndarray,
    measured: np.ndarray,
    predicted: np.ndarray,
    noise: np.ndarray,
    *,
    quarter: bool = False,
) -> list[Judged]:
    """Errors at every incidence; directions (n, 3), values and noise (n, channels), sr^-1. Channels are averaged.

    quarter: the cloth has two mirror planes, so that under normal incidence a view stands for its images too.
    """
    rows = []
    for theta, phi, chosen in incidences(incident):
        weights = solid_angles(outgoing[chosen], quarter=quarter and theta < np.radians(1))
        error = prediction_error(outgoing[chosen], measured[chosen], predicted[chosen], weights)
        weights = weights * outgoing[chosen, 2]
        true, guess = measured[chosen].mean(axis=1), predicted[chosen].mean(axis=1)
        power = float(np.sum(weights * true**2))
        spread = np.sqrt(np.sum(noise[chosen] ** 2, axis=1)) / noise.shape[1]
        enough = len(chosen) >= LEAST_VIEWS
        phi_deg = float(np.degrees(phi))
        rows.append(
            Judged(
                theta_i_deg=round(float(np.degrees(theta)), 3),
                phi_i_deg=round(phi_deg, 3),
                plane="any" if theta < np.radians(1) else plane_name(phi_deg),
                views=len(chosen),
                rms_rel=error.rms_rel,
                bias_rel=float(np.sum(weights * (guess - true)) / np.sum(weights * true)),
                peak_direction_deg=float(np.degrees(error.peak_direction)) if enough else None,
                peak_value_rel=error.peak_value if enough else None,
                noise_rel=float(np.sqrt(np.sum(weights * spread**2) / power)) if (spread > 0).any() else None,
            )
        )
    return rows


def by_incidence(rows: list[Judged]) -> dict[str, dict]:
    """Return means over the planes of one polar angle, by the angle rounded to a degree, and the worst rms_rel."""
    means = {}
    for angle in sorted({round(row.theta_i_deg) for row in rows}):
        mine = [row for row in rows if round(row.theta_i_deg) == angle]
        values = [abs(row.peak_value_rel) for row in mine if row.peak_value_rel is not None]
        turns = [row.peak_direction_deg for row in mine if row.peak_direction_deg is not None]
        means[str(angle)] = {
            "incidences": len(mine),
            "views": sum(row.views for row in mine),
            "rms_rel": float(np.mean([row.rms_rel for row in mine])),
            "worst_rms_rel": max(row.rms_rel for row in mine),
            "peak_value_rel": float(np.mean(values)) if values else None,
            "peak_direction_deg": float(np.mean(turns)) if turns else None,
        }
    return means


def in_plane(outgoing: np.ndarray, azimuth: float, *, within: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Rows of views (n, 3) in the plane through the normal at this azimuth, and their signed polar angles, radians.

    within: largest sine of the angle between the view's azimuth and the plane's; where fewer than four views are that
    near, largest sine of the angle to the plane. Angles are positive towards the azimuth; rising.
    """
    ahead, aside = np.array([np.cos(azimuth), np.sin(azimuth)]), np.array([-np.sin(azimuth), np.cos(azimuth)])
    off, tilt = np.abs(outgoing[:, :2] @ aside), np.hypot(outgoing[:, 0], outgoing[:, 1])
    rows = np.flatnonzero(off <= np.maximum(within * tilt, 1e-3))
    if len(rows) < 4:
        rows = np.flatnonzero(off <= within)
    angle = np.arctan2(outgoing[rows, :2] @ ahead, outgoing[rows, 2])
    order = np.argsort(angle, kind="stable")
    return rows[order], angle[order]
