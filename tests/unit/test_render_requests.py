"""Framing of the object by a pinhole camera, and the exposure of its picture."""

import numpy as np
import pytest
from refusals import expect_facts
from small_painting import small_painting

from nishiki.artifacts.declaration import at_bounds
from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.brdf.gloss_profile import GlossProfile
from nishiki.brdf.scene import parameters_at_bounds
from nishiki.evaluate.camera_colour import display_map
from nishiki.render.display import adapted_exposure, display_image
from nishiki.render.plane.frame import render, screen_to_plane
from nishiki.render.plane.scene import Light, PlaneScene
from nishiki.stages.render import LightSettings, SequenceSettings, ViewSettings
from nishiki.stages.render.painting import direction, film_view, load_scene, outline, view_of, white_sheet

FRAMES = {
    "fills the maps": ((300, 400), (0, 0, 300, 400)),
    "long": ((100, 900), (0, 0, 100, 900)),
    "tall": ((900, 100), (0, 0, 900, 100)),
    "small, off the middle": ((600, 700), (50, 40, 120, 60)),
}


def scene(shape, box) -> PlaneScene:
    """Flat normals in a box (row, column, rows, columns) of the maps."""
    normals = np.zeros((*shape, 3), np.float32)
    row, column, rows, columns = box
    normals[row : row + rows, column : column + columns, 2] = 1
    return PlaneScene(normals, np.ones((*shape, 3), np.float32), pitch=0.25)


def on_screen(view, of: PlaneScene, points) -> np.ndarray:
    """(2, N) share of the screen's width and height, 0 to 1 from edge to edge, of points (N, 3) of the plane."""
    places = np.linalg.solve(screen_to_plane(view, of), np.column_stack([points[:, :2], np.ones(len(points))]).T)
    return (places[:2] / places[2] + 0.5) / np.array([[view.columns], [view.rows]])


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize(
    ("elevation", "azimuth", "distance"), [(45, -90, 3), (20, 20, 1.5), (90, -90, 3), (60, 133, 9)]
)
def test_the_object_fills_the_picture(name, elevation, azimuth, distance):
    of = scene(*FRAMES[name])
    view = view_of(ViewSettings(kind="pinhole", elevation_deg=elevation, azimuth_deg=azimuth, distance=distance), of)
    row, column, rows, columns = FRAMES[name][1]
    x = (np.array([column, column + columns]) - of.shape[1] / 2) * of.pitch
    y = (of.shape[0] / 2 - np.array([row, row + rows])) * of.pitch
    corners = np.array([[a, b, 0.0] for a in x for b in y])
    assert max(view.rows, view.columns) == 1024
    for places in on_screen(view, of, corners):
        assert 0 <= places.min() < 0.035
        assert 0.965 < places.max() <= 1


@pytest.mark.parametrize(("rows", "columns"), [(768, 1024), (1024, 300), (None, 500), (400, None)])
def test_given_sides_are_kept_and_the_object_is_inside(rows, columns):
    of = scene(*FRAMES["small, off the middle"])
    view = view_of(ViewSettings(kind="pinhole", elevation_deg=40, rows=rows, columns=columns), of)
    assert rows in (None, view.rows)
    assert columns in (None, view.columns)
    places = on_screen(view, of, outline(of))
    spans = np.ptp(places, axis=1)
    assert places.min() >= 0
    assert places.max() <= 1
    assert spans.max() > 0.93
    np.testing.assert_allclose(places.min(axis=1) + places.max(axis=1), 1, atol=0.02)


def test_the_outline_of_nothing_is_that_of_the_maps():
    of = scene((4, 6), (0, 0, 0, 0))
    assert np.ptp(outline(of), axis=0).tolist() == [1.5, 1.0, 0.0]


def test_films_of_a_moving_view_have_even_sides():
    view = film_view(SequenceSettings(name="turn", moves="view", columns=333), scene((301, 407), (0, 0, 301, 407)))
    assert view.rows % 2 == view.columns % 2 == 0


def test_a_white_sheet_lies_in_the_plane():
    lamps = [LightSettings(elevation_deg=90, intensity=2.0), LightSettings(elevation_deg=30)]
    assert white_sheet(lamps, 0.05) == pytest.approx(2 + 0.5 + 0.05)


@pytest.mark.parametrize("level", [1e-3, 0.04, 0.26, 1.0])
def test_a_picture_in_raking_light_is_as_light_as_one_in_daylight(level):
    """The same reflectances under less light give the same 8-bit picture."""
    reflectance = np.random.default_rng(1).uniform(0.05, 0.7, (40, 50, 1)).astype(np.float32)
    xyz, seen = np.repeat(reflectance, 3, axis=2), np.ones((40, 50), bool)
    pictures = [
        display_image(light * xyz, exposure=adapted_exposure(light * xyz, seen=seen, sheet=light)).pixels.astype(int)
        for light in (1.0, level)
    ]
    assert np.abs(pictures[0] - pictures[1]).max() <= 8  # the exposure has two digits
    assert np.percentile(pictures[1].max(axis=2), 98) > 225


def test_exposure_is_bounded_and_looks_at_the_object_only():
    black = np.full((10, 10, 3), 0.01, np.float32)
    seen = np.ones((10, 10), bool)
    assert adapted_exposure(black, seen=seen, sheet=0.5) == 16  # a black object stays dark
    assert adapted_exposure(black, seen=seen, sheet=0.5, bounded=False) > 16  # without a board nobody knows it is black
    assert adapted_exposure(100 * black, seen=seen, sheet=0.1) == 5  # highlights do not darken everything
    black[:5] = 100
    seen[:5] = False
    assert adapted_exposure(black, seen=seen, sheet=0.5) == 16
    assert adapted_exposure(black, seen=~seen, sheet=0.0) == 1


def test_parameters_at_a_bound_are_named():
    free = {"beta": [2.0], "gamma": [0.3], "flags": []}
    assert parameters_at_bounds([free, free]) == []
    ladder = {"beta": [2.0], "gamma": [0.01], "flags": ["AT_BOUND"], "at_bounds": ["gloss: the narrowest"]}
    (text,) = parameters_at_bounds([ladder])
    assert text.startswith(ladder["at_bounds"][0])
    profile = GlossProfile(np.array([0.95, 0.05]), np.array([0.01, 0.9]))
    (text,) = profile.ends()
    expect_facts(text, "0.57", 95)
    inside, own = at_bounds({"weft": {"at_bounds": ["humps"]}, "at_bounds": ["n"], "other": 3})
    expect_facts(inside, "weft", "humps")
    assert own == "n"


@pytest.mark.parametrize("board", [True, False])
def test_without_a_white_board_the_light_parts_of_linear_photographs_are_grey(tmp_path, board):
    maps = MapWriter(tmp_path, rows=8, columns=8, band_rows=8, stamp={})
    maps.group.update(to_srgb=None, unbalanced=not board)
    colours = np.linspace(0.1, 0.6, 64).reshape(8, 8, 1) * np.array([0.5, 1, 2])
    maps.write("reflectance", colours.astype(np.float32))
    maps.write("flags", np.zeros((8, 8), np.uint8))
    matrix = display_map(Maps(tmp_path))
    assert (matrix is None) == board
    if not board:
        shown = colours @ np.array(matrix).T
        assert np.allclose(shown, shown[..., :1], rtol=1e-5)
        assert np.array(matrix) @ np.ones(3) @ [0.2126, 0.7152, 0.0722] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(("block", "elevation"), [(2, 70), (3, 70), (3, 20)])
def test_maps_that_are_averaged_as_they_are_read_give_the_mean_of_the_picture(tmp_path, block, elevation):
    """Of the pixels away from the corner without an estimate; under the steeper lamp gloss counts."""
    painting = small_painting(tmp_path)
    whole, small = (load_scene(painting.inputs, cast_shadows=True, block=b) for b in (1, block))
    assert small.pitch == block * whole.pitch
    lamp = [Light(direction=tuple(direction(elevation, 0)), angular_radius=0.01)]
    pictures = [render(scene, lamp).xyz[..., 1] for scene in (whole, small)]
    rows, columns = (side // block for side in painting.known.shape)

    def squares(values):
        return values[: rows * block, : columns * block].reshape(rows, block, columns, block)

    known = squares(painting.known).all(axis=(1, 3))
    expected = squares(pictures[0]).mean(axis=(1, 3))
    difference = (pictures[1][:rows, :columns] - expected)[known]
    assert np.sqrt(np.mean(difference**2)) < 0.015 * expected[known].mean()
    assert abs(difference.mean()) < 0.005 * expected[known].mean()
