"""Separation by polarisers: errors of both parts with and without smoothing, and what peers reach.

    python benchmarks/path_traced_polarisers.py PARTS          path-traced parts, known exactly
    python benchmarks/polarisation.py PARTS [--objects NAME ...] [--views 3]

Photographs are made from the path-traced parts by a sensor of this file's own: Poisson electrons, normal read noise,
rounding to 8, 12 or 16 bits, linear or sRGB-coded. One JSON object a line: {object, kind, layout, sensor, method,
diffuse_percent, specular_percent, cpu_s, of_plain_diffuse, of_plain_specular}. A part's error is the root mean square
over all pixels that the object covers wholly and that no state saturates, over views and channels, in per cent of the
part's true mean there; cpu_s is that of one view. Peers smooth the specular part of the formulas, each with the noise
that Nishiki measured and the strength that served it best on the tuned objects; the estimates of the diffuse part are
mixed with Nishiki's weights.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "scripts"), str(Path(__file__).parent)]
from path_traced_polarisers import OBJECTS  # noqa: E402

import _project  # noqa: E402, F401

BETA = np.array([0.395, 0.412, 0.371], np.float32)
READ_NOISE = 5.0  # electrons
SENSORS = {  # electrons at full scale, bits, encoding
    "5000 electrons, 12 bit": (5_000, 12, "linear"),
    "20000 electrons, 12 bit": (20_000, 12, "linear"),
    "60000 electrons, 12 bit": (60_000, 12, "linear"),
    "60000 electrons, 8 bit": (60_000, 8, "linear"),
    "60000 electrons, 8 bit sRGB": (60_000, 8, "srgb"),
    "1000000 electrons, 16 bit": (1_000_000, 16, "linear"),
    "no noise": (None, None, "linear"),
}
LAYOUTS = {
    "circular": ("off", "on"),
    "crossed": ("0", "90"),
    "four angles": ("0", "45", "90", "135"),
    "two pairs": ("0/0", "0/90", "45/45", "45/135"),
    "nine states": tuple(f"{g}/{a}" for g in (0, 60, 120) for a in (20, 80, 140)),
}


def seen(diffuse, specular, state: str) -> np.ndarray:
    """What the camera sees without noise, full scale 1."""
    if state in ("off", "on"):
        return diffuse + specular if state == "off" else BETA * diffuse
    *generator, analyser = map(float, state.split("/"))
    return specular * np.cos(np.radians(analyser - (generator[0] if generator else 0.0))) ** 2 + diffuse / 2


def photograph(light, sensor, random) -> tuple[np.ndarray, np.ndarray]:
    """Linear values float32 and where they are not saturated (rows, columns)."""
    electrons, bits, encoding = SENSORS[sensor]
    if electrons is None:
        return light.astype(np.float32), np.ones(light.shape[:2], bool)
    values = (random.poisson(light * electrons) + random.normal(0, READ_NOISE, light.shape)) / electrons
    full = 2**bits - 1
    if encoding == "srgb":
        values = np.maximum(values, 0)
        values = np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)
    codes = np.clip(np.round(values * full), 0, full) / full
    good = (codes < 1).all(axis=-1)
    if encoding == "srgb":
        codes = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    return codes.astype(np.float32), good


def non_local_means(specular, sigma):
    """scikit-image, fast mode, with the noise given."""
    from skimage.restoration import denoise_nl_means

    return denoise_nl_means(
        specular, patch_size=5, patch_distance=6, h=0.8 * sigma, sigma=sigma, fast_mode=True, channel_axis=-1
    )


def bilateral(specular, sigma):
    """OpenCV: five standard deviations of the noise in each of three channels."""
    import cv2

    return cv2.bilateralFilter(specular, 9, 5 * sigma * np.sqrt(3), 2.5)


def guided(specular, sigma):
    """OpenCV's guided filter with the mean of the channels as its guide."""
    import cv2

    guide = specular.mean(axis=-1)
    return cv2.ximgproc.guidedFilter(guide, specular, 4, float(4 * sigma**2))


PEERS = {
    "non-local means (scikit-image)": non_local_means,
    "bilateral (OpenCV)": bilateral,
    "guided filter (OpenCV)": guided,
}


def methods(planes, valid, sums, rest, inside) -> dict:
    """Name: (diffuse, specular, processor seconds) of one view; inside: where the peers' noise is averaged."""
    from nishiki.polarisation.polarisation import components
    from nishiki.polarisation.smoothing import smooth_planes

    start = time.process_time()
    plain = components(planes, valid, sums, **rest)
    results = {"plain": (plain.diffuse, plain.specular, time.process_time() - start)}
    start = time.process_time()
    smoothed = smooth_planes(planes, valid, sums, **rest)
    noise, view = smoothed.noise, components(smoothed.planes, valid, sums, **rest)
    results["smoothed"] = (view.diffuse, view.specular, time.process_time() - start)
    if sums.method != "circular" or noise is None or not noise.positive:
        return results
    lit = np.maximum(planes, 0)
    off, on = (noise.slope * lit[k] + noise.floor for k in (0, 1))
    on = on / BETA**2
    sigma = float(np.sqrt((off + on)[inside].mean()))
    for name, peer in PEERS.items():
        start = time.process_time()
        specular = np.asarray(peer(plain.specular, sigma), np.float32)
        diffuse = plain.diffuse + on / np.maximum(off + on, 1e-30) * (plain.specular - specular)
        results[name] = (diffuse, specular, time.process_time() - start)
    return results


def rows_of(folder: Path, name: str, layout: str, sensor: str, views: int):
    """Lines of one object, layout and sensor."""
    from nishiki.polarisation.polarisation import sum_planes
    from nishiki.polarisation.polariser_states import sums_of

    sums = sums_of(LAYOUTS[layout])
    rest = {"beta": BETA} if layout == "circular" else {}
    tallies, means, count = {}, np.zeros(2), 0
    with np.load(folder / f"{name}.npz") as parts:
        truth = [(parts["diffuse"][v], parts["specular"][v], parts["cover"][v]) for v in range(views)]
    for view, (diffuse, specular, cover) in enumerate(truth):
        random = np.random.default_rng(view)
        photographs = [photograph(seen(diffuse, specular, state), sensor, random) for state in sums.states]
        planes, valid = sum_planes(photographs, sums.weights)
        inside = (cover > 0.999) & valid
        count += inside.sum() * 3
        means += [part[inside].sum(dtype=np.float64) for part in (diffuse, specular)]
        for method, (*parts, seconds) in methods(planes, valid, sums, rest, inside).items():
            squares = [
                np.sum((part - true)[inside].astype(np.float64) ** 2)
                for part, true in zip(parts, (diffuse, specular), strict=True)
            ]
            tallies[method] = tallies.get(method, 0) + np.array([*squares, seconds])
    errors = {m: 100 * np.sqrt(tally[:2] / count) / (means / count) for m, tally in tallies.items()}
    for method, tally in tallies.items():
        of_plain = errors[method] / np.maximum(errors["plain"], 1e-12)
        yield {
            "object": name,
            "kind": OBJECTS[name][0],
            "layout": layout,
            "sensor": sensor,
            "method": method,
            "diffuse_percent": float(f"{errors[method][0]:.4g}"),
            "specular_percent": float(f"{errors[method][1]:.4g}"),
            "cpu_s": round(tally[2] / views, 3),
            "of_plain_diffuse": round(float(of_plain[0]), 3),
            "of_plain_specular": round(float(of_plain[1]), 3),
        }


def main() -> None:
    """Arguments in, lines out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=list(SENSORS))
    parser.add_argument("--layouts", nargs="+", default=list(LAYOUTS), choices=list(LAYOUTS))
    parser.add_argument("--views", type=int, default=3)
    arguments = parser.parse_args()
    for name in arguments.objects:
        for layout in arguments.layouts:
            for sensor in arguments.sensors:
                for row in rows_of(arguments.folder, name, layout, sensor, arguments.views):
                    print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
