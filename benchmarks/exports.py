"""Every export of finished scenes: bytes, what is lost, processor time, memory, and what other programs' readers say.

    NODE_PATH=node_modules python benchmarks/exports.py --data FOLDER [--work FOLDER] [--only jar --formats gltf]
    python benchmarks/exports.py --configfile FILE --only SCENE ...

The scenes are the three of the demos, simulated, and rti_fossil and oxford_dino of the measured data; or those of a
configuration of one's own. They are made in the folder of --work, whose results are taken up again. One JSON object a
line for each format of each scene: bytes, processor seconds and memory of the export alone, and `loses`, what the
report says of it. Readers that are not installed are named as such: gltf-validator (npm), usd-core, MaterialX, Mitsuba,
OpenImageIO, the package spectral.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from economy import Runs
from npm_packages import gltf_problems

from nishiki.engine.project import load_yaml
from nishiki.engine.workflow import Workflow
from nishiki.stages.report.capture import lost
from nishiki.stages.table import chain_of

PROJECT = Path(__file__).resolve().parents[1]


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
    refused = f"{name} needs "
    if done.returncode and refused not in done.stderr:
        sys.exit(f"{' '.join(command)}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
    if done.returncode:
        why = refused + done.stderr.split(refused, 1)[1].splitlines()[0]
        return {"scene": scene, "format": name, "not_made": why}
    flow = Workflow({**load_yaml(Path(configfile)), "exports": {scene: [name]}}, only=[scene], file=configfile)
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


def five_scenes(data: Path, work: Path) -> Path:
    """Captures of the five scenes in a folder, and the configuration that names them."""
    runs = Runs(work)
    captures = {
        "painting": runs.simulate("painting"),
        "jar": runs.simulate("jar", "--preset", "object"),
        "satin": runs.simulate("satin", "--preset", "satin"),
        "fossil": runs.converted(data / "rti_fossil"),
        "dino": runs.converted(data / "oxford_dino"),
    }
    rows = ["scene\tcapture", *(f"{scene}\t{capture}" for scene, capture in captures.items())]
    (work / "scenes.tsv").write_text("\n".join(rows) + "\n")
    configuration = work / "config.yaml"
    configuration.write_text("scenes: scenes.tsv\nresults: results\n")
    return configuration


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the measured data")
    parser.add_argument("--work", type=Path, help="where the five scenes are made (default: a temporary folder)")
    parser.add_argument("--configfile", type=Path, help="in place of --data: a configuration of finished scenes")
    parser.add_argument("--only", nargs="+", metavar="SCENE", help="default: all")
    parser.add_argument("--formats", nargs="+", help="default: all that the scene's stage has")
    options = parser.parse_args()
    if (options.data is None) == (options.configfile is None):
        parser.error("either --data or --configfile is needed")
    with tempfile.TemporaryDirectory() as temporary:
        if options.data:
            work = (options.work or Path(temporary)).absolute()
            work.mkdir(parents=True, exist_ok=True)
            configuration = five_scenes(options.data.absolute(), work)
            os.chdir(work)
        else:
            configuration = options.configfile
        for scene in options.only or scene_names(configuration):
            for name in options.formats or formats_of(scene, str(configuration)):
                print(json.dumps(measured(scene, name, str(configuration)), ensure_ascii=False), flush=True)


def scene_names(configuration: Path) -> list[str]:
    """Scenes of a configuration, in the order of its table."""
    return list(Workflow(load_yaml(configuration), file=str(configuration)).plans)


def formats_of(scene: str, configfile: str) -> list[str]:
    """Formats that the scene's stage of export has, in the order of its declaration."""
    geometry = Workflow(load_yaml(Path(configfile)), only=[scene], file=configfile).plans[scene].facts.geometry
    (stage,) = (each for each in chain_of(geometry).values() if each.asked_as == "export")
    (of_one, _) = get_args(stage.settings.model_fields["formats"].annotation)
    return list(get_args(of_one))


if __name__ == "__main__":
    main()
