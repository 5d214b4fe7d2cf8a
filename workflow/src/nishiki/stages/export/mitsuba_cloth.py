"""A cloth digitised by Nishiki, as a reflection model and a scene of Mitsuba 3; needs NumPy and nothing of Nishiki.

    python nishiki_cloth.py --output picture.exr

or, in a program of your own, after mi.set_variant(...), a variant that ends in _rgb:

    import nishiki_cloth
    scene = nishiki_cloth.load()
    picture = mi.render(scene)

A picture's value is relative to a perfect white diffuser that faces a lamp of strength 1. The BRDF is a table over half
vector and difference of light and eye, in the frame weft, warp, normal (S. Rusinkiewicz, A new change of variables for
efficient BRDF representation, 1998):

    (u, v) = (p_x + p_y, p_x - p_y), p = h / (|h_x| + |h_y| + h_z): the half vector h
    ring   = t / t_max, t the angle between light and h, t_max the one at which light or eye meets the horizon
    turn   : azimuth of light minus eye about h, from the x axis as the shortest turn carries it from the normal to h

It holds sqrt(f i_z o_z), linear between nodes. Seen from behind, weft and normal are turned round. Normals that turn
away from the eye are bent back to it.
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np

NAME = "nishiki_cloth"
LEAST_COSINE = 0.02
"""Least cosine of the eye above the horizon; normals are bent to reach it."""


def define():
    """Register the reflection model with the active variant of Mitsuba."""
    import drjit as dr
    import mitsuba as mi

    class Cloth(mi.BSDF):
        """The model; `table`: file of the table; `weft`: texture of the direction of the weft, world coordinates."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.weft = props["weft"]
            with np.load(props["table"]) as stored:
                codes, self.edge = stored["codes"], float(stored["edge"])
                values = codes * np.float32(stored["largest"] / stored["steps"])
            self.sides, _, self.rings, self.turns, _ = codes.shape
            # One volume of three axes: v, u, and the rings of one turn after the other.
            volume = np.ascontiguousarray(values.transpose(3, 2, 0, 1, 4), np.float32)
            volume = volume.reshape(-1, self.sides, self.sides, 3)
            self.volume = mi.Texture3f(mi.TensorXf(volume), use_accel=False)
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.Anisotropic | mi.BSDFFlags.SpatiallyVarying | sides
            self.m_flags, self.m_components = flags, [flags]

        def root(self, i, o):
            """Compute sqrt(f i_z o_z) of directions above the horizon."""
            total, apart = i + o, i - o
            twice_cosine, twice_sine = dr.norm(total), dr.norm(apart)
            h = total / twice_cosine
            along = dr.select(twice_sine > 1e-6, apart / dr.maximum(twice_sine, 1e-6), mi.Vector3f(1, 0, 0))
            p = -1 / (1 + h.z)
            x = mi.Vector3f(1 + h.x * h.x * p, h.x * h.y * p, -h.x)
            y = mi.Vector3f(h.x * h.y * p, 1 + h.y * h.y * p, -h.y)
            turn = dr.atan2(dr.dot(along, y), dr.dot(along, x)) / (2 * math.pi)
            turn = (turn - dr.floor(turn)) * self.turns
            largest = dr.maximum(dr.atan2(h.z, dr.abs(along.z)), 1e-9)
            ring = dr.clip(dr.atan2(twice_sine, twice_cosine) / largest, 0, 1) * (self.rings - 1)
            size = dr.abs(h.x) + dr.abs(h.y) + dr.abs(h.z)
            u, v = (h.x + h.y) / size, (h.x - h.y) / size
            u, v = ((dr.clip(each / self.edge, -1, 1) + 1) / 2 * (self.sides - 1) for each in (u, v))
            first = dr.floor(turn)
            share, values = turn - first, []
            for number in (first, first + 1):
                number = dr.select(number >= self.turns, number - self.turns, number)
                place = (v + 0.5) / self.sides, (u + 0.5) / self.sides
                depth = (number * self.rings + ring + 0.5) / (self.turns * self.rings)
                values.append(mi.Color3f(*self.volume.eval(mi.Point3f(*place, depth))))
            return (1 - share) * values[0] + share * values[1]

        def eval(self, ctx, si, wo, active=True):
            light, eye = si.to_world(wo), si.to_world(si.wi)
            side = dr.select(dr.dot(si.n, eye) < 0, -1.0, 1.0)
            normal, weft = si.sh_frame.n * side, mi.Vector3f(self.weft.eval_3(si, active)) * side
            facing = dr.dot(normal, eye)
            bent = dr.normalize(normal + (LEAST_COSINE - facing) * eye)
            normal = dr.select(facing < LEAST_COSINE, bent, normal)
            weft = dr.normalize(weft - dr.dot(weft, normal) * normal)
            warp = dr.cross(normal, weft)
            i, o = (mi.Vector3f(dr.dot(weft, d), dr.dot(warp, d), dr.dot(normal, d)) for d in (light, eye))
            seen = active & (i.z > 0) & (o.z > 0) & (dr.dot(si.n, light) * side > 0)
            up = mi.Vector3f(0, 0, 1)
            root = self.root(dr.select(seen, i, up), dr.select(seen, o, up))
            return dr.select(seen, root * root / dr.maximum(o.z, 1e-6), mi.Color3f(0))

        def pdf(self, ctx, si, wo, active=True):
            cosine = dr.select(si.wi.z < 0, -wo.z, wo.z)
            return dr.select(active & (cosine > 0), cosine / math.pi, 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            sampled = mi.BSDFSample3f()
            sampled.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            sampled.pdf = mi.warp.square_to_cosine_hemisphere_pdf(sampled.wo)
            sampled.wo.z = dr.select(si.wi.z < 0, -sampled.wo.z, sampled.wo.z)
            sampled.eta, sampled.sampled_component = 1.0, 0
            sampled.sampled_type = mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
            usable = active & (sampled.pdf > 0)
            weight = self.eval(ctx, si, sampled.wo, usable) / dr.maximum(sampled.pdf, 1e-12)
            return sampled, dr.select(usable, weight, mi.Color3f(0))

        def to_string(self):
            return NAME

    mi.register_bsdf(NAME, lambda props: Cloth(props))


def disc(lamp, count):
    """Compute unit vectors towards `count` points of a lamp's disc, evenly spread; its middle where count is 1."""
    ahead = np.asarray(lamp["direction"])
    right = np.cross(ahead, (0, 1, 0) if abs(ahead[1]) < 0.9 else (1, 0, 0))
    right /= np.linalg.norm(right)
    number = np.arange(count)
    radius = math.tan(math.radians(lamp["radius_deg"])) * np.sqrt((number + 0.5) / count) * (count > 1)
    angle = 2.399963229728653 * number
    across = np.cos(angle)[:, None] * right + np.sin(angle)[:, None] * np.cross(ahead, right)
    points = ahead + radius[:, None] * across
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def description(*, columns=None, samples=64, points=1, room=False, max_depth=2, folder=None):
    """Describe the scene as Mitsuba's dictionary.

    columns: width of the picture; points: distant lamps that stand for the disc of each, more give softer shadows;
    room: even light from all around; max_depth: 2 for direct light, more for light from fold to fold.
    """
    import mitsuba as mi

    folder = Path(folder or Path(__file__).parent)
    facts = json.loads((folder / "scene.json").read_text())
    camera = facts["camera"]
    columns = columns or camera["columns"]
    rows = round(columns * camera["rows"] / camera["columns"])
    weft = {"type": "mesh_attribute", "name": "vertex_weft"}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth, "hide_emitters": True},
        "cloth": {
            **{"type": "ply", "filename": str(folder / "cloth.ply")},
            "bsdf": {"type": NAME, "table": str(folder / "brdf.npz"), "weft": weft},
        },
        "sensor": {
            "type": "perspective",
            "fov": camera["field_of_view_deg"],
            "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at(**{name: camera[name] for name in ("origin", "target", "up")}),
            "near_clip": 0.01 * camera["distance"],
            "far_clip": 100 * camera["distance"],
            "film": {
                **{"type": "hdrfilm", "width": columns, "height": rows, "rfilter": {"type": "box"}},
                **{"component_format": "float32", "pixel_format": "rgb"},
            },
            "sampler": {"type": "independent", "sample_count": samples},
        },
    }
    if facts["paper"] > 0:
        body = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [facts["paper"]] * 3}}
        scene["paper"] = {
            **{"type": "ply", "filename": str(folder / "paper.ply")},
            "bsdf": {"type": "twosided", "bsdf": body},
        }
    for name, lamp in facts["lamps"].items():
        for number, towards in enumerate(disc(lamp, points)):
            strength = [math.pi * value / points for value in lamp["colour"]]
            scene[f"lamp_{name}_{number}"] = {
                **{"type": "directional", "direction": (-towards).tolist()},
                "irradiance": {"type": "rgb", "value": strength},
            }
    if room:
        scene["room"] = {"type": "constant", "radiance": {"type": "rgb", "value": [facts["around"]] * 3}}
    return scene


def load(**changes):
    """Load the scene in the active variant; see `description`."""
    import mitsuba as mi

    define()
    return mi.load_dict(description(**changes))


def main():
    """Render one picture."""
    import mitsuba as mi

    parser = argparse.ArgumentParser(description="Render the draped cloth under its lamps.")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of Mitsuba, one that ends in _rgb")
    parser.add_argument("--columns", type=int, help="width of the picture in pixels")
    parser.add_argument("--samples", type=int, default=64, help="a pixel")
    parser.add_argument("--points", type=int, default=16, help="of each lamp's disc: soft shadows")
    parser.add_argument("--depth", type=int, default=4, help="2: direct light; more: light from fold to fold")
    parser.add_argument("--no-room", action="store_true", help="without the even light from all around")
    parser.add_argument("--output", default="picture.exr", help=".exr (linear) or .png")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    scene = load(
        columns=options.columns, samples=options.samples, points=options.points, room=not options.no_room,
        max_depth=options.depth,
    )  # fmt: skip
    mi.util.write_bitmap(options.output, mi.render(scene))


if __name__ == "__main__":
    main()
