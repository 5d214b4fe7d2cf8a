"""Provide the common parts of simulated captures: camera settings, the sensor, and the files of a capture."""

import csv
import math
import sys
import time
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.randomness import normals
from nishiki.threads import over_rows


def declare_range(low: float, high: float, default: Any = MISSING) -> Any:
    """Declare a number of some settings with its range, which `check_ranges` reads."""
    return field(default=default, metadata={"range": (low, high)})


def check_ranges(settings: Any, *more: tuple[str, float, float, float], prefix: str = "") -> None:
    """Raise UserError for the first number outside its range: a field of the settings, or (name, value, low, high)."""
    declared = ((f.name, getattr(settings, f.name), *f.metadata["range"]) for f in fields(settings) if f.metadata)
    for name, value, low, high in (*declared, *more):
        if not low <= value <= high:
            raise UserError(
                f"simulation: {prefix}{name} expected {low:g} to {high:g}, found {value!r}; choose a value in that "
                "range"
            )


@dataclass(frozen=True)
class CameraSettings:
    """The camera: sensitivity of the sensor and its noise."""

    channels: int = declare_range(3, 8, 3)  # number of spectral channels, 3 to 8
    bits: int = declare_range(8, 16, 12)  # of the converter
    full_well: float = declare_range(100.0, 1e9, 30000.0)  # electrons at full scale
    read_noise: float = declare_range(0.0, 1e4, 8.0)  # electrons, standard deviation
    black_level: int = 64  # codes
    # fraction of full scale that a perfect white diffuser facing the lamp reaches in the most sensitive channel
    white_level: float = declare_range(0.01, 1.0, 0.7)
    noise: bool = True  # False gives the mean signal (still quantised)

    def __post_init__(self):
        check_ranges(self, ("black_level", self.black_level, 0, 2**self.bits // 4))


def camera_from(options, camera: CameraSettings) -> CameraSettings:
    """Change a camera by the options of the command line."""
    level = camera.white_level if options.white_level is None else options.white_level
    return replace(camera, bits=options.bits, noise=not options.no_noise, white_level=level)


def check_choice(name: str, value: str, choices) -> None:
    """Raise UserError where the value is none of the choices."""
    if value not in choices:
        raise UserError(f"simulation: {name} expected one of {', '.join(choices)}, found {value!r}; choose one")


FINE_NM = np.arange(380.0, 780.5, 2.0)  # finer and wider than the grid on which the chain works

# (peak, centre nm, width below, width above) of each lobe of red, green and blue
_RGB = (
    ((0.95, 602.0, 26.0, 36.0), (0.10, 540.0, 30.0, 26.0), (0.03, 440.0, 20.0, 24.0)),
    ((1.00, 534.0, 32.0, 37.0), (0.05, 468.0, 18.0, 20.0)),
    ((0.86, 456.0, 24.0, 29.0), (0.06, 530.0, 26.0, 30.0)),
)


def channel_names(count: int) -> tuple[str, ...]:
    """Return red, green, blue for three channels, else band1 (long waves) to bandN (short waves)."""
    return ("red", "green", "blue") if count == 3 else tuple(f"band{index + 1}" for index in range(count))


def sensitivities(wavelengths_nm: np.ndarray, channels: int) -> np.ndarray:
    """Compute relative sensitivities (channels, wavelengths), 0..1: invented smooth lobes behind an IR and UV filter.

    Three channels: broad overlapping red, green and blue with small side lobes. More: one bell each, evenly placed
    from 655 to 430 nm.
    """
    w = np.asarray(wavelengths_nm, float)
    cut = 1.0 / (1.0 + np.exp(-(w - 408.0) / 5.0)) / (1.0 + np.exp((w - 672.0) / 7.0))
    if channels == 3:
        return np.array([sum(_lobe(w, *lobe) for lobe in lobes) for lobes in _RGB]) * cut
    centres = np.linspace(655.0, 430.0, channels)
    width = 0.5 * 225.0 / (channels - 1)
    return np.array([_lobe(w, 0.9, centre, width, 1.15 * width) for centre in centres]) * cut


def _lobe(w, peak, centre, below, above):
    return peak * np.exp(-0.5 * ((w - centre) / np.where(w < centre, below, above)) ** 2)


def dark_frame(shape: tuple[int, ...], camera: CameraSettings, *, key: int) -> np.ndarray:
    """Simulate codes (rows, columns, channels) with the lens closed: black level and read noise."""
    return expose(np.zeros(shape, np.float32), camera, key=key)


def expose(signal: np.ndarray, camera: CameraSettings, *, key: int, first_row: int = 0) -> np.ndarray:
    """Simulate codes (rows, columns, channels) uint16 of an exposure; 1.0 in `signal` fills the well and the converter.

    Shot noise is taken as normal (the well holds thousands of electrons; below some ten electrons the read noise
    hides the difference). `first_row` is the row of the image at which this band starts, so that bands join exactly.
    """
    codes, full, each = np.empty(signal.shape, np.uint16), 2**camera.bits - 1, math.prod(signal.shape[1:])

    def fill(start: int, stop: int, signal: np.ndarray) -> None:
        for row in range(start, stop):
            count = np.maximum(signal[row].astype(float), 0.0) * camera.full_well
            if camera.noise:
                # One normal number serves both: shot noise of a large count is normal with that variance.
                places = np.arange((first_row + row) * each, (first_row + row + 1) * each).reshape(count.shape)
                count += np.sqrt(count + camera.read_noise**2) * normals(key, places)
            code = camera.black_level + count / camera.full_well * (full - camera.black_level)
            codes[row] = np.clip(np.floor(code + 0.5), 0, full)

    over_rows(fill, len(codes), np.asarray(signal, np.float32))
    return codes


DARK_FRAMES = 3  # photographs
BOARD_REFLECTANCE = 0.98  # of the white board


class ProgressLine:
    """One line on the terminal that is written over."""

    def __init__(self):
        self.start = time.monotonic()

    def __call__(self, text: str, end: str = "") -> None:
        print(f"\r\033[K{time.monotonic() - self.start:5.1f} s  {text}", end=end, file=sys.stderr, flush=True)


def write_image(path: Path, codes: np.ndarray) -> None:
    """Write a PNG of RGB or grey, or a TIFF with one page a channel."""
    import cv2

    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".png":
        done = cv2.imwrite(str(path), codes[..., ::-1] if codes.ndim > 2 else codes, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    else:
        pages = [np.ascontiguousarray(codes[..., channel]) for channel in range(codes.shape[2])]
        done = cv2.imwritemulti(str(path), pages, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    if not done:
        raise UserError(f"{path}: could not be written; is the disk full?")


def write_csv(path: Path, rows) -> None:
    """Write the rows of a table, its heading first."""
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def write_description(capture: Path, title: str, geometry: str, channels, camera: CameraSettings, **blocks) -> None:
    """Write capture.yaml. blocks : the blocks after the camera; `sensitivities`, if given, belongs to the camera."""
    import yaml

    described = {
        "model": "simulated camera",
        "channels": list(channels),
        "encoding": "linear",
        "bits": camera.bits,
        "saturation": 0.98,
        "black_level": camera.black_level,
    }
    if "sensitivities" in blocks:
        described["sensitivities"] = blocks.pop("sensitivities")
    values = {"format": 1, "title": title, "geometry": geometry, "camera": described, **blocks}
    (capture / "capture.yaml").write_text(yaml.safe_dump(values, sort_keys=False))


def readme(kind: str, **facts: Any) -> str:
    """Return the README of a truth folder, by the template of a kind of capture."""
    return (Path(__file__).parent / kind / "truth.md").read_text(encoding="utf-8").format(**facts)


class TruthWriter:
    """truth.zarr, filled shot by shot, and a README of its contents."""

    def __init__(self, folder: Path):
        import zarr

        self.folder = folder
        self.group: Any = zarr.open_group(folder / "truth.zarr", mode="w", zarr_format=3)

    def make(self, name: str, shape, dtype):
        """Create an array to be filled, a chunk each first index and 256 rows."""
        chunks = (1, min(256, shape[1]), *shape[2:])
        return self.group.create_array(name, shape=shape, dtype=dtype, chunks=chunks)

    def put(self, name: str, values: np.ndarray) -> None:
        """Store a whole array."""
        chunks = (min(256, values.shape[0]), *values.shape[1:])
        self.group.create_array(name, shape=values.shape, dtype=values.dtype, chunks=chunks)[...] = values

    def finish(self, attributes: dict, readme: str) -> None:
        """Write the attributes of the group, and the README."""
        self.group.attrs.update(attributes)
        (self.folder / "README.md").write_text(readme)
