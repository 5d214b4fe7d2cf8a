"""The viewer's pages in a real browser: opened, set to a state, and their canvas compared with `render`."""

from __future__ import annotations

import base64
import functools
import http.server
import importlib.util
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact, ArtifactWriter, open_artifact
from nishiki.artifacts.stage import Context
from nishiki.brdf.slopes import slope_covariance
from nishiki.colour.colour import cie_1931_cmfs, decode, delta_e_2000, illuminant, srgb_matrix, xyz_to_lab
from nishiki.progress import Progress
from nishiki.render.cloth.models import ClothModels, apply_dyes
from nishiki.render.cloth.scene import Lamp
from nishiki.render.cloth.studio import RenderVariant, linear_colour
from nishiki.render.cloth.studio import render as render_cloth
from nishiki.render.display import adapted_exposure, develop, display_image
from nishiki.render.object.shots import FreeLamp, FreeLighting
from nishiki.render.plane.frame import render
from nishiki.render.plane.scene import Ambient, Light, PlaneScene, View
from nishiki.render.plane.shade import cast_shadows
from nishiki.stages.render import DYES, LightSettings, SurfaceFile
from nishiki.stages.render.painting import direction, load_scene, select_object, white_sheet
from nishiki.stages.viewer import ViewerSettings
from nishiki.stages.viewer import painting as viewer_run
from nishiki.stages.viewer.cloth import shape_of, surfaces

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
READ = """() => {
  const bytes = nishiki.scene.readPixels();
  let text = "";
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(text);
}"""


def missing() -> str | None:
    """Why pages cannot be opened here; None where they can."""
    if importlib.util.find_spec("playwright") is None:
        return "playwright is not installed"
    return None if CHROMIUM else "no Chromium on the path"


@dataclass
class Page:
    """An open page: its messages, its requests, and its canvas."""

    page: Any
    messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def noted(self, message: str) -> None:
        """Keep a message of the console, but for the driver's remark that tests read the canvas back often."""
        if "GPU stall due to ReadPixels" not in message:
            self.messages.append(message)

    def set(self, **changes: Any) -> None:
        """Change the state and wait until the picture is complete."""
        self.page.evaluate("(changes) => { nishiki.set(changes); }", changes)
        self.page.evaluate("nishiki.idle()")

    def state(self) -> dict[str, Any]:
        """The state of the page."""
        return self.page.evaluate("JSON.parse(JSON.stringify(nishiki.state))")

    def canvas(self) -> np.ndarray:
        """(n,) uint8 bytes of the canvas as it is, from its lowest row upwards, once the picture is complete."""
        self.page.evaluate("nishiki.idle()")
        return np.frombuffer(base64.b64decode(self.page.evaluate(READ)), np.uint8)

    def section(self, name: str) -> Any:
        """A section of the panel, unfolded."""
        part = self.page.locator(f"[data-section={name}]")
        if part.get_attribute("open") is None:
            part.locator("summary").click()
        return part

    def picture(self, width: int, height: int, **changes: Any) -> np.ndarray:
        """(height, width, 3) uint8 canvas of this size with a state."""
        self.page.evaluate("nishiki.idle()")  # the page draws on a smaller canvas first
        self.page.evaluate(
            "([w, h]) => { nishiki.scene.canvas.width = w; nishiki.scene.canvas.height = h; }", [width, height]
        )
        self.set(**changes)
        self.page.evaluate("nishiki.scene.draw(nishiki.state)")
        values = np.frombuffer(base64.b64decode(self.page.evaluate(READ)), np.uint8).reshape(height, width, 4)
        return values[::-1, :, :3]


def lens_and_larger_picture(shown: Page, rows: int, columns: int, **state: Any) -> tuple[np.ndarray, np.ndarray]:
    """What a lens shows of a picture of this size, and the same part of the picture of three times the size: uint8."""
    at, side = (columns // 2 - 5, rows // 2 + 3), 40
    larger = shown.picture(3 * columns, 3 * rows, **state).copy()
    shown.picture(columns, rows, **state)
    left, top = at[0] - side // 2, at[1] - side // 2
    draw = """([at, region]) => {
      const { scene, state } = nishiki, seen = scene.enlarged(state, 3, at, at);
      do scene.draw(seen, region, "lens"); while (scene.busy);
      return (READ)(); // at once: the page draws its own state after it
    }""".replace("READ", READ)
    region = {"x": left, "y": top, "width": side, "height": side}
    values = np.frombuffer(base64.b64decode(shown.page.evaluate(draw, [at, region])), np.uint8)
    drawn = values.reshape(rows, columns, 4)[::-1, :, :3]
    first = (top + 2 * at[1], left + 2 * at[0])
    return (
        drawn[top : top + side, left : left + side],
        larger[first[0] : first[0] + side, first[1] : first[1] + side],
    )


def presets_seen(shown: Page) -> dict[str, np.ndarray]:
    """The canvas under every preset of the page, the first of them, which is chosen last, twice."""
    buttons = shown.page.locator("#panel [role=group][aria-label=Presets] button")
    seen = {}
    for number in (*range(buttons.count()), 0):
        buttons.nth(number).evaluate("each => each.click()")
        assert buttons.nth(number).get_attribute("aria-pressed") == "true"
        seen[buttons.nth(number).text_content() + (" again" if number == 0 and seen else "")] = shown.canvas().copy()
    return seen


@contextmanager
def painting_page(current: Path, folder: Path) -> Iterator[Path]:
    """The page that the stage viewer makes in an empty folder of the present results of a painting."""
    inputs = {
        name: open_artifact(current / name)
        for name in ("ingest", "normals", "height", "spectra", "brdf", "evaluate")
        if (current / name).exists()
    }
    stamp = {"scene": "tiny", "stage": "viewer", "key": "0" * 12, "version": "0"}
    with ArtifactWriter(folder / stamp["key"]) as output:
        viewer_run.run(Context(inputs, ViewerSettings(), output, None, None, stamp, Progress("tiny/viewer")))
        yield (output.folder / "index.html").resolve()


class _Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        """Requests are not printed."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder, for pages that read files."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Silent, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()


@contextmanager
def opened(index: Path, *, width: int = 800, height: int = 600) -> Iterator[Page]:
    """The page in headless Chromium with its software rasteriser, once its scene can be drawn."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        shown = Page(browser.new_page(viewport={"width": width, "height": height}))
        shown.page.on("console", lambda message: shown.noted(f"{message.type}: {message.text}"))
        shown.page.on("pageerror", lambda error: shown.messages.append(f"error: {error}"))
        shown.page.on("request", lambda request: shown.requests.append(request.url[:200]))
        shown.page.goto(index.resolve().as_uri())
        shown.page.wait_for_function("window.nishiki && window.nishiki.scene", timeout=60_000)
        shown.page.evaluate("nishiki.idle()")
        yield shown
        browser.close()


def lamp(azimuth: float, elevation: float, illuminant: str = "D65", **changes: Any) -> dict[str, Any]:
    """A lamp of a state."""
    return {
        "azimuth_deg": azimuth,
        "elevation_deg": elevation,
        "distance": None,
        "radius_deg": 0.75,
        "intensity": 1,
        "illuminant": illuminant,
        **changes,
    }


def lights_of(scene: PlaneScene, state: dict[str, Any]) -> list[Light]:
    """The lamps of a state of the page, for `render`."""
    lights = []
    side = max(scene.shape) * scene.pitch
    for each in state["lamps"]:
        towards = direction(each["elevation_deg"], each["azimuth_deg"])
        near = each["distance"]
        place = (
            {"position_mm": tuple(towards * near * side), "falloff": True} if near else {"direction": tuple(towards)}
        )
        lights.append(
            Light(
                spectrum=illuminant(each["illuminant"]),
                intensity=each["intensity"],
                angular_radius=np.radians(each["radius_deg"]),
                **place,
            )
        )
    return lights


def tilted_view(scene: PlaneScene, tilt_deg: float, azimuth_deg: float, zoom: float = 1) -> View:
    """A pinhole camera so far away that its picture is a parallel projection, a pixel for a pixel across the tilt."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    along, across = np.array([[np.cos(azimuth), np.sin(azimuth), 0], [-np.sin(azimuth), np.cos(azimuth), 0]])
    normal = np.array([0, 0, 1.0])
    rows, columns = scene.shape
    far = 1e4 * rows * scene.pitch
    return View(
        eye_mm=tuple(far * (np.sin(tilt) * along + np.cos(tilt) * normal)),
        up=tuple(along[1] * (np.cos(tilt) * along - np.sin(tilt) * normal) + across[1] * across),
        field_of_view=2 * np.arctan(rows * scene.pitch / 2 / far / zoom),
        rows=rows,
        columns=columns,
    )


def rendered(scene: PlaneScene, state: dict[str, Any], view: View | None = None) -> tuple[np.ndarray, float]:
    """(rows, columns, 3) uint8 that `render` shows of a state of the page, frontal or from `view`; and the exposure."""
    lights = lights_of(scene, state)
    made = render(scene, lights, view, ambient=Ambient(spectrum=lights[0].spectrum, level=state["ambient"]))
    exposure = state["exposure"]
    if exposure == "auto":
        settings = [
            LightSettings(elevation_deg=each["elevation_deg"], intensity=each["intensity"]) for each in state["lamps"]
        ]
        exposure = adapted_exposure(made.xyz, seen=select_object(made), sheet=white_sheet(settings, state["ambient"]))
    return display_image(made.xyz, white=made.white_xyz, exposure=exposure).pixels, exposure


def enhanced(scene: PlaneScene, state: dict[str, Any]) -> np.ndarray:
    """(rows, columns, 3) uint8 of an enhancement by its formula (docs/stages/viewer.md), from pictures of `render`.

    state : with one distant lamp, a number as exposure, `enhance` and `strength`.
    """
    strength, name = state["strength"], state["enhance"]
    (light,) = lights_of(scene, state)
    visibility = cast_shadows(scene.height, [light], pitch=scene.pitch)
    slopes = scene.normals[..., :2] / np.maximum(scene.normals[..., 2:], 0.2)
    if name == "unsharp":
        rows, columns = np.indices(scene.shape)
        ring = [(y, x) for r in (1, 3) for y in (-r, 0, r) for x in (-r, 0, r) if x or y]
        beside = [
            np.clip(rows + y, 0, rows.max()) * scene.shape[1] + np.clip(columns + x, 0, columns.max()) for y, x in ring
        ]
        mean = np.mean([scene.normals.reshape(-1, 3)[each] for each in beside], axis=0)
        normals = scene.normals + 4 * strength * (scene.normals - mean)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        scene = replace(scene, normals=normals.astype(np.float32))
    if name in ("raking", "relief"):
        normals = scene.normals * [1 + 4 * strength, 1 + 4 * strength, 1]
        normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
        covariance = None if scene.slopes is None else slope_covariance(normals)
        scene = replace(scene, normals=normals, slopes=covariance)

    def xyz(scene, level):
        ambient = Ambient(spectrum=light.spectrum, level=level)
        return render(scene, [light], ambient=ambient, visibility=visibility).xyz.astype(np.float64)

    matte = replace(scene, gloss=replace(scene.gloss, beta=np.zeros_like(scene.gloss.beta)))
    gloss = xyz(scene, 0.0) - xyz(matte, 0.0)
    lit = xyz(matte, 0.0)
    ambient = xyz(matte, state["ambient"]) - lit
    white = light.spectrum @ cie_1931_cmfs().T / (light.spectrum @ cie_1931_cmfs()[1])
    if name == "specular":
        halfway = light.central_direction() + np.array([0, 0, 1])
        cosine = np.maximum(scene.normals @ (halfway / np.linalg.norm(halfway)), 0)
        highlight = 0.6 * strength * light.intensity * visibility[0] * cosine**60
        shown = lit * (1 - 0.8 * strength) + ambient + gloss + highlight[..., None] * white
    elif name == "curvature":
        around = np.pad(slopes, ((1, 1), (1, 1), (0, 0)), mode="edge")
        bend = around[1:-1, 2:, 0] - around[1:-1, :-2, 0] + around[:-2, 1:-1, 1] - around[2:, 1:-1, 1]
        shown = (lit + ambient) * np.clip(1 + 6 * strength * bend, 0.3, 1.7)[..., None] + gloss
    elif name in ("unsharp", "relief"):
        shown = lit + ambient + gloss
    else:
        spectra = scene.coefficients @ scene.basis
        colour = (spectra * light.spectrum) @ cie_1931_cmfs().T / (light.spectrum @ cie_1931_cmfs()[1])
        shade = (lit + ambient)[..., 1:2] / colour[..., 1:2]
        shown = shade * ((1 - strength) * colour + strength * 0.6 * white) + gloss
    return display_image(shown.astype(np.float32), white=white, exposure=state["exposure"]).pixels


def cloth_rendered(
    models: ClothModels,
    state: dict[str, Any],
    shape: str,
    *,
    mesh: SurfaceFile | None = None,
    supersampling: int = 3,
    shadows: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """What `cloth_render` shows of a state of a cloth's page in the first view of a surface.

    Returns
    -------
    tuple of numpy.ndarray
        (rows, columns, 3) uint8; (rows, columns) bool, the pixels that the cloth covers wholly.
    """
    stage, options = surfaces(mesh)[shape](), state.get("options", {})
    numbers = shape_of(stage).numbers
    middle, radius = np.array(numbers["centre"]), numbers["radius"]
    front, lamps = stage.camera.rotation * [[1], [-1], [-1]], []
    for each in state["lamps"]:
        towards = direction(each["elevation_deg"], each["azimuth_deg"]) @ front
        near = each["distance"] and 2 * radius * each["distance"]
        place = {"place": tuple(middle + near * towards), "distance": near} if near else {"direction": tuple(towards)}
        lamps.append(Lamp(colour=(each["intensity"],) * 3, radius=np.radians(each["radius_deg"]), **place))
    region, _, model = options.get("material", f"{models.regions[0]}-{models.default}").partition("-")
    brdf = models.brdf(region, model)
    dye = options.get("dye", "measured")
    brdf = brdf if dye == "measured" else apply_dyes(brdf, {dye: linear_colour(DYES[dye])})[dye]
    materials = (brdf,) if stage.paper is None else (brdf, stage.paper)
    take = RenderVariant(materials, (1.0,) * len(lamps), around=state["ambient"])
    light = {"surroundings": stage.surroundings, "shadows": shadows}
    picture = render_cloth(stage.scene, [take], lamps, stage.camera, supersampling=supersampling, **light)[0]
    image = develop(picture.linear, picture.coverage, exposure=state["exposure"], soft=True, background=1.0)
    return image.pixels, picture.cloth > 1 - 1e-6


def own_lighting(state: dict[str, Any], rays: int = 16) -> FreeLighting:
    """The lamps of a state of an object's page, for `object_render`."""
    lamps = tuple(
        FreeLamp(
            np.radians(each["azimuth_deg"]),
            np.radians(each["elevation_deg"]),
            each["intensity"],
            np.radians(each["radius_deg"]),
            each["distance"],
        )
        for each in state["lamps"]
    )
    return FreeLighting(lamps, state["ambient"], state.get("options", {}).get("shadows", True), rays)


def difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """CIEDE2000 of 8-bit sRGB pictures, pixel by pixel."""
    to_xyz = np.linalg.inv(srgb_matrix())
    labs = [xyz_to_lab(decode(each / 255, "srgb") @ to_xyz.T, to_xyz @ np.ones(3)) for each in (first, second)]
    return delta_e_2000(*labs)


def plane_scene(inputs: dict[str, Artifact]) -> PlaneScene:
    """What the stage render would show of these artifacts."""
    return load_scene(inputs, cast_shadows=True)
