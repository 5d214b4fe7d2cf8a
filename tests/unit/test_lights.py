"""The dialects of lights files."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from nishiki.capture.lights import direction_problems, light_name, read_lights
from nishiki.formats.problems import CaptureError

THREE = np.array([[0.1, 0.2, 0.9], [-0.3, 0.4, 0.8], [0.5, -0.6, 0.7]])
DIALECTS = {
    "named": "3\na.jpg 0.1 0.2 0.9\nb.jpg -0.3 0.4 0.8\nc.jpg 0.5 -0.6 0.7\n",
    "bare": "3\n0.1 0.2 0.9\n-0.3 0.4 0.8\n0.5 -0.6 0.7\n",
    "decimal commas": "3\na.jpg 0,1 0,2 0,9\nb.jpg -0,3 0,4 0,8\nc.jpg 0,5 -0,6 0,7\n",
    "bare decimal commas": "3\n0,1 0,2 0,9\n-0,3 0,4 0,8\n0,5 -0,6 0,7\n",
    "commas between": "3\na.jpg,0.1,0.2,0.9\nb.jpg,-0.3,0.4,0.8\nc.jpg,0.5,-0.6,0.7\n",
    "commas and blanks": "3\na.jpg, 0.1, 0.2, 0.9\nb.jpg, -0.3, 0.4, 0.8\nc.jpg, 0.5, -0.6, 0.7\n",
    "semicolons and decimal commas": "3\na.jpg;0,1;0,2;0,9\nb.jpg;-0,3;0,4;0,8\nc.jpg;0,5;-0,6;0,7\n",
    "tabs": "3\na.jpg\t0.1\t0.2\t0.9\nb.jpg\t-0.3\t0.4\t0.8\nc.jpg\t0.5\t-0.6\t0.7\n",
    "exponents": "3\na.jpg 1e-1 2E-1 9e-1\nb.jpg -3e-1 4e-1 8e-1\nc.jpg 5e-1 -.6 .7\n",
    "absolute": "3\n/home/x/a.jpg 0.1 0.2 0.9\n/home/x/b.jpg -0.3 0.4 0.8\n/home/x/c.jpg 0.5 -0.6 0.7\n",
    "windows": "3\r\nC:\\My photos\\a.jpg 0.1 0.2 0.9\r\nC:\\b.jpg -0.3 0.4 0.8\r\nD:\\x y\\c.jpg 0.5 -0.6 0.7\r\n",
    "quoted with blanks": '3\n"my a.jpg" 0.1 0.2 0.9\n"b.jpg" -0.3 0.4 0.8\nc.jpg 0.5 -0.6 0.7\n',
    "mark, blank lines, comments": "\ufeff\n# dome 2\n3\n\na.jpg 0.1 0.2 0.9  # top\n\n"
    "b.jpg -0.3 0.4 0.8\nc.jpg 0.5 -0.6 0.7\n\n\n",
    "no last line end": "3\na.jpg 0.1 0.2 0.9\nb.jpg -0.3 0.4 0.8\nc.jpg 0.5 -0.6 0.7",
}


def write(folder, text, name="lights.lp"):
    path = folder / name
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize("dialect", DIALECTS)
def test_every_dialect_gives_the_same_lights(tmp_path, dialect):
    lights = read_lights(write(tmp_path, DIALECTS[dialect]))
    np.testing.assert_array_equal(lights.vectors, THREE)
    np.testing.assert_allclose(np.linalg.norm(lights.directions, axis=1), 1, rtol=1e-15)
    if "bare" in dialect:
        assert lights.names == ("1", "2", "3")
        assert lights.files == (None,) * 3
    else:
        assert [name[-1] for name in lights.names] == ["a", "b", "c"]


def test_names_may_hold_blanks_and_hashes(tmp_path):
    lights = read_lights(write(tmp_path, "1\nshot #3 of a.tif 0.1 0.2 0.9\n"))
    assert lights.names == ("shot #3 of a",)
    assert lights.files == ("shot #3 of a.tif",)
    assert lights.index("shot #3 of a.tif") == 0
    assert lights.find("another") is None


def test_non_unit_vectors_are_normalised_and_noted(tmp_path):
    lights = read_lights(write(tmp_path, "3\n1 2 9\n-30 40 80\n0.5 -0.6 0.7\n"))
    assert [w.kind for w in lights.warnings] == ["light-not-unit"]
    np.testing.assert_allclose(lights.directions[0], np.array([1, 2, 9]) / np.sqrt(86), rtol=1e-15)


def test_positions_are_not_expected_to_be_of_unit_length(tmp_path):
    lights = read_lights(write(tmp_path, "1\n300 -400 1200\n"), kind="position_mm")
    assert lights.warnings == ()
    np.testing.assert_allclose(lights.directions[0], np.array([3, -4, 12]) / 13, rtol=1e-15)


def test_direction_list_without_a_count(tmp_path):
    lights = read_lights(write(tmp_path, "0.1 0.2 0.9\n-0.3 0.4 0.8\n", "light_directions.txt"))
    assert len(lights.names) == 2


def test_tables(tmp_path):
    lights = read_lights(write(tmp_path, "light,x,y,z\nnorth,0,0.6,0.8\nzenith,0,0,1\n", "lights.csv"))
    assert lights.names == ("north", "zenith")
    np.testing.assert_allclose(lights.directions, [[0, 0.6, 0.8], [0, 0, 1]], atol=1e-15)
    angles = read_lights(write(tmp_path, "light,azimuth_deg,polar_deg\na,90,30\nb,0,0\n", "angles.csv"))
    np.testing.assert_allclose(angles.directions, [[0, 0.5, np.sqrt(0.75)], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("4\n" + DIALECTS["named"][2:], "lights-count"),
        ("2\n" + DIALECTS["named"][2:], "lights-count"),
        (DIALECTS["named"][2:], "lights-unreadable"),
        ("", "lights-unreadable"),
        ("0\n", "lights-none"),
        ("1\na.jpg 0.1 0.2\n", "lights-unreadable"),
        ("1\na.jpg 0.1 0.2 high\n", "lights-unreadable"),
        ("2\na.jpg 0.1 0.2 0.9\n0.1 0.2 0.9\n", "lights-unreadable"),
        ("1\na.jpg 0 0 0\n", "light-zero"),
        ("1\na.jpg nan 0 1\n", "light-not-finite"),
        ("1\na.jpg 0 inf 1\n", "light-not-finite"),
        ("1\na.jpg 0.5 0.5 -0.1\n", "light-behind"),
        ("1\na.jpg 1 0 0\n", "light-behind"),
        ("2\na.jpg 0 0 1\na.jpg 0.1 0 1\n", "light-duplicate"),
        ("2\nx/a.jpg 0 0 1\ny/a.png 0.1 0 1\n", "light-duplicate"),
    ],
)
def test_mistakes_are_named(tmp_path, text, kind):
    with pytest.raises(CaptureError) as caught:
        read_lights(write(tmp_path, text))
    assert caught.value.problems[0].kind == kind
    assert "lights.lp" in str(caught.value)


def test_all_mistakes_of_a_file_are_reported_together(tmp_path):
    with pytest.raises(CaptureError) as caught:
        read_lights(write(tmp_path, "4\na 0 0 0\nb 0 0 -1\nc nan 0 1\nc 0 0 1\n"))
    kinds = [p.kind for p in caught.value.problems]
    assert kinds == ["light-zero", "light-behind", "light-not-finite", "light-duplicate"]


def test_geometry_that_cannot_determine_a_normal():
    in_plane = np.array([[np.sin(a), 0, np.cos(a)] for a in (-0.9, -0.2, 0.1, 0.7)])
    assert [p.kind for p in direction_problems(in_plane, "f")] == ["lights-coplanar"]
    assert [p.kind for p in direction_problems(in_plane[:2], "f")] == ["lights-few"]
    bent = in_plane + np.array([0, 0.05, 0]) * np.eye(4)[:, :1]
    assert direction_problems(bent, "f") == []


def test_light_names_lose_folders_and_image_suffixes_only():
    assert light_name("C:\\a b\\IMG_1.JPG") == "IMG_1"
    assert light_name("az10.25") == "az10.25"
    assert light_name('"x/y/lamp.top"') == "lamp.top"


@pytest.mark.parametrize("line", ["frames/ 0 0 1", "frames\\\\ 0 0 1", "frames/.png 0 0 1", "'' 0 0 1"])
def test_a_lamp_without_a_name_is_refused(tmp_path, line):
    path = write(tmp_path, f"3\na.png 0.6 0 0.8\n{line}\nb.png 0 0.6 0.8\n")
    with refused(CaptureError, "2", kind="name-unusable"):
        read_lights(path)


coordinate = st.floats(-1e6, 1e6, allow_nan=False).filter(lambda v: v == 0 or abs(v) > 1e-6)


@given(st.lists(st.tuples(coordinate, coordinate, st.floats(1e-3, 1e6)), min_size=1, max_size=8), st.booleans())
def test_what_is_written_is_read(tmp_path_factory, vectors, comma):
    lines = [" ".join(repr(v) for v in vector) for vector in vectors]
    text = f"{len(vectors)}\n" + "\n".join(f"img {i}.png {line}" for i, line in enumerate(lines)) + "\n"
    if comma:
        head, *rest = text.split("\n")
        text = "\n".join([head, *(line.replace(".png", "@png").replace(".", ",").replace("@", ".") for line in rest)])
    path = write(tmp_path_factory.mktemp("lp"), text)
    lights = read_lights(path)
    np.testing.assert_array_equal(lights.vectors, np.array(vectors))
    np.testing.assert_allclose(np.linalg.norm(lights.directions, axis=1), 1, rtol=1e-12)


@pytest.mark.data
def test_measured_files(data):
    assert len(read_lights(data / "rti_fossil/lights.lp").names) == 41
    assert read_lights(data / "uw_gray/lights.lp").files == (None,) * 12
    assert len(read_lights(data / "diligent_ball/light_directions.txt").names) == 96
