"""An exported glTF or USD file drawn by Blender's Cycles, linear and under one lamp at a time.

`pictures` starts another Python for it, because Blender's module bpy brings its own NumPy: that Python runs this file.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

PLACE = "NISHIKI_BPY"
"""Environment variable that names the folder where bpy is installed (pip install --target FOLDER bpy)."""
UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From the axes of the file, y up, to those of Blender, z up."""


def missing() -> str | None:
    """Why Blender cannot be asked here; None where it can."""
    folder = os.environ.get(PLACE)
    if folder is None:
        return f"{PLACE} does not name a folder with Blender's module (pip install --target FOLDER bpy)"
    return None if (Path(folder) / "bpy").is_dir() else f"{PLACE}: there is no bpy in {folder}"


def above(rows: int, columns: int, pixel: float) -> dict:
    """The camera that sees a plane of rows and columns of pixels, of this side in metres, along its normal."""
    place = np.eye(4)
    place[2, 3] = 1.0
    return {"rows": rows, "columns": columns, "width": columns * pixel, "place": place.tolist()}


def pinhole(camera, metres: float) -> dict:
    """A camera of ours, without lens distortion; metres: of a unit of its world."""
    place = np.eye(4)
    place[:3, :3] = camera.rotation.T * [1, -1, -1]
    place[:3, 3] = camera.centre * metres
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics
    return {
        "rows": camera.rows,
        "columns": camera.columns,
        "focal": [fx, fy],
        "middle": [cx, cy],
        "place": place.tolist(),
    }


def pictures(file: Path, camera: dict, lamps: Sequence[dict], *, flat: bool = False) -> np.ndarray:
    """(lamps, rows, columns, 4) float32: linear light, 1 is a white that faces the lamp, and coverage; direct light.

    lamps : {"direction": (3,)}, distant, under which a white that faces it is 1; or {"position": (3,), "reference": r},
    under which it is 1 at the distance r; metres in the file's axes. flat : the mesh is pressed into the plane z = 0.
    """
    with tempfile.TemporaryDirectory() as scratch:
        request, made = Path(scratch) / "request.json", Path(scratch) / "pictures.npy"
        lamps = [{name: np.asarray(value, float).tolist() for name, value in lamp.items()} for lamp in lamps]
        asked = {"file": str(file), "camera": camera, "lamps": lamps, "flat": flat, "output": str(made)}
        request.write_text(json.dumps(asked))
        environment = {**os.environ, "PYTHONPATH": os.environ[PLACE]}
        command = [sys.executable, __file__, str(request)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode or not made.is_file():
            raise RuntimeError(f"Blender, exit status {done.returncode}: {done.stdout[-2000:]}{done.stderr[-4000:]}")
        return np.load(made)


def version() -> str:
    """Of Blender."""
    code = "import bpy; print('Blender', bpy.app.version_string)"
    environment = {**os.environ, "PYTHONPATH": os.environ[PLACE]}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip().splitlines()[-1]


def _imported(bpy, file: str, *, flat: bool) -> None:
    """An empty scene with the file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if file.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=file)
    else:
        bpy.ops.wm.usd_import(filepath=file)
    if flat:
        for shape in (each for each in bpy.data.objects if each.type == "MESH"):
            mesh, to_world = shape.data, np.array(shape.matrix_world)
            places = np.empty(3 * len(mesh.vertices), np.float32)
            mesh.vertices.foreach_get("co", places)
            world = places.reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
            world[:, 1] = 0
            level = (world - to_world[:3, 3]) @ np.linalg.inv(to_world[:3, :3]).T
            mesh.vertices.foreach_set("co", np.ascontiguousarray(level, np.float32).ravel())
            if "custom_normal" in mesh.attributes:
                mesh.attributes.remove(mesh.attributes["custom_normal"])
            mesh.update()


def _to_blender(place: Sequence) -> np.ndarray:
    """A matrix (4, 4) of the file's axes in Blender's."""
    matrix = np.eye(4)
    matrix[:3, :3] = UP
    return matrix @ np.array(place)


def _camera(bpy, asked: dict) -> None:
    import mathutils

    settings, data = bpy.context.scene.render, bpy.data.cameras.new("camera")
    rows, columns = asked["rows"], asked["columns"]
    settings.resolution_x, settings.resolution_y, settings.resolution_percentage = columns, rows, 100
    data.sensor_fit, data.clip_start, data.clip_end = "HORIZONTAL", 1e-3, 1e3
    if "width" in asked:
        data.type, data.ortho_scale = "ORTHO", asked["width"]
    else:
        (fx, fy), (cx, cy) = asked["focal"], asked["middle"]
        data.sensor_width = 36
        data.lens = fx * 36 / columns
        if abs(fx / fy - 1) > 1e-4:
            raise ValueError(f"expected square pixels, found focal lengths {fx} and {fy}")
        data.shift_x, data.shift_y = ((columns - 1) / 2 - cx) / columns, (cy - (rows - 1) / 2) / columns
    shape = bpy.data.objects.new("camera", data)
    shape.matrix_world = mathutils.Matrix(_to_blender(asked["place"]).tolist())
    bpy.context.scene.collection.objects.link(shape)
    bpy.context.scene.camera = shape


def _lamp(bpy, asked: dict):
    import mathutils

    if "direction" in asked:
        data = bpy.data.lights.new("lamp", "SUN")
        data.energy, data.angle = np.pi, 0
    else:
        data = bpy.data.lights.new("lamp", "POINT")
        data.energy, data.shadow_soft_size = 4 * np.pi**2 * asked["reference"] ** 2, 0
    shape = bpy.data.objects.new("lamp", data)
    if "direction" in asked:
        towards = mathutils.Vector((UP @ asked["direction"]).tolist())
        shape.rotation_mode, shape.rotation_quaternion = "QUATERNION", towards.to_track_quat("Z", "Y")
    else:
        shape.location = (UP @ asked["position"]).tolist()
    bpy.context.scene.collection.objects.link(shape)
    return shape


def _drawn(bpy, request: dict) -> np.ndarray:
    _imported(bpy, request["file"], flat=request["flat"])
    scene = bpy.context.scene
    scene.world = None  # a new one would be grey
    scene.render.engine, scene.render.film_transparent = "CYCLES", True
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.max_bounces = "CPU", 1, 0
    cycles.use_denoising = cycles.use_adaptive_sampling = False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 0.01
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode, scene.render.image_settings.color_depth = "RGBA", "32"
    _camera(bpy, request["camera"])
    made = []
    for number, lamp in enumerate(request["lamps"]):
        shape = _lamp(bpy, lamp)
        path = f"{request['output']}-{number}.exr"
        scene.render.filepath = path
        bpy.ops.render.render(write_still=True)
        picture = bpy.data.images.load(path)
        columns, rows = picture.size
        values = np.empty(rows * columns * 4, np.float32)
        picture.pixels.foreach_get(values)
        made.append(values.reshape(rows, columns, 4)[::-1])
        bpy.data.objects.remove(shape)
    return np.stack(made)


if __name__ == "__main__":
    import bpy

    with open(sys.argv[1], encoding="utf-8") as told:
        asked_for = json.load(told)
    np.save(asked_for["output"], _drawn(bpy, asked_for))
