"""What a source file says, apart from comments, docstrings and layout: digest of its syntax tree, names it imports.

Parsing all modules of the project takes seconds, at every start and in every job of a cluster. Both answers depend on
the file's bytes alone (and on the version of Python, whose trees differ), so they are kept under the SHA-256 of these
bytes in `.kernels` (of an installation: in the user's cache), beside the compiled kernels. Where nothing may be
written, files are parsed each time.
"""

import ast
import atexit
import functools
import hashlib
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from nishiki.installation import cache_folder

MOST = 5000
"""Entries that are kept at most; more are those of edited files, and none is kept then but the present ones."""


class Syntax(NamedTuple):
    """tree: SHA-256 of the syntax tree without docstrings; names: every module, and every name from one, imported."""

    tree: str
    names: tuple[str, ...]


@functools.cache
def syntax_of(path: Path) -> Syntax:
    """Syntax of a Python file. Raises SyntaxError."""
    data = path.read_bytes()
    store, name = _store(), hashlib.sha256(data).hexdigest()
    syntax = store.known.get(name)
    if syntax is None:
        tree = ast.parse(data)
        names = tuple(sorted(_imported(tree)))  # before docstrings go
        syntax = Syntax(hashlib.sha256(_without_docstrings(tree).encode()).hexdigest(), names)
    store.used[name] = syntax
    return syntax


def _imported(tree: ast.Module) -> set[str]:
    """Names in any import statement, late imports inside functions included."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _without_docstrings(tree: ast.Module) -> str:
    """Text of a syntax tree (comments are no part of it)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            if ast.get_docstring(node, clean=False) is not None:
                node.body = node.body[1:] or [ast.Pass()]
    return ast.dump(tree, annotate_fields=False)


class _Store:
    """Syntaxes by the digest of the file, as they were kept, and those of this process."""

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
