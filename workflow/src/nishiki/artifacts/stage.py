"""Run a stage: arguments in, checked inputs, one artifact out, and the facts of the run.

No NaN or infinity leaves a stage unless the file itself states where and why. Every floating-point array that a stage
wrote (Zarr, npz) is read once more before the artifact is finished, and every JSON and CSV file; the writer of EXR
takes finite values only. NaN passes in Zarr arrays only whose attribute `nan` states what it means there (an error map
has no error where there is no truth); infinity never passes.
"""

import argparse
import json
import os
import platform
import re
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nishiki.artifacts.artifact import MANIFEST, Artifact, ArtifactWriter, open_artifact
from nishiki.artifacts.declaration import Guarded, at_bounds, check, limit_warnings, parse
from nishiki.artifacts.maps import StagePart, TiledStage, in_order
from nishiki.artifacts.provenance import canonical, name_above, stage_key
from nishiki.errors import NotFinite, UserError, describe_machine_error
from nishiki.formats.files import read_json
from nishiki.formats.picture_process import end_children
from nishiki.formats.stored import METADATA, BandedArray
from nishiki.installation import list_loaded
from nishiki.progress import Progress
from nishiki.threads import in_threads, threads
from nishiki.version import PROJECT_VERSION


class RunFacts:
    """Clocks and counters from the moment that a stage's imports are done."""

    def __init__(self) -> None:
        self.clock, self.cpu, self.read = time.perf_counter(), time.process_time(), bytes_read()

    def finish(self, capture: Path | None) -> dict[str, Any]:
        """Return all facts at the end of the run.

        cpu_seconds: with those of processes that decoded pictures; start_cpu_seconds: until the imports were done;
        bytes_read: since then, of files and from the cache of the operating system alike; packages: heavy ones that
        were loaded; threads: that the job was given.
        """
        end_children()
        cpu, read = sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]) + time.process_time(), bytes_read()
        return {
            "seconds": round(time.perf_counter() - self.clock, 3),
            "cpu_seconds": round(cpu - self.cpu, 3),
            "start_cpu_seconds": round(self.cpu, 3),
            "process_cpu_seconds": round(cpu, 3),
            "peak_memory_mib": round(peak_memory_kib() / 1024, 1),
            "bytes_read": None if read is None or self.read is None else read - self.read,
            "packages": list(list_loaded()),
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "host": platform.node(),
            "platform": platform.platform(),
            "python": platform.python_version(),
            "cpus": os.cpu_count(),
            "threads": threads(),
            "capture": str(capture or ""),
        }


def bytes_read() -> int | None:
    """Return the bytes that this process requested from the operating system; None where they are not counted."""
    return _read_process_number("io", "rchar:")


def peak_memory_kib() -> int:
    """Return the peak of the resident memory of this program.

    ru_maxrss also counts the process that started this one, up to the moment at which it became this program: a small
    stage would show the memory of the workflow engine.
    """
    return _read_process_number("status", "VmHWM:") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _read_process_number(file: str, name: str) -> int | None:
    """Read a number that the system tells of this process."""
    try:
        lines = Path("/proc/self", file).read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) for line in lines if line.startswith(name)), None)


Item = TypeVar("Item")
NAMELESS = "scene"
"""Scene of a stage that is run by hand without a name."""


@dataclass(frozen=True)
class Context:
    """Argument of a stage's function: settings, inputs, output and place in the run.

    inputs: artifacts by stage; one that stands for other stages is there under their names, too. fields: artifacts of
    the scenes of a mosaic's fields, by field and stage.
    """

    inputs: dict[str, Artifact]
    settings: Any
    output: ArtifactWriter
    capture: Path | None
    truth: Path | None
    stamp: dict[str, str]
    progress: Progress
    part: StagePart | None = None  # of a divided stage: the share that this job does
    parts: tuple[Artifact, ...] = ()  # of a divided stage: what the one that joins them is given
    fields: dict[str, dict[str, Artifact]] = field(default_factory=dict)

    def share(self, items: Sequence[Item]) -> Sequence[Item]:
        """Select the bands (or other equal pieces of work) of this job: all, unless it is a part."""
        return self.part.share(items) if self.part else items


def run_stage(
    settings_model: type[Guarded],
    run: Callable[[Context], dict[str, Any]],
    description: str,
    *,
    arguments: Sequence[str] | None = None,
    digest_of_capture: Callable[[Path], str] | None = None,
    stands_for: Sequence[str] = (),
) -> None:
    """Run one stage from the command line. Exit status 0: done; 2: bad input, told in one line; 1: a bug.

    arguments: of the command line, after the stage's name; None: those of this process.
    digest_of_capture: for the first stage, whose key starts from the capture instead of upstream artifacts.
    stands_for: stages whose artifacts of several fields it joins, and in whose place later stages read its own.
    """
    values = _arguments(settings_model, description, arguments)
    who = settings_model.STAGE if values.scene == NAMELESS else f"{values.scene}/{settings_model.STAGE}"
    try:
        _run(settings_model, run, values, digest_of_capture, stands_for)
    except UserError as error:
        print(f"nishiki {who}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print(f"nishiki {who}: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except (OSError, MemoryError) as error:
        message = describe_machine_error(error)
        if message is None:
            raise
        print(f"nishiki {who}: {message}. Finished results are kept.", file=sys.stderr)
        raise SystemExit(2) from None


def _arguments(model: type[Guarded], description: str, words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog=f"stage.py {model.STAGE}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="settings:\n"
        + "\n".join(
            f"  {name:18} {field.description or ''} (default {field.default!r})"
            for name, field in model.model_fields.items()
        ),
    )
    parser.add_argument("--scene", default=NAMELESS, help="name of the scene, for stamps and messages")
    parser.add_argument("--inputs", nargs="*", default=[], metavar="FOLDER", help="artifacts of the upstream stages")
    parser.add_argument("--capture", type=Path, help="capture folder (ingest only)")
    parser.add_argument("--truth", type=Path, help="folder of the truth (evaluate)")
    parser.add_argument("--part", metavar="N/M", help="do only this share of the work; --output: folder of the part")
    parser.add_argument("--settings", default="{}", metavar="JSON", help="settings of this stage; the rest by default")
    parser.add_argument("--code", default="", help="digest of the code, recorded in the artifact")
    parser.add_argument("--libraries", default="{}", metavar="JSON", help="library versions, recorded in the artifact")
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        help="results folder of the stage (the key is appended), or the path of the artifact.json to make",
    )
    return parser.parse_args(words)


def _run(
    model: type[Guarded],
    run: Callable[[Context], dict[str, Any]],
    arguments: argparse.Namespace,
    digest_of_capture: Callable[[Path], str] | None,
    stands_for: Sequence[str],
) -> None:
    facts = RunFacts()
    settings = parse(model, _json(arguments.settings, "--settings"), f"settings of {model.STAGE}")
    opened = [open_artifact(Path(folder)) for folder in arguments.inputs]
    named = {name_above(arguments.scene, item.manifest): item for item in opened if "part" not in item.manifest}
    inputs, fields = _by_stage(named)
    parts = [artifact for artifact in opened if "part" in artifact.manifest]
    if not digest_of_capture:
        upstream = {name: artifact.key for name, artifact in named.items()}
    elif arguments.capture is None:
        raise UserError("--capture is needed: the sealed capture folder")
    else:
        upstream = {"capture": digest_of_capture(arguments.capture)}
    values = settings.model_dump(mode="json")
    key = stage_key(model.STAGE, model.VERSION, values, upstream)
    read = {name: {"key": item.key, "digest": item.digest} for name, item in named.items()}
    joined = in_order(parts, key=key, code=arguments.code, upstream=read) if parts else ()
    if arguments.part is not None and not isinstance(run, TiledStage):
        raise UserError(f"--part: {model.STAGE} cannot be divided")
    part = None if arguments.part is None else StagePart.parse(arguments.part)
    target = arguments.output
    if not part and target.name == MANIFEST:
        target = target.parent
        if target.name != key:
            raise UserError(f"{target}: the inputs differ from the plan and give the key {key}. Remedy: run again")
    elif not part:
        target /= key
    joins = [name for name in stands_for if fields and all(name in made for made in fields.values())]
    stamp = {"scene": arguments.scene, "stage": model.STAGE, "key": key, "version": PROJECT_VERSION}
    with ArtifactWriter(target) as output:
        context = Context(
            inputs,
            settings,
            output,
            arguments.capture,
            arguments.truth,
            stamp,
            Progress(f"{arguments.scene}/{model.STAGE}"),
            part,
            tuple(joined),
            fields,
        )
        diagnostics = run(context)
        if not part:
            check(model.STAGE, model.LIMITS, diagnostics, settings.allow)
            warnings = [f"a fitted parameter ended at its bound: {each}" for each in at_bounds(diagnostics)]
            warnings += limit_warnings(model.STAGE, model.LIMITS, diagnostics, settings.allow)
            who = model.STAGE if arguments.scene == NAMELESS else f"{arguments.scene}/{model.STAGE}"
            for each in warnings:
                print(f"nishiki {who}: warning: {each}", file=sys.stderr)
        expect_finite(output.folder, model.STAGE)
        manifest = {
            **stamp,
            **({"part": arguments.part} if part else {}),
            **({"stands_for": joins} if joins else {}),
            "format_version": model.VERSION,
            "settings": json.loads(canonical(values)),
            "upstream": read or {"capture": {"digest": upstream["capture"]}},
            "code": arguments.code,
            "libraries": _json(arguments.libraries, "--libraries"),
            "diagnostics": diagnostics,
        }
        made_from = [Path(name) if name.endswith(MANIFEST) else Path(name, MANIFEST) for name in arguments.inputs]
        output.finish(manifest, facts.finish(arguments.capture), inputs=made_from)


def _by_stage(named: dict[str, Artifact]) -> tuple[dict[str, Artifact], dict[str, dict[str, Artifact]]]:
    """Return the artifacts of the scene by stage, and those of fields by field and stage."""
    inputs: dict[str, Artifact] = {}
    fields: dict[str, dict[str, Artifact]] = {}
    for name, artifact in named.items():
        field, _, stage = name.rpartition("/")
        if field:
            fields.setdefault(field, {})[stage] = artifact
        else:
            inputs |= dict.fromkeys((stage, *artifact.manifest.get("stands_for", ())), artifact)
    return inputs, fields


def _json(text: str, where: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except ValueError as error:
        raise UserError(f"{where}: not valid JSON ({error})") from None
    if not isinstance(value, dict):
        raise UserError(f"{where}: expected a JSON object, found {text!r}")
    return value


CELL = re.compile(r"(?:^|[,;\t ])[+-]?(?:nan|inf|infinity)(?=$|[,;\t ])", re.IGNORECASE | re.MULTILINE)
Place = tuple[int, ...]


def expect_finite(folder: Path, stage: str) -> None:
    """Look at everything that a stage wrote below `folder`.

    Raises NotFinite naming the stage and for each array the number of such values and the first index.
    """
    texts = [text for text in problems(Path(folder)) if text]
    if texts:
        raise NotFinite(
            f"{stage} wrote values that are not finite, which is a defect of this program: {'; '.join(texts)}. "
            "Nothing of this stage is kept; please report it with the capture or its settings"
        )


def problems(folder: Path) -> Iterator[str]:
    """Yield a text for each array or file below `folder` that holds a forbidden value."""
    for name in sorted(_names(folder)):
        path = folder / name
        if path.name == METADATA:
            yield from _zarr(path, path.parent.relative_to(folder).as_posix())
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as stored:
                for key in stored.files:
                    values = stored[key]
                    if values.dtype.kind in "fc":
                        yield _describe_forbidden(f"{name}: {key}", [((0,) * values.ndim, values)])
        elif path.suffix == ".json":
            yield from _words(path, name, r"[:,\[\s](?:NaN|-?Infinity)(?=[,\]}\s]|$)")
        elif path.suffix in (".csv", ".tsv"):
            yield from _words(path, name, CELL)


def _names(folder: Path) -> Iterator[str]:
    """Yield files below a folder that hold values, except chunks of Zarr arrays: they have no suffix, and are many."""
    start = len(str(folder)) + 1
    for root, _, names in os.walk(folder):
        for name in names:
            if name.endswith((".json", ".npz", ".csv", ".tsv")):
                yield f"{root[start:]}/{name}" if root[start:] else name


def _zarr(path: Path, name: str) -> Iterator[str]:
    node = read_json(path)
    if node.get("node_type") != "array" or not str(node.get("data_type")).startswith("float"):
        return
    array = BandedArray.of(path.parent)

    def block(place: Place) -> tuple[Place, np.ndarray]:
        return tuple(number * size for number, size in zip(place, array.chunks, strict=True)), array.chunk(place)

    written = (place for place in array.places() if array.path(*place).is_file())
    yield _describe_forbidden(name, in_threads(block, written), nan_means=bool(array.attrs.get("nan")))


def _words(path: Path, name: str, pattern: str | re.Pattern) -> Iterator[str]:
    match = re.search(pattern, path.read_text(encoding="utf-8", errors="replace"))
    if match:
        yield f"{name}: {match.group(0).strip(' ,:[')!r} at character {match.start()}"


def _describe_forbidden(name: str, blocks: Iterable[tuple[Place, np.ndarray]], *, nan_means: bool = False) -> str:
    """Describe the forbidden values of parts of an array, each with the index of its first value; empty without any."""
    tests = {"infinite": np.isinf} | ({} if nan_means else {"NaN": np.isnan})
    counts, firsts = Counter[str](), dict[str, Place]()
    for start, values in blocks:
        with np.errstate(all="ignore"):  # one pass without a mask; an overflow of the sum costs a second look only
            is_finite = np.isfinite(np.sum(values, dtype=np.float32 if values.dtype.itemsize == 2 else None))
        for word, test in tests.items() if not is_finite else ():
            if len(places := np.argwhere(test(values))):
                counts[word] += len(places)
                firsts.setdefault(word, tuple((places[0] + np.array(start, int)).tolist()))
    words = ", ".join(f"{counts[word]} {word}, the first at {place}" for word, place in firsts.items())
    return f"{name}: {words}" if words else ""
