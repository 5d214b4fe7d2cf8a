"""What a painting's page draws before all has come, and after: shadows of the worker, exposures, two states."""

import base64

import numpy as np
import pytest
import scipy.ndimage
import viewer_pages
from viewer_pages import lamp

from nishiki.artifacts.artifact import open_artifact
from nishiki.render.plane.scene import Light
from nishiki.render.plane.shade import cast_shadows
from nishiki.report.viewer import pyramid
from nishiki.report.viewer.pyramid import height_block
from nishiki.stages.viewer import painting as stage

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=viewer_pages.missing() or ""),
]
RAKING = (lamp(180, 7), lamp(180, 5, distance=1.5))
FRONTAL = {"x": 0, "y": 0, "zoom": 1, "tilt_deg": 0, "azimuth_deg": 0}


def test_shadows_of_lamps_at_rest_are_those_of_the_full_heights(finished_site, shown, tmp_path, monkeypatch):
    current = finished_site.folder / "results/tiny/current"
    scene = viewer_pages.plane_scene(
        {name: open_artifact(current / name) for name in ("normals", "height", "spectra", "brdf")}
    )
    rows, columns = scene.shape
    monkeypatch.setattr(stage, "RELIEFS", ((rows * columns // 16, 0.002), (16_000_000, 0.002)))
    states = [{"lamps": [each], "ambient": 0.0, "exposure": 2.0, "view": FRONTAL} for each in RAKING]
    with viewer_pages.painting_page(current, tmp_path) as page:
        shown.page.goto(page.as_uri())
        shown.page.wait_for_function("window.nishiki")
        shown.page.evaluate("nishiki.idle()")
        assert shown.page.evaluate("nishiki.scene.shadows.levels.length") == 2
        rest = [shown.picture(columns, rows, **state).copy() for state in states]
        shown.page.evaluate("nishiki.scene.shadows.levels.length = 1; nishiki.scene.shadows.known.clear();")
        dragged = [shown.picture(columns, rows, **state).copy() for state in states]
    for state, *pictures in zip(states, rest, dragged, strict=True):
        expected, _ = viewer_pages.rendered(scene, state)
        errors = [np.percentile(viewer_pages.difference(each, expected), 99) for each in pictures]
        assert errors[0] < 2
        assert errors[1] > 2 * errors[0]


def test_the_worker_reads_heights_with_holes_and_marches_as_render_does(shown):
    rng = np.random.default_rng(8)
    rows, columns = 75, 90
    surface = scipy.ndimage.gaussian_filter(rng.normal(0, 30, (rows, columns)), 1.5)
    surface[30:44, 20:50] += 60
    known = scipy.ndimage.gaussian_filter(rng.random((rows, columns)), 3) > 0.47
    surface = np.where(known, surface, np.nan).astype(np.float32)
    block, described = height_block(lambda band: surface[band], (rows, columns), 1.0, rows * columns, 0.002)
    part = [7, 20, 71, 74]  # left, top, right, bottom
    lamps = [
        ((30.0, 55.0, 40.0), None),
        ((-100.0, 20.0, 70.0), None),
        ((5.0, 3.0, 90.0), None),
        ((80.0, -40.0, 50.0), part),
    ]
    heights, *visibilities = shown.page.evaluate(
        """async ([text, described, lamps]) => {
          const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)), { shadows } = nishiki.scene;
          const worker = new shadows.levels[0].constructor(described), out = [(await worker.open(bytes, true)).surface];
          for (const [vector, window] of lamps) {
            const answer = new Promise((resolve) => (worker.onready = (job, visibility) => resolve(visibility)));
            worker.request({ key: `${vector}`, lamps: [{ vector, w: 1, radius: 0.03 }], window });
            out.push(await answer);
          }
          return out.map((each) => Array.from(each, (value) => (Number.isNaN(value) ? null : value)));
        }""",
        [base64.b64encode(block).decode(), described, lamps],
    )
    read = np.array([np.nan if value is None else value for value in heights]).reshape(rows, columns)
    np.testing.assert_array_equal(np.isnan(read), ~known)
    assert np.abs(read - surface)[known].max() <= 0.51 * described["step"] + 1e-5
    for (position, window), seen in zip(lamps, visibilities, strict=True):
        left, top, right, bottom = window or (0, 0, columns, rows)
        inside = (slice(top, bottom), slice(left, right))
        light = Light(spectrum=np.ones(61), position_mm=position, angular_radius=0.03)
        expected = cast_shadows(read.astype(np.float32), [light], pitch=1.0)[0][inside]
        apart = np.abs(np.array(seen).reshape(expected.shape) / 255 - expected)[known[inside]]
        assert apart.max() < 0.006
        assert 0.05 < np.mean(expected[known[inside]] < 0.5) < 0.95


def test_heights_that_cannot_be_read_are_an_error_and_are_not_waited_for(shown):
    said = shown.page.evaluate(
        """async () => {
          const { shadows, manifest } = nishiki.scene, worker = new shadows.levels[0].constructor(manifest.shadows[0]);
          return worker.open(new Uint8Array([1, 2, 3]), true).then(() => null, (error) => error.message);
        }"""
    )
    assert said.startswith("height-0: ")


def test_shadows_that_are_on_their_way_are_not_those_of_the_other_side(shown):
    """Until a worker answers, each side keeps the shadows that it had; a layer without shadows needs none."""
    first, second, third = ([lamp(azimuth, 10)] for azimuth in (0, 90, 200))
    kept = {"lamps": second, "ambient": 0, "layer": "appearance", "exposure": 2, "enhance": "none"}
    shown.set(lamps=first, exposure=2, compare={"divider": 0.5, "state": kept})
    keys = shown.page.evaluate(
        """(lamps) => {
          const { scene } = nishiki, { canvas, shadows } = scene, half = canvas.width / 2;
          const right = { x: half, y: 0, width: canvas.width - half, height: canvas.height };
          const drawn = (state) => {
            scene.draw({ ...nishiki.state, compare: null, ...state }, right);
            return scene.shadow?.key;
          };
          const before = drawn({}), { request } = shadows.levels[0];
          shadows.levels[0].request = () => {}; // no answer comes
          const keys = [before, drawn({ lamps }), drawn({ layer: "normals" })];
          shadows.levels[0].request = request;
          return keys;
        }""",
        third,
    )
    assert keys[0] == keys[1]
    assert keys[2] is None


def test_two_states_stand_under_the_divider(shown):
    plain = shown.canvas().reshape(-1, shown.page.evaluate("nishiki.scene.canvas.width"), 4)
    shown.section("compare").get_by_text("Keep this on the left").click()
    shown.set(layer="normals")
    both = shown.canvas().reshape(plain.shape)
    middle = plain.shape[1] // 2
    assert np.array_equal(both[:, : middle - 1], plain[:, : middle - 1])
    assert np.mean(both[:, middle + 1 :] != plain[:, middle + 1 :]) > 0.2


def test_exposure_of_a_long_painting_is_chosen_before_its_first_picture(finished_site, shown, tmp_path, monkeypatch):
    """The level that it is chosen from has several tiles, as where a painting is longer than a tile."""
    current = finished_site.folder / "results/tiny/current"
    for module in (stage, pyramid):
        monkeypatch.setattr(module, "TILE", 64)
    with viewer_pages.painting_page(current, tmp_path) as page:
        shown.page.goto(page.as_uri())
        shown.page.wait_for_function("window.nishiki")
        shown.page.evaluate("nishiki.idle()")
        levels, first = shown.page.evaluate(
            """async () => {
              const { scene, state } = nishiki, canvas = document.createElement("canvas");
              const other = await scene.constructor.open(canvas, scene.manifest, scene.loader);
              other.draw(state);
              return [scene.manifest.tiles.levels.length, other.exposureShown];
            }"""
        )
        assert levels > 1
        assert first == pytest.approx(shown.page.evaluate("nishiki.scene.exposureShown"), rel=0.1)
        assert first != 1
