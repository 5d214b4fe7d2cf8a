"""Coded objects against the truth of `path_traced_turntable.py`: quality over the true outline, all bytes counted.

    python benchmarks/path_traced_turntable_score.py FOLDER RESULTS [--objects NAME ...]

FOLDER: of the captures and their truth; RESULTS: folder in which `nishiki run` stored the scenes under the objects'
names, with the product residual. One JSON line an object: bytes of all that a renderer needs, PSNR of all captured
views over the true outline (saturated pixels and those that the surface misses included; peak: full scale), the same
of JPEG 2000 of each view and of AV1 over the views at that size, from the qualities around it, and the surface's shape
against the true mesh.

Where the run left views out (setting `hold_out`), `left_out` has PSNR over their true outlines, all their pixels taken
together, and overlap with these: `decoded`, the residual of the captured neighbours; `model_alone`, no residual; and
two peers without any coding, the photographs of the two captured neighbours carried over the decoded surface
(`warped`) and over the true one (`warped_true_surface`), which says what the surface alone costs.
"""

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
from codecs_of_pictures import av1, filled, jpeg2000
from path_traced_turntable import FULL_SCALE, HOLES, OBJECTS

import _project  # noqa: F401
from nishiki.artifacts.artifact import open_artifact
from nishiki.codec.compact import cost_of
from nishiki.colour.colour import encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, read_triangles
from nishiki.geometry.placement import agreement
from nishiki.geometry.surface import shape_of
from nishiki.geometry.visibility import interpolate, rasterise
from nishiki.render.object.pixels import DepthMaps, extend
from nishiki.render.object.renderer import DecodedObject
from nishiki.render.object.shots import Neighbours

STAGES = ("ingest", "mesh", "cameras", "texels", "object_brdf", "residual")
PEERS = {"jpeg2000_db": (jpeg2000, range(36, 56)), "av1_db": (av1, range(36, 100, 8))}  # and their qualities


def psnr(values: np.ndarray, photographs: np.ndarray, where: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB over where (views, rows, columns) bool, peak 1."""
    return float(-10 * np.log10(np.mean((values - photographs)[where].astype(np.float64) ** 2)))


def peer_at(peer: str, size: int, photographs: np.ndarray, outline: np.ndarray, bits: int) -> float | None:
    """PSNR of a codec at so many bytes, on the pictures' common box; None where no quality needs as many."""
    coder, qualities = PEERS[peer]
    rows, columns = np.flatnonzero(outline.any((0, 2))), np.flatnonzero(outline.any((0, 1)))
    box = (slice(None), slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    codes = filled(np.rint(photographs.clip(0, 1) * FULL_SCALE).astype(np.uint16), outline)
    below = None
    for quality in qualities:
        coded = coder(np.ascontiguousarray(codes[box]), bits, quality)
        at = coded.bytes, psnr(coded.decoded / np.float32(FULL_SCALE), photographs[box], outline[box])
        if coded.bytes >= size:
            sizes, values = zip(below or at, at, strict=True)
            return round(float(np.interp(np.log(size), np.log(sizes), values)), 2) if below else None
        below = at
    return None


def warped(
    mesh: Mesh, camera: Camera, cameras: list[Camera], photographs: np.ndarray, shown: Neighbours, rim: int
) -> np.ndarray:
    """A view (rows, columns, channels) of a surface that bears the photographs of the views `shown`, each point by
    those that see it; values are carried on beyond the edge by `rim` pixels."""
    raster, depths = rasterise(mesh, camera), DepthMaps(mesh)
    points, normals = (
        interpolate(values, mesh.triangles, raster.triangle, raster.barycentric)
        for values in (mesh.vertices, mesh.normals)
    )
    picture, total = np.float32(0), np.float32(0)
    for view, share in zip(shown.views, shown.weights, strict=True):
        places = cameras[view].project(points.reshape(-1, 3))[0].astype(np.float32).reshape(*points.shape[:2], 2)
        seen = depths.visible(points, normals, cameras[view])
        weight = np.float32(share) * (seen + np.float32(1e-6))  # what no view sees shows the mean of all
        picture = picture + weight[..., None] * cv2.remap(photographs[view], places, None, cv2.INTER_LINEAR)
        total = total + weight
    covered = raster.triangle >= 0
    picture = np.where(covered[..., None], picture / total[..., None], np.float32(0))
    extend(picture, covered, rings=rim)
    return picture.clip(0, 1)


def left_out_scores(decoded, renderer, model, photographs: np.ndarray, outline: np.ndarray, true: Mesh) -> dict:
    """Scores of the views that no fit saw; see the head of this file."""
    views = sorted(renderer.without)
    shots = [renderer.predicted(view) for view in views]
    pictures = list(renderer.render(shots))
    covered = [picture.covered for picture in pictures]

    def carried(mesh: Mesh) -> np.ndarray:
        return np.array(
            [
                warped(mesh, shot.camera, decoded.cameras, photographs, shot.views, renderer.rim)
                for shot in shots
            ]
        )  # fmt: skip

    predictions = {
        "decoded": np.array([encode(picture.linear, decoded.encoding) for picture in pictures]),
        "model_alone": np.array([encode(picture.linear, decoded.encoding) for picture in model.render(shots)]),
        "warped": carried(renderer.mesh),
        "warped_true_surface": carried(true),
    }
    scores = {key: round(psnr(values, photographs[views], outline[views]), 2) for key, values in predictions.items()}
    overlap = np.mean([agreement(*pair) for pair in zip(covered, outline[views], strict=True)])
    return {"views": len(views), **scores, "overlap": round(float(overlap), 4)}


def score(name: str, folder: Path, scene: Path) -> dict:
    """One line; see the head of this file."""
    inputs = {stage: open_artifact((scene / "current" / stage).resolve()) for stage in STAGES}
    truth = folder / f"{name}-truth"
    outline = np.load(truth / "masks.npz")["cover"].astype(np.float32) >= 0.5
    decoded = DecodedObject.open(inputs)
    cost = cost_of(
        decoded.mesh, decoded.atlas.chart, decoded.cameras, decoded.lighting.as_dict(), decoded.residual.bytes
    )
    options = {
        "mesh": cost.mesh.restore(decoded.mesh),
        "without": decoded.numbers(inputs["texels"].settings["hold_out"]),
    }
    renderer = decoded.renderer(**options)
    captured = [view for view in range(len(outline)) if view not in renderer.without]
    pictures = list(renderer.render([renderer.captured(view) for view in captured]))
    source = Photographs(inputs)
    photographs = np.array([encode(source.read(view, 0)[0], decoded.encoding) for view in range(len(outline))])
    values = np.array([encode(picture.linear, decoded.encoding) for picture in pictures])
    covered = np.array([picture.covered for picture in pictures])
    true_mesh = Mesh.of(*read_triangles(truth / "mesh.ply"))
    shape, true = shape_of(decoded.mesh), shape_of(true_mesh)
    left_out = {}
    if renderer.without:
        model = decoded.renderer(model_only=True, **options)
        left_out = {"left_out": left_out_scores(decoded, renderer, model, photographs, outline, true_mesh)}
    return {
        "object": name,
        "kind": OBJECTS[name][0],
        "bytes": cost.total,
        "psnr_db": round(psnr(values, photographs[captured], outline[captured]), 2),
        **{
            peer: peer_at(peer, cost.total, photographs[captured], outline[captured], FULL_SCALE.bit_length())
            for peer in PEERS
        },
        "genus": shape.genus,
        "true_genus": HOLES.get(name, 0),
        "volume_ratio": None if shape.volume is None else round(shape.volume / true.volume, 4),
        "overlap": round(
            float(np.mean([agreement(*pair) for pair in zip(covered, outline[captured], strict=True)])), 4
        ),
        "triangles": shape.triangles,
        "charts": int(decoded.atlas.chart.max()) + 1,
        "mesh_bytes": cost.parts["mesh"],
        "charts_bytes": cost.parts["charts"],
        **left_out,
    }


def main() -> None:
    """Arguments in, lines out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    arguments = parser.parse_args()
    for name in arguments.objects:
        if (arguments.results / name / "current" / "residual").exists():
            print(json.dumps(score(name, arguments.folder, arguments.results / name)), flush=True)


if __name__ == "__main__":
    main()
