"""A folder with tiny simulated scenes, an undisturbed run of them, and what can be asked of a disturbed one."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from benchmarks.cut_mosaic import cut_capture

PROJECT = Path(__file__).resolve().parents[2]
PRESETS = {"plane": "tiny", "turntable": "object-tiny", "goniometer": "satin-tiny"}
PAINTING_IN_FIELDS = ("--rows", "320", "--columns", "400", "--rings", "1", "--ring-lights", "6")
SMALL = {
    "render": {"pictures": [{"name": "daylight"}], "sequences": [{"name": "moving-light", "frames": 2, "columns": 48}]},
    "cloth_render": {"view": {"rows": 48, "columns": 48}, "supersampling": 1},
    "object_render": {"views": 4, "between": 1, "film": {"frames_per_step": 1, "columns": 48, "supersampling": 1}},
}
UNSTABLE = ("run.json",)  # facts of one run: times, memory, host


@dataclass
class Arena:
    """Scenes, configuration and results in one folder; `reference` is what an undisturbed run made."""

    folder: Path
    scenes: tuple[str, ...]
    reference: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def results(self) -> Path:
        """Where the runs write."""
        return self.folder / "results"

    @property
    def kept(self) -> Path:
        """A copy of the undisturbed results, with their times."""
        return self.folder / "undisturbed"

    def nishiki(self, *arguments: str, **options) -> subprocess.CompletedProcess:
        """The command line inside the arena, to its end."""
        return subprocess.run(
            self.command(*arguments),
            cwd=self.folder,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=900,
            **options,
        )

    def command(self, *arguments: str) -> list[str]:
        """Arguments of a process for the command line."""
        return [sys.executable, "-m", "nishiki", *arguments]

    def start(self) -> subprocess.Popen:
        """A run in a process group of its own, going on in the background; its output goes to run.log."""
        log = open(self.folder / "run.log", "w")
        return subprocess.Popen(
            self.command("run", "--configfile", "config.yaml"),
            cwd=self.folder,
            env=environment(),
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def run(self) -> subprocess.CompletedProcess:
        """A run to its end."""
        return self.nishiki("run", "--configfile", "config.yaml")

    def verify(self, *arguments: str) -> subprocess.CompletedProcess:
        """The command verify on the results."""
        return self.nishiki("verify", *arguments, "results")

    def artifacts(self, root: Path | None = None) -> list[Path]:
        """Folders of all finished artifacts of the plans, below `results` or another root."""
        root = root or self.results
        found = (path.parent for path in root.glob("*/*/*/artifact.json"))
        return sorted(folder for folder in found if len(folder.name) == 12 and not folder.is_symlink())

    def durations(self) -> dict[str, float]:
        """Seconds that each stage took in the undisturbed run; the longest where several scenes have it."""
        found = {}
        for folder in self.artifacts(self.kept):
            run = json.loads((folder / "run.json").read_text())
            seconds = run["start_cpu_seconds"] + run["seconds"]
            found[folder.parent.name] = max(seconds, found.get(folder.parent.name, 0.0))
        return found

    def restore(self) -> None:
        """The undisturbed results again, as they were."""
        shutil.rmtree(self.results, ignore_errors=True)
        shutil.copytree(self.kept, self.results, symlinks=True)

    def digests(self, root: Path | None = None) -> dict[str, str]:
        """SHA-256 of every file of the finished artifacts, by its name below the results."""
        root = root or self.results
        return {
            path.relative_to(root).as_posix(): digest(path)
            for folder in self.artifacts(root)
            for path in sorted(folder.rglob("*"))
            if path.is_file() and path.name not in UNSTABLE
        }


def environment() -> dict[str, str]:
    """Environment of every process: the project's package, nothing of a calling test."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**kept, "PYTHONPATH": str(PROJECT / "workflow/src")}


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def make_arena(folder: Path, geometries: tuple[str, ...]) -> Arena:
    """Simulate the scenes, `mosaic` and those of PRESETS, run them undisturbed, and keep what came out."""
    folder.mkdir(parents=True, exist_ok=True)
    arena = Arena(folder, geometries)
    truths = {name: "" if name == "mosaic" else f"captures/{name}-truth" for name in geometries}
    rows = "".join(f"{name}\tcaptures/{name}\t{truth}\n" for name, truth in truths.items())
    (folder / "scenes.tsv").write_text("scene\tcapture\ttruth\n" + rows)
    (folder / "config.yaml").write_text(yaml.safe_dump({"scenes": "scenes.tsv", "results": "results", **SMALL}))
    for name in geometries:
        capture = f"captures/{name}"
        if name == "mosaic" and not (folder / capture).is_dir():
            whole = (folder / "captures/whole", folder / "captures/whole-truth")
            expect(arena.nishiki("simulate", "--output", whole[0], "--truth", whole[1], *PAINTING_IN_FIELDS))
            cut_capture(whole[0], folder / capture, grid=(2, 2), overlap=0.3, seed=1)
        if not (folder / capture).is_dir():
            arguments = ("--output", capture, "--truth", f"{capture}-truth", "--preset", PRESETS[name])
            expect(arena.nishiki("simulate", *arguments))
    if not arena.kept.is_dir():
        shutil.rmtree(arena.results, ignore_errors=True)
        start = time.monotonic()
        expect(arena.run())
        (folder / "seconds.json").write_text(json.dumps(time.monotonic() - start))
        arena.results.rename(arena.kept)
        arena.restore()
    arena.seconds = json.loads((folder / "seconds.json").read_text())
    arena.reference = arena.digests(arena.kept)
    return arena


def expect(done: subprocess.CompletedProcess) -> None:
    """The process did what it should, or everything that it said."""
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, done.args))}: exit {done.returncode}\n{done.stdout}")
