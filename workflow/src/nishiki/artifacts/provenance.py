"""Stage keys and code digests: what decides whether a stage has to run.

The key of a stage is the start of the SHA-256 of a canonical text of everything that decides its result, apart from the
code: stage name and format version, exactly the settings that it reads, and the keys of its upstream artifacts.
The code digest covers the syntax trees of the stage's program and of every module of this project that it imports,
directly or not, without comments and docstrings; declarations of stages are left out, because the settings stand in the
key as values, and costs, texts and limits change no byte of a result. So is the package's own `__init__.py`, which only
names what users call. Tables and templates beside these modules count too, and of the JavaScript of pages the modules
that the stage's own page is built from. Modules go by their names below the package and scripts by theirs, so that the
digests of a checkout and of an installed package are the same.
"""

import functools
import hashlib
import importlib.metadata
import json
import math
import unicodedata
from pathlib import Path
from typing import Any

from nishiki.artifacts.javascript import modules_of
from nishiki.artifacts.syntax import syntax_of
from nishiki.errors import UserError
from nishiki.installation import SCRIPTS, SOURCE

KEY_DIGITS = 12
PACKAGE = "nishiki"
STAGES = SOURCE / PACKAGE / "stages"
GEOMETRIES = ("object", "cloth")
"""Prefixes of stages that several geometries have: `object_render` is the module `object` of the package `render`."""


def canonical(value: Any) -> str:
    """Canonical JSON text of `value`: keys sorted, 1 and 1.0 equal, Unicode in NFC, no spaces.

    Raises ValueError for NaN and infinities, which have no place in a configuration, and TypeError for other types.
    """
    return json.dumps(_normal(value), sort_keys=True, ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def _normal(value: Any) -> Any:
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, int):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"a setting must be finite, found {value}")
        return int(value) if value.is_integer() and abs(value) < 2**53 else value
    if isinstance(value, str):
        return unicodedata.normalize("NFC", value)
    if isinstance(value, dict):
        return {unicodedata.normalize("NFC", str(key)): _normal(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_normal(item) for item in value]
    raise TypeError(f"a setting must be made of numbers, texts, lists and blocks, found {type(value).__name__}")


def stage_key(stage: str, version: int, settings: dict, upstream: dict[str, str]) -> str:
    """Key of a stage: 12 hexadecimal digits. `upstream` maps stage names (or `capture`) to their keys or digests."""
    return key_of_text(stage, version, canonical(settings), upstream)


def key_of_text(stage: str, version: int, settings: str, upstream: dict[str, str]) -> str:
    """The same from the canonical text of the settings, which thousands of scenes may share."""
    rest = canonical({"stage": stage, "upstream": upstream, "version": version})
    text = f'{{"settings":{settings},{rest[1:]}'  # canonical text of all four: "settings" is the first in order
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]


def differences(first: dict, second: dict, path: str = "") -> list[str]:
    """Each place where two settings blocks differ, as `place: first -> second`."""
    texts = []
    for key in sorted(set(first) | set(second), key=str):
        place = f"{path}.{key}" if path else str(key)
        a, b = first.get(key, "(absent)"), second.get(key, "(absent)")
        if isinstance(a, dict) and isinstance(b, dict):
            texts += differences(a, b, place)
        elif _normal(a) != _normal(b):
            texts.append(f"{place}: {a!r} -> {b!r}")
    return texts


def module_of(stage: str) -> str:
    """Return the dotted name of the module that runs a stage, below `nishiki.stages`."""
    geometry, _, rest = stage.partition("_")
    if geometry in GEOMETRIES:
        return f"{rest}.{geometry}"
    return f"{stage}.painting" if (STAGES / stage / "painting.py").is_file() else f"{stage}.run"


def stage_program(stage: str) -> str:
    """Path of a stage's code below the folder of a checkout, as in a packed crate."""
    return f"workflow/src/{PACKAGE}/stages/{module_of(stage).replace('.', '/')}.py"


def program_of(name: str) -> Path:
    """The file that runs a stage of this name; for other names a script of the project."""
    program = STAGES.joinpath(*module_of(name).split(".")).with_suffix(".py")
    return program if program.is_file() else SCRIPTS / f"{name}.py"


def code_digest(script: Path) -> str:
    """Digest of the code that a script (or a stage's program) runs: itself, every module of this project that it
    imports, directly or not, and their tables."""
    digest = hashlib.sha256()
    script = Path(script).resolve()
    files = code_files(script)
    for path in files:
        digest.update(f"{_name(path)}\0{syntax_of(path).tree}\0".encode())
    for path in data_files(files):
        digest.update(f"{path.relative_to(SOURCE)}\0{file_digest(path)}\0".encode())
    return digest.hexdigest()[:KEY_DIGITS]


def code_files(script: Path) -> list[Path]:
    """The script and the project's modules that it imports, directly or not, in a fixed order."""
    script = Path(script).resolve()
    seen: set[Path] = set()
    queue = [script]
    while queue:
        path = queue.pop()
        if path not in seen:
            seen.add(path)
            queue += _imports(path)
    return [script, *sorted(seen - {script}, key=_name)]


def _is_module(path: Path) -> bool:
    """Whether a file is part of the package; an installed one also carries the project's scripts."""
    return SOURCE in path.parents and SCRIPTS not in path.parents


def _name(path: Path) -> Path:
    """A file's name in a digest, which says nothing of where the project lies."""
    return path.relative_to(SOURCE) if _is_module(path) else Path(path.name)


@functools.cache
def _imports(path: Path) -> tuple[Path, ...]:
    """Project modules named in any import statement of a file, late imports inside functions included."""
    modules = set()
    for name in syntax_of(path).names:
        parts = name.split(".")
        local = path.parent / f"{parts[0]}.py"
        if parts[0] == PACKAGE:
            modules |= set(_module_files(name))
        elif len(parts) == 1 and local.is_file() and not _is_module(path):
            modules.add(local.resolve())  # a script's neighbour in scripts/
    declared = {STAGES / "table.py", *STAGES.glob("*/__init__.py")}
    return tuple(sorted(modules - {path, SOURCE / PACKAGE / "__init__.py"} - declared))


def _module_files(name: str) -> list[Path]:
    """The module's file and those of the packages that it lies in (importing it runs them)."""
    parts = name.split(".")
    packages = [SOURCE.joinpath(*parts[: end + 1], "__init__.py") for end in range(len(parts))]
    candidates = [SOURCE.joinpath(*parts).with_suffix(".py"), *packages]
    return [path for path in candidates if path.is_file()]


def data_files(modules: list[Path]) -> list[Path]:
    """Tables and templates that lie in the folders of the modules, and in a folder that has the name of a module beside
    it: they decide the result as code does. Of the JavaScript there, that which has the name of a module counts, and
    what it imports from a folder of the latter kind, directly or not."""
    own = [path for path in modules if SOURCE / PACKAGE in path.parent.parents and _is_module(path)]
    beside = {path.parent for path in own}
    named = {path.with_suffix("") for path in own if path.with_suffix("").is_dir()}
    files = {
        item
        for folder in beside | named
        for item in folder.iterdir()
        if item.is_file() and item.suffix not in (".py", ".md")
    }
    scripts = {item for item in files if item.suffix == ".js"}
    entries = [item for item in scripts if item.with_suffix(".py") in own]
    imported = {item for entry in entries for item in modules_of(entry, sorted(named))}
    return sorted((files - scripts) | (scripts & imported))


@functools.cache
def library_version(name: str) -> str:
    """Installed version of a library, `absent` where it is not installed (an optional one)."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def file_digest(path: Path) -> str:
    """SHA-256 of a file, 64 hexadecimal digits."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def truth_digest(path: Path) -> str:
    """Digest of a truth: of a file, of a folder's manifest, or of all files of a folder without one.

    Raises UserError where there is none.
    """
    if path.is_file():
        return file_digest(path)
    if not path.is_dir():
        raise UserError(f"{path}: truth not found; correct the column truth of the scene table, or leave it empty")
    manifest = path / "manifest-sha256.txt"
    if manifest.is_file():
        return file_digest(manifest)
    files = {item.relative_to(path).as_posix(): file_digest(item) for item in sorted(path.rglob("*")) if item.is_file()}
    return hashlib.sha256(canonical(files).encode()).hexdigest()
