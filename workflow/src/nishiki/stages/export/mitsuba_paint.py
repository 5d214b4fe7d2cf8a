"""A painting digitised by Nishiki, as a reflection model and a scene of Mitsuba 3; needs nothing of Nishiki.

    python nishiki_paint.py --elevation 45 --azimuth 90 --output picture.exr

or, in a program of your own, after mi.set_variant(...):

    import nishiki_paint
    scene = nishiki_paint.load(lights=[(0.5, 0.5, 0.7)])
    picture = mi.render(scene)

A picture's value is relative to a perfect white diffuser that faces a lamp of strength 1. For unit vectors n (normal of
the texture), l, v and h with c = n.l, r = n.v:

    value = c f T(c) T(r) albedo + sum_k beta_k D_k F G / r,     f = max(a + b c + d (n.h)^8 + e_x l_x + e_y l_y, 0)
    D = s^2 / sqrt(det(s^2 + C)) exp(-u'(s^2 + C)^-1 u / 2),  s = gamma / sqrt(2 ln 2)
    F: Fresnel, exact;  G = min(1, 2 (n.h) min(c, r) / v.h);  T(x) = 1 + t ((1 - F(x)) / (1 - F(1)) - 1)

u is the slope of n less that of h, C the covariance of the slopes inside a texel, both scaled so that u is as long as
the angle phi of n and h: without slopes, D = exp(-ln 2 (phi / gamma)^2). beta, gamma and the index of refraction are
those of the texel's region.

S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, eq. 10 to 13; the body's
factor f, its losses at the surface T and the slopes as on Nishiki's page of the stage render.
"""

import argparse
import json
import math
from pathlib import Path

NAME = "nishiki_paint"
TEXTURES = ("albedo", "normals", "shading", "directional", "slopes", "regions")


def define():
    """Register the reflection model with the active variant of Mitsuba, an RGB one."""
    import drjit as dr
    import mitsuba as mi

    if not mi.is_rgb:
        raise RuntimeError(f"{NAME} has colours in RGB, not {mi.variant()}. Remedy: scalar_rgb or llvm_ad_rgb")

    class Paint(mi.BSDF):
        """Reflection model from regions and losses of scene.json, as text, and raw textures, some optional."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.textures = {name: props[name] for name in TEXTURES if name in props}
            self.regions = json.loads(props["gloss"])["regions"]
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.SpatiallyVarying
            self.m_flags, self.m_components = flags, [flags]

        def texel(self, name, si, active):
            return self.textures[name].eval_3(si, active) if name in self.textures else mi.Color3f(0)

        def take_region(self, region, values):
            """Return the value of a texel's region."""
            chosen = mi.Float(values[0])
            for number, value in enumerate(values[1:], 1):
                chosen = dr.select(region > number - 0.5, value, chosen)
            return chosen

        def fresnel(self, cosine, index):
            contrast = index * index - 1
            s = dr.sqrt(contrast + cosine * cosine) + cosine
            d = contrast / s
            parallel = (cosine * s - 1) / (cosine * d + 1)
            return 0.5 * (d / s) ** 2 * (1 + parallel * parallel)

        def transmit(self, cosine, index, transmission):
            straight = 1 - ((index - 1) / (index + 1)) ** 2
            return 1 + transmission * ((1 - self.fresnel(cosine, index)) / straight - 1)

        def body(self, si, light, c, along, active):
            a, b, d = self.texel("shading", si, active)
            x, y, _ = self.texel("directional", si, active)
            return dr.maximum(a + b * c + d * dr.maximum(along, 0) ** 8 + x * light.x + y * light.y, 0)

        def lobes(self, si, normal, half, region, active):
            """Sum beta D over the lobes."""
            phi = dr.atan2(dr.norm(dr.cross(normal, half)), dr.dot(normal, half))
            nz, hz = dr.maximum(normal.z, 0.2), dr.maximum(half.z, 1e-3)
            x, y = normal.x / nz - half.x / hz, normal.y / nz - half.y / hz
            square = x * x + y * y
            scale = dr.select(square > 1e-8, phi * phi / dr.maximum(square, 1e-8), nz**3)
            xx, xy, yy = self.texel("slopes", si, active)
            total = mi.Float(0)
            for lobe in range(len(self.regions[0]["beta"])):
                beta, gamma = (
                    self.take_region(region, [each[name][lobe] for each in self.regions]) for name in ("beta", "gamma")
                )
                narrow = gamma * gamma / (2 * math.log(2))
                a, b, c = narrow + scale * xx, scale * xy, narrow + scale * yy
                inverse = 1 / (a * c - b * b)
                exponent = 0.5 * scale * (c * x * x - 2 * b * x * y + a * y * y) * inverse
                total += beta * narrow * dr.sqrt(inverse) * dr.exp(-exponent)
            return total

        def eval(self, ctx, si, wo, active=True):
            normal = mi.Vector3f(self.texel("normals", si, active))
            light, view = si.to_world(wo), si.to_world(si.wi)
            half = dr.normalize(light + view)
            c, r, q = dr.dot(normal, light), dr.dot(normal, view), dr.dot(view, half)
            along = dr.dot(normal, half)
            lit = active & (c > 0) & (si.wi.z > 0) & (wo.z > 0) & (dr.squared_norm(normal) > 0.5)
            faces_the_view = r > 0  # others show their body without gloss
            c, r, q = (dr.maximum(each, 1e-6) for each in (c, r, q))
            region = self.textures["regions"].eval_1(si, active) if "regions" in self.textures else 0
            index, loss = (
                self.take_region(region, [each[name] for each in self.regions]) for name in ("index", "transmission")
            )
            passed = self.transmit(c, index, loss) * self.transmit(r, index, loss)
            body = c * self.body(si, light, c, along, active) * passed
            masked = dr.minimum(1 / r, 2 * dr.maximum(along, 0) * dr.minimum(c / r, 1) / q)
            gloss = self.lobes(si, normal, half, region, active) * self.fresnel(q, index) * masked
            gloss = dr.select(faces_the_view, gloss, 0)
            metal = index > 1e3  # mirrors in its colour, without a body
            body, gloss = dr.select(metal, gloss, body), dr.select(metal, 0, gloss)
            value = (mi.Color3f(self.texel("albedo", si, active)) * body + mi.Color3f(gloss)) / math.pi
            return dr.select(lit, dr.maximum(value, 0), mi.Color3f(0))  # colours outside of sRGB

        def pdf(self, ctx, si, wo, active=True):
            return dr.select(active & (si.wi.z > 0) & (wo.z > 0), mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            sampled = mi.BSDFSample3f()
            sampled.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            sampled.pdf = mi.warp.square_to_cosine_hemisphere_pdf(sampled.wo)
            sampled.eta, sampled.sampled_component = 1.0, 0
            sampled.sampled_type = mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
            usable = active & (si.wi.z > 0) & (sampled.pdf > 0)
            weight = self.eval(ctx, si, sampled.wo, usable) / dr.maximum(sampled.pdf, 1e-12)
            return sampled, dr.select(usable, weight, mi.Color3f(0))

        def to_string(self):
            return NAME

    mi.register_bsdf(NAME, lambda props: Paint(props))


def description(lights, *, relief=None, columns=None, samples=16, folder=None):
    """Describe the scene as Mitsuba's dictionary.

    lights: unit vectors towards distant lamps of strength 1; relief: the height is geometry and casts shadows, else the
    picture is flat, by default where the directional terms of the body already hold the shadows; columns: width of the
    picture, by default that of the textures.
    """
    import mitsuba as mi

    folder = Path(folder or Path(__file__).parent)
    facts = json.loads((folder / "scene.json").read_text())
    wide = facts["width"]
    to_world = mi.ScalarTransform4f()
    mesh = "relief.ply" if (facts["shadows"] if relief is None else relief) else "flat.ply"
    shape = {"type": "ply", "filename": str(folder / mesh), "face_normals": True}
    bsdf = {"type": NAME, "gloss": json.dumps(facts["gloss"])}
    for name in facts["textures"]:
        bsdf[name] = {
            **{"type": "bitmap", "filename": str(folder / f"{name}.exr"), "raw": True},
            **{"filter_type": "nearest", "wrap_mode": "clamp"},
        }
    columns = columns or facts["columns"]
    above = 2 * max(wide, facts["height"])
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "painting": {**shape, "bsdf": bsdf},
        "sensor": {
            "type": "orthographic",
            "to_world": to_world.look_at(origin=[0, 0, above], target=[0, 0, 0], up=[0, 1, 0])
            @ to_world.scale([wide / 2, wide / 2, 1]),
            "near_clip": 0.01 * above,
            "far_clip": 2 * above,
            "film": {
                **{"type": "hdrfilm", "width": columns, "height": round(columns * facts["rows"] / facts["columns"])},
                **{"rfilter": {"type": "box"}, "component_format": "float32", "pixel_format": "rgb"},
            },
            "sampler": {"type": "independent", "sample_count": samples},
        },
    }
    for number, (x, y, z) in enumerate(lights):
        scene[f"lamp_{number}"] = {
            **{"type": "directional", "direction": [-x, -y, -z]},
            "irradiance": {"type": "rgb", "value": [math.pi] * 3},
        }
    return scene


def load(lights, **changes):
    """Load the scene in the active variant; see `description`."""
    import mitsuba as mi

    define()
    return mi.load_dict(description(lights, **changes))


def main():
    """Render one picture under one lamp."""
    import mitsuba as mi

    parser = argparse.ArgumentParser(description="Render the painting under one distant lamp.")
    parser.add_argument("--elevation", type=float, default=45, help="degrees above the plane of the painting")
    parser.add_argument("--azimuth", type=float, default=90, help="degrees, 0: right, 90: top")
    parser.add_argument("--variant", default="scalar_rgb", help="of Mitsuba, for RGB; llvm_ad_rgb is faster")
    parser.add_argument("--columns", type=int, help="width of the picture in pixels")
    parser.add_argument("--samples", type=int, default=16, help="a pixel")
    parser.add_argument("--flat", action="store_true", help="without the relief's cast shadows")
    parser.add_argument("--output", default="picture.exr", help=".exr (linear) or .png")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    elevation, azimuth = math.radians(options.elevation), math.radians(options.azimuth)
    across = math.cos(elevation)
    lamp = (across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation))
    relief = False if options.flat else None
    scene = load([lamp], relief=relief, columns=options.columns, samples=options.samples)
    mi.util.write_bitmap(options.output, mi.render(scene))


if __name__ == "__main__":
    main()
