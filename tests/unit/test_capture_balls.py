"""Photographs with mirror balls in the frame and no lights file: traced scenes, and captures as people make them."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from mirror_rays import Scene, dome

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.options import ConvertOptions
from nishiki.capture.spheres import measure
from nishiki.capture.spheres import measure as balls
from nishiki.capture.spheres.optics import LampImage
from nishiki.capture.spheres.search import SpheresError
from nishiki.formats.masks import read_mask
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture

LAMPS = dome(9, 1e4, (0, 0, 0), lowest_deg=30)


def relief(rows, columns):
    """Normals (rows, columns, 3) of waves that return to their height at the edges."""
    y, x = np.mgrid[:rows, :columns].astype(float)
    across = 0.4 * np.cos(x / 7) * np.cos(y / 11)
    along = 0.4 * np.sin(y / 5 + x / 30)
    normals = np.stack([-across, along, np.ones_like(x)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def photographs(spheres, *, rows=220, columns=300, lamps=LAMPS, **options):
    """Spheres on a plane of which a rectangle in the middle is a relief; pitch of a quarter millimetre."""
    scene = Scene(spheres, rows=rows, columns=columns, floor=0, pitch=0.25, samples=4)
    normals = relief(rows - 90, columns - 170)
    for i, lamp in enumerate(lamps):
        picture = scene.photograph(lamp, size=250.0, seed=i, **options)
        shade = np.maximum(normals @ (lamp / np.linalg.norm(lamp)), 0)
        picture[45:-45, 85:-85] = 0.6 * shade + np.random.default_rng(i).normal(0, 0.003, shade.shape)
        yield np.clip(picture, 0, 1)


def written(folder, pictures):
    folder.mkdir()
    for i, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"IMG_{i + 1:04d}.png"), np.round(picture * 65535).astype(np.uint16))
    return folder


def angles_deg(capture, lamps):
    towards = lamps / np.linalg.norm(lamps, axis=1)[:, None]
    return np.degrees(np.arccos(np.clip((capture.lights.directions * towards).sum(axis=1), -1, 1)))


TWO = [((-27, 18, 7), 7), ((27, -18, 7), 7)]


def test_lamps_are_measured_on_balls_and_these_are_no_object(tmp_path):
    source = written(tmp_path / "dome", photographs(TWO))
    made = convert(source, tmp_path / "capture", ConvertOptions(examine=check_capture))
    assert {"lamps-from-balls", "balls-masked"} <= {problem.kind for problem in made.warnings}
    capture = load_capture(tmp_path / "capture")
    assert angles_deg(capture, LAMPS).mean() < 1.0
    mask = read_mask(tmp_path / "capture" / "mask.png")
    assert mask.mean() == pytest.approx(1 - 2 * np.pi * (1.1 * 28) ** 2 / (220 * 300), abs=0.005)
    assert not mask[int(109.5 - 18 * 4), int(149.5 - 27 * 4)]
    assert cv2.imread(str(tmp_path / "capture" / "mirror_balls.png")) is not None


@pytest.mark.parametrize(("outlines", "kind"), [(0, "layout-unknown"), (1, "layout-unknown"), (2, "lamps-unmeasured")])
def test_one_round_thing_without_highlights_is_no_mirror_ball(tmp_path, monkeypatch, outlines, kind):
    def fails(given):
        raise SpheresError("no highlights", SimpleNamespace(outlines=[None] * outlines))

    source = written(tmp_path / "dome", photographs(TWO))
    monkeypatch.setattr(balls, "measure_spheres", fails)
    with pytest.raises(CaptureError) as told:
        convert(source, tmp_path / "capture")
    assert told.value.problems[0].kind == kind


def test_a_photograph_without_its_flash_is_left_out_by_name(tmp_path):
    pictures = list(photographs(TWO[:1]))
    pictures[3] = pictures[3] * 0.02
    made = convert(written(tmp_path / "dome", pictures), tmp_path / "capture", ConvertOptions())
    assert [p.file for p in made.warnings if p.kind == "lamp-unmeasured"] == ["IMG_0004"]
    assert angles_deg(load_capture(tmp_path / "capture"), np.delete(LAMPS, 3, axis=0)).mean() < 2.0


def test_photographs_without_balls_are_refused(tmp_path):
    pictures = (picture[45:-45, 85:-85] for picture in photographs(TWO))
    with pytest.raises(CaptureError) as caught:
        convert(written(tmp_path / "dome", pictures), tmp_path / "capture", ConvertOptions())
    assert [problem.kind for problem in caught.value.problems] == ["layout-unknown"]


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(("kind", "left_out"), [("sound", []), ("window", ["IMG_2007"]), ("on-velvet", [])])
def test_balls_of_captures_as_people_make_them(data, tmp_path, kind, left_out):
    source = data / "faulty_captures" / "photographs" / f"13-spheres-{kind}"
    made = convert(source, tmp_path / "capture", ConvertOptions())
    assert [p.file for p in made.warnings if p.kind == "lamp-unmeasured"] == left_out
    turn = np.deg2rad(np.arange(14) * 360 / 14 + 7)
    height = np.deg2rad(np.where(np.arange(14) % 2, 25, 65))
    lamps = np.column_stack([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)])
    names = [f"IMG_{2001 + i}" for i in range(14)]
    used = np.array([name not in left_out for name in names])
    assert angles_deg(load_capture(tmp_path / "capture"), lamps[used]).mean() < 0.5
    found = {p.kind for p in check_capture(tmp_path / "capture", level="full")}
    assert not found & {"lights-axes-undecided", "file-unlisted"}


@pytest.mark.data
@pytest.mark.parametrize("folder", ["uw_owl", "uw_horse", "uw_cat", "uw_gray", "psbox_cat/Objects"])
def test_no_ball_is_found_where_there_is_none(data, tmp_path, folder):
    source = tmp_path / "source"
    source.mkdir()
    for path in (data / folder).glob("*.png"):
        if "mask" not in path.name:
            shutil.copy(path, source)
    with pytest.raises(CaptureError) as caught:
        convert(source, tmp_path / "capture", ConvertOptions())
    assert caught.value.problems[0].kind == "layout-unknown"


def test_a_highlight_of_another_size_counts_only_where_no_other_ball_shows_the_lamp():
    """Light that a ball throws on the ground, seen in the other ball, has passed for the lamp."""
    found = np.empty((6, 2), object)
    for lamp, ball in np.ndindex(found.shape):
        found[lamp, ball] = LampImage(np.zeros(2), 0.1, 4.0, 1.0, 0.0, False)
    for lamp, ball in ((2, 1), (3, 0), (3, 1)):
        found[lamp, ball] = replace(found[lamp, ball], area_px=40.0)
    findings = SimpleNamespace(outlines=[None, None], highlights=found, left_out={})
    sightings, warnings = measure._sightings(findings, [f"{i}" for i in range(6)])
    used = {(s.lamp, s.sphere) for s in sightings}
    assert used == {(lamp, ball) for lamp in range(6) for ball in range(2)} - {(2, 1)}
    assert len(warnings) == 2
    assert not findings.left_out


@pytest.mark.parametrize(("tilt_deg", "named"), [(1.3, False), (5.6, True)])
def test_lamps_that_tilt_the_scene_are_named(tilt_deg, named):
    camera = SimpleNamespace(focal_px=None)
    measured = SimpleNamespace(
        findings=SimpleNamespace(outlines=[], camera=camera, left_out={}),
        fit=SimpleNamespace(direction_sigma=np.full(6, 0.02)),
        scene=SimpleNamespace(tilt_deg=tilt_deg),
    )
    kinds = {problem.kind for problem in balls._notes(Path("photographs"), measured, None, 6)}
    assert ("balls-tilted" in kinds) is named
