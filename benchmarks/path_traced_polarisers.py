"""Objects behind polarisers, path-traced by Mitsuba: diffuse and specular light, each known exactly.

    python benchmarks/path_traced_polarisers.py FOLDER [--objects NAME ...] [--samples 256] [--views 4]

The bodies of `path_traced_turntable`, polygonised finer, with a fine grain in their paint, bumps and patches of
different gloss. Each view is rendered twice: with the diffuse lobe alone (all interreflection) and with the specular
lobe alone (lamp to surface to camera). FOLDER gets NAME.npz: `diffuse`, `specular` (views, rows, columns, 3) float32
without noise, 1 = full scale, `cover` (share of each pixel that the object covers). The lamp's colour in the camera's
channels is LAMP. No code of this project takes part but the shapes.

OBJECTS says on which objects methods were tuned and on which not; "gilded" patches reflect in a colour of their own.
"""

import argparse
import os
import sys
from glob import glob
from pathlib import Path

import numpy as np
from path_traced_turntable import (
    DISTANCE,
    FIELD_DEG,
    LAMP_OFFSET,
    LAMP_RADIUS,
    SIZE,
    camera_of,
    inside_of,
    paint_of,
    waves,
)

CELLS = 224
LAMP = np.array([0.85, 1.0, 0.7], np.float32)
BRIGHT = 0.8  # of full scale: the 99.5th percentile of all light

OBJECTS = {  # name: kind, shape, seed, roughness of two patches, height of the fine bumps, gilded
    "pebble": ("tuned", "pebble", 21, (0.2, 0.45), 0.0, False),
    "figure": ("tuned", "figure", 22, (0.3, 0.5), 0.004, False),
    "mug": ("unseen", "mug", 31, (0.25, 0.4), 0.002, False),
    "knot": ("unseen", "knot", 32, (0.15, 0.35), 0.006, False),
    "bowl": ("unseen", "bowl", 33, (0.35, 0.5), 0.0, False),
    "gilded": ("unseen", "pebble", 34, (0.25, 0.45), 0.003, True),
}


def mesh_of(shape: str, seed: int, bumps: float):
    """A closed trimesh with fine bumps of that height."""
    import trimesh
    from skimage.measure import marching_cubes

    side = np.linspace(-1.25, 1.25, CELLS)
    values = np.empty((CELLS,) * 3)
    for plane, x in enumerate(side):
        y, z = np.meshgrid(side, side, indexing="ij")
        points = np.stack([np.full(y.shape, x), y, z], axis=-1).reshape(-1, 3)
        values[plane] = inside_of(shape, points, seed).reshape(y.shape)
    vertices, faces, _, _ = marching_cubes(-values, 0.0, spacing=(side[1] - side[0],) * 3)
    mesh = trimesh.Trimesh(vertices - 1.25, faces)
    mesh = max(mesh.split(only_watertight=False), key=lambda part: len(part.faces))
    if mesh.volume < 0:
        mesh.invert()
    normals = np.asarray(mesh.vertex_normals)
    mesh.vertices = mesh.vertices + normals * (bumps * waves(mesh.vertices, seed + 7, 20, 60, 40))[:, None]
    return mesh


def share_of(vertices: np.ndarray, seed: int) -> np.ndarray:
    """(n,) 0 or 1 with narrow borders: patches."""
    return 1 / (1 + np.exp(-60 * waves(vertices, seed + 70, 2, 6)))


def shape_of(mi, mesh, material: dict, attributes: dict[str, np.ndarray]):
    """A Mitsuba mesh of a trimesh with attributes of its vertices."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(material)
    shape = mi.Mesh("object", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=props)
    values = mi.traverse(shape)
    values["vertex_positions"] = np.asarray(mesh.vertices, np.float32).ravel()
    values["vertex_normals"] = np.asarray(mesh.vertex_normals, np.float32).ravel()
    values["faces"] = np.asarray(mesh.faces, np.uint32).ravel()
    values.update()
    for name, each in attributes.items():
        shape.add_attribute(f"vertex_{name}", 1 if each.ndim == 1 else 3, np.asarray(each, np.float32).ravel())
    return shape


def materials(gilded: bool) -> tuple[dict, dict]:
    """Diffuse lobe, specular lobe."""
    roughness = {"type": "mesh_attribute", "name": "vertex_roughness"}
    paint = {"type": "mesh_attribute", "name": "vertex_color"}
    metal = {"type": "mesh_attribute", "name": "vertex_metal"}
    diffuse = {"type": "principled", "base_color": paint, "roughness": roughness, "specular": 0.0}
    black = {"type": "rgb", "value": [0.0, 0.0, 0.0]}
    specular = {"type": "principled", "base_color": black, "roughness": roughness, "specular": 0.5}
    if gilded:
        gold = {"type": "rgb", "value": [0.5, 0.36, 0.14]}
        specular |= {"base_color": gold, "metallic": metal}
        diffuse |= {"metallic": 0.0}
    return diffuse, specular


def rendered(mi, shape, view: int, views: int, samples: int, depth: int) -> np.ndarray:
    """(rows, columns, 4) float32: linear light and cover."""
    _, rotation, translation = camera_of(view, views)
    centre = -rotation.T @ translation
    lamp = centre + 0.5 * (LAMP_OFFSET[0] * rotation[0] - LAMP_OFFSET[1] * rotation[1])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgba",
            "rfilter": {"type": "gaussian", "stddev": 0.5}}  # fmt: skip
    sensor = {
        "type": "perspective",
        "fov": FIELD_DEG,
        "to_world": mi.ScalarTransform4f().look_at(origin=centre.tolist(), target=[0, 0, 0], up=[0, 0, 1]),
        "film": film,
        "sampler": {"type": "independent", "sample_count": samples},
    }
    radiance = {"type": "uniform", "value": 0.9 * DISTANCE**2 / LAMP_RADIUS**2}
    emitter = {"type": "area", "radiance": radiance}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "hide_emitters": True},
        "sensor": sensor,
        "lamp": {"type": "sphere", "center": lamp.tolist(), "radius": LAMP_RADIUS, "emitter": emitter},
        "object": shape,
    }
    # a triangle without area can give a sample that is no number
    return np.nan_to_num(np.array(mi.render(mi.load_dict(scene), seed=view), np.float32), posinf=0.0)


def make(mi, name: str, folder: Path, samples: int, views: int) -> None:
    """Both parts of one object."""
    _, shape, seed, (first, second), bumps, gilded = OBJECTS[name]
    mesh = mesh_of(shape, seed, bumps)
    vertices = np.asarray(mesh.vertices)
    patches, grain = share_of(vertices, seed), 1 + 0.12 * waves(vertices, seed + 90, 30, 90, 60)
    attributes = {
        "color": np.clip(paint_of(vertices, seed) * grain[:, None], 0.02, 0.95),
        "roughness": first + (second - first) * patches,
        "metal": share_of(vertices, seed + 3),
    }
    parts = []
    for material, depth, count in zip(materials(gilded), (5, 2), (samples, samples), strict=True):
        body = shape_of(mi, mesh, material, attributes)
        parts.append(np.stack([rendered(mi, body, view, views, count, depth) for view in range(views)]))
    diffuse, specular = (each[..., :3] * LAMP for each in parts)
    cover = parts[0][..., 3]
    scale = BRIGHT / np.percentile((diffuse + specular)[cover > 0.99], 99.5)
    np.savez_compressed(folder / f"{name}.npz", diffuse=scale * diffuse, specular=scale * specular, cover=cover)
    inside = cover > 0.99
    print(name, "mean diffuse", scale * diffuse[inside].mean(), "specular", scale * specular[inside].mean(), flush=True)


def main() -> None:
    """Arguments in, parts out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--views", type=int, default=4)
    arguments = parser.parse_args()
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", next(iter(glob("/usr/lib/x86_64-linux-gnu/libLLVM*.so*")), ""))
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name in arguments.objects:
        make(mi, name, arguments.folder, arguments.samples, arguments.views)


if __name__ == "__main__":
    sys.exit(main())
