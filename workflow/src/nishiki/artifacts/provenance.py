"""Compute stage keys and code digests, which decide whether a stage has to run.

Parsing all modules of the project takes seconds, at every start and in every job of a cluster. The syntax and imports
of a file depend on its bytes alone (and on the version of Python, whose trees differ), so they are kept under the
SHA-256 of these bytes in `.kernels` (of an installation: in the user's cache), beside the compiled kernels. Where
nothing may be written, files are parsed each time.

The key of a stage is the start of the SHA-256 of a canonical text of everything that decides its result, apart from the
code: stage name and format version, exactly the settings that it reads, and the keys of its upstream artifacts.
The code digest covers the syntax trees of the stage's program and of every module of this project that it imports,
directly or not, without comments and docstrings; declarations of stages are left out, because the settings stand in the
key as values, and costs, texts and limits change no byte of a result. So is the package's own `__init__.py`, which only
names what users call. Tables and templates beside these modules count too, and of the JavaScript of pages the modules
that the stage's own page is built from. Modules go by their names below the package and scripts by theirs, so that the
digests of a checkout and of an installed package are the same.
"""

import ast
import atexit
import functools
import hashlib
import importlib.metadata
import json
import math
import os
import re
import sys
import unicodedata
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from nishiki.errors import UserError
from nishiki.installation import SCRIPTS, SOURCE, cache_folder

MOST = 5000
"""Most entries that are kept; beyond it only those of the present files are kept."""


class Syntax(NamedTuple):
    """tree: SHA-256 of the syntax tree without docstrings; names: every module, and every name from one, imported."""

    tree: str
    names: tuple[str, ...]


@functools.cache
def syntax_of(path: Path) -> Syntax:
    """Parse a Python file. Raises SyntaxError."""
    data = path.read_bytes()
    store, name = _store(), hashlib.sha256(data).hexdigest()
    syntax = store.known.get(name)
    if syntax is None:
        tree = ast.parse(data)
        imported: set[str] = set()  # in any import statement, late imports inside functions included
        for node in ast.walk(tree):  # comments are no part of a syntax tree
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                if ast.get_docstring(node, clean=False) is not None:
                    node.body = node.body[1:] or [ast.Pass()]
        tree_text = ast.dump(tree, annotate_fields=False)
        syntax = Syntax(hashlib.sha256(tree_text.encode()).hexdigest(), tuple(sorted(imported)))
    store.used[name] = syntax
    return syntax


class _Store:
    """Cache of syntaxes by the digest of the file."""

    def __init__(self, path: Path | None):
        self.path = path
        self.known: dict[str, Syntax] = {}
        self.used: dict[str, Syntax] = {}
        if path is None:
            return
        with suppress(OSError, ValueError, TypeError, AttributeError):
            entries = json.loads(path.read_bytes())
            self.known = {name: Syntax(str(tree), tuple(names)) for name, (tree, names) in entries.items()}

    def keep(self) -> None:
        """Write what is new."""
        if self.path is None or self.used.keys() <= self.known.keys():
            return
        every = self.known | self.used
        partial = self.path.with_name(f"{self.path.name}.{os.getpid()}")
        with suppress(OSError):
            self.path.parent.mkdir(exist_ok=True)
            partial.write_text(json.dumps(self.used if len(every) > MOST else every))
            partial.rename(self.path)
        with suppress(OSError):
            partial.unlink()


@functools.cache
def _store() -> _Store:
    folder, name = cache_folder(), f"syntax-{sys.version_info.major}.{sys.version_info.minor}.json"
    store = _Store(folder / name if folder else None)
    atexit.register(store.keep)
    return store


IMPORT = re.compile(r'from "viewer/(\w+)";')


def modules_of(entry: Path, folders: Iterable[Path]) -> list[Path]:
    """List the module that a page begins with and its direct and indirect imports from the folders, by name.

    Raises
    ------
    FileNotFoundError
        If an imported module is in none of the folders.
    """
    known = {path.stem: path for folder in folders for path in folder.glob("*.js")}
    modules: set[Path] = set()
    queue = [entry]
    while queue:
        path = queue.pop()
        if path in modules:
            continue
        modules.add(path)
        names = IMPORT.findall(path.read_text(encoding="utf-8"))
        if missing := set(names) - set(known):
            raise FileNotFoundError(f"{path}: imports viewer/{min(missing)}, which is no module of the page")
        queue += [known[name] for name in names]
    return [entry, *sorted(modules - {entry})]


KEY_DIGITS = 12  # hexadecimal: 48 bits
PACKAGE = "nishiki"
STAGES = SOURCE / PACKAGE / "stages"
GEOMETRIES = ("object", "cloth")
"""Prefixes of stages that several geometries have: `object_render` is the module `object` of the package `render`."""


def canonical(value: Any) -> str:
    """Write `value` as canonical JSON: keys sorted, 1 and 1.0 equal, Unicode in NFC, no spaces.

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


UPSTREAM = re.compile(r"([A-Za-z0-9_-]+/)?[a-z_0-9]+")
"""Names of what a stage reads: STAGE of its own scene, or FIELD/STAGE of the scene of a field."""


def scene_of_field(scene: str, field: str) -> str:
    """Return the name of the scene that a field of a mosaic has."""
    return f"{scene}--{field}"


def name_above(scene: str, manifest: Mapping[str, Any]) -> str:
    """Return the name under which a stage of `scene` reads the artifact of a manifest (see `UPSTREAM`)."""
    of, stage = manifest["scene"], manifest["stage"]
    field = of.removeprefix(scene_of_field(scene, ""))
    return stage if field == of else f"{field}/{stage}"


def place_above(scene: str, name: str) -> tuple[str, str]:
    """Return scene and stage of what a stage of `scene` reads under a name (see `UPSTREAM`)."""
    field, _, stage = name.rpartition("/")
    return (scene_of_field(scene, field) if field else scene), stage


def stage_key(stage: str, version: int, settings: dict, upstream: dict[str, str]) -> str:
    """Compute a stage's key: 12 hexadecimal digits. `upstream` maps stages (or `capture`) to their keys or digests."""
    return key_of_text(stage, version, canonical(settings), upstream)


def key_of_text(stage: str, version: int, settings: str, upstream: dict[str, str]) -> str:
    """Compute the key from the canonical text of the settings, which thousands of scenes may share."""
    rest = canonical({"stage": stage, "upstream": upstream, "version": version})
    text = f'{{"settings":{settings},{rest[1:]}'  # canonical text of all four: "settings" is the first in order
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]


def differences(first: dict, second: dict, path: str = "") -> list[str]:
    """List each place where two settings blocks differ, as `place: first -> second`."""
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
    """Return the path of a stage's code below the folder of a checkout, as in a packed crate."""
    return f"workflow/src/{PACKAGE}/stages/{module_of(stage).replace('.', '/')}.py"


def program_of(name: str) -> Path:
    """Return the file that runs a stage of this name; for other names a script of the project."""
    program = STAGES.joinpath(*module_of(name).split(".")).with_suffix(".py")
    return program if program.is_file() else SCRIPTS / f"{name}.py"


def code_digest(script: Path) -> str:
    """Hash the code that a script (or a stage's program) runs.

    It consists of the script, every module of this project that it imports, directly or not, and their tables.
    """
    digest = hashlib.sha256()
    script = Path(script).resolve()
    files = code_files(script)
    for path in files:
        digest.update(f"{_name(path)}\0{syntax_of(path).tree}\0".encode())
    for path in data_files(files):
        digest.update(f"{path.relative_to(SOURCE)}\0{file_digest(path)}\0".encode())
    return digest.hexdigest()[:KEY_DIGITS]


def code_files(script: Path) -> list[Path]:
    """List the script and the project's modules that it imports, directly or not, in a fixed order."""
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
    """Return whether a file is part of the package; an installed one also carries the project's scripts."""
    return SOURCE in path.parents and SCRIPTS not in path.parents


def _name(path: Path) -> Path:
    """Return a file's name in a digest, which is independent of the place of the project."""
    return path.relative_to(SOURCE) if _is_module(path) else Path(path.name)


@functools.cache
def _imports(path: Path) -> tuple[Path, ...]:
    """Project modules named in any import statement of a file, late imports inside functions included."""
    modules = set()
    for name in syntax_of(path).names:
        parts = name.split(".")
        local = path.parent / f"{parts[0]}.py"
        if parts[0] == PACKAGE:
            packages = [
                SOURCE.joinpath(*parts[: end + 1], "__init__.py") for end in range(len(parts))
            ]  # import runs them
            candidates = [SOURCE.joinpath(*parts).with_suffix(".py"), *packages]
            modules |= {path for path in candidates if path.is_file()}
        elif len(parts) == 1 and local.is_file() and not _is_module(path):
            modules.add(local.resolve())  # a script's neighbour in scripts/
    declared = {STAGES / "table.py", *STAGES.glob("*/__init__.py")}
    return tuple(sorted(modules - {path, SOURCE / PACKAGE / "__init__.py"} - declared))


def data_files(modules: list[Path]) -> list[Path]:
    """List the tables and templates that decide results as code does.

    They lie in the folders of the modules, or in a folder named as a module beside it. Of JavaScript there, the file
    named as a module counts, and its direct and indirect imports from a folder of the latter kind.
    """
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
    """Return the installed version of a library, `absent` where an optional one is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


def file_digest(path: Path) -> str:
    """Compute the SHA-256 of a file, 64 hexadecimal digits."""
    with open(path, "rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def truth_digest(path: Path) -> str:
    """Digest a truth: a file, a folder's manifest, or all files of a folder without one.

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
