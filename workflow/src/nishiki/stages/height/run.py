"""Height: integrate the normals into a relief, and tell how far the normals are likely to be off."""

import numpy as np

from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.artifacts.stage import Context
from nishiki.photometric import flags as bits
from nishiki.photometric.expected_error import UNKNOWN, expected_error
from nishiki.photometric.height import flatten_normals, integrate_normals


def run(context: Context) -> dict:
    """Integrate the whole field: a global problem, held in memory at once."""
    maps = Maps(context.inputs["normals"].folder)
    normals = maps.read("normals")
    valid = (maps.read("flags") & bits.NO_ESTIMATE) == 0
    pitch = maps.group.attrs.get("pixel_pitch_mm")
    out = MapWriter(
        context.output.folder, rows=normals.shape[0], columns=normals.shape[1], band_rows=256, stamp=context.stamp
    )
    of_relief, turned = normals, 0.0
    if context.settings.flatten:
        of_relief, turned = flatten_normals(normals, valid)
        out.write("normals", of_relief, unit="unit vector, flattened; 0 where there is no estimate")
    field = integrate_normals(of_relief, valid=valid, pixel_pitch=pitch or 1.0, method=context.settings.method)
    del of_relief
    out.write(
        "height",
        field.height.astype(np.float32),
        unit="mm" if pitch else "pixels",
        nan="not integrated: outside the mask, or no estimate of the normal",
    )
    diagnostics = {**field.diagnostics, "flattened_deg": float(np.degrees(turned))}
    del field
    sigma, correction = maps.read("sigma"), maps.read("correction_sigma") if "correction_sigma" in maps else None
    if correction is not None:
        sigma = np.sqrt(np.maximum(sigma**2 - correction**2, 0))
    error = expected_error(normals, sigma, valid)
    if correction is not None:
        error = np.minimum(np.hypot(error, correction), UNKNOWN)
    out.write("expected_error", error, unit="radians, rms angle of the normal; pi / 2 where there is no estimate")
    thinned = error[valid][:: max(1, int(valid.sum()) // 100_000)]
    middle, high = np.degrees(np.percentile(thinned, [50, 95]))
    expected = {"expected_error_median_deg": float(middle), "expected_error_p95_deg": float(high)}
    return {"unit": "mm" if pitch else "pixels", **diagnostics, **expected}
