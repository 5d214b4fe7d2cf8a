"""Time a texel of the reflection fit against scipy's least squares, one point after the other; a JSON object a line.

    texel_fit.py [--data FOLDER] [--texels N] [--scipy N]

Without --data: simulated texels of 36 views x 3 channels (Lambert and GGX gloss with noise, cameras on a circle).  With
it: also the texels of every texel store found in or below FOLDER (folders that hold texels.zarr beside the ingested
capture's artifact are timed with a lamp at the camera; only the time is of interest then).
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT / "scripts"))
sys.path.insert(1, str(PROJECT / "tests"))

from published_fits import fit_points, point_problem  # noqa: E402

import _project  # noqa: E402, F401
from nishiki.brdf.texels.model import CaptureLamps  # noqa: E402
from nishiki.brdf.texels.texel_fit import WIDTHS, LobeProfile, TileSamples, gather, lambert, lobes_of  # noqa: E402

VIEWS, CHANNELS = 36, 3


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def simulated(texels: int, *, noise: float = 0.003, roughness: float = 0.3, seed: int = 0) -> TileSamples:
    """Texels that every one of 36 cameras in a cap over them sees; the lamp is beside the camera."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(texels)))
    normals = unit(rng.normal(size=(side, side, 3)) * 0.25 + [0, 0, 1.0])
    positions = np.concatenate([rng.uniform(-50, 50, (side, side, 2)), np.zeros((side, side, 1))], axis=-1)
    turns = 2 * np.pi * np.arange(VIEWS) / VIEWS
    lean = 0.9 * (0.2 + 0.8 * rng.random(VIEWS))
    back = np.stack([np.sin(lean) * np.cos(turns), np.sin(lean) * np.sin(turns), np.cos(lean)], axis=1)
    centres = 600 * back
    lamps = [lamp_beside(centre) for centre in centres]
    albedo = rng.uniform(0.1, 0.8, (side, side, CHANNELS))
    values = np.empty((VIEWS, side, side, CHANNELS), np.float32)
    for o, (centre, lamp) in enumerate(zip(centres, lamps, strict=True)):
        values[o] = reflected(positions, normals, albedo, centre, lamp.vector, roughness)
    values += noise * rng.normal(size=values.shape).astype(np.float32)
    return gather(values, np.ones(values.shape[:3], bool), positions, normals, centres, lamps)


def lamp_beside(centre):
    """A lamp 100 mm above a camera that looks at the origin."""
    from nishiki.geometry.camera import Camera

    back = unit(centre)
    right = unit(np.cross([0.0, 1.0, 0.1], back))
    rotation = np.stack([right, -np.cross(back, right), -back])
    camera = Camera("", np.eye(3), rotation, -rotation @ centre, 1, 1)
    return CaptureLamps("position", ((0.0, 100.0, 0.0),)).lamp(camera)


def reflected(positions, normals, albedo, centre, place, roughness):
    """Lambert and Trowbridge-Reitz with Smith's masking: not the model that is fitted."""
    to_lamp, to_camera = unit(place - positions), unit(centre - positions)
    cos_i, cos_r = (np.maximum(np.sum(normals * v, axis=-1), 1e-3) for v in (to_lamp, to_camera))
    cos_a = np.sum(normals * unit(to_lamp + to_camera), axis=-1)
    a2 = roughness**4
    gloss = 0.04 * a2 / (cos_a**2 * (a2 - 1) + 1) ** 2 * cos_i
    for cosine in (cos_i, cos_r):
        gloss = gloss / (cosine + np.sqrt(a2 + (1 - a2) * cosine**2))
    return albedo * cos_i[..., None] + gloss[..., None]


def fastest(run, rounds):
    """Least processor seconds of some rounds."""
    times = []
    for _ in range(rounds):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return min(times)


def scipy_seconds(data: TileSamples, count: int, analytic: bool) -> tuple[float, np.ndarray, np.ndarray]:
    """Seconds of scipy's Levenberg-Marquardt on the first points, and what it found."""
    few = [
        np.asarray(a[:count], float) for a in (data.alpha, data.values, data.attenuation, data.diffuse, data.weights)
    ]
    found, reports = np.zeros((count, data.values.shape[2], 2)), np.zeros((count, 8))
    point_problem(few[0][0], few[1][0], few[2][0], few[3][0], np.sqrt(few[4][0]))
    return fastest(lambda: fit_points(*few, found, reports, analytic=analytic), 1), found, reports


def explained(data: TileSamples, kd, ks, lobe) -> float:
    """Root mean square of the weighted residuals of texels; lobe (points, slots): what multiplies K_s."""
    model = kd[:, None] * data.diffuse[..., None] + ks[:, None] * lobe[..., None]
    weights = data.weights[..., None]
    return float(np.sqrt(np.sum(weights * (model - data.values) ** 2) / (weights.sum() * model.shape[-1])))


def some_of(data: TileSamples, points) -> TileSamples:
    """Some of the points."""
    return TileSamples(*(None if values is None else values[points] for values in vars(data).values()))


def timed(name: str, data: TileSamples, scipy_count: int) -> None:
    """Lines on one set of texels."""
    texels, count = len(data.texel), min(scipy_count, len(data.texel))
    shared = {"object": name, "views": int(data.view.max()) + 1, "channels": data.values.shape[2], "texels": texels}
    shared["observations_a_texel"] = round(float(data.seen.mean()), 2)
    part = some_of(data, slice(count))
    kd, ks, sigma = fit_alone(part)
    mine = fastest(lambda: fit_alone(data), 5) / texels * 1e6
    slow, found, reports = scipy_seconds(data, count, True)
    differences, *_ = scipy_seconds(data, count, False)
    width = reports[:, 0] / np.sqrt(2 * np.log(2))
    both = np.isfinite(width) & (width > WIDTHS[0]) & (width < WIDTHS[-1])  # a width was determined
    compared = some_of(part, both)
    gaussian = compared.attenuation * np.exp(-(compared.alpha**2) / (2 * width[both, None] ** 2))  # scipy's lobe
    reference, differences = slow / count * 1e6, differences / count * 1e6
    report(
        **shared, method="profile_of_widths", us_per_texel=round(mine, 3), default=True,
        ratio_to_scipy=round(reference / mine, 1), ratio_to_scipy_differences=round(differences / mine, 1),
        rms=explained(compared, kd[both], ks[both], lobes_of(compared, sigma[both])), compared=int(both.sum()),
    )  # fmt: skip
    report(
        **shared, method="scipy_least_squares", us_per_texel=round(reference, 1), default=False,
        us_per_texel_differences=round(differences, 1), ratio_to_scipy=1.0,
        rms=explained(compared, found[both, :, 1], found[both, :, 0], gaussian), compared=int(both.sum()),
    )  # fmt: skip


def fit_alone(data: TileSamples) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit K_d, K_s and sigma of each texel by itself, as the stage fits those of neighbours together."""
    sigma, ks = LobeProfile.of(data).solve()
    sigma = np.where(sigma > 0, sigma, WIDTHS[0])
    return lambert(data, lobes_of(data, sigma)[..., None] * ks[:, None]), ks, sigma


def report(**values) -> None:
    print(json.dumps(values), flush=True)


def stores(folder: Path):
    """Texel stores in or below a folder."""
    return sorted(path.parent for path in [*folder.glob("texels.zarr"), *folder.glob("**/texels.zarr")])


def from_store(folder: Path, count: int) -> TileSamples | None:
    """Texels of the fullest tile of a store, seen under a lamp at the camera."""
    from nishiki.atlas.store import Texels

    texels = Texels(folder)
    lamps = [CaptureLamps("camera").lamp(camera) for camera in texels.cameras]
    best = None
    for tile in range(0, texels.tiles, max(texels.tiles // 20, 1)):
        positions, normals, inside = texels.geometry(tile)
        if best is None or inside.sum() > best[0]:
            best = (inside.sum(), tile, positions, normals, inside)
    if best is None or not best[0]:
        return None
    _, tile, positions, normals, inside = best
    many = len(texels.lights)
    centres = np.array([camera.centre for camera in texels.cameras] * many)
    visible = texels.visible(tile) & inside
    return gather(texels.read("total", tile), visible, positions, normals, centres, lamps * many,
                    encoding=texels.encoding)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--texels", type=int, default=40000)
    parser.add_argument("--scipy", type=int, default=200)
    options = parser.parse_args()
    timed("simulated", simulated(options.texels), options.scipy)
    for folder in stores(options.data) if options.data else []:
        data = from_store(folder, options.texels)
        if data is not None and len(data.texel) > options.scipy:
            timed(folder.parent.name, data, options.scipy)


if __name__ == "__main__":
    main()
