"""Objects on a turntable, path-traced by Mitsuba: captures whose shape, outlines and light are known exactly.

    python benchmarks/path_traced_turntable.py FOLDER [--objects NAME ...] [--samples 128] [--views 36] [--size 384]
        [--lamp 0.21 0.28]

Mitsuba 3 renders bodies before black, from all round, with one small lamp beside the camera. They are painted with the
principled material (Burley's diffuse lobe and a GGX coat): interreflection, cast shadows, gloss, and rims that shade to
black; no code of this project takes part. Of each object FOLDER gets NAME, a capture with camera matrices, neither
masks nor scan, and NAME-truth with `mesh.ply`, `masks.npz` (share of each pixel that the object covers) and `light.npz`
(linear pictures without noise). OBJECTS says whether methods were tuned on an object ("tuned") or not ("unseen"),
HOLES the genus of its surface.
"""

import argparse
import os
import sys
from glob import glob
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401

SIZE = 384  # pixels a side
DISTANCE, FIELD_DEG = 5.0, 30.0  # of the camera from the object, whose radius is about 1
LAMP_OFFSET, LAMP_RADIUS = (0.21, 0.28), 0.12  # right and up from the camera
FULL_SCALE, ELECTRONS, READ_NOISE = 4095, 20_000, 5.0  # 12 bits; shot noise of 0.7 % at full scale
CELLS = 160  # of the grid that the shapes are polygonised on

OBJECTS = {  # name: kind, seed, roughness
    "ring": ("tuned", 1, 0.45),
    "bowl": ("tuned", 2, 0.4),
    "pebble": ("tuned", 3, 0.35),
    "mug": ("tuned", 11, 0.4),
    "figure": ("tuned", 12, 0.5),
    "knot": ("unseen", 13, 0.45),
    "boat": ("unseen", 14, 0.45),
    "jug": ("tuned", 15, 0.4),
    "stool": ("tuned", 16, 0.5),
    "teapot": ("tuned", 17, 0.35),
    "chair": ("tuned", 18, 0.5),
}
HOLES = {"ring": 1, "mug": 1, "jug": 1, "stool": 4, "teapot": 1, "chair": 1}


def inside_of(name: str, points: np.ndarray, seed: int) -> np.ndarray:
    """A function of points (n, 3) that is above 0 in the body and steep at its surface; z is up."""
    x, y, z = points.T
    bumps = 0.02 * waves(points, seed, 2, 9)
    if name == "ring":  # standing upright and a little turned, so that views look through it
        across = np.hypot(0.8 * x + 0.6 * y, z)
        return 0.27 - np.hypot(across - 0.65, -0.6 * x + 0.8 * y) + bumps
    if name == "bowl":
        radius = np.linalg.norm(points / [1.0, 1.0, 0.85], axis=1)
        shell = 0.06 - np.abs(radius - 0.85)
        foot = smaller(0.35 - np.hypot(x, y), 0.12 - np.abs(z + 0.75))
        return larger(smaller(shell, -z + 0.1), foot) + 0.4 * bumps
    if name == "pebble":
        return 0.85 - np.linalg.norm(points / [1.0, 0.8, 0.7], axis=1) + 4 * bumps
    if name == "mug":
        wall = smaller(0.07 - np.abs(np.hypot(x, y) - 0.55), 0.7 - np.abs(z))
        base = smaller(0.6 - np.hypot(x, y), 0.08 - np.abs(z + 0.62))
        handle = smaller(0.09 - np.hypot(np.hypot(x - 0.6, z) - 0.38, y), x - 0.5)
        return larger(larger(wall, base), handle) + 0.3 * bumps
    if name == "figure":  # a trunk with a head and three limbs
        balls = [((0, 0, -0.35), 0.45), ((0, 0, 0.15), 0.36), ((0.05, 0, 0.65), 0.26)]
        ends = [((0.25, 0.1, 0.2), (0.75, 0.3, 0.45)), ((-0.2, 0.1, 0.2), (-0.65, -0.3, 0.0)),
                ((0.1, -0.3, -0.5), (0.3, -0.8, -0.7))]  # fmt: skip
        parts = [r - np.linalg.norm(points - centre, axis=1) for centre, r in balls]
        parts += [0.14 - to_segment(points, *map(np.array, pair)) for pair in ends]
        return 0.06 * np.log(np.exp(np.array(parts) / 0.06).sum(axis=0)) + bumps
    if name == "knot":  # two leaning bodies that touch: deep folds, no hole
        first = 0.75 - np.linalg.norm((points - [0.25, 0, -0.1]) / [0.6, 1.0, 1.1], axis=1)
        second = 0.75 - np.linalg.norm((points - [-0.3, -0.1, 0.1]) / [0.75, 0.6, 1.1], axis=1)
        return larger(first, second) + 2 * bumps
    if name == "boat":  # a leaning oblong shell, open above
        x, z = 0.94 * x - 0.34 * z, 0.34 * x + 0.94 * z
        outer = 0.6 * (1 - np.sqrt((x / 1.0) ** 2 + (y / 0.65) ** 2 + (z / 0.6) ** 2))
        inner = 0.6 * (np.sqrt((x / 0.82) ** 2 + (y / 0.5) ** 2 + ((z - 0.12) / 0.45) ** 2) - 1)
        return smaller(smaller(outer, inner), 0.15 - z) + 0.3 * bumps
    if name == "jug":  # a belly with a dent and a shallow mouth; the handle casts a shadow on it, and it on the handle
        x, y, z = (points := points / 1.15).T
        body = smaller(0.44 + 0.12 * np.cos(3.4 * (z + 0.15)) - np.hypot(x, y), 0.75 - np.abs(z))
        body = smaller(body, np.linalg.norm((points - [-0.1, 0.62, -0.1]) / [1, 1, 1.3], axis=1) - 0.26)
        body = smaller(body, np.linalg.norm((points - [0, 0, 0.9]) / [1, 1, 0.8], axis=1) - 0.3)
        handle = smaller(0.085 - np.hypot(np.hypot(x - 0.5, z - 0.05) - 0.46, y), x - 0.2)
        return larger(body, handle) + 0.3 * bumps
    if name == "stool":  # a seat on four thin legs with thin rungs
        seat = smaller(0.6 - np.hypot(x, y), 0.05 - np.abs(z - 0.45))
        feet = [np.array([0.62 * np.cos(a), 0.62 * np.sin(a), -0.75]) for a in np.pi / 2 * np.arange(4)]
        tops = [np.array([0.66, 0.66, 1]) * foot + [0, 0, 1.2] for foot in feet]
        middles = [0.6 * foot + 0.4 * top for foot, top in zip(feet, tops, strict=True)]
        rods = [(0.032, foot, top) for foot, top in zip(feet, tops, strict=True)]
        rods += [(0.022, middle, middles[(k + 1) % 4]) for k, middle in enumerate(middles)]
        return larger(seat, np.max([r - to_segment(points, a, b) for r, a, b in rods], axis=0), 0.01) + 0.05 * bumps
    if name == "teapot":
        body = 0.5 - 0.9 * np.linalg.norm(points / [1.0, 1.0, 0.85], axis=1)
        lid = smaller(0.14 - np.linalg.norm(points - [0, 0, 0.55], axis=1), z)
        start, end = np.array([-0.4, 0, -0.1]), np.array([-0.95, 0.1, 0.4])
        share = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
        spout = 0.16 - 0.09 * share - to_segment(points, start, end)
        handle = smaller(0.065 - np.hypot(np.hypot((x - 0.55) / 1.2, z - 0.05) - 0.36, y), x - 0.4)
        return larger(larger(body, lid), larger(spout, handle)) + 0.4 * bumps
    if name == "chair":
        seat = smaller(0.45 - np.abs(x), smaller(0.42 - np.abs(y), 0.05 - np.abs(z + 0.1)))
        ends = [(sx * 0.38, sy * 0.36, -0.1) for sx in (-1, 1) for sy in (-1, 1)]
        rods = [(0.04, np.array(end), np.array(end) * [1.1, 1.15, 0] - [0, 0, 0.85]) for end in ends]
        posts = [(np.array([-0.4, sy * 0.34, -0.1]), np.array([-0.55, sy * 0.36, 0.85])) for sy in (-1, 1)]
        rods += [(0.035, *post) for post in posts] + [(0.06, posts[0][1], posts[1][1])]
        return larger(seat, np.max([r - to_segment(points, a, b) for r, a, b in rods], axis=0), 0.01) + 0.1 * bumps
    raise ValueError(name)


def waves(points, seed, lowest, highest, count=16):
    """Sum of random plane waves at points (n, 3), about unit variance."""
    random = np.random.default_rng(seed)
    vectors = random.normal(size=(count, 3))
    lengths = np.geomspace(lowest, highest, count)
    vectors *= (lengths / np.linalg.norm(vectors, axis=1))[:, None]
    amplitudes = lengths**-1.2
    amplitudes *= np.sqrt(2 / np.sum(amplitudes**2))
    return np.cos(points @ vectors.T + random.uniform(0, 2 * np.pi, count)) @ amplitudes


def larger(a, b, soft=0.03):
    """Union of two bodies with a rounded seam."""
    return soft * np.logaddexp(a / soft, b / soft)


def smaller(a, b, soft=0.03):
    """Intersection of two bodies with a rounded edge."""
    return -larger(-a, -b, soft)


def to_segment(points, start, end):
    """Distance of points (n, 3) to a line segment."""
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def mesh_of(name: str, seed: int):
    """A closed trimesh, its triangles outwards."""
    import trimesh
    from skimage.measure import marching_cubes

    side = np.linspace(-1.25, 1.25, CELLS)
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    values = inside_of(name, grid, seed).reshape((CELLS,) * 3)
    vertices, faces, _, _ = marching_cubes(-values, 0.0, spacing=(side[1] - side[0],) * 3)
    mesh = trimesh.Trimesh(vertices - 1.25, faces)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh = max(mesh.split(only_watertight=False), key=lambda part: len(part.faces))
    if mesh.volume < 0:
        mesh.invert()
    holes = 1 - mesh.euler_number // 2
    if not mesh.is_watertight or holes != HOLES.get(name, 0):
        raise ValueError(f"{name}: expected a closed surface with {HOLES.get(name, 0)} holes, found {holes}")
    return mesh


def paint_of(vertices: np.ndarray, seed: int) -> np.ndarray:
    """Colours (n, 3) of two paints in patches with soft and sharp borders."""
    random = np.random.default_rng(100 + seed)
    two = random.uniform(0.05, 0.75, (2, 3))
    share = 1 / (1 + np.exp(-12 * waves(vertices, seed + 50, 3, 14)))
    return share[:, None] * two[0] + (1 - share[:, None]) * two[1]


def camera_of(view: int, views: int, size: int = SIZE):
    """K (3, 3), R (3, 3), t (3,): x right, y down, z into the scene."""
    turn, height = 2 * np.pi * view / views, np.radians(22)
    centre = DISTANCE * np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
    forward = -centre / DISTANCE
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = 0.5 * size / np.tan(np.radians(FIELD_DEG / 2))
    middle = (size - 1) / 2
    return np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]), rotation, -rotation @ centre


def rendered(mi, scene_mesh, arguments, view: int) -> np.ndarray:
    """(rows, columns, 4) float32: linear light and cover."""
    size = arguments.size
    _, rotation, translation = camera_of(view, arguments.views, size)
    centre = -rotation.T @ translation
    up, right = -rotation[1], rotation[0]
    lamp = centre + arguments.lamp[0] * right + arguments.lamp[1] * up
    radiance = 0.9 * DISTANCE**2 / LAMP_RADIUS**2
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 5, "hide_emitters": True},
            "sensor": {
                "type": "perspective",
                "fov": FIELD_DEG,
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=centre.tolist(), target=[0, 0, 0], up=[0, 0, 1]
                ),
                "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba",
                         "rfilter": {"type": "gaussian", "stddev": 0.5}},
                "sampler": {"type": "independent", "sample_count": arguments.samples},
            },
            "lamp": {
                "type": "sphere",
                "center": lamp.tolist(),
                "radius": LAMP_RADIUS,
                "emitter": {"type": "area", "radiance": {"type": "uniform", "value": radiance}},
            },
            "object": scene_mesh,
        }
    )  # fmt: skip
    # a triangle without area can give a sample that is no number
    return np.nan_to_num(np.array(mi.render(scene, seed=view), np.float32), nan=0.0, posinf=0.0)


def main() -> None:
    """Arguments in, captures out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--views", type=int, default=36)
    parser.add_argument("--size", type=int, default=SIZE, help="pixels a side")
    parser.add_argument("--lamp", type=float, nargs=2, default=LAMP_OFFSET, help="right and up from the camera")
    arguments = parser.parse_args()
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", next(iter(glob("/usr/lib/x86_64-linux-gnu/libLLVM*.so*")), ""))
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    for name in arguments.objects:
        make(mi, name, arguments)


def make(mi, name: str, arguments) -> None:
    """One capture with its truth."""
    import cv2

    folder, views = arguments.folder, arguments.views

    _, seed, roughness = OBJECTS[name]
    mesh = mesh_of(name, seed)
    capture, truth = folder / name, folder / f"{name}-truth"
    capture.mkdir(parents=True)
    truth.mkdir(parents=True)
    mesh.export(truth / "mesh.ply")
    paint = paint_of(np.asarray(mesh.vertices), seed)
    shape = mi.Mesh("object", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True,
                    props=properties(mi, roughness))  # fmt: skip
    values = mi.traverse(shape)
    values["vertex_positions"] = np.asarray(mesh.vertices, np.float32).ravel()
    values["vertex_normals"] = np.asarray(mesh.vertex_normals, np.float32).ravel()
    values["faces"] = np.asarray(mesh.faces, np.uint32).ravel()
    values.update()
    shape.add_attribute("vertex_color", 3, paint.astype(np.float32).ravel())
    random = np.random.default_rng(seed)
    light, cover = [], []
    for view in range(views):
        picture = rendered(mi, shape, arguments, view)
        light.append(picture[..., :3])
        cover.append(picture[..., 3])
        print(f"\r{name}: view {view + 1} of {views}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    scale = 0.9 / np.percentile(np.stack(light), 99.8)
    rows = ["file,role,view"]
    matrices = ["view," + ",".join(f"p{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))]
    for view, picture in enumerate(light):
        electrons = random.poisson(np.maximum(picture * scale, 0) * ELECTRONS) + random.normal(
            0, READ_NOISE, picture.shape
        )
        codes = np.clip(np.round(electrons / ELECTRONS * FULL_SCALE), 0, FULL_SCALE).astype(np.uint16)
        cv2.imwrite(str(capture / f"{view:03d}.png"), codes[..., ::-1])
        rows.append(f"{view:03d}.png,sample,{view:03d}")
        intrinsics, rotation, translation = camera_of(view, views, arguments.size)
        matrix = intrinsics @ np.column_stack([rotation, translation])
        matrices.append(f"{view:03d}," + ",".join(f"{value:.12g}" for value in matrix.ravel()))
    (capture / "frames.csv").write_text("\n".join(rows) + "\n")
    (capture / "cameras.csv").write_text("\n".join(matrices) + "\n")
    (capture / "capture.yaml").write_text(
        f"format: 1\ntitle: path-traced {name}\ngeometry: turntable\n"
        "camera: {channels: [red, green, blue], bits: 12}\nlights: {kind: camera}\n"
        "turntable: {full_turn: true, unit: arbitrary, cameras: cameras.csv, background: dark}\n"
    )
    np.savez_compressed(truth / "masks.npz", cover=np.stack(cover).astype(np.float16))
    np.savez_compressed(truth / "light.npz", light=(scale * np.stack(light)).astype(np.float16))


def properties(mi, roughness: float):
    """Material of a mesh that has the colours of its vertices."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {
            "type": "principled",
            "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            "roughness": roughness,
            "specular": 0.5,
        }
    )
    return props


if __name__ == "__main__":
    main()
