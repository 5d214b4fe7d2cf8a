"""The viewer's page of a painting in headless Chromium: what it shows is what render shows; nothing is fetched."""

import json
import re

import numpy as np
import pytest
import viewer_pages
from viewer_pages import lamp

from nishiki.artifacts.artifact import open_artifact
from nishiki.artifacts.maps import Maps

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


def test_the_canvas_shows_what_render_shows_and_values_are_those_of_the_maps(site):
    site.configure(products=["viewer"])
    site.nishiki("run")
    current = site.folder / "results/tiny/current"
    inputs = {name: open_artifact(current / name) for name in ("normals", "height", "spectra", "brdf")}
    scene = viewer_pages.plane_scene(inputs)
    rows, columns = scene.shape
    with viewer_pages.opened(current / "viewer/index.html", width=400, height=300) as page:
        for state in STATES:
            expected, exposure = viewer_pages.rendered(scene, {**state, "exposure": "auto"})
            shown = page.picture(columns, rows, **state, exposure="auto", view=FRONTAL)
            assert page.page.evaluate("nishiki.scene.exposure.value") == pytest.approx(exposure, rel=0.06)
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
        for layer in page.page.evaluate("nishiki.scene.layers()"):
            page.set(layer=layer["name"])
        assert page.messages == []
        assert [url for url in page.requests if not url.startswith(("file:", "data:", "blob:"))] == []


def test_blocks_beside_the_page_hold_every_byte(site):
    site.configure(products=["viewer"], viewer={"inline_mb": 0})
    site.nishiki("run")
    folder = site.folder / "results/tiny/current/viewer"
    html = (folder / "index.html").read_text()
    manifest = json.loads(re.search(r'id="manifest">(.*?)</script>', html).group(1))
    assert not manifest["data"]["inline"]
    with viewer_pages.opened(folder / "index.html", width=200, height=150) as page:
        picture = page.picture(64, 48, view=FRONTAL)
        assert picture.std() > 10
        assert page.messages == []
        assert any(url.endswith("data/tile-0-0-0.js") for url in page.requests)
