"""A glTF file drawn by three.js in headless Chromium, as viewers on the web draw it."""

from __future__ import annotations

import base64
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import viewer_pages
from npm_packages import npm_folder

NODE_FOLDER = npm_folder("three/build/three.module.js")
THREE = NODE_FOLDER / "three" if NODE_FOLDER else None
"""The npm package three; None where it is not installed."""
PAGE = """<!doctype html><meta charset="utf-8">
<script type="importmap">
{"imports": {"three": "./three/build/three.module.js", "loaders/": "./three/examples/jsm/loaders/"}}
</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "loaders/GLTFLoader.js";
const renderer = new THREE.WebGLRenderer({ alpha: true, antialias: false, preserveDrawingBuffer: true });
const scene = new THREE.Scene(), lamp = new THREE.DirectionalLight(0xffffff, Math.PI);
const { scene: model } = await new GLTFLoader().loadAsync("model.glb");
scene.add(model, lamp);
const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0, 2);
camera.position.z = 1;
globalThis.draw = ([rows, columns, pixel, direction]) => {
  const right = (columns * pixel) / 2, top = (rows * pixel) / 2;
  Object.assign(camera, { left: -right, right, top, bottom: -top });
  camera.updateProjectionMatrix();
  renderer.setSize(columns, rows, false);
  lamp.position.set(...direction);
  renderer.render(scene, camera);
  const gl = renderer.getContext(), bytes = new Uint8Array(rows * columns * 4);
  gl.readPixels(0, 0, columns, rows, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  let text = "";
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(text);
};
</script>"""


@contextmanager
def opened(glb: Path) -> Iterator:
    """A function (rows, columns, pixel, direction) that gives (rows, columns, 4) uint8, sRGB and 0 beside the mesh: the
    file from the front, the side of a pixel in its unit, under one distant lamp under which a white that faces it is 1,
    without tone mapping."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder:
        web = Path(folder)
        shutil.copy(glb, web / "model.glb")
        (web / "three").symlink_to(THREE)
        (web / "index.html").write_text(PAGE, encoding="utf-8")
        with viewer_pages.served(web) as address, sync_playwright() as tool:
            browser = tool.chromium.launch(executable_path=viewer_pages.CHROMIUM, args=viewer_pages.FLAGS)
            page = browser.new_page()
            problems = []
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.goto(f"{address}/index.html")
            page.wait_for_function("() => Boolean(globalThis.draw)", timeout=60_000)

            def draw(rows: int, columns: int, pixel: float, direction) -> np.ndarray:
                text = page.evaluate("draw", [rows, columns, pixel, [float(v) for v in direction]])
                values = np.frombuffer(base64.b64decode(text), np.uint8).reshape(rows, columns, 4)
                return values[::-1]

            yield draw
            assert not problems
            browser.close()
