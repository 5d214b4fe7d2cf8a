"""Exports of a painting, read back by the libraries of other programs."""

import importlib.util
import io
import json
import re
import shutil
import subprocess
import zipfile
from dataclasses import replace
from types import SimpleNamespace
from typing import get_args

import numpy as np
import OpenEXR
import pytest
import tifffile
import trimesh
from pages import make_artifact
from PIL import Image, ImageCms
from small_painting import COLUMNS, PITCH_MM, ROWS, STAMP, dome, export_context, small_painting

from nishiki.artifacts.finite import expect_finite
from nishiki.artifacts.maps import MapWriter
from nishiki.brdf.torrance_sparrow import specular
from nishiki.cli import FORMATS
from nishiki.colour.colour import (
    delta_e_2000,
    illuminant,
    srgb_encode,
    white_xyz,
    xyz_from_spectra,
    xyz_to_lab,
    xyz_to_srgb_linear,
)
from nishiki.errors import UserError
from nishiki.formats.exr_bands import ExrWriter, read_blocks
from nishiki.formats.picture_tiles import read_full_resolution, read_jpeg, write_deep_zoom, write_iiif_image
from nishiki.formats.tiff_bands import TiffWriter
from nishiki.packages import installed
from nishiki.render.display import normals_as_colours
from nishiki.render.plane.frame import render
from nishiki.render.plane.scene import Gloss, Light, PlaneScene, View
from nishiki.stages.export.declaration import ExportSettings, Format
from nishiki.stages.export.gltf_material import GltfMaterial, fitted_material
from nishiki.stages.export.iiif import manifest
from nishiki.stages.export.light_models import HarmonicModel, ptm_weights, solve
from nishiki.stages.export.look import textures
from nishiki.stages.export.relief_mesh import reliefs
from nishiki.stages.export.report import export_section
from nishiki.stages.export.run import run
from nishiki.stages.export.scene import ExportedScene
from nishiki.stages.height.declaration import HeightSettings

LAMPS = [(np.sin(a) * 0.7, np.cos(a) * 0.7, 0.714) for a in np.radians([10, 100, 190, 280])]

OF_PACKAGES = {"usd": "usd-core", "materialx": "materialx"}
FORMATS_HERE = tuple(name for name in get_args(Format) if installed(OF_PACKAGES.get(name, "numpy")))
"""Formats that can be written: those of the extra `export` only where it is installed."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The painting, the folder of its exports in all formats, and what the stage reports."""
    folder = tmp_path_factory.mktemp("painting")
    painting = small_painting(folder)
    context = export_context(painting, folder / "export", ExportSettings(formats=FORMATS_HERE))
    with context.output as output:
        reported = run(context)
        expect_finite(output.folder, "export")
        yield SimpleNamespace(painting=painting, folder=output.folder / "exports", reported=reported)


def shaded(normals, lamp):
    return np.maximum(normals @ np.asarray(lamp), 0)


def test_normals_say_their_convention_and_lose_a_thousandth_of_a_degree(exported):
    with tifffile.TiffFile(exported.folder / "normals.tif") as tiff:
        coded, page = tiff.asarray(), tiff.pages[0]
        assert "y up" in page.description
        assert f"nishiki.key={STAMP['key']}" in page.description
        assert page.tags["XResolution"].value[0] / page.tags["XResolution"].value[1] == pytest.approx(10 / PITCH_MM)
    assert coded.dtype == np.uint16
    known = exported.painting.known
    read = coded / 65535 * 2 - 1
    error = np.linalg.norm(read - exported.painting.normals, axis=-1)[known]
    assert np.degrees(error.max()) < 0.002
    assert not coded[~known].any()
    assert np.degrees(error.max()) == pytest.approx(exported.reported["losses"]["normals"]["largest_deg"], rel=0.3)
    with OpenEXR.File(str(exported.folder / "normals.exr"), separate_channels=True) as file:
        exact = np.stack([file.channels()[f"N.{axis}"].pixels for axis in "XYZ"], axis=-1)
        assert "y up" in file.header()["comments"]
    np.testing.assert_array_equal(exact[known], exported.painting.normals[known])


def test_a_moving_light_shows_the_same_relief_in_every_file(exported):
    painting, inner = exported.painting, (slice(2, -10), slice(2, -2))
    tiff = tifffile.imread(exported.folder / "normals.tif") / 65535 * 2 - 1
    height = tifffile.imread(exported.folder / "height.tif")
    down, right = np.gradient(height, PITCH_MM)
    slopes = np.stack([-right, down, np.ones_like(height)], axis=-1)
    from_height = slopes / np.linalg.norm(slopes, axis=-1, keepdims=True)
    mesh = trimesh.load(exported.folder / "height.ply", process=False)
    picture = np.full((ROWS, COLUMNS, 3), np.nan)
    column = np.rint(mesh.vertices[:, 0] / PITCH_MM + COLUMNS / 2 - 0.5).astype(int)
    row = np.rint(ROWS / 2 - 0.5 - mesh.vertices[:, 1] / PITCH_MM).astype(int)
    faces = mesh.face_normals
    of_vertices = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(of_vertices, corner, faces)
    picture[row, column] = of_vertices / np.linalg.norm(of_vertices, axis=1, keepdims=True)
    for lamp in LAMPS:
        true = shaded(painting.normals, lamp)[inner]
        np.testing.assert_allclose(shaded(tiff, lamp)[inner], true, atol=1e-4)
        np.testing.assert_allclose(shaded(from_height, lamp)[inner], true, atol=0.02)
        np.testing.assert_allclose(shaded(picture, lamp)[inner], true, atol=0.03)
        assert true.std() > 0.05


def test_the_height_has_its_scale_and_says_where_there_is_none(exported):
    with tifffile.TiffFile(exported.folder / "height.tif") as tiff:
        height, page = tiff.asarray(), tiff.pages[0]
        assert np.isnan(page.nodata)
        assert "Height in mm" in page.description
        assert page.tags[33550].value[:2] == (PITCH_MM, PITCH_MM)
        assert page.tags[33922].value[3:5] == (-COLUMNS * PITCH_MM / 2, ROWS * PITCH_MM / 2)
    known = exported.painting.known
    np.testing.assert_array_equal(np.isnan(height), ~known)
    np.testing.assert_allclose(height[known], exported.painting.height[known], atol=1e-6)
    mesh = trimesh.load(exported.folder / "height.ply", process=False)
    assert len(mesh.vertices) == known.sum()
    assert (mesh.face_normals[:, 2] > 0).all()
    given = mesh.vertex_normals
    assert np.einsum("ij,ij->i", given, exported.painting.normals[known]).min() > 0.999


def test_the_albedo_has_a_profile_by_which_colour_management_finds_the_colours(exported):
    with tifffile.TiffFile(exported.folder / "albedo.tif") as tiff:
        coded, profile = tiff.asarray(), tiff.pages[0].iccprofile
    lab_profile = ImageCms.createProfile("LAB", 5000)
    known = exported.painting.known
    white = white_xyz(illuminant("D50"))
    true = xyz_to_lab(xyz_from_spectra(illuminant("D50"), exported.painting.reflectance()), white)[known]
    source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    eight = Image.fromarray(np.rint(coded / 257).astype(np.uint8))
    transform = ImageCms.buildTransform(source, lab_profile, "RGB", "LAB", renderingIntent=1)
    managed = np.array(ImageCms.applyTransform(eight, transform)).astype(float)[known]
    signed = np.where(managed[:, 1:] > 127, managed[:, 1:] - 256, managed[:, 1:])
    read = np.column_stack([managed[:, 0] * 100 / 255, signed])
    assert delta_e_2000(read, true).mean() < 0.8  # both pictures have eight bits on the way
    assert exported.reported["losses"]["albedo"]["clipped"] == 0


def test_a_mesh_with_fewer_vertices_than_pixels_stays_in_place(exported, tmp_path):
    settings = ExportSettings(formats=("height",), mesh_vertices=300)
    context = export_context(exported.painting, tmp_path, settings)
    with context.output as output:
        reported = run(context)["losses"]["height"]
        coarse = trimesh.load(output.folder / "exports/height.ply", process=False)
    assert reported["pixels_a_vertex"] == 9
    assert len(coarse.vertices) <= 300
    fine = trimesh.load(exported.folder / "height.ply", process=False)
    np.testing.assert_allclose(coarse.bounds[:, :2], fine.bounds[:, :2], atol=1.5 * PITCH_MM)
    inside = np.abs(coarse.vertices[:, None, :2] - fine.vertices[None, :, :2]).max(axis=2) < 1.4 * PITCH_MM
    means = [fine.vertices[near, 2].mean() for near in inside]
    np.testing.assert_allclose(coarse.vertices[:, 2], means, atol=0.02)


def test_y_down_turns_green_only(exported, tmp_path):
    context = export_context(exported.painting, tmp_path, ExportSettings(formats=("normals",), normals_y="down"))
    with context.output as output:
        run(context)
        down = tifffile.imread(output.folder / "exports/normals.tif").astype(int)
    up = tifffile.imread(exported.folder / "normals.tif").astype(int)
    known = exported.painting.known
    np.testing.assert_array_equal(down[known][:, [0, 2]], up[known][:, [0, 2]])
    np.testing.assert_array_equal(down[known][:, 1], 65535 - up[known][:, 1])
    assert not down[~known].any()


def test_the_page_names_every_file_and_what_it_loses(exported):
    export = SimpleNamespace(diagnostics=exported.reported)
    (_, table) = export_section(export).blocks
    assert [row[0] for row in table.rows] == list(FORMATS_HERE)
    text = " ".join(str(cell) for row in table.rows for cell in row)
    assert all(path.name in text for path in exported.folder.iterdir())
    assert export_section(None) is None


@pytest.mark.parametrize("rows", [1, 16, 37])
def test_exr_by_bands_reads_as_it_was_written(tmp_path, rows):
    values = np.random.default_rng(rows).normal(size=(rows, 5, 3)).astype(np.float32)
    names = ("z", "a_name_that_is_longer_than_thirty_one_letters", "R")
    path = tmp_path / "bands.exr"
    with ExrWriter(path, names, rows, 5, {"unit": "mm", "factor": 0.5}) as writer:
        for start in range(0, rows, 7):
            writer.write(values[start : start + 7])
    with OpenEXR.File(str(path), separate_channels=True) as file:
        read = np.stack([file.channels()[name].pixels for name in names], axis=-1)
        assert (file.header()["unit"], file.header()["factor"]) == ("mm", 0.5)
    np.testing.assert_array_equal(read, values)
    blocks = np.concatenate(list(read_blocks(path))).transpose(0, 2, 1)
    np.testing.assert_array_equal(blocks, values[..., [2, 1, 0]])


def test_files_by_bands_refuse_missing_rows(tmp_path):
    with pytest.raises(ValueError, match="expected 4 rows, found 2"), ExrWriter(tmp_path / "a", "Y", 4, 3, {}) as exr:
        exr.write(np.zeros((2, 3, 1)))
    text = {"band_rows": 2, "description": "", "software": ""}
    with (
        pytest.raises(ValueError, match="expected 4 rows, found 2"),
        TiffWriter(tmp_path / "b", (4, 3, 1), "uint16", **text) as tiff,
    ):
        tiff.write(np.zeros((2, 3)))


def test_the_command_names_every_format():
    assert all(name in FORMATS for name in get_args(Format))


def pixels_of(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def rbf_weights(info, lights, light, openlime):
    """Weights of the captured lights (n, 3): by sigma, as relight's viewers, or as OpenLIME 1.2 computes them."""
    if openlime:
        distances = [float(np.hypot.reduce(each - light)) for each in lights]
        near = [np.exp(-2 * distance) for distance in distances]
        mean = sum(d * w for d, w in zip(distances, near, strict=True)) / sum(near)
        weights = np.array([np.exp(-8 / mean * distance**2) for distance in distances])
    else:
        weights = np.exp(-np.sum((lights - light) ** 2, axis=1) / info["sigma"] ** 2)
        weights[weights <= 0.001 * weights.sum()] = 0
    return weights / weights.sum()


def viewer_weights(info, light, openlime=False):
    """Weights (planes + 1, 3) of the mean and the planes as OpenLIME's shader computes them from info.json."""
    x, y, z = light
    if info["type"] == "rbf":
        lights = np.array(info["lights"]).reshape(-1, 3)
        weights = rbf_weights(info, lights, light, openlime)
        basis = np.array(info["basis"], float).reshape(info["nplanes"] + 1, len(lights), 3)
        basis[0] /= 255
        basis[1:] = (basis[1:] - 127) / np.array(info["materials"][0]["range"])[:, None, None]
        return np.einsum("l,plk->pk", weights, basis)
    if info["type"] == "ptm":
        bases = [1, x, y, x * x, x * y, y * y]
    else:
        phi, theta = np.arctan2(y, x), min(np.arccos(z), 3.1415 / 2 - 0.15)
        cosine, pi = np.cos(theta), np.pi
        root = np.sqrt(cosine - cosine**2)
        bases = [
            *(1 / np.sqrt(2 * pi), np.sqrt(6 / pi) * np.cos(phi) * root),
            *(np.sqrt(3 / (2 * pi)) * (2 * cosine - 1), np.sqrt(6 / pi) * root * np.sin(phi)),
            np.sqrt(30 / pi) * np.cos(2 * phi) * (-cosine + cosine**2),
            np.sqrt(30 / pi) * np.cos(phi) * (2 * cosine - 1) * root,
            np.sqrt(5 / (2 * pi)) * (1 - 6 * cosine + 6 * cosine**2),
            np.sqrt(30 / pi) * (2 * cosine - 1) * root * np.sin(phi),
            np.sqrt(30 / pi) * (-cosine + cosine**2) * np.sin(2 * phi),
        ]
    return np.concatenate([np.zeros((1, 3)), np.kron(np.array(bases)[:, None], np.eye(3))])


def shown_by_viewer(folder, light, openlime=False):
    """(rows, columns, 3): what OpenLIME computes from a relight folder for a light."""
    info = json.loads((folder / "info.json").read_text())
    count = info["nplanes"]
    planes = [pixels_of(folder / f"plane_{n}.jpg") for n in range(-(-count // 3))]
    texels = np.concatenate(planes, axis=-1)[..., :count] / 255
    material = info["materials"][0]
    coefficients = (texels - material["bias"]) * np.array(material["scale"])
    weights = viewer_weights(info, light, openlime)
    return weights[0] + coefficients @ weights[1:]


@pytest.mark.parametrize(("kind", "least"), [("ptm", 34), ("hsh", 34), ("rbf", 25), ("rbf in OpenLIME 1.2", 20)])
def test_a_relightable_image_shows_the_photographs_in_a_viewer(exported, kind, least):
    painting, folder = exported.painting, exported.folder / f"relight_{kind.split()[0]}"
    figures = exported.reported["losses"]["relight"]["kinds"][kind]["psnr_db"]
    wavelengths = [45, 28, 8]
    channels = painting.reflectance()[..., wavelengths]
    squares = []
    for light in painting.lights[-3:]:
        linear = np.maximum(painting.normals @ light, 0)[..., None] * channels
        difference = np.clip(shown_by_viewer(folder, light, "OpenLIME" in kind), 0, 1) - srgb_encode(linear)
        squares.append(np.mean(difference**2))
    decibels = -10 * np.log10(np.mean(squares))
    assert decibels == pytest.approx(figures["check"]["all"], abs=0.3)
    assert decibels > least
    assert figures["fitted"]["all"] > least
    assert figures["check"]["lights"] == 3


def test_a_ptm_file_shows_the_photographs(exported):
    """Decoded as the format's description says, without our reader."""
    data = (exported.folder / "relight_ptm/painting.ptm").read_bytes()
    version, layout, columns, rows, scale, bias, *_ = data.split(b"\n", 6)
    assert (version, layout, int(columns), int(rows)) == (b"PTM_1.2", b"PTM_FORMAT_RGB", COLUMNS, ROWS)
    codes = np.frombuffer(data[-ROWS * COLUMNS * 18 :], np.uint8).reshape(3, ROWS, COLUMNS, 6)[:, ::-1]
    terms = (codes - [int(each) for each in bias.split()]) * np.array([float(each) for each in scale.split()])
    squares = []
    for u, v, w in exported.painting.lights[-3:]:
        shown = (terms @ [u * u, v * v, u * v, u, v, 1]).transpose(1, 2, 0) / 255
        channels = exported.painting.reflectance()[..., [45, 28, 8]]
        linear = np.maximum(exported.painting.normals @ (u, v, w), 0)[..., None] * channels
        squares.append(np.mean((np.clip(shown, 0, 1) - srgb_encode(linear)) ** 2))
    figures = exported.reported["losses"]["relight"]["kinds"]["ptm file"]["psnr_db"]["check"]
    assert -10 * np.log10(np.mean(squares)) == pytest.approx(figures["all"], abs=0.3)
    assert figures["all"] > 34


def test_a_plane_of_light_that_falls_from_the_left_is_brighter_on_slopes_to_the_left(exported):
    left = shown_by_viewer(exported.folder / "relight_ptm", (-0.7, 0, 0.714))
    right = shown_by_viewer(exported.folder / "relight_ptm", (0.7, 0, 0.714))
    change = (left - right).mean(axis=-1).ravel()
    assert np.corrcoef(change, exported.painting.normals[..., 0].ravel())[0, 1] < -0.9
    normals = pixels_of(exported.folder / "relight_ptm/normals.jpg") / 255 * 2 - 1
    assert np.abs(normals - exported.painting.normals)[exported.painting.known].mean() < 0.02


def test_deep_zoom_tiles_hold_the_picture(tmp_path):
    rows, columns = np.mgrid[0:520, 0:300]
    picture = np.stack([rows // 4, columns // 2, (rows + columns) // 8], axis=-1).astype(np.uint8)
    write_deep_zoom(tmp_path, "plane_0", picture, tmp_path, 95)
    assert 'Width="300" Height="520"' in (tmp_path / "plane_0.dzi").read_text()
    levels = sorted(int(path.name) for path in (tmp_path / "plane_0_files").iterdir())
    assert levels == list(range(3))  # 4 tiles of 254 pixels hold 520 rows; OpenLIME asks for level 0 as a single tile
    assert read_jpeg(tmp_path / "plane_0_files/0/0_0.jpg").shape[:2] == (130, 75)
    assert read_jpeg(tmp_path / "plane_0_files/1/0_0.jpg").shape[:2] == (255, 150)
    assert read_jpeg(tmp_path / "plane_0_files/2/1_1.jpg").shape[:2] == (256, 47)
    read = np.concatenate([band for _, band in read_full_resolution(tmp_path, "plane_0", 520, 300)])
    assert np.abs(read.astype(int) - picture).mean() < 1
    assert np.abs(read.astype(int) - picture).max() < 12


def test_samples_that_are_not_valid_do_not_count():
    random = np.random.default_rng(4)
    lights = dome(14, 2)
    true = random.normal(size=(5, 6, 3)) * 0.1
    values = np.einsum("lb,nbk->nlk", ptm_weights(lights), true)
    spoilt, valid = values.copy(), np.ones((5, 14), bool)
    spoilt[2, 3], valid[2, 3] = 9, False
    np.testing.assert_allclose(solve(ptm_weights(lights), spoilt, valid, np.zeros((6, 6))), true, atol=1e-6)


def test_as_many_lights_as_terms_are_not_taken_for_a_perfect_fit():
    lights = dome(9, 1)
    values = np.random.default_rng(3).uniform(size=(50, 9, 3))
    assert HarmonicModel.of("hsh", lights, values, np.ones((50, 9), bool)).ridge > 0


def test_spectra_are_read_exactly(exported):
    painting = exported.painting
    true = (painting.coefficients @ painting.basis).astype(np.float32) * painting.known[..., None]
    with OpenEXR.File(str(exported.folder / "spectra.exr"), separate_channels=True) as file:
        channels = file.channels()
        assert file.header()["spectralLayoutVersion"] == "1.0"
        names = sorted(name for name in channels if name.startswith("T."))
        assert (names[0], names[30], names[-1]) == ("T.400,000000nm", "T.550,000000nm", "T.700,000000nm")
        np.testing.assert_array_equal(np.stack([channels[name].pixels for name in names], axis=-1), true)
        shown = np.stack([channels[name].pixels for name in "RGB"], axis=-1)
    d65 = xyz_to_srgb_linear(xyz_from_spectra(illuminant("D65"), true), white=white_xyz(illuminant("D65")))
    np.testing.assert_allclose(shown, d65, atol=0.02)  # seen under D50 and adapted
    assert exported.reported["losses"]["spectral"]["outside"] == np.mean((true < 0) | (true > 1))
    header = (exported.folder / "spectra.hdr").read_text()
    assert re.search(r"wavelength = \{400, 405, .*, 700\}", header)
    left, top = -COLUMNS * PITCH_MM / 2, ROWS * PITCH_MM / 2
    assert f"map info = {{Arbitrary, 1, 1, {left:g}, {top:g}, {PITCH_MM}, {PITCH_MM}, units=mm}}" in header
    bil = np.fromfile(exported.folder / "spectra.img", "<f4").reshape(ROWS, 61, COLUMNS)
    np.testing.assert_array_equal(bil.transpose(0, 2, 1), true)


def test_other_libraries_read_the_spectra(exported):
    envi = pytest.importorskip("spectral.io.envi", reason="the package spectral is not installed")
    image = envi.open(str(exported.folder / "spectra.hdr"), str(exported.folder / "spectra.img"))
    assert image.bands.centers == list(range(400, 701, 5))
    true = exported.painting.reflectance() * exported.painting.known[..., None]
    np.testing.assert_allclose(image.load(), true, atol=1e-6)


def test_colour_science_reads_the_spectral_exr(exported):
    pytest.importorskip("OpenImageIO", reason="OpenImageIO is not installed, which colour-science reads EXR with")
    from colour import read_spectral_image_Fichet2021

    components = read_spectral_image_Fichet2021(str(exported.folder / "spectra.exr"))
    wavelengths, values = components["T"][:2]
    np.testing.assert_allclose(wavelengths, np.arange(400, 701, 5))
    true = exported.painting.reflectance() * exported.painting.known[..., None]
    np.testing.assert_allclose(values, true, atol=1e-6)


def test_a_scene_without_spectra_says_so(exported, tmp_path):
    inputs = {name: artifact for name, artifact in exported.painting.inputs.items() if name != "spectra"}
    painting = replace(exported.painting, inputs=inputs)
    context = export_context(painting, tmp_path, ExportSettings(formats=("spectral",)))
    with pytest.raises(UserError, match=r"needs spectra.*export\.formats"), context.output:
        run(context)


def test_gltf_is_the_displaced_plane_with_the_relief_in_its_normal_texture(exported):
    painting = exported.painting
    scene = trimesh.load(exported.folder / "painting.glb")
    (mesh,) = scene.geometry.values()
    assert len(mesh.vertices) == painting.known.sum()
    metres = mesh.vertices * 1000
    assert np.abs(metres[:, 2] - painting.height[painting.known]).max() < 1e-4
    assert metres[:, 0].max() == pytest.approx((COLUMNS / 2 - 0.5) * PITCH_MM, rel=1e-5)
    material = mesh.visual.material
    texel = np.rint(mesh.visual.uv * [COLUMNS, ROWS] - 0.5).astype(int)
    row, column = ROWS - 1 - texel[:, 1], texel[:, 0]  # trimesh counts from the bottom
    np.testing.assert_array_equal(np.stack([row, column]), np.nonzero(painting.known))
    coded = np.asarray(material.normalTexture)[row, column] / 255 * 2 - 1
    for lamp in LAMPS:
        np.testing.assert_allclose(shaded(coded, lamp), shaded(painting.normals[painting.known], lamp), atol=0.01)
    assert material.metallicFactor == 0
    assert material.roughnessFactor == exported.reported["losses"]["gltf"]["materials"][0]["roughness"]
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
    np.testing.assert_array_equal(textures(scene, 512)[1], upright)
    assert scene.normals(slice(0, ROWS))[..., 0].std() > 0.05


def test_the_fitted_lobe_of_gltf_looks_like_ours():
    beta, gamma, index = np.array([3.0, 0.4]), np.array([0.12, 0.5]), 1.45
    material = fitted_material(beta, gamma, index, 0.3)
    for degrees in (0, 10, 25, 50):
        angle = np.radians(degrees)
        light, view = np.array([np.sin(angle), 0, np.cos(angle)]), np.array([0, 0, 1.0])
        ours = 0.3 * light[2] + sum(
            specular(np.array([0, 0, 1.0]), light, view, beta=b, gamma=g, refractive_index=index)
            for b, g in zip(beta, gamma, strict=True)
        )
        base = material.base_colour(np.full((1, 3), 0.3))
        shown = material.shown(base, np.array([[0, 0, 1.0]]), light)[0, 0]
        assert srgb_encode(shown) == pytest.approx(srgb_encode(ours), abs=0.03)
    assert fitted_material(np.array([0.0]), np.array([0.9]), 1.45, 0.3).strength < 0.01


def test_the_material_of_gltf_is_that_of_the_specification():
    material = GltfMaterial(roughness=0.5, strength=1.0, index=1.5)
    light = np.array([0.6, 0, 0.8])
    half = np.array([0.6, 0, 1.8]) / np.sqrt(3.6)
    alpha2, fresnel_term = 0.5**4, 0.04 + 0.96 * (1 - half[2]) ** 5
    distribution = alpha2 / (np.pi * (half[2] ** 2 * (alpha2 - 1) + 1) ** 2)
    smith = 2 * 0.8 / (0.8 + np.sqrt(alpha2 + (1 - alpha2) * 0.64)) * 2 / (1 + 1)
    brdf = (1 - fresnel_term) * 0.2 / np.pi + fresnel_term * distribution * smith / (4 * 0.8)
    shown = material.shown(np.full((1, 3), 0.2), np.array([[0, 0, 1.0]]), light)
    np.testing.assert_allclose(shown[0], np.pi * 0.8 * brdf, rtol=1e-6)


def gltf_problems(path):
    """Errors and warnings of the validator of Khronos; skips without node or the validator."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed, which runs the validator of glTF")
    script = "const v=require('gltf-validator'),f=require('fs');v.validateBytes(new Uint8Array(f.readFileSync("
    script += "process.argv[1]))).then(r=>console.log(JSON.stringify(r.issues)))"
    done = subprocess.run([node, "-e", script, str(path)], capture_output=True, text=True, check=False)
    if "Cannot find module 'gltf-validator'" in done.stderr:
        pytest.skip("the npm package gltf-validator is not installed (set NODE_PATH to its folder)")
    issues = json.loads(done.stdout)
    return [each for each in issues["messages"] if each["severity"] < 2]


def test_gltf_is_valid(exported):
    assert gltf_problems(exported.folder / "painting.glb") == []


def plane_scene(painting):
    """The painting as our own renderer takes it."""
    normals = np.where(painting.known[..., None], painting.normals, np.float32(0))
    height = np.where(painting.known, painting.height, np.nan).astype(np.float32)
    gloss = Gloss([[0.6]], [[0.25]], [1.45])
    fields = {"coefficients": painting.coefficients, "basis": painting.basis, "pitch": PITCH_MM}
    return PlaneScene(normals, gloss=gloss, height=height, **fields)


def merl_value(table, light, view):
    """The MERL database's look-up: (3,) of the cell that two unit vectors above the surface fall into."""
    half = (light + view) / np.linalg.norm(light + view)
    theta, phi = np.arccos(half[2]), np.arctan2(half[1], half[0])
    about_z = np.array([[np.cos(phi), np.sin(phi), 0], [-np.sin(phi), np.cos(phi), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(theta), 0, -np.sin(theta)], [0, 1, 0], [np.sin(theta), 0, np.cos(theta)]])
    difference = about_y @ about_z @ light
    turn = np.arctan2(difference[1], difference[0]) % np.pi
    row = int(np.sqrt(np.degrees(theta) * 90))
    column = int(np.degrees(np.arccos(np.clip(difference[2], -1, 1))))
    return table[:, row, column, min(int(np.degrees(turn)), 179)] * [1 / 1500, 1.15 / 1500, 1.66 / 1500]


def test_a_merl_table_holds_the_reflection_model(exported):
    content = (exported.folder / "merl/region-0.binary").read_bytes()
    assert np.frombuffer(content, "<i4", 3).tolist() == [90, 90, 180]
    table = np.frombuffer(content, "<f8", offset=12).reshape(3, 90, 90, 180)
    assert (table[:, 89, 80, 90] < 0).all()  # the light is below the surface
    gloss = json.loads((exported.folder / "mitsuba/scene.json").read_text())["gloss"]
    beta, gamma = (np.array([float(v) for v in gloss[name].split()]) for name in ("beta", "gamma"))
    random, up = np.random.default_rng(0), np.array([0, 0, 1.0])
    errors = []
    for _ in range(400):
        light, view = random.normal((0, 0, 1.2), 1, size=(2, 3))
        light, view = light / np.linalg.norm(light), view / np.linalg.norm(view)
        if min(light[2], view[2]) < 0.3:
            continue
        value = merl_value(table, light, view)
        lobes = sum(
            specular(up, light, view, beta=b, gamma=g, refractive_index=gloss["index"])
            for b, g in zip(beta, gamma, strict=True)
        )
        body = value * np.pi - lobes / light[2]  # the colour, but for the surface's loss and the cells' size
        errors.append(body)
    body = np.median(errors, axis=0)
    with OpenEXR.File(str(exported.folder / "mitsuba/albedo.exr"), separate_channels=True) as file:
        colour = np.stack([file.channels()[name].pixels for name in "RGB"], axis=-1)
    srgb = colour[exported.painting.known].mean(axis=0)
    np.testing.assert_allclose(body, srgb, rtol=0.1)
    assert np.percentile(np.abs(errors - body), 90) < 0.1 * body.mean()


@pytest.fixture(scope="module")
def nishiki_paint(exported):
    """The exported module of Mitsuba, with a variant set."""
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (group path-tracing)")
    mitsuba.set_variant("scalar_rgb")
    spec = importlib.util.spec_from_file_location("nishiki_paint", exported.folder / "mitsuba/nishiki_paint.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("lamp", [(0.6, 0.1, 0.79), (-0.1, -0.05, 0.99)])
def test_mitsuba_renders_what_we_render(exported, nishiki_paint, lamp):
    import mitsuba

    painting = exported.painting
    folder = exported.folder / "mitsuba"
    flat = np.array(mitsuba.render(nishiki_paint.load([lamp], relief=False, samples=1, folder=folder)))
    light = Light(direction=lamp, spectrum=illuminant("D65"))
    scene = replace(plane_scene(painting), height=None)
    d65 = white_xyz(illuminant("D65"))
    ours = xyz_to_srgb_linear(render(scene, [light], View()).xyz, white=d65)
    known = painting.known & (ours.min(axis=-1) > 0.01)
    np.testing.assert_allclose(flat[known], ours[known], rtol=0.01)
    assert known.mean() > 0.9
    relief = np.array(mitsuba.render(nishiki_paint.load([lamp], samples=1, folder=folder)))
    inner = known.copy()
    inner[[0, -1]] = inner[:, [0, -1]] = False
    assert np.median(np.abs(relief[inner] - ours[inner])) < 0.01


def test_iiif_tiles_are_the_picture_and_the_manifest_is_one(exported):
    from iiif_prezi3 import Manifest

    folder = exported.folder / "iiif"
    text = (folder / "manifest.json").read_text(encoding="utf-8")
    manifest = Manifest(**json.loads(text))
    assert json.loads(manifest.json())["id"] == "http://localhost:8000/manifest.json"
    canvas = json.loads(text)["items"][0]
    assert (canvas["height"], canvas["width"]) == (ROWS, COLUMNS)
    assert canvas["service"][0]["physicalScale"] == PITCH_MM
    choices = canvas["items"][0]["items"][0]["body"]["items"]
    assert [choice["service"][0]["id"].rsplit("/", 1)[1] for choice in choices] == ["colour", "relief", "normals"]
    for choice in choices:
        picture = read_jpeg(folder / choice["id"].removeprefix("http://localhost:8000/"))
        assert picture.shape == (choice["height"], choice["width"], 3)
    read = (
        read_jpeg(folder / "normals" / f"0,0,{COLUMNS},{ROWS}" / f"{COLUMNS},{ROWS}" / "0" / "default.jpg") / 255 * 2
        - 1
    )
    known = exported.painting.known
    angle = np.degrees(
        np.arccos(np.clip((read * exported.painting.normals).sum(-1) / np.linalg.norm(read, axis=-1), -1, 1))
    )
    assert np.median(angle[known]) < 2
    losses = exported.reported["losses"]["iiif"]["jpeg_psnr_db"]
    coded = normals_as_colours(exported.painting.normals.astype(np.float32)) // 257
    error = ((read + 1) / 2 * 255 - coded)[known]
    assert losses["normals"] == pytest.approx(-10 * np.log10(np.mean((error / 255) ** 2)), abs=1)


@pytest.mark.parametrize("shape", [(700, 1300), (513, 512), (2500, 40), (3, 5)])
def test_iiif_files_are_those_that_a_viewer_asks_for(tmp_path, shape):
    y, x = np.mgrid[: shape[0], : shape[1]]
    picture = np.stack([x * 200 // shape[1], y * 200 // shape[0], (x + y) // 40 % 2 * 60 + 60], axis=-1).astype(
        np.uint8
    )
    write_iiif_image(tmp_path / "a", "https://a.example/a", picture, tmp_path, 95)
    info = json.loads((tmp_path / "a" / "info.json").read_text())
    assert (info["height"], info["width"]) == shape
    (tiles,) = info["tiles"]
    asked = {"full/max", *(f"full/{size['width']},{size['height']}" for size in info["sizes"])}
    for factor in tiles["scaleFactors"]:
        side = tiles["width"] * factor
        shown = np.zeros((-(-shape[0] // factor), -(-shape[1] // factor), 3), np.uint8)
        for top in range(0, shape[0], side):
            for left in range(0, shape[1], side):
                wide, high = min(side, shape[1] - left), min(side, shape[0] - top)
                size = -(-wide // factor), -(-high // factor)
                name = f"{left},{top},{wide},{high}/{size[0]},{size[1]}"
                tile = read_jpeg(tmp_path / "a" / name / "0" / "default.jpg")
                assert tile.shape == (size[1], size[0], 3)
                shown[top // factor : top // factor + size[1], left // factor : left // factor + size[0]] = tile
                asked.add(name)
        if factor == 1:
            assert np.abs(shown.astype(int) - picture).mean() < 2
    there = {path.parent.parent.relative_to(tmp_path / "a").as_posix() for path in tmp_path.glob("a/*/*/0/default.jpg")}
    assert there == asked
    whole = read_jpeg(tmp_path / "a" / "full" / "max" / "0" / "default.jpg")
    assert max(whole.shape) == min(max(shape), 1024)
    means = picture.reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(whole.reshape(-1, 3).mean(axis=0), means, atol=3)


def test_rights_of_a_manifest(exported):
    def stated(rights):
        ingest = exported.painting.inputs["ingest"]
        about = {**ingest.diagnostics["capture"], "rights": rights, "creator": "A. N. Other", "object_holder": "Museum"}
        inputs = {"ingest": SimpleNamespace(diagnostics={"capture": about})}
        context = SimpleNamespace(inputs=inputs, stamp=STAMP)
        return manifest(context, ExportedScene(exported.painting.inputs), "https://a.example")

    assert stated("https://creativecommons.org/licenses/by/4.0/")["rights"].endswith("by/4.0/")
    assert stated("Museum of X, all rights reserved")["requiredStatement"]["value"]["none"] == [
        "Museum of X, all rights reserved"
    ]
    plain = stated(None)
    assert not {"rights", "requiredStatement"} & set(plain)
    assert {"label": {"en": ["Photographs by"]}, "value": {"none": ["A. N. Other"]}} in plain["metadata"]
    assert {"label": {"en": ["Kept by"]}, "value": {"none": ["Museum"]}} in plain["metadata"]
