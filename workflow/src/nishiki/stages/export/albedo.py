"""The diffuse colour under D50 as 16-bit TIFF in a wide RGB space, with its ICC profile."""

from collections.abc import Iterator

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.icc import ROMM, icc_profile
from nishiki.formats.tiff_bands import write_tiff
from nishiki.stages.export.normals import software, stamped
from nishiki.stages.export.scene import ExportedScene


def write(context: Context, scene: ExportedScene) -> dict:
    """`albedo.tif`; the share of its samples that are outside of the space."""
    matrix, how = scene.to_xyz_d50()
    matrix = np.linalg.inv(ROMM.to_xyz()) @ matrix
    description = (
        f"Diffuse colour of the surface under D50, relative to a perfect white diffuser, without shading and gloss; "
        f"0, 0, 0 where there is no estimate. {ROMM.name}, from {how}. {stamped(context)}"
    )
    clipped = count = 0

    def bands() -> Iterator[np.ndarray]:
        nonlocal clipped, count
        for rows in scene.bands():
            known = scene.known(rows)[..., None]
            linear = np.where(known, np.nan_to_num(scene.coefficients(rows)) @ matrix.T, 0)
            clipped += int(np.count_nonzero((linear < 0) | (linear > 1)))
            count += 3 * int(np.count_nonzero(known))
            yield np.floor(65535 * np.clip(linear, 0, 1) ** (1 / ROMM.gamma) + 0.5).astype(np.uint16)

    write_tiff(
        context.output.path("exports/albedo.tif"),
        bands(),
        (*scene.shape, 3),
        description=description,
        software=software(context),
        pitch_mm=scene.pitch_mm,
        icc=icc_profile(ROMM),
    )
    return {"files": ["exports/albedo.tif"], "clipped": clipped / max(count, 1), "colour_from": how}
