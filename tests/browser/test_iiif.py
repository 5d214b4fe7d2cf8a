"""Tiles and manifest of IIIF in a viewer that shares nothing with us: Tify, from npm."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import viewer_pages
from npm_packages import npm_folder

from nishiki.formats.banded_pictures import write_iiif_image
from nishiki.stages.export.iiif import LAYERS, canvas, image, manifest, manifest_of, write_manifest
from nishiki.stages.export.object import BEHAVIOR

NODE_FOLDER = npm_folder("tify/dist/tify.js")
TIFY = NODE_FOLDER / "tify" / "dist" if NODE_FOLDER else None
pytestmark = [
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=str(viewer_pages.missing())),
    pytest.mark.skipif(TIFY is None, reason="the npm package tify is not installed (set NODE_PATH to its folder)"),
]
ROWS, COLUMNS = 900, 1500
COLOURS = {"colour": (200, 40, 40), "relief": (120, 120, 120), "normals": (40, 60, 210)}
PAGE = """<!doctype html><meta charset="utf-8"><link rel="stylesheet" href="tify/tify.css">
<div id="viewer" style="height: 95vh"></div>
<script type="module">
import Tify from "./tify/tify.js";
new Tify({container: "#viewer", manifestUrl: "manifest.json", translationsDirUrl: "tify/translations"});
</script>"""


@pytest.fixture
def address(tmp_path):
    """Address of a folder with three layers of one colour each, and of the viewer beside them."""
    (tmp_path / "scratch").mkdir()
    web = tmp_path / "web"
    web.mkdir()
    with viewer_pages.served(web) as address:
        for name in LAYERS:
            picture = np.broadcast_to(np.uint8(COLOURS[name]), (ROWS, COLUMNS, 3))
            write_iiif_image(web / name, f"{address}/{name}", picture, tmp_path / "scratch", 92)
        capture = SimpleNamespace(diagnostics={"capture": {"title": "Three sheets of paper"}})
        stamp = {"version": "0", "scene": "sheets", "key": "0"}
        scene = SimpleNamespace(shape=(ROWS, COLUMNS), pitch_mm=0.1)
        write_manifest(web, manifest(SimpleNamespace(inputs={"ingest": capture}, stamp=stamp), scene, address))
        (web / "tify").symlink_to(TIFY)
        (web / "index.html").write_text(PAGE, encoding="utf-8")
        yield address


@pytest.fixture
def turn(tmp_path):
    """Address of two views of an object of one colour each, and of the viewer beside them."""
    (tmp_path / "scratch").mkdir()
    web = tmp_path / "web"
    web.mkdir()
    with viewer_pages.served(web) as address:
        canvases = []
        for view, colour in (("000", (200, 40, 40)), ("001", (40, 60, 210))):
            picture = np.broadcast_to(np.uint8(colour), (700, 600, 3))
            write_iiif_image(web / view / "view", f"{address}/{view}/view", picture, tmp_path / "scratch", 92)
            images = [image(f"{address}/{view}", "view", "View", (700, 600))]
            canvases.append(canvas(f"{address}/canvas/{view}", images, (700, 600), 0.5))
        capture = SimpleNamespace(diagnostics={"capture": {"title": "Two sides"}})
        context = SimpleNamespace(inputs={"ingest": capture}, stamp={"version": "0", "scene": "sides", "key": "0"})
        write_manifest(web, {**manifest_of(context, address, canvases), "behavior": [BEHAVIOR]})
        (web / "tify").symlink_to(TIFY)
        (web / "index.html").write_text(PAGE, encoding="utf-8")
        yield address


def test_viewer_turns_an_object_view_by_view(turn):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=viewer_pages.CHROMIUM, args=viewer_pages.FLAGS)
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.goto(f"{turn}/index.html")
        page.get_by_text("Two sides").first.wait_for()
        for view, colour in enumerate(((200, 40, 40), (40, 60, 210))):
            if view:
                page.locator("button[title='Next page']").first.click()
            page.wait_for_timeout(2000)
            shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[500, 800, ::-1]
            np.testing.assert_allclose(shown.astype(int), colour, atol=3)
        browser.close()


def test_viewer_shows_the_chosen_layer_from_its_tiles(address):
    from playwright.sync_api import sync_playwright

    answers = {}
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=viewer_pages.CHROMIUM, args=viewer_pages.FLAGS)
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.on("response", lambda answer: answers.update({answer.url.removeprefix(address): answer.status}))
        page.goto(f"{address}/index.html")
        page.get_by_text("Three sheets of paper").first.wait_for()
        for name, (label, _) in LAYERS.items():
            if name != "colour":
                page.locator("button[title*=ayer]").first.click()
                page.get_by_text(label).first.click()
            page.wait_for_timeout(2000)
            shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[600, 1000, ::-1]
            np.testing.assert_allclose(shown.astype(int), COLOURS[name], atol=3)
            assert answers[f"/{name}/512,0,512,512/512,512/0/default.jpg"] in (200, 304)
        browser.close()
    refused = {url for url, status in answers.items() if status >= 400 and "default.jpg" in url}
    assert {url.split("/full/")[1] for url in refused} <= {
        "96,/0/default.jpg"
    }  # Tify's thumbnails have a size of its own
