"""The course from a relightable image to a capture: what is told, what wins over it, and what its normals are worth."""

import shutil

import numpy as np
import pytest
from refusals import refused
from relightable_images import lrgb_file, write_relight
from small_painting import dome
from unit.test_capture_colmap import around, photographs, write_model
from unit.test_capture_meshroom import write_cameras

from nishiki.api import read_observations
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.relightable import lamps_for
from nishiki.colour.colour import decode, srgb_encode
from nishiki.formats.legacy_rti import write_ptm
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture
from nishiki.photometric.solve import estimate_normals
from nishiki.stages.export.light_models import HarmonicModel, ptm_weights


def test_a_capture_says_that_its_pictures_were_rendered(tmp_path):
    folder = tmp_path / "source"
    folder.mkdir()
    (folder / "relief.ptm").write_bytes(lrgb_file()[0])
    made = convert(folder, tmp_path / "c", region=(0, 0, 4, 6))
    assert {"rendered", "rendered-clipped"} == {each.kind for each in made.warnings}
    capture = load_capture(tmp_path / "c")
    assert capture.settings.rendered_from == "relief.ptm"
    assert (tmp_path / "c/relief.ptm").read_bytes() == (folder / "relief.ptm").read_bytes()
    assert "photographs" in capture.settings.notes
    assert capture.settings.camera.encoding == "srgb"
    problems = check_capture(tmp_path / "c", level="full")
    assert "rendered" in {each.kind for each in problems}
    assert "file-unlisted" not in {each.kind for each in problems}
    lamps = lamps_for(None)
    np.testing.assert_allclose(capture.directions, lamps.directions, atol=1e-8)
    (tmp_path / "own.lp").write_text("3\n0 0 1\n0.6 0 0.8\n0 0.6 0.8\n")
    made = convert(folder / "relief.ptm", tmp_path / "d", lights_file=tmp_path / "own.lp", encoding="linear")
    assert made.photographs == 3
    with pytest.raises(CaptureError, match="check"):
        convert(folder, tmp_path / "e", checks=("a",))
    (folder / "other.rti").write_bytes(b"")
    with pytest.raises(CaptureError, match="several"):
        convert(folder, tmp_path / "e")


@pytest.mark.parametrize("program", ["COLMAP", "Meshroom"])
def test_photographs_below_a_folder_win_over_its_relightable_images(tmp_path, program):
    source = tmp_path / "source"
    photographs(source / "images", [name for name, _, _ in around()])
    if program == "COLMAP":
        write_model(source / "sparse/0", "text")
    else:
        write_cameras(source)
    for name in ("finished.ptm", "finished.rti"):
        (source / name).write_bytes(lrgb_file()[0])
        assert convert(source, tmp_path / name).layout.endswith(f" {program}")
    write_relight(tmp_path / "r", "ptm", "lrgb", 9)
    shutil.copytree(tmp_path / "r", source, dirs_exist_ok=True)
    assert convert(source, tmp_path / "c").layout.endswith(f" {program}")


@pytest.mark.parametrize("found", ["a/circle_data.txt", "jpeg-exports/a.jpg"])
def test_spheres_and_projects_of_rtibuilder_win_over_a_relight_folder(tmp_path, found):
    write_relight(tmp_path / "r", "ptm", "lrgb", 9)
    (tmp_path / "r" / found).parent.mkdir()
    (tmp_path / "r" / found).touch()
    with refused(CaptureError, kind="layout-unknown"):
        convert(tmp_path / "r", tmp_path / "c")


def test_normals_survive_our_own_export(tmp_path):
    """A matte relief under 24 lamps: fitted, written and converted as a user would; normals by least squares."""
    rows, columns = 40, 48
    y, x = np.mgrid[0:rows, 0:columns] / 6
    normals = np.stack([0.35 * np.sin(x), 0.3 * np.cos(y + x / 2), np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    colour = np.array([0.5, 0.35, 0.2])
    lights = dome(24, 0)
    values = np.maximum(normals.reshape(-1, 3) @ lights.T, 0)[..., None] * colour
    coded = srgb_encode(values).transpose(1, 2, 0)
    model = HarmonicModel.of("ptm", lights, coded, np.ones((24, rows * columns), bool))
    fitted = model.fit(coded, np.ones((24, rows * columns), bool)).T.reshape(rows, columns, 6, 3)
    low, span = fitted.min(axis=(0, 1)), np.ptp(fitted, axis=(0, 1))
    planes = np.rint(255 * (fitted - low) / span).astype(np.uint8)
    write_ptm(tmp_path / "relief.ptm", [planes[:, :, term] for term in range(6)], span, -low / span)
    convert(tmp_path / "relief.ptm", tmp_path / "c")
    observed = read_observations(tmp_path / "c")
    field = estimate_normals(observed.values.mean(axis=-1), observed.directions, valid=observed.valid)
    exact = np.einsum("lb,rcbk->lrck", ptm_weights(observed.directions), fitted)  # what the fit says, in full precision
    unrounded = estimate_normals(decode(np.clip(exact, 0, 1), "srgb").mean(axis=-1), observed.directions)
    assert degrees_apart(field.normals, unrounded.normals).mean() < 0.3
    assert degrees_apart(field.normals, normals).mean() < 3.5  # the polynomials themselves


def degrees_apart(some, others):
    return np.degrees(np.arccos(np.clip((some * others).sum(axis=-1), -1, 1)))
