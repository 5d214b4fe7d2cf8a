"""The lamps of a turntable capture: fixed to the camera, while the object turns (seen from the object, they go round).

Lamps are stated in the lamp frame of the camera: x right, y up, z from the scene to the camera, origin at the camera's
centre.  `Lighting` is what a capture has; `Lamp` is one lamp seen in one view, in the object's own frame, ready for
`nishiki.brdf.texels.model.predict`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera

KINDS = ("camera", "direction", "position", "environment", "unknown")
POINT, DISTANT, ENVIRONMENT = 0, 1, 2
HARMONICS = 9  # 1, x, y, z, xy, yz, zx, x^2 - y^2, 3 z^2 - 1
UNITS_IN_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
TO_LAMP_FRAME = np.diag([1.0, -1.0, -1.0])  # from the camera frame with y down and z into the scene


@dataclass(frozen=True)
class Lamp:
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
class Lighting:
    """The lamps of a capture, in the lamp frame.

    kind: "camera" (the lamp is at the camera's centre), "direction", "position" (in the world's unit), "environment"
    (fitted, see `nishiki.brdf.texels.environment`) or "unknown" (nothing can be predicted yet).  vectors: one row
    (x, y, z) a light; harmonics: (9, channels) nested tuples a light; reference: as in `Lamp`.
    """

    kind: str
    vectors: tuple[tuple[float, ...], ...] = field(default=((0.0, 0.0, 0.0),))
    harmonics: tuple = field(default=())
    reference: float = 0.0

    def __post_init__(self):
        if self.kind not in KINDS:
            raise UserError(f"lighting: expected one of {', '.join(KINDS)}, found {self.kind!r}")

    @classmethod
    def from_capture(cls, lamp: dict, *, lights: int, unit: str) -> Lighting:
        """Lighting as a capture declares it: {"kind", "vectors" (lights, 3) or None}, `unit` of the world's lengths.

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

    def as_dict(self) -> dict:
        """Plain data, for JSON."""
        return {
            "kind": self.kind,
            "vectors": [list(row) for row in self.vectors],
            "harmonics": [[list(row) for row in light] for light in self.harmonics],
            "reference": self.reference,
        }

    @classmethod
    def from_dict(cls, values: dict) -> Lighting:
        """Inverse of `as_dict`."""
        harmonics = tuple(_rows(light) for light in values["harmonics"])
        return cls(values["kind"], _rows(values["vectors"]), harmonics, float(values["reference"]))

    def lamp(self, camera: Camera, light_index: int = 0) -> Lamp:
        """The lamp `light_index` as it stands when the object is seen from `camera`.

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
        arrays = (np.ascontiguousarray(a, np.float32) for a in (vector, rotation, harmonics))
        return Lamp(form, *arrays, self.reference)


def _rows(values) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in values)
