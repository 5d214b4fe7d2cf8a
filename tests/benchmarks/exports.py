"""Every export of finished scenes: bytes, what is lost, processor time, memory, and what other programs' readers say.

    NODE_PATH=node_modules python tests/benchmarks/exports.py painting jar satin fossil dino [--configfile FILE]

Scenes are those of the configuration, in the folder where this is called; what they lack is made first. One JSON object
a line for each format of each scene. Readers that are not installed are named as such: gltf-validator (npm), usd-core,
MaterialX, Mitsuba, OpenImageIO, the package spectral.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import _project  # noqa: F401

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from npm_packages import gltf_problems

from nishiki.engine.project import load_yaml
from nishiki.engine.workflow import Workflow
from nishiki.stages.export.report import lost
from nishiki.stages.table import chain_of

PROJECT = Path(__file__).resolve().parents[2]


def gltf(path: Path) -> str:
    problems = gltf_problems(path)
    errors = sum(problem["severity"] == 0 for problem in problems)
    return f"gltf-validator: {errors} errors, {len(problems) - errors} warnings"


def usd(path: Path) -> str:
    validation, usd_module = (importlib.import_module(f"pxr.{name}") for name in ("UsdValidation", "Usd"))
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    found = validation.ValidationContext(validators).Validate(usd_module.Stage.Open(str(path)))
    return f"{len(validators)} validators of usd-core: {len(found)} findings"


def materialx(path: Path) -> str:
    module = importlib.import_module("MaterialX")
    document, library = module.createDocument(), module.createDocument()
    module.loadLibraries(module.getDefaultDataLibraryFolders(), module.getDefaultDataSearchPath(), library)
    module.readFromXmlFile(document, str(path))
    document.setDataLibrary(library)
    valid, message = document.validate()
    return f"MaterialX: {'valid' if valid else message}"


def mitsuba(path: Path) -> str:
    module = importlib.import_module("mitsuba")
    module.set_variant("scalar_rgb")
    scene = module.load_file(str(path))
    return f"Mitsuba loads it ({len(scene.shapes())} shapes, {len(scene.emitters())} lamps)"


def bsdf(path: Path) -> str:
    module = importlib.import_module("mitsuba")
    module.set_variant("scalar_rgb")
    module.load_dict({"type": "measured", "filename": str(path)})
    return "Mitsuba loads it"


def tiff(path: Path) -> str:
    values = importlib.import_module("tifffile").imread(path)
    return f"tifffile: {' × '.join(map(str, values.shape))}, {values.dtype}"


def exr(path: Path) -> str:
    spec = importlib.import_module("OpenImageIO").ImageInput.open(str(path)).spec()
    return f"OpenImageIO: {spec.height} × {spec.width}, {spec.nchannels} channels"


def envi(path: Path) -> str:
    picture = importlib.import_module("spectral.io.envi").open(str(path))
    return f"spectral: {' × '.join(map(str, picture.shape))}"


def ply(path: Path) -> str:
    mesh = importlib.import_module("trimesh").load(path, process=False)
    return f"trimesh: {len(mesh.vertices)} vertices"


def iiif(path: Path) -> str:
    manifest = importlib.import_module("iiif_prezi3").Manifest(**json.loads(path.read_text(encoding="utf-8")))
    return f"iiif-prezi3: {len(manifest.items)} canvases"


READERS: dict[str, Callable[[Path], str]] = {
    "*.glb": gltf,
    "*.usdz": usd,
    "*.mtlx": materialx,
    "scene.xml": mitsuba,
    "*.bsdf": bsdf,
    "*.tif": tiff,
    "*.exr": exr,
    "*.hdr": envi,
    "*.ply": ply,
    "manifest.json": iiif,
}


def read(folder: Path, files: list[str]) -> dict[str, str]:
    """What the reader of each file says, by the name of the file."""
    said = {}
    for file in map(Path, files):
        reader = next((each for pattern, each in READERS.items() if file.match(pattern)), None)
        if reader is None:
            continue
        try:
            said[file.name] = reader(folder / file)
        except (ImportError, pytest.skip.Exception) as missing:
            said[file.name] = f"not checked: {missing}"
    return said


def measured(scene: str, name: str, configfile: str) -> dict:
    """One export, made by the command."""
    command = [sys.executable, "-m", "nishiki", "export", scene, name, "--configfile", configfile]
    environment = {**os.environ, "PYTHONPATH": str(PROJECT / "workflow/src")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
    flow = Workflow({**load_yaml(Path(configfile)), "exports": {scene: [name]}}, only=scene, file=configfile)
    stage = next(each for each in flow.plans[scene].stages if each.endswith("export"))
    folder = Path(flow.artifact(scene, stage)).parent
    facts = json.loads((folder / "run.json").read_text())
    diagnostics = json.loads((folder / "artifact.json").read_text())["diagnostics"]
    (losses,) = diagnostics["losses"].values()
    return {
        "scene": scene,
        "format": name,
        "mb": round(sum(diagnostics["bytes"].values()) / 1e6, 2),
        "cpu_s": round(facts["process_cpu_seconds"], 1),
        "peak_mib": round(facts["peak_memory_mib"]),
        "loses": lost(losses),
        "readers": "; ".join(f"{file}: {text}" for file, text in read(folder, losses["files"]).items()) or "–",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--formats", nargs="+", help="default: all that the scene's stage has")
    parser.add_argument("--configfile", default="config/config.yaml")
    options = parser.parse_args()
    for scene in options.scenes:
        for name in options.formats or formats_of(scene, options.configfile):
            print(json.dumps(measured(scene, name, options.configfile), ensure_ascii=False), flush=True)


def formats_of(scene: str, configfile: str) -> list[str]:
    """Formats that the scene's stage of export has, in the order of its declaration."""
    geometry = Workflow(load_yaml(Path(configfile)), only=scene, file=configfile).plans[scene].facts.geometry
    (stage,) = (each for each in chain_of(geometry).values() if each.asked_as == "export")
    (of_one, _) = get_args(stage.settings.model_fields["formats"].annotation)
    return list(get_args(of_one))


if __name__ == "__main__":
    main()
