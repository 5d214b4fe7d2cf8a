"""Camera raw through LibRaw: linear, the camera's own colours, no white balance, no gamma, 16 bits."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np

from nishiki.formats.image_header import ImageHeader
from nishiki.formats.problems import CaptureError, error
from nishiki.packages import install_command


def _rawpy(name: str) -> ModuleType:
    try:
        import rawpy
    except ImportError as e:
        remedy = f"Install it with {install_command(('rawpy',))}, or develop to 16-bit linear TIFF first"
        raise CaptureError(error("raw-support", name, "camera raw needs the package rawpy", remedy=remedy)) from e
    return rawpy


def read_raw_header(path: Path, name: str) -> ImageHeader:
    """Size of the developed picture; pixels are not unpacked."""
    rawpy = _rawpy(name)
    try:
        with rawpy.imread(str(path)) as raw:
            sizes = raw.sizes
            stored = 2 * sizes.raw_height * sizes.raw_width
            return ImageHeader("raw", sizes.height, sizes.width, 3, "uint16", stored_bytes=stored)
    except Exception as e:  # LibRaw's own errors, and what its binding makes of a file that is none
        raise CaptureError(error("image-unreadable", name, "camera raw cannot be read", found=str(e))) from e


def read_raw(path: Path, name: str) -> np.ndarray:
    """Developed picture (rows, columns, 3) uint16, 65535 at the sensor's white level, black level subtracted.

    Bilinear demosaicing: it is the same linear filter in every frame, so ratios between lights, on which photometric
    stereo rests, are not disturbed as they are by methods that follow edges. The white level is the camera's and not
    that of the brightest pixel (LibRaw's default), which would scale each frame differently.
    """
    rawpy = _rawpy(name)
    try:
        with rawpy.imread(str(path)) as raw:
            return raw.postprocess(
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                use_camera_wb=False,
                use_auto_wb=False,
                user_wb=[1.0, 1.0, 1.0, 1.0],
                user_flip=0,
            )
    except Exception as e:
        raise CaptureError(error("image-truncated", name, "camera raw cannot be developed", found=str(e))) from e
