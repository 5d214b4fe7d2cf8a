"""Exports of a cloth, read back by the libraries of other programs and by slow references."""

import importlib.util
import json
import math
import re
import struct
from dataclasses import replace
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
import trimesh
from benchmarks.cloth_peers import Ward
from npm_packages import gltf_problems
from pages import make_artifact
from unit.test_cloth_render import QUAD
from unit.test_half_vector_table import look_up, read_bsdf

from nishiki.artifacts.artifact import ArtifactWriter
from nishiki.artifacts.declaration import parse
from nishiki.artifacts.stage import Context, expect_finite
from nishiki.brdf.cloth.store import save_brdf
from nishiki.geometry.turn import scale_camera
from nishiki.progress import Progress
from nishiki.render.cloth.scene import BrdfTable, ClothScene, Lamp, Matte
from nishiki.render.cloth.studio import RenderVariant, frame_camera, paper_below, render
from nishiki.render.cloth.surfaces import read_drape
from nishiki.stages.export import ClothExportSettings
from nishiki.stages.export import ClothFormat as Format
from nishiki.stages.export.cloth import (
    ExportedCloth,
    GltfCloth,
    camera_of,
    coded_error,
    errors,
    fitted_cloth,
    pairs,
    run,
)
from nishiki.stages.render import ClothRenderSettings
from nishiki.stages.render.cloth import lights_of
from nishiki.stages.report.capture import exports_section as exported_section

pytestmark = pytest.mark.slow

STAMP = {"scene": "small", "stage": "cloth_export", "key": "0" * 12, "version": "0.1.0"}
WARD = Ward(diffuse=np.array([0.05, 0.04, 0.1]), specular=np.full(3, 0.2), alpha_x=0.5, alpha_y=0.2)
SHINY = GltfCloth(
    base=np.array([0.1, 0.05, 0.02]), roughness=0.5, anisotropy=0.6, weight=0.9, specular_colour=np.full(3, 2.0),
    along_warp=True,
)  # fmt: skip


def inputs_of(folder, **shown):
    """What the stage reads: a model, and the settings of the pictures."""

    def fill(writer):
        save_brdf(writer.path("models/cloth/ward.npz"), WARD)
        told = {"default": "ward", "regions": ["cloth"], "models": {"cloth": {"ward": {"used": [0]}}}}
        writer.path("cloth_brdf.json").write_text(json.dumps(told))

    settings = parse(ClothRenderSettings, {"view": {"rows": 48, "columns": 48}, **shown}, "settings")
    return {
        "cloth_brdf": make_artifact(folder, None, fill, stamp=STAMP, stage="cloth_brdf"),
        "cloth_render": make_artifact(folder, settings, lambda writer: {}, stamp=STAMP),
    }


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """What was read, the folder of the exports in all formats, and what the stage reports."""
    folder = tmp_path_factory.mktemp("cloth")
    inputs = inputs_of(folder)
    with ArtifactWriter(folder / STAMP["key"]) as output:
        reported = run(
            Context(inputs, ClothExportSettings(formats=get_args(Format)), output, None, None, STAMP, Progress("small"))
        )
        expect_finite(output.folder, "cloth_export")
        cloth = ExportedCloth.of(inputs)
        yield SimpleNamespace(cloth=cloth, folder=output.folder / "exports", reported=reported)


def slow_reference(light, view):
    """The material SHINY by the formulas of the extensions' pages, term by term."""
    alpha = SHINY.roughness**2
    at, ab = alpha + (1 - alpha) * SHINY.anisotropy**2, alpha
    t, b = np.array([0.0, 1.0, 0.0]), np.array([-1.0, 0.0, 0.0])  # turned by 90 degrees from the weft
    h = (light + view) / np.linalg.norm(light + view)
    a2 = at * ab
    f = np.array([ab * (t @ h), at * (b @ h), a2 * h[2]])
    distribution = a2 * (a2 / (f @ f)) ** 2 / math.pi
    ggx_view = light[2] * math.hypot(at * (t @ view), ab * (b @ view), view[2])
    ggx_light = view[2] * math.hypot(at * (t @ light), ab * (b @ light), light[2])
    visibility = min(0.5 / (ggx_view + ggx_light), 1)
    schlick = SHINY.weight * (0.08 + 0.92 * (1 - view @ h) ** 5)
    return (1 - schlick) * SHINY.base / math.pi + schlick * distribution * visibility


def test_the_material_is_that_of_the_extensions():
    lights, views = (each[:20] for each in pairs(200, 3))
    found = SHINY.evaluate(lights, views)
    for k in range(20):
        np.testing.assert_allclose(found[k], slow_reference(lights[k], views[k]), rtol=1e-9)
    assert not SHINY.evaluate(lights * [1, 1, -1], views).any()


@pytest.mark.parametrize("along_warp", [False, True])
def test_the_fit_finds_a_material_again(along_warp):
    material = replace(SHINY, along_warp=along_warp)
    found = fitted_cloth(material, count=200)
    assert found.along_warp == along_warp
    for name, value in material.as_dict().items():
        np.testing.assert_allclose(getattr(found, name), value, atol=1e-3)
    assert coded_error(found, material) < 1e-4


def read_glb(path):
    """The document of a binary glTF file, and its attributes and indices as arrays."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def array(number):
        accessor = document["accessors"][number]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        return np.frombuffer(binary, kind, accessor["count"] * width, start).reshape(-1, width)

    primitive = document["meshes"][0]["primitives"][0]
    return document, {name: array(k) for name, k in primitive["attributes"].items()}, array(primitive["indices"])


def test_gltf_is_valid(exported):
    assert gltf_problems(exported.folder / "cloth.glb") == []


def test_other_programs_read_the_mesh(exported):
    (mesh,) = trimesh.load(exported.folder / "cloth.glb", process=False).geometry.values()
    given = exported.cloth.draped.surface.mesh
    np.testing.assert_allclose(mesh.vertices, given.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, given.triangles)
    np.testing.assert_allclose(mesh.vertex_normals, given.normals, atol=1e-5)
    material = mesh.visual.material
    told = exported.reported["losses"]["gltf"]["material"]
    assert material.doubleSided
    assert material.roughnessFactor == pytest.approx(told["roughness"])
    assert material.metallicFactor == 0


def test_tangents_run_along_the_weft_and_bitangents_along_the_warp(exported):
    document, arrays, _ = read_glb(exported.folder / "cloth.glb")
    tangents, normals, uv = (arrays[name].astype(float) for name in ("TANGENT", "NORMAL", "TEXCOORD_0"))
    np.testing.assert_allclose(np.sum(tangents[:, :3] * normals, axis=1), 0, atol=1e-5)
    assert (tangents[:, 3] == 1).all()
    side = round(len(uv) ** 0.5)
    grid = arrays["POSITION"].astype(float).reshape(side, side, 3)
    weft, warp = (np.gradient(grid, axis=axis).reshape(-1, 3) for axis in (0, 1))
    bitangents = np.cross(normals, tangents[:, :3])
    for direction, expected in ((weft, tangents[:, :3]), (warp, bitangents)):
        cosines = np.sum(direction * expected, axis=1) / np.linalg.norm(direction, axis=1)
        assert np.median(cosines) > 0.99
        assert np.percentile(cosines, 2) > 0.8  # cloth shears where it is pinched
    places = uv.reshape(side, side, 2)
    assert (np.diff(places[..., 0], axis=0) > 0).all(), "u runs along the weft"
    assert (np.diff(places[..., 1], axis=1) < 0).all(), "v runs down, against the warp"
    wide = read_drape()[-1, 0] - read_drape()[0, 0]
    np.testing.assert_allclose(grid[-1, 0] - grid[0, 0], wide, atol=1e-5)
    (material,) = document["materials"]
    anisotropy = material["extensions"]["KHR_materials_anisotropy"]
    assert anisotropy["anisotropyRotation"] == 0, "the ward lobe is wider along the weft"
    assert anisotropy["anisotropyStrength"] > 0.3
    assert "anisotropyTexture" in anisotropy, "Blender reads tangents only where there is one"
    assert document["extensionsUsed"] == sorted(material["extensions"])
    assert document["asset"]["extras"] == {**STAMP, "unit": "metres", "region": "cloth", "model": "ward"}


def test_the_loss_is_that_of_the_pictures(exported):
    told = exported.reported["losses"]["gltf"]
    assert errors(exported.cloth, exported.cloth.brdf)["psnr_db"]["all"] == pytest.approx(120)
    measured = told["against_model"]
    assert measured["pictures"] == 12
    assert measured["psnr_db"]["worst"] <= measured["psnr_db"]["all"]
    assert measured["psnr_db"]["all"] > 28
    material = GltfCloth(**{**told["material"], **{
        name: np.array(told["material"][name]) for name in ("base", "specular_colour")
    }})  # fmt: skip
    again = errors(exported.cloth, material)
    assert again["delta_e"]["mean"] == pytest.approx(measured["delta_e"]["mean"], rel=1e-6)
    turned = errors(exported.cloth, replace(material, along_warp=True))
    assert turned["delta_e"]["mean"] > 2 * measured["delta_e"]["mean"]


def test_a_surface_from_a_file_has_its_texture_coordinates_where_they_follow_the_weft(tmp_path):
    path = tmp_path / "quad.obj"
    path.write_text(QUAD)
    for number, (changes, expected) in enumerate([({}, True), ({"turned_deg": 30}, False), ({"weft": "y"}, False)]):
        inputs = inputs_of(tmp_path / str(number), mesh={"file": str(path), **changes})
        assert (ExportedCloth.of(inputs).draped.uv is not None) == expected


def test_the_page_names_the_file_and_its_loss(exported):
    (_, table) = exported_section(exported.reported).blocks
    (gltf, mitsuba, bsdf) = (row[:2] for row in table.rows)
    assert (gltf, mitsuba, bsdf) == (("gltf", "cloth.glb"), ("mitsuba", "mitsuba/"), ("bsdf", "cloth.bsdf"))
    assert all(re.search(r"\d dB .*CIEDE2000 \d", row[3]) for row in table.rows)


def test_a_bsdf_file_holds_the_model(exported):
    arrays = read_bsdf(exported.folder / "cloth.bsdf")
    light, eye = (each[:12] for each in pairs(200, 4))
    expected = exported.cloth.brdf.evaluate(light, eye) * eye[:, 2:]
    found = np.array([look_up(arrays, i, o) for i, o in zip(light, eye, strict=True)])
    np.testing.assert_allclose(found, expected, atol=0.1 * expected.max())
    assert np.median(np.abs(found / expected - 1)) < 0.02
    told = exported.reported["losses"]["bsdf"]["against_model"]
    assert told["psnr_db"]["all"] > exported.reported["losses"]["gltf"]["against_model"]["psnr_db"]["all"] + 10


@pytest.fixture(scope="module")
def nishiki_cloth(exported):
    """The exported module of Mitsuba, with a variant set."""
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (group path-tracing)")
    mitsuba.set_variant("scalar_rgb")
    spec = importlib.util.spec_from_file_location("nishiki_cloth", exported.folder / "mitsuba/nishiki_cloth.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.define()
    return module


def our_picture(cloth, camera, towards, *, paper, supersampling=1):
    """The cloth by our renderer with the exported table, under one lamp without a disc, and on this paper."""
    surfaces = [cloth.draped.surface]
    if paper:
        azimuth = np.radians(cloth.shown.view.azimuth_deg)
        surfaces.append(paper_below(surfaces[0].mesh.vertices, azimuth=azimuth))
    take = RenderVariant((*BrdfTable.of(cloth.brdf), Matte((cloth.shown.paper,) * 3)), (1.0,))
    lamps = [Lamp(direction=tuple(towards), radius=0.0)]
    scene = ClothScene.of(surfaces)
    return render(scene, [take], lamps, camera, supersampling=supersampling, within=0.0)[0]


@pytest.mark.parametrize("below", [False, True])
def test_mitsuba_renders_what_we_render(exported, nishiki_cloth, below):
    """Along the very rays of our samples: direct light on front and back, with cast shadows."""
    import mitsuba as mi

    cloth = exported.cloth
    scene = nishiki_cloth.description(folder=exported.folder / "mitsuba")
    lamps = [name for name in scene if name.startswith("lamp_")]
    assert len(lamps) == len(cloth.shown.lights)
    del scene[lamps[1]]
    camera = camera_of(cloth)
    if below:  # the back of the cloth
        del scene["paper"]
        camera = frame_camera(
            cloth.draped.surface.mesh.vertices, elevation=-1.0, azimuth=0.3, rows=48, columns=48, distance=3
        )
        scene[lamps[0]]["direction"] = [-0.3, 0.8, -0.5]
    scene[lamps[0]]["irradiance"]["value"] = [np.pi] * 3
    ours = our_picture(cloth, camera, -np.array(scene[lamps[0]]["direction"]), paper=not below)
    row, column = np.nonzero(ours.coverage)
    plane = (np.column_stack([column, row]) - camera.intrinsics[:2, 2]) / camera.intrinsics[0, 0]
    rays = np.column_stack([plane, np.ones(len(plane))]) @ camera.rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    loaded, sampler = mi.load_dict(scene), mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    integrator, origin = loaded.integrator(), camera.centre.tolist()
    theirs = np.array([integrator.sample(loaded, sampler, mi.Ray3f(origin, ray.tolist()))[0] for ray in rays])
    expected = ours.linear[row, column]
    lit, dark = (theirs > 1e-4).all(axis=1) & (expected > 1e-4).all(axis=1), (theirs < 1e-4).all(axis=1)
    np.testing.assert_allclose(theirs[lit], expected[lit], rtol=1e-3)
    assert lit.mean() > 0.3
    assert np.mean(dark != (expected < 1e-4).all(axis=1)) < 0.03, "few samples differ in whether they are in shadow"


def test_mitsuba_shows_the_picture_of_our_camera(exported, nishiki_cloth):
    import mitsuba as mi

    cloth = exported.cloth
    scene = nishiki_cloth.description(folder=exported.folder / "mitsuba", columns=24, samples=16)
    lamps = [name for name in scene if name.startswith("lamp_")]
    del scene[lamps[1]]
    theirs = np.array(mi.render(mi.load_dict(scene)))
    lamp = lights_of(cloth.shown)[0]
    azimuth = np.radians(cloth.shown.view.azimuth_deg)
    camera = scale_camera(camera_of(cloth), 0.5)
    ours = our_picture(cloth, camera, lamp.lamp(azimuth).direction, paper=True, supersampling=4).linear
    ours = ours * np.array(lamp.colour)
    assert theirs.sum() == pytest.approx(ours.sum(), rel=0.03)
    assert np.corrcoef(theirs.ravel(), ours.ravel())[0, 1] > 0.95


def test_mitsuba_shows_the_same_cloth_from_its_measured_material(exported, nishiki_cloth):
    """`cloth.bsdf` along the texture coordinates of `cloth.ply`, beside the model in Python."""
    import mitsuba as mi

    scene = nishiki_cloth.description(folder=exported.folder / "mitsuba", columns=24, samples=16)
    expected = np.array(mi.render(mi.load_dict(scene)))
    material = {"type": "measured", "filename": str(exported.folder / "cloth.bsdf")}
    scene["cloth"]["bsdf"] = {"type": "twosided", "bsdf": material}
    found = np.array(mi.render(mi.load_dict(scene)))
    assert np.mean(np.abs(found - expected)) < 0.01 * expected.mean()
    assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.999


def test_points_of_a_lamp_fill_its_disc(nishiki_cloth):
    direction = np.array([0.6, 0.64, 0.48])
    lamp = {"direction": direction.tolist(), "radius_deg": 3.0}
    np.testing.assert_allclose(nishiki_cloth.disc(lamp, 1), [direction], atol=1e-12)
    angles = np.degrees(np.arccos(nishiki_cloth.disc(lamp, 200) @ direction))
    assert angles.max() == pytest.approx(3, abs=0.05)
    assert np.mean(angles**2) == pytest.approx(4.5, rel=0.01), "evenly over the area"
