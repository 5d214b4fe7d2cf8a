"""Processor time and peak memory of the export of a large painting in one format.

    python benchmarks/export_memory.py mitsuba gltf --rows 800 3200

The painting of the tests (`tests/small_painting.py`), made larger: 1500 columns, six lights of the fit and three that
no fit saw. Kernels must be compiled before; painting and export are made in processes of their own. One JSON line a
format and size.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import small_painting

import _project  # noqa: F401
from nishiki.artifacts.artifact import Artifact
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.painting import run

COLUMNS, FITTED, BAND_ROWS = 1500, 6, 64


def made_painting(folder: Path, rows: int) -> dict[str, Artifact]:
    """What the export reads."""
    small_painting.ROWS, small_painting.COLUMNS, small_painting.BAND_ROWS = rows, COLUMNS, BAND_ROWS
    dome = small_painting.dome
    small_painting.dome = lambda count, seed: dome(FITTED if count > FITTED else count, seed)
    return small_painting.small_painting(folder).inputs


def exported(inputs: dict[str, Artifact], folder: Path, form: str) -> dict:
    """Figures of one export."""
    painting = SimpleNamespace(inputs=inputs)
    start = time.process_time()
    context = small_painting.export_context(painting, folder, ExportSettings(formats=(form,)))
    with context.output:
        kinds = run(context)["losses"][form].get("kinds")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    return {"cpu_s": round(time.process_time() - start, 2), "peak_mb": round(peak), "kinds": kinds}


def alone(work, *arguments):
    """What a function returns, run in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="+", help="of the stage export")
    parser.add_argument("--rows", nargs="+", type=int, default=[800, 3200])
    options = parser.parse_args()
    for rows in options.rows:
        with tempfile.TemporaryDirectory() as folder:
            inputs = alone(made_painting, Path(folder), rows)
            for form in options.formats:
                figures = alone(exported, inputs, Path(folder) / form, form)
                print(json.dumps({"format": form, "rows": rows, **figures}), flush=True)


if __name__ == "__main__":
    main()
