"""The viewer's pages in a real browser: opened, set to a state, and their canvas compared with `render`."""

from __future__ import annotations

import base64
import importlib.util
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.colour.colour import delta_e_2000, illuminant, srgb_matrix, xyz_to_lab
from nishiki.colour.encoding import decode
from nishiki.render.display import adapted_exposure, display_image
from nishiki.render.plane.frame import render
from nishiki.render.plane.scene import Ambient, Light, PlaneScene
from nishiki.stages.render.declaration import LightSettings
from nishiki.stages.render.requests import direction, white_sheet
from nishiki.stages.render.run import load_scene, seen

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

    def set(self, **changes: Any) -> None:
        """Change the state and wait until the picture is complete."""
        self.page.evaluate("(changes) => { nishiki.set(changes); }", changes)
        self.page.evaluate("nishiki.idle()")

    def picture(self, width: int, height: int, **changes: Any) -> np.ndarray:
        """(height, width, 3) uint8 canvas of this size with a state."""
        self.page.evaluate(
            "([w, h]) => { nishiki.scene.canvas.width = w; nishiki.scene.canvas.height = h; }", [width, height]
        )
        self.set(**changes)
        self.page.evaluate("nishiki.scene.draw(nishiki.state)")
        values = np.frombuffer(base64.b64decode(self.page.evaluate(READ)), np.uint8).reshape(height, width, 4)
        return values[::-1, :, :3]


@contextmanager
def opened(index: Path, *, width: int = 800, height: int = 600) -> Iterator[Page]:
    """The page in headless Chromium with its software rasteriser, once its scene can be drawn."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        shown = Page(browser.new_page(viewport={"width": width, "height": height}))
        shown.page.on("console", lambda message: shown.messages.append(f"{message.type}: {message.text}"))
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


def rendered(scene: PlaneScene, state: dict[str, Any]) -> tuple[np.ndarray, float]:
    """(rows, columns, 3) uint8 that `render` shows of a state of the page, frontal, in full size; and the exposure."""
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
    made = render(scene, lights, ambient=Ambient(spectrum=lights[0].spectrum, level=state["ambient"]))
    exposure = state["exposure"]
    if exposure == "auto":
        settings = [
            LightSettings(elevation_deg=each["elevation_deg"], intensity=each["intensity"]) for each in state["lamps"]
        ]
        exposure = adapted_exposure(made.xyz, seen=seen(made), sheet=white_sheet(settings, state["ambient"]))
    return display_image(made.xyz, white=made.white_xyz, exposure=exposure).pixels, exposure


def difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """CIEDE2000 of 8-bit sRGB pictures, pixel by pixel."""
    to_xyz = np.linalg.inv(srgb_matrix())
    labs = [xyz_to_lab(decode(each / 255, "srgb") @ to_xyz.T, to_xyz @ np.ones(3)) for each in (first, second)]
    return delta_e_2000(*labs)


def plane_scene(inputs: dict[str, Artifact]) -> PlaneScene:
    """What the stage render would show of these artifacts."""
    return load_scene(inputs, cast_shadows=True)
