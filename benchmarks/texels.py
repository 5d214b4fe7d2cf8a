"""Texels: seconds and peak memory against triangles, pixels and views.

    python benchmarks/texels.py [--full] [--output FOLDER] [--data ARTIFACTS]

Without --data: bumpy spheres on a turntable, each seen in pictures whose values are made up, through the same functions
that the stage calls: charts, atlas, and the store written to disk view by view. Reduced sizes by default, each doubling
one of triangles, pixels and views; --full: a quarter of a million triangles with 9, 18 and 36 views of 12 megapixels.
--data: a folder that holds the artifacts ingest, cameras and mesh of an object (each in a folder of that name, with the
key below or not), measured likewise.

One JSON object a line: triangles, views, pixels (a view), object_pixels (all views), texels (inside), tiles, charts;
seconds: charts_s (with density and atlas), geometry_s (a point for every texel), views_s (rasterising, sampling and
writing all views), read_s (every tile's stack and samples, in order), us_per_sample: views_s a texel and view;
peak_rss_mb: of a process of its own for each line, pictures included; disk_mb. Kernels are compiled before.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.atlas.atlas import build_atlas
from nishiki.atlas.charts import make_charts, probe_spacing, turning
from nishiki.atlas.quality import sampling_density, texels_per_unit
from nishiki.atlas.store import Texels
from nishiki.atlas.write import Source, TexelsWriter
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.stages.texels import OUTPUTS

SMALL = [(20_000, 6, 300_000), (40_000, 6, 300_000), (20_000, 12, 300_000), (20_000, 6, 600_000)]
FULL = [(250_000, 9, 12_000_000), (250_000, 18, 12_000_000), (250_000, 36, 12_000_000)]


def bumpy_sphere(triangles: int) -> Mesh:
    """A closed surface of about so many triangles: rings of latitude, radius 1 with bumps of a tenth."""
    rings = max(4, round(np.sqrt(triangles / 4)))
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.arange(2 * rings) * np.pi / rings, indexing="ij")
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1)
    radius = 1 + 0.1 * np.sin(7 * d[..., 0]) * np.sin(6 * d[..., 1]) * np.cos(8 * d[..., 2])
    index = np.arange(theta.size).reshape(theta.shape)
    index[0], index[-1] = index[0, 0], index[-1, 0]
    here, down = index[:-1], index[1:]
    right, across = np.roll(here, -1, axis=1), np.roll(down, -1, axis=1)
    corners = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((here, down, across), (here, across, right))])
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return Mesh.of((d * radius[..., None]).reshape(-1, 3), corners[proper])


def around(views: int, pixels: int) -> list[Camera]:
    """Cameras on a full turn, 4:3 pictures of about so many pixels, the object filling most of the height."""
    rows = round(np.sqrt(pixels * 3 / 4))
    columns, cameras = round(pixels / rows), []
    k = np.array([[2.5 * rows, 0, columns / 2], [0, 2.5 * rows, rows / 2], [0, 0, 1]])
    for angle in 2 * np.pi * np.arange(views) / views:
        centre = 6 * np.array([np.sin(angle), 0.3, np.cos(angle)]) / np.hypot(1, 0.3)
        ahead = -centre / 6
        right = np.cross(ahead, [0, 1, 0]) / np.linalg.norm(np.cross(ahead, [0, 1, 0]))
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        cameras.append(Camera(f"{len(cameras):03d}", k, rotation, -rotation @ centre, rows, columns))
    return cameras


def made_up(camera: Camera, number: int) -> tuple[np.ndarray, np.ndarray]:
    """A 12-bit picture of three channels that compresses like a photograph's noise would, all pixels valid."""
    rng = np.random.default_rng(number)
    codes = rng.integers(500, 3500, (camera.rows, camera.columns, 3), dtype=np.uint16)
    return codes.astype(np.float32) / np.float32(4095), np.ones((camera.rows, camera.columns), bool)


def measure(folder: Path, mesh: Mesh, cameras: list[Camera], read, *, channels: int, texels: float) -> dict:
    """Times of one object; read(view) -> picture, valid."""
    clock = [time.perf_counter()]

    def lap() -> float:
        clock.append(time.perf_counter())
        return round(clock[-1] - clock[-2], 3)

    up, front = turning(cameras)
    spacing = probe_spacing(mesh, cameras, texels_per_pixel=texels)
    charts = make_charts(mesh, up=up, front=front, spacing=spacing)
    density = sampling_density(mesh, charts.plane, cameras, percentile=90.0)
    scale = texels_per_unit(density, charts.plane, charts.chart, texels_per_pixel=texels)
    atlas = build_atlas(charts.plane, charts.chart, scale, size=64)
    found = {"triangles": len(mesh.triangles), "views": len(cameras), "pixels": cameras[0].rows * cameras[0].columns}
    found |= {"charts": len(charts.frames.direction), "tiles": atlas.tiles, "charts_s": lap()}
    source = Source(("",), ("total",), channels, "linear", True)
    writer = TexelsWriter(folder, OUTPUTS, mesh, atlas, cameras, source, stamp={})
    found["geometry_s"] = lap()
    pixels, spent = 0, 0.0
    for index in range(len(cameras)):
        picture, valid = read(index)
        lap()
        view = writer.view(index, None)
        writer.pictures(view, 0, {"total": picture}, valid)
        pixels += len(view.places.row)
        spent += lap()
    writer.finish()
    inside = int(writer.inside.sum())
    found |= {"texels": inside, "object_pixels": pixels, "views_s": round(spent, 3)}
    found["us_per_sample"] = round(spent / max(1, inside * len(cameras)) * 1e6, 3)
    del writer, view, picture, valid
    lap()
    stored = Texels(folder)
    for tile in range(stored.tiles):
        stored.read("total", tile), stored.visible(tile), stored.samples("total", tile)
    found["read_s"] = lap()
    found["disk_mb"] = round(sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6, 1)
    return found


def of_artifacts(root: Path, folder: Path, texels: float) -> dict:
    """An object's own artifacts."""
    from nishiki.geometry.camera import load_cameras
    from nishiki.observations.views import Views

    def of(stage: str, name: str) -> Path:
        return next(p for p in sorted(root.glob(f"{stage}/**/{name}")))

    views = Views(of("ingest", "views.zarr"))
    cameras, mesh = load_cameras(of("cameras", "cameras.json")), Mesh.load(of("mesh", "mesh.npz"))
    return measure(folder, mesh, cameras, lambda k: views.read(k), channels=len(views.channels), texels=texels)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--output", type=Path, help="where the stores are written; they are removed again")
    parser.add_argument("--texels-per-pixel", type=float, default=1.0)
    parser.add_argument("--one", nargs=3, type=int, metavar=("TRIANGLES", "VIEWS", "PIXELS"), help="a single size")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    sizes = [tuple(options.one)] if options.one else FULL if options.full else SMALL
    if not options.child:
        common = [sys.executable, __file__, "--child", "--texels-per-pixel", str(options.texels_per_pixel)]
        common += ["--output", str(options.output)] if options.output else []
        runs = [["--data", str(options.data)]] if options.data else [["--one", *map(str, size)] for size in sizes]
        for run in runs:
            subprocess.run([*common, *run], check=True)
        return
    if options.output:
        Path(options.output).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.output) as temporary:
        cameras = around(2, 20_000)
        warm = Path(temporary) / "warm"
        measure(warm, bumpy_sphere(500), cameras, lambda k: made_up(cameras[k], k), channels=3, texels=1.0)
        folder = Path(temporary) / "measured"
        if options.data:
            found = of_artifacts(options.data, folder, options.texels_per_pixel)
        else:
            triangles, views, pixels = sizes[0]
            cameras = around(views, pixels)
            read, mesh = (lambda k: made_up(cameras[k], k)), bumpy_sphere(triangles)
            found = measure(folder, mesh, cameras, read, channels=3, texels=options.texels_per_pixel)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({**found, "peak_rss_mb": round(peak, 1), "default": options.texels_per_pixel == 1.0}), flush=True)


if __name__ == "__main__":
    main()
