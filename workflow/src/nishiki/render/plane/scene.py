"""Describe a plane scene: the maps of the object, its gloss, lamps, ambient light and the view.

The painting is the rectangle z = 0 with its centre at the origin, x to the right, y up, z towards the viewer, lengths
in the unit of `pitch` (mm in captures that state a scale).  Row 0 of every map is the top.  Values are relative to the
white reference: a perfect white diffuser that faces a lamp of intensity 1 has Y = 1.
"""

from dataclasses import dataclass, field

import numpy as np

from nishiki.colour.sampling import BANDS
from nishiki.errors import UserError, require
from nishiki.geometry.camera import Camera, look_at


def _finite_vector(name, value, length) -> np.ndarray:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (length,) or not np.all(np.isfinite(vector)):
        raise UserError(f"{name}: expected {length} finite numbers, found {value!r}; correct the light or view list")
    return vector


def _spectrum(name, value) -> np.ndarray:
    spectrum = np.asarray(value, dtype=np.float64)
    if spectrum.shape != (BANDS,):
        raise UserError(
            f"{name}: expected {BANDS} bands (400 to 700 nm every 5 nm), found shape {spectrum.shape}; resample it"
        )
    if not np.all(np.isfinite(spectrum)) or spectrum.min() < 0 or spectrum.max() <= 0:
        raise UserError(f"{name}: expected finite values >= 0, not all 0; found {spectrum.min()} .. {spectrum.max()}")
    return spectrum


def _level(name, value) -> None:
    if not (np.isfinite(value) and value >= 0):
        raise UserError(f"{name}: expected a finite value >= 0, found {value!r}; 1 is the level of the white reference")


@dataclass(frozen=True)
class Light:
    """One lamp: a direction (lamp at infinity) or a position, its spectrum, and its strength."""

    direction: tuple | None = None  # (3,) towards the lamp, of any length
    # (3,) from the centre of the painting, in the unit of the pitch. Exactly one of them is given, with z > 0
    position_mm: tuple | None = None
    # (61,) relative power, 400 .. 700 nm every 5 nm; only its shape matters
    spectrum: np.ndarray = field(default_factory=lambda: np.ones(BANDS))
    intensity: float = 1.0  # Y of a perfect white that faces the lamp at the centre of the painting
    falloff: bool = False  # with a position, irradiance decreases with the square of the distance (1 at the centre)
    # radius of the lamp as seen from the centre, radians; it softens the edges of cast shadows only
    angular_radius: float = 0.0

    def __post_init__(self):
        if (self.direction is None) == (self.position_mm is None):
            raise UserError("light: expected either a direction or a position_mm, found both or none; give one of them")
        vector = _finite_vector("light", self.direction if self.position_mm is None else self.position_mm, 3)
        if not vector[2] > 0:
            raise UserError(
                f"light: expected z > 0 (in front of the painting), found {vector.tolist()}; check its sign"
            )
        if self.falloff and self.position_mm is None:
            raise UserError("light: fall-off needs a position_mm, found a direction; give the position or drop falloff")
        if not 0 <= self.angular_radius < np.pi / 4:
            raise UserError(
                f"light: expected an angular radius below 45 degrees, found {np.degrees(self.angular_radius):g} degrees"
            )
        object.__setattr__(self, "spectrum", _spectrum("spectrum of a light", self.spectrum))
        _level("intensity of a light", self.intensity)

    def homogeneous(self) -> np.ndarray:
        """Return (4,): unit direction and 0, or position and 1, so that the vector to the lamp from p is xyz - w p."""
        if self.position_mm is not None:
            return np.append(np.asarray(self.position_mm, dtype=np.float64), 1.0)
        direction = np.asarray(self.direction, dtype=np.float64)
        return np.append(direction / np.linalg.norm(direction), 0.0)

    def central_direction(self) -> np.ndarray:
        """Compute (3,): unit vector from the centre of the painting to the lamp."""
        vector = self.homogeneous()[:3]
        return vector / np.linalg.norm(vector)


@dataclass(frozen=True)
class Ambient:
    """Light from everywhere in front of the painting: a uniform half space that gives a flat perfect white Y = level.

    It reaches the diffuse colour only, with the share (1 + n_z) / 2 of that half space which a tilted facet sees.
    """

    spectrum: np.ndarray = field(default_factory=lambda: np.ones(BANDS))
    level: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "spectrum", _spectrum("spectrum of the ambient light", self.spectrum))
        _level("level of the ambient light", self.level)


@dataclass(frozen=True)
class View:
    """Viewpoint: without an eye the frontal orthographic view, with one a pinhole camera."""

    # eye_mm, target_mm: (3,) in the unit of the pitch from the centre of the painting, eye with z > 0
    eye_mm: tuple | None = None
    target_mm: tuple = (0.0, 0.0, 0.0)
    up: tuple = (0.0, 1.0, 0.0)  # (3,), not parallel to the line of sight
    field_of_view: float = np.radians(30.0)  # of the image's height, radians
    rows: int | None = None  # rows, columns: of the image (for the frontal view the default is the size of the maps)
    columns: int | None = None

    def __post_init__(self):
        if (self.rows is None) != (self.columns is None) or (
            self.rows is not None and self.columns is not None and min(self.rows, self.columns) < 1
        ):
            raise UserError(f"view: expected rows and columns >= 1, found {self.rows} and {self.columns}; give both")
        if self.eye_mm is None:
            return
        for name, value in (("eye", self.eye_mm), ("target", self.target_mm), ("up", self.up)):
            _finite_vector(name, value, 3)
        if not self.eye_mm[2] > 0:
            raise UserError(f"view: expected an eye in front of the painting (z > 0), found {self.eye_mm}")
        if self.rows is None:
            raise UserError("view: a pinhole view needs rows and columns; give the size of the image")
        self.camera()

    def camera(self) -> Camera:
        """Return the pinhole camera of a view with an eye."""
        size, angle = (require(self.rows), require(self.columns)), self.field_of_view
        return look_at(self.eye_mm, self.target_mm, rows=size[0], columns=size[1], field_of_view=angle, up=self.up)


@dataclass(frozen=True)
class Gloss:
    """Torrance-Sparrow parameters, one row a region; a scene without regions has one row."""

    # beta, gamma: (regions, lobes), strength relative to the white reference and half width at half maximum in radians
    beta: np.ndarray
    gamma: np.ndarray
    refractive_index: np.ndarray  # (regions,) >= 1
    # (regions,) share (0 to 1) of the loss at a surface of that index that the body's light suffers on its way in and
    # out (`nishiki.brdf.torrance_sparrow.transmittance`)
    transmission: np.ndarray | float = 0.0

    def __post_init__(self):
        beta, gamma = (np.asarray(a, dtype=np.float64) for a in (self.beta, self.gamma))
        index = np.atleast_1d(np.asarray(self.refractive_index, dtype=np.float64))
        beta, gamma = (a.reshape(index.size, -1) if a.ndim < 2 else a for a in (beta, gamma))
        if beta.shape != gamma.shape or beta.shape[0] != index.size or beta.shape[1] < 1:
            raise UserError(
                f"gloss: expected beta and gamma of (regions, lobes) and one refractive index a region, "
                f"found {beta.shape}, {gamma.shape} and {index.shape}"
            )
        if not (np.all(np.isfinite(beta)) and beta.min() >= 0):
            raise UserError(f"gloss: expected finite beta >= 0, found {beta.tolist()}; refit or set it to 0")
        if not (gamma.min() >= 1e-6):
            raise UserError(
                f"gloss: expected gamma >= 1e-6 rad, found {gamma.tolist()}; float32 normals resolve no less"
            )
        if not (np.all(np.isfinite(index)) and index.min() >= 1):
            raise UserError(f"gloss: expected a refractive index >= 1, found {index.tolist()}")
        lost = np.broadcast_to(np.asarray(self.transmission, dtype=np.float64), index.shape).copy()
        if not (lost.min() >= 0 and lost.max() <= 1):
            raise UserError(f"gloss: expected a transmission from 0 to 1, found {lost.tolist()}")
        for name, value in (("beta", beta), ("gamma", gamma), ("refractive_index", index), ("transmission", lost)):
            object.__setattr__(self, name, value)

    @classmethod
    def none(cls) -> "Gloss":
        """Make a matte surface: no specular term is computed."""
        return cls(np.zeros((1, 1)), np.ones((1, 1)), np.ones(1))


@dataclass(frozen=True)
class PlaneScene:
    """The maps of a flat object."""

    normals: np.ndarray  # (rows, columns, 3) float32, unit length, (0, 0, 0) where unknown
    coefficients: np.ndarray  # (rows, columns, K) float32, diffuse reflectance. With `basis` (K, 61), S = coefficients
    # @ basis; without a basis they are linear sRGB
    basis: np.ndarray | None = None
    # (rows, columns, 3 or 5) float32, terms of the body shading (`torrance_sparrow.body_shading`), or None
    shading: np.ndarray | None = None
    # (rows, columns, 3) float32, covariance of the slopes in a pixel (`nishiki.brdf.slopes`), or None: no blur
    slopes: np.ndarray | None = None
    height: np.ndarray | None = None  # (rows, columns) float32 in the unit of `pitch`, or None: no cast shadows
    labels: np.ndarray | None = None  # (rows, columns) uint8 row of `gloss` for each pixel, or None: row 0 everywhere
    gloss: Gloss = field(default_factory=Gloss.none)
    pitch: float = 1.0  # distance between neighbouring pixels

    def __post_init__(self):
        if not (np.isfinite(self.pitch) and self.pitch > 0):
            raise UserError(f"pitch: expected a length above 0, found {self.pitch!r}")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the maps."""
        return self.normals.shape[:2]
