"""Errors of the spectral reflectance against true spectra."""

from dataclasses import dataclass

import numpy as np

from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_matrix, xyz_to_lab
from nishiki.errors import UserError
from nishiki.evaluate.summary import Summary, summarise

_BAND_ROWS = 16


@dataclass(frozen=True)
class RegionSpectrum:
    """Mean estimated and mean true spectrum (61,) of the pixels of one region; rmse between the two."""

    label: int
    pixels: int
    estimate: np.ndarray
    truth: np.ndarray
    rmse: float


@dataclass(frozen=True)
class ReflectanceErrors:
    """Reflectance against truth.

    rmse : over the 61 bands of each pixel; de00 : illuminant -> CIEDE2000; de00_map : (rows, columns) float32 under the
    first illuminant, NaN where not compared; regions : mean spectra of the regions.
    """

    rmse: Summary
    de00: dict[str, Summary]
    de00_map: np.ndarray
    regions: tuple[RegionSpectrum, ...]

    def as_dict(self) -> dict:
        """Plain values, for JSON (spectra rounded to 1e-5)."""
        regions = [
            {
                "label": r.label,
                "pixels": r.pixels,
                "rmse": r.rmse,
                "estimate": np.round(r.estimate, 5).tolist(),
                "truth": np.round(r.truth, 5).tolist(),
            }
            for r in self.regions
        ]
        de00 = {name: summary.as_dict() for name, summary in self.de00.items()}
        return {"rmse": self.rmse.as_dict(), "de00": de00, "regions": regions}


def reflectance_errors(
    coefficients: np.ndarray,
    basis: np.ndarray,
    paints: np.ndarray,
    spectra: np.ndarray,
    *,
    pixels: np.ndarray,
    regions: np.ndarray | None = None,
    illuminants: tuple[str, ...] = ("D65", "A", "FL11"),
) -> ReflectanceErrors:
    """Compare S = coefficients @ basis with the true spectrum of each pixel.

    coefficients : (rows, columns, K); basis : (K, 61); paints : (rows, columns, samples) or (rows, columns) integers
    into spectra (paints, 61), a pixel's spectrum is the mean over its samples; pixels : (rows, columns) bool, those to
    compare; regions : (rows, columns) integers that group pixels for mean spectra (default: the first sample's paint).
    Values are not clipped. Raises UserError where shapes differ.
    """
    paints = paints[..., None] if paints.ndim == 2 else paints
    shape = coefficients.shape[:2]
    if paints.shape[:2] != shape or spectra.ndim != 2 or spectra.shape[1] != basis.shape[1]:
        raise UserError(
            f"truth: expected paints of {shape} pixels and spectra of {basis.shape[1]} bands, found "
            f"{paints.shape} and {spectra.shape}; give the truth of this very capture"
        )
    if paints.size and int(paints.max()) >= len(spectra):
        raise UserError(f"truth: expected paints from 0 to {len(spectra) - 1}, found {paints.max()}")
    regions = paints[..., 0] if regions is None else regions
    means = _RegionMeans(int(regions.max()) + 1, basis.shape[1])
    rmse = np.full(shape, np.nan, np.float32)
    maps = {name: np.full(shape, np.nan, np.float32) for name in illuminants}
    eyes = {
        name: (xyz_matrix(illuminant(name), np.eye(basis.shape[1])).T, white_xyz(illuminant(name))) for name in maps
    }
    for start in range(0, shape[0], _BAND_ROWS):
        band = slice(start, start + _BAND_ROWS)
        used = pixels[band]
        estimated = coefficients[band][used].astype(np.float64) @ basis
        true = spectra[paints[band][used]].mean(axis=1, dtype=np.float64)
        rmse[band][used] = np.sqrt(np.mean((estimated - true) ** 2, axis=1))
        for name, (matrix, white) in eyes.items():
            maps[name][band][used] = delta_e_2000(
                xyz_to_lab(estimated @ matrix, white), xyz_to_lab(true @ matrix, white)
            )
        means.add(regions[band][used], estimated, true)
    return ReflectanceErrors(
        rmse=summarise(rmse, where=pixels),
        de00={name: summarise(values, where=pixels) for name, values in maps.items()},
        de00_map=maps[illuminants[0]],
        regions=means.spectra(),
    )


class _RegionMeans:
    """Sums of estimated and true spectra by region, band after band."""

    def __init__(self, regions: int, bands: int):
        self.size = np.zeros(regions, np.int64)
        self.sums = np.zeros((2, regions, bands))

    def add(self, labels: np.ndarray, estimated: np.ndarray, true: np.ndarray) -> None:
        for label in np.unique(labels):
            chosen = labels == label
            self.size[label] += np.count_nonzero(chosen)
            self.sums[0, label] += estimated[chosen].sum(axis=0)
            self.sums[1, label] += true[chosen].sum(axis=0)

    def spectra(self) -> tuple[RegionSpectrum, ...]:
        result = []
        for label in np.flatnonzero(self.size):
            estimated, true = self.sums[:, label] / self.size[label]
            rmse = float(np.sqrt(np.mean((estimated - true) ** 2)))
            result.append(RegionSpectrum(int(label), int(self.size[label]), estimated, true, rmse))
        return tuple(result)
