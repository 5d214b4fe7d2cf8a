"""Exports to USD and MaterialX, read back and validated by their own libraries."""

import cv2
import numpy as np
import pytest

from nishiki.errors import UserError
from nishiki.formats.textured_surface import SurfaceLook, TexturedMesh, write_materialx, write_usdz
from nishiki.installation import MODULES
from nishiki.stages.export.look import GltfMaterial, WhiteAtGrazing

RANDOM = np.random.default_rng(5)
PICTURE = RANDOM.integers(0, 256, (12, 20, 3)).astype(np.uint8)
GREY = RANDOM.integers(0, 256, (12, 20)).astype(np.uint8)
PAINTING = SurfaceLook(PICTURE, 0.4, 0.06, normals=PICTURE[::-1])
OBJECT = SurfaceLook(PICTURE, GREY, 0.1, weight=GREY[::-1])
MESH = TexturedMesh(
    positions=np.float32([[-1, -1, 0.2], [1, -1, 0], [-1, 1, 0], [1, 1, 0.1]]),
    normals=np.float32([[0, 0, 1]] * 4),
    texture=np.float32([[0, 1], [1, 1], [0, 0], [1, 0]]),
    triangles=np.array([[0, 1, 2], [1, 3, 2]]),
)


def usd_faults(path):
    """What the validators of OpenUSD find: stage, geometry, shading, references and the rules of packages."""
    validation = pytest.importorskip("pxr.UsdValidation", reason="usd-core is not installed (extra export)")
    from pxr import Usd

    context = validation.ValidationContext(validation.ValidationRegistry().GetOrLoadAllValidators())
    return [f"{each.GetName()}: {each.GetMessage()}" for each in context.Validate(Usd.Stage.Open(str(path)))]


def usdz(folder, look, name="höhe 1"):
    path = folder / "surface.usdz"
    pytest.importorskip("pxr", reason="usd-core is not installed (extra export)")
    write_usdz(path, MESH, look, name=name, facts={"scene": name, "key": "k"})
    return path


@pytest.mark.parametrize("look", [PAINTING, OBJECT], ids=["painting", "object"])
def test_the_validators_of_usd_find_nothing(tmp_path, look):
    assert usd_faults(usdz(tmp_path, look)) == []


def test_the_validators_of_usd_find_what_is_wrong(tmp_path):
    path = usdz(tmp_path, PAINTING)
    from pxr import Sdf, Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.TransferContent(stage.Flatten())
    spoiled = Usd.Stage.Open(layer)
    spoiled.ClearDefaultPrim()
    UsdGeom.Mesh.Define(spoiled, "/surface/material/inside")
    spoiled.GetPrimAtPath("/surface/material/normals").GetAttribute("inputs:sourceColorSpace").Set("sRGB")
    spoiled.Export(str(tmp_path / "spoiled.usda"))
    assert len(usd_faults(tmp_path / "spoiled.usda")) >= 3


def test_usd_holds_the_mesh_in_metres_with_y_up(tmp_path):
    path = usdz(tmp_path, PAINTING)
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    assert stage.GetDefaultPrim().GetDisplayName() == "höhe 1"
    assert dict(stage.GetRootLayer().customLayerData) == {"scene": "höhe 1", "key": "k"}
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/surface/mesh"))
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), MESH.positions)
    np.testing.assert_array_equal(mesh.GetFaceVertexIndicesAttr().Get(), MESH.triangles.ravel())
    np.testing.assert_array_equal(mesh.GetExtentAttr().Get(), [[-1, -1, 0], [1, 1, np.float32(0.2)]])
    places = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    np.testing.assert_array_equal(places, [[0, 0], [1, 0], [0, 1], [1, 1]])  # the first vertex is the lower left one
    corners = MESH.positions[MESH.triangles]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()


@pytest.mark.parametrize("look", [PAINTING, OBJECT], ids=["painting", "object"])
def test_usd_holds_the_values_of_the_material(tmp_path, look):
    """A texture's value at a place, computed as the specification of UsdUVTexture says, is what the look has there."""
    path = usdz(tmp_path, look)
    from pxr import Ar, Usd, UsdShade

    stage = Usd.Stage.Open(str(path))
    bound = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/surface/mesh")).ComputeBoundMaterial()[0]
    surface, _, _ = bound.ComputeSurfaceSource()

    def value(name):
        given = surface.GetInput(name)
        if not given.HasConnectedSource():
            return np.array(given.Get())
        texture = UsdShade.Shader(given.GetConnectedSources()[0][0].source.GetPrim())
        place = texture.GetInput("file").Get().resolvedPath
        data = np.frombuffer(Ar.GetResolver().OpenAsset(Ar.ResolvedPath(place)).GetBuffer(), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)[..., ::-1] / 255
        space = texture.GetInput("sourceColorSpace").Get()
        scale, bias = (texture.GetInput(each) for each in ("scale", "bias"))
        picture = picture * (np.array(scale.Get())[:3] if scale else 1) + (np.array(bias.Get())[:3] if bias else 0)
        return space, picture

    space, picture = value("diffuseColor")
    np.testing.assert_array_equal(np.rint(picture * 255), look.colour)
    assert (space, value("metallic")) == ("sRGB", 0)
    reflectance = ((value("ior") - 1) / (value("ior") + 1)) ** 2
    if look is PAINTING:
        assert value("roughness") == pytest.approx(0.4)
        assert reflectance == pytest.approx(0.06, rel=1e-5)
        space, normals = value("normal")
        assert space == "raw"
        np.testing.assert_allclose(normals, look.normals / 255.0 * 2 - 1, atol=1e-6)
    else:
        assert value("roughness")[0] == "raw"
        np.testing.assert_allclose(value("roughness")[1][..., 0], look.roughness / 255)
        assert reflectance == pytest.approx(0.1 * look.weight.mean() / 255, rel=1e-5)
        assert not surface.GetInput("normal")


def test_usd_is_the_same_at_every_writing(tmp_path):
    (tmp_path / "again").mkdir()
    assert usdz(tmp_path, OBJECT).read_bytes() == usdz(tmp_path / "again", OBJECT).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again", "surface.usdz"]


@pytest.mark.parametrize("look", [PAINTING, OBJECT], ids=["painting", "object"])
def test_materialx_makes_a_shader_of_the_document(tmp_path, look):
    materialx = pytest.importorskip("MaterialX", reason="materialx is not installed (extra export)")
    from MaterialX import PyMaterialXGenGlsl, PyMaterialXGenShader

    files = write_materialx(tmp_path / "surface.mtlx", look, facts={"scene": "höhe & 1"})
    assert sorted(files) == sorted(path.name for path in tmp_path.iterdir())
    document = materialx.createDocument()
    materialx.readFromXmlFile(document, str(tmp_path / "surface.mtlx"))
    folders, places = materialx.getDefaultDataLibraryFolders(), materialx.getDefaultDataSearchPath()
    materialx.loadLibraries(folders, places, document)
    assert document.validate() == (True, "")
    (surface,) = document.getNodes("open_pbr_surface")
    assert {each.getName() for each in surface.getInputs()} <= {
        each.getName() for each in document.getNodeDef("ND_open_pbr_surface_surfaceshader").getActiveInputs()
    }
    generator = PyMaterialXGenGlsl.GlslShaderGenerator.create()
    context = PyMaterialXGenShader.GenContext(generator)
    context.registerSourceCodeSearchPath(places)
    (material,) = document.getMaterialNodes()
    code = generator.generate("surface", material, context).getSourceCode("pixel")
    for name in look.pictures():
        assert f"{name}_file" in code
        picture = cv2.imread(str(tmp_path / f"{name}.png"))[..., ::-1]
        np.testing.assert_array_equal(picture, look.pictures()[name])


def test_the_index_of_a_look_has_its_reflectance():
    for look in (PAINTING, OBJECT):
        assert ((look.index - 1) / (look.index + 1)) ** 2 == pytest.approx(look.reflectance)
    assert np.isfinite(SurfaceLook(PICTURE, 1.0, 1.0).index)


def exact_reflectance(cosine, index):
    """Of a dielectric, unpolarised (Fresnel)."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    return (across**2 + along**2) / 2


def test_formats_without_a_weight_reflect_the_same_below_75_degrees_between_light_and_view():
    """The lobe is fitted to these; beyond them they reflect more at grazing light than glTF, as dielectrics do."""
    cosines = np.cos(np.radians(np.arange(0, 37.6, 0.5)))
    for strength in (0.2, 1.0, 3.0):
        material = GltfMaterial(0.4, strength, 1.45)
        white = WhiteAtGrazing(**vars(material))
        look = SurfaceLook(PICTURE, white.roughness, white.normal_reflectance)
        assert np.abs(white.fresnel(cosines) - material.fresnel(cosines)).max() < 4e-4
        np.testing.assert_allclose(white.fresnel(cosines), exact_reflectance(cosines, look.index), atol=0.005)
        assert white.fresnel(np.array(0.0)) == pytest.approx(1)
        assert exact_reflectance(1e-9, look.index) == pytest.approx(1)


def test_a_missing_package_is_told_with_the_command_that_installs_it(tmp_path, monkeypatch):
    for package in ("usd-core", "materialx"):
        monkeypatch.setitem(MODULES, package, "nobody_has_this")
    with pytest.raises(UserError, match=r"\./nishiki install --extras export"):
        write_usdz(tmp_path / "a.usdz", MESH, PAINTING, name="a", facts={})
    with pytest.raises(UserError, match=r"\./nishiki install --extras export"):
        write_materialx(tmp_path / "a.mtlx", PAINTING, facts={})
    assert list(tmp_path.iterdir()) == []
