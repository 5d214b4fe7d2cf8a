"""Exports of a painting: normals, heights, albedo and spectra, read back by the libraries of other programs."""

import io
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import get_args

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
import trimesh
from PIL import Image, ImageCms
from refusals import refused
from small_painting import (
    COLUMNS,
    FORMATS_HERE,
    LAMPS,
    PITCH_MM,
    ROWS,
    STAMP,
    export_context,
    exported_painting,
    of_pixels,
    shaded,
)

from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_from_spectra, xyz_to_lab, xyz_to_srgb_linear
from nishiki.commands.results import FORMATS
from nishiki.errors import NotFinite, UserError
from nishiki.formats.banded_pictures import ExrWriter, write_tiff
from nishiki.stages.export import ExportSettings, Format
from nishiki.stages.export.painting import run
from nishiki.stages.report.capture import exports_section as exported_section

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The painting, the folder of its exports, and what the stage reports."""
    with exported_painting(tmp_path_factory.mktemp("painting"), FORMATS_HERE) as made:
        yield made


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
    own = of_pixels(mesh.vertices)
    picture[row[own], column[own]] = (of_vertices / np.linalg.norm(of_vertices, axis=1, keepdims=True))[own]
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
        assert " mm" in page.description
        assert page.tags[33550].value[:2] == (PITCH_MM, PITCH_MM)
        assert page.tags[33922].value[3:5] == (-COLUMNS * PITCH_MM / 2, ROWS * PITCH_MM / 2)
    known = exported.painting.known
    np.testing.assert_array_equal(np.isnan(height), ~known)
    np.testing.assert_allclose(height[known], exported.painting.height[known], atol=1e-6)
    mesh = trimesh.load(exported.folder / "height.ply", process=False)
    own = of_pixels(mesh.vertices)
    np.testing.assert_allclose(mesh.vertices[own, 2], exported.painting.height[known], atol=1e-6)
    outer = np.array([COLUMNS, ROWS]) * PITCH_MM / 2
    np.testing.assert_allclose(mesh.bounds[:, :2], [-outer, outer], rtol=1e-6)
    assert (mesh.face_normals[:, 2] > 0).all()
    given = mesh.vertex_normals[own]
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
    settings = ExportSettings(formats=("height",), mesh_vertices=400)
    context = export_context(exported.painting, tmp_path, settings)
    with context.output as output:
        reported = run(context)["losses"]["height"]
        coarse = trimesh.load(output.folder / "exports/height.ply", process=False)
    assert reported["pixels_a_vertex"] == 9
    assert len(coarse.vertices) <= 400
    fine = trimesh.load(exported.folder / "height.ply", process=False)
    np.testing.assert_allclose(coarse.bounds[:, :2], fine.bounds[:, :2], rtol=1e-6)
    coarse, fine = (mesh.vertices[of_pixels(mesh.vertices)] for mesh in (coarse, fine))
    inside = np.abs(coarse[:, None, :2] - fine[None, :, :2]).max(axis=2) < 1.4 * PITCH_MM
    means = [fine[near, 2].mean() for near in inside]
    np.testing.assert_allclose(coarse[:, 2], means, atol=0.02)


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
    (_, table) = exported_section(export.diagnostics).blocks
    assert [row[0] for row in table.rows] == list(FORMATS_HERE)
    text = " ".join(str(cell) for row in table.rows for cell in row)
    assert all(path.name in text for path in exported.folder.iterdir())
    losses = {row[0]: row[-1] for row in table.rows}
    assert re.search(r" [\d.]+ % ", losses["merl"])
    assert losses["height"] == "nothing"


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
    values[-1, 2, 1] = np.nan
    with refused(NotFinite, "bands.exr"), ExrWriter(path, names, rows, 5, {}) as writer:
        writer.write(values)


def test_files_by_bands_refuse_missing_rows(tmp_path):
    with refused(ValueError, "4", "2", by="_finish"), ExrWriter(tmp_path / "a", "Y", 4, 3, {}) as exr:
        exr.write(np.zeros((2, 3, 1)))
    text = {"description": "", "software": ""}
    with refused(ValueError, "4", "2", by="pack_bands"):
        write_tiff(tmp_path / "b", [np.zeros((2, 3), np.uint16)], (4, 3, 1), **text)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("samples", [1, 3])
def test_tiff_by_bands_reads_as_it_was_written(tmp_path, dtype, samples):
    values = (np.random.default_rng(0).random((37, 11, samples)) * 255).astype(dtype)
    path = tmp_path / "a.tif"
    bands = (values[start : start + 16] for start in range(0, 37, 16))
    write_tiff(path, bands, values.shape, description="µ", software="s", pitch_mm=0.5, icc=b"icc", nodata="nan")
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).reshape(values.shape)  # libtiff, which shares nothing with it
    np.testing.assert_array_equal(read[..., ::-1] if samples == 3 else read, values)


def test_the_command_names_every_format():
    assert all(name in FORMATS for name in get_args(Format))


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
    assert f"1, 1, {left:g}, {top:g}, {PITCH_MM}, {PITCH_MM}, units=mm}}" in header
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
    with refused(UserError, "spectra", "export.formats"), context.output:
        run(context)
