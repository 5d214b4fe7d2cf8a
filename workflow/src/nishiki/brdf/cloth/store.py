"""Store the reflection model of a cloth in one `.npz` file, and sample any model as a table.

The table is sampled over the half vector h and the difference between light and half vector (Rusinkiewicz, A new change
of variables for efficient BRDF representation, 1998): a highlight moves with the light, but stays where it is in h.
With i and o exchanged h stays and phi_d turns by pi, so a table over phi_d in 0 .. pi is reciprocal by construction;
what is not reciprocal in the model becomes its mean over both orders.
"""

import io
import zipfile
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nishiki.brdf.cloth.interface import halves, only_above
from nishiki.errors import UserError
from nishiki.formats.fields import ArrayFields
from nishiki.formats.merl import UTIA_PHI_DEG, UTIA_THETA_DEG
from nishiki.formats.stored import load_arrays
from nishiki.goniometry.directions import unit

_HALF_PI = np.pi / 2
_NEAREST_HORIZON = 1e-3  # z of the directions that stand for those at and beyond the horizon


def pair(theta_h, phi_h, theta_d, phi_d) -> tuple[np.ndarray, np.ndarray]:
    """Light and view (..., 3) of a half vector and of the light's angles about it (radians, broadcast).

    The frame about h is the cloth's, turned by theta_h about the y axis and then by phi_h about z.
    """
    theta_h, phi_h, theta_d, phi_d = np.broadcast_arrays(theta_h, phi_h, theta_d, phi_d)
    x, y, z = np.sin(theta_d) * np.cos(phi_d), np.sin(theta_d) * np.sin(phi_d), np.cos(theta_d)

    def to_cloth(x, y, z):
        x, z = x * np.cos(theta_h) + z * np.sin(theta_h), z * np.cos(theta_h) - x * np.sin(theta_h)
        return np.stack([x * np.cos(phi_h) - y * np.sin(phi_h), x * np.sin(phi_h) + y * np.cos(phi_h), z], axis=-1)

    return to_cloth(x, y, z), to_cloth(-x, -y, z)


def pair_angles(incident, outgoing):
    """theta_h, phi_h (0 .. 2 pi), theta_d, phi_d (0 .. pi) of directions above the horizon; the inverse of `pair`."""
    g = halves(incident, outgoing)
    x, y, z = np.moveaxis(np.broadcast_to(np.asarray(incident, float), g.h.shape), -1, 0)
    flat = np.hypot(g.h[..., 0], g.h[..., 1])
    theta_h, phi_h = np.arctan2(flat, g.h[..., 2]), np.arctan2(g.h[..., 1], g.h[..., 0])
    x, y = x * np.cos(phi_h) + y * np.sin(phi_h), y * np.cos(phi_h) - x * np.sin(phi_h)
    x, z = x * np.cos(theta_h) - z * np.sin(theta_h), z * np.cos(theta_h) + x * np.sin(theta_h)
    theta_d = np.arctan2(np.hypot(x, y), z)
    return theta_h, np.mod(phi_h, 2 * np.pi), theta_d, np.mod(np.arctan2(y, x), np.pi)


@dataclass(frozen=True)
class TableBrdf(ArrayFields):
    """Linear interpolation in (theta_h, phi_h, theta_d, phi_d); theta_h denser towards the normal (square root)."""

    KIND: ClassVar[str] = "table"
    values: (
        np.ndarray
    )  # (nh, mh, nd, md, channels) float32, 1 / sr, at (k/(nh-1))^2 pi/2, periodic, k/(nd-1) pi/2, periodic

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.values.shape[-1]

    @classmethod
    def sample(cls, brdf, *, thetas_h: int = 28, phis_h: int = 48, thetas_d: int = 19, phis_d: int = 24) -> "TableBrdf":
        """Sample any BRDF; nodes whose light or view is below the horizon take the value on the horizon.

        Default: 613 000 nodes, 2.5 MB a channel.
        """
        theta_h, phi_h = (
            (np.arange(thetas_h) / (thetas_h - 1)) ** 2 * _HALF_PI,
            np.arange(phis_h) * (2 * np.pi / phis_h),
        )
        theta_d, phi_d = np.arange(thetas_d) / (thetas_d - 1) * _HALF_PI, np.arange(phis_d) * (np.pi / phis_d)
        values = np.empty((thetas_h, phis_h, thetas_d, phis_d, brdf.channels), np.float32)
        for k, theta in enumerate(theta_h):
            incident, outgoing = pair(theta, phi_h[:, None, None], theta_d[:, None], phi_d)
            incident, outgoing = _raised(incident), _raised(outgoing)
            values[k] = brdf.evaluate(incident, outgoing)
            if not getattr(brdf, "RECIPROCAL", False):
                values[k] = (values[k] + brdf.evaluate(outgoing, incident)) / 2
        return cls(values)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, 1 / sr: (..., channels)."""
        above = halves(incident, outgoing).above
        theta_h, phi_h, theta_d, phi_d = pair_angles(incident, outgoing)
        nh, mh, nd, md = self.values.shape[:4]
        axes = (
            _between(np.sqrt(theta_h / _HALF_PI) * (nh - 1), nh),
            _around(phi_h / (2 * np.pi) * mh, mh),
            _between(theta_d / _HALF_PI * (nd - 1), nd),
            _around(phi_d / np.pi * md, md),
        )
        total = np.zeros((*above.shape, self.channels))
        for corner in np.ndindex(2, 2, 2, 2):
            weight = np.prod([axis[1][side] for axis, side in zip(axes, corner, strict=True)], axis=0)
            index = tuple(axis[0][side] for axis, side in zip(axes, corner, strict=True))
            total += weight[..., None] * self.values[index]
        return only_above(above, total)


def _raised(directions: np.ndarray) -> np.ndarray:
    """Lift the directions below the horizon straight up to it."""
    low = np.stack([directions[..., 0], directions[..., 1], np.maximum(directions[..., 2], _NEAREST_HORIZON)], axis=-1)
    return low / np.linalg.norm(low, axis=-1, keepdims=True)


def _between(place: np.ndarray, count: int):
    """Return indices and weights of the two nodes beside a place 0 .. count - 1."""
    first = np.clip(place.astype(int), 0, count - 2)
    share = np.clip(place - first, 0, 1)
    return (first, first + 1), (1 - share, share)


def _around(place: np.ndarray, count: int):
    """Return indices and weights of the two nodes beside a place on a circle of `count` nodes."""
    first = np.floor(place).astype(int)
    share = place - first
    return (first % count, (first + 1) % count), (1 - share, share)


def goniometer_rows(brdf, *, incident_deg, outgoing_deg) -> np.ndarray:
    """Rows theta_i, phi_i, theta_r, phi_r (degrees), then one value a channel (1 / sr), of all pairs of two lists.

    incident_deg (m, 2), outgoing_deg (n, 2): theta, phi.  The very columns of a capture's table of reflectances, so
    that an exported BRDF can be read as a measurement.
    """
    incident_deg, outgoing_deg = np.asarray(incident_deg, float), np.asarray(outgoing_deg, float)
    values = brdf.evaluate(unit(*np.radians(incident_deg.T))[:, None], unit(*np.radians(outgoing_deg.T))[None])
    angles = np.concatenate(
        [np.repeat(incident_deg, len(outgoing_deg), axis=0), np.tile(outgoing_deg, (len(incident_deg), 1))], axis=1
    )
    return np.concatenate([angles, values.reshape(len(angles), -1)], axis=1)


def utia_planes(brdf) -> np.ndarray:
    """Sample the table of the UTIA BRDF database, (3, 6, 48, 6, 48) float64: channel, theta_i, phi_i, theta_r, phi_r.

    theta 0 .. 75 degrees by 15, phi by 7.5; written as little-endian doubles in this order it is a `.bin` file that
    readers of that database open (ALTA among them).  One channel is written three times.  Values are 1 / sr.
    """
    directions = unit(*np.radians(np.meshgrid(UTIA_THETA_DEG, UTIA_PHI_DEG, indexing="ij")))
    values = brdf.evaluate(directions[:, :, None, None], directions[None, None])
    values = np.broadcast_to(values, (*values.shape[:-1], 3)) if values.shape[-1] == 1 else values[..., :3]
    return np.ascontiguousarray(np.moveaxis(values, -1, 0)).astype("<f8")


KINDS = {  # where the class of a kind is
    "bard_linear": "nishiki.brdf.cloth.normal_incidence:LinearBard",
    "bard_great_circle": "nishiki.brdf.cloth.normal_incidence:GreatCircleBard",
    "bard_scaled": "nishiki.brdf.cloth.normal_incidence:ScaledBard",
    "facets": "nishiki.brdf.cloth.normal_incidence:FacetBrdf",
    "yarn_facets": "nishiki.brdf.cloth.yarn_facets:YarnFacets",
    "yarns": "nishiki.weave.yarn_weave:InterlacedYarns",
    "weave": "nishiki.weave.model:WeaveBrdf",
    "table": "nishiki.brdf.cloth.store:TableBrdf",
    "dyed": "nishiki.brdf.cloth.interface:Dyed",
}
_KIND = "kind"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # of every member: a file's bytes do not depend on when it was written


def class_of(kind: str) -> Any:
    """Import the dataclass of a kind of BRDF."""
    if kind not in KINDS:
        raise UserError(f"kind of BRDF: expected one of {', '.join(sorted(KINDS))}, found {kind!r}")
    module, name = KINDS[kind].split(":")
    return getattr(import_module(module), name)


def save_brdf(path: Path, brdf) -> None:
    """Write a reflection model of a cloth to a `.npz` file.

    The same numbers give the same bytes; nothing is pickled.

    Parameters
    ----------
    path : str or Path
        File to write; one that exists is replaced.
    brdf : ClothBrdf
        Model, from `nishiki.fit_cloth` for example.

    Raises
    ------
    OSError
        Where the file cannot be written.

    See Also
    --------
    read_cloth : Reads it back.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> cloth = nishiki.read_cloth("results/satin/current/brdf.npz")
    >>> nishiki.write_cloth("cloth.npz", cloth)
    >>> again = nishiki.read_cloth("cloth.npz")
    >>> light, view = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.0, 1.0])
    >>> bool((again.evaluate(light, view) == cloth.evaluate(light, view)).all())
    True
    """
    arrays = {_KIND: np.array(brdf.KIND), **brdf.as_arrays()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(arrays):
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(arrays[name], order="C"), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), member.getvalue(), zipfile.ZIP_DEFLATED)


def load_brdf(path: Path):
    """Read a reflection model of a cloth: a result of the stage cloth_brdf, or what `nishiki.write_cloth` wrote.

    Parameters
    ----------
    path : str or Path
        The `.npz` file.

    Returns
    -------
    ClothBrdf
        Its method `evaluate(incident, outgoing)` takes unit vectors (..., 3), x weft, y warp, z normal, and gives the
        bidirectional reflectance in 1 / sr, (..., channels) float64.

    Raises
    ------
    nishiki.errors.UserError
        Where the file is missing, damaged, or holds no such model.

    See Also
    --------
    fit_cloth : Fits a model to measurements.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> cloth = nishiki.read_cloth("results/satin/current/brdf.npz")
    >>> lights, view = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]), np.array([0.0, 0.0, 1.0])
    >>> values = cloth.evaluate(lights, view)
    >>> values.shape == (2, cloth.channels)
    True
    """
    arrays = load_arrays(path, name=f"{path}: expected a stored BRDF (.npz)")
    if _KIND not in arrays:
        raise UserError(f"{path}: expected a stored BRDF with its kind, found arrays {sorted(arrays)}")
    return class_of(str(arrays.pop(_KIND))).from_arrays(arrays)
