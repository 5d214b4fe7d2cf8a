"""Height: integrate the normals into a relief, and tell how far the normals are likely to be off."""

import numpy as np

from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.artifacts.stage import Context
from nishiki.photometric.expected_error import REACH, UNKNOWN, expected_error
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.photometric.height import HeightSample, band_rows, flatten_normals, integrate_bands
from nishiki.photometric.multigrid import windows
from nishiki.stages.height import OUTPUTS

SAMPLED = 100_000  # pixels of the percentiles


def run(context: Context) -> dict:
    """Integrate the whole field by bands of rows."""
    maps = Maps(context.inputs["normals"].folder)
    shape, pitch = tuple(maps.group["flags"].shape), maps.group.attrs.get("pixel_pitch_mm")
    step = band_rows(shape[1])
    out = MapWriter.of(context, OUTPUTS, (shape[0], shape[1]), step)

    def read(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        return maps.read("normals", rows), (maps.read("flags", rows) & NO_ESTIMATE) == 0

    read_relief, turned = read, 0.0
    if context.settings.flatten:
        flat = out.create("normals", (3,))
        turned = flatten_normals(shape, read, flat.__setitem__)

        def read_relief(rows: slice) -> tuple[np.ndarray, np.ndarray]:
            return flat[rows], read(rows)[1]

    height = out.create(
        "height", unit="mm" if pitch else "pixels", nan="not integrated: outside the mask, or no estimate of the normal"
    )
    diagnostics = integrate_bands(
        shape,
        read_relief,
        lambda rows, values, valid: height.__setitem__(rows, values),
        pixel_pitch=pitch or 1.0,
        method=context.settings.method,
        folder=context.output.folder,
    )
    errors = out.create("expected_error")
    sample = HeightSample(diagnostics["valid_pixels"], SAMPLED)
    for band in windows(shape[0], step, REACH):
        (normals, valid), sigma = read(band.read), maps.read("sigma", band.read)
        if "correction_sigma" in maps:
            correction = maps.read("correction_sigma", band.read)
            error = expected_error(normals, np.sqrt(np.maximum(sigma**2 - correction**2, 0)), valid)
            error = np.minimum(np.hypot(error, correction), UNKNOWN)[band.inner]
        else:
            error = expected_error(normals, sigma, valid)[band.inner]
        errors[band.core] = error
        sample.add(error, valid[band.inner], band.core.start)
    middle, high = np.degrees(np.percentile(sample.chosen()[2], [50, 95]))
    expected = {"expected_error_median_deg": float(middle), "expected_error_p95_deg": float(high)}
    return {"unit": "mm" if pitch else "pixels", **diagnostics, "flattened_deg": float(np.degrees(turned)), **expected}
