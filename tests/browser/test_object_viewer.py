"""The page of an object in a real browser: what it decodes and draws, against the decoder and the renderer."""

import base64
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import viewer_pages
from coded_dome import coded_dome

from nishiki.geometry.camera import look_at
from nishiki.render.display import encode_display
from nishiki.render.object import renderer as renderer_module
from nishiki.render.object.shots import Neighbours, Shot
from nishiki.report.viewer.page import Blocks
from nishiki.stages.render.painting import direction
from nishiki.stages.viewer.object import write_object

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=str(viewer_pages.missing())),
]


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """An object and its page, open in a browser."""
    folder = tmp_path_factory.mktemp("object")
    decoded = coded_dome(folder)
    blocks = Blocks(SimpleNamespace(path=lambda name: folder / name), inline_bytes=10**8)
    about = {"title": "Ball", "scene": "ball", "key": "", "version": "", "unit": "mm"}
    write_object(decoded, blocks, about, without=frozenset())
    with viewer_pages.opened(folder / "index.html", width=300, height=200) as page:
        yield SimpleNamespace(decoded=decoded, page=page)


def canvas(shown, **state):
    camera = shown.decoded.cameras[0]
    return shown.page.picture(
        camera.columns, camera.rows, **{"options": {}, "lamps": [], "ambient": 0, "layer": "appearance", **state}
    )


def with_tool(shown, key):
    """The page, from a captured view, with the tool of a key chosen."""
    page = shown.page.page
    page.evaluate("dispatchEvent(new Event('resize'))")
    shown.page.set(view={"captured": 2}, options={})
    page.locator("canvas").first.focus()
    page.keyboard.press(key)
    return page


def check(shown, state, renderer, shot):
    picture = next(renderer.render([shot]))
    want = encode_display(picture.linear).pixels
    inner = picture.covered.copy()
    for axis in (0, 1):  # the pixels beside the edge are blended with the background
        inner &= np.roll(picture.covered, 1, axis) & np.roll(picture.covered, -1, axis)
    assert inner.sum() > 3000
    apart = viewer_pages.difference(canvas(shown, **state), want)[inner]
    assert apart.mean() < 0.3
    assert np.percentile(apart, 99) < 1.5


def test_captured_view(shown):
    renderer = shown.decoded.renderer(rim=0)
    check(shown, {"view": {"captured": 3}}, renderer, renderer.captured(3))


def test_between_views(shown, monkeypatch):
    """The page gives its two views full weight at highlights, edges and borders of shadows."""
    monkeypatch.setattr(renderer_module, "weigh_lender", lambda diffuse, gloss: np.float32(1))
    monkeypatch.setattr(renderer_module, "find_borders", lambda shown, inside: np.zeros(shown.shape, bool))
    renderer = shown.decoded.renderer(rim=0)
    check(shown, {"view": {"captured": 9.5}}, renderer, renderer.between(9, 0.5))


LAMPS = {
    "distant": [viewer_pages.lamp(180, 15, radius_deg=0)],
    "wide and near": [
        viewer_pages.lamp(200, 25, radius_deg=8),
        viewer_pages.lamp(70, 40, radius_deg=3, distance=0.9, intensity=0.7),
    ],
}


@pytest.mark.parametrize(("name", "shadows"), [("distant", False), ("wide and near", True)])
def test_free_lamps_show_the_model_alone_with_the_shadows_of_rays(shown, name, shadows):
    state = {"lamps": LAMPS[name], "ambient": 0.05, "view": {"captured": 3}}
    state["options"] = {"lighting": "free"} if shadows else {"lighting": "free", "shadows": False}
    lighting = viewer_pages.own_lighting(state)
    renderer = shown.decoded.renderer(rim=0, own_lamps=lighting)
    check(shown, state, renderer, renderer.captured(3))


def test_shadows_fall_where_they_should(shown):
    state = {"lamps": LAMPS["distant"], "ambient": 0.05, "view": {"captured": 3}, "options": {"lighting": "free"}}
    lighting = viewer_pages.own_lighting(state)
    with_them = shown.decoded.renderer(rim=0, own_lamps=lighting)
    without = shown.decoded.renderer(rim=0, own_lamps=replace(lighting, shadows=False))
    shaded, plain = (
        encode_display(next(each.render([each.captured(3)])).linear).pixels for each in (with_them, without)
    )
    changed = viewer_pages.difference(shaded, plain) > 8
    assert changed.sum() > 150
    assert np.median(viewer_pages.difference(canvas(shown, **state), shaded)[changed]) < 0.5


DARK_BUT_THE_LAST = [viewer_pages.lamp(50 * n, 30, radius_deg=0, intensity=0.02) for n in range(7)]


@pytest.mark.parametrize(
    ("lamps", "ambient"),
    [([*DARK_BUT_THE_LAST, viewer_pages.lamp(200, 35, radius_deg=0)], 0.05), ([], 0.3), ([], 0)],
    ids=["eight and even light", "even light alone", "none"],
)
def test_every_lamp_that_the_panel_offers_and_even_light_without_any(shown, lamps, ambient):
    state = {"lamps": lamps, "ambient": ambient, "view": {"captured": 3}, "options": {"lighting": "free"}}
    renderer = shown.decoded.renderer(rim=0, own_lamps=viewer_pages.own_lighting(state))
    check(shown, state, renderer, renderer.captured(3))


def test_the_ceiling_of_the_capture_does_not_bind_free_lamps(shown):
    assert shown.page.page.evaluate("nishiki.scene.manifest.ceiling") == 1
    state = {"view": {"captured": 3}, "options": {"lighting": "free", "shadows": False}}
    bright = canvas(shown, **state, lamps=[viewer_pages.lamp(40, 60, intensity=4)], exposure=0.25).astype(int)
    plain = canvas(shown, **state, lamps=[viewer_pages.lamp(40, 60)], exposure=1).astype(int)
    canvas(shown, exposure=1)
    assert bright.max() > encode_display(np.full((1, 1, 3), 0.27)).pixels.max()  # at this exposure 1 is 0.25
    assert np.percentile(abs(bright - plain), 99) <= 2


def test_two_states_with_shadows_of_their_own_come_to_rest(shown):
    """Both sides of the divider sum up their own samples, and carry on the object's edge from it alone."""
    kept = {
        "lamps": LAMPS["distant"],
        "ambient": 0,
        "options": {"lighting": "free"},
        "layer": "appearance",
        "exposure": 1,
    }
    state = {**kept, "lamps": LAMPS["wide and near"][:1], "view": {"captured": 3}}
    right, left = (canvas(shown, **{**state, **change}).copy() for change in ({}, kept))
    draw = """([state, kept]) => {
      const { scene } = nishiki;
      do {
        scene.draw(state, {x: 75, y: 0, width: 75, height: 130});
        scene.draw({...state, ...kept}, {x: 0, y: 0, width: 75, height: 130}, "left");
      } while (scene.busy);
      return (READ)(); // at once: the page draws its own state after it
    }""".replace("READ", viewer_pages.READ)
    values = np.frombuffer(base64.b64decode(shown.page.page.evaluate(draw, [state, kept])), np.uint8)
    both = values.reshape(*right.shape[:2], 4)[::-1, :, :3]
    assert (both[:, :75] == left[:, :75]).all()
    assert (both[:, 75:] == right[:, 75:]).all()
    assert (left != right).any()


def test_free_view(shown):
    renderer, first = shown.decoded.renderer(rim=0), shown.decoded.cameras[0]
    eye, up = np.array([1.8, 2.4, 3.6]), (0.0, 1.0, 0.0)
    camera = look_at(eye, (0, 0, 0), rows=first.rows, columns=first.columns, field_of_view=np.radians(30), up=up)
    view = {"eye": eye.tolist(), "target": [0, 0, 0], "up": list(up), "fov_deg": 30, "captured": None}
    position = shown.page.page.evaluate("view => nishiki.scene.cameraOf(view).position", view)
    assert 0 < position < renderer.turn.position[1]
    lenders = Neighbours.around(renderer.turn, position)
    check(shown, {"view": view}, renderer, Shot(camera, lenders))


def test_decoded_numbers_are_those_of_the_decoder(shown):
    residual, scene = shown.decoded.residual, "nishiki.scene.coded"
    shown.page.page.evaluate("nishiki.idle()")
    for tile in (0, residual.tiles // 2, residual.tiles - 1):
        extent = residual.extents[tile]
        view = (extent.start + extent.length // 2) % residual.design.views
        values = shown.page.page.evaluate(f"Array.from({scene}.residual({tile}, {view}, 0))")
        values = np.reshape(values, (residual.size, residual.size, 4))[..., :3]
        want = residual.decode(tile)[view]
        assert np.abs(want).max() > 0.05
        np.testing.assert_allclose(values, want, atol=2e-6)


def test_probe_gives_the_parameters(shown):
    canvas(shown, view={"captured": 0})
    probed = shown.page.page.evaluate("nishiki.scene.probe(75, 65, nishiki.state)")
    renderer = shown.decoded.renderer()
    picture = next(renderer.render([renderer.captured(0)]))
    place = [np.atleast_1d(v) for v in (picture.triangle[65, 75], picture.barycentric[65, 75][None])]
    tile, s, t = (v[0] for v in shown.decoded.atlas.locate(*place))
    kd, _, sigma = shown.decoded.residual.parameters(int(tile))
    i, j = int(s), int(t)
    near = kd[i : i + 2, j : j + 2].reshape(-1, 3)
    diffuse = np.array(probed["layers"]["diffuse"])
    assert (near.min(axis=0) - 1e-3 <= diffuse).all()
    assert (diffuse <= near.max(axis=0) + 1e-3).all()
    widths = sigma[i : i + 2, j : j + 2]
    assert widths.min() - 1e-3 <= probed["layers"]["roughness"] <= widths.max() + 1e-3
    linear = picture.linear[65, 75]
    here = next(view for view in probed["photographs"] if view["view"] == "000")
    np.testing.assert_allclose(here["values"], linear, atol=0.02)
    assert shown.page.page.evaluate("nishiki.scene.probe(1, 1, nishiki.state)") is None


def test_points_of_the_surface_for_the_ruler(shown):
    page, camera = shown.page.page, shown.decoded.cameras[0]
    canvas(shown, view={"captured": 0})
    renderer = shown.decoded.renderer()
    picture = next(renderer.render([renderer.captured(0)]))
    for row, column in ((65, 75), (50, 60), (80, 90)):
        corners = shown.decoded.mesh.vertices[shown.decoded.mesh.triangles[picture.triangle[row, column]]]
        u, v = picture.barycentric[row, column]
        got = page.evaluate(f"nishiki.scene.pointAt({column}.3, {row}.8, nishiki.state)")
        np.testing.assert_allclose(got, u * corners[0] + v * corners[1] + (1 - u - v) * corners[2], atol=0.02)
        back = page.evaluate("point => nishiki.scene.fromScene(point, nishiki.state)", got)
        np.testing.assert_allclose(back, [column + 0.5, row + 0.5], atol=0.5)
    assert page.evaluate("nishiki.scene.pointAt(1, 1, nishiki.state)") is None
    point = np.array([[0.3, -0.2, 0.5]])  # the lens of a captured camera counts
    seen = page.evaluate("point => nishiki.scene.fromScene(point, nishiki.state)", point[0].tolist())
    np.testing.assert_allclose(np.subtract(seen, 0.5), camera.project(point)[0][0], atol=1e-6)
    # the scale bar: a millimetre across the line of sight at the depth of the object's middle
    middle = np.array(page.evaluate("nishiki.scene.manifest.centre"))
    apart = camera.rotation @ middle + camera.translation
    scale = page.evaluate("nishiki.scene.scaleOf(nishiki.state)")
    np.testing.assert_allclose(scale, camera.intrinsics[0, 0] / apart[2], rtol=1e-9)


def test_the_ruler_measures_and_does_not_turn(shown):
    page = with_tool(shown, "r")
    page.mouse.move(130, 100)
    page.mouse.down()
    page.mouse.move(150, 110)
    page.mouse.move(165, 95)
    page.mouse.up()
    page.evaluate("nishiki.idle()")
    assert page.evaluate("nishiki.state.view.captured") == 2
    ends = [page.evaluate(f"nishiki.scene.pointAt({x}, {y}, nishiki.state)") for x, y in ((130, 100), (165, 95))]
    length = np.linalg.norm(np.subtract(*ends))
    assert length > 0.1
    words = page.locator("#overlay text").all_text_contents()
    assert len(words) == 2  # scale bar and ruler
    value, unit = words[1].split()
    assert unit == "mm"
    np.testing.assert_allclose(float(value), length, rtol=1e-3)
    page.keyboard.press("m")


def test_keys_alone_measure_and_read_values(shown):
    page = with_tool(shown, "r")
    before = page.evaluate("nishiki.state.view")
    for key in ("ArrowLeft", "Enter", *["ArrowRight"] * 3, "ArrowDown", "Enter", "ArrowDown"):
        page.keyboard.press(key)
    assert page.evaluate("nishiki.state.view") == before
    size = page.evaluate("[nishiki.scene.canvas.clientWidth, nishiki.scene.canvas.clientHeight]")
    middle = np.subtract(size, 1) / 2
    places = [np.add(middle, offset) for offset in ((-8, 0), (16, 8))]
    ends = [page.evaluate("([x, y]) => nishiki.scene.pointAt(x, y, nishiki.state)", place.tolist()) for place in places]
    value, unit = page.locator("#spoken").text_content().split()
    assert unit == "mm"
    np.testing.assert_allclose(float(value), np.linalg.norm(np.subtract(*ends)), rtol=1e-3)
    page.keyboard.press("p")
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Enter")
    place = page.locator("[data-section=probe] dd").first
    place.wait_for(state="attached")
    here = page.evaluate("([x, y]) => nishiki.scene.pointAt(x, y, nishiki.state)", places[1].tolist())
    read = [float(number) for number in place.text_content().removesuffix(" mm").split(", ")]
    np.testing.assert_allclose(read, here, rtol=1e-3, atol=1e-3)
    page.keyboard.press("m")
    page.keyboard.press("ArrowLeft")
    shown.page.page.evaluate("nishiki.idle()")
    assert page.evaluate("nishiki.state.view.captured") is None  # with this tool an arrow turns


def test_dragging_turns_the_object_and_page_keys_step_through_captured_views(shown):
    page = shown.page.page
    canvas(shown, view={"captured": 2})
    page.mouse.move(150, 100)
    page.mouse.down()
    page.mouse.move(180, 110)
    page.mouse.up()
    shown.page.page.evaluate("nishiki.idle()")
    assert page.evaluate("nishiki.state.view.captured") is None
    page.locator("canvas").first.focus()
    page.keyboard.press("PageUp")
    assert isinstance(page.evaluate("nishiki.state.view.captured"), int)


def test_a_region_is_a_part_of_the_same_picture(shown):
    whole = canvas(shown, view={"captured": 4}).copy()
    other = canvas(shown, view={"captured": 6}).copy()
    part = "nishiki.scene.draw({...nishiki.state, view: {captured: 4}}, {x: 0, y: 0, width: 70, height: 130})"
    read = f"() => {{ {part}; return ({viewer_pages.READ})(); }}"  # at once: nothing is drawn in between
    values = np.frombuffer(base64.b64decode(shown.page.page.evaluate(read)), np.uint8)
    mixed = values.reshape(130, 150, 4)[::-1, :, :3]
    assert (mixed[:, :70] == whole[:, :70]).all()
    assert (mixed[:, 70:] == other[:, 70:]).all()
    assert (whole != other).any()


def test_the_lens_shows_the_picture_of_three_times_the_size(shown):
    state = {"options": {}, "lamps": [], "ambient": 0, "layer": "appearance", "view": {"captured": 2}}
    lens, larger = viewer_pages.lens_and_larger_picture(shown.page, 130, 150, **state)
    assert np.ptp(larger) > 20
    assert viewer_pages.difference(lens, larger).max() < 1


def test_the_lens_goes_with_the_pointer_and_does_not_turn(shown):
    page = with_tool(shown, "g")
    before = shown.page.canvas()
    page.mouse.move(150, 100)
    page.locator("#lens").wait_for(state="visible")
    page.mouse.down()
    page.mouse.move(155, 100)
    page.mouse.up()
    assert 0 < np.mean(shown.page.canvas() != before) < 1
    assert page.evaluate("nishiki.state.view.captured") == 2
    page.mouse.move(150, 250)
    page.keyboard.press("m")
    page.locator("#lens").wait_for(state="hidden")
    assert np.array_equal(shown.page.canvas(), before)


def test_presets_change_what_is_seen_and_the_first_one_brings_it_back(shown):
    canvas(shown, view={"captured": 2}, ambient=0.05)
    seen = viewer_pages.presets_seen(shown.page)
    opened, *others, again = seen.values()
    assert len(others) == 3  # raking, gloss, relief
    assert np.array_equal(opened, again)
    pictures = [opened, *others]
    assert all(np.mean(a != b) > 0.05 for k, a in enumerate(pictures) for b in pictures[:k])


def test_the_emphasised_gloss_is_brightest_halfway_between_lamp_and_eye(shown):
    lamps = [viewer_pages.lamp(30, 50, radius_deg=0)]
    options = {"lighting": "free", "shadows": False}
    view = {"view": {"captured": 2}, "lamps": lamps, "options": options}
    bright = canvas(shown, **view, enhance="specular", strength=1, exposure=0.5).sum(axis=-1, dtype=int)
    rows, columns = np.nonzero(bright == bright.max())
    at = [float(np.median(columns)), float(np.median(rows))]
    probed = shown.page.page.evaluate("([x, y]) => nishiki.scene.probe(x, y, nishiki.state)", at)
    camera = shown.decoded.cameras[2]
    towards = camera.rotation.T @ (np.array([1, -1, -1]) * direction(50, 30))
    away = camera.centre - np.array(probed["position_mm"])
    halfway = towards + away / np.linalg.norm(away)
    assert probed["normal"] @ halfway / np.linalg.norm(halfway) > 0.99
    canvas(shown, enhance="none", exposure=1)


def test_controls_that_change_nothing_are_not_offered(shown):
    """Lamps of the capture cannot be moved, and a lamp's spectrum means nothing to an object without spectra."""
    section, words = shown.page.page.locator("[data-section=light]"), "cannot be computed"
    ticks = shown.page.page.locator("[data-section=layers] input[type=checkbox]")
    canvas(shown, options={}, lamps=[viewer_pages.lamp(40, 50)])
    assert (section.locator(".pad").count(), section.locator("input[type=range]").count()) == (0, 1)  # the exposure's
    assert ticks.count() == 2  # residual, places of the camera
    canvas(shown, options={"lighting": "free"}, lamps=[viewer_pages.lamp(40, 50)])
    assert (section.locator(".pad").count(), section.locator("select").count()) == (1, 0)
    assert words in section.text_content()
    assert ticks.count() == 2  # shadows, places of the camera


def test_depth_buffers_are_given_back(shown):
    canvas(shown, view={"captured": 0})
    made, alive = shown.page.page.evaluate("""async () => {
      const { scene } = nishiki, { gl } = scene, create = gl.createRenderbuffer, remove = gl.deleteRenderbuffer;
      const alive = new Set();
      let made = 0;
      gl.createRenderbuffer = () => { const one = create.call(gl); made++; alive.add(one); return one; };
      gl.deleteRenderbuffer = (one) => { alive.delete(one); remove.call(gl, one); };
      scene.dropTargets();
      await scene.probe(75, 65, nishiki.state);
      for (let view = 0; view < 8; view++) scene.texels.residualOf(view, 0);
      scene.draw(nishiki.state);
      scene.dropTargets();
      delete gl.createRenderbuffer;
      delete gl.deleteRenderbuffer;
      return [made, alive.size];
    }""")
    assert made > 8
    assert alive == 0


def test_a_point_has_three_coordinates(shown):
    page = with_tool(shown, "p")
    want = page.evaluate("nishiki.scene.pointAt(150, 100, nishiki.state)")
    page.mouse.click(150, 100)
    place = page.locator("[data-section=probe] dd").first
    place.wait_for(state="attached")
    names = page.locator("[data-section=probe] dt").all_text_contents()
    assert len(set(names)) == len(names) == 6
    assert not [name for name in names if "." in name]  # a text that is missing
    *values, last = place.text_content().split(", ")
    last, unit = last.split()
    assert unit == "mm"
    np.testing.assert_allclose([float(value) for value in (*values, last)], want, rtol=1e-3, atol=1e-4)
    page.locator("#sheet").click()  # the page is narrow: the controls opened
    page.locator("canvas").first.focus()
    page.keyboard.press("m")


def test_a_tool_that_is_chosen_keeps_the_focus(shown):
    page = shown.page.page
    for number in (1, 0):
        page.locator("#tools button").nth(number).focus()
        page.keyboard.press("Enter")
        focused = "document.activeElement === document.querySelectorAll('#tools button')[NUMBER]"
        assert page.evaluate(focused.replace("NUMBER", str(number)))
        assert page.locator("#tools button").nth(number).get_attribute("aria-pressed") == "true"


def test_layers_differ_and_nothing_was_complained_of(shown):
    names = shown.page.page.evaluate("nishiki.scene.layers().map(layer => layer.name)")
    pictures = [canvas(shown, view={"captured": 1}, layer=name).copy() for name in names]
    canvas(shown, view={"captured": 1}, layer="appearance", options={"cameras": True})
    assert len({picture.tobytes() for picture in pictures}) == len(names)
    assert shown.page.messages == []
    assert all(url.startswith(("file:", "data:")) for url in shown.page.requests)
