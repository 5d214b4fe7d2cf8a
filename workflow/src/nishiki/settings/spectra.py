"""Settings of spectra."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.settings.counts import Bases


class SpectraSettings(Guarded):
    """Spectral reflectance from the camera's response."""

    STAGE: ClassVar[str] = "spectra"
    VERSION: ClassVar[int] = 1

    method: Literal["local", "wiener", "paper"] = Field(
        "local", description="paper: three bases, inverse of H (P eq. 8)"
    )
    bases: Bases = Field(
        "auto", description="number of basis functions; auto: as many as camera and lamp support (docs/economy.md)"
    )
    noise: float = Field(0.005, gt=0, le=1, description="standard deviation of a response, relative to white")
    training: str = Field("synthetic", description="synthetic, or a CSV: wavelength_nm, then one reflectance a column")
    training_sha256: str = Field("", description="digest of the training file; filled in by the plan")
