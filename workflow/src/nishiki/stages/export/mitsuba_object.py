"""An object digitised by Nishiki, as a reflection model and a scene of Mitsuba 3; needs nothing of Nishiki.

    python nishiki_object.py --output picture.exr

or, in a program of your own, after mi.set_variant(...), a variant that ends in _rgb:

    import nishiki_object
    scene = nishiki_object.load(view="003")
    picture = mi.render(scene)

A picture's value is relative to a perfect white diffuser that faces a lamp of strength 1. For unit vectors n (of the
mesh's vertices, interpolated), l and v, and the angle a of n with the bisector of l and v:

    value = K_d n.l + K_s / max(n.v, 0.05) (1 + a^2 / (4 sigma^2))^-2,    0 where n.l <= 0; no gloss where n.v <= 0

D. Miyazaki, T. Shibata and K. Ikeuchi (2007), Wavelet-texture method: BTF compression by using Daubechies wavelet,
parametric reflection model, and circular polarizer, eq. 6 and 8.
"""

import argparse
import json
import math
from pathlib import Path

NAME = "nishiki_object"
LAMP = "nishiki_lamp"
GRAZING = 0.05
"""Least n.v in the gloss."""
LEAST_SIGMA = 1e-4
"""Least width of a lobe, radians."""


def define():
    """Register the reflection model with the active variant of Mitsuba."""
    import drjit as dr
    import mitsuba as mi

    class Object(mi.BSDF):
        """The model; textures `kd`, `ks` (three channels) and `sigma` (one, radians); `scale` multiplies `kd`."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.kd, self.ks, self.sigma = (props[name] for name in ("kd", "ks", "sigma"))
            self.scale = float(props["scale"])
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.SpatiallyVarying | sides
            self.m_flags, self.m_components = flags, [flags]

        def eval(self, ctx, si, wo, active=True):
            half = wo + si.wi
            length = dr.norm(half)
            half = dr.select(length > 1e-6, half / dr.maximum(length, 1e-6), mi.Vector3f(0, 0, 1))
            angle = dr.atan2(dr.norm(mi.Vector2f(half.x, half.y)), half.z)
            sigma = dr.maximum(self.sigma.eval_1(si, active), LEAST_SIGMA)
            lobe = dr.square(dr.rcp(1 + dr.square(0.5 * angle / sigma))) / dr.maximum(si.wi.z, GRAZING)
            lobe = dr.select(si.wi.z > 0, lobe, 0)
            body = mi.Color3f(self.kd.eval_3(si, active)) * (self.scale * wo.z)
            value = (body + mi.Color3f(self.ks.eval_3(si, active)) * lobe) / math.pi
            return dr.select(active & (wo.z > 0), value, mi.Color3f(0))

        def pdf(self, ctx, si, wo, active=True):
            return dr.select(active & (wo.z > 0), wo.z / math.pi, 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            sampled = mi.BSDFSample3f()
            sampled.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            sampled.pdf = mi.warp.square_to_cosine_hemisphere_pdf(sampled.wo)
            sampled.eta, sampled.sampled_component = 1.0, 0
            sampled.sampled_type = mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
            usable = active & (sampled.pdf > 0)
            weight = self.eval(ctx, si, sampled.wo, usable) / dr.maximum(sampled.pdf, 1e-12)
            return sampled, dr.select(usable, weight, mi.Color3f(0))

        def to_string(self):
            return NAME

    class Lamp(mi.Emitter):
        """A lamp at `position` without fall-off: the capture compensates it."""

        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.position, self.strength = mi.Point3f(props["position"]), mi.Color3f(props["strength"])
            self.m_flags = int(mi.EmitterFlags.DeltaPosition)
            self.m_needs_sample_3 = False

        def sample_direction(self, it, sample, active=True):
            found = mi.DirectionSample3f()
            found.p, found.n, found.uv, found.time = self.position, mi.Normal3f(0), mi.Point2f(0), it.time
            found.d = self.position - it.p
            found.dist = dr.norm(found.d)
            found.d /= found.dist
            found.pdf, found.delta, found.emitter = 1.0, True, getattr(mi, "EmitterPtr", lambda emitter: emitter)(self)
            return found, dr.select(active, self.strength, mi.Color3f(0))

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval_direction(self, it, ds, active=True):
            return dr.select(active, self.strength, mi.Color3f(0))

        def eval(self, si, active=True):
            return mi.Color3f(0)

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return LAMP

    mi.register_bsdf(NAME, lambda props: Object(props))
    mi.register_emitter(LAMP, lambda props: Lamp(props))


def facts_of(folder=None):
    """Read scene.json: views with their cameras and lamps, strength of the colours."""
    return json.loads((Path(folder or Path(__file__).parent) / "scene.json").read_text())


def lamp_of(lamp):
    """Return a lamp of scene.json as Mitsuba's dictionary."""
    value = [math.pi] * 3
    if lamp["kind"] == "directional":
        return {"type": "directional", "direction": lamp["direction"], "irradiance": {"type": "rgb", "value": value}}
    if lamp["kind"] == "around":
        return {"type": "constant", "radiance": {"type": "rgb", "value": lamp["radiance"]}}
    if lamp["falloff"]:
        value = [each * lamp["distance"] ** 2 for each in value]
        return {"type": "point", "position": lamp["position"], "intensity": {"type": "rgb", "value": value}}
    return {"type": LAMP, "position": lamp["position"], "strength": {"type": "rgb", "value": value}}


def description(*, view=None, light=None, body="colour", columns=None, samples=16, max_depth=2, folder=None):
    """Describe the scene as Mitsuba's dictionary.

    view, light: names in scene.json, by default the first; body: colour, what all photographs show of the albedo, or
    model, the smooth K_d of the fit; columns: width of the picture; max_depth: 2 for direct light, more for light from
    surface to surface.
    """
    import mitsuba as mi

    folder = Path(folder or Path(__file__).parent)
    facts = facts_of(folder)
    shown = facts["views"][view or next(iter(facts["views"]))]
    camera, lamps = shown["camera"], shown["lamps"]
    columns = columns or camera["columns"]
    rows = round(columns * camera["rows"] / camera["columns"])

    def texture(file, raw=True):
        return {
            **{"type": "bitmap", "filename": str(folder / file), "raw": raw},
            **{"filter_type": "bilinear", "wrap_mode": "clamp"},
        }

    kd = texture("colour.png", raw=False) if body == "colour" else texture("kd.exr")
    bsdf = {"type": NAME, "kd": kd, "ks": texture("ks.exr"), "sigma": texture("sigma.exr")}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth, "hide_emitters": True},
        "object": {
            **{"type": "ply", "filename": str(folder / "object.ply")},
            "bsdf": {**bsdf, "scale": facts["colour_scale"] if body == "colour" else 1.0},
        },
        "sensor": {
            **{"type": "perspective", "fov": camera["field_of_view_deg"], "fov_axis": "x"},
            "principal_point_offset_x": camera["principal_offset"][0],
            "principal_point_offset_y": camera["principal_offset"][1],
            "to_world": mi.ScalarTransform4f(camera["to_world"]),
            **{"near_clip": camera["near"], "far_clip": camera["far"]},
            "film": {
                **{"type": "hdrfilm", "width": columns, "height": rows, "rfilter": {"type": "box"}},
                **{"component_format": "float32", "pixel_format": "rgb"},
            },
            "sampler": {"type": "independent", "sample_count": samples},
        },
        "lamp": lamp_of(lamps[light or next(iter(lamps))]),
    }


def load(**changes):
    """Load the scene in the active variant; see `description`."""
    import mitsuba as mi

    define()
    return mi.load_dict(description(**changes))


def main():
    """Render one picture."""
    import mitsuba as mi

    facts = facts_of()
    views = facts["views"]
    lights = {name for shown in views.values() for name in shown["lamps"]}
    parser = argparse.ArgumentParser(description="Render the object as one of its photographs was taken.")
    parser.add_argument("--view", choices=views, metavar="VIEW", help=f"one of {', '.join(views)} (the first)")
    parser.add_argument("--light", choices=sorted(lights), metavar="LIGHT", help="of the capture (the first)")
    parser.add_argument("--variant", default="scalar_rgb", help="of Mitsuba; llvm_ad_rgb is faster")
    parser.add_argument("--columns", type=int, help="width of the picture in pixels")
    parser.add_argument("--samples", type=int, default=16, help="a pixel")
    parser.add_argument("--depth", type=int, default=2, help="2: direct light; more: light from surface to surface")
    parser.add_argument(
        "--body", choices=("colour", "model"), default="colour", help="model: the smooth K_d of the fit"
    )
    parser.add_argument("--output", default="picture.exr", help=".exr (linear) or .png")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    scene = load(
        view=options.view, light=options.light, body=options.body, columns=options.columns, samples=options.samples,
        max_depth=options.depth,
    )  # fmt: skip
    mi.util.write_bitmap(options.output, mi.render(scene))


if __name__ == "__main__":
    main()
