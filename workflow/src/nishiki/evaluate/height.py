"""Error of the integrated height: its level and tilt are free, because normals do not say them."""

from dataclasses import asdict, dataclass

import numpy as np

from nishiki.errors import UserError


@dataclass(frozen=True)
class HeightError:
    """Height against truth after removal of the best plane from the difference; unit of the heights.

    rms, p90, worst: of the remaining difference; relief_rms: of the truth about its own best plane, to compare with;
    tilt_deg: tilt of the removed plane where heights and pitch share a unit; pixels: number compared.
    """

    rms: float | None
    p90: float | None
    worst: float | None
    relief_rms: float | None
    tilt_deg: float | None
    pixels: int

    def as_dict(self) -> dict:
        """Plain values, for JSON."""
        return asdict(self)


def height_error(height: np.ndarray, truth: np.ndarray, *, pixels: np.ndarray, pitch: float = 1.0) -> HeightError:
    """Compare heights (rows, columns) where `pixels` (bool) is set and both are finite.

    pitch : distance of neighbouring pixels in the unit of the heights. Fewer than 3 pixels: all figures None.
    Raises UserError where shapes differ.
    """
    if height.shape != truth.shape:
        raise UserError(
            f"truth: expected heights of shape {height.shape}, found {truth.shape}; crop them as the capture"
        )
    used = pixels & np.isfinite(height) & np.isfinite(truth)
    count = int(np.count_nonzero(used))
    if count < 3:
        return HeightError(None, None, None, None, None, count)
    rows, columns = np.nonzero(used)
    difference, _, slope = _without_plane(height[used].astype(np.float64) - truth[used], rows, columns)
    relief, _, _ = _without_plane(truth[used].astype(np.float64), rows, columns)
    return HeightError(
        rms=float(np.sqrt(np.mean(difference**2))),
        p90=float(np.percentile(np.abs(difference), 90)),
        worst=float(np.abs(difference).max()),
        relief_rms=float(np.sqrt(np.mean(relief**2))),
        tilt_deg=float(np.degrees(np.arctan(slope / pitch))),
        pixels=count,
    )


def _without_plane(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Residual of the least-squares plane, its coefficients, and its slope per pixel."""
    x, y = columns - columns.mean(), rows - rows.mean()
    centred = values - values.mean()
    gram = np.array([[x @ x, x @ y], [x @ y, y @ y]])
    # lstsq: pixels of one line only leave the slope across it free; it takes the smallest
    slope = np.linalg.lstsq(gram, np.array([x @ centred, y @ centred]), rcond=1e-12)[0]
    return centred - slope[0] * x - slope[1] * y, slope, float(np.hypot(*slope))
