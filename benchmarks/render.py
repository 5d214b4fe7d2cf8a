"""Time and error of rendering a plane scene, a JSON object a line.

    python benchmarks/render.py --data simulated
    python benchmarks/render.py --data FOLDER      # a folder with, or full of folders with, normals_gt.npz,
                                                         # light_directions.txt and photographs

Methods: `matrix` (shipped default: one 3 x K matrix a spectrum, compiled), `bands` (61 explicit bands, compiled),
`numpy` (3 x K in plain NumPy), `einsum` (61 bands in plain NumPy, what one would otherwise write).  max_rel_error:
worst difference from 61 explicit bands in float64 over a sample of pixels, relative to the largest of the pixel's X, Y,
Z.  All inputs are in memory, compiled code is warm.  Each time is the shortest of several runs; cpu_ns_per_pixel_light
is processor time, which other load disturbs less; ratio is processor time over that of the default with one thread.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from unittest import mock

import numpy as np
from numba import njit

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(2, str(Path(__file__).resolve().parents[1] / "workflow/src"))
from compiled_lobe import specular_scalar

import _project  # noqa: F401
from nishiki import threads
from nishiki.brdf.torrance_sparrow import specular
from nishiki.colour.colour import cie_1931_cmfs, illuminant, white_xyz, xyz_matrix
from nishiki.render.plane.scene import Gloss, Light, PlaneScene
from nishiki.render.plane.shade import pixel_to_plane, shade_xyz

FRONT = np.array([0.0, 0.0, 1.0])


def basis(count):
    """(count, 61): a constant and cosines, as smooth as the principal components of paints."""
    return np.array([np.cos(np.pi * k * np.linspace(0, 1, 61)) for k in range(count)])


def simulated(rows, columns):
    """Scenes by name: (scene, lights)."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:rows, :columns].astype(float)
    height = np.sin(x / 5) * np.cos(y / 7) + 0.6 * np.sin(x / 2.1 + y / 3.3)
    slope_y, slope_x = np.gradient(height)
    normals = np.stack([-slope_x, slope_y, np.ones_like(x)], axis=-1)
    normals = (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)
    ring = [(np.cos(a), np.sin(a), 1.0) for a in np.arange(8) * np.pi / 4] + [(0.0, 0.0, 1.0)]
    a, d65 = illuminant("A"), illuminant("D65")
    for name, bands, gamma, lights in (
        ("ring9_3coefficients", 3, 0.15, [Light(direction=d, spectrum=d65) for d in ring]),
        ("ring9_8coefficients", 8, 0.15, [Light(direction=d, spectrum=d65) for d in ring]),
        ("ring9_narrow_gloss", 3, 0.03, [Light(direction=d, spectrum=d65) for d in ring]),
        ("one_light_3coefficients", 3, 0.15, [Light(direction=ring[0], spectrum=d65)]),
        ("near_lamps_two_spectra", 3, 0.15, [
            Light(position_mm=tuple(900 * np.array(d)), falloff=True, spectrum=(a, d65)[k % 2])
            for k, d in enumerate(ring)
        ]),
    ):  # fmt: skip
        sigma = rng.uniform(-0.1, 0.1, (rows, columns, bands))
        sigma[..., 0] = rng.uniform(0.2, 0.8, (rows, columns))
        gloss = Gloss([[0.8]], [[gamma]], [1.45])
        yield name, PlaneScene(normals, sigma.astype(np.float32), basis=basis(bands), gloss=gloss), lights


def measured(folder):
    """One scene an object folder: its true normals, a diffuse colour from its photographs, its lights (9 of them)."""
    import cv2

    for found in sorted([folder, *folder.iterdir()] if folder.is_dir() else []):
        if not (found / "normals_gt.npz").is_file() or not (found / "light_directions.txt").is_file():
            continue
        normals = np.load(found / "normals_gt.npz")["normals"].astype(np.float32)
        directions = np.loadtxt(found / "light_directions.txt")
        photographs = sorted(p for p in found.glob("*.png") if p.stem.isdigit())
        chosen = np.linspace(0, len(directions) - 1, min(9, len(directions))).astype(int)
        images = [cv2.imread(str(photographs[k]), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535.0 for k in chosen]
        shading = np.maximum(np.einsum("rcx,lx->lrc", normals, directions[chosen]), 0.0)[..., None]
        albedo = np.sum(images * shading, axis=0) / np.maximum(np.sum(shading**2, axis=0), 1e-6)
        albedo /= max(1e-9, np.quantile(albedo, 0.999))
        # three basis functions with peaks in the blue, green and red: spectra that look like the colours
        bands = np.linspace(400, 700, 61)
        hills = np.array([np.exp(-(((bands - peak) / 60) ** 2)) for peak in (610, 540, 450)])
        scene = PlaneScene(normals, albedo.astype(np.float32), basis=hills, gloss=Gloss([[0.8]], [[0.15]], [1.45]))
        yield found.name, scene, [Light(direction=tuple(d), spectrum=illuminant("D65")) for d in directions[chosen]]


@njit(cache=False, error_model="numpy", fastmath={"reassoc", "contract"})
def _bands(normals, sigma, spectra, lights, weights, plane, gamma, index, beta, out):
    """Every band of every pixel and light, summed to XYZ."""
    rows, columns, count = sigma.shape
    reflectance = np.empty(61)
    for row in range(rows):
        for column in range(columns):
            for b in range(61):
                total = 0.0
                for k in range(count):
                    total += sigma[row, column, k] * spectra[k, b]
                reflectance[b] = total
            nx, ny, nz = normals[row, column]
            px, py = plane[0, 0] * column + plane[0, 2], plane[1, 1] * row + plane[1, 2]
            x, y, z = 0.0, 0.0, 0.0
            for j in range(len(lights)):
                w = lights[j, 3]
                lx, ly, lz = lights[j, 0] - w * px, lights[j, 1] - w * py, lights[j, 2]
                length2 = lx * lx + ly * ly + lz * lz
                scale = 1.0 / np.sqrt(length2)
                lx, ly, lz = lx * scale, ly * scale, lz * scale
                cosine = max(nx * lx + ny * ly + nz * lz, 0.0)
                shine = beta * specular_scalar(nx, ny, nz, lx, ly, lz, 0.0, 0.0, 1.0, gamma, index)
                fall = lights[j, 4] / length2 if lights[j, 4] > 0 else 1.0
                cosine, shine = cosine * fall, shine * fall
                for b in range(61):
                    value = reflectance[b] * cosine + shine
                    x += value * weights[j, 0, b]
                    y += value * weights[j, 1, b]
                    z += value * weights[j, 2, b]
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = x, y, z


def bands(scene, lights):
    out = np.empty((*scene.shape, 3), np.float32)
    gloss = scene.gloss
    lamps = np.array([[*light.homogeneous(), _reference2(light)] for light in lights])
    weights = _powers(lights)[:, None] * cie_1931_cmfs()
    _bands(scene.normals, scene.coefficients, scene.basis, lamps, weights, pixel_to_plane(scene.pitch, scene.shape),
           gloss.gamma[0, 0], gloss.refractive_index[0], gloss.beta[0, 0], out)  # fmt: skip
    return out


def _reference2(light):
    return float(np.sum(np.square(light.position_mm))) if light.falloff else 0.0


def _powers(lights):
    return np.array([x.intensity * x.spectrum / (cie_1931_cmfs()[1] @ x.spectrum) for x in lights])


def _weights(scene, lights, kind):
    """Diffuse and specular weight of each light at each pixel, in plain NumPy."""
    rows, columns = scene.shape
    normals, plane = scene.normals.astype(kind), pixel_to_plane(scene.pitch, scene.shape)
    points = np.zeros((rows, columns, 3), kind)
    points[..., 0] = plane[0, 0] * np.arange(columns) + plane[0, 2]
    points[..., 1] = (plane[1, 1] * np.arange(rows) + plane[1, 2])[:, None]
    gloss = scene.gloss
    for light in lights:
        source = light.homogeneous().astype(kind)
        towards = source[:3] - source[3] * points if source[3] else source[:3]
        length2 = np.sum(towards**2, axis=-1, keepdims=True)
        towards = towards / np.sqrt(length2)
        fall = _reference2(light) / length2[..., 0] if light.falloff else 1.0
        shine = specular(normals, towards, FRONT, beta=gloss.beta[0, 0], gamma=gloss.gamma[0, 0],
                         refractive_index=gloss.refractive_index[0])  # fmt: skip
        yield light, np.maximum(np.sum(normals * towards, axis=-1), 0) * fall, shine * fall


def numpy_matrix(scene, lights, kind=np.float64):
    sigma, total = scene.coefficients.astype(kind), np.zeros((*scene.shape, 3), kind)
    for light, diffuse, shine in _weights(scene, lights, kind):
        matrix = (light.intensity * xyz_matrix(light.spectrum, scene.basis)).astype(kind)
        total += diffuse[..., None] * (sigma @ matrix.T)
        total += shine[..., None] * (light.intensity * white_xyz(light.spectrum)).astype(kind)
    return total


def einsum_bands(scene, lights):
    reflectance = np.einsum("rck,kb->rcb", scene.coefficients.astype(np.float64), scene.basis)
    total = np.zeros((*scene.shape, 3))
    for power, (_, diffuse, shine) in zip(_powers(lights), _weights(scene, lights, np.float64), strict=True):
        radiance = (reflectance * diffuse[..., None] + shine[..., None]) * power
        total += np.einsum("rcb,xb->rcx", radiance, cie_1931_cmfs())
    return total


def best_time(function, repeats):
    """Shortest (seconds, processor seconds)."""
    wall, processor = [], []
    for _ in range(repeats):
        start, start_processor = time.perf_counter(), time.process_time()
        function()
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - start_processor)
    return np.array([min(wall), min(processor)])


def crop(scene, rows=48):
    """The first rows for the plain methods' error and time; lights at infinity do not notice."""
    return dataclasses.replace(scene, normals=scene.normals[:rows], coefficients=scene.coefficients[:rows])


def measure(name, scene, lights, repeats):
    everything = threads.threads()
    sample = crop(scene)
    reference = einsum_bands(sample, lights)
    known = np.sum(sample.normals**2, axis=2) > 0.5
    scale = np.abs(reference).max(axis=2, keepdims=True) + 1e-15
    methods = [("matrix", shade, 1, scene, repeats)]
    if everything > 1:
        methods.append(("matrix", shade, everything, scene, repeats))
    methods += [
        ("bands", bands, 1, scene, max(2, repeats // 8)),
        ("numpy", numpy_matrix, 1, scene, 2),
        ("einsum", einsum_bands, 1, sample, 2),
    ]
    base = None
    for method, function, workers, maps, times in methods:
        with mock.patch.object(threads, "threads", return_value=workers):
            error = np.abs(function(sample, lights) - reference) / scale
            seconds = best_time(lambda f=function, m=maps: f(m, lights), times)
        pixels = maps.shape[0] * maps.shape[1]
        per, processor = seconds / (pixels * len(lights)) * 1e9
        base = processor if base is None else base
        line = {
            "scene": name,
            "method": method,
            "ns_per_pixel_light": round(per, 2),
            "cpu_ns_per_pixel_light": round(processor, 2),
            "pixels": pixels,
            "lights": len(lights),
            "threads": workers,
            "max_rel_error": float(f"{error[known].max():.3g}"),
            "default": method == "matrix",
            "ratio": round(processor / base, 2),
        }
        print(json.dumps(line), flush=True)


def shade(scene, lights):
    return shade_xyz(scene, lights).values


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="simulated", help="simulated, or a folder")
    parser.add_argument("--rows", type=int, default=512)
    parser.add_argument("--columns", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=12)
    options = parser.parse_args()
    found = simulated(options.rows, options.columns) if options.data == "simulated" else measured(Path(options.data))
    count = 0
    for name, scene, lights in found:
        measure(name, scene, lights, options.repeats)
        count += 1
    if not count:
        parser.error(f"no folder with normals_gt.npz and light_directions.txt in {options.data}; give another --data")


if __name__ == "__main__":
    main()
