"""How near a picture is to its photograph, in the capture's own encoding, over outline and rendered surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PEAK = 1.0  # full scale of the camera's codes


@dataclass(frozen=True)
class Difference:
    """Sum of squared differences over the channels and number of pixels; uncovered: pixels of the outline that the
    surface misses; superfluous: pixels that it covers beyond the outline."""

    squares: float
    samples: int
    pixels: int
    uncovered: int = 0
    superfluous: int = 0

    @property
    def psnr_db(self) -> float | None:
        """Peak signal to noise ratio of peak 1; None without pixels or without any difference."""
        if not self.samples or self.squares <= 0:
            return None
        return float(10 * np.log10(PEAK * PEAK * self.samples / self.squares))

    def __add__(self, other: Difference) -> Difference:
        return Difference(
            self.squares + other.squares,
            self.samples + other.samples,
            self.pixels + other.pixels,
            self.uncovered + other.uncovered,
            self.superfluous + other.superfluous,
        )


NOTHING = Difference(0.0, 0, 0)


def difference(
    coded: np.ndarray, photograph: np.ndarray, outline: np.ndarray, covered: np.ndarray, valid: np.ndarray
) -> Difference:
    """Difference over all pixels that either shows.

    Parameters
    ----------
    coded, photograph : (rows, columns, channels) array
        In the capture's encoding, full scale 1.
    outline, covered, valid : (rows, columns) bool array
        Pixels of the object; pixels that the rendered surface reaches; neither dead nor saturated.
    """
    judged = (outline | covered) & valid
    delta = coded[judged].astype(np.float64) - photograph[judged].astype(np.float64)
    missed, extra = (int(np.count_nonzero(judged & ~part)) for part in (covered, outline))
    return Difference(float(np.sum(delta * delta)), delta.size, int(np.count_nonzero(judged)), missed, extra)


def structural_similarity(coded: np.ndarray, photograph: np.ndarray, inside: np.ndarray) -> float | None:
    """Mean structural similarity over the pixels inside (Z. Wang et al., Image quality assessment: from error
    visibility to structural similarity, IEEE Trans. Image Processing 13(4), 2004): Gaussian window of 1.5 pixels,
    mean of the channels, outside of the silhouette counted as equal.  None without pixels."""
    from scipy.ndimage import gaussian_filter

    if not inside.any():
        return None
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    box = slice(max(rows[0] - 6, 0), rows[-1] + 7), slice(max(columns[0] - 6, 0), columns[-1] + 7)
    mask = inside[box]
    total = 0.0
    for channel in range(coded.shape[2]):
        y = np.where(mask, photograph[box][..., channel], 0).astype(np.float64)
        x = np.where(mask, coded[box][..., channel], 0).astype(np.float64)
        mx, my = (gaussian_filter(v, 1.5, truncate=3.5) for v in (x, y))
        xx, yy, xy = (gaussian_filter(v, 1.5, truncate=3.5) for v in (x * x, y * y, x * y))
        c1, c2 = (0.01 * PEAK) ** 2, (0.03 * PEAK) ** 2
        top = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
        bottom = (mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2)
        total += float(np.mean((top / bottom)[mask]))
    return total / coded.shape[2]


def summary(differences: list[Difference]) -> dict:
    """Mean and worst PSNR of the views, and that of all pixels taken together; None where nothing was measured."""
    values = [d.psnr_db for d in differences if d.psnr_db is not None]
    pooled = sum(differences, NOTHING)
    return {
        "views": len(values),
        "mean_psnr_db": float(np.mean(values)) if values else None,
        "worst_psnr_db": float(np.min(values)) if values else None,
        "pooled_psnr_db": pooled.psnr_db,
        "pixels": pooled.pixels,
        "uncovered_pixels": pooled.uncovered,
        "superfluous_pixels": pooled.superfluous,
    }
