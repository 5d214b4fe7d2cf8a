"""What a crate says of one digitisation in the vocabularies of museums: who, what, when, how, as far as it is known."""

from dataclasses import dataclass
from datetime import date as Date
from datetime import datetime
from typing import Any

from nishiki.archive.crate_stages import PackedStage
from nishiki.capture.schema_base import Session

TECHNIQUES = {
    "plane": "photographs of one view under several lamps in turn",
    "turntable": "photographs from several sides, or under several states of a polariser",
    "goniometer": "measurement of reflectance under many directions of light and view",
}
"""How a capture of each geometry is made, in words."""


def capture_method(described: Session) -> dict[str, Any]:
    """How a capture was made, as its capture.yaml says: `geometry`, `camera`, `pixel_pitch_mm`."""
    scaled = getattr(described, "goniometer", described)
    return {
        "geometry": getattr(described, "geometry", None),
        "camera": described.camera.model,
        "pixel_pitch_mm": getattr(scaled, "pixel_pitch_mm", None),
    }


@dataclass(frozen=True)
class Digitisation:
    """One digitised scene.

    Attributes
    ----------
    scene, version : str
        Name of the scene; version of this program.
    digest : str
        SHA-256 of the seal of the capture.
    about : dict
        What capture.yaml says under the keys of `ABOUT`; None or empty where nothing is said.
    method : dict
        `geometry`, `camera` (its model) and `pixel_pitch_mm` of capture.yaml; None where nothing is said.
    stages : list of PackedStage
        In the order of the flow.
    """

    scene: str
    version: str
    digest: str
    about: dict[str, str | None]
    method: dict[str, Any]
    stages: list[PackedStage]

    def said(self, key: str) -> str:
        """What capture.yaml says under a key of `about`; empty where it says nothing."""
        return self.about.get(key) or ""

    @property
    def technique(self) -> str:
        """How the photographs were taken, in words; empty where the geometry is unknown."""
        return TECHNIQUES.get(self.method.get("geometry", ""), "")

    @property
    def camera(self) -> str:
        """Model of the camera; empty where nothing is said."""
        return self.method.get("camera") or ""

    @property
    def scale(self) -> str:
        """Distance of two pixels on the object, in words; empty where nothing is said."""
        pitch = self.method.get("pixel_pitch_mm")
        return f"a pixel is {pitch:g} mm on the object" if pitch else ""


def days_of(text: str) -> tuple[str, str] | None:
    """First and last moment of an ISO 8601 date, or of a date with time; None for any other text.

    Examples
    --------
    >>> days_of("2026-01-31")
    ('2026-01-31T00:00:00', '2026-01-31T23:59:59')
    >>> days_of("2026-01-31, in two sessions") is None
    True
    """
    try:
        day = Date.fromisoformat(text)
    except ValueError:
        pass
    else:
        return f"{day.isoformat()}T00:00:00", f"{day.isoformat()}T23:59:59"
    try:
        moment = datetime.fromisoformat(text).isoformat()
    except ValueError:
        return None
    return moment, moment
