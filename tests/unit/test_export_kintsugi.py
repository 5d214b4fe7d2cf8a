"""An object for Kintsugi 3D Viewer, read back as its published reader and shader do, beside our own model."""

import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from glossy_ball import glossy_ball
from npm_packages import gltf_problems
from PIL import Image

from nishiki.brdf.texels.model import predict
from nishiki.colour.colour import decode, encode
from nishiki.formats.textured_surface import sample
from nishiki.optional_formats.kintsugi import LobeBasis, lobes, write_kintsugi
from nishiki.stages.export.object_look import ObjectSurface, SeenPoints, object_mesh

STAMP = {"version": "1", "scene": "ball", "key": "0123456789ab"}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A glossy ball, written; what the loss is reckoned with."""
    look, model, context = glossy_ball()
    folder = tmp_path_factory.mktemp("kintsugi")
    (folder / "exports/kintsugi").mkdir(parents=True)
    context.stamp, context.output = STAMP, SimpleNamespace(path=lambda file: folder / file)
    asked = {}

    class Ball(ObjectSurface):
        mesh, unit = object_mesh(context, look), "metres"
        compare = staticmethod(lambda shown: asked.update(shown) or {})

    surface = Ball(context)
    surface.look, surface.model = look, model
    write_kintsugi(context, surface)
    return SimpleNamespace(look=look, model=model, folder=folder / "exports/kintsugi", shown=asked)


def document(folder):
    """The JSON of the binary glTF."""
    data = (folder / "object.glb").read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size])


class Reader:
    """The files as the viewer reads them: pictures and tables beside the document, three rows a table."""

    def __init__(self, folder):
        self.folder, self.gltf = folder, document(folder)
        (material,) = self.gltf["materials"]
        extras, plain = material["extras"], material["pbrMetallicRoughness"]
        assert extras["specularWeights"]["stride"] == 4
        self.diffuse = decode(self.picture(extras["diffuseTexture"]), "srgb")
        self.roughness = self.picture(plain["metallicRoughnessTexture"])[..., 1]
        self.constant = decode(self.picture(extras["diffuseConstantTexture"]), "srgb")[0, 0]
        self.weights = np.concatenate([self.picture(each) for each in extras["specularWeights"]["textures"]], axis=-1)
        rows = [line.split(",") for line in (folder / extras["basisFunctionsUri"]).read_text().splitlines()]
        names = [row[0] for row in rows]
        assert names == [f"{channel}#{b}" for b in range(8) for channel in ("Red", "Green", "Blue")]
        self.tables = np.array([[float(entry) for entry in row[1:]] for row in rows]).reshape(8, 3, -1)

    def picture(self, texture):
        """Values in 0 to 1."""
        uri = self.gltf["images"][self.gltf["textures"][texture["index"]]["source"]]["uri"]
        return np.asarray(Image.open(self.folder / uri)) / 255

    def distribution(self, places, cos_phi):
        """(n, 3) D: weights times tables, linear between their entries; outside of the texture is 0."""
        steps = self.tables.shape[-1] - 1
        x = np.sqrt(np.arccos(np.minimum(cos_phi, 1)) * 3 / np.pi) * steps
        lobes = [
            [np.interp(x, np.arange(steps + 2), [*channel, 0], right=0) for channel in table] for table in self.tables
        ]
        return np.einsum("nb,bcn->nc", sample(self.weights, places), np.array(lobes))

    def light(self, points, *, viewer):
        """(n, 3) what the viewer's shader shows under the points' lamp, or the formulas of the Builder."""
        irradiance, strength = points.factors()
        cos_phi, cos_i, cos_r, cos_q = points.cosines()
        found = self.distribution(points.places, cos_phi)
        m = sample(self.roughness[..., None], points.places)[:, 0] ** 2
        mix = [c * c * (1 - m * m) + m * m for c in (cos_i, cos_r)]
        if viewer:
            geometry = 0.5 / np.maximum(0.05, cos_r * np.sqrt(mix[0] + cos_i * np.sqrt(mix[1])))
            at_grazing = np.repeat((found / 0.04).mean(axis=1)[:, None], 3, axis=1)
            fifth = ((1 - cos_q) ** 5)[:, None]
            found = found * (1 - fifth) + at_grazing * fifth
        else:
            masked = [-0.5 + 0.5 * np.sqrt(1 + m * m * (1 / np.maximum(c, 1e-9) ** 2 - 1)) for c in (cos_i, cos_r)]
            geometry = 1 / (1 + masked[0] + masked[1]) / np.maximum(4 * cos_i * cos_r, 1e-9)
        body = sample(self.diffuse, points.places)
        return body * irradiance + np.pi * found * (geometry * cos_i * strength)[:, None]


def decibels(a, b):
    """PSNR of sRGB-coded values, peak 1."""
    return -10 * np.log10(np.mean((encode(np.clip(a, 0, 1), "srgb") - encode(np.clip(b, 0, 1), "srgb")) ** 2))


def test_the_files_as_read_show_what_the_loss_is_reckoned_with(exported):
    reader = Reader(exported.folder)
    for view in range(4):
        points = SeenPoints.of(exported.look, view)
        theirs = exported.look.scale * reader.light(points, viewer=True)
        np.testing.assert_allclose(theirs, exported.shown["kintsugi"](points), rtol=1e-4, atol=1e-6)


def test_the_files_show_our_model(exported):
    reader, look = Reader(exported.folder), exported.look
    body = decode(look.colour / 255, "srgb") * look.scale
    model = np.concatenate([body, exported.model["ks"], exported.model["sigma"]], axis=-1)
    for view in range(4):
        points = SeenPoints.of(look, view)
        kd, ks, sigma = np.split(sample(model, points.places), [3, 6], axis=1)
        at = (points.positions, points.normals, points.centre, points.lamp)
        ours = sum(predict(kd, ks, sigma[:, 0], *at)) / look.scale
        meant, viewer = (decibels(reader.light(points, viewer=viewer), ours) for viewer in (False, True))
        without = decibels(sample(reader.diffuse, points.places) * points.factors()[0], ours)
        reached = points.cosines()[0] > np.cos(np.radians(58))  # tables end at 60 degrees
        assert decibels(reader.light(points, viewer=False)[reached], ours[reached]) > 55
        assert meant > viewer
        assert viewer > without + 7


def test_a_sum_of_lobes_is_next_to_a_lobe_of_any_width_between():
    sigma = np.geomspace(0.03, 0.4, 400).reshape(20, 20)
    ks = np.full((20, 20, 3), (0.6, 0.5, 0.4))
    basis = LobeBasis.of(ks, sigma)
    found = np.einsum("ijb,bcn->ijcn", basis.weights / 255, basis.tables)
    wanted = 4 / np.pi * ks[..., None] * lobes(sigma.ravel()).reshape(20, 20, 1, -1)
    assert np.abs(found - wanted).max() < 0.02 * wanted.max()


def test_light_from_behind_is_dark_and_divides_by_no_zero(exported):
    constant = Reader(exported.folder).constant
    assert (constant > 0).all()
    assert (constant < 0.001).all()


def test_an_object_without_gloss_has_no_weights():
    basis = LobeBasis.of(np.zeros((4, 5, 3)), np.full((4, 5), 0.2))
    assert not basis.weights.any()
    assert np.isfinite(basis.tables).all()


def test_the_validator_of_gltf_finds_nothing(exported):
    assert gltf_problems(exported.folder / "object.glb") == []
