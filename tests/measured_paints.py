"""Paints, cameras and lamps from measured tables, for captures of paintings that do not exist."""

from pathlib import Path

import numpy as np

WAVELENGTHS = np.arange(400.0, 701.0, 20.0)  # nm, traced four at a time; spectra are straight between them
FINE = np.arange(400.0, 701.0, 5.0)  # nm, of the truth's spectra


def read_rows(path: Path) -> dict[str, np.ndarray]:
    """Lines `"name" value value ...`."""
    rows = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        parts = line.rsplit('"', 1)
        if len(parts) == 2 and parts[0].startswith('"'):
            rows[parts[0][1:]] = np.array(parts[1].split(), float)
    return rows


def absorption_and_scattering(spectra: Path, pigments: str, rng) -> tuple[np.ndarray, np.ndarray]:
    """K and S (paints, 16) of nine chosen paints, the first the whitest."""
    if pigments == "okumura":
        table = np.array(list(read_rows(spectra / "paints_okumura" / "okumura_ks.txt").values()))
        nm = np.linspace(360.0, 750.0, table.shape[1] // 2)
        k, s = (resampled(nm, part) for part in np.split(table, 2, axis=1))
    else:
        table = np.array(
            [r for r in read_rows(spectra / "paints_measured" / f"{pigments}.rs").values() if len(r) == 36]
        )
        measured = np.clip(resampled(np.linspace(380.0, 730.0, 36), table), 0.005, 0.97)
        inside = below_surface(measured, 1.5)
        k, s = (1 - inside) ** 2 / (2 * inside), np.ones_like(inside)
    light = (k / s).mean(axis=1)
    order = np.concatenate([[np.argmin(light)], rng.permutation(len(light))])
    chosen = order[np.sort(np.unique(order, return_index=True)[1])][:9]
    return np.maximum(k[chosen], 1e-5), np.maximum(s[chosen], 1e-5)


def resampled(nm: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Rows at the traced wavelengths, the end value beyond the table."""
    return np.array([np.interp(WAVELENGTHS, nm, row) for row in values])


def below_surface(measured: np.ndarray, index: float) -> np.ndarray:
    """Reflectance below the surface from that measured above it. J. L. Saunderson, JOSA 32, 1942; diffuse inside."""
    outside = ((index - 1) / (index + 1)) ** 2
    inside = 1 - (1 - 0.0918) / index**2  # diffuse light from within, E. A. Lusher's value for 1.5 outside: 0.0918
    level = measured / ((1 - outside) * (1 - inside) + inside * measured)
    return np.clip(level, 0.004, 0.985)


def palette(spectra: Path, pigments: str, rng, count: int = 28) -> np.ndarray:
    """(count, 16) reflectances of mixed paints: R = 1 + K/S - sqrt((K/S)^2 + 2 K/S), Kubelka and Munk 1931."""
    k, s = absorption_and_scattering(spectra, pigments, rng)
    mixed = []
    for i in range(count):
        parts = np.zeros(len(k))
        colours = rng.choice(np.arange(1, len(k)), size=rng.choice([1, 1, 2, 3]), replace=False)
        parts[colours] = rng.dirichlet(np.ones(len(colours)))
        white = 0.0 if i % 4 == 0 else rng.uniform(0.1, 0.97)
        parts = parts * (1 - white)
        parts[0] += white
        ratio = (parts @ k) / (parts @ s)
        mixed.append(1 + ratio - np.sqrt(ratio**2 + 2 * ratio))
    return np.clip(np.array(mixed), 0.004, 0.985)


def camera_curves(spectra: Path, name: str) -> np.ndarray:
    """(3, 61) red, green, blue."""
    lines = (spectra / "cameras" / "camspec_database.txt").read_text().splitlines()
    at = [line.strip() for line in lines].index(name)
    table = np.array([line.split() for line in lines[at + 1 : at + 4]], float)
    return np.array([np.interp(FINE, np.linspace(400.0, 720.0, 33), row) for row in table])


def lamp_power(spectra: Path, name: str, nm: np.ndarray) -> np.ndarray:
    """Relative spectral power."""
    file = {"A": "cie.stdillum.A.spd", "D65": "cie.stdillum.D6500.spd"}[name]
    table = np.loadtxt(spectra / "illuminants" / file)
    return np.interp(nm, table[:, 0], table[:, 1])
