"""A simulated painting under a dome, the software of the camera above it, and the person who attends.

The dome releases the camera on its shutter cable; the photograph under the lamp that shines then appears in the folder
of the camera's software. Programs reach it all through a serial port, a folder and a terminal, as with a real dome.
"""

import csv
import os
import select
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import yaml

from nishiki.errors import UserError
from nishiki.simulate.rig.dome import SimulatedDome

SUBJECTS = {"white board": "white", "lens cap on": "dark", "lens cap off": "object", "object": "object"}
"""Subjects before the lens after a request that contains these words; the first match counts."""
REQUEST_ENDS = "press Enter "
"""End of every request to a person."""


class PaintingBench:
    """A dome with a camera on its shutter cable, over a painting that was photographed by hand before.

    Parameters
    ----------
    capture : Path
        Simulated capture of a painting: one lamp lights each photograph.
    folder : Path
        Folder to make: `dome` is the serial port, `camera` is where the camera's software saves.

    Attributes
    ----------
    lamps : tuple of str
        Names of the lamps, in the order of the dome.
    checks : tuple of str
        Lamps that are kept for evaluation.
    subject : {"object", "white", "dark"}
        Object before the lens: the painting, a white board in its place, or the lens cap.
    """

    def __init__(self, capture: Path, folder: Path) -> None:
        source = data_of(capture)
        with (source / "frames.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        self.photographs = {
            ("white" if row["role"] == "white" else "object", row["light"]): source / row["file"]
            for row in rows
            if row["role"] != "dark"
        }
        self.darks = [source / row["file"] for row in rows if row["role"] == "dark"]
        self.lamps = tuple(row["light"] for row in rows if row["role"] in ("sample", "check"))
        self.checks = tuple(row["light"] for row in rows if row["role"] == "check")
        self.subject = "object"
        self.darks_taken = 0
        self.saved_in = folder / "camera"
        self.saved_in.mkdir(parents=True, exist_ok=True)
        self.taken = len(list(self.saved_in.iterdir()))  # a camera goes on counting
        self.dome = SimulatedDome(folder / "dome", len(self.lamps), self.expose)

    def photograph(self, lit: set[int]) -> Path:
        """Simulate the camera: a photograph of the capture by hand."""
        if self.subject == "dark" or not lit:
            return self.darks[self.darks_taken % len(self.darks)]
        if len(lit) > 1:
            raise ValueError(f"expected one lamp that shines, found {len(lit)}: no such photograph was simulated")
        return self.photographs[self.subject, self.lamps[min(lit)]]

    def expose(self, lit: set[int]) -> None:
        """Photograph the subject before the lens; the camera's software saves it."""
        source = self.photograph(lit)
        self.darks_taken += source in self.darks
        self.taken += 1
        draft = self.saved_in / f".DSC_{self.taken:04d}{source.suffix}"
        shutil.copyfile(source, draft)
        draft.rename(draft.with_name(draft.name[1:]))

    def obey(self, request: str) -> None:
        """Put the requested subject before the lens. UserError where the request names nothing known."""
        words = [words for words in SUBJECTS if words in request]
        if not words:
            raise UserError(f"the simulated operator does not understand {request!r}")
        self.subject = SUBJECTS[words[0]]

    def close(self) -> None:
        """End the simulation."""
        self.dome.stop()


def data_of(capture: Path) -> Path:
    """Return the folder of a capture's files: `data` once it is sealed."""
    return capture / "data" if (capture / "data").is_dir() else capture


def write_rig(bench: PaintingBench, by_hand: Path, folder: Path) -> tuple[Path, Path]:
    """Write the description of the bench and a plan that takes the photographs of the capture by hand.

    Returns
    -------
    tuple of Path
        rig.yaml and plan.yaml, in `folder`.
    """
    source = data_of(by_hand)
    capture = yaml.safe_load((source / "capture.yaml").read_text())
    lights = capture["lights"]
    for key in ("format", "geometry", "lights"):
        del capture[key]  # these follow from the plan
    shutil.copyfile(source / lights["file"], folder / lights["file"])
    if (source / "spectra").is_dir():
        shutil.copytree(source / "spectra", folder / "spectra", dirs_exist_ok=True)
    port = str((folder / "dome").absolute())
    rig = {
        "camera": {"kind": "folder", "folder": "camera", "release": "lamps", "complete_s": 0.1},
        "lamps": {"kind": "dome", "port": port, "count": len(bench.lamps), "settle_s": 0.0},
    }
    plan = {
        "kind": "dome",
        "lights": lights["file"],
        "lights_kind": lights["kind"],
        "suffix": bench.darks[0].suffix[1:],
        "white": {"when": "before"},
        "dark": {"when": "after", "frames": len(bench.darks)},
        "checks_for": list(bench.checks),
        "capture": capture,
    }
    paths = folder / "rig.yaml", folder / "plan.yaml"
    for path, values in zip(paths, (rig, plan), strict=True):
        path.write_text(yaml.safe_dump(values, sort_keys=False))
    return paths


def run_at_terminal(command: list[str], obey: Callable[[str], None], **options: object) -> int:
    """Run a program at a terminal where a simulated person answers its requests; its output goes to standard error.

    Parameters
    ----------
    command : list of str
        The program.
    obey : callable
        Does what the last line asks; then Enter is pressed.
    **options
        Further arguments of `subprocess.Popen`.

    Returns
    -------
    int
        Exit status of the program.
    """
    master, slave = os.openpty()
    try:
        program = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, **options)
        os.close(slave)
        line = ""
        while True:
            if not select.select([master], [], [], 0.1)[0]:
                if program.poll() is not None:
                    break
                continue
            try:
                text = os.read(master, 4096).decode(errors="replace")
            except OSError:  # the program has ended
                break
            print(text, end="", file=sys.stderr, flush=True)
            line = (line + text).rpartition("\n")[2]
            if line.endswith(REQUEST_ENDS):
                obey(line)
                line = ""
                os.write(master, b"\n")
        return program.wait()
    finally:
        os.close(master)
