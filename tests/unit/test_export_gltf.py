"""A painting as glTF, OpenUSD and MaterialX: one mesh, one look, one error."""

import io
import zipfile

import numpy as np
import pytest
import trimesh
from npm_packages import gltf_problems
from pages import make_artifact
from PIL import Image
from small_painting import (
    COLUMNS,
    FORMATS_HERE,
    LAMPS,
    PITCH_MM,
    ROWS,
    STAMP,
    exported_painting,
    of_pixels,
    shaded,
    small_painting,
)

from nishiki.artifacts.maps import MapWriter
from nishiki.brdf.torrance_sparrow import specular
from nishiki.colour.colour import illuminant, srgb_encode, white_xyz, xyz_from_spectra, xyz_to_srgb_linear
from nishiki.stages.export.look import GltfMaterial, best_material, coded_errors, textures
from nishiki.stages.export.scene import ExportedScene, reliefs
from nishiki.stages.height import HeightSettings


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The painting, the folder of its exports, and what the stage reports."""
    with exported_painting(
        tmp_path_factory.mktemp("painting"),
        tuple(name for name in FORMATS_HERE if name in ("gltf", "usd", "materialx")),
    ) as made:
        yield made


def test_gltf_is_the_displaced_plane_with_the_relief_in_its_normal_texture(exported):
    painting = exported.painting
    scene = trimesh.load(exported.folder / "painting.glb")
    (mesh,) = scene.geometry.values()
    millimetres = mesh.vertices * 1000
    own = of_pixels(millimetres)
    assert np.abs(millimetres[own, 2] - painting.height[painting.known]).max() < 1e-4
    outer = np.array([COLUMNS, ROWS]) * PITCH_MM / 2
    np.testing.assert_allclose([millimetres[:, :2].min(axis=0), millimetres[:, :2].max(axis=0)], [-outer, outer], 1e-5)
    np.testing.assert_allclose(mesh.visual.uv, millimetres[:, :2] / outer / 2 + 0.5, atol=1e-6)
    material = mesh.visual.material
    texel = np.rint(mesh.visual.uv[own] * [COLUMNS, ROWS] - 0.5).astype(int)
    row, column = ROWS - 1 - texel[:, 1], texel[:, 0]  # trimesh counts from the bottom
    np.testing.assert_array_equal(np.stack([row, column]), np.nonzero(painting.known))
    coded = np.asarray(material.normalTexture)[row, column] / 255 * 2 - 1
    for lamp in LAMPS:
        np.testing.assert_allclose(shaded(coded, lamp), shaded(painting.normals[painting.known], lamp), atol=0.01)
    assert material.metallicFactor == 0
    roughness = np.asarray(material.metallicRoughnessTexture)[..., 1] / 255
    narrowest = exported.reported["losses"]["gltf"]["materials"][0]["roughness"]
    assert narrowest - 0.5 / 255 <= roughness.min() < roughness.max()  # the slopes inside a pixel widen the lobe
    lamp = illuminant("D65")
    srgb = xyz_to_srgb_linear(xyz_from_spectra(lamp, painting.reflectance()), white=white_xyz(lamp))
    shown = np.asarray(material.baseColorTexture)[row, column] / 255
    assert np.abs(shown - srgb_encode(srgb[painting.known])).mean() < 0.01


def test_usd_and_materialx_have_the_mesh_the_textures_and_the_error_of_gltf(exported):
    if not {"usd", "materialx"} <= set(FORMATS_HERE):
        pytest.skip("usd-core or materialx is not installed (extra export)")
    from pxr import Usd, UsdGeom

    (mesh,) = trimesh.load(exported.folder / "painting.glb", process=False).geometry.values()
    with zipfile.ZipFile(exported.folder / "painting.usdz") as package:
        inside = {name: package.read(name) for name in package.namelist()}
    stage = Usd.Stage.Open(str(exported.folder / "painting.usdz"))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/surface/mesh"))
    np.testing.assert_array_equal(np.array(shape.GetPointsAttr().Get()), mesh.vertices.astype(np.float32))
    np.testing.assert_array_equal(np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), mesh.faces)
    places = np.array(UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Get())
    np.testing.assert_allclose(places, mesh.visual.uv, atol=1e-6)  # trimesh counts from the bottom, too
    for name, texture in (
        ("colour", mesh.visual.material.baseColorTexture),
        ("normals", mesh.visual.material.normalTexture),
    ):
        assert inside[f"textures/{name}.png"] == (exported.folder / f"materialx/{name}.png").read_bytes()
        np.testing.assert_array_equal(Image.open(io.BytesIO(inside[f"textures/{name}.png"])), texture)
    losses = exported.reported["losses"]
    for name in ("usd", "materialx"):
        for lights, figures in losses[name]["kinds"][name]["psnr_db"].items():
            assert figures["all"] == pytest.approx(losses["gltf"]["kinds"]["gltf"]["psnr_db"][lights]["all"], abs=0.05)


@pytest.mark.slow
def test_reliefs_that_were_flattened_are_exported_with_their_normals(tmp_path):
    """The mesh is flat, so vertex normals that still lean would shade it as the bowl that was taken off."""
    painting = small_painting(tmp_path)
    level = np.zeros((ROWS, COLUMNS), np.float32)
    upright = np.dstack([level, level, level + 1])

    def flattened(writer):
        maps = MapWriter(writer.folder, rows=ROWS, columns=COLUMNS, band_rows=16, stamp=STAMP)
        maps.write("height", level, unit="mm")
        maps.write("normals", upright)

    painting.inputs["height"] = make_artifact(tmp_path / "flat", HeightSettings(), flattened, stamp=STAMP)
    scene = ExportedScene(painting.inputs)
    for part in reliefs(scene, 10_000, colours=None):
        np.testing.assert_array_equal(part.normals, np.tile(np.float32([0, 0, 1]), (len(part.normals), 1)))
    np.testing.assert_array_equal(textures(scene, 512, slopes=False).normals[painting.known], upright[painting.known])
    assert scene.normals(slice(0, ROWS))[..., 0].std() > 0.05


def test_the_fitted_lobe_of_gltf_looks_like_ours():
    beta, gamma, index = np.array([3.0, 0.4]), np.array([0.12, 0.5]), 1.45
    material = best_material(coded_errors(beta, gamma, index, 0.3), index)
    for degrees in (0, 10, 25, 50):
        angle = np.radians(degrees)
        light, view = np.array([np.sin(angle), 0, np.cos(angle)]), np.array([0, 0, 1.0])
        ours = 0.3 * light[2] + sum(
            specular(np.array([0, 0, 1.0]), light, view, beta=b, gamma=g, refractive_index=index)
            for b, g in zip(beta, gamma, strict=True)
        )
        base = material.base_colour(np.full((1, 3), 0.3))
        shown = material.render(base, np.array([[0, 0, 1.0]]), light)[0, 0]
        assert srgb_encode(shown) == pytest.approx(srgb_encode(ours), abs=0.03)
    assert best_material(coded_errors(np.array([0.0]), np.array([0.9]), 1.45, 0.3), 1.45).strength < 0.01


def test_the_material_of_gltf_is_that_of_the_specification():
    material = GltfMaterial(roughness=0.5, strength=1.0, index=1.5)
    light = np.array([0.6, 0, 0.8])
    half = np.array([0.6, 0, 1.8]) / np.sqrt(3.6)
    alpha2, fresnel_term = 0.5**4, 0.04 + 0.96 * (1 - half[2]) ** 5
    distribution = alpha2 / (np.pi * (half[2] ** 2 * (alpha2 - 1) + 1) ** 2)
    smith = 2 * 0.8 / (0.8 + np.sqrt(alpha2 + (1 - alpha2) * 0.64)) * 2 / (1 + 1)
    brdf = (1 - fresnel_term) * 0.2 / np.pi + fresnel_term * distribution * smith / (4 * 0.8)
    shown = material.render(np.full((1, 3), 0.2), np.array([[0, 0, 1.0]]), light)
    np.testing.assert_allclose(shown[0], np.pi * 0.8 * brdf, rtol=1e-6)


def test_gltf_is_valid(exported):
    assert gltf_problems(exported.folder / "painting.glb") == []
