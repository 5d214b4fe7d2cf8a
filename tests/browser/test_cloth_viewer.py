"""The page of a cloth in a real browser: canvas against cloth_render, choices, dragging, values under the cursor."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import viewer_pages
from benchmarks.cloth_peers import Ward
from viewer_pages import lamp

from nishiki.brdf.cloth.store import save_brdf
from nishiki.progress import Progress
from nishiki.render.cloth.models import ClothModels
from nishiki.report.viewer.page import Blocks
from nishiki.stages.render import DYES, SurfaceFile
from nishiki.stages.viewer import cloth

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(viewer_pages.missing() is not None, reason=str(viewer_pages.missing())),
]
ROOF = """v 0 0 0
v 3 0 0
v 3 1 -1
v 0 1 -1
v 3 0 -2
v 0 0 -2
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt 1 2
vt 0 2
f 1/1 2/2 3/3
f 1/1 3/3 4/4
f 4/4 3/3 5/5
f 4/4 5/5 6/6
"""
WARDS = {
    "ward": Ward(diffuse=np.array([0.25, 0.08, 0.03]), specular=np.full(3, 0.15), alpha_x=0.45, alpha_y=0.2),
    "dull": Ward(diffuse=np.array([0.1, 0.2, 0.3]), specular=np.zeros(3), alpha_x=0.4, alpha_y=0.4),
}
STATES = {
    "distant": {"lamps": [lamp(140, 35, radius_deg=1.5)], "ambient": 0.16},
    "two, wide": {"lamps": [lamp(60, 60, radius_deg=4), lamp(160, 20, intensity=0.6)], "ambient": 0.0},
    "near": {"lamps": [lamp(90, 40, distance=1.0, radius_deg=2)], "ambient": 0.05},
    "dyed": {"lamps": [lamp(140, 35)], "ambient": 0.16, "options": {"dye": "gold"}},
    "other model": {"lamps": [lamp(140, 35)], "ambient": 0.16, "options": {"material": "cloth-dull"}},
}


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Two models and their page, open in a browser, with surfaces of fewer points than shipped."""
    folder = tmp_path_factory.mktemp("cloth")
    models = folder / "models" / "cloth"
    models.mkdir(parents=True)
    for name, brdf in WARDS.items():
        save_brdf(models / f"{name}.npz", brdf)
    told = {name: {"used": [0]} for name in WARDS}
    text = json.dumps({"default": "ward", "regions": ["cloth"], "models": {"cloth": told}})
    (folder / "cloth_brdf.json").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cloth, "FINEST_SIDE", 65)
        patch.setattr(cloth, "SIZE", (180, 240))
        blocks = Blocks(SimpleNamespace(path=lambda name: folder / name), inline_bytes=10**8)
        about = {"title": "Satin", "scene": "satin", "key": "", "version": ""}
        (folder / "roof.obj").write_text(ROOF)
        mesh = SurfaceFile(file=str(folder / "roof.obj"))
        cloth.write_cloth(ClothModels(folder), blocks, about, dyes=DYES, mesh=mesh, progress=Progress("test"))
        with viewer_pages.opened(folder / "index.html", width=500, height=300) as page:
            yield SimpleNamespace(models=ClothModels(folder), mesh=mesh, page=page)


@pytest.mark.parametrize(
    ("shape", "name"),
    [*(("drape", name) for name in STATES), ("flat", "near"), ("cylinders", "two, wide"), ("file", "distant")],
)
def test_the_page_shows_what_cloth_render_shows(shown, shape, name):
    state = {"options": {}, **STATES[name], "exposure": 0.9}
    state["options"] = {**state["options"], "shape": shape}
    want, cloth = viewer_pages.cloth_rendered(shown.models, state, shape, mesh=shown.mesh)
    assert cloth.sum() > 4000
    got = shown.page.picture(240, 180, **state, view=None, layer="appearance")
    apart = viewer_pages.difference(got, want)[cloth]
    assert apart.mean() < 0.7
    assert np.percentile(apart, 97) < 2.5  # the rest: edges of shadows


def test_shadows_fall_where_they_should(shown):
    state = {**STATES["distant"], "exposure": 0.9, "options": {"shape": "drape"}}
    lit = viewer_pages.cloth_rendered(shown.models, {**state, "lamps": [], "ambient": 1.0}, "drape")[1]
    plain, _ = viewer_pages.cloth_rendered(shown.models, state, "drape")
    without, _ = viewer_pages.cloth_rendered(shown.models, state, "drape", shadows=False)
    changed = lit & (viewer_pages.difference(plain, without) > 5)
    assert changed.sum() > 300
    got = shown.page.picture(240, 180, **state, view=None)
    assert np.median(viewer_pages.difference(got, plain)[changed]) < 1


def test_values_under_the_cursor(shown):
    state = {**STATES["distant"], "exposure": 0.9, "options": {"shape": "flat", "material": "cloth-dull"}}
    shown.page.picture(240, 180, **state, view=None)
    probed = shown.page.page.evaluate("nishiki.scene.probe(119.5, 89.5, nishiki.state)")
    np.testing.assert_allclose(probed["normal"], [0, 0, 1], atol=1e-3)
    assert abs(probed["gloss"]["lamp_deg"] - 55) < 0.1
    assert probed["gloss"]["eye_deg"] < 0.5
    np.testing.assert_allclose(probed["gloss"]["reflectance"], WARDS["dull"].diffuse, rtol=0.01)
    assert shown.page.page.evaluate("nishiki.scene.probe(2, 2, nishiki.state)") is None


def test_a_surface_from_a_file_comes_first_with_its_own_numbers(shown):
    assert shown.page.page.evaluate("nishiki.scene.options()[0].value") == "file"
    shown.page.picture(240, 180, **STATES["distant"], options={}, view=None)
    probed = shown.page.page.evaluate("nishiki.scene.probe(119.5, 89.5, nishiki.state)")
    place = np.array(probed["position_mm"])
    assert (place > [0, 0, -1]).all()
    assert (place < [3, 1, 0]).all()
    np.testing.assert_allclose(place[1], -place[2], atol=1e-3)  # on the front of the roof
    assert shown.page.page.evaluate("nishiki.scene.bounds().unit") == ""


def test_dragging_turns_the_cloth_and_another_surface_brings_its_own_view(shown):
    page = shown.page.page
    before = shown.page.picture(240, 180, options={"shape": "flat"}, view=None, layer="appearance").copy()
    page.mouse.move(100, 100)
    page.mouse.down()
    page.mouse.move(160, 120)
    page.mouse.up()
    page.evaluate("nishiki.idle()")
    assert page.evaluate("nishiki.state.view.shape") == "flat"
    turned = page.evaluate("nishiki.scene.viewOf(nishiki.state).eye")
    first = page.evaluate("nishiki.scene.firstView('flat').eye")
    assert np.linalg.norm(np.subtract(turned, first)) > 0.3
    shown.page.set(options={"shape": "drape"})
    assert page.evaluate("nishiki.scene.viewOf(nishiki.state).shape") == "drape"
    again = shown.page.picture(240, 180, options={"shape": "flat"}, view=None)
    assert (again == before).all()


def test_the_lens_shows_the_picture_of_three_times_the_size(shown):
    state = {**STATES["distant"], "exposure": 0.9, "options": {"shape": "drape"}, "view": None, "layer": "appearance"}
    lens, larger = viewer_pages.lens_and_larger_picture(shown.page, 90, 120, **state)
    assert np.ptp(larger) > 20
    apart = viewer_pages.difference(lens, larger)
    assert np.median(apart) == 0
    assert np.mean(apart > 2) < 0.01


def test_presets_change_what_is_seen_and_the_first_one_brings_it_back(shown):
    shown.page.picture(120, 90, options={"shape": "flat"}, view=None, layer="appearance")
    opened, *others, again = viewer_pages.presets_seen(shown.page).values()
    assert len(others) == 2  # raking, gloss
    assert np.array_equal(opened, again)
    assert all(np.mean(opened != other) > 0.05 for other in others)


def test_layers_and_an_own_dye_differ_and_nothing_was_complained_of(shown):
    names = shown.page.page.evaluate("nishiki.scene.layers().map(layer => layer.name)")
    state = {"view": None, "options": {"shape": "drape"}, "lamps": [lamp(140, 35)]}
    pictures = [shown.page.picture(120, 90, **state, layer=name).copy() for name in names]
    options = {"shape": "drape", "dye": "own", "colour": "#00ff88"}
    pictures.append(shown.page.picture(120, 90, **{**state, "options": options}, layer="appearance"))
    assert len({picture.tobytes() for picture in pictures}) == len(pictures)
    shown.page.page.set_viewport_size({"width": 1000, "height": 600})
    shown.page.page.locator("[data-section=layers] summary").click()
    assert shown.page.page.locator("input[type=color]").count() == 1
    assert shown.page.messages == []
    assert all(url.startswith(("file:", "data:")) for url in shown.page.requests)
