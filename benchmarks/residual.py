"""The coded residual against its baselines, on a turntable capture.

    python benchmarks/residual.py --data CAPTURE               a capture folder, or one that `convert` recognises
    python benchmarks/residual.py --data results/dino/current  artifacts of a run, as they are

One JSON object a line: {object, domain, method, kept, bytes, bits_per_texel, bits_per_pixel, psnr_db, encode_s,
decode_s}. domain "texels": the paper's counting, coefficients kept of all samples or of the visible ones, nothing
quantised; domain "pictures": rendered views against photographs inside the silhouette, with the bytes of all that
a renderer needs (mesh, charts, cameras, parameters too), beside JPEG, JPEG 2000, JPEG XL, AVIF view by view and two
video codecs over the views. The last lines give the default's gain over each other method at equal bytes.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(PROJECT / "scripts"), str(Path(__file__).parent), str(PROJECT / "tests")]
import _project  # noqa: E402, F401

NEEDED = ("ingest", "cameras", "mesh", "texels", "object_brdf")


def artifacts_of(data: Path, work: Path) -> dict:
    """Upstream artifacts: those of a run, or of one that is made now."""
    from nishiki.artifacts.artifact import open_artifact

    current = data if (data / "texels").exists() else run_upstream(data, work)
    names = (*NEEDED, *(("polarise",) if (current / "polarise").exists() else ()))
    return {name: open_artifact((current / name).resolve()) for name in names}


def run_upstream(data: Path, work: Path) -> Path:
    """Convert where needed, and run everything up to the reflection parameters, with no view left out."""
    capture = data
    if not any((data / place).is_file() for place in ("capture.yaml", "data/capture.yaml")):
        capture = work / "capture"
        nishiki("convert", str(data.resolve()), str(capture), cwd=work)
    if not (capture / "bagit.txt").is_file():
        raise SystemExit(f"{capture} is not sealed: ./nishiki seal {capture}")
    (work / "scenes.tsv").write_text(f"scene\tcapture\nobject\t{capture.resolve()}\n")
    (work / "config.yaml").write_text("scenes: scenes.tsv\nproducts: [object_brdf]\nhold_out: none\n")
    nishiki("run", "--configfile", "config.yaml", cwd=work)
    return work / "results/object/current"


def nishiki(*arguments: str, cwd: Path) -> None:
    """The command line in a folder; ends with its message where it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "nishiki", *arguments],
        cwd=cwd,
        env={**_environment(), "PYTHONPATH": str(PROJECT / "workflow/src")},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(done.stdout[-4000:] + done.stderr[-4000:])


def _environment() -> dict:
    import os

    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def texel_rows(inputs: dict, every: int) -> Iterator[dict]:
    """Rows of the texel domain."""
    from residual_texels import curves

    from nishiki.atlas.store import Texels
    from nishiki.brdf.texels.model import CaptureLamps
    from nishiki.brdf.texels.parameters import ParameterMaps

    lighting = json.loads(inputs["object_brdf"].path("object_brdf.json").read_text())["lighting"]
    folder = inputs["object_brdf"].folder
    yield from curves(
        Texels(inputs["texels"].folder), ParameterMaps(folder), CaptureLamps.from_dict(lighting), every=every
    )


def picture_rows(inputs: dict, work: Path, asked, codecs: bool) -> Iterator[dict]:
    """Rows of the picture domain, and the gains at equal bytes."""
    from residual_pictures import codec_rows, gains, our_rows

    rows, compared = [], None
    for line, pictures in our_rows(inputs, work, asked):
        compared = pictures
        rows.append(line)
        yield line
    if codecs and compared is not None:
        for line in codec_rows(compared):
            rows.append(line)
            yield line
        yield from gains(rows)


def main() -> None:
    """Parse, run, print."""
    from residual_pictures import VARIANTS, Asked

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="capture, photographs, or results/SCENE/current")
    parser.add_argument("--object", default="", help="name in the lines (default: of the folder)")
    parser.add_argument(
        "--bits", type=float, nargs="*", default=[0.15, 0.3, 0.55], help="bits a pixel of residual and parameters"
    )
    parser.add_argument("--methods", nargs="*", choices=tuple(VARIANTS), default=tuple(VARIANTS))
    parser.add_argument("--domain", choices=("both", "texels", "pictures"), default="both")
    parser.add_argument("--work", type=Path, help="keep the coded objects in this folder")
    parser.add_argument("--no-codecs", action="store_true", help="only this system's own variants")
    parser.add_argument("--every", type=int, default=1, help="domain texels: of so many patches one")
    options = parser.parse_args()
    asked = Asked(tuple(options.methods), tuple(options.bits))
    name = options.object or options.data.resolve().name
    with tempfile.TemporaryDirectory() as folder:
        work = options.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        inputs = artifacts_of(options.data, work)
        lines = []
        if options.domain != "pictures":
            lines.append(texel_rows(inputs, options.every))
        if options.domain != "texels":
            lines.append(picture_rows(inputs, work, asked, not options.no_codecs))
        for part in lines:
            for line in part:
                print(json.dumps({"object": name, **line}), flush=True)


if __name__ == "__main__":
    main()
