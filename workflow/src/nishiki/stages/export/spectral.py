"""Reflectance spectra of every pixel as spectral EXR (Fichet and others, 2021) and as ENVI."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.errors import UserError
from nishiki.formats.envi import EnviWriter
from nishiki.formats.exr_bands import ExrWriter
from nishiki.formats.tiff_bands import strips
from nishiki.stages.export.normals import stamped
from nishiki.stages.export.scene import ExportedScene

REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ROWS_AT_A_TIME = 32


def channel(wavelength_nm: float) -> str:
    """Name of a band of a reflective picture: T, the wavelength with a decimal comma, its unit."""
    return f"T.{wavelength_nm:.6f}".replace(".", ",").replace("T,", "T.", 1) + "nm"


def write(context: Context, scene: ExportedScene) -> dict:
    """`spectra.exr`, and `spectra.img` with its `spectra.hdr`."""
    basis = scene.basis
    if basis is None:
        raise UserError(
            "export: spectral needs spectra, which this scene has none of. Remedy: give the capture spectra of camera "
            "and lamp, or leave spectral out of export.formats"
        )
    to_rgb = scene.to_srgb().T
    path = context.output.path
    names = [channel(float(wavelength)) for wavelength in WAVELENGTHS_NM]
    header = {
        "spectralLayoutVersion": "1.0",
        "chromaticities": REC_709,
        "comments": "Reflectance relative to a perfect white diffuser; R, G, B: the same under D65 for looking",
        **{f"nishiki.{name}": text for name, text in context.stamp.items()},
    }
    outside = count = 0
    with (
        ExrWriter(path("exports/spectra.exr"), [*names, "R", "G", "B"], *scene.shape, header) as exr,
        EnviWriter(
            path("exports/spectra.img"),
            scene.shape,
            WAVELENGTHS_NM,
            description=f"Reflectance relative to a perfect white diffuser, 0: no estimate. {stamped(context)}",
            pitch_mm=scene.pitch_mm,
        ) as envi,
    ):
        for rows in strips(scene.shape[0], ROWS_AT_A_TIME):
            known = scene.known(rows)[..., None]
            coefficients = np.where(known, np.nan_to_num(scene.coefficients(rows)), 0)
            spectra = (coefficients @ basis).astype(np.float32)
            exr.write(np.concatenate([spectra, coefficients @ to_rgb], axis=-1))
            envi.write(spectra)
            outside += int(np.count_nonzero((spectra < 0) | (spectra > 1)))
            count += spectra.shape[-1] * int(np.count_nonzero(known))
    return {
        "files": ["exports/spectra.exr", "exports/spectra.img", "exports/spectra.hdr"],
        "outside": outside / max(count, 1),
    }
