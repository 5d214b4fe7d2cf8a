"""Imported first by every script, before any library. From then on an interrupt is reported in one line.

It also makes the package importable, and keeps compiled kernels of different code apart.
"""

import hashlib
import os
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
if (PROJECT / "workflow" / "src").is_dir():  # a checkout; an installed package is on the path
    sys.path.insert(0, str(PROJECT / "workflow" / "src"))

from nishiki.installation import PACKAGE, cache_folder  # noqa: E402


def _report(kind, error, trace) -> None:
    """Report an interrupt during the imports in one line, like a later one; leave anything else to Python."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _report


def use_kernel_cache() -> None:
    """Give this state of the package's compiled modules its own folder of kernels.

    numba renews a cached function when the function's own file changes, but not when a function that it inlines from
    another file does: an edit would rerun a stage with the old machine code.
    """
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", "nishiki.kernel_cache.ByModule,UserProvidedCacheLocator")
    folder = None if "NUMBA_CACHE_DIR" in os.environ else cache_folder()
    if folder is None:
        return
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_bytes()
        if b"numba" in text:
            digest.update(text)
    kernels = folder / digest.hexdigest()[:12]
    os.environ["NUMBA_CACHE_DIR"] = str(kernels)
    if not kernels.is_dir():
        kernels.mkdir(parents=True, exist_ok=True)
        text = "nishiki: compiling kernels, each at its first use; the first run takes a minute or two longer"
        print(text, file=sys.stderr, flush=True)


use_kernel_cache()
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # numba's threads sleep between kernels; by default they spin
