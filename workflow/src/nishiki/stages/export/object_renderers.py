"""An object for renderers with its own gloss: a scene of Mitsuba 3, and glTF for Kintsugi 3D Viewer."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.texels.model import DISTANT, POINT, ViewLamp, predict
from nishiki.colour.colour import decode, srgb_encode
from nishiki.formats.banded_pictures import ExrWriter, png_bytes
from nishiki.formats.textured_surface import Glb, TexturedMesh, faces, heading, vertices
from nishiki.geometry.camera import NO_DISTORTION, Camera
from nishiki.render.display import three_channels
from nishiki.render.object.decoded_object import DecodedObject
from nishiki.stages.export import mitsuba_object
from nishiki.stages.export.object_look import (
    ObjectLook,
    ObjectSurface,
    SeenPoints,
    Shown,
    TextureAtlas,
    against_photographs,
    coded,
    in_charts,
    sample,
)
from nishiki.stages.export.registry import METRES, NORMAL_REFLECTANCE, add_surface, software

FITTED_POINTS = 1000  # of the mesh, to which a pinhole is fitted


def write_mitsuba(context: Context, surface: ObjectSurface) -> dict:
    """Write the folder `mitsuba`: mesh, textures, captured views and lamps, and our reflection model in Python.

    Returns its errors, and how far its cameras are from the capture's.
    """
    look = surface.look
    parameters = model_textures(look.decoded, look.layout)
    unit = METRES.get(context.inputs["mesh"].diagnostics.get("unit"), 1.0)
    folder = context.output.path("exports/mitsuba/scene.json").parent
    figures = write_folder(folder, look, surface.mesh, parameters, unit=unit, stamp=context.stamp)
    return {
        **look.figures(),
        **figures,
        "kinds": {name: {"psnr_db": found} for name, found in errors(context, look, parameters).items()},
    }


def write_folder(
    folder: Path,
    look: ObjectLook,
    mesh: TexturedMesh,
    parameters: dict[str, np.ndarray],
    *,
    unit: float,
    stamp: Mapping[str, str],
) -> dict:
    """Write the files; parameters: as of `model_textures`; unit: metres of a length of 1 in the cameras' world.

    Returns the number of vertices, and `camera_px` as `scene_facts` has it.
    """
    decoded = look.decoded
    (folder / "object.ply").write_bytes(
        heading(len(mesh.positions), len(mesh.triangles))
        + vertices(mesh.positions, mesh.normals, mesh.texture)
        + faces(mesh.triangles)
    )
    header = {f"nishiki.{name}": text for name, text in stamp.items()}
    for name, values in parameters.items():
        channels = "RGB" if values.shape[2] == 3 else "Y"
        with ExrWriter(folder / f"{name}.exr", channels, values.shape[0], values.shape[1], header) as exr:
            exr.write(values)
    (folder / "colour.png").write_bytes(png_bytes(look.surface().pictures()["colour"]))
    facts, apart = scene_facts(decoded, mesh.positions, unit)
    facts |= {"colour_scale": look.scale, "stamp": dict(stamp)}
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_object.py").write_text(Path(mitsuba_object.__file__).read_text(encoding="utf-8"))
    return {"vertices": len(mesh.positions), "camera_px": apart}


def model_textures(decoded: DecodedObject, layout: TextureAtlas) -> dict[str, np.ndarray]:
    """Compute kd, ks (rows, columns, 3) and sigma (rows, columns, 1) of the decoded model, float32, gaps filled."""

    def parameters(tile: int) -> np.ndarray:
        kd, ks, sigma = decoded.residual.parameters(tile)
        return np.dstack([three_channels(kd), three_channels(ks), sigma])

    filled = np.maximum(np.nan_to_num(in_charts(decoded, layout, 7, parameters)), 0)
    return {"kd": filled[..., :3], "ks": filled[..., 3:6], "sigma": filled[..., 6:]}


def scene_facts(decoded: DecodedObject, positions: np.ndarray, unit: float) -> tuple[dict, float]:
    """Describe cameras and lamps of every captured view, lengths times `unit`.

    Also the largest distance in pixels between what the pinholes with square pixels show of `positions` and what the
    capture's cameras do.
    """
    middle, views, apart = positions.mean(axis=0), {}, 0.0
    points = positions / unit
    for name, camera in zip(decoded.views, decoded.cameras, strict=True):
        pinhole = nearest_pinhole(camera, points)
        apart = max(apart, float(np.linalg.norm(pinhole.project(points)[0] - camera.project(points)[0], axis=1).max()))
        lamps = {
            light: lamp_facts(decoded.lighting.lamp(camera, number), middle, unit)
            for number, light in enumerate(decoded.lights)
        }
        views[name] = {"camera": camera_facts(pinhole, positions, unit), "lamps": lamps}
    return {"views": views}, apart


def nearest_pinhole(camera: Camera, points: np.ndarray) -> Camera:
    """Fit the pinhole with square pixels at the camera's place, by least squares of the distances in pixels.

    It shows world points (n, 3) nearest to where the camera has them; the camera itself where it is one.

    Matrices without metric calibration, such as projective ones, have oblong pixels and an axis far off the picture.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    k, middle = camera.intrinsics, np.array([camera.columns - 1, camera.rows - 1]) / 2
    if not any(camera.distortion) and abs(k[0, 1]) + abs(k[0, 0] - k[1, 1]) < 1e-9 * k[0, 0]:
        return camera
    points = points[:: max(len(points) // FITTED_POINTS, 1)]
    seen = camera.project(points)[0]
    ahead = np.linalg.solve(k, [*middle, 1]) @ camera.rotation  # the first guess looks along the middle pixel
    ahead /= np.linalg.norm(ahead)
    right = camera.rotation[0] - ahead * (ahead @ camera.rotation[0])
    right /= np.linalg.norm(right)
    guess = np.stack([right, np.cross(ahead, right), ahead])

    def pinhole(unknowns: np.ndarray) -> Camera:
        rotation = Rotation.from_rotvec(unknowns[:3]).as_matrix() @ guess
        focal, (column, row) = k[0, 0] * np.exp(unknowns[3]), middle + k[0, 0] * unknowns[4:]
        square = np.array([[focal, 0, column], [0, focal, row], [0, 0, 1]])
        return replace(
            camera,
            intrinsics=square,
            rotation=rotation,
            translation=-rotation @ camera.centre,
            distortion=NO_DISTORTION,
        )

    found = least_squares(lambda unknowns: (pinhole(unknowns).project(points)[0] - seen).ravel(), np.zeros(6))
    return pinhole(found.x)


def camera_facts(camera: Camera, positions: np.ndarray, unit: float) -> dict:
    """Describe a pinhole as Mitsuba does: x left, y up, z ahead; `principal_offset` as shares of the size."""
    k, centre = camera.intrinsics, camera.centre * unit
    to_world = np.eye(4)
    to_world[:3] = np.column_stack([-camera.rotation[0], -camera.rotation[1], camera.rotation[2], centre])
    away = np.linalg.norm(positions - centre, axis=1)
    return {
        "to_world": to_world.tolist(),
        "field_of_view_deg": float(2 * np.degrees(np.arctan(camera.columns / (2 * k[0, 0])))),
        "principal_offset": [0.5 - (k[0, 2] + 0.5) / camera.columns, 0.5 - (k[1, 2] + 0.5) / camera.rows],
        "rows": camera.rows,
        "columns": camera.columns,
        "near": float(0.1 * away.min()),
        "far": float(10 * away.max()),
    }


def lamp_facts(lamp: ViewLamp, middle: np.ndarray, unit: float) -> dict:
    """Describe a lamp for scene.json.

    `distance` of a near one: at which a white that faces it shows 1; where it shows that at any distance (`falloff`
    false), that of the object's middle (3,), metres. Surroundings of unknown lamps are even light of their mean
    strength.
    """
    if lamp.form == POINT:
        position, known = np.asarray(lamp.vector, np.float64) * unit, lamp.reference > 0
        distance = lamp.reference * unit if known else float(np.linalg.norm(position - middle))
        return {"kind": "point", "position": position.tolist(), "distance": distance, "falloff": known}
    if lamp.form == DISTANT:
        return {"kind": "directional", "direction": (-np.asarray(lamp.vector, np.float64)).tolist()}
    mean = np.maximum(three_channels(lamp.harmonics[:1])[0], 0)
    return {"kind": "around", "radiance": mean.astype(float).tolist()}


def errors(context: Context, look: ObjectLook, parameters: dict[str, np.ndarray]) -> dict[str, dict]:
    """Compute the PSNR of the reflection model against photographs, with the colours of all photographs."""
    colour = decode(look.colour / 255, "srgb")
    model = np.concatenate([colour * look.scale, parameters["ks"], parameters["sigma"]], axis=-1)

    def by_model(points: SeenPoints) -> np.ndarray:
        kd, ks, sigma = np.split(sample(model, points.places), [3, 6], axis=1)
        diffuse, gloss = predict(kd, ks, sigma[:, 0], points.positions, points.normals, points.centre, points.lamp)
        return diffuse + gloss

    return against_photographs(context, look, {"model": by_model})


FOLDER = "exports/kintsugi"
TABLES = "basisFunctions.csv"
BASES = 8  # as many as the viewer's shader adds up
SAMPLES = 91  # of a table, as the Builder writes them
NARROWEST, WIDEST = 0.01, 1.0  # radians; a table ends at 60 degrees
FIRST_STEP = 1 / 255
"""Light from behind: it avoids a division by 0 in the shader and is invisible in 8 bits."""


@dataclass(frozen=True)
class LobeBasis:
    """Gloss as a sum of weighted tables.

    Reflectance in Kintsugi 3D Viewer (source: its shader BasisIBR-ORM, and the serialiser of its Builder):

        f = d / pi + D(phi) G,    D(phi) = sum_b w_b T_b(u),    u = sqrt(3 phi / pi)

    d: diffuse colour; phi: angle of normal and half vector; T_b: a table for each of eight functions and three
    channels, even steps of u from 0 to 1 (60 degrees), linear between; w_b: weights in 0 to 1; G: masking over 4 n.l
    n.v. Our lobe K_s / n.v exp(-phi^2 / (2 sigma^2)), relative to a white that faces the lamp, is D = 4 K_s / pi
    exp(..) without masking. The tables are such lobes of eight widths, and the weights of a texel the least squares of
    its own lobe.
    """

    tables: np.ndarray  # (8, 3, 91) float64 ndarray: D of each function, for red, green and blue
    weights: np.ndarray  # (rows, columns, 8) uint8 ndarray: shares of 255 of the functions at texels

    @classmethod
    def of(cls, ks: np.ndarray, sigma: np.ndarray) -> "LobeBasis":
        """Fit lobes at texels: ks (rows, columns, 3) relative to a lamp of strength 1; sigma (rows, columns), radians.

        All texels have the mean colour of the gloss. The strongest 0.1 % of the weights of a function are clipped.
        """
        from scipy.optimize import nnls

        strength, width = ks.mean(axis=-1), np.clip(sigma, NARROWEST, WIDEST)
        glossy = width[strength > 0] if (strength > 0).any() else width
        low, high = np.percentile(glossy, (0.5, 99.5))
        widths = np.geomspace(low, max(high, 1.1 * low), BASES)
        own = np.geomspace(widths[0], widths[-1], 8 * BASES)
        basis = lobes(widths)
        # nonnegative shares of these lobes whose sum is next to a lobe of each width
        shares = np.array([nnls(basis.T, lobe)[0] for lobe in lobes(own)])
        peak, colour = 4 / np.pi * strength, ks.mean(axis=(0, 1)) / max(strength.mean(), 1e-12)
        tables, weights = np.empty((BASES, 3, SAMPLES)), np.empty((*strength.shape, BASES), np.uint8)
        for number, lobe in enumerate(basis):
            wanted = peak * np.interp(width, own, shares[:, number])
            largest = float(np.percentile(wanted[wanted > 0], 99.9)) if (wanted > 0).any() else 0.0
            tables[number] = largest * colour[:, None] * lobe
            weights[..., number] = coded(wanted / max(largest, 1e-12))
        return cls(tables, weights)

    def text(self) -> str:
        """Write the tables in the viewer's format: three rows a function."""
        rows = [
            ", ".join([f"{channel}#{number}", *(f"{value:.9f}" for value in table)])
            for number, tables in enumerate(self.tables)
            for channel, table in zip(("Red", "Green", "Blue"), tables, strict=True)
        ]
        return "\n".join(rows) + "\n"


def lobes(widths: np.ndarray) -> np.ndarray:
    """Compute (k, 91) exp(-phi^2 / (2 sigma^2)) at the samples of a table, of widths sigma (k,) in radians."""
    phi = np.pi / 3 * np.linspace(0, 1, SAMPLES) ** 2
    return np.exp(-(phi**2) / (2 * np.square(widths)[:, None]))


def write_kintsugi(context: Context, surface: ObjectSurface) -> dict:
    """Write the folder `kintsugi`; return its error against photographs."""
    look = surface.look
    model = model_textures(look.decoded, look.layout)
    basis = LobeBasis.of(model["ks"] / look.scale, model["sigma"][..., 0])
    glb = Glb()

    def put(name: str, data: bytes) -> str:
        context.output.path(f"{FOLDER}/{name}").write_bytes(data)
        return name

    def texture(name: str, picture: np.ndarray) -> int:
        return glb.texture_beside(put(f"{name}.png", png_bytes(picture)))

    normal = srgb_encode(look.specular[..., None] / 255 * look.normal_reflectance * np.ones(3))
    weights = [texture(f"weights{b:02}{b + 3:02}", basis.weights[..., b : b + 4]) for b in range(0, BASES, 4)]
    extras = {
        "diffuseTexture": {"index": texture("diffuse", look.colour)},
        "diffuseConstantTexture": {"index": texture("constant", coded(np.full((1, 1, 3), FIRST_STEP)))},
        "specularTexture": {"index": texture("specular", coded(normal))},
        "basisFunctionsUri": put(TABLES, basis.text().encode("ascii")),
        "specularWeights": {"stride": 4, "textures": [{"index": each} for each in weights]},
    }
    add_surface(glb, surface, texture, extras=extras)
    document = {**context.stamp, "unit": surface.unit}
    glb.write(context.output.path(f"{FOLDER}/object.glb"), generator=software(context), extras=document)
    found = against_photographs(context, look, {"kintsugi": viewed(look, basis)})
    return {
        "vertices": len(surface.mesh.positions),
        **look.figures(),
        "kinds": {name: {"psnr_db": figures} for name, figures in found.items()},
    }


def viewed(look: ObjectLook, basis: LobeBasis) -> Shown:
    """Render visible points with these textures as the viewer's shader does.

    Its masking G = 0.5 / max(0.05, n.v sqrt(S(l)^2 + n.l S(v))) is, on a smooth surface, by sqrt(2 n.l / (n.l + n.v))
    too strong: 1.41 with the lamp at the camera. Fresnel's rise is that from 0.04 to 1.
    """
    colour = decode(look.colour / 255, "srgb")

    def shown(points: SeenPoints) -> np.ndarray:
        body = sample(colour, points.places)
        weights, roughness = (sample(each, points.places) / 255 for each in (basis.weights, look.roughness[..., None]))
        irradiance, strength = points.factors()
        cos_phi, cos_i, cos_r, cos_q = points.cosines()
        found = distribution(basis.tables, weights, cos_phi)
        grazing = found.mean(axis=1, keepdims=True) / NORMAL_REFLECTANCE
        rising = found + (grazing - found) * ((1 - cos_q) ** 5)[:, None]
        light, view = (each**2 + roughness[:, 0] ** 4 * (1 - each**2) for each in (cos_i, cos_r))  # S^2
        masking = 0.5 / np.maximum(cos_r * np.sqrt(light + cos_i * np.sqrt(view)), 0.05)
        gloss = rising * (masking * cos_i * strength)[:, None]
        return look.scale * (body * irradiance + np.pi * gloss)

    return shown


def distribution(tables: np.ndarray, weights: np.ndarray, cos_phi: np.ndarray) -> np.ndarray:
    """Compute (n, 3) D of tables (k, 3, samples) and weights (n, k); 0 beyond 60 degrees, as in the viewer's shader."""
    last = tables.shape[-1] - 1
    place = np.sqrt(3 * np.arccos(np.clip(cos_phi, 0, 1)) / np.pi) * last
    before = np.minimum(place.astype(np.int64), last + 1)
    share = np.minimum(place - before, 1)
    padded = np.pad(tables, ((0, 0), (0, 0), (0, 2)))
    return np.einsum("nb,bcn->nc", weights, padded[..., before] * (1 - share) + padded[..., before + 1] * share)
