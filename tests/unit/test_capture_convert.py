"""Folders of photographs as they are found, made into captures."""

import cv2
import numpy as np
import pytest
from captures import RING, write_frame
from refusals import refused

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.seal import sha256_of
from nishiki.capture.spheres.optics import direction_from_sphere
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture

LIGHTS = [tuple(v) for v in np.array(RING)]


def photographs(folder, names, channels=3, seed=0):
    rng = np.random.default_rng(seed)
    for name in names:
        write_frame(folder / name, rng.integers(10, 200, (16, 24, channels)), np.uint8)


def lines(names=None):
    rows = [f"{x:.6f} {y:.6f} {z:.6f}" for x, y, z in LIGHTS]
    rows = rows if names is None else [f"{n} {row}" for n, row in zip(names, rows, strict=True)]
    return f"{len(rows)}\n" + "\n".join(rows) + "\n"


def test_named_lights_with_a_mask_and_pictures_that_do_not_belong(tmp_path):
    source = tmp_path / "source"
    names = [f"IMG_{i}.png" for i in range(5)]
    photographs(source, [*names, "preview.png"])
    write_frame(source / "object_mask.png", np.full((16, 24, 1), 255), np.uint8)
    (source / "dome.lp").write_text(lines([f"C:\\dome\\{n}" for n in names]))
    before = {p.name: (sha256_of(p), p.stat().st_mtime_ns) for p in source.iterdir()}
    made = convert(source, tmp_path / "c", checks=("IMG_3",), title="Five lights", region=(0, 0, 8, 12))
    assert {w.kind for w in made.warnings} == {"photograph-unlisted", "encoding-assumed"}
    capture = load_capture(tmp_path / "c")
    assert [f.role for f in capture.observed] == ["sample"] * 3 + ["check", "sample"]
    assert capture.settings.title == "Five lights"
    assert capture.mask is not None
    assert not [p for p in check_capture(tmp_path / "c", level="full") if p.severity == "error"]
    np.testing.assert_allclose(capture.lights.vectors, LIGHTS, atol=1e-6)
    assert {p.name: (sha256_of(p), p.stat().st_mtime_ns) for p in source.iterdir()} == before


def test_directions_without_names_follow_the_natural_order(tmp_path):
    source = tmp_path / "source"
    photographs(source, [f"cat.{i}.png" for i in (8, 9, 10, 11, 12)])
    photographs(source, ["cat.mask.png"])
    (source / "lights.lp").write_text(lines())
    made = convert(source, tmp_path / "c", link=True)
    assert "lights-in-order" in {w.kind for w in made.warnings}
    capture = load_capture(tmp_path / "c")
    assert [f.file for f in capture.observed] == [f"frames/cat.{i}.png" for i in (8, 9, 10, 11, 12)]
    assert (tmp_path / "c/frames/cat.8.png").stat().st_ino == (source / "cat.8.png").stat().st_ino


def test_diligent_with_file_names_and_intensities(tmp_path):
    source = tmp_path / "source"
    photographs(source, ["b.png", "a.png", "d.png", "c.png", "e.png", "mask.png"])
    (source / "light_directions.txt").write_text(lines().split("\n", 1)[1])
    (source / "light_intensities.txt").write_text("1 2 3\n" * 4 + "4 5 6\n")
    (source / "filenames.txt").write_text("b.png\na.png\nd.png\nc.png\ne.png\n")
    made = convert(source, tmp_path / "c")
    assert "lights-in-order" not in {w.kind for w in made.warnings}
    capture = load_capture(tmp_path / "c")
    assert [f.light for f in capture.observed] == ["b", "a", "d", "c", "e"]
    np.testing.assert_array_equal(capture.intensities[-1], [4, 5, 6])


def test_white_and_dark_folders(tmp_path):
    names = [f"{i}.png" for i in range(5)]
    for place in ("source", "boards"):
        photographs(tmp_path / place, names)
    photographs(tmp_path / "caps", ["x.png"])
    (tmp_path / "source/lights.lp").write_text(lines(names))
    convert(tmp_path / "source", tmp_path / "c", white=tmp_path / "boards", dark=tmp_path / "caps")
    capture = load_capture(tmp_path / "c")
    assert capture.white_of("3").file == "white/3.png"
    assert len(capture.frames_of("dark")) == 1


def sphere_picture(light, centre=(60.0, 70.0), radius=50.0, shape=(130, 150)):
    """A mirror sphere under one lamp of finite size, each pixel traced by the mirror law."""
    rows, columns = np.indices(shape)
    x, y = (columns - centre[1]) / radius, -(rows - centre[0]) / radius
    inside = x**2 + y**2 < 1
    z = np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))
    mirrored = np.stack([2 * z * x, 2 * z * y, 2 * z * z - 1], axis=-1)
    light = np.asarray(light) / np.linalg.norm(light)
    return np.where(inside, 20 + 235 * (mirrored @ light > np.cos(0.08)), 5.0)


@pytest.mark.parametrize("light", [(0, 0, 1), (0.5, 0.3, 0.8), (-0.7, 0.2, 0.5), (0.2, -0.8, 0.4)])
def test_a_mirror_sphere_shows_where_the_lamp_is(light):
    found = direction_from_sphere(sphere_picture(light), (60.0, 70.0), 50.0)
    expected = np.asarray(light) / np.linalg.norm(light)
    assert np.degrees(np.arccos(found @ expected)) < 1.0


def test_a_sphere_without_a_highlight_is_refused():
    with refused(ValueError, by="direction_from_sphere"):
        direction_from_sphere(np.full((50, 50), 7.0), (25, 25), 20)


def test_spheres_beside_the_object(tmp_path):
    """Rows of the circles are counted from the bottom, as PSBox writes them; finished images do not matter."""
    source = tmp_path / "source"
    source.mkdir()
    for name in ("finished.ptm", "finished.rti"):
        (source / name).write_bytes(b"")
    photographs(source / "object", [f"Image_{i:02d}.png" for i in range(5)], channels=1)
    for probe, centre in (("Probe-1", (60.0, 70.0)), ("Probe-2", (64.0, 75.0))):
        for i, light in enumerate(LIGHTS):
            picture = sphere_picture(light, centre)[..., None]
            write_frame(source / probe / f"Image_{i:02d}.png", picture, np.uint8)
        (source / probe / "circle_data.txt").write_text(f"{centre[1] + 1}\n{len(picture) - centre[0]}\n50\n")
    made = convert(source, tmp_path / "c")
    assert made.layout.endswith(" spheres")
    capture = load_capture(tmp_path / "c")
    assert capture.settings.camera.channels == ("grey",)
    cosines = (capture.directions * (np.array(LIGHTS) / np.linalg.norm(LIGHTS, axis=1, keepdims=True))).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 1.0


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda s: (s / "lights.lp").unlink(), "layout-unknown"),
        (lambda s: (s / "b.lp").write_text("1\n"), "layout-unknown"),
        (lambda s: (s / "2.png").unlink(), "photographs-count"),
        (lambda s: (s / "lights.lp").write_text(lines([f"{i}.tif" for i in range(1, 6)])), "photograph-missing"),
    ],
)
def test_folders_that_cannot_be_understood(tmp_path, change, kind):
    source = tmp_path / "source"
    photographs(source, [f"{i}.png" for i in range(5)])
    (source / "lights.lp").write_text(lines())
    change(source)
    with pytest.raises(CaptureError) as caught:
        convert(source, tmp_path / "c")
    assert caught.value.problems[0].kind == kind
    assert not (tmp_path / "c").exists()
    assert not list(tmp_path.glob(".*"))


def test_nothing_is_overwritten(tmp_path):
    photographs(tmp_path / "source", [f"{i}.png" for i in range(5)])
    (tmp_path / "source/lights.lp").write_text(lines())
    (tmp_path / "c").mkdir()
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "source", tmp_path / "c")
    assert caught.value.problems[0].kind == "target-exists"


EXPECTED = {
    "uw_gray": (12, "directions in order"),
    "uw_cat": (12, "directions in order"),
    "uw_chrome": (12, "directions in order"),
    "diligent_ball": (96, "DiLiGenT"),
    "diligent_cat": (96, "DiLiGenT"),
    "psbox_cat": (12, "mirror spheres"),
    "rti_fossil": (41, "lights file"),
}


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long) if name.endswith("_cat") else name for name in EXPECTED]
)
def test_measured_folders(data, tmp_path, name):
    made = convert(data / name, tmp_path / name)
    assert (made.photographs, made.layout) == EXPECTED[name]
    capture = load_capture(tmp_path / name)
    level = "quick" if name == "rti_fossil" else "full"
    assert not [p for p in check_capture(tmp_path / name, level=level) if p.severity == "error"]
    assert (capture.mask is not None) == (name not in ("psbox_cat", "rti_fossil"))
    assert (capture.intensities is not None) == name.startswith("diligent")
    assert capture.settings.camera.encoding == ("srgb" if name == "rti_fossil" else "linear")


@pytest.mark.data
def test_lamps_from_the_measured_mirror_sphere_agree_with_its_lights_file(data):
    """The file's directions and those of the highlights differ by about 3 degrees in these measurements."""
    folder = data / "uw_chrome"
    mask = cv2.imread(str(folder / "chrome.mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    rows, columns = np.nonzero(mask)
    radius = np.sqrt(mask.sum() / np.pi)
    given = np.array([line.split() for line in (folder / "lights.lp").read_text().split("\n")[1:13]], float)
    angles = []
    for i in range(12):
        image = cv2.imread(str(folder / f"chrome.{i}.png"), cv2.IMREAD_GRAYSCALE)
        found = direction_from_sphere(image, (rows.mean(), columns.mean()), radius)
        angles.append(np.degrees(np.arccos(found @ given[i] / np.linalg.norm(given[i]))))
    assert np.mean(angles) < 4.0
    assert np.median(angles) < 3.0


@pytest.mark.parametrize(
    ("place", "given", "title"),
    [
        ("coin 1.5 mm", ".", "coin 1.5 mm"),
        ("coin 1.5 mm", "./", "coin 1.5 mm"),
        ("coin 1.5 mm/inner", "..", "coin 1.5 mm"),
        ("coin 1.5 mm/inner", "../../coin 1.5 mm/inner/..", "coin 1.5 mm"),
        (".", "coin 1.5 mm/", "coin 1.5 mm"),
        (".", "link", "link"),
        ("link", ".", "coin 1.5 mm"),
    ],
)
def test_the_title_is_the_name_of_the_folder_however_it_is_named(tmp_path, monkeypatch, place, given, title):
    source = tmp_path / "coin 1.5 mm"
    photographs(source, [f"{i}.png" for i in range(5)])
    (source / "lights.lp").write_text(lines())
    (source / "inner").mkdir()
    (tmp_path / "link").symlink_to(source)
    monkeypatch.chdir(tmp_path / place)
    made = convert(given, tmp_path / "c")
    assert load_capture(tmp_path / "c").settings.title == title
    assert {each.file for each in made.warnings} == {title}


def test_a_folder_of_photographs_is_proposed_before_that_of_their_masks(tmp_path):
    for name in ("masks", "photographs"):
        write_frame(tmp_path / name / "a.png", np.full((8, 8, 1), 100))
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path, tmp_path / "c")
    assert f"./nishiki run {tmp_path / 'photographs'};" in caught.value.problems[0].remedy
