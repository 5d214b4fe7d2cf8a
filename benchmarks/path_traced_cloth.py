"""Cloths of elliptical yarns, path-traced by Mitsuba: reflectances whose weave and yarns are known exactly.

    python benchmarks/path_traced_cloth.py FOLDER [--cloths NAME ...] [--rays 2000]

Yarns are closed tubes of elliptical section, swept along smooth ways over and under each other, each yarn a little
different. Their surface is an anisotropic rough dielectric over a dyed body, or a translucent wall that lets part of
the light through the yarn. Light is traced with all interreflection; no code of this project takes part in what is
measured. Of each cloth FOLDER gets NAME, a goniometer's capture with a table of reflectances (540 views of one quarter
of the hemisphere with the light along the normal, 360 views of the whole hemisphere for each of 15 oblique lights,
`weave: unknown`), and NAME-truth.json with the numbers of the weave. CLOTHS says whether methods were tuned on a cloth
("tuned") or not ("unseen").
"""

import argparse
import json
import os
import sys
from dataclasses import asdict, dataclass
from glob import glob
from math import gcd
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.simulate.cloth.settings import hemisphere_views, quarter_views, session

AROUND, ALONG = 32, 12  # vertices round a section, and along the yarn from crossing to crossing
MARGIN = 2.5  # mm of cloth around the part that is looked at: grazing rays go far
DEPTH = 8  # of the paths


@dataclass(frozen=True)
class Yarn:
    """Spacing and axes of the section in mm (width over spacing: fill; thickness over width: aspect), roughness."""

    spacing: float
    fill: float
    aspect: float
    along: float
    across: float

    @property
    def half_width(self) -> float:
        """Half of the wider axis, mm."""
        return 0.5 * self.fill * self.spacing


@dataclass(frozen=True)
class Cloth:
    """harness, step, under, together of the binding: a warp yarn lies below `under` of `harness` weft yarns, the place
    moves on by `step` after every `together` warp yarns. dye: albedo of the body, at most 0.5; through: share of the
    body's light that passes the wall of a yarn; irregular: how much yarns differ (1: 4 % in their axes); power: of the
    section |x/a|^power + |z/b|^power = 1 (2: an ellipse, more: flattened)."""

    use: str
    weave: str
    harness: int
    step: int
    warp: Yarn
    weft: Yarn
    dye: tuple[float, float, float]
    warp_crimp: float = 0.35
    smooth: float = 1.3
    arch: float = 0.06
    through: float = 0.0
    irregular: float = 1.0
    seed: int = 1
    under: int = 1
    together: int = 1
    power: float = 2.0


CLOTHS = {
    "satin-5": Cloth("tuned", "satin", 5, 2, Yarn(0.11, 0.95, 0.52, 0.10, 0.27), Yarn(0.14, 0.9, 0.5, 0.13, 0.3),
                     (0.02, 0.02, 0.025), seed=1),
    "twill-4": Cloth("tuned", "twill", 4, 1, Yarn(0.13, 0.93, 0.62, 0.14, 0.32), Yarn(0.15, 0.9, 0.6, 0.15, 0.32),
                     (0.05, 0.08, 0.26), 0.45, seed=2),
    "plain": Cloth("tuned", "plain", 2, 1, Yarn(0.16, 0.85, 0.5, 0.14, 0.3), Yarn(0.17, 0.85, 0.5, 0.14, 0.3),
                   (0.3, 0.2, 0.1), 0.5, seed=3),
    "satin-8": Cloth("unseen", "satin", 8, 3, Yarn(0.09, 0.97, 0.6, 0.09, 0.25), Yarn(0.11, 0.92, 0.55, 0.12, 0.28),
                     (0.36, 0.05, 0.06), 0.3, 1.4, seed=11),
    "twill-3": Cloth("unseen", "twill", 3, 1, Yarn(0.12, 0.94, 0.7, 0.12, 0.3), Yarn(0.12, 0.92, 0.6, 0.14, 0.32),
                     (0.03, 0.03, 0.03), 0.5, seed=12),
    "satin-5-translucent": Cloth("unseen", "satin", 5, 3, Yarn(0.10, 0.94, 0.45, 0.15, 0.33),
                                 Yarn(0.13, 0.9, 0.5, 0.17, 0.35), (0.49, 0.45, 0.37), through=0.3, seed=13),
    "twill-2-2": Cloth("tuned", "twill", 4, 1, Yarn(0.12, 0.92, 0.6, 0.13, 0.3), Yarn(0.14, 0.9, 0.55, 0.14, 0.3),
                       (0.06, 0.04, 0.03), 0.5, seed=21, under=2),
    "twill-1-2": Cloth("tuned", "twill", 3, 1, Yarn(0.14, 0.88, 0.5, 0.14, 0.3), Yarn(0.12, 0.94, 0.55, 0.11, 0.28),
                       (0.03, 0.05, 0.04), 0.6, seed=22, under=2),
    "basket": Cloth("tuned", "basket", 4, 2, Yarn(0.14, 0.9, 0.55, 0.14, 0.3), Yarn(0.15, 0.9, 0.55, 0.14, 0.3),
                    (0.12, 0.1, 0.05), 0.5, seed=23, under=2, together=2),
    "flattened": Cloth("tuned", "satin", 5, 2, Yarn(0.11, 0.95, 0.45, 0.11, 0.26), Yarn(0.14, 0.92, 0.4, 0.13, 0.3),
                       (0.04, 0.02, 0.02), 0.35, seed=24, power=2.6),
    "twill-3-3": Cloth("unseen", "twill", 6, 1, Yarn(0.12, 0.93, 0.55, 0.12, 0.29), Yarn(0.13, 0.92, 0.55, 0.13, 0.3),
                       (0.02, 0.04, 0.09), 0.45, seed=31, under=3),
    "satin-1-4": Cloth("unseen", "satin", 5, 2, Yarn(0.13, 0.9, 0.5, 0.14, 0.3), Yarn(0.11, 0.95, 0.5, 0.1, 0.27),
                       (0.1, 0.02, 0.02), 0.6, seed=32, under=4),
    "twill-2-2-flat": Cloth("unseen", "twill", 4, 1, Yarn(0.13, 0.93, 0.5, 0.13, 0.3),
                            Yarn(0.15, 0.91, 0.5, 0.15, 0.32), (0.04, 0.04, 0.05), 0.45, seed=33, under=2, power=2.5),
}  # fmt: skip


def pattern_of(cloth: Cloth) -> np.ndarray:
    """Mark where the warp lies on top: (harness, warp yarns of a repeat) bool, row = weft yarn, column = warp yarn."""
    side = cloth.harness // gcd(cloth.harness, cloth.step) * cloth.together
    row, column = np.arange(cloth.harness)[:, None], np.arange(side)
    return (row - cloth.step * (column // cloth.together)) % cloth.harness >= cloth.under


def way(up: np.ndarray, spacing: float, amplitude: float, smooth: float, arch: float) -> np.ndarray:
    """Height (crossings * ALONG,) of a yarn's middle: its sides smoothed by a raised cosine, floats a little arched.

    up: (crossings,) whether it lies on top. amplitude: height above the middle where it crosses another yarn.
    """
    fine = ALONG
    side = np.repeat(np.where(up, 1.0, -1.0), fine)
    width = smooth * fine
    offset = np.arange(-int(width), int(width) + 1)
    kernel = np.where(np.abs(offset) < 0.5 * width, 1 + np.cos(2 * np.pi * offset / width), 0.0)
    kernel /= kernel.sum()
    padded = np.pad(side, 4 * fine, mode="wrap")
    soft = np.convolve(padded, kernel, mode="same")[4 * fine : -4 * fine]
    middles = soft.reshape(-1, fine)[:, fine // 2]
    low, high = middles.min(), middles.max()
    height = amplitude * (2 * (soft - low) / (high - low) - 1) if high > low else amplitude * soft
    wide = np.where(np.abs(np.arange(-8 * fine, 8 * fine + 1)) < 3 * fine, 1.0, 0.0)
    broad = np.convolve(np.pad(soft, 8 * fine, mode="wrap"), wide / wide.sum(), mode="same")[8 * fine : -8 * fine]
    return height + arch * spacing * (broad - broad.mean())


def tubes(cloth: Cloth, system: str, random) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(vertices, triangles, texture coordinates) of every yarn of one system in a cell of `cell_of`, lengths in mm."""
    repeats = repeats_of(cloth)
    pattern = np.tile(pattern_of(cloth), (repeats, repeats))
    own, other = (cloth.warp, cloth.weft) if system == "warp" else (cloth.weft, cloth.warp)
    up = pattern.T if system == "warp" else ~pattern
    share = cloth.warp_crimp if system == "warp" else 1 - cloth.warp_crimp
    touch = own.half_width * own.aspect + other.half_width * other.aspect
    out = []
    for number, row in enumerate(up):
        scatter = 1 + 0.04 * cloth.irregular * random.normal(size=3)
        height = way(row, other.spacing, share * touch * scatter[0], cloth.smooth, cloth.arch)
        count = len(height)
        wander = sum(
            random.normal() * np.cos(2 * np.pi * k * np.arange(count) / count + random.uniform(0, 7)) for k in (1, 2)
        )
        aside = (number + 0.5) * own.spacing + 0.015 * cloth.irregular * own.spacing * wander
        place = np.arange(count) * (other.spacing / ALONG)
        slope = (np.roll(height, -1) - np.roll(height, 1)) / (2 * other.spacing / ALONG)
        slope, height, place, aside = (np.append(v, v[0]) for v in (slope, height, place, aside))
        place[-1] = count * other.spacing / ALONG
        turn = np.linspace(0, 2 * np.pi, AROUND + 1)
        a, b = own.half_width * scatter[1], own.half_width * own.aspect * scatter[2]
        tilt = 1 / np.sqrt(1 + slope**2)
        wide, thick = (np.copysign(np.abs(f(turn)) ** (2 / cloth.power), f(turn)) for f in (np.cos, np.sin))
        across = aside[:, None] + a * wide
        along = place[:, None] - (slope * tilt)[:, None] * b * thick
        up_z = height[:, None] + tilt[:, None] * b * thick
        x, y = (across, along) if system == "warp" else (along, across)
        vertices = np.stack([x, y, up_z], axis=-1).reshape(-1, 3)
        u, v = np.broadcast_arrays(place[:, None], turn * own.half_width)
        first = (np.arange(count)[:, None] * (AROUND + 1) + np.arange(AROUND)).ravel()
        quads = first, first + 1, first + AROUND + 2, first + AROUND + 1
        faces = np.concatenate(
            [np.stack([quads[0], quads[1], quads[2]], 1), np.stack([quads[0], quads[2], quads[3]], 1)]
        )
        faces = faces if system == "weft" else faces[:, ::-1]  # their normals point away from the yarn
        out.append((vertices, faces, np.stack([u, v], axis=-1).reshape(-1, 2)))
    return out


def repeats_of(cloth: Cloth) -> int:
    """Repeats of the weave in the irregular cell."""
    return max(8 // cloth.harness, 1)


def cell_of(cloth: Cloth) -> np.ndarray:
    """Extent of the irregular cell along weft and warp, mm."""
    rows, columns = pattern_of(cloth).shape
    return repeats_of(cloth) * np.array([columns * cloth.warp.spacing, rows * cloth.weft.spacing])


def joined(parts) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One mesh of several."""
    starts = np.cumsum([0, *(len(v) for v, _, _ in parts)])
    return (
        np.concatenate([v for v, _, _ in parts]),
        np.concatenate([f + start for (_, f, _), start in zip(parts, starts, strict=False)]),
        np.concatenate([t for _, _, t in parts]),
    )


def material(cloth: Cloth, yarn: Yarn) -> dict:
    """A Mitsuba material: x of its frame along the yarn."""
    gloss = {
        "type": "roughconductor",
        "distribution": "beckmann",
        "alpha_u": yarn.along,
        "alpha_v": yarn.across,
        "eta": 1.56,
        "k": 0.0,
        "specular_reflectance": {"type": "uniform", "value": 2.0},
    }
    colour = {"type": "rgb", "value": [2 * v for v in cloth.dye]}
    if cloth.through:
        body = {"type": "principledthin", "base_color": colour, "diff_trans": 2 * cloth.through, "eta": 1.5}
        return {"type": "blendbsdf", "weight": 0.5, "gloss": gloss, "body": body}
    body = {"type": "diffuse", "reflectance": colour}
    return {"type": "twosided", "bsdf": {"type": "blendbsdf", "weight": 0.5, "gloss": gloss, "body": body}}


def mesh_of(mi, name: str, part, normals: np.ndarray, bsdf: dict):
    """A Mitsuba mesh with smooth normals and texture coordinates."""
    vertices, faces, uv = part
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=props)
    values = mi.traverse(mesh)
    values["vertex_positions"] = vertices.astype(np.float32).ravel()
    values["vertex_normals"] = normals.astype(np.float32).ravel()
    values["vertex_texcoords"] = uv.astype(np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    values.update()
    return mesh


def normals_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (n, 3) at the vertices, seams of the tubes joined."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    key = np.round(vertices, 7)
    _, which = np.unique(key, axis=0, return_inverse=True)
    which = which.reshape(-1)
    sums = np.zeros((which.max() + 1, 3))
    for k in range(3):
        np.add.at(sums, which[faces[:, k]], face)
    normals = sums[which]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def scene_of(mi, cloth: Cloth):
    """The cloth, copies of one cell around the origin, with one light at infinity that is moved later."""
    random = np.random.default_rng(cloth.seed)
    parts = {system: joined(tubes(cloth, system, random)) for system in ("warp", "weft")}
    cell = cell_of(cloth)
    count = np.ceil(MARGIN / cell).astype(int)
    places = [np.array([i, j, 0]) * [*cell, 0.0] for i in range(-count[0], count[0] + 1)
              for j in range(-count[1], count[1] + 1)]  # fmt: skip
    scene = {
        "type": "scene",
        "lamp": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "uniform", "value": 1.0}},
    }
    for system, (vertices, faces, uv) in parts.items():
        sheet = joined([(vertices + place, faces, uv) for place in places])
        normals = np.tile(normals_of(vertices, faces), (len(places), 1))
        scene[system] = mesh_of(mi, system, sheet, normals, material(cloth, getattr(cloth, system)))
    return mi.load_dict(scene), parts


def unit(theta_deg: float, phi_deg: float) -> np.ndarray:
    """A direction away from the cloth."""
    theta, phi = np.radians([theta_deg, phi_deg])
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def turn_lamp(mi, scene, incident: np.ndarray) -> None:
    """Let the light come from a direction."""
    values = mi.traverse(scene)
    up = [0, 1, 0] if abs(incident[1]) < 0.9 else [1, 0, 0]
    frame = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=(-incident).tolist(), up=up)
    values["lamp.to_world"] = mi.Transform4f(frame)
    values.update()


def radiances(mi, scene, cloth: Cloth, top: float, outgoing: np.ndarray, rays: int, seed: int) -> np.ndarray:
    """(views, 3) mean radiance towards the directions (views, 3) under a lamp of irradiance 1 on a facing plane."""
    import drjit as dr

    integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "rr_depth": 100})
    cell = cell_of(cloth)
    batch = max(1, 2_000_000 // rays)
    out = []
    for first in range(0, len(outgoing), batch):
        views = outgoing[first : first + batch]
        total = rays * len(views)
        # Roberts' sequence over the cell, shifted at random for each view
        random = np.random.default_rng([seed, first])
        index = np.arange(rays)[:, None] * np.array([0.7548776662466927, 0.5698402909980532])
        places = (index[None] + random.uniform(size=(len(views), 1, 2))) % 1.0 * cell
        origin = np.concatenate([places, np.full((len(views), rays, 1), top)], axis=-1)
        direction = np.repeat(-views[:, None], rays, axis=1)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed + first, total)
        ray = mi.RayDifferential3f(
            mi.Ray3f(mi.Point3f(*origin.reshape(-1, 3).T.astype(np.float32)),
                     mi.Vector3f(*direction.reshape(-1, 3).T.astype(np.float32)))
        )  # fmt: skip
        values, _, _ = integrator.sample(scene, sampler, ray)
        values = np.array(mi.TensorXf(dr.ravel(values), (total, 3)))
        out.append(np.nan_to_num(values).reshape(len(views), rays, 3).mean(axis=1))
    return np.concatenate(out)


def truth_of(parts, cloth: Cloth) -> dict:
    """Numbers of the weave as it lies: slopes of the surface that is seen from above, weft's share, heights."""
    cell = cell_of(cloth)
    kinds, pieces = [], []
    for system, (vertices, faces, _) in parts.items():
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                pieces.append(
                    (vertices + np.array([i * cell[0], j * cell[1], 0.0]), faces, np.zeros((len(vertices), 2)))
                )
                kinds += [system == "weft"] * len(faces)
    vertices, faces, _ = joined(pieces)
    normals, heights, weft = from_above(vertices, faces, np.array(kinds), cell)
    found = {key: getattr(cloth, key) for key in ("weave", "harness", "step", "under", "together", "use")}
    for axis, plane in enumerate(("weft", "warp")):
        angle = np.degrees(np.arctan2(np.abs(normals[:, axis]), normals[:, 2]))
        found[f"mean_slope_{plane}_deg"] = float(angle.mean())
        found[f"p90_slope_{plane}_deg"] = float(np.percentile(angle, 90))
    found["weft_share"] = float(weft.mean())
    found["aspect_warp"], found["aspect_weft"] = cloth.warp.aspect, cloth.weft.aspect
    found["relief"] = float((np.percentile(heights, 95) - np.percentile(heights, 5)) / cloth.warp.spacing)
    found["spacing_ratio"] = cloth.weft.spacing / cloth.warp.spacing
    return found | {"cloth": asdict(cloth)}


def from_above(vertices, faces, kinds, cell, side: int = 900):
    """Normals (n, 3), heights (n,) and weft (n,) of the highest surface on a regular grid over the cell."""
    step = cell / side
    height = np.full((side, side), -np.inf)
    owner = np.full((side, side), -1)
    corners = vertices[faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-30)
    upwards = np.flatnonzero(face[:, 2] > 1e-6)
    for k in upwards:
        low = np.maximum(np.ceil(corners[k, :, :2].min(axis=0) / step - 0.5).astype(int), 0)
        high = np.minimum(np.floor(corners[k, :, :2].max(axis=0) / step - 0.5).astype(int), side - 1)
        if (low > high).any():
            continue
        x, y = np.meshgrid(*((np.arange(low[a], high[a] + 1) + 0.5) * step[a] for a in (0, 1)), indexing="ij")
        inside = np.ones(x.shape, bool)
        for c in range(3):
            p, q = corners[k, c], corners[k, (c + 1) % 3]
            inside &= (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) >= -1e-15
        n = face[k]
        z = corners[k, 0, 2] - (n[0] * (x - corners[k, 0, 0]) + n[1] * (y - corners[k, 0, 1])) / n[2]
        block = (slice(low[0], high[0] + 1), slice(low[1], high[1] + 1))
        better = inside & (z > height[block])
        height[block] = np.where(better, z, height[block])
        owner[block] = np.where(better, k, owner[block])
    seen = owner >= 0
    return face[owner[seen]], height[seen], kinds[owner[seen]]


def measure(mi, name: str, folder: Path, rays: int) -> None:
    """One capture with its truth."""
    cloth = CLOTHS[name]
    angles = session(quarter_views(), hemisphere_views())
    incident = np.array([unit(*row) for row in angles[:, :2]])
    outgoing = np.array([unit(*row) for row in angles[:, 2:]])
    values = np.empty((len(angles), 3))
    lamps, which = np.unique(angles[:, :2], axis=0, return_inverse=True)
    which = which.reshape(-1)
    scene, parts = scene_of(mi, cloth)
    top = max(float(vertices[:, 2].max()) for vertices, _, _ in parts.values()) + 1e-3
    for number, lamp in enumerate(lamps):
        rows = np.flatnonzero(which == number)
        turn_lamp(mi, scene, unit(*lamp))
        light = radiances(mi, scene, cloth, top, outgoing[rows], rays, 1000 * number + cloth.seed)
        values[rows] = light / incident[rows[0], 2]
        print(f"\r{name}: light {number + 1} of {len(lamps)}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    target = folder / name
    target.mkdir(parents=True, exist_ok=True)
    lines = ["theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,red,green,blue"]
    lines += [",".join(f"{v:.7g}" for v in [*a, *b]) for a, b in zip(angles, values, strict=True)]
    (target / "reflectances.csv").write_text("\n".join(lines) + "\n")
    (target / "capture.yaml").write_text(
        f"format: 1\ntitle: path-traced {name}\ngeometry: goniometer\n"
        "goniometer: {table: reflectances.csv, weave: unknown}\n"
    )
    (folder / f"{name}-truth.json").write_text(json.dumps(truth_of(parts, cloth), indent=1) + "\n")


def main() -> None:
    """Arguments in, captures out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cloths", nargs="+", default=list(CLOTHS), choices=list(CLOTHS))
    parser.add_argument("--rays", type=int, default=2000)
    arguments = parser.parse_args()
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", next(iter(glob("/usr/lib/x86_64-linux-gnu/libLLVM*.so*")), ""))
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    for name in arguments.cloths:
        measure(mi, name, arguments.folder, arguments.rays)


if __name__ == "__main__":
    main()
