"""Tables of the UTIA BRDF database, `.bin`: doubles without a heading, (channel, theta_i, phi_i, theta_r, phi_r).

Reference: J. Filip and R. Vavra (2014), Template-based sampling of anisotropic BRDFs, Computer Graphics Forum 33 (7).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nishiki.formats.files import Refused, read_bytes

UTIA_THETA_DEG, UTIA_PHI_DEG = np.arange(0, 90, 15.0), np.arange(0, 360, 7.5)
UTIA_SHAPE = (3, len(UTIA_THETA_DEG), len(UTIA_PHI_DEG), len(UTIA_THETA_DEG), len(UTIA_PHI_DEG))
UTIA_BYTES = 8 * int(np.prod(UTIA_SHAPE))


def read_utia(path: Path, name: str) -> np.ndarray:
    """Rows (58081, 7) float64 of theta_i, phi_i, theta_r, phi_r in degrees and red, green, blue as stored.

    Values that differ only in the azimuth of a direction along the normal are averaged. Refused where the file is not
    as long as such a table.
    """
    content = read_bytes(path, "reflectances_bytes", name=name)
    if len(content) != UTIA_BYTES:
        expected, found = f"{UTIA_BYTES} bytes, as a table of the UTIA database has", f"{len(content)}"
        remedy = "Give a .bin file of the UTIA database, or the measurements as .csv"
        raise Refused(name, "not such a table", expected=expected, found=found, remedy=remedy)
    stored = np.moveaxis(np.frombuffer(content, "<f8").reshape(UTIA_SHAPE), 0, -1)
    by_light = np.concatenate([stored[:1].mean(axis=1), stored[1:].reshape(-1, *stored.shape[2:])])
    values = np.concatenate([by_light[:, :1].mean(axis=2), by_light[:, 1:].reshape(len(by_light), -1, 3)], axis=1)
    directions = np.array([(0.0, 0.0), *((theta, phi) for theta in UTIA_THETA_DEG[1:] for phi in UTIA_PHI_DEG)])
    count = len(directions)
    return np.column_stack(
        [np.repeat(directions, count, axis=0), np.tile(directions, (count, 1)), values.reshape(-1, 3)]
    )
