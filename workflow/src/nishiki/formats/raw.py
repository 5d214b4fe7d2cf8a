"""Camera raw through LibRaw: linear, the camera's own colours, no white balance, no gamma, 16 bits."""

from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np

from nishiki.formats.coding import Coding
from nishiki.formats.exif import exif_of
from nishiki.formats.picture_files import ImageHeader, Output, Picture, Wanted
from nishiki.formats.problems import CaptureError, error
from nishiki.installation import install_command


def open_raw(file: BinaryIO, name: str) -> Picture:
    """Open a camera's raw file: three channels, or one of a sensor without colour filters."""
    try:
        import rawpy
    except ImportError as e:
        remedy = f"Install it with {install_command(('rawpy',))}, or develop to 16-bit linear TIFF first"
        raise CaptureError(error("raw-support", name, "camera raw needs the package rawpy", remedy=remedy)) from e
    exif = exif_of(file)
    file.seek(0)
    try:
        with rawpy.imread(file) as raw:
            sizes, channels, other = raw.sizes, 1 if raw.num_colors == 1 else 3, raw.other
    except Exception as e:  # LibRaw's own errors, and what its binding makes of a file that is none
        remedy = "Copy the file again from the camera, or develop it to 16-bit linear TIFF with its own program"
        found = e.args[0].decode() if e.args and isinstance(e.args[0], bytes) else str(e)
        raise CaptureError(
            error("image-unreadable", name, "camera raw cannot be read", found=found, remedy=remedy)
        ) from e
    if exif.exposure_s is None and other is not None:  # raw files that are no TIFF
        exif = replace(exif, exposure_s=other.shutter_speed or None, f_number=other.aperture or None,
                       iso=other.iso_speed or None)  # fmt: skip
    stored = 2 * sizes.raw_height * sizes.raw_width
    header = ImageHeader(
        "raw", sizes.height, sizes.width, channels, "uint16", stored_bytes=stored,
        coding=Coding("linear, camera raw"), exif=exif,
    )  # fmt: skip
    return Picture(header, lambda wanted, output: _develop(rawpy, file, wanted, output))


def _develop(rawpy: Any, file: BinaryIO, wanted: Wanted, output: Output) -> np.ndarray:
    """Developed picture (rows, columns, channels) uint16, 65535 at the sensor's white level, black level subtracted.

    Bilinear demosaicing: it is the same linear filter in every frame, so ratios between lights, on which photometric
    stereo rests, are not disturbed as they are by methods that follow edges. The white level is the camera's and not
    that of the brightest pixel (LibRaw's default), which would scale each frame differently.
    """
    file.seek(0)
    with rawpy.imread(file) as raw:
        developed = raw.postprocess(
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
    out = output(developed.shape, "uint16")
    out[...] = developed
    return out
