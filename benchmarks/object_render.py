"""Speed of decoding and rendering an object, a JSON object a line.

    python benchmarks/object_render.py --data FOLDER

FOLDER holds results of the object chain (artifacts of the stages up to residual, anywhere below), or captures of
turntables (folders with a capture.yaml), which are then taken through the chain with default settings first.

One line a case: {object, case, default, pictures, pixels, tiles, seconds, megapixels_per_s, decode_s, threads}.
`cold`: one view, nothing decoded before; `view`: the same again, its tiles in memory; `turn`: all captured views;
`between`: a view half-way, whose residual is that of two, with their depth maps at hand; `model`: no residual;
`preview`: the coarse part of the residual alone.  pixels: those that show the object.  decode_s: the residual of the
tiles that the case shows, on one thread, by itself.  Compiled code is warm; seconds is the shortest of several runs.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project
from nishiki.artifacts.artifact import open_artifact
from nishiki.geometry.visibility import rasterise
from nishiki.render.object.renderer import DecodedObject

STAGES = ("cameras", "mesh", "texels", "object_brdf", "residual")


def results(folder):
    """Inputs by stage for every residual artifact below the folder: each with those that it was made from."""
    artifacts = [open_artifact(path) for path in sorted(folder.rglob("artifact.json"))]
    by_key = {(item.stage, item.key): item for item in artifacts}
    for residual in (item for item in artifacts if item.stage == "residual"):
        found = {"residual": residual}
        waiting = [residual]
        while waiting:
            for stage, upstream in waiting.pop().manifest["upstream"].items():
                item = by_key.get((stage, upstream.get("key")))
                if item is not None and stage not in found:
                    found[stage] = item
                    waiting.append(item)
        if set(STAGES) <= set(found):
            yield residual.manifest["scene"], found


def run_chain(capture, output):
    """The stages from a capture to the residual, with default settings, as a user would run them by hand."""
    made = {}

    def stage(name, inputs, *more):
        folders = [str(made[item]) for item in inputs if item in made]
        command = [sys.executable, str(_project.PROJECT / "scripts/stage.py"), name, "--scene", capture.name]
        command += ["--output", str(output / name), *(["--inputs", *folders] if folders else []), *more]
        subprocess.run(command, check=True)
        made[name] = next((output / name).glob("*/artifact.json")).parent

    stage("ingest", (), "--capture", str(capture))
    from nishiki.observations.views import Views

    if len(Views(made["ingest"]).states) > 1:
        stage("polarise", ("ingest",))
    stage("cameras", ("ingest",))
    stage("mesh", ("ingest", "cameras"))
    stage("texels", ("ingest", "polarise", "cameras", "mesh"))
    stage("object_brdf", ("ingest", "cameras", "mesh", "texels"))
    stage("residual", ("cameras", "mesh", "texels", "object_brdf"))


def shortest(work, *, repeat):
    """Seconds of the fastest of several runs, and the last result."""
    best = np.inf
    for _ in range(repeat):
        clock = time.perf_counter()
        value = work()
        best = min(best, time.perf_counter() - clock)
    return best, value


def tiles_of(decoded, cameras):
    """Tiles that the cameras see."""
    seen = set()
    for camera in cameras:
        raster = rasterise(decoded.mesh, camera)
        covered = raster.triangle >= 0
        tile = decoded.atlas.locate(raster.triangle[covered], raster.barycentric[covered])[0]
        seen |= set(np.unique(tile[tile >= 0]).tolist())
    return sorted(seen)


def cases(decoded, repeat):
    """(case, shots, renderer made anew for each run or None for one that has run before)."""
    count = len(decoded.cameras)

    def draw(renderer, shots):
        pixels = 0
        for picture in renderer.render(shots):
            pixels += int(np.count_nonzero(picture.covered))
        return pixels

    plain, model, preview = decoded.renderer(), decoded.renderer(model_only=True), decoded.renderer(level=2)
    one, turn = [plain.captured(0)], [plain.captured(k) for k in range(count)]
    half = [plain.between(0, 0.5)]
    draw(plain, [*one, *half])  # compiles
    yield "cold", one, *shortest(lambda: draw(decoded.renderer(), one), repeat=repeat), 0
    for name, renderer, shots in (("view", plain, one), ("turn", plain, turn), ("between", plain, half)):
        draw(renderer, shots[:1])
        yield name, shots, *shortest(lambda r=renderer, s=shots: draw(r, s), repeat=repeat), 0
    draw(model, one)
    yield "model", one, *shortest(lambda: draw(model, one), repeat=repeat), None
    yield "preview", one, *shortest(lambda: draw(decoded.renderer(level=2), one), repeat=repeat), preview.level


def lines(name, decoded, repeat):
    """The lines of one object."""
    for case, shots, seconds, pixels, level in cases(decoded, repeat):
        tiles = tiles_of(decoded, [shot.camera for shot in shots])
        filled = [tile for tile in tiles if level is not None and not decoded.residual.empty(tile)]
        clock = time.perf_counter()
        for tile in filled:
            decoded.residual.decode(tile, level=level)
        decode_s = time.perf_counter() - clock
        yield {
            "object": name,
            "case": case,
            "default": case in ("cold", "view", "turn", "between"),
            "pictures": len(shots),
            "pixels": pixels,
            "tiles": len(tiles),
            "seconds": round(seconds, 4),
            "megapixels_per_s": round(pixels / seconds / 1e6, 3),
            "decode_s": round(decode_s, 4),
            "threads": decoded.renderer().threads,
        }


def main():
    """Print the lines of every object found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="results of the object chain, or captures")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        found = list(results(options.data))
        if not found:
            captures = sorted(path.parent for path in options.data.rglob("capture.yaml"))
            for number, capture in enumerate(captures):
                run_chain(capture, Path(scratch) / str(number))
            found = list(results(Path(scratch)))
        if not found:
            parser.error(f"{options.data}: expected results of the object chain or captures, found neither")
        for name, inputs in found:
            for line in lines(name, DecodedObject.open(inputs), options.repeat):
                print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
