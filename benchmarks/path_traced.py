"""Captures of paintings that Mitsuba has path-traced: light transport that no code of this project has made.

    python benchmarks/path_traced.py --output FOLDER [--paintings NAME ...] [--spectra FOLDER]

writes a capture FOLDER/NAME and its truth FOLDER/NAME-truth of each painting, as benchmarks/painting.py --data
FOLDER reads them. Paint is Mitsuba's rough plastic (Walter et al. 2007, microfacets; losses in and out of the surface,
reflection inside) or plain diffuse, over a mesh of brush strokes, knife strokes or canvas with four vertices a pixel
along each side; shadows and light from paint to paint are traced. Colours are Kubelka-Munk mixtures of measured
pigments; camera, lamp and pigments come from the measured tables in --spectra and stay there. PAINTINGS under "tuned"
may be looked at while a method is changed, those under "unseen" judge it.

Needs mitsuba, and libLLVM 19 named by DRJIT_LIBLLVM_PATH. Seconds a painting are printed, one JSON object a line.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

PROJECT = Path(__file__).resolve().parents[1]
sys.path[0] = str(PROJECT / "scripts")
sys.path[1:1] = [str(PROJECT / "workflow" / "src"), str(PROJECT / "tests")]

from brush_relief import PITCH_MM, VERTICES, noise, split, surface, vertex_normals  # noqa: E402
from measured_paints import FINE, WAVELENGTHS, camera_curves, lamp_power, palette  # noqa: E402

from nishiki.simulate.capture import TruthWriter, write_csv, write_image  # noqa: E402

BOARD = 0.96  # reflectance of the white board
WHITE_LEVEL, BITS, BLACK = 0.65, 12, 32  # share of full scale of a white facing the lamp; of the converter
FULL_WELL, READ_NOISE = 30_000.0, 6.0  # electrons
LLVM = ("libLLVM-19.so.1", "libLLVM-19.so", "libLLVM.so.19.1")
BARE, GOLD = (0.0, "none", 1.0), (0.2, "ggx", 0.0)


@dataclass(frozen=True)
class Painting:
    """What is painted and how it is taken; alpha: roughness of the interface, 0: no interface (plain diffuse)."""

    seed: int
    relief: str  # strokes, canvas, impasto
    gain: float
    alpha: float
    distribution: str
    index: float
    pigments: str  # okumura, or a file of paints_measured
    camera: str
    lamp: str  # A or D65
    rings: tuple[tuple[int, float], ...]  # (lamps, incidence in degrees)
    others: tuple[tuple[float, str, float], ...] = ()  # (alpha, distribution, index) of further finishes; index 0: gold
    share: float = 1.0  # of the picture's width that the first finish takes
    darkness: float = 1.0  # factor on the reflectance of the paints
    distance: float = 0.0  # of the lamps from the middle, in widths of the picture; 0: they are far away


PAINTINGS = {
    "tuned": {
        "none-1": Painting(11, "strokes", 2.0, 0.45, "ggx", 1.5, "okumura", "Canon 60D", "D65", ((8, 48), (3, 25))),
        "satin-1": Painting(12, "canvas", 1.8, 0.22, "ggx", 1.48, "Golden_HB", "Nikon D700", "A", ((8, 50), (4, 28))),
        "glossy-1": Painting(
            13, "impasto", 1.3, 0.09, "ggx", 1.5, "okumura", "Pentax K-5", "D65", ((8, 45), (4, 22), (1, 4))
        ),
        "matte-1": Painting(
            14, "impasto", 1.2, 0.0, "none", 1.0, "WinsorNewton_Artist", "Canon 5DMarkII", "A", ((9, 45),)
        ),
        "two-1": Painting(
            15, "impasto", 1.5, 0.2, "ggx", 1.5, "Golden_HB", "Canon 60D", "D65", ((8, 48), (4, 26)), (BARE,), 0.66
        ),
        "three-1": Painting(
            16,
            "impasto",
            1.3,
            0.12,
            "ggx",
            1.5,
            "okumura",
            "Nikon D700",
            "D65",
            ((8, 50), (4, 30), (1, 5)),
            ((0.28, "ggx", 1.5), BARE),
            0.4,
        ),
        "gilded-1": Painting(
            17, "strokes", 1.6, 0.2, "ggx", 1.5, "okumura", "Canon 60D", "D65", ((10, 46), (5, 24)), (GOLD,), 0.7
        ),
        "gilded-3": Painting(
            31,
            "canvas",
            1.7,
            0.16,
            "ggx",
            1.5,
            "okumura",
            "Nikon D90",
            "D65",
            ((9, 47), (5, 25)),
            (BARE, (0.28, "ggx", 0.0)),
            0.4,
        ),
        "many-1": Painting(
            41, "impasto", 1.4, 0.2, "ggx", 1.5, "okumura", "Canon 60D", "D65", ((8, 16), (16, 33), (24, 50), (24, 62))
        ),
        "many-2": Painting(
            42, "strokes", 1.8, 0.4, "ggx", 1.5, "Golden_HB", "Nikon D700", "A", ((6, 18), (12, 36), (30, 54))
        ),
        "many-3": Painting(
            43, "canvas", 1.8, 0.1, "ggx", 1.5, "okumura", "Nikon D90", "D65", ((12, 25), (36, 52)), (BARE,), 0.5
        ),
        "near-1": Painting(
            44,
            "impasto",
            1.5,
            0.18,
            "ggx",
            1.5,
            "okumura",
            "Canon 60D",
            "D65",
            ((8, 46), (4, 25)),
            (BARE,),
            0.6,
            distance=1.6,
        ),
        "dark-1": Painting(
            18, "impasto", 1.3, 0.0, "none", 1.0, "okumura", "Pentax K-5", "D65", ((8, 48), (4, 28)), darkness=0.25
        ),
    },
    "unseen": {
        "none-2": Painting(
            21, "canvas", 2.0, 0.38, "beckmann", 1.46, "Schmincke_Mussini", "Nikon D90", "A", ((8, 45), (4, 24))
        ),
        "near-2": Painting(
            45,
            "canvas",
            1.7,
            0.22,
            "beckmann",
            1.5,
            "Golden_HB",
            "Nikon D700",
            "A",
            ((9, 48), (4, 27)),
            (BARE,),
            0.5,
            distance=1.3,
        ),
        "satin-2": Painting(
            22, "impasto", 1.5, 0.18, "ggx", 1.5, "Maimeri_Classico", "Canon 40D", "D65", ((8, 48), (1, 5))
        ),
        "glossy-2": Painting(23, "strokes", 2.4, 0.11, "ggx", 1.47, "okumura", "SONY NEX-5N", "A", ((8, 50), (4, 26))),
        "glossy-3": Painting(
            24, "canvas", 1.6, 0.13, "beckmann", 1.5, "KremerHistorical", "Nikon D3", "D65", ((8, 46), (5, 25))
        ),
        "two-2": Painting(
            25,
            "strokes",
            2.0,
            0.15,
            "beckmann",
            1.48,
            "Maimeri_Classico",
            "Nikon D90",
            "A",
            ((9, 44), (3, 22)),
            (BARE,),
            0.6,
        ),
        "three-2": Painting(
            26,
            "canvas",
            1.7,
            0.1,
            "ggx",
            1.5,
            "Schmincke_Mussini",
            "Canon 40D",
            "D65",
            ((10, 50), (5, 27)),
            ((0.3, "beckmann", 1.5), BARE),
            0.35,
        ),
        "dark-2": Painting(
            27,
            "strokes",
            1.8,
            0.0,
            "none",
            1.0,
            "KremerHistorical",
            "SONY NEX-5N",
            "A",
            ((9, 46), (3, 25)),
            darkness=0.25,
        ),
        "satin-3": Painting(28, "impasto", 1.4, 0.2, "ggx", 1.5, "Golden_HB", "Nikon D3", "D65", ((8, 48), (4, 26))),
        "two-3": Painting(
            29, "canvas", 1.7, 0.24, "ggx", 1.5, "okumura", "Canon 5DMarkII", "D65", ((9, 47), (6, 27)), (BARE,), 0.55
        ),
        "gilded-2": Painting(
            30, "impasto", 1.4, 0.18, "ggx", 1.5, "Golden_HB", "Nikon D700", "D65", ((11, 48), (5, 26)), (GOLD,), 0.6
        ),
        "gilded-5": Painting(
            33,
            "impasto",
            1.5,
            0.17,
            "ggx",
            1.5,
            "Maimeri_Classico",
            "Canon 5DMarkII",
            "A",
            ((9, 49), (6, 26)),
            ((0.25, "beckmann", 0.0), BARE),
            0.45,
        ),
        "gilded-6": Painting(
            34,
            "strokes",
            1.5,
            0.12,
            "ggx",
            0.0,
            "okumura",
            "Nikon D700",
            "D65",
            ((10, 50), (5, 28)),
            (BARE,),
            0.35,
        ),
        "gilded-4": Painting(
            32,
            "strokes",
            1.7,
            0.14,
            "beckmann",
            0.0,
            "KremerHistorical",
            "Canon 40D",
            "A",
            ((8, 46), (4, 24), (1, 4)),
            ((0.22, "ggx", 1.5), BARE),
            0.3,
        ),
    },
}
CHECKS_DEG = (20.0, 32.0, 50.0, 60.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for captures and truths")
    parser.add_argument("--paintings", nargs="+", default=list(all_paintings()), choices=list(all_paintings()))
    data = Path(os.environ.get("NISHIKI_DATA", PROJECT.parent / "shared" / "data"))
    parser.add_argument("--spectra", type=Path, default=data / "spectra", help="folder of the measured tables")
    parser.add_argument("--rows", type=int, default=128)
    parser.add_argument("--columns", type=int, default=176)
    parser.add_argument("--samples", type=int, default=4, help="rays along each side of a pixel")
    options = parser.parse_args()
    if not options.spectra.is_dir():
        raise SystemExit(f"{options.spectra}: no such folder; name the measured spectra with --spectra or NISHIKI_DATA")
    for name in options.paintings:
        start, cpu = time.perf_counter(), time.process_time()
        make(options.output / name, all_paintings()[name], options)
        seconds = {"seconds": round(time.perf_counter() - start, 1), "cpu_s": round(time.process_time() - cpu, 1)}
        print(json.dumps({"painting": name, **seconds}), flush=True)


def all_paintings() -> dict[str, Painting]:
    """Both halves."""
    return {**PAINTINGS["tuned"], **PAINTINGS["unseen"]}


def lamps(painting: Painting) -> list[tuple[str, str, np.ndarray]]:
    """(name, role, unit direction)."""
    rng = np.random.default_rng(painting.seed + 1000)
    found = []
    for ring, (count, incidence) in enumerate(painting.rings):
        first = rng.uniform(0, 2 * np.pi)
        for i in range(count):
            azimuth = first + 2 * np.pi * i / count + rng.normal(0, 0.05)
            found.append((f"R{ring + 1}L{i + 1:02d}", "sample", direction(incidence + rng.normal(0, 1.0), azimuth)))
    for i, incidence in enumerate(CHECKS_DEG):
        azimuth = rng.uniform(0, 2 * np.pi)
        found.append((f"check{i + 1}", "check", direction(incidence, azimuth)))
    return found


def direction(incidence_deg: float, azimuth: float) -> np.ndarray:
    """Unit vector to the lamp."""
    polar = np.radians(incidence_deg)
    return np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])


class Studio:
    """The painting as Mitsuba's scene under one lamp of irradiance 1 in its middle, seen along -z."""

    def __init__(self, painting: Painting, height, label, reflectances, shape, samples):
        import drjit
        import mitsuba

        self.mi, self.dr, self.shape, self.samples, self.painting = mitsuba, drjit, shape, samples, painting
        finishes = ((painting.alpha, painting.distribution, painting.index), *painting.others)
        self.bsdfs = [self.material(spectrum, *finish) for finish in finishes for spectrum in reflectances]
        dark = np.zeros(len(WAVELENGTHS))
        self.black = [self.material(dark, *finish) for finish in finishes for _ in reflectances]
        self.middle = np.array([shape[1], -shape[0], 0]) * PITCH_MM / 2
        self.distance = painting.distance * shape[1] * PITCH_MM
        self.parts = split(height, label, shape)
        self.scenes = {"paint": self.scene(self.bsdfs), "gloss": self.scene(self.black)}
        self.integrator = mitsuba.load_dict({"type": "path", "max_depth": 4})
        rng = np.random.default_rng(painting.seed + 2000)
        side = shape[1] * samples
        jitter = rng.random((2, shape[0] * samples, side))
        self.x = ((np.arange(side)[None, :] + jitter[0]) / samples * PITCH_MM).astype(np.float32)
        self.y = ((np.arange(shape[0] * samples)[:, None] + jitter[1]) / samples * PITCH_MM).astype(np.float32)

    def material(self, spectrum, alpha, distribution, index):
        """BSDF of a paint under a finish."""
        if index == 0:
            return self.mi.load_dict({"type": "roughconductor", "material": "Au", "alpha": alpha})
        text = ", ".join(f"{v:.6f}" for v in spectrum)
        nm = ", ".join(f"{v:g}" for v in WAVELENGTHS)
        colour = {"type": "irregular", "wavelengths": nm, "values": text}
        if not spectrum.any():
            colour = {"type": "uniform", "value": 0.0}
        if alpha == 0:
            return self.mi.load_dict({"type": "diffuse", "reflectance": colour})
        return self.mi.load_dict(
            {
                "type": "roughplastic",
                "alpha": alpha,
                "distribution": distribution,
                "int_ior": index,
                "ext_ior": 1.0,
                "nonlinear": True,
                "diffuse_reflectance": colour,
            }
        )

    def scene(self, bsdfs):
        """One mesh a paint, and the lamp."""
        mi = self.mi
        found = {"type": "scene"}
        for number, (points, normals, faces) in self.parts.items():
            properties = mi.Properties()
            properties["mesh_bsdf"] = bsdfs[number]
            mesh = mi.Mesh(f"paint{number}", len(points), len(faces), has_vertex_normals=True, props=properties)
            values = mi.traverse(mesh)
            values["vertex_positions"] = points.astype(np.float32).ravel()
            values["vertex_normals"] = normals.astype(np.float32).ravel()
            values["faces"] = faces.astype(np.uint32).ravel()
            values.update()
            found[f"paint{number}"] = mesh
        flat = {"type": "irregular", "wavelengths": "300, 900", "values": "1, 1"}
        found["lamp"] = {"type": "directional", "direction": [0, 0, -1], "irradiance": flat}
        if self.distance:
            values = {**flat, "values": f"{self.distance**2}, {self.distance**2}"}
            found["lamp"] = {"type": "point", "position": [0, 0, self.distance], "intensity": values}
        return mi.load_dict(found)

    def rays(self, wavelengths):
        """One a sample of every pixel."""
        mi = self.mi
        x, y = mi.Float(self.x.ravel()), mi.Float(self.y.ravel())
        ray = mi.RayDifferential3f(mi.Point3f(x, -y, 20.0), mi.Vector3f(0, 0, -1))
        ray.wavelengths = type(ray.wavelengths)(*[float(v) for v in wavelengths])
        return ray

    def set_lamp(self, towards):
        """Turn the lamp of both scenes."""
        turned = self.mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=(-towards).tolist(), up=[0.3, 0.9, 0.1])
        for scene in self.scenes.values():
            values = self.mi.traverse(scene)
            if self.distance:
                values["lamp.position"] = self.mi.Point3f(*(self.middle + self.distance * towards).tolist())
            else:
                values["lamp.to_world"] = self.mi.Transform4f(turned.matrix)
            values.update()

    def trace(self, which, wavelengths) -> np.ndarray:
        """(rows, columns, 4) light relative to a white facing the lamp; the same rays at all wavelengths."""
        sampler = self.mi.load_dict({"type": "independent"})
        sampler.seed(self.painting.seed, self.x.size)
        spectrum, *_ = self.integrator.sample(self.scenes[which], sampler, self.rays(wavelengths))
        values = np.pi * np.array(spectrum)
        values = values if values.shape[0] == len(wavelengths) else values.T
        return np.moveaxis(self.pixels(values), 0, -1)

    def pixels(self, values) -> np.ndarray:
        """(.., samples) to the mean of each pixel (.., rows, columns)."""
        (rows, columns), s = self.shape, self.samples
        return values.reshape(*values.shape[:-1], rows, s, columns, s).mean(axis=(-3, -1))

    def spectral(self) -> np.ndarray:
        """(rows, columns, 16)."""
        steps = range(0, len(WAVELENGTHS), 4)
        return np.concatenate([self.trace("paint", WAVELENGTHS[i : i + 4]) for i in steps], axis=-1)

    def lit(self, towards) -> np.ndarray:
        """Share of each pixel that sees the lamp."""
        mi = self.mi
        point = self.scenes["paint"].ray_intersect(self.rays(WAVELENGTHS[:4]))
        if self.distance:
            place = mi.Point3f(*(self.middle + self.distance * towards).tolist())
            hidden = self.scenes["paint"].ray_test(point.spawn_ray_to(place))
            towards = self.dr.normalize(place - point.p)
        else:
            towards = mi.Vector3f(*[float(v) for v in towards])
            hidden = self.scenes["paint"].ray_test(point.spawn_ray(towards))
        facing = self.dr.dot(point.sh_frame.n, towards) > 0
        return self.pixels(np.array(facing & ~hidden).astype(np.float32))

    def white(self, towards) -> tuple[np.ndarray, np.ndarray]:
        """(rows, columns, 1) of a perfect white in the object's place: facing the lamp, and lying flat."""
        if not self.distance:
            return np.ones((*self.shape, 1)), np.full((*self.shape, 1), towards[2])
        x, y = ((np.arange(n) + 0.5) * PITCH_MM for n in self.shape[::-1])
        flat = np.dstack([*np.meshgrid(x, -y), np.zeros(self.shape)])
        apart = self.middle + self.distance * towards - flat
        square = np.sum(apart**2, axis=-1, keepdims=True)
        facing = self.distance**2 / square
        return facing, facing * apart[..., 2:] / np.sqrt(square)

    def frontal(self) -> np.ndarray:
        """(paints, 16) what each paint's body returns of light along the normal, seen along it, gloss left out."""
        mi, found = self.mi, []
        si = self.dr.zeros(mi.SurfaceInteraction3f, 1)
        si.wi = mi.Vector3f(0, 0, 1)
        for bsdf, black in zip(self.bsdfs, self.black, strict=True):
            row = []
            for i in range(0, len(WAVELENGTHS), 4):
                si.wavelengths = type(si.wavelengths)(*[float(v) for v in WAVELENGTHS[i : i + 4]])
                seen = [np.ravel(b.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))) for b in (bsdf, black)]
                row.append(np.pi * (seen[0] - seen[1]))
            found.append(np.concatenate(row))
        return np.array(found)


def make(folder: Path, painting: Painting, options) -> None:
    """One capture, sealed, and its truth."""
    from nishiki.capture.seal import seal

    if folder.exists():
        raise SystemExit(f"{folder}: exists already; remove it or choose another folder")
    use_mitsuba()
    shape, rng = (options.rows, options.columns), np.random.default_rng(painting.seed)
    reflectances = painting.darkness * palette(options.spectra, painting.pigments, rng)
    height, label = surface(painting, *shape, len(reflectances))
    label = label + len(reflectances) * finish_of(painting, label.shape)
    studio = Studio(painting, height, label, reflectances, shape, options.samples)
    view = Observer(options.spectra, painting, shape)
    draft = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    draft.mkdir(parents=True)
    rig, truth = lamps(painting), {"lit": [], "xyz_lamp": [], "xyz_d65": [], "gloss": [], "body": []}
    frames = [(f"dark/{i}.png", "dark", "") for i in (1, 2, 3)]
    for file, *_ in frames:
        write_image(draft / file, view.codes(np.zeros((*shape, 3))))
    for name, role, towards in rig:
        studio.set_lamp(towards)
        light = studio.spectral()
        facing, flat = studio.white(towards)
        truth["lit"].append(np.rint(100 * studio.lit(towards)).astype(np.uint8))
        if role == "check":
            gloss = studio.trace("gloss", WAVELENGTHS[:4]).mean(axis=-1) / facing[..., 0]
            lamp = view.xyz(light / facing, view.power)
            for key, value in zip(
                ("xyz_lamp", "xyz_d65", "gloss", "body"),
                (lamp, view.xyz(light / facing, view.daylight), gloss, lamp[..., 1] - gloss),
                strict=True,
            ):
                truth[key].append(value.astype(np.float32))
        board = np.repeat(BOARD * flat, 3, axis=-1)
        for kind, values in ((role, view.channels(light)), ("white", board)):
            file = f"{'white' if kind == 'white' else 'frames'}/{name}.png"
            write_image(draft / file, view.codes(values))
            frames.append((file, kind, name))
    write_description(draft, folder.name, painting, view, rig, frames)
    write_truth(folder.with_name(f"{folder.name}-truth"), studio, height, label, rig, truth, shape)
    seal(draft)
    draft.rename(folder)


def finish_of(painting: Painting, shape: tuple[int, int]) -> np.ndarray:
    """Number of each vertex' finish: strips with wavy borders, the first `share` of the width, the others alike."""
    rng = np.random.default_rng(painting.seed + 4000)
    x = np.linspace(0, 1, shape[1]) + 0.06 * noise(rng, shape, 50)
    rest = np.linspace(painting.share, 1, len(painting.others) + 1)[: len(painting.others)]
    return np.searchsorted(rest, x, side="right")


def use_mitsuba() -> None:
    """The spectral variant, compiled by LLVM."""
    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        places = [Path("/usr/lib/x86_64-linux-gnu") / name for name in LLVM]
        there = next((place for place in places if place.exists()), None)
        if there:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(there)
    try:
        import mitsuba

        mitsuba.set_variant("llvm_ad_spectral")
    except ImportError as error:
        remedy = "install mitsuba and name libLLVM in DRJIT_LIBLLVM_PATH"
        raise SystemExit(f"mitsuba with LLVM is needed ({error}); {remedy}") from error


class Observer:
    """Camera, lamp and standard observer; codes with noise, vignetting and black level."""

    def __init__(self, spectra: Path, painting: Painting, shape):
        from nishiki.colour.colour import cie_1931_cmfs

        self.rng = np.random.default_rng(painting.seed + 3000)
        self.curves = camera_curves(spectra, painting.camera)
        self.power, self.daylight = (lamp_power(spectra, name, FINE) for name in (painting.lamp, "D65"))
        self.finer = np.array([np.interp(FINE, WAVELENGTHS, unit) for unit in np.eye(len(WAVELENGTHS))])
        self.matching = cie_1931_cmfs()
        y, x = np.indices(shape)
        away = np.hypot(x - shape[1] / 2, y - shape[0] / 2) / np.hypot(*shape) * 2
        self.vignette = 1 - 0.06 * away[..., None] ** 2

    def channels(self, light) -> np.ndarray:
        """Camera channels of light (.., 16), a white facing the lamp = 1."""
        weights = self.curves * self.power
        return light @ (self.finer @ (weights / weights.sum(axis=1, keepdims=True)).T)

    def xyz(self, light, power) -> np.ndarray:
        """(.., 3), a white facing the lamp has Y = 1."""
        weights = self.matching * power
        return light @ (self.finer @ (weights / weights[1].sum()).T)

    def codes(self, values) -> np.ndarray:
        """16-bit pictures of 12-bit codes."""
        full = 2**BITS - 1
        electrons = np.maximum(values, 0) * WHITE_LEVEL * FULL_WELL * self.vignette
        seen = self.rng.poisson(electrons) + self.rng.normal(0, READ_NOISE, electrons.shape)
        return np.clip(np.rint(BLACK + seen / FULL_WELL * (full - BLACK)), 0, full).astype(np.uint16)


def write_description(draft: Path, name: str, painting: Painting, view: Observer, rig, frames) -> None:
    """capture.yaml, frames.csv, lamps and curves."""
    (draft / "capture.yaml").write_text(
        f"format: 1\ntitle: Path-traced painting {name}\n"
        f"camera: {{model: {painting.camera}, channels: [red, green, blue], bits: {BITS}, saturation: 0.98, "
        f"sensitivities: spectra/camera.csv}}\n"
        f"illuminant: spectra/illuminant.csv\nlights: {{file: lights.lp"
        f"{', kind: position_mm' * bool(painting.distance)}}}\n"
        f"white: {{reflectance: {BOARD}}}\npixel_pitch_mm: {PITCH_MM}\n"
    )
    write_csv(draft / "frames.csv", [("file", "role", "light"), *frames])
    scale = painting.distance * view.vignette.shape[1] * PITCH_MM or 1.0
    lines = [f"{lamp} " + " ".join(f"{v:.6f}" for v in scale * towards) for lamp, _, towards in rig]
    (draft / "lights.lp").write_text("\n".join([str(len(rig)), *lines]) + "\n")
    (draft / "spectra").mkdir()
    curves = [(f"{w:g}", *(f"{v:.8f}" for v in row)) for w, row in zip(FINE, view.curves.T, strict=True)]
    write_csv(draft / "spectra" / "camera.csv", [("wavelength_nm", "red", "green", "blue"), *curves])
    power = [(f"{w:g}", f"{p:.6f}") for w, p in zip(FINE, view.power, strict=True)]
    write_csv(draft / "spectra" / "illuminant.csv", [("wavelength_nm", "power"), *power])


def write_truth(folder: Path, studio: Studio, height, label, rig, lights: dict, shape) -> None:
    """truth.zarr, named as nishiki.stages.evaluate.painting reads it."""
    rows, columns = shape
    place = [studio.y.ravel() / PITCH_MM * VERTICES, studio.x.ravel() / PITCH_MM * VERTICES]
    normals = [
        studio.pixels(map_coordinates(part, place, order=1)) for part in np.moveaxis(vertex_normals(height), 2, 0)
    ]
    normals = np.stack(normals, axis=-1)
    own = label[:-1, :-1].reshape(rows, VERTICES, columns, VERTICES).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    fine = np.array([np.interp(FINE, WAVELENGTHS, row) for row in studio.frontal()])
    arrays = {
        "normals": (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        "height_mm": studio.pixels(map_coordinates(height, place, order=1)).astype(np.float32),
        "labels": own.astype(np.uint8),
        "finish": (own[..., own.shape[-1] // 2] // (len(studio.bsdfs) // (1 + len(studio.painting.others)))).astype(
            np.uint8
        ),
        "spectra": fine.astype(np.float32),
        "wavelengths_nm": FINE,
        "roughness": np.array([studio.painting.alpha], np.float32),
        **{name: np.array(values) for name, values in lights.items()},
    }
    truth = TruthWriter(folder)
    for name, values in arrays.items():
        truth.put(name, values)
    truth.group.attrs.update(
        lights=[name for name, *_ in rig],
        checks=[name for name, role, _ in rig if role == "check"],
        directions=[towards.tolist() for *_, towards in rig],
        painting=vars(studio.painting),
    )


if __name__ == "__main__":
    main()
