"""Make a painting with two regions of gloss: one simulated painting, varnished in part of the picture and matte beside.

    .venv/bin/python benchmarks/gloss_regions.py captures/two-glosses

Both finishes are simulated with the same seed, so that paints, relief, lamps and white boards are the same; each
photograph is put together from both along the border of a wavy region map, which the capture names as its regions.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.simulate.command import main as simulate

GLOSSES = ("varnish", "matte")


def region_map(rows: int, columns: int) -> np.ndarray:
    """(rows, columns) uint8: 1 in two thirds of the picture, with islands and a wavy border."""
    y, x = np.mgrid[:rows, :columns] / columns
    waves = np.sin(9 * x + 2 * np.sin(7 * y)) + np.sin(11 * y + 3 * np.sin(5 * x))
    return (waves > -0.45).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="capture folder to make")
    parser.add_argument("--preset", default="painting")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folders = []
        for gloss in GLOSSES:
            folder = Path(scratch) / gloss
            arguments = ["--output", str(folder), "--truth", f"{folder}-truth", "--gloss", gloss]
            if simulate([*arguments, "--preset", options.preset]):
                sys.exit(f"{gloss}: simulation failed")
            folders.append(folder / "data" if (folder / "data").is_dir() else folder)
        first, second = folders
        for source in sorted(path for path in first.rglob("*") if path.is_file()):
            name = source.relative_to(first)
            target = options.output / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if name.parts[0] != "frames":
                target.write_bytes(source.read_bytes())
                continue
            one, other = (cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for folder in (first, second))
            labels = region_map(*one.shape[:2])
            cv2.imwrite(str(target), np.where(labels[..., None] == 1, one, other))
        cv2.imwrite(str(options.output / "regions.png"), labels)
        settings = yaml.safe_load((options.output / "capture.yaml").read_text())
        settings.update(regions="regions.png", title="Simulated painting, varnished in part")
        (options.output / "capture.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))


if __name__ == "__main__":
    main()
