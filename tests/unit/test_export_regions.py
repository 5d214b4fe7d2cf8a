"""A painting with two regions of gloss in glTF, USD and MaterialX, decoded as their specifications say."""

import io
import json
import struct
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from small_painting import COLUMNS, ROWS, export_context, small_painting

from nishiki.colour.colour import srgb_encode
from nishiki.installation import is_installed
from nishiki.render.plane.scene import Light
from nishiki.render.plane.shade import predict_observations
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.look import STRENGTH, PaintingSurface, coded_errors, most_frequent
from nishiki.stages.export.painting import run
from nishiki.stages.export.scene import ExportedScene

FORMATS = (
    "gltf",
    *(("usd",) if is_installed("usd-core") else ()),
    *(("materialx",) if is_installed("materialx") else ()),
)
LABELS = np.zeros((ROWS, COLUMNS), np.uint8)
LABELS[10:30, 20:51] = 1


@contextmanager
def exported_with(folder, painting, **settings):
    """The painting, the folder of its exports, its look, and what the stage reports."""
    context = export_context(painting, folder, ExportSettings(formats=FORMATS, **settings))
    with context.output as output:
        reported = run(context)
        look = PaintingSurface(context, ExportedScene(painting.inputs)).look
        yield SimpleNamespace(painting=painting, folder=output.folder / "exports", look=look, losses=reported["losses"])


@pytest.fixture(scope="module")
def painting(tmp_path_factory):
    """With two finishes."""
    return small_painting(tmp_path_factory.mktemp("regions"), regions=LABELS)


@pytest.fixture(scope="module")
def exported(painting, tmp_path_factory):
    """With texels of a pixel."""
    with exported_with(tmp_path_factory.mktemp("fine"), painting) as made:
        yield made


@pytest.fixture(scope="module")
def coarse(painting, tmp_path_factory):
    """With texels of 3 x 3 pixels."""
    with exported_with(tmp_path_factory.mktemp("coarse"), painting, gltf={"texture_px": COLUMNS // 3}) as made:
        yield made


def contents(path):
    """The document of a .glb file and its pictures in the order of its textures."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    binary = data[28 + length :]
    pictures = []
    for texture in document["textures"]:
        view = document["bufferViews"][document["images"][texture["source"]]["bufferView"]]
        start = view["byteOffset"]
        pictures.append(np.asarray(Image.open(io.BytesIO(binary[start : start + view["byteLength"]]))))
    return document, pictures


def linear(coded):
    """Of sRGB values."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


@pytest.mark.slow
@pytest.mark.parametrize("size", ["exported", "coarse"])
def test_a_viewer_of_gltf_shows_the_error_that_is_stated(request, size):
    """The dielectric of glTF 2.0, appendix B, with KHR_materials_specular, written out for light and view."""
    exported = request.getfixturevalue(size)
    document, pictures = contents(exported.folder / "painting.glb")
    step = exported.look.step
    pictures = [picture.repeat(step, axis=0).repeat(step, axis=1)[:ROWS, :COLUMNS] for picture in pictures]
    (material,) = document["materials"]
    extension = material["extensions"]["KHR_materials_specular"]
    index = material["extensions"]["KHR_materials_ior"]["ior"]
    base = linear(pictures[material["pbrMetallicRoughness"]["baseColorTexture"]["index"]] / 255)
    alpha = (pictures[material["pbrMetallicRoughness"]["metallicRoughnessTexture"]["index"]][..., 1] / 255.0) ** 2
    weight = pictures[extension["specularTexture"]["index"]][..., 3] / 255
    normals = pictures[material["normalTexture"]["index"]] / 255 * 2 - 1
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    f0 = min(((index - 1) / (index + 1)) ** 2 * extension["specularColorFactor"][0], 1)
    view, squares = np.array([0, 0, 1.0]), []
    true = exported.painting.reflectance()[..., [45, 28, 8]]
    for light in exported.painting.lights[-3:]:
        half = (light + view) / np.linalg.norm(light + view)
        n_l, n_v, n_h = (np.maximum(normals @ each, 0) for each in (light, view, half))
        fresnel = weight * (f0 + (1 - f0) * (1 - view @ half) ** 5)
        d = alpha**2 / (np.pi * (n_h**2 * (alpha**2 - 1) + 1) ** 2)
        towards_light, towards_view = (np.sqrt(alpha**2 + (1 - alpha**2) * c**2) for c in (n_l, n_v))
        v = 1 / ((n_l + towards_light) * (n_v + towards_view))
        f = (1 - fresnel)[..., None] * base / np.pi + (fresnel * d * v)[..., None]
        photograph = np.maximum(exported.painting.normals @ light, 0)[..., None] * true
        shown = np.clip(srgb_encode(np.pi * f * n_l[..., None]), 0, 1)
        squares.append((shown - np.clip(srgb_encode(photograph), 0, 1)) ** 2)
    stated = exported.losses["gltf"]["kinds"]["gltf"]["psnr_db"]["check"]["all"]
    assert -10 * np.log10(np.mean(squares)) == pytest.approx(stated, abs=0.3)  # photographs are 12 bits, in camera RGB
    assert np.ptp(alpha) > 0.05
    assert step == (1 if size == "exported" else 3)


def test_textures_have_the_lobe_of_each_region_widened_by_the_slopes(exported):
    document, pictures = contents(exported.folder / "painting.glb")
    (material,) = document["materials"]
    broad, narrow = exported.losses["gltf"]["materials"]
    assert narrow["roughness"] < 0.6 * broad["roughness"]
    most = max(1, broad["specular"], narrow["specular"])
    extension = material["extensions"]["KHR_materials_specular"]
    assert extension["specularColorFactor"] == pytest.approx([most] * 3)
    roughness = pictures[material["pbrMetallicRoughness"]["metallicRoughnessTexture"]["index"]]
    weight = pictures[extension["specularTexture"]["index"]]
    assert (roughness[..., 2] == 0).all()  # no metal
    covariance = ExportedScene(exported.painting.inputs).slopes(slice(0, ROWS)).astype(float)
    for label, lobe in ((0, broad), (1, narrow)):
        expected = (lobe["roughness"] ** 4 + covariance[..., 0] + covariance[..., 2]) ** 0.25
        apart = roughness[..., 1] / 255 - np.minimum(expected, 1)
        assert np.abs(apart[label == LABELS]).max() < 1.1 / 255  # the reported roughness has 8 bits, too
        assert np.unique(weight[..., 3][label == LABELS]) == round(255 * lobe["specular"] / most)
    assert np.ptp(roughness[..., 1][LABELS == 1]) > 5


def test_materialx_has_the_same_textures_and_the_same_error(exported):
    if "materialx" not in FORMATS:
        pytest.skip("materialx is not installed (extra export)")
    _, (_, _, roughness, weight) = contents(exported.folder / "painting.glb")
    for name, channel in (("roughness", roughness[..., 1]), ("specular", weight[..., 3])):
        picture = np.asarray(Image.open(exported.folder / f"materialx/{name}.png"))
        np.testing.assert_array_equal(picture[..., 0], channel)
    ours, theirs = (exported.losses[name]["kinds"][name]["psnr_db"]["check"]["all"] for name in ("gltf", "materialx"))
    assert theirs == pytest.approx(ours, abs=0.05)


def test_usd_has_a_texture_of_roughness_and_the_one_strength_that_suits_all_regions_best(exported):
    if "usd" not in FORMATS:
        pytest.skip("usd-core is not installed (extra export)")
    from pxr import Usd, UsdShade

    stage = Usd.Stage.Open(str(exported.folder / "painting.usdz"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/surface/material/surface"))
    assert surface.GetInput("roughness").HasConnectedSource()
    index = surface.GetInput("ior").Get()
    usd, gltf = exported.look.gloss.usd, exported.look.gloss.gltf
    assert ((index - 1) / (index + 1)) ** 2 == pytest.approx(usd.materials[0].normal_reflectance, rel=1e-4)
    strengths = [material.strength for material in usd.materials]
    assert strengths[0] == pytest.approx(strengths[1])
    least, most = sorted(material.strength for material in gltf.materials)
    assert 0.9 * least < strengths[0] < 1.1 * most


@pytest.fixture(scope="module")
def gilded(tmp_path_factory):
    """Whose second region is a metal."""
    folder = tmp_path_factory.mktemp("gilded")
    with exported_with(folder, small_painting(folder, regions=LABELS, gilded=True)) as made:
        yield made


def test_gltf_has_a_metal_where_the_painting_is_gilded(gilded):
    document, (colours, _, roughness, weight) = contents(gilded.folder / "painting.glb")
    (material,) = document["materials"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 1
    assert material["extensions"]["KHR_materials_ior"]["ior"] == pytest.approx(1.45)
    np.testing.assert_array_equal(roughness[..., 2], 255 * (LABELS == 1))
    np.testing.assert_array_equal(weight[LABELS == 1][:, 3], 255)
    scene = ExportedScene(gilded.painting.inputs)
    mirror = np.clip(scene.srgb(slice(0, ROWS)), 0, 1)[LABELS == 1]
    assert np.abs(linear(colours[LABELS == 1] / 255) - mirror).max() < 0.005  # 8 bits, coded


def test_a_gilded_painting_looks_in_gltf_as_our_renderer_shows_it(gilded):
    """Facets of Trowbridge and Reitz have brighter tails than a Gaussian's; the strongest dielectric is far off."""
    rows, scene, look = slice(0, ROWS), ExportedScene(gilded.painting.inputs), gilded.look
    texels, gold = look.texels(rows, COLUMNS), (LABELS == 1) & gilded.painting.known
    metal, srgb = look.gloss.gltf.of(texels.rows, texels.columns), scene.srgb(rows).astype(np.float32)
    paint = replace(metal, metallic=0.0, strength=STRENGTH[-1])
    lights = gilded.painting.lights[:18:4]
    model = scene.model(rows)._replace(coefficients=srgb)
    pictures = predict_observations(model, [Light(direction=tuple(each)) for each in lights])

    def apart(light, material, ours):
        pictures = material.render(texels.colours, texels.normals, light).reshape(srgb.shape), ours.values
        return np.abs(np.subtract(*(np.clip(srgb_encode(np.maximum(each, 0)), 0, 1)[gold] for each in pictures)))

    errors = [[apart(*pair, ours).mean() for pair in ((light, metal), (light, paint))]
              for light, ours in zip(lights, pictures, strict=True)]  # fmt: skip
    of_metal, of_paint = np.mean(errors, axis=0)
    assert of_metal < 0.1
    assert of_metal < 0.5 * of_paint


def test_usd_and_materialx_have_a_texture_of_the_metal(gilded):
    materialx = pytest.importorskip("MaterialX", reason="materialx is not installed (extra export)")
    pytest.importorskip("pxr", reason="usd-core is not installed (extra export)")
    picture = np.asarray(Image.open(gilded.folder / "materialx/metallic.png"))
    np.testing.assert_array_equal(picture[..., 0], 255 * (LABELS == 1))
    document, (file,) = materialx.createDocument(), gilded.folder.glob("materialx/*.mtlx")
    materialx.readFromXmlFile(document, str(file))
    (node,) = document.getNodes("open_pbr_surface")
    image = node.getInput("base_metalness").getConnectedOutput().getConnectedNode()
    assert image.getInputValue("file") == "metallic.png"
    from pxr import Usd, UsdShade

    stage = Usd.Stage.Open(str(gilded.folder / "painting.usdz"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/surface/material/surface"))
    assert surface.GetInput("metallic").HasConnectedSource()
    usd = gilded.look.gloss.usd
    index = surface.GetInput("ior").Get()
    assert ((index - 1) / (index + 1)) ** 2 == pytest.approx(usd.materials[0].normal_reflectance, rel=0.01)


def test_the_grid_of_errors_has_its_least_at_the_lobe_that_it_was_made_of():
    errors = coded_errors(np.array([0.0]), np.array([0.3]), 1.5, 0.4)
    assert errors.shape[1] == len(STRENGTH)
    assert np.unravel_index(errors.argmin(), errors.shape) == (0, 0)  # rough and of no strength: matte
    assert (np.diff(errors[0][STRENGTH < 1]) >= 0).all()


@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_texel_has_the_region_of_most_of_its_pixels(step):
    random = np.random.default_rng(step)
    labels = random.integers(0, 3, (7, 8)).astype(np.uint8) * 20
    known = random.random((7, 8)) > 0.3
    found = most_frequent(labels, known, step)
    for row in range(found.shape[0]):
        for column in range(found.shape[1]):
            window = slice(row * step, (row + 1) * step), slice(column * step, (column + 1) * step)
            counts = {label: np.count_nonzero((labels[window] == label) & known[window]) for label in (0, 20, 40)}
            if max(counts.values()) and step > 1:
                assert counts[found[row, column]] == max(counts.values())
    if step == 1:
        np.testing.assert_array_equal(found, labels)
