"""Sensitivities recovered from one colour target: how far they are off, and what that costs in colour.

    python benchmarks/camera_sensitivities.py --data FOLDER_OF_MEASURED_DATA

A ColorChecker Classic is seen by cameras with measured sensitivities: the 28 from which the method's components were
made (Jiang et al. 2013), and two measured by the National Physical Laboratory that it never saw. Each patch has the
noise of the mean of 400 pixels at 1 % of the white patch. One JSON line a camera and lamp: root mean square error of
the curves, each at 1; what they leave of patches left out in turn, relative to white; mean CIEDE2000 of the colours of
1,269 Munsell chips under the lamp, of spectra estimated with the true curves, with the recovered ones, and with those
of another camera (the mean of the 28), as a user without any would take.
"""

import argparse
import json
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "scripts"), str(Path(__file__).parent)]
from spectra import read_cameras, read_reflectances  # noqa: E402

from nishiki.calibrate.target import chart_reflectances, recover  # noqa: E402
from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_from_spectra, xyz_to_lab  # noqa: E402
from nishiki.colour.estimate import estimate_spectra, fit_estimator  # noqa: E402
from nishiki.colour.sampling import (  # noqa: E402
    WAVELENGTHS_NM,
    channel_weights,
)
from nishiki.colour.training import synthetic_reflectances  # noqa: E402

NOISE = 0.01 / 20


def unseen() -> dict[str, np.ndarray]:
    """Sensitivities (3, 61) of the two cameras that the method never saw."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    names = "Nikon 5100 (NPL)", "Sigma SDMerill (NPL)"
    tables = {name: colour.MSDS_CAMERA_SENSITIVITIES[name] for name in names}
    return {
        name: np.maximum([np.interp(WAVELENGTHS_NM, table.wavelengths, curve) for curve in table.values.T], 0)
        for name, table in tables.items()
    }


def colour_error(camera: np.ndarray, believed: np.ndarray, lamp: np.ndarray, chips: np.ndarray) -> float:
    """Mean CIEDE2000 of chips (n, 61) seen by one camera and estimated with the curves of another."""
    estimator = fit_estimator(synthetic_reflectances(), lamp, believed)
    spectra = estimate_spectra(chips @ channel_weights(lamp, camera).T, estimator).spectra()
    white = white_xyz(lamp)
    labs = (xyz_to_lab(xyz_from_spectra(lamp, each), white) for each in (spectra, chips))
    return float(delta_e_2000(*labs).mean())


def main() -> None:
    """Arguments in, lines out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--unseen", action="store_true", help="only the two cameras that the method never saw")
    arguments = parser.parse_args()
    folder = arguments.data / "spectra"
    known, chips = read_cameras(folder), next(iter(read_reflectances(folder).values()))
    names, reflectances = chart_reflectances()
    usual = np.mean([camera / camera.max(axis=1, keepdims=True) for camera in known.values()], axis=0)
    random = np.random.default_rng(0)
    cameras = [] if arguments.unseen else [(name, "known", curves) for name, curves in known.items()]
    cameras += [(name, "unseen", curves) for name, curves in unseen().items()]
    for name, use, curves in cameras:
        for lamp_name in ("D65", "A", "FL11"):
            lamp = illuminant(lamp_name)
            seen = 0.9 * reflectances @ channel_weights(lamp, curves).T
            seen = seen + NOISE * random.standard_normal(seen.shape)
            recovered = recover(seen, lamp, reflectances, np.ones(len(names), bool))
            true = curves / curves.max(axis=1, keepdims=True)
            line = {
                "camera": name,
                "use": use,
                "lamp": lamp_name,
                "rmse": float(np.sqrt(np.mean((recovered.curves - true) ** 2))),
                "left_out": recovered.left_out,
                "de00_true": colour_error(curves, curves, lamp, chips),
                "de00_recovered": colour_error(curves, recovered.curves, lamp, chips),
                "de00_mean_camera": colour_error(curves, usual, lamp, chips),
            }
            print(json.dumps({key: round(v, 4) if isinstance(v, float) else v for key, v in line.items()}), flush=True)


if __name__ == "__main__":
    main()
