"""Normals of path-traced coloured objects: error against truth beside time, for plastics from dark to bright.

    python benchmarks/path_traced_objects.py FOLDER [--objects NAME ...] [--samples 64]

Mitsuba 3 renders bumpy spheres, blobs and reliefs of rough plastic and of the principled material under distant lamps:
interreflection, cast shadows, GGX gloss and the losses below a dielectric surface; none of it is what photometric
stereo is fitted with. Renderings are kept in FOLDER (NAME.npz) and made once. Every method sees 12-bit photographs with
shot noise, under all 96 lamps within 55 degrees of the axis, under 24 and 12 spread over them and under 12 within 30
degrees. "joint" is the default followed by the joint fit with gloss where that is significant, for up to 24 lamps.

One JSON object a line: object, lights, method, mean and median angle in degrees, processor time a pixel. `kind` says
whether the object was looked at while methods were tuned ("tuned") or not ("unseen").
"""

import argparse
import json
import os
import sys
import time
from glob import glob
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401

SIZE = 128  # pixels a side
LAMPS, CONE = 96, 55.0
FEW, NARROW = 12, 30.0
JOINT_PIXELS = 8000  # of an object, for its gloss
DEPTH = 4  # three bounces
FULL_SCALE = 4095
ELECTRONS = 20_000  # at full scale: shot noise of 0.7 % there
READ_NOISE = 5.0  # electrons


def rough(colour, alpha):
    """Diffuse body below a rough dielectric surface (GGX), with the colour shift of internal reflections."""
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": alpha,
        "nonlinear": True,
        "diffuse_reflectance": {"type": "rgb", "value": colour},
    }


def principled(colour, roughness):
    """Disney's principled material: Burley's diffuse lobe and a GGX coat of specular reflection."""
    return {
        "type": "principled",
        "base_color": {"type": "rgb", "value": colour},
        "roughness": roughness,
        "specular": 0.5,
    }


def matt(colour):
    """Lambert's law."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}


OBJECTS = {  # name: kind, shape, seed, material
    "red_sphere": ("tuned", "sphere", 1, rough([0.10, 0.01, 0.01], 0.20)),
    "blue_blob": ("tuned", "blob", 2, principled([0.02, 0.03, 0.12], 0.4)),
    "brown_relief": ("tuned", "relief", 3, rough([0.08, 0.04, 0.015], 0.15)),
    "grey_blob": ("tuned", "blob", 4, rough([0.05, 0.05, 0.05], 0.2)),
    "yellow_sphere": ("tuned", "sphere", 5, rough([0.75, 0.55, 0.08], 0.2)),
    "white_relief": ("tuned", "relief", 6, principled([0.7, 0.7, 0.68], 0.35)),
    "green_blob": ("unseen", "blob", 11, rough([0.01, 0.05, 0.015], 0.25)),
    "violet_sphere": ("unseen", "sphere", 12, principled([0.06, 0.015, 0.09], 0.35)),
    "navy_relief": ("unseen", "relief", 13, rough([0.01, 0.02, 0.07], 0.3)),
    "crimson_blob": ("unseen", "blob", 14, rough([0.15, 0.005, 0.02], 0.12)),
    "slate_sphere": ("unseen", "sphere", 15, principled([0.06, 0.06, 0.065], 0.4)),
    "orange_blob": ("unseen", "blob", 16, principled([0.7, 0.3, 0.05], 0.45)),
    "plaster_relief": ("unseen", "relief", 17, matt([0.6, 0.58, 0.55])),
    "teal_relief": ("unseen", "relief", 18, principled([0.01, 0.06, 0.07], 0.25)),
}


def directions():
    """(LAMPS, 3) unit vectors, evenly spread over the cap (Fibonacci spiral)."""
    k = np.arange(LAMPS) + 0.5
    z = 1 - k / LAMPS * (1 - np.cos(np.radians(CONE)))
    angle = k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])


def narrow_cone():
    """Indices of the FEW lamps within NARROW degrees."""
    inside = np.flatnonzero(directions()[:, 2] > np.cos(np.radians(NARROW)))
    return inside[np.linspace(0, inside.size - 1, FEW).round().astype(int)]


def lamp_sets():
    """(name, indices): all lamps, and few of them."""
    every = np.arange(LAMPS)
    yield "all", every
    yield "24 spread", every[::4]
    yield "12 spread", every[np.linspace(0, LAMPS - 1, FEW).round().astype(int)]
    yield "12 narrow", narrow_cone()


def waves(points, seed, count, lowest, highest):
    """Sum of random plane waves at points (n, d), about unit variance."""
    random = np.random.default_rng(seed)
    vectors = random.normal(size=(count, points.shape[1]))
    lengths = np.geomspace(lowest, highest, count)
    vectors *= (lengths / np.linalg.norm(vectors, axis=1))[:, None]
    amplitudes = lengths**-1.2
    amplitudes *= np.sqrt(2 / np.sum(amplitudes**2))
    return np.cos(points @ vectors.T + random.uniform(0, 2 * np.pi, count)) @ amplitudes


def mesh_of(shape, seed):
    """A trimesh with smooth vertex normals inside the unit square."""
    import trimesh

    if shape == "relief":
        side = np.linspace(-1.1, 1.1, 401)
        x, y = np.meshgrid(side, side)
        z = 0.045 * waves(np.column_stack([x.ravel(), y.ravel()]), seed, 24, 4, 25)
        vertices = np.column_stack([x.ravel(), y.ravel(), z])
        n = side.size
        corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        faces = np.concatenate(
            [
                np.column_stack([corner, corner + 1, corner + n]),
                np.column_stack([corner + 1, corner + n + 1, corner + n]),
            ]
        )
        return trimesh.Trimesh(vertices, faces, process=False)
    ball = trimesh.creation.icosphere(subdivisions=6)
    amplitude, low, high = (0.03, 4, 14) if shape == "sphere" else (0.11, 2, 8)
    radius = 1 + amplitude * waves(ball.vertices, seed, 24, low, high)
    ball.vertices *= (0.92 * radius / radius.max())[:, None]
    return ball


def variant():
    """Mitsuba with its LLVM backend."""
    import mitsuba

    if "DRJIT_LIBLLVM_PATH" not in os.environ and (found := sorted(glob("/usr/lib/*/libLLVM*so*19*"))):
        os.environ["DRJIT_LIBLLVM_PATH"] = found[0]
    mitsuba.set_variant("llvm_ad_rgb")
    return mitsuba


def render(name, folder, samples):
    """Radiance relative to a white diffuser that faces the lamp (lights, rows, columns, 3), normals, mask: NAME.npz."""
    mi = variant()
    _, shape, seed, material = OBJECTS[name]
    ply = folder / f"{name}.ply"
    mesh = mesh_of(shape, seed)
    mesh.vertex_normals  # noqa: B018 computed, so that they are written
    mesh.export(ply, vertex_normal=True)
    camera = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "orthographic", "to_world": camera, "film": film},
            "lamp": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 1.0}},
            "object": {"type": "ply", "filename": str(ply), "bsdf": material},
        }
    )
    aov = mi.load_dict({"type": "aov", "aovs": "n:sh_normal,p:position"})
    channels = np.array(mi.render(scene, integrator=aov, spp=256, seed=1))
    normals = channels[..., :3]
    length = np.linalg.norm(normals, axis=-1)
    mask = length > 0.9  # object all over the pixel, and smooth in it
    normals = normals / np.maximum(length, 1e-9)[..., None]
    integrator = mi.load_dict({"type": "path", "max_depth": DEPTH})
    parameters = mi.traverse(scene)
    stack = []
    for j, (x, y, z) in enumerate(directions().tolist()):
        up = [0, 1, 0] if abs(y) < 0.9 else [1, 0, 0]
        parameters["lamp.to_world"] = mi.Transform4f().look_at(
            origin=mi.Point3f(x, y, z), target=mi.Point3f(0), up=mi.Vector3f(up)
        )
        parameters.update()
        stack.append(np.array(mi.render(scene, integrator=integrator, spp=samples, seed=100 + j)) * np.pi)
    ply.unlink()
    np.savez(folder / f"{name}.npz", stack=np.float32(stack), normals=np.float32(normals), mask=mask)


def photograph(radiance, seed):
    """12-bit photographs of radiances (..., channels): shot and read noise; values in the same unit, and validity."""
    random = np.random.default_rng(seed)
    full = np.percentile(radiance, 99.5)
    electrons = radiance / full * ELECTRONS
    electrons = electrons + random.normal(size=radiance.shape) * np.sqrt(np.maximum(electrons, 0) + READ_NOISE**2)
    codes = np.clip(np.round(electrons / ELECTRONS * FULL_SCALE), 0, FULL_SCALE)
    valid = (codes < FULL_SCALE).all(axis=-1) & (codes > 0).any(axis=-1)
    return np.float32(codes / FULL_SCALE * full), valid


def load(file, lamps):
    """Photographs (lights, 1, pixels, 3), directions, valid, true normals (1, pixels, 3) under the chosen lamps."""
    with np.load(file) as held:
        mask = held["mask"]
        samples, valid = photograph(held["stack"][:, mask], sum(map(ord, file.stem)))
        truth = held["normals"][mask]
    return np.ascontiguousarray(samples[lamps][:, None]), directions()[lamps], valid[lamps][:, None], truth[None]


def solved(samples, lights, valid, how):
    """Normals (1, pixels, 3) by one of METHODS."""
    from nishiki.photometric.body import body_intensity
    from nishiki.photometric.light_selection import select_diffuse
    from nishiki.photometric.solve import estimate_normals

    if how == "joint":
        return joint_fit(samples, lights, valid)
    mean = samples.mean(axis=-1)
    if how == "least_squares":
        return estimate_normals(mean, lights, valid=valid, solver="least_squares").normals
    usable = select_diffuse(mean, lights, valid=valid).usable
    intensity = {"mean": lambda: mean, "green": lambda: np.ascontiguousarray(samples[..., 1])}.get(
        how, lambda: body_intensity(samples, valid)
    )()
    return estimate_normals(intensity, lights, usable=usable, valid=valid).normals


def joint_fit(samples, lights, valid):
    """Normals (1, pixels, 3) as the stage makes them of few lamps: the default, then the joint fit if gloss counts."""
    from nishiki.photometric.body import body_intensity, diffuse_reflectance
    from nishiki.photometric.gloss import GlossTile, refine_normals
    from nishiki.photometric.gloss_scene import fit_scene_gloss
    from nishiki.photometric.light_selection import select_diffuse
    from nishiki.photometric.solve import estimate_normals

    usable = select_diffuse(samples.mean(axis=-1), lights, valid=valid).usable
    field = estimate_normals(body_intensity(samples, valid), lights, usable=usable, valid=valid)
    body = diffuse_reflectance(samples, lights, field.normals, usable=usable, shading=field.shading).reflectance
    part = slice(None, None, max(1, samples.shape[2] // JOINT_PIXELS))
    of_lights = samples[:, :, part], valid[:, :, part], lights
    tile = GlossTile(*of_lights, field.normals[:, part], field.flags[:, part], field.sigma[:, part], body[:, part])
    gloss = fit_scene_gloss([tile])
    if not gloss.significant:
        return field.normals
    start = {"normals": field.normals, "flags": field.flags, "reflectance": body}
    return refine_normals(samples, lights, gloss=gloss.profile, valid=valid, **start).normals


METHODS = ("least_squares", "green", "mean", "default", "joint")


def main():
    """Every method on every object under all lamps and under few."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS))
    parser.add_argument("--samples", type=int, default=64, help="paths a pixel, where an object is rendered")
    arguments = parser.parse_args()
    from nishiki.photometric.flags import FEW_LIGHTS

    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name in arguments.objects:
        file = arguments.folder / f"{name}.npz"
        if not file.exists():
            render(name, arguments.folder, arguments.samples)
        for lamp_set, lamps in lamp_sets():
            samples, lights, valid, truth = load(file, lamps)
            for how in METHODS if len(lamps) <= FEW_LIGHTS else METHODS[:-1]:
                solved(samples[:, :, :64], lights, valid[:, :, :64], how)  # compiles
                start = time.process_time()
                found = solved(samples, lights, valid, how)
                seconds = time.process_time() - start
                error = np.degrees(np.arccos(np.clip(np.sum(found * truth, axis=-1, dtype=np.float64), -1, 1)))
                line = {"object": name, "kind": OBJECTS[name][0], "lights": lamp_set, "method": how}
                line |= {"mean_deg": round(float(error.mean()), 3), "median_deg": round(float(np.median(error)), 3)}
                line |= {"cpu_us_per_pixel": round(1e6 * seconds / truth.shape[1], 2), "pixels": truth.shape[1]}
                print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
