"""What all simulated captures have in common: the camera, and how settings are checked."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nishiki.errors import UserError


@dataclass(frozen=True)
class CameraSettings:
    """The camera: sensitivity of the sensor and its noise.

    channels : number of spectral channels, 3 to 8. bits : of the converter. full_well : electrons at full scale.
    read_noise : electrons, standard deviation. black_level : codes. white_level : fraction of full scale that a
    perfect white diffuser facing the lamp reaches in the most sensitive channel. noise : False gives the mean signal
    (still quantised).
    """

    channels: int = 3
    bits: int = 12
    full_well: float = 30000.0
    read_noise: float = 8.0
    black_level: int = 64
    white_level: float = 0.7
    noise: bool = True

    def ranges(self, *, channels: tuple[int, int]) -> list[tuple]:
        """Rows of `check_ranges`; channels: least and largest number."""
        return [
            ("channels", self.channels, *channels),
            ("bits", self.bits, 8, 16),
            ("full_well", self.full_well, 100.0, 1e9),
            ("read_noise", self.read_noise, 0.0, 1e4),
            ("black_level", self.black_level, 0, 2**self.bits // 4),
            ("white_level", self.white_level, 0.01, 1.0),
        ]


def camera_from(options, camera: CameraSettings) -> CameraSettings:
    """A camera with what the command line asks for."""
    level = camera.white_level if options.white_level is None else options.white_level
    return replace(camera, bits=options.bits, noise=not options.no_noise, white_level=level)


def check_ranges(rows) -> None:
    """Raise UserError for the first row (name, value, low, high) whose value is outside its range."""
    for name, value, low, high in rows:
        if not low <= value <= high:
            raise UserError(
                f"simulation: {name} expected {low:g} to {high:g}, found {value!r}; choose a value in that range"
            )


def check_choice(name: str, value: str, choices) -> None:
    """Raise UserError where the value is none of the choices."""
    if value not in choices:
        raise UserError(f"simulation: {name} expected one of {', '.join(choices)}, found {value!r}; choose one")
