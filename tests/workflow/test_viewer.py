"""The viewer of a painting in headless Chromium: it shows what render shows, alone and beside another picture."""

import json
import re
import urllib.parse
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import scipy.ndimage
import viewer_pages
from viewer_pages import READ, lamp

from nishiki.artifacts.artifact import open_artifact
from nishiki.artifacts.maps import Maps
from nishiki.observations.plane import Observations
from nishiki.progress import Progress
from nishiki.stages.evaluate.painting import EvaluatedScene
from nishiki.stages.painting_maps import PaintingMaps, light_of
from nishiki.stages.viewer import painting as painting_maps

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=viewer_pages.missing() or ""),
]
STATES = (
    {"lamps": [lamp(90, 45)], "ambient": 0.05},
    {"lamps": [lamp(180, 15, "A"), lamp(20, 60, "F11", intensity=0.5)], "ambient": 0.0},
    {"lamps": [lamp(250, 40, "D50", distance=0.8)], "ambient": 0.02},
)
FRONTAL = {"x": 0, "y": 0, "zoom": 1, "tilt_deg": 0, "azimuth_deg": 0}


@pytest.fixture(scope="module")
def index(viewed):
    """The page of a run that has made the report too."""
    return viewed.folder / "results/tiny/current/viewer/index.html"


def test_the_canvas_shows_what_render_shows_and_values_are_those_of_the_maps(viewed, shown):
    page, current = shown, viewed.folder / "results/tiny/current"
    inputs = {name: open_artifact(current / name) for name in ("normals", "height", "spectra", "brdf")}
    scene = viewer_pages.plane_scene(inputs)
    rows, columns = scene.shape
    for state in STATES:
        expected, exposure = viewer_pages.rendered(scene, {**state, "exposure": "auto"})
        shown = page.picture(columns, rows, **state, exposure="auto", view=FRONTAL)
        assert page.page.evaluate("nishiki.scene.exposureShown") == pytest.approx(exposure, rel=0.06)
        shown = page.picture(columns, rows, **state, exposure=exposure, view=FRONTAL)
        errors = viewer_pages.difference(shown, expected)
        assert errors.mean() < 0.35, state
        assert np.percentile(errors, 99) < 1.5, state
    turned = page.picture(columns, rows, lamps=[lamp(270, 20)], exposure=1.0)
    assert viewer_pages.difference(turned, shown).mean() > 2  # another lamp, another picture
    probe = page.page.evaluate(f"nishiki.scene.probe({columns // 2 + 0.5}, {rows // 2 + 0.5}, nishiki.state)")
    normals = Maps(inputs["normals"].folder)
    normal = normals.read("normals")[rows // 2, columns // 2]
    assert np.degrees(np.arccos(np.clip(np.dot(probe["normal"], normal), -1, 1))) < 0.5
    assert probe["layers"]["lights_used"] == normals.read("lights_used")[rows // 2, columns // 2]
    basis = np.array(scene.basis)
    spectrum = scene.coefficients[rows // 2, columns // 2] @ basis
    assert np.abs(np.array(probe["spectrum"]["reflectance"]) - spectrum).max() < 0.02
    shown_values = {each["view"]: each for each in probe["photographs"]}
    frames = Observations((current / "ingest").resolve())
    with_ingest = {**inputs, "ingest": open_artifact(current / "ingest")}
    evaluated = EvaluatedScene(with_ingest, frames)
    assert list(shown_values) == list(frames.lights)
    values, valid = frames.read(slice(0, rows), channel="mean")
    assert probe["sample_pixels"] == 0
    for j, name in enumerate(frames.lights):
        place = (rows // 2, columns // 2)
        if valid[(j, *place)]:
            assert shown_values[name]["values"][0] == pytest.approx(values[(j, *place)], abs=0.02)
        predicted = evaluated.predict(light_of(frames.directions[j], None), slice(0, rows), None)
        assert shown_values[name]["predicted"][0] == pytest.approx(predicted.channels[place].mean(), abs=0.02)
    for layer in page.page.evaluate("nishiki.scene.layers()"):
        page.set(layer=layer["name"])


def test_photographs_of_large_paintings_are_sampled_around_the_middle(viewed, monkeypatch):
    current = viewed.folder / "results/tiny/current"
    inputs = {name: open_artifact(current / name) for name in ("ingest", "normals", "height", "spectra", "brdf")}
    frames = Observations(inputs["ingest"].folder)
    monkeypatch.setattr(painting_maps, "MOST_CODES", 20_000)
    blocks = {}
    told = painting_maps.photographs_of(
        PaintingMaps(inputs), frames, SimpleNamespace(add=blocks.__setitem__), Progress("")
    )
    shape = (2, len(frames.lights), told["rows"], told["columns"])
    assert told["step"] == 3
    assert np.prod(shape) <= 20_000
    codes = np.frombuffer(zlib.decompress(blocks["photographs"]), np.uint8).reshape(shape)
    assert all(
        abs(2 * first + (count - 1) * told["step"] - (size - 1)) <= 1
        for first, count, size in zip(told["first"], shape[2:], frames.shape, strict=True)
    )
    evaluated = EvaluatedScene(inputs, frames)
    values, valid = frames.read(slice(0, frames.shape[0]), channel="mean")
    samples = (slice(told["first"][0], None, told["step"]), slice(told["first"][1], None, told["step"]))
    for j in range(len(frames.lights)):
        seen, usable = values[j][samples], valid[j][samples]
        assert np.array_equal(codes[0, j] == told["nothing"], ~usable)
        predicted = evaluated.predict(light_of(frames.directions[j], None), slice(0, frames.shape[0]), None)
        predicted = predicted.channels.mean(axis=-1)[samples]
        for code, expected in zip(codes[:, j], (seen, predicted), strict=True):
            known = (code != told["nothing"]) & np.isfinite(expected)
            decoded = told["white"] * (code[known] / told["top"]) ** 2
            steps = np.sqrt(told["white"] * np.maximum(expected[known], 0)) / told["top"] + 1e-4 * told["white"]
            assert np.all(np.abs(decoded - np.maximum(expected[known], 0)) < 1.1 * steps)


def test_tilted_picture_is_that_of_render_and_its_relief_is_lifted(viewed, shown):
    current = viewed.folder / "results/tiny/current"
    inputs = {name: open_artifact(current / name) for name in ("normals", "height", "spectra", "brdf")}
    scene = viewer_pages.plane_scene(inputs)
    rows, columns = scene.shape
    tilt, azimuth = 50, 205
    state = {"lamps": [lamp(90, 45)], "ambient": 0.05, "exposure": 0.8}
    tilted = {**FRONTAL, "tilt_deg": tilt, "azimuth_deg": azimuth}
    # pixels of the canvas a third of those of the maps: at the same size render shows means of samples
    state["view"] = {**tilted, "zoom": 3}
    expected, _ = viewer_pages.rendered(scene, state, viewer_pages.tilted_view(scene, tilt, azimuth, 3))
    shown.page.evaluate("nishiki.scene.lifted = nishiki.scene.relief; nishiki.scene.relief = null")
    flat = shown.picture(columns, rows, **state).copy()
    errors = viewer_pages.difference(flat, expected)
    assert np.median(errors) < 0.8  # where neighbours differ, the page interpolates codes and render what they mean
    assert errors.mean() < 2.5

    # the relief ten times as high, in pixels of a third, against rays that go down in small steps
    view, state["view"] = viewer_pages.tilted_view(scene, tilt, azimuth), tilted
    height = 10 * np.nan_to_num(Maps(inputs["height"].folder).read("height"))
    shown.page.evaluate("""([surface, rows, columns, pitch]) => { const { scene } = nishiki;
      scene.relief = new scene.lifted.constructor(scene.gl, { surface, rows, columns, pitch }, pitch); }""",
      [height.ravel().tolist(), rows, columns, scene.pitch])  # fmt: skip
    size = (3 * columns, 3 * rows)
    lifted = shown.picture(*size, **state, layer="normals")
    towards = np.array(view.eye_mm) / np.linalg.norm(view.eye_mm)
    up = np.array(view.up)
    right = np.cross(up, towards)
    y, x = np.mgrid[rows / 2 - 1 / 6 : -rows / 2 : -1 / 3, -columns / 2 + 1 / 6 : columns / 2 : 1 / 3] * scene.pitch
    screen = x[..., None] * right + y[..., None] * up
    place, above = np.full((*x.shape, 2), -1.0), np.zeros(x.shape, bool)
    for level in np.linspace(height.max() + 1e-6, height.min(), 400):
        point = screen + towards * ((level - screen[..., 2]) / towards[2])[..., None]
        at = np.stack([(rows - 1) / 2 - point[..., 1] / scene.pitch, (columns - 1) / 2 + point[..., 0] / scene.pitch])
        surface = scipy.ndimage.map_coordinates(height, at, order=1, mode="nearest")
        on = (np.abs(point[..., 1]) < rows * scene.pitch / 2) & (np.abs(point[..., 0]) < columns * scene.pitch / 2)
        above |= on & (surface < level)
        hit = on & above & (surface >= level) & (place[..., 0] < -0.9)
        place[hit] = np.moveaxis(at, 0, -1)[hit]
    seen = place[..., 0] > -0.9
    assert np.mean((lifted.max(axis=-1) > 27) == seen) > 0.98
    seen = scipy.ndimage.binary_erosion(seen, iterations=3)
    normals = np.stack([scipy.ndimage.map_coordinates(n, np.moveaxis(place, -1, 0), order=1)
                        for n in np.moveaxis(scene.normals, -1, 0)], axis=-1)  # fmt: skip
    apart = np.abs(normals[seen] * 0.5 + 0.5 - lifted[seen] / 255).max(axis=-1)
    missed = []
    for row, column in np.argwhere(seen)[:: np.count_nonzero(seen) // 40]:
        x, y, h = shown.page.evaluate(f"nishiki.scene.pointAt({column + 0.5}, {row + 0.5}, nishiki.state)")
        at = [(rows - 1) / 2 - y / scene.pitch, (columns - 1) / 2 + x / scene.pitch]
        there = scipy.ndimage.map_coordinates(height, np.array(at)[:, None], order=1, mode="nearest")[0]
        assert h == pytest.approx(there, abs=1e-4)
        missed.append(np.abs(np.subtract(at, place[row, column])).max())
    assert np.median(missed) < 0.06  # pixels; the steps above miss by more where a line of sight grazes the relief
    assert np.max(missed) < 1
    shown.page.evaluate("nishiki.scene.relief = null")
    unlifted = shown.picture(*size, **state, layer="normals")
    without = np.abs(normals[seen] * 0.5 + 0.5 - unlifted[seen] / 255).max(axis=-1)
    assert np.median(apart) < 0.02
    assert np.mean(apart) < 0.25 * np.mean(without)


@pytest.mark.parametrize("enhancement", ["specular", "curvature", "raking", "unsharp", "relief"])
def test_an_enhancement_is_what_its_formula_says(viewed, shown, enhancement):
    current = viewed.folder / "results/tiny/current"
    scene = viewer_pages.plane_scene(
        {name: open_artifact(current / name) for name in ("normals", "height", "spectra", "brdf")}
    )
    plain = {"lamps": [lamp(90, 45)], "ambient": 0.05, "exposure": 0.8, "strength": 0.5, "view": FRONTAL}
    rows, columns = scene.shape
    expected = viewer_pages.enhanced(scene, {**plain, "enhance": enhancement})
    canvas = shown.picture(columns, rows, **plain, enhance=enhancement)
    errors = viewer_pages.difference(canvas, expected)
    assert errors.mean() < 0.35
    assert np.percentile(errors, 99) < 1.5
    assert viewer_pages.difference(canvas, shown.picture(columns, rows, **plain, enhance="none")).mean() > 1


@pytest.mark.parametrize(
    "address", ["javascript:alert(1)", "https://a.example/index.html", "data:text/html,x", "http://["]
)
def test_pages_of_other_places_are_not_shown_beside(index, shown, address):
    shown.page.goto(index.resolve().as_uri() + "?" + urllib.parse.urlencode({"beside": address}))
    shown.page.wait_for_function("window.nishiki")
    assert address in shown.page.locator("#spoken").text_content()
    assert shown.page.locator("iframe").count() == 0
    assert shown.state()["compare"] is None


def test_report_shows_the_viewer_where_it_is_unfolded(browser, index):
    browser.page.goto((index.parents[1] / "report.html").absolute().as_uri())
    assert not [frame for frame in browser.page.frames if "viewer" in frame.url], "it is not loaded before"
    browser.page.locator("#viewer summary").click()
    browser.page.frame_locator("iframe").get_by_text("Lamp 1").wait_for()
    assert browser.messages == []


def test_blocks_beside_the_page_hold_every_byte(viewed, browser):
    viewed.configure(products=["viewer"], viewer={"inline_mb": 0})
    viewed.nishiki("run")
    folder = viewed.folder / "results/tiny/current/viewer"
    html = (folder / "index.html").read_text()
    manifest = json.loads(re.search(r'id="manifest">(.*?)</script>', html).group(1))
    assert not manifest["data"]["inline"]
    browser.page.goto((folder / "index.html").as_uri())
    browser.page.wait_for_function("window.nishiki")
    assert browser.picture(64, 48, view=FRONTAL).std() > 10
    assert browser.messages == []
    assert any(url.endswith("data/tile-0-0-0.js") for url in browser.requests)


def test_results_of_two_settings_stand_under_one_divider(viewed, browser):
    before = (viewed.folder / "results/tiny/current/viewer").resolve()
    viewed.configure(products=["viewer"], viewer={"step": 8.0})
    viewed.nishiki("run")
    page = browser.page
    page.set_viewport_size({"width": 900, "height": 640})
    state = {"lamps": [lamp(180, 35, "A")], "exposure": 0.7}
    inside = (slice(150, 500), slice(90, 250))

    def screen():
        page.wait_for_timeout(300)
        page.evaluate("nishiki.idle()")
        return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[inside].astype(int)

    alone = []
    for folder in (before, (viewed.folder / "results/tiny/current/viewer").resolve()):
        page.goto((folder / "index.html").as_uri())
        page.wait_for_function("window.nishiki")
        browser.set(**state)
        alone.append(screen())
    assert np.abs(alone[0] - alone[1]).max() > 8
    printed = viewed.nishiki("view", "tiny", "--beside", str(before), "--print")
    page.goto(printed.stdout.strip().splitlines()[-1])
    page.wait_for_function("window.nishiki")
    browser.set(**state)
    other = page.locator("#beside").element_handle().content_frame()
    other.wait_for_function("window.nishiki && nishiki.state.exposure === 0.7", timeout=60_000)
    assert before.name in browser.section("compare").text_content()
    assert np.abs(screen() - alone[0]).max() <= 2
    browser.set(compare={"divider": 0.02, "state": None})
    assert np.abs(screen() - alone[1]).max() <= 2
    # of which nothing is seen, nothing is waited for: browsers do not draw it
    browser.page.evaluate("nishiki.set({ compare: { divider: 0, state: null }, ambient: 0.2 })")
    page.wait_for_timeout(500)
    assert page.evaluate("Promise.race([nishiki.idle().then(() => true), new Promise((r) => setTimeout(r, 5000))])")
    browser.set(compare={"divider": 0.02, "state": None})
    # the picture is complete once the other page has drawn it too, however slow that page is
    other.evaluate("""() => {
      const ask = requestAnimationFrame;
      window.requestAnimationFrame = (call) => setTimeout(() => ask(call), 700);
    }""")
    earlier = other.evaluate(READ)
    browser.set(lamps=[lamp(20, 60, "F11")])
    changed = other.evaluate(READ)
    page.wait_for_timeout(1000)
    assert earlier != changed == other.evaluate(READ)
    assert browser.messages == []
    refused = viewed.nishiki("view", "tiny", "--beside", "nowhere", "--print", check=False)
    assert refused.returncode == 2
    assert "nowhere" in refused.stderr
