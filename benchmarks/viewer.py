"""The viewer's page against render, object_render or cloth_render: differences of the pictures, bytes, time of a frame.

    python benchmarks/viewer.py results/SCENE ...
    python benchmarks/viewer.py --openings 5 OLDER/index.html NEWER/index.html

Each folder holds the results of one painting, object or cloth with the product viewer. Where a painting is larger than
the canvas, its middle is compared at 1:1; of an object and a cloth the pixels that they cover wholly, at the size of
the capture and at 800 x 600. The browser is headless Chromium with its software rasteriser. With --openings pages of
paintings are opened in turns in a browser that runs since five seconds, and the times from the opening to the first
picture, and until nothing is on its way, are printed.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(PROJECT / "workflow/src"), str(PROJECT / "tests")]

import viewer_pages  # noqa: E402
from viewer_pages import lamp  # noqa: E402

from nishiki.artifacts.artifact import open_artifact  # noqa: E402
from nishiki.render.cloth.models import ClothModels  # noqa: E402
from nishiki.render.display import encode_display  # noqa: E402
from nishiki.render.object.renderer import DecodedObject  # noqa: E402
from nishiki.stages.viewer.cloth import surfaces  # noqa: E402

STATES = {
    "D65 45°": {"lamps": [lamp(90, 45)], "ambient": 0.05},
    "D65 15°": {"lamps": [lamp(180, 15)], "ambient": 0.0},
    "A 45°": {"lamps": [lamp(90, 45, "A")], "ambient": 0.05},
    "F11 70°": {"lamps": [lamp(20, 70, "F11")], "ambient": 0.05},
    "D65 30° wide and A 60°": {
        "lamps": [lamp(300, 30, radius_deg=5), lamp(100, 60, "A", intensity=0.5)],
        "ambient": 0.1,
    },
    "D50 near": {"lamps": [lamp(250, 40, "D50", distance=0.8)], "ambient": 0.02},
}
CLOTH_STATES = {
    "35°": {"lamps": [lamp(140, 35, radius_deg=1.5)], "ambient": 0.16},
    "12°": {"lamps": [lamp(10, 12, radius_deg=1.5)], "ambient": 0.05},
    "two wide": {
        "lamps": [lamp(60, 60, radius_deg=4), lamp(160, 30, intensity=0.6, radius_deg=3)],
        "ambient": 0.1,
    },
    "near": {"lamps": [lamp(90, 40, distance=1.0, radius_deg=2)], "ambient": 0.1},
    "from around": {"lamps": [], "ambient": 0.3},
    "dyed": {"lamps": [lamp(140, 35, radius_deg=1.5)], "ambient": 0.16, "options": {"dye": "gold"}},
}
FIRST_PICTURE = """
const { drawArrays, bindFramebuffer, readPixels } = WebGL2RenderingContext.prototype;
let target = null;
WebGL2RenderingContext.prototype.bindFramebuffer = function (kind, framebuffer) {
  target = framebuffer;
  bindFramebuffer.call(this, kind, framebuffer);
};
WebGL2RenderingContext.prototype.drawArrays = function (...values) {
  drawArrays.apply(this, values);
  if (target || window.firstPicture) return;
  window.firstPicture = Infinity;
  queueMicrotask(() => {
    readPixels.call(this, 0, 0, 1, 1, this.RGBA, this.UNSIGNED_BYTE, new Uint8Array(4)); // waits until it is drawn
    window.firstPicture = performance.now();
  });
};
"""
OBJECT_VIEW = 2
OBJECT_STATES = {
    "captured": {},
    "model alone": {"options": {"residual": False}},
    "far lamp, a point": {"lamps": [lamp(180, 25, radius_deg=0)], "ambient": 0.05, "options": {"lighting": "free"}},
    "far lamp, 3°": {"lamps": [lamp(180, 25, radius_deg=3)], "ambient": 0.05, "options": {"lighting": "free"}},
    "two, wide": {
        "lamps": [lamp(60, 50, radius_deg=8), lamp(200, 15, intensity=0.6, radius_deg=3)],
        "ambient": 0.05,
        "options": {"lighting": "free"},
    },
    "near lamp": {
        "lamps": [lamp(90, 40, distance=0.8, radius_deg=3)],
        "ambient": 0.05,
        "options": {"lighting": "free"},
    },
}
MOST = (512, 512)
FRAMES = 5


def measured(folder: Path) -> list[dict]:
    """Rows of one scene: one a state, and one of its sizes and times."""
    current = folder / "current"
    inputs = {
        name: open_artifact(current / name, contents=False)
        for name in ("normals", "height", "spectra", "brdf")
        if (current / name).exists()
    }
    page_folder = current / "viewer"
    scene = viewer_pages.plane_scene(inputs)
    height, width = (min(side, most) for side, most in zip(scene.shape, MOST, strict=True))
    top, left = ((side - part) // 2 for side, part in zip(scene.shape, (height, width), strict=True))
    zoom = max(scene.shape[0] / height, scene.shape[1] / width)
    middle = [
        (left + width / 2 - scene.shape[1] / 2) * scene.pitch,
        (scene.shape[0] / 2 - top - height / 2) * scene.pitch,
    ]
    view = {"x": middle[0] * scene.pitch, "y": middle[1] * scene.pitch, "zoom": zoom, "tilt_deg": 0, "azimuth_deg": 0}
    rows = []
    start = time.perf_counter()
    with viewer_pages.opened(page_folder / "index.html", width=1000, height=700) as page:
        opening = time.perf_counter() - start
        first = [url for url in page.requests if url.startswith("file:")]
        read = sum(Path(url.removeprefix("file://")).stat().st_size for url in first)
        for name, state in STATES.items():
            expected, exposure = viewer_pages.rendered(scene, {**state, "exposure": "auto"})
            shown = page.picture(width, height, **state, exposure=exposure, view=view)
            errors = viewer_pages.difference(shown, expected[top : top + height, left : left + width])
            rows.append({"scene": folder.name, "state": name, "mean": errors.mean(), "p99": np.percentile(errors, 99)})
        draw = f"""() => {{
          const start = performance.now();
          for (let k = 0; k < {FRAMES}; k++) {{ nishiki.scene.draw(nishiki.state); nishiki.scene.readPixels(); }}
          return (performance.now() - start) / {FRAMES};
        }}"""
        page.set(lamps=[lamp(90, 45)])
        milliseconds = page.page.evaluate(draw)
        cost = page.page.evaluate("nishiki.scene.cost()")
        messages = page.messages
    files = [path for path in page_folder.rglob("*") if path.suffix in (".js", ".html")]
    rows.append(
        {
            "scene": folder.name,
            "pixels": scene.normals.shape[0] * scene.normals.shape[1],
            "megabytes": sum(path.stat().st_size for path in files) / 1e6,
            "megabytes_before_first_picture": read / 1e6,
            "opening_s": opening,
            "frame_ms": milliseconds,
            "frame_pixels": width * height,
            **cost,
            "messages": messages,
        }
    )
    return rows


def measured_object(folder: Path) -> list[dict]:
    """Rows of one scene: one a state, of a captured view, and its own lamps without their shadows."""
    current, rows = folder / "current", []
    stages = ("ingest", "mesh", "cameras", "texels", "object_brdf", "residual")
    decoded = DecodedObject.open({name: open_artifact(current / name, contents=False) for name in stages})
    first = decoded.cameras[0]
    states = dict(OBJECT_STATES)
    for name, state in OBJECT_STATES.items():
        if "lamps" in state:
            states[f"{name}, no shadows"] = {**state, "options": {**state["options"], "shadows": False}}
    with viewer_pages.opened(
        current / "object_viewer/index.html", width=first.columns + 330, height=first.rows
    ) as page:
        for name, state in states.items():
            state = {"lamps": [], "ambient": 0, "options": {}, "exposure": 1, "layer": "appearance", **state}
            shown = page.picture(first.columns, first.rows, **state, view={"captured": OBJECT_VIEW})
            own = viewer_pages.own_lighting(state) if state["lamps"] else None
            renderer = decoded.renderer(rim=0, own_lamps=own, model_only=not state["options"].get("residual", True))
            picture = next(renderer.render([renderer.captured(OBJECT_VIEW)]))
            inner = picture.covered.copy()
            for axis in (0, 1):  # the pixels beside the edge are blended with the background
                inner &= np.roll(picture.covered, 1, axis) & np.roll(picture.covered, -1, axis)
            errors = viewer_pages.difference(shown, encode_display(picture.linear).pixels)[inner]
            rows.append({"scene": folder.name, "state": name, "mean": errors.mean(), "p99": np.percentile(errors, 99)})
        rows.append({"scene": folder.name, "messages": page.messages})
    return rows


def measured_cloth(folder: Path) -> list[dict]:
    """Rows of one scene: one a surface and state, one a model, and one of its sizes and times."""
    current, rows = folder / "current", []
    models = ClothModels(open_artifact(current / "cloth_brdf", contents=False).folder)
    others = [f"{models.regions[0]}-{name}" for name in models.names(models.regions[0]) if name != models.default]
    states = [(shape, name, state) for shape in surfaces(None) for name, state in CLOTH_STATES.items()]
    states += [("drape", name, {**CLOTH_STATES["35°"], "options": {"material": name}}) for name in others]
    with viewer_pages.opened(current / "cloth_viewer/index.html", width=1000, height=700) as page:
        for shape, name, state in states:
            options = {**state.get("options", {}), "shape": shape}
            state = {**state, "exposure": 0.9, "options": options}
            shown = page.picture(800, 600, **state, view=None)
            expected, cloth = viewer_pages.cloth_rendered(models, state, shape)
            errors = viewer_pages.difference(shown, expected)[cloth]
            rows.append({"shape": shape, "state": name, "mean": errors.mean(), "p99": np.percentile(errors, 99)})
        for shape in surfaces(None):
            page.set(**CLOTH_STATES["35°"], options={"shape": shape})
            frame = f"""() => {{
              const start = performance.now();
              for (let k = 1; k <= {FRAMES}; k++) {{
                nishiki.scene.draw({{...nishiki.state, ambient: 0.1 + 0.001 * k}});
                nishiki.scene.readPixels();
              }}
              return (performance.now() - start) / {FRAMES};
            }}"""
            rows.append({"shape": shape, "frame_ms": page.page.evaluate(frame), "messages": page.messages})
    return rows


def measured_openings(pages: list[Path], openings: int) -> list[dict]:
    """Rows of times in ms: least, median and most."""
    from playwright.sync_api import sync_playwright

    times = {page: [] for page in pages}
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=viewer_pages.CHROMIUM, args=viewer_pages.FLAGS)
        browser.new_page().wait_for_timeout(5000)
        for index in pages * openings:
            page = browser.new_page(viewport={"width": 1200, "height": 760})
            page.add_init_script(FIRST_PICTURE)
            page.goto(index.resolve().as_uri(), wait_until="commit")
            page.wait_for_function("window.firstPicture < Infinity && window.nishiki", timeout=60_000)
            first = page.evaluate("window.firstPicture")
            page.evaluate("nishiki.idle()")
            times[index].append((first, page.evaluate("performance.now()")))
            page.close()
        browser.close()
    quartiles = {page: np.percentile(each, (0, 50, 100), axis=0).round() for page, each in times.items()}
    return [
        {"page": str(page), "first_picture_ms": values[:, 0].tolist(), "at_rest_ms": values[:, 1].tolist()}
        for page, values in quartiles.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE, or pages")
    parser.add_argument("--openings", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.openings:
        for row in measured_openings(arguments.folders, arguments.openings):
            print(json.dumps(row), flush=True)
        return
    for folder in arguments.folders:
        pages = {"viewer": measured, "object_viewer": measured_object, "cloth_viewer": measured_cloth}
        (measure,) = (pages[name] for name in pages if (folder / "current" / name).exists())
        for row in measure(folder):
            print(json.dumps({key: round(v, 3) if isinstance(v, float) else v for key, v in row.items()}), flush=True)


if __name__ == "__main__":
    main()
