"""Relightable images of our export beside those by relight's method, decoded again, at equal planes and JPEG quality.

    python benchmarks/relightable.py --data FOLDER_OF_MEASURED_DATA
    python benchmarks/relightable.py --data FOLDER --only painting diligent_cat --quality 80 95
    python benchmarks/relightable.py --data FOLDER --kept-back          scenes that no choice was made on

Every scene is run up to the export; some of its lights are held out. The photographs, sRGB-coded relative to a white
that faces the lamp, are fitted under the other lights: by the stage export (`bilinear` with what the fitted model
draws), and as 8-bit pictures by relight's method (tests/relight_planes.py: its arithmetic in NumPy, not its
program). Both go through JPEG without subsampled colours and are decoded, clipped and rounded to 8 bits. One JSON line
a scene and set of planes:

    fitted_db, unseen_db    PSNR (peak 1) under the lights of the fit and under those left out, over the object (a
                            painting: the whole frame) where the photograph is neither saturated nor black in all
                            colours; `*_all_db` over all its pixels; `left_out`: the share between the two
    openlime_unseen_db      of rbf: the same where the viewer takes Gaussians as OpenLIME 1.2 does
    kb                      planes and, where there is one, the table of components in info.json
    cpu_s                   processor time from coded photographs to JPEG files
    kb_ratio, cpu_ratio     relative to our planes of the same kind and number

`gltf` is what the scene's own reflection model gains in the export's glTF file, by the export's own figures.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from relighting import PROJECT, capture_of, nishiki

sys.path.insert(0, str(PROJECT / "tests"))

import relight_planes as relight

from nishiki.artifacts.artifact import open_artifact
from nishiki.formats.banded_pictures import jpeg_bytes
from nishiki.observations.plane import Observations
from nishiki.stages.export.light_models import PrincipalModel, TabulatedModel
from nishiki.stages.export.relight import SAMPLES, StoredModel, model_of
from nishiki.stages.export.scene import CodedPhotographs, ExportedScene, GridPictures

SCENES = ("painting", "diligent_cat", "diligent_cat-12", "rti_fossil")
KEPT_BACK = ("diligent_ball", "diligent_ball-12", "rti_marble", "uw_owl", "uw_horse")
PLANES = (9, 18, 27)  # of components: relight-cli's default, ours, and as many as hsh has
MYCC_BRIGHTNESS = {9: 5, 18: 8, 27: 13}
HOLD_EVERY = 8
GROUPS = {"fitted": "fitted", "unseen": "check"}
"""Lights by our words and by those of the export's diagnostics."""


@dataclass(frozen=True)
class Scene:
    """values : (pixels, lights, 3) coded photographs, pixels row by row; valid : (pixels, lights); mask : (pixels,)."""

    shape: tuple[int, int]
    directions: np.ndarray
    values: np.ndarray
    valid: np.ndarray
    mask: np.ndarray
    fitted: np.ndarray
    unseen: np.ndarray
    photographs: CodedPhotographs
    drawn: GridPictures
    gltf: dict


@dataclass(frozen=True)
class Made:
    """Planes as both sides have them. shown : transfers of viewers, the first the one that the planes are made for."""

    kind: str
    colour_space: str
    codes: np.ndarray
    decode: Callable[[np.ndarray], np.ndarray]
    shown: tuple[Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], ...]
    table: list[int]


def scene_of(data: Path, folder: Path, name: str) -> Scene:
    """Run a scene up to the export of glTF and read its photographs."""
    if name == "painting":
        capture = folder / "captures/painting"
        if not capture.exists():
            nishiki(folder, "simulate", "--output", str(capture), "--truth", str(folder / "captures/painting-truth"))
    else:
        capture = capture_of(data, folder, name)
    table = (capture / "data/frames.csv").read_text().splitlines()
    columns = table[0].split(",")
    rows = [dict(zip(columns, line.split(","), strict=False)) for line in table[1:]]
    kept = any(row["role"] == "check" for row in rows)
    lights = list(dict.fromkeys(row["light"] for row in rows if row["role"] == "sample"))
    held_out = [] if kept else lights[:: HOLD_EVERY if len(lights) > 16 else 5]
    work = folder / f"run-{name}"
    if not work.exists():
        work.mkdir()
        (work / "scenes.tsv").write_text(f"scene\tcapture\ttruth\none\t{capture}\t\n")
        settings = {"scenes": "scenes.tsv", "products": ["export"], "hold_out": held_out}
        settings["export"] = {"formats": ["gltf"]}
        (work / "config.yaml").write_text(yaml.safe_dump(settings))
        nishiki(work, "run", "--configfile", "config.yaml", "--cores", "1")
    current = work / "results/one/current"
    stages = [stage for stage in ("ingest", "normals", "height", "spectra", "brdf") if (current / stage).is_dir()]
    exported = ExportedScene({stage: open_artifact(current / stage) for stage in stages})
    frames = Observations(current / "ingest")
    photographs = CodedPhotographs(frames, exported)
    fitted, unseen = frames.fit_lights(held_out), frames.check_lights(held_out)
    every = np.arange(len(frames.lights))
    strips = [strip for band in frames.bands() for strip in photographs.strips(band, every)]
    diagnostics = json.loads((current / "export/artifact.json").read_text())["diagnostics"]
    return Scene(
        frames.shape,
        frames.directions,
        np.concatenate([values.transpose(2, 0, 1) for _, values, _ in strips]),
        np.concatenate([valid.T for _, _, valid in strips]),
        frames.mask.ravel(),
        fitted,
        unseen,
        photographs,
        GridPictures(frames, exported, fitted),
        diagnostics["losses"]["gltf"]["kinds"]["gltf"]["psnr_db"],
    )


class OpenLimeModel(PrincipalModel):
    """rbf as OpenLIME 1.2 shows it: `width` is not looked at, the Gaussians are as wide as the lights are far apart."""

    def weights(self, light: np.ndarray) -> np.ndarray:
        """Return exp(-8 d^2 / m) of distances d, with m their mean weighted by exp(-2 d); sum 1."""
        distances = np.linalg.norm(self.lights - light, axis=1)
        near = np.exp(-2 * distances)
        mean = distances @ near / near.sum()
        weights = np.exp(-8 * distances**2 / max(mean, 1e-9))
        return weights / weights.sum()


def ours(scene: Scene, kind: str, planes: int) -> Made:
    """By the stage export."""
    seen = scene.photographs
    values, valid = scene.values[:, scene.fitted].transpose(1, 2, 0), scene.valid[:, scene.fitted].T
    if kind == "bilinear":
        seen = scene.drawn
        strips = [strip for band in seen.frames.bands() for strip in seen.strips(band, scene.fitted)]
        values, valid = (np.concatenate([strip[place] for strip in strips], axis=-1) for place in (1, 2))
    samples = seen.samples(scene.fitted, SAMPLES)
    model = model_of(kind, scene.directions[scene.fitted], *samples, planes=planes)
    stored = StoredModel.of(model, scene.directions[scene.fitted], *samples)
    codes = stored.codes(model.fit(values, valid)).T
    shown, table = [model.transfer], []
    if isinstance(model, PrincipalModel):
        shown.append(OpenLimeModel(**vars(model)).transfer)
    if isinstance(model, TabulatedModel):
        table = np.concatenate([model.mean_code[None], model.codes]).ravel().tolist()
    return Made(
        kind, model.colour_space, codes, lambda codes: (codes / 255 - stored.bias) * stored.scale, tuple(shown), table
    )


def theirs(scene: Scene, kind: str, planes: int, brightness: int | None = None) -> Made:
    """By relight's method."""
    codes = np.rint(255 * scene.values[:, scene.fitted]).astype(np.uint8)
    lights = scene.directions[scene.fitted]
    if kind in ("ptm", "hsh"):
        made = relight.terms_planes(kind, codes, scene.shape, lights)
    else:
        made = relight.component_planes(kind, codes, scene.shape, lights, planes, brightness)
    shown, table = [made.transfer], []
    if kind in ("rbf", "bilinear"):
        table = [127] * (len(made.components) + 1) * made.mean.size
    if kind == "rbf":
        base = OpenLimeModel(*[np.zeros(0)] * 3, lights, relight.SIGMA)
        shown.append(made.shown_with(base.weights).transfer)
    return Made(kind, made.colour_space, made.codes(), made.decoded, tuple(shown), table)


def as_jpeg(made: Made, shape: tuple[int, int], quality: int) -> list[bytes]:
    """Files of the planes, three to a picture."""
    pictures = [made.codes[:, n : n + 3].reshape(*shape, 3) for n in range(0, made.codes.shape[1], 3)]
    return [jpeg_bytes(picture, quality) for picture in pictures]


def decoded(made: Made, files: list[bytes]) -> np.ndarray:
    """(pixels, planes) coefficients."""
    pictures = [cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] for file in files]
    return made.decode(np.concatenate([picture.reshape(-1, 3) for picture in pictures], axis=1))


def decibels(scene: Scene, coefficients: np.ndarray, transfer: Callable, lights: np.ndarray) -> tuple[float, float]:
    """Over the samples that count, and over all of the object."""
    squares, counts = np.zeros(2), np.zeros(2)
    for light in lights:
        offset, weights = transfer(scene.directions[light])
        shown = np.rint(255 * np.clip(offset + coefficients @ weights, 0, 1)) / 255
        errors = ((shown - scene.values[:, light]) ** 2).sum(axis=1)
        for number, chosen in enumerate((scene.valid[:, light], scene.mask)):
            squares[number] += errors[chosen].sum()
            counts[number] += 3 * np.count_nonzero(chosen)
    every, whole = -10 * np.log10(squares / counts)
    return round(float(every), 2), round(float(whole), 2)


def tasks() -> Iterator[tuple[str, str, int, Callable[[Scene], Made]]]:
    """Side, kind, planes and what makes them; ours first."""
    for kind, planes in (("ptm", 18), ("hsh", 27)):
        yield "ours", kind, planes, lambda scene, kind=kind, planes=planes: ours(scene, kind, planes)
        yield "relight", kind, planes, lambda scene, kind=kind, planes=planes: theirs(scene, kind, planes)
    for planes in PLANES:
        for kind in ("rbf", "bilinear"):
            yield "ours", kind, planes, lambda scene, kind=kind, planes=planes: ours(scene, kind, planes)
            for brightness in (None, MYCC_BRIGHTNESS[planes]):
                arguments = (kind, planes, brightness)
                yield "relight", kind, planes, lambda scene, arguments=arguments: theirs(scene, *arguments)


def measure(data: Path, folder: Path, name: str, qualities: list[int]) -> None:
    """Print the lines of one scene."""
    scene = scene_of(data, folder, name)
    left_out = 1 - np.count_nonzero(scene.valid[scene.mask]) / scene.valid[scene.mask].size
    about = {"scene": name, "lights": [len(scene.fitted), len(scene.unseen)], "left_out": round(left_out, 4)}
    said = {
        "side": "ours",
        "kind": "gltf",
        "fitted_db": scene.gltf["fitted"]["all"],
        "unseen_db": scene.gltf["check"]["all"],
    }
    print(json.dumps({**about, **said}), flush=True)
    reference: dict[tuple[str, int, int], tuple[float, float]] = {}
    for side, kind, planes, make in tasks():
        if kind in ("rbf", "bilinear") and planes > 2 * len(scene.fitted):
            continue  # hardly fewer planes than photographs
        start = time.process_time()
        made = make(scene)
        seconds = time.process_time() - start
        for quality in qualities:
            start = time.process_time()
            files = as_jpeg(made, scene.shape, quality)
            cpu = seconds + time.process_time() - start
            size = (sum(map(len, files)) + len(json.dumps(made.table))) / 1e3
            place = (kind, planes, quality)
            if side == "ours":
                reference[place] = size, cpu
            coefficients = decoded(made, files)
            line = {**about, "side": side, "kind": kind, "space": made.colour_space, "planes": made.codes.shape[1]}
            line["quality"] = quality
            for group in GROUPS:
                figures = decibels(scene, coefficients, made.shown[0], getattr(scene, group))
                line[f"{group}_db"], line[f"{group}_all_db"] = figures
            for transfer in made.shown[1:]:
                line["openlime_unseen_db"] = decibels(scene, coefficients, transfer, scene.unseen)[0]
            line |= {"kb": round(size, 1), "cpu_s": round(cpu, 2)}
            line |= {"kb_ratio": round(size / reference[place][0], 3), "cpu_ratio": round(cpu / reference[place][1], 3)}
            print(json.dumps(line), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, type=Path, help="folder of the measured sets")
    parser.add_argument("--only", nargs="+", choices=(*SCENES, *KEPT_BACK), help="default: the scenes of development")
    parser.add_argument("--kept-back", action="store_true", help="the other scenes")
    parser.add_argument("--quality", nargs="+", type=int, default=[95], help="of JPEG")
    parser.add_argument("--work", type=Path, help="keep captures and results here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = (options.work or Path(name)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for item in options.only or (KEPT_BACK if options.kept_back else SCENES):
            measure(options.data.resolve(), folder, item, options.quality)


if __name__ == "__main__":
    main()
