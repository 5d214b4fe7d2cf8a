"""Simulate the capture of a painting, of sphere caps, of a jar on a turntable, of a cloth: photographs and the truth.

    ./nishiki simulate --output captures/painting --truth captures/painting-truth
    ./nishiki simulate --output captures/small --truth captures/small-truth --preset tiny
    ./nishiki simulate --output captures/tray --truth captures/tray-truth --scene spheres --gloss satin --seed 7
    ./nishiki simulate --output captures/jar --truth captures/jar-truth --preset object
    ./nishiki simulate --output captures/satin --truth captures/satin-truth --preset satin

The capture folder is what a studio would hand over: photographs of the object and of a white board under each lamp,
dark frames, and tables of the lamps, of the camera's sensitivities and of the lamp's spectrum. The truth folder holds
what no studio knows: normals, height, spectra, roughness, shadows, and noise-free colours under the check lights. A
turntable capture holds two pictures a view (circular polarisers not crossed and crossed), camera matrices and a scan;
that of a cloth small photographs from a gonioreflectometer.
"""

import argparse
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from nishiki.capture.seal import seal
from nishiki.errors import UserError
from nishiki.formats.files import whole_folder
from nishiki.installation import COMMAND
from nishiki.simulate.capture import ProgressLine
from nishiki.simulate.cloth.settings import DYES, FILAMENTS
from nishiki.simulate.cloth.settings import PRESETS as CLOTHS
from nishiki.simulate.painting.settings import BODIES, RELIEFS, ROUGHNESS, SCENES
from nishiki.simulate.painting.settings import PRESETS as PAINTINGS
from nishiki.simulate.turntable.shape import PRESETS as OBJECTS

CHAINS: dict[str, Mapping[str, Any]] = {"painting": PAINTINGS, "turntable": OBJECTS, "cloth": CLOTHS}
"""Presets of each kind of capture, by the folder that simulates it."""
_FINISHES = ", ".join(f"{name} {alpha:g}" for name, alpha in ROUGHNESS.items())
_NUMBER, _COUNT, _FLAG = {"type": float}, {"type": int}, {"action": "store_true"}
GROUPS = {"object": ("painting",), "lamps": ("painting",), "turntable": ("turntable",), "cloth": ("cloth",)}
KNOWN_BY = {
    "pitch-mm": ("painting", "cloth"),
    "supersampling": ("painting", "turntable"),
    "no-bounce": tuple(CHAINS),
    "lights-as": ("painting", "turntable"),
    "channels": ("painting",),
}
"""Kinds of capture with the options of a group, and single options that differ from their group; others: all."""
OPTIONS = {  # name, help, settings of argparse
    "size": (
        (
            "preset",
            "painting 384×512 (default), tiny 64×96, large 1536×2048, full 3000×4000; on a turntable: object "
            "36 views of 384×384, object-tiny 12 of 96×96, object-large 36 of 3000×4000; cloths: satin, twill, plain "
            "5940 photographs of 48×48, satin-tiny 176 of 24×24",
            {"choices": (*PAINTINGS, *OBJECTS, *CLOTHS), "default": "painting"},
        ),
        ("rows", "camera pixels, instead of the preset's", _COUNT),
        ("columns", "camera pixels, instead of the preset's", _COUNT),
        ("pitch-mm", "size of a camera pixel on the object (0.2; cloths 0.25)", _NUMBER),
        ("supersampling", "points per pixel in each direction (2; object 4)", _COUNT),
    ),
    "object": (
        ("scene", "what is photographed (painting)", {"choices": SCENES, "default": "painting"}),
        ("relief", "flat, thin paint on canvas, or thick paint (impasto)", {"choices": RELIEFS, "default": "impasto"}),
        ("relief-gain", "all heights times this (1)", {**_NUMBER, "default": 1.0}),
        ("gloss", f"finish, by GGX roughness: {_FINISHES} (varnish)", {"choices": ROUGHNESS, "default": "varnish"}),
        ("roughness", "GGX roughness instead of the finish's, 0.02 to 1", _NUMBER),
        (
            "body",
            "rough: Oren-Nayar under a refracting surface; lambert: ideal (rough)",
            {"choices": BODIES, "default": "rough"},
        ),
        ("no-bounce", "leave out light reflected from one part of the relief to another", _FLAG),
    ),
    "lamps": (
        ("rings", "rings of lamps; one stands at 45°, more at 30° to 60° (1)", {**_COUNT, "default": 1}),
        ("ring-lights", "lamps in a ring (8)", {**_COUNT, "default": 8}),
        ("no-top", "no lamp beside the camera", _FLAG),
        (
            "checks",
            "incidence of the lamps that are kept for evaluation (20 30 50 60); none: no values",
            {**_NUMBER, "nargs": "*", "default": [20.0, 30.0, 50.0, 60.0], "metavar": "DEGREES"},
        ),
        ("distance-mm", "distance from the lamp to the centre of the object (80 half diagonals)", _NUMBER),
        (
            "lights-as",
            "what the capture states of the lamps (direction; on a turntable position, or camera: beside the camera)",
            {"choices": ("direction", "position", "camera")},
        ),
        ("lamp-diameter-deg", "size of the lamp seen from the object (1.5)", {**_NUMBER, "default": 1.5}),
    ),
    "camera": (
        ("channels", "3 = red, green, blue; up to 8 bands (3)", {**_COUNT, "default": 3}),
        ("bits", "bits of the converter (12)", {**_COUNT, "default": 12}),
        (
            "white-level",
            "share of full scale of a white facing the lamp; more saturates more highlights (0.7; object 0.5)",
            _NUMBER,
        ),
        ("no-noise", "quantised, but without shot and read noise", _FLAG),
        ("format", "format of the photographs (png for 3 channels, tiff for more)", {"choices": ("png", "tiff")}),
    ),
    "turntable": (
        ("views", "views over a full turn, instead of the preset's", _COUNT),
        (
            "polariser",
            "circular: two pictures a view (default)",
            {"choices": ("circular", "none"), "default": "circular"},
        ),
        (
            "silhouettes",
            "outlines of every view in the capture: given (default) or none",
            {"choices": ("given", "none"), "default": "given"},
        ),
        ("mesh", "mesh in the capture: a scan (default) or none", {"choices": ("scan", "none"), "default": "scan"}),
        ("mesh-noise-mm", "noise of the scan along the normal (0.02)", _NUMBER),
        ("triangles", "triangles of the object, instead of the preset's", _COUNT),
        ("scan-triangles", "triangles of the scan (default: those of the object)", _COUNT),
    ),
    "cloth": (
        ("harness", "yarns of a repeat (satin 5: 5 and 7 to 10 or 12; twill 4)", _COUNT),
        ("flatness", "exponent of the warp's section, 2 = ellipse (satin about 2.6)", _NUMBER),
        ("arch-deg", "steepest slope of the arch of a float (satin 8)", _NUMBER),
        ("filaments", "roughness along and across them (silk)", {"choices": FILAMENTS}),
        ("dye", "dye of the first cloth (black)", {"choices": DYES}),
        (
            "two-cloths",
            "add a second cloth beside the first, weft on top, dyed gold, with a picture of the regions",
            _FLAG,
        ),
    ),
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command, and return its exit status."""
    commands = parser()
    options = commands.parse_args(arguments)
    try:
        kind = next(name for name, presets in CHAINS.items() if options.preset in presets)
        for group, name in ((group, name) for group, rows in OPTIONS.items() for name, *_ in rows):
            kinds, attribute = KNOWN_BY.get(name, GROUPS.get(group, tuple(CHAINS))), name.replace("-", "_")
            if kind not in kinds and getattr(options, attribute) != commands.get_default(attribute):
                presets = ", ".join(preset for known in kinds for preset in CHAINS[known])
                raise UserError(f"--{name} belongs to {presets}, found with --preset {options.preset}; leave it out")
        if options.format is None:
            options.format = "png" if options.channels == 3 else "tiff"
        if options.format == "png" and options.channels != 3:
            raise UserError(f"--format png holds 3 channels, found {options.channels}; use --format tiff")
        simulate(import_module(f"nishiki.simulate.{kind}.photographs"), options)
    except UserError as error:
        print(f"nishiki simulate: {error}", file=sys.stderr)
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    """Build the parser of the command line."""
    style = argparse.RawDescriptionHelpFormatter
    text = argparse.ArgumentParser(prog=f"{COMMAND} simulate", description=__doc__, formatter_class=style)
    text.add_argument("--output", required=True, metavar="FOLDER", help="capture folder to make; must not exist yet")
    text.add_argument("--truth", required=True, metavar="FOLDER", help="folder for the truth; must not exist yet")
    text.add_argument("--seed", type=int, default=1, help="another seed: another object, lamps, noise (default 1)")
    for title, rows in OPTIONS.items():
        group = text.add_argument_group(title)
        for name, help_text, extra in rows:
            group.add_argument(f"--{name}", help=help_text, **extra)
    return text


def simulate(kind, options: argparse.Namespace) -> None:
    """Make both folders under temporary names, then rename them: a killed run leaves no half capture."""
    output, truth = Path(options.output), Path(options.truth)
    settings = kind.settings_from(options)
    for folder in (output, truth):
        if folder.exists() or folder.is_symlink():
            raise UserError(f"{folder}: expected no such folder yet, found one; remove it or choose another name")
    if truth.resolve().is_relative_to(output.resolve()):
        raise UserError(f"{truth}: the truth must lie outside the capture {output}; choose another folder")
    report = ProgressLine()
    with whole_folder(output) as capture, whole_folder(truth) as known:
        for draft in (capture, known):
            draft.mkdir(parents=True)
        kind.write_all(settings, capture, known, options, report)
        seal(capture)
    report("capture and truth written", end="\n")
