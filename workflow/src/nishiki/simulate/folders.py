"""Files of simulated captures: pictures, tables, the truth; and one line of progress on the terminal."""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.settings import CameraSettings

DARK_FRAMES = 3


class Progress:
    """One line on the terminal that is written over."""

    def __init__(self):
        self.start = time.monotonic()

    def __call__(self, text: str, end: str = "") -> None:
        print(f"\r\033[K{time.monotonic() - self.start:5.1f} s  {text}", end=end, file=sys.stderr, flush=True)


def write_image(path: Path, codes: np.ndarray) -> None:
    """PNG of RGB or grey, or TIFF with one page a channel."""
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
    """Rows of a table, its heading first."""
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def write_description(capture: Path, title: str, geometry: str, channels, camera: CameraSettings, **blocks) -> None:
    """capture.yaml. blocks : what follows the camera; `sensitivities`, if given, belongs to the camera."""
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


class Truth:
    """truth.zarr, filled shot by shot, and a README that says what is in it."""

    def __init__(self, folder: Path):
        import zarr

        self.folder = folder
        self.group = zarr.open_group(folder / "truth.zarr", mode="w", zarr_format=3)

    def make(self, name: str, shape, dtype):
        """An array to be filled, a chunk each first index and 256 rows."""
        chunks = (1, min(256, shape[1]), *shape[2:])
        return self.group.create_array(name, shape=shape, dtype=dtype, chunks=chunks)

    def put(self, name: str, values: np.ndarray) -> None:
        """A whole array."""
        chunks = (min(256, values.shape[0]), *values.shape[1:])
        self.group.create_array(name, shape=values.shape, dtype=values.dtype, chunks=chunks)[...] = values

    def finish(self, attributes: dict, readme: str) -> None:
        """Attributes of the group, and the README."""
        self.group.attrs.update(attributes)
        (self.folder / "README.md").write_text(readme)
