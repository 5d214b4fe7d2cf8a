"""Imported first by every script, before any library. From then on an interrupt is reported in one line.

It also makes the package importable, and keeps compiled kernels of different code apart.
"""

import os
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
if (PROJECT / "workflow" / "src").is_dir():  # a checkout; an installed package is on the path
    sys.path.insert(0, str(PROJECT / "workflow" / "src"))

from nishiki.installation import use_kernel_cache  # noqa: E402


def _report(kind, error, trace) -> None:
    """Report an interrupt during the imports in one line, like a later one; leave anything else to Python."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _report


use_kernel_cache()
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # numba's threads sleep between kernels; by default they spin
