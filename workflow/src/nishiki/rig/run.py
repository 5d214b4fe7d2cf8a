"""Take a capture with a rig: every frame of a table once, checked, journalled, and sealed at the end.

Everything lies in NAME.rig/ beside the capture NAME until the last frame is there:

    NAME.rig/journal.jsonl   what happened, one line an event
    NAME.rig/frames.tsv      the table
    NAME.rig/incoming/       the photograph that is being taken
    NAME.rig/rejected/       the last photograph of each frame that was not kept
    NAME.rig/capture/        the capture as it grows

A frame is journalled with its digest before it is renamed into the capture. After a kill between the two, the digest
tells that the photograph in incoming/ is that frame.
"""

import contextlib
import dataclasses
import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

from nishiki.capture.folder import load_capture
from nishiki.capture.mosaic import TABLE as MOSAIC
from nishiki.capture.mosaic import MosaicCapture, is_capture, is_mosaic
from nishiki.capture.schema import CameraResponse, validate
from nishiki.capture.seal import MANIFEST, capture_digest, read_manifest, seal, sha256_of
from nishiki.capture.taking import channel_names
from nishiki.capture.taking import table_text as rows_text
from nishiki.errors import UserError, require
from nishiki.formats.files import flush, put_file
from nishiki.formats.images import read_codes, read_exif, read_header
from nishiki.formats.problems import CaptureError, group_problems
from nishiki.rig import records
from nishiki.rig.description import OpenedRig, expect_devices, open_rig, read_rig
from nishiki.rig.device import DeviceError, DeviceLost, Rig, ask_operator
from nishiki.rig.frames_table import AUTOMATIC, FIELDS, PlannedFrame, by_field, read_table, summary, table_text
from nishiki.rig.plan import ReadPlan, read_plan

REQUESTS = {
    "white": "put the white board in the object's place",
    "board": "put the calibration board on the turntable",
    "dark": "put the lens cap on (or make the room dark)",
    "object": "take the lens cap off and put the object in its place",
}
SUFFIXES = {".jpeg": ".jpg", ".tiff": ".tif"}
RECONNECTIONS = 5
"""Maximum number of reconnections of the devices for one frame."""
WAIT_S = 2.0
"""Seconds before the first reconnection; doubled for each further one."""
GOOD_PEAK = (0.55, 0.85)
"""Target range of the automatic exposure for the 99.9 % quantile, relative to full scale."""
OVERLAP = 0.1
"""Minimum overlap of neighbouring fields, as a share of a field: matches of the mosaic need about this much."""
TRIALS = 12  # exposures of an automatic one
EXISTS = "{}: exists already. Remedy: choose another name; nothing is overwritten"
SAME_COMMAND = "Nothing is lost: the same command goes on with this frame"


def run_capture(
    rig: Path,
    plan: Path,
    capture: Path,
    *,
    observer: records.RunState | None = None,
    open_devices: Callable[[Path], Rig] = open_rig,
    ask: Callable[[str, str], None] = ask_operator,
    pause: Callable[[float], None] = time.sleep,
) -> str:
    """Take the photographs of a plan, or continue an earlier call, and seal the capture.

    Parameters
    ----------
    rig : Path
        Description of the rig.
    plan : Path
        The plan (YAML), or a table of frames made from one (.tsv).
    capture : Path
        Capture folder to make. Until it is complete, everything lies in a folder of this name with `.rig` added.
    observer : RunObserver
        Is told what happens.
    open_devices : callable
        Opens the devices of a description.
    ask : callable
        Asks a person to do something, and waits: the name of what asks, the request.
    pause : callable
        Waits for some seconds.

    Returns
    -------
    str
        The digest of the sealed capture.

    Raises
    ------
    UserError
        The plan, the rig or a frame needs a person. Nothing is lost: the same call goes on.
    """
    read, frames = read_frames_of(plan)
    capture, fields = Path(capture), by_field(frames)
    if fields and not is_mosaic(capture) and is_capture(capture):
        raise UserError(EXISTS.format(capture))
    before, parts = None, {f"{FIELDS}/{name}": part for name, part in fields.items()} or {".": frames}
    for name, part in parts.items():
        run = CaptureRun(rig, read, part, capture / name, observer or records.RunState(), open_devices, ask, pause)
        digest = run.complete(plan, like=before)
        if fields and before is None:
            expect_overlap(read, run.capture)
        before = run
    if not fields:
        return digest
    grid = require(getattr(read.settings, "fields", None))
    rows: list[tuple[str, ...]] = [("field", "path", "x_mm", "y_mm")]
    for name, part in fields.items():
        stands = dict(next(frame.axes for frame in part if frame.group == "object"))
        rows.append((name, f"{FIELDS}/{name}", *(f"{grid.sign * stands[axis]:.10g}" for axis in grid.axes)))
    put_file(capture / MOSAIC, rows_text(rows))
    return cast(MosaicCapture, load_capture(capture)).digest


def expect_overlap(plan: ReadPlan, field: Path) -> None:
    """Raise UserError where neighbours of this field, whose size and scale are known, would overlap too little."""
    grid, pitch = require(getattr(plan.settings, "fields", None)), plan.settings.capture.get("pixel_pitch_mm")
    header = read_header(next((field / "data" / "frames").iterdir()))
    sizes = (grid.columns, header.columns), (grid.rows, header.rows)
    for (count, size), step in zip(sizes, grid.step_mm, strict=True):
        if pitch and count > 1 and step > (1 - OVERLAP) * size * pitch:
            raise UserError(
                f"plan: fields.step_mm: a field is {size * pitch:g} mm wide or high, so steps of {step:g} mm leave an "
                f"overlap of {max(1 - step / size / pitch, 0):.0%}. Remedy: step_mm of at most "
                f"{(1 - OVERLAP) * size * pitch:.4g} there, and a new name for the capture; or correct pixel_pitch_mm"
            )


def read_frames_of(plan: Path) -> tuple[ReadPlan, tuple[PlannedFrame, ...]]:
    """Read a plan and its frames, from the plan itself or from a table that names it."""
    if plan.suffix.lower() == ".tsv":
        plan_file, frames = read_table(plan)
        return read_plan(plan_file), frames
    read = read_plan(plan)
    return read, read.frames()


def describe_run(rig: Path, plan: Path, capture: Path) -> str:
    """Describe a run without moving anything: the table, its totals, and the number of finished frames.

    Raises UserError where the plan asks for something that the rig does not have.
    """
    _read, frames = read_frames_of(plan)
    expect_devices(frames, read_rig(rig))
    places = [capture / FIELDS / name for name in by_field(frames)] or [capture]
    events = [event for place in places for event in records.Journal(work_folder(place) / "journal.jsonl").events()]
    kept = [event["file"] for event in events if event["event"] == "frame"]
    text = table_text(frames, os.path.relpath(plan)) + summary(frames, capture)
    return f"{text}\n{len(kept)} of them are kept already" if kept else text


def work_folder(capture: Path) -> Path:
    """Return the folder of a capture until it is complete."""
    return capture.with_name(f"{capture.name}.rig")


class CaptureRun:
    """Capture in progress; see `run_capture`."""

    def __init__(
        self,
        rig: Path,
        plan: ReadPlan,
        frames: tuple[PlannedFrame, ...],
        capture: Path,
        observer: records.RunState,
        open_devices: Callable[[Path], Rig],
        ask: Callable[[str, str], None],
        pause: Callable[[float], None],
    ) -> None:
        self.rig_file, self.plan, self.frames, self.capture = rig, plan, frames, capture
        self.observer, self.ask, self.pause = observer, ask, pause
        self.devices = OpenedRig(rig, frames, open_devices)
        self.neighbours = records.FrameNeighbours(plan, frames)
        self.work = work_folder(capture)
        self.payload, self.incoming = self.work / "capture", self.work / "incoming"
        self.journal = records.Journal(self.work / "journal.jsonl")
        self.camera = validate(CameraResponse, records.capture_settings(plan)["camera"], "plan: capture.camera")
        self.kept: dict[str, dict[str, Any]] = {}
        self.exposures: dict[str, float] = {}
        self.subject: str | None = "object"

    def complete(self, plan_file: Path, *, like: "CaptureRun | None" = None) -> str:
        """Take missing frames, then check, rename and seal.

        like: the field of the same mosaic that was finished before; its boards, darks and exposures serve this one too.
        """
        checked = any(event["event"] == "checked" for event in self.journal.events())
        if self._is_in_place() and not checked:
            raise UserError(EXISTS.format(self.capture))
        with self._lock():
            try:
                if not self._is_in_place():
                    self._begin(plan_file, like)
                    for frame in self.frames:
                        if frame.file not in self.kept:
                            self._take(frame)
                    self._check_and_place()
                return self._seal()
            except UserError as error:
                with contextlib.suppress(OSError):
                    self._note("stop", message=str(error))
                raise
            finally:
                self.devices.close()

    # The folder of the run

    def _is_in_place(self) -> bool:
        return self.capture.exists() or self.capture.with_name(self.capture.name + ".sealing").exists()

    @contextlib.contextmanager
    def _lock(self) -> Iterator[None]:
        """Lock the capture against other runs. UserError where one is in progress."""
        self.work.mkdir(parents=True, exist_ok=True)
        with (self.work / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(f"{self.capture}: another run takes it now. Remedy: wait, or end it") from None
            yield

    def _begin(self, plan_file: Path, like: "CaptureRun | None") -> None:
        """Prepare the folder, or continue from the files of an earlier run."""
        for folder in (self.payload, self.incoming, self.work / "rejected", self.work / "companions"):
            folder.mkdir(exist_ok=True)
        self._keep_table(plan_file)
        records.write_tables(self.payload, self.plan, self.frames, {})
        records.refuse_unusable_settings(self.payload)
        own = [*self.journal.events()]
        self.kept = {event["file"]: event for event in own if event["event"] == "frame"}
        for event in [*(like.journal.events() if like else ()), *own]:
            if event["event"] == "exposure":
                self.exposures[event["group"]] = event["exposure_s"]
            elif event["event"] == "subject":
                self.subject = event["subject"]
        if self.subject != "object":
            self.subject = None  # somebody may have changed it since
        for file in [file for file, event in self.kept.items() if not self._is_kept(event)]:
            self._note("missing", file=file)
            del self.kept[file]
        if like is not None:
            self._share(like)
        self._note("begin", frames=len(self.frames), kept=len(self.kept))
        self.observer.record_start(self.frames, set(self.kept), self.camera)

    def _share(self, other: "CaptureRun") -> None:
        """Copy photographs taken once for all fields that are missing here."""
        shared = {frame.file for frame in self.frames if frame.group in ("white", "dark")} - set(self.kept)
        for event in other.journal.events():
            if event["event"] == "frame" and event["file"] in shared:
                copy = self.incoming / "shared"
                shutil.copyfile(other.capture / "data" / event["file"], copy)
                facts = {key: value for key, value in event.items() if key not in ("time", "event")}
                self.kept[event["file"]] = self._note("frame", **facts)
                self._rename(copy, self.payload / event["file"])

    def _keep_table(self, plan_file: Path) -> None:
        """Write the table beside the journal; UserError where the run began with another one."""
        path = self.work / "frames.tsv"
        if path.exists():
            _, began = read_table(path)
            if began != self.frames:
                i = next(
                    (i for i, (a, b) in enumerate(zip(began, self.frames, strict=False)) if a != b),
                    min(len(began), len(self.frames)),
                )
                raise UserError(
                    f"{plan_file}: from frame {i + 1} on other frames than those that this capture began with. "
                    f"Remedy: ./nishiki rig run {self.rig_file} {path} {self.capture} goes on; another name begins anew"
                )
            return
        named = read_table(plan_file)[0] if plan_file.suffix.lower() == ".tsv" else plan_file
        put_file(path, table_text(self.frames, os.path.relpath(named, self.work)))

    def _is_kept(self, event: dict[str, Any]) -> bool:
        """Check whether a journalled frame is in the capture, or can be put there, with its original digest."""
        target = self.payload / event["file"]
        if target.exists():
            return sha256_of(target) == event["sha256"]
        for path in self.incoming.iterdir():
            if path.is_file() and path.stat().st_size == event["bytes"] and sha256_of(path) == event["sha256"]:
                self._rename(path, target)
                return True
        return False

    # Frames

    def _take(self, frame: PlannedFrame) -> None:
        """Take one frame until it is accepted; UserError after the stated number of repetitions."""
        repeats = self.plan.settings.checks.repeats
        rejections = 0
        while True:
            path, taken, measures, reasons = self._expose(frame, lambda: self._exposure_of(frame))
            if measures is not None and not reasons:
                return self._keep(frame, path, taken, measures)
            rejections += 1
            self._note("rejected", file=frame.file, attempt=rejections, reasons=reasons)
            os.replace(path, self.work / "rejected" / frame.file.replace("/", "_"))
            if rejections > repeats:
                raise UserError(
                    f"{frame.file}: rejected {rejections} times: {'; '.join(reasons)}. It lies in "
                    f"{self.work / 'rejected'}. {SAME_COMMAND}; the plan's block 'checks' has the limits"
                )

    def _expose(
        self, frame: PlannedFrame, seconds: Callable[[], float | None]
    ) -> tuple[Path, float | None, records.Measures | None, list[str]]:
        """Photograph and measure; reopen devices that do not answer.

        Return the file, the seconds of the exposure, the measures, and the reasons for a rejection.
        """
        losses = 0
        while True:
            try:
                return self._photograph(frame, seconds())
            except DeviceLost as error:
                losses += 1
                self._note("lost", file=frame.file, attempt=losses, message=str(error))
                self.devices.close()
                if losses > RECONNECTIONS:
                    raise DeviceLost(f"{frame.file}: {error}. {SAME_COMMAND}") from None
                self.pause(WAIT_S * 2 ** (losses - 1))

    def _photograph(
        self, frame: PlannedFrame, seconds: float | None
    ) -> tuple[Path, float | None, records.Measures | None, list[str]]:
        largest = max((event["bytes"] for event in self.kept.values()), default=frame.bytes)
        free = shutil.disk_usage(self.work).free
        if free < 2 * largest:
            raise UserError(
                f"{self.work}: expected room for two photographs ({2 * largest / 1e6:.0f} MB), found "
                f"{free / 1e6:.0f} MB. Remedy: free space there. {SAME_COMMAND}"
            )
        rig = self.devices.open_devices()
        if frame.group != self.subject:
            self.subject = None
            self._note("request", request=REQUESTS[frame.group])
            self.ask("rig", REQUESTS[frame.group])
            self._note("subject", subject=frame.group)
            self.subject = frame.group
        taken = self.devices.set_up(frame, seconds)
        _clear(self.incoming)
        path = self._pick(frame, rig.camera.photograph(self.incoming))
        try:
            header = read_header(path)
            codes = read_codes(path, channel_names(header), header=header)
        except CaptureError as error:
            return path, taken, None, [f"the photograph cannot be read: {error.problems[0]}"]
        measures = records.measure(codes, self.camera, read_exif(path).exposure_s)
        self.observer.record_photograph(frame, codes, measures)
        return path, taken, measures, self.neighbours.reasons_against(frame, measures, taken, self.kept)

    def _pick(self, frame: PlannedFrame, files: tuple[Path, ...]) -> Path:
        """Choose the photograph among the files of an exposure; the JPEG beside a raw file goes to companions/."""
        suffix = Path(frame.file).suffix.lower()

        def fits(path: Path) -> bool:
            known = path.suffix.lower()
            return SUFFIXES.get(known, known) == SUFFIXES.get(suffix, suffix)

        chosen = [path for path in files if fits(path)]
        if len(chosen) != 1:
            names = ", ".join(path.name for path in files) or "nothing"
            raise DeviceError(f"{frame.file}: expected one {suffix} file, found {names}. Remedy: correct 'suffix'")
        for path in files:
            if path != chosen[0]:
                name = f"{Path(frame.file).with_suffix('').as_posix().replace('/', '_')}{path.suffix}"
                os.replace(path, self.work / "companions" / name)
        return chosen[0]

    def _keep(self, frame: PlannedFrame, path: Path, exposure_s: float | None, measures: records.Measures) -> None:
        """Record a photograph with its digest in the journal, then rename it into the capture."""
        with path.open("rb") as file:
            os.fsync(file.fileno())
        facts = {
            "file": frame.file,
            "sha256": sha256_of(path),
            "bytes": path.stat().st_size,
            "exposure_s": exposure_s,
            "measures": dataclasses.asdict(measures),
        }
        self.kept[frame.file] = self._note("frame", **facts)
        self._rename(path, self.payload / frame.file)

    def _rename(self, path: Path, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
        flush(target.parent)

    # Exposure

    def _exposure_of(self, frame: PlannedFrame) -> float | None:
        """Return the exposure of a frame in seconds; meter an automatic one before the first frame that needs it."""
        if not isinstance(frame.exposure_s, str):
            return frame.exposure_s
        group = next(name for name, cell in AUTOMATIC.items() if cell == frame.exposure_s)
        if group not in self.exposures:
            lit = [f for f in self.frames if f.group == group and f.exposure_s == frame.exposure_s]
            if frame.group == "dark" or not lit:
                raise UserError(f"{frame.file}: exposure {frame.exposure_s} is not known. Remedy: give it in seconds")
            self.exposures[group] = self._meter(max(lit, key=lambda f: self.neighbours.references[f.file]))
            self._note("exposure", group=group, exposure_s=self.exposures[group])
        return self.exposures[group]

    def _meter(self, frame: PlannedFrame) -> float:
        """Find the exposure in seconds at which a frame, expected to be the brightest, uses the codes unsaturated."""
        auto = self.plan.settings.auto
        seconds, tried = auto.start_s, []
        for _ in range(TRIALS):
            path, taken, measures, reasons = self._photograph(frame, seconds)
            _clear(self.incoming)
            if measures is None:
                raise DeviceLost(f"{path.name}: {reasons[0]}")
            seconds = taken or seconds
            fits = measures.saturated <= auto.saturated
            tried.append(f"{seconds:g} s: {measures.saturated:.2%} saturated, peak {measures.peak:.2f}")
            at_end = seconds >= 0.99 * auto.most_s
            if fits and (measures.peak >= GOOD_PEAK[0] or at_end):
                return seconds
            factor = 0.25 if not fits else 0.7 / max(measures.peak, 0.05)
            wanted = min(max(float(f"{seconds * factor:.3g}"), auto.least_s), auto.most_s)
            if wanted == seconds:
                break
            seconds = wanted
        what = f"{frame.file}: no exposure found: {'; '.join(tried)}"
        raise UserError(f"{what}. Remedy: change light or aperture, or set exposure_s in the plan")

    # The end

    def _check_and_place(self) -> None:
        """Write the tables, check the capture as ./nishiki check does, and rename it to its final name."""
        from nishiki.observations.check import check_capture

        self.devices.close()
        header = read_header(self.payload / self.frames[0].file)
        exposures = {file: event["exposure_s"] for file, event in self.kept.items() if event["exposure_s"]}
        records.write_tables(self.payload, self.plan, self.frames, exposures, header)
        problems = check_capture(self.payload, level="full")
        errors = [problem for problem in problems if problem.severity == "error"]
        if errors:
            raise UserError(
                f"{self.payload}: every frame is taken, but the check found {len(errors)} errors:\n"
                + "\n".join(map(str, group_problems(errors)))
                + "\nRemedy: correct the plan and run the same command; frames are taken again where their file is "
                f"removed from {self.payload}"
            )
        self._note("checked", warnings=[str(problem) for problem in problems])
        os.rename(self.payload, self.capture)
        flush(self.capture.absolute().parent)

    def _seal(self) -> str:
        """Seal the capture, and compare its manifest with the digests of the frames at their exposure."""
        digests = {event["file"]: event["sha256"] for event in self.journal.events() if event["event"] == "frame"}
        if not (self.capture / "bagit.txt").is_file():
            seal(self.capture)
        listed = read_manifest(self.capture / MANIFEST)
        changed = [f.file for f in self.frames if listed.get(f"data/{f.file}") != digests.get(f.file)]
        if changed:
            raise UserError(
                f"{self.capture}: {len(changed)} frames changed after they were taken, such as {changed[0]}. "
                "Remedy: check the disk; take the capture again under another name"
            )
        digest = capture_digest(self.capture)
        if not any(event["event"] == "sealed" for event in self.journal.events()):
            self._note("sealed", digest=digest)
        for folder in ("incoming", "rejected", "companions"):
            with contextlib.suppress(OSError):
                (self.work / folder).rmdir()  # those that hold nothing
        return digest

    def _note(self, event: str, **facts: Any) -> dict[str, Any]:
        line = self.journal.write(event, **facts)
        self.observer.record_event(line)
        return line


def _clear(folder: Path) -> None:
    """Remove files of an unfinished exposure."""
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
