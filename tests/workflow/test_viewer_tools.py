"""The page of a painting in Chromium: saved pictures, notes, lens, presets, fingers, and pages that hold it."""

import io
import json
import threading
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import viewer_pages
from PIL import Image

from nishiki.commands.results import ResultsHandler

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=viewer_pages.missing() or ""),
]
OUTLINE = [(0.4, 0.4), (0.5, 0.4), (0.5, 0.6), (0.4, 0.6)]


def drag(page, shares):
    """Drag over the canvas from place to place, each a share of its width and height."""
    box = page.locator("#canvas").bounding_box()
    places = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in shares]
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place, steps=2)
    page.mouse.up()


def downloaded(page, button):
    """Bytes of the file that a button gives, and its name."""
    with page.expect_download() as download:
        page.get_by_role("button", name=button).click()
    return Path(download.value.path()).read_bytes(), download.value.suggested_filename


def test_the_saved_picture_is_the_one_that_is_seen_and_says_what_it_shows(shown):
    lamp = viewer_pages.lamp(120, 30)
    shown.set(lamps=[lamp], note="Größe")
    canvas = shown.canvas().reshape(
        *shown.page.evaluate("[nishiki.scene.canvas.height, nishiki.scene.canvas.width]"), 4
    )
    content, name = downloaded(shown.page, "Save the picture")
    picture = Image.open(io.BytesIO(content))
    picture.load()
    assert name == "tiny-120-30.png"
    texts = picture.text
    assert (texts["Comment"], texts["Source"].split(",")[0].split()[-1]) == ("Größe", "tiny")
    assert {"azimuth 120", "elevation 30", "D65"} <= {
        part for part in ("azimuth 120", "elevation 30", "D65") if part in texts["Description"]
    }
    assert json.loads(texts["nishiki:state"])["lamps"] == [lamp]
    scale, unit, *_ = texts["nishiki:scale"].split(" ")
    (x0, _), (x1, _) = (shown.page.evaluate("(x) => nishiki.scene.toScene(x, 0, nishiki.state)", x) for x in (0, 100))
    assert float(scale) == pytest.approx((x1 - x0) / 100, rel=1e-3)
    assert unit == shown.page.evaluate("nishiki.scene.bounds().unit")
    different = np.any(np.asarray(picture)[..., :3] != canvas[::-1, :, :3], axis=-1)
    rows, columns = np.nonzero(different)  # the scale bar, below on the right, and nothing else
    assert 100 < different.sum() < 0.02 * different.size
    assert rows.min() > 0.85 * different.shape[0]
    assert columns.min() > 0.4 * different.shape[1]


def test_a_note_keeps_lamps_and_view_and_comes_back_from_its_file(shown, index, tmp_path):
    page = shown.page
    shown.set(lamps=[viewer_pages.lamp(200, 20)])
    page.locator("#canvas").focus()
    page.keyboard.press("a")
    drag(page, OUTLINE)
    page.keyboard.type("crack")
    drag(page, [(0.55, 0.5)])
    page.keyboard.type("retouched")
    content, name = downloaded(page, "Save as a file")
    assert name == "tiny-annotations.json"
    items = json.loads(content)["items"]
    assert [each["body"]["value"] for each in items] == ["crack", "retouched"]
    assert items[0]["target"]["state"]["value"]["lamps"][0]["azimuth_deg"] == 200
    shown.set(lamps=[viewer_pages.lamp(0, 60)], view={**shown.state()["view"], "zoom": 3})
    shown.section("annotations").get_by_role("button", name="crack").click()
    assert shown.state()["lamps"][0]["azimuth_deg"] == 200
    assert shown.state()["view"]["zoom"] == 1
    page.evaluate("nishiki.idle()")
    assert page.locator("#overlay .note").count() == 2

    page.reload()  # the browser keeps them
    page.wait_for_function("window.nishiki")
    page.evaluate("nishiki.idle()")
    assert page.locator("#overlay .note").count() == 2
    for _ in range(2):
        shown.section("annotations").locator(".notes button").first.click()
        page.get_by_role("button", name="Delete").click()
    page.evaluate("nishiki.idle()")
    assert page.locator("#overlay .note").count() == 0
    (tmp_path / "notes.json").write_bytes(content)
    (tmp_path / "wrong.json").write_text(json.dumps({"items": [{"target": "elsewhere"}]}))
    chooser = page.locator("[data-section=annotations] input[type=file]")
    chooser.set_input_files(tmp_path / "wrong.json")
    page.wait_for_function("document.getElementById('spoken').textContent.includes('annotation 1')")
    chooser.set_input_files(tmp_path / "notes.json")
    page.locator("#overlay .note").nth(1).wait_for()
    again, _ = downloaded(page, "Save as a file")
    assert json.loads(again) == json.loads(content)
    page.evaluate("localStorage.clear()")


def test_a_server_keeps_notes_beside_the_scene(shown, index, tmp_path):
    viewer = tmp_path / "tiny/current/viewer"
    viewer.parent.mkdir(parents=True)
    viewer.symlink_to(index.parent)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(ResultsHandler, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = shown.page.context.browser.new_context().new_page()  # it complains that there are no notes yet
        address = f"http://127.0.0.1:{server.server_port}/tiny/current/viewer/index.html"
        page.goto(address)
        page.wait_for_function("window.nishiki")
        page.locator("#canvas").focus()
        page.keyboard.press("a")
        drag(page, [(0.5, 0.5)])
        with page.expect_response(lambda answer: "here" in (answer.request.post_data or "")) as answer:
            page.keyboard.type("here")
            page.locator("#canvas").focus()
        assert answer.value.status == 204
        kept = json.loads((tmp_path / "tiny/annotations.json").read_text())
        assert [each["body"]["value"] for each in kept["items"]] == ["here"]
        page.reload()
        page.locator("#overlay .note").wait_for()
        put = "(path) => fetch(path, { method: 'PUT', body: '{}' }).then(({ status }) => status)"
        beside = ("tiny/current/viewer/other.json", "nothing/current/viewer/annotations.json", "annotations.json")
        assert [page.evaluate(put, f"/{path}") for path in beside] == [403, 403, 403]
        page.context.close()
        server.shutdown()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiny"]
    assert not (index.parent / "annotations.json").exists()


def test_the_lens_is_larger_around_the_pointer_and_goes_with_it(shown):
    before = shown.canvas()
    box = shown.page.locator("#canvas").bounding_box()
    shown.page.locator("#canvas").focus()
    shown.page.keyboard.press("g")
    shown.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    shown.page.locator("#lens").wait_for(state="visible")
    frame = shown.page.locator("#lens").bounding_box()
    assert frame["x"] + frame["width"] / 2 == pytest.approx(box["x"] + box["width"] / 2, abs=2)
    share = np.mean(shown.canvas() != before)
    assert 0 < share <= 220**2 / (box["width"] * box["height"])
    shown.page.mouse.move(box["x"] + box["width"] + 50, 300)
    shown.page.locator("#lens").wait_for(state="hidden")
    assert np.array_equal(shown.canvas(), before)


def test_presets_change_what_is_seen_and_the_first_one_brings_it_back(shown):
    shown.set(exposure=1)
    seen = [shown.canvas()]
    group = shown.page.get_by_role("group", name="Presets")
    names = group.get_by_role("button").all_text_contents()
    for name in (*names[1:], names[0]):
        group.get_by_role("button", name=name, exact=True).click()
        assert group.get_by_role("button", name=name, exact=True).get_attribute("aria-pressed") == "true"
        seen.append(shown.canvas())
    assert np.array_equal(seen[-1], seen[0])
    assert all(np.mean(a != b) > 0.05 for k, a in enumerate(seen[:-1]) for b in seen[:k])


def test_fingers_move_the_lamp_zoom_and_use_the_lens(index, shown):
    context = shown.page.context.browser.new_context(has_touch=True, viewport={"width": 390, "height": 780})
    page = context.new_page()
    page.goto(index.resolve().as_uri())
    page.wait_for_function("window.nishiki")
    touch = context.new_cdp_session(page)

    def fingers(kind, *places):
        points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(places)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", (195, 390))
    fingers("touchMove", (60, 390))
    fingers("touchEnd")
    assert page.evaluate("nishiki.state.lamps[0].azimuth_deg") == pytest.approx(180, abs=2)
    page.get_by_role("button", name="Move").tap()
    fingers("touchStart", (150, 390), (240, 390))
    fingers("touchMove", (105, 390), (285, 390))
    fingers("touchEnd")
    assert page.evaluate("nishiki.state.view.zoom") == pytest.approx(2, rel=0.05)
    page.get_by_role("button", name="Lens").tap()
    fingers("touchStart", (195, 500))
    page.locator("#lens").wait_for(state="visible")
    frame = page.locator("#lens").bounding_box()
    assert frame["y"] + frame["height"] <= 500, "the finger does not cover it"
    fingers("touchEnd")
    page.locator("#lens").wait_for(state="hidden")
    page.get_by_role("button", name="Note").tap()
    fingers("touchStart", (250, 380))
    fingers("touchEnd")
    page.get_by_label("Text of the note").wait_for()
    page.wait_for_function("document.querySelector('.notes + textarea').getBoundingClientRect().bottom <= innerHeight")
    sizes = page.evaluate(
        "[...document.querySelectorAll('#tools button, #actions button')].map((each) => each.offsetWidth)"
    )
    assert min(sizes) >= 44
    context.close()


def test_a_page_holds_the_viewer_by_one_script_and_one_element(index, shown, tmp_path):
    host = tmp_path / "host.html"
    folder = index.resolve().parent.as_uri()
    host.write_text(
        f'<!doctype html><body><script src="{folder}/embed.js"></script><nishiki-viewer></nishiki-viewer></body>'
    )
    page = shown.page.context.browser.new_context().new_page()
    page.goto(host.as_uri())
    frame = page.frame_locator("nishiki-viewer iframe")
    frame.locator("#canvas").wait_for()
    frame.locator("#tools button").first.wait_for()
    assert not frame.locator("#panel").is_visible(), "the picture has the frame for itself"
    frame.locator("#sheet").click()
    frame.locator("#panel").wait_for(state="visible")
    bookmark = f"{folder}/index.html#%7B%22ambient%22%3A0.31%7D"
    page.evaluate("(address) => document.querySelector('nishiki-viewer').setAttribute('src', address)", bookmark)
    handle = page.wait_for_selector("nishiki-viewer iframe").content_frame()
    handle.wait_for_function("window.nishiki?.state.ambient === 0.31")
    page.context.close()
