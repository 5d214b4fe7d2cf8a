"""Evaluate Lambert's term and a lobe of facets on a surface, under the lamps of a turntable capture.

Lamps are stated in the lamp frame of the camera: x right, y up, z from the scene to the camera, origin at the camera's
centre.  `Lighting` is what a capture has; `ViewLamp` is one lamp seen in one view, in the object's own frame, ready for
`nishiki.brdf.texels.model.predict`.

    I_d = K_d cos(theta_i)                              I_s = K_s / cos(theta_r) (1 + alpha^2 / (4 sigma^2))^-2

theta_i, theta_r: angles of the normal with the directions to the lamp and to the camera; alpha: with their bisector.
The model is that of Miyazaki et al. (2007, eq. 6 and 8) with the facets of Trowbridge and Reitz (Average irregularity
representation of a rough surface for ray reflection, J. Opt. Soc. Am. 65, 1975) in place of Gaussian ones, whose lobe
has the same peak and the same curvature there, but no tail.
Under an environment (unknown lighting) an irradiance, a quadratic form of the normal, stands for cos(theta_i).

Limits.  Both terms are 0 where the lamp or (I_s) the camera is behind the surface.  1 / cos(theta_r) is held below
1 / GRAZING: no camera resolves a surface seen more steeply.  sigma = 0 is a mirror (1 at alpha = 0, else 0), sigma =
infinity a lobe without end (1 everywhere).  Parameters and normals that are not finite count as 0.
"""

from dataclasses import dataclass, field

import numpy as np

from nishiki.brdf.slopes import GRAZING
from nishiki.errors import UserError
from nishiki.formats.stored import PlainFields
from nishiki.geometry.camera import Camera

KINDS = ("camera", "direction", "position", "environment", "unknown")
POINT, DISTANT, ENVIRONMENT = 0, 1, 2
HARMONICS = 9  # 1, x, y, z, xy, yz, zx, x^2 - y^2, 3 z^2 - 1
HALF_GLOSS = np.float32(0.15)  # over diffuse light, at which the weight of a view is one half
UNITS_IN_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
TO_LAMP_FRAME = np.diag([1.0, -1.0, -1.0])  # from the camera frame with y down and z into the scene


@dataclass(frozen=True)
class ViewLamp:
    """One lamp in one view, in the object's frame, float32.

    form: POINT, DISTANT or ENVIRONMENT.  vector (3,): the place of a point lamp, the unit direction towards a distant
    one, the unit direction of an environment's highlights (0 0 0: it has none).  rotation (3, 3): object to lamp frame.
    harmonics (9, channels): irradiance of an environment over the normal in the lamp frame.  reference: distance at
    which a point lamp counts 1, farther and nearer by the inverse square; 0: the same at every distance.
    """

    form: int
    vector: np.ndarray
    rotation: np.ndarray
    harmonics: np.ndarray
    reference: float = 0.0


@dataclass(frozen=True)
class CaptureLamps(PlainFields):
    """The lamps of a capture, in the lamp frame."""

    # "camera" (the lamp is at the camera's centre), "direction", "position" (in the world's unit), "environment"
    # (fitted, see `nishiki.brdf.texels.environment`) or "unknown" (nothing can be predicted yet)
    kind: str
    vectors: tuple[tuple[float, ...], ...] = field(default=((0.0, 0.0, 0.0),))  # one row (x, y, z) a light
    harmonics: tuple = field(default=())  # (9, channels) nested tuples a light
    reference: float = 0.0  # as in `ViewLamp`

    def __post_init__(self):
        if self.kind not in KINDS:
            raise UserError(f"lighting: expected one of {', '.join(KINDS)}, found {self.kind!r}")

    @classmethod
    def from_capture(cls, lamp: dict, *, lights: int, unit: str) -> "CaptureLamps":
        """Read a capture's lighting: {"kind", "vectors" (lights, 3) or None}, `unit` of the world's lengths.

        Raises UserError where a direction has no length, a place is given but the world's unit is no length, or the
        number of vectors is not that of the lights.
        """
        kind = lamp["kind"]
        if kind in ("camera", "unknown"):
            return cls(kind, ((0.0, 0.0, 0.0),) * lights)
        vectors = np.asarray(lamp["vectors"], np.float64)
        if vectors.shape != (lights, 3) or not np.isfinite(vectors).all():
            raise UserError(f"lights: expected {lights} finite vectors (one a light), found shape {vectors.shape}")
        if kind == "direction":
            lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
            if np.any(lengths == 0):
                raise UserError(f"lights: the direction of light {int(np.argmin(lengths)) + 1} has no length")
            return cls(kind, _rows(vectors / lengths))
        if unit not in UNITS_IN_MM:
            known = ", ".join(UNITS_IN_MM)
            raise UserError(
                f"lights: places are in mm, but the cameras' unit is {unit!r} (known: {known}). Remedy: state the "
                "unit of the cameras in the capture's turntable block, or give directions."
            )
        return cls("position", _rows(vectors / UNITS_IN_MM[unit]))

    def lamp(self, camera: Camera, light_index: int = 0) -> ViewLamp:
        """Return the lamp `light_index` as it stands when the object is seen from `camera`.

        Raises UserError for unknown lighting (it has to be fitted first) and for a light that is not there.
        """
        if self.kind == "unknown":
            raise UserError("lighting: unknown; fit it first (stage object_brdf), or state the lights in capture.yaml")
        if not 0 <= light_index < len(self.vectors):
            raise UserError(f"light {light_index}: expected 0 to {len(self.vectors) - 1}")
        rotation = TO_LAMP_FRAME @ camera.rotation
        vector = np.asarray(self.vectors[light_index], np.float64)
        harmonics = np.zeros((HARMONICS, 1))
        if self.kind == "environment":
            form, vector, harmonics = ENVIRONMENT, rotation.T @ vector, np.array(self.harmonics[light_index])
        elif self.kind == "direction":
            form, vector = DISTANT, rotation.T @ vector
        else:
            form, vector = POINT, camera.centre + rotation.T @ vector
        vector, rotation, harmonics = (np.ascontiguousarray(a, np.float32) for a in (vector, rotation, harmonics))
        return ViewLamp(form, vector, rotation, harmonics, self.reference)


def _rows(values) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in values)


_GRAZING = np.float32(GRAZING)
_TINY = np.float32(1e-30)
_ZERO, _QUARTER, _HALF, _ONE, _THREE, _FOUR = (np.float32(v) for v in (0, 0.25, 0.5, 1, 3, 4))


def predict(
    kd: np.ndarray,
    ks: np.ndarray,
    sigma: np.ndarray,
    positions: np.ndarray,
    normals: np.ndarray,
    camera_centre: np.ndarray,
    lamp: ViewLamp,
) -> tuple[np.ndarray, np.ndarray]:
    """Predict diffuse and specular radiance of points under one lamp in one camera; both (..., channels) float32.

    kd, ks: (..., channels); sigma: (...), radians >= 0; positions, normals: (..., 3) in the object's frame, normals of
    unit length; camera_centre: (3,).  Linear, relative: 1 is a white diffuser that faces the lamp.  Miyazaki et al.
    (2007), eq. 6, and eq. 8 with `facet_lobe`.
    """
    kd, ks, sigma = (np.asarray(a, np.float32) for a in (kd, ks, sigma))
    irradiance, angles = factors(positions, normals, camera_centre, lamp, kd.shape[-1])
    strength, cos_r, alpha2 = np.moveaxis(angles, -1, 0)
    with np.errstate(all="ignore"):
        lobe = np.where(alpha2 > 0, facet_lobe(alpha2, sigma), _ONE)
        lobe *= strength / np.maximum(cos_r, _GRAZING)
        radiances = kd * irradiance, ks * lobe[..., None]
    diffuse, specular = (np.where(np.isfinite(values), values, _ZERO) for values in radiances)
    return diffuse, specular


def facet_lobe(squared_angle: np.ndarray, sigma: np.ndarray | float) -> np.ndarray:
    """Compute (1 + alpha^2 / (4 sigma^2))^-2 of squared angles; sigma in radians (Trowbridge and Reitz 1975)."""
    return 1 / np.square(1 + squared_angle / (4 * sigma * sigma))


def weigh_lender(diffuse: np.ndarray, gloss: np.ndarray) -> np.ndarray:
    """Compute the weight (n,) float32 of a view's residual, 1 / (1 + (gloss / (HALF_GLOSS diffuse))^2), 0.001 to 1.

    diffuse, gloss (n, channels): of the model in that view. A residual in a highlight is wrong in other views.
    """
    ratio = gloss.sum(axis=-1) / np.maximum(HALF_GLOSS * diffuse.sum(axis=-1), _TINY)
    return 1 / (1 + np.square(np.minimum(ratio, np.float32(30))))


def factors(
    positions: np.ndarray, normals: np.ndarray, camera_centre: np.ndarray, lamp: ViewLamp, channels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the factors of `predict` for a fit: (irradiance (..., channels), angles (..., 3)), float32.

    irradiance: what multiplies K_d.  angles: the distance factor max(0, cos(theta_i) / cos(theta_i)) of the lobe (1, or
    the inverse square of a near lamp; 0: lamp behind), cos(theta_r), and alpha^2.
    """
    places, facing = (np.asarray(a, np.float32).reshape(-1, 3) for a in (positions, normals))
    view, _ = _unit(np.asarray(camera_centre, np.float32) - places)
    towards, strength = lamp.vector, _ONE
    if lamp.form == POINT:
        towards, square = _unit(towards - places)
        strength = np.float32(lamp.reference) ** 2 / square if lamp.reference > 0 else _ONE
    cos_i, cos_r, half = (facing * towards).sum(axis=1), _dot(facing, view), towards + view
    square = _dot(half, half)
    scale = np.where(square > _TINY, _ONE / np.sqrt(np.maximum(square, _TINY)), _ZERO)
    apart = facing - half * scale[:, None]
    sine = _QUARTER * _dot(apart, apart)  # sin(alpha / 2)^2 without cancellation
    angles = np.empty((len(places), 3), np.float32)
    angles[:, 0] = np.where((cos_i > _ZERO) & (cos_r > _ZERO), strength, _ZERO)
    angles[:, 1], angles[:, 2] = cos_r, _FOUR * np.arcsin(np.sqrt(np.fmin(sine, _HALF))) ** 2
    if lamp.form == ENVIRONMENT:
        x, y, z = (facing @ lamp.rotation.T).T
        products = np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, _THREE * z * z - _ONE
        harmonics = lamp.harmonics  # one row serves every channel
        if harmonics.shape[1] != channels:
            harmonics = np.repeat(harmonics.mean(axis=1, keepdims=True), channels, axis=1)
        irradiance = np.fmax(np.stack(products, axis=1) @ harmonics, _ZERO)
    else:
        irradiance = np.repeat(np.fmax(cos_i * strength, _ZERO)[:, None], channels, axis=1)
    return irradiance.reshape(*positions.shape[:-1], channels), angles.reshape(*positions.shape[:-1], 3)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide vectors (n, 3) by their lengths; return the squares of these, too."""
    square = _dot(vectors, vectors) + _TINY
    return vectors / np.sqrt(square)[:, None], square
