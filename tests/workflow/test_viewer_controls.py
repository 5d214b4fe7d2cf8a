"""The page of a painting in headless Chromium: hands, keys, languages, a desk and a telephone."""

import json
import urllib.parse

import numpy as np
import pytest
import viewer_pages

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=viewer_pages.missing() or ""),
]


def test_lamp_follows_the_pointer_and_the_picture_follows_the_lamp(shown):
    before = shown.canvas()
    box = shown.page.locator("#canvas").bounding_box()
    shown.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    shown.page.mouse.down()
    shown.page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + box["height"] / 2, steps=3)
    shown.page.mouse.up()
    (lamp,) = shown.state()["lamps"]
    assert lamp["azimuth_deg"] == pytest.approx(180, abs=1)
    assert lamp["elevation_deg"] < 60
    assert np.mean(shown.canvas() != before) > 0.2


def test_spectrum_layer_and_enhancement_change_what_is_seen(shown):
    seen = [shown.canvas()]
    shown.section("light").get_by_label("Spectrum", exact=True).select_option("F11")
    seen.append(shown.canvas())
    shown.section("layers").get_by_label("Layer").select_option("normals")
    seen.append(shown.canvas())
    shown.section("layers").get_by_label("Layer").select_option("appearance")
    shown.section("layers").get_by_label("Enhancement").select_option("specular")
    seen.append(shown.canvas())
    assert all(np.mean(a != b) > 0.05 for k, a in enumerate(seen) for b in seen[:k])


def test_table_of_a_lamp_is_read_or_refused_with_a_reason(shown, tmp_path):
    light = shown.section("light")
    light.get_by_label("Spectrum", exact=True).select_option("csv")
    good, bad = tmp_path / "lamp.csv", tmp_path / "bad.csv"
    good.write_text("wavelength_nm,power\n380,0\n500,1\n720,3\n")
    bad.write_text("500,1\n")
    light.locator("input[type=file]").set_input_files(bad)
    shown.page.wait_for_function("document.querySelector('[role=alert]').textContent.includes('400 to 700')")
    assert shown.state()["lamps"][0]["illuminant"] == "D65"
    light.locator("input[type=file]").set_input_files(good)
    shown.page.wait_for_function("nishiki.state.lamps[0].illuminant.csv")
    assert shown.state()["lamps"][0]["illuminant"]["csv"]["power"] == [0, 1, 3]


def test_a_section_stays_open_where_the_panel_is_made_anew_at_once(shown):
    shown.page.evaluate("() => { document.querySelector('[data-section=help] summary').click(); nishiki.set({}); }")
    shown.page.evaluate("nishiki.idle()")
    assert shown.page.locator("[data-section=help]").get_attribute("open") is not None
    shown.page.locator("[data-section=help] summary").press("Enter")
    shown.set()
    assert shown.page.locator("[data-section=help]").get_attribute("open") is None


def test_wheel_zooms_about_the_pointer(shown):
    box = shown.page.locator("#canvas").bounding_box()
    here = [box["width"] * 0.3, box["height"] * 0.4]
    place = "([x, y]) => nishiki.scene.toScene(x, y, nishiki.state)"
    before = shown.page.evaluate(place, here)
    shown.page.mouse.move(box["x"] + here[0], box["y"] + here[1])
    shown.page.mouse.wheel(0, -600)
    shown.page.wait_for_function("nishiki.state.view.zoom > 2")
    np.testing.assert_allclose(shown.page.evaluate(place, here), before, atol=0.5)


def test_keys_alone_reach_lamp_view_probe_and_divider(shown):
    shown.page.locator("#canvas").focus()
    press = shown.page.keyboard.press
    first = shown.state()["lamps"][0]
    press("ArrowLeft")
    assert shown.state()["lamps"][0] != first
    assert "azimuth" in shown.page.locator("#spoken").text_content()
    press("+")
    press("Shift+ArrowRight")
    view = shown.state()["view"]
    assert view["zoom"] == pytest.approx(1.25)
    assert view["x"] > 0
    press("t")
    shown.page.locator("#canvas").focus()
    press("ArrowRight")
    press("ArrowUp")
    assert shown.state()["view"]["tilt_deg"] == pytest.approx(np.hypot(5, 5))
    assert shown.state()["view"]["azimuth_deg"] == pytest.approx(45)
    assert "azimuth 45" in shown.page.locator("#spoken").text_content()
    press("p")
    shown.page.locator("#canvas").focus()
    press("Enter")
    shown.page.wait_for_selector("[data-section=probe] .plot")
    compare = shown.section("compare")
    compare.get_by_text("Keep this on the left").press("Enter")
    shown.page.locator("#divider").wait_for()
    shown.page.locator("#divider").press("ArrowRight")
    assert shown.state()["compare"]["divider"] == pytest.approx(0.52)


def test_ruler_measures_in_the_unit_of_the_scene(shown):
    shown.page.get_by_role("button", name="Ruler").click()
    box = shown.page.locator("#canvas").bounding_box()
    ends = [[box["width"] * share, box["height"] / 2] for share in (0.3, 0.6)]
    shown.page.mouse.move(box["x"] + ends[0][0], box["y"] + ends[0][1])
    shown.page.mouse.down()
    shown.page.mouse.move(box["x"] + ends[1][0], box["y"] + ends[1][1], steps=2)
    shown.page.mouse.up()
    (x0, _), (x1, _) = (shown.page.evaluate("([x, y]) => nishiki.scene.toScene(x, y, nishiki.state)", e) for e in ends)
    unit = shown.page.evaluate("nishiki.scene.bounds().unit")
    said = shown.page.locator("#spoken").text_content()
    value, of = said.split(" ")
    assert of == unit
    assert float(value) == pytest.approx(x1 - x0, rel=0.01)


def test_keys_alone_measure(shown):
    shown.page.locator("#canvas").focus()
    for key in ("r", "ArrowLeft", "Enter", "ArrowRight", "ArrowRight", "Enter", "ArrowDown"):
        shown.page.keyboard.press(key)
    y = (shown.page.evaluate("nishiki.scene.canvas.clientHeight") - 1) / 2
    (x0, _), (x1, _) = (
        shown.page.evaluate("([x, y]) => nishiki.scene.toScene(x, y, nishiki.state)", [x, y]) for x in (0, 16)
    )
    value, unit = shown.page.locator("#spoken").text_content().split(" ")
    assert unit == shown.page.evaluate("nishiki.scene.bounds().unit")
    assert float(value) == pytest.approx(x1 - x0, rel=0.01)


def test_values_are_those_of_the_last_place_and_the_controls_show_them(shown):
    """The first answer comes after the second; on a telephone the controls are closed before."""
    shown.page.set_viewport_size({"width": 390, "height": 780})
    shown.page.get_by_role("button", name="Values").click()
    shown.page.evaluate("""() => {
      const { scene } = nishiki, answer = scene.probe.bind(scene), late = [500];
      scene.probe = async (...place) => {
        const found = answer(...place);
        await new Promise((resolve) => setTimeout(resolve, late.pop() ?? 0));
        return found;
      };
    }""")
    box = shown.page.locator("#canvas").bounding_box()
    places = [[box["width"] * share, box["height"] / 2] for share in (0.4, 0.6)]
    _, (x, y, *_) = (shown.page.evaluate("([x, y]) => nishiki.scene.pointAt(x, y, nishiki.state)", p) for p in places)
    for place in places:
        shown.page.mouse.click(*place)
    values = shown.page.locator("[data-section=probe] dd")
    values.first.wait_for()
    shown.page.wait_for_timeout(1000)
    *read, _ = values.first.text_content().replace(",", "").split()
    np.testing.assert_allclose([float(number) for number in read], [x, y], atol=0.15)  # the middle of a pixel
    assert 0 < values.first.bounding_box()["y"] < 780


def test_bookmark_brings_back_lamps_view_and_note(index, shown):
    shown.section("bookmark").get_by_label("Note").fill("craquelure <b>here</b>")
    shown.page.locator("#canvas").focus()
    shown.page.keyboard.press("+")
    shown.page.keyboard.press("ArrowDown")
    shown.page.wait_for_function("location.hash.length > 1")
    shown.page.wait_for_timeout(500)
    address, before = shown.page.url, shown.state()
    kept = json.loads(urllib.parse.unquote(address.split("#")[1]))
    assert set(kept) == {"lamps", "view", "note"}
    shown.page.goto("about:blank")
    shown.page.goto(address)
    shown.page.wait_for_function("window.nishiki")
    assert shown.state()["note"] == before["note"]
    assert shown.state()["view"]["zoom"] == pytest.approx(before["view"]["zoom"], rel=1e-5)
    assert shown.state()["lamps"][0]["elevation_deg"] == pytest.approx(before["lamps"][0]["elevation_deg"], abs=0.01)


def test_both_languages_have_all_texts_and_a_phone_has_all_controls(shown):
    texts = shown.page.evaluate("JSON.parse(document.getElementById('texts').textContent)")
    assert set(texts["en"]) == set(texts["ja"])
    shown.page.set_viewport_size({"width": 390, "height": 780})
    button = shown.page.locator("#sheet")
    shown.page.locator("#panel").wait_for(state="hidden")
    button.click()
    shown.page.wait_for_timeout(300)  # the controls slide in
    edges = shown.page.evaluate(
        "['canvas', 'panel'].map((id) => document.getElementById(id).getBoundingClientRect().toJSON())"
    )
    assert edges[0]["bottom"] <= edges[1]["top"] + 1, "the controls do not cover the picture"
    shown.section("help").get_by_label("Language").select_option("ja")
    assert shown.page.locator("[data-section=light] summary").text_content() == "照明"
    assert shown.page.evaluate("document.documentElement.lang") == "ja"
    unnamed = """[...document.querySelectorAll('button, input, select, textarea')].filter(each =>
      !(each.getAttribute('aria-label') || each.textContent.trim() || each.closest('label')?.textContent.trim()))"""
    assert shown.page.evaluate(f"{unnamed}.length") == 0
    assert shown.page.evaluate("document.documentElement.scrollWidth") <= 390
