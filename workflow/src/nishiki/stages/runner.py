"""Run one stage by name, for the workflow or a person: `python scripts/stage.py NAME --help`."""

import argparse
import gc
import sys
import traceback
import warnings
from importlib import import_module

from nishiki.artifacts.provenance import STAGES, module_of, program_of
from nishiki.artifacts.stage import run_stage
from nishiki.stages.base import declaration_of


def main() -> None:
    """Make one artifact from the arguments, the first of which names the stage.

    A bug ends with exit status 1 and a traceback, whose last line names the scene and the stage.
    """
    arguments = sys.argv[1:]
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help"):
        print(_usage())
        return
    if not name.isidentifier() or program_of(name).parent.parent != STAGES:
        print(f"nishiki: unknown stage {name!r}. {_usage()}", file=sys.stderr)
        raise SystemExit(2)
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--scene", default="")
    scene = parser.parse_known_args(arguments[1:])[0].scene
    who = f"{scene}/{name}" if scene else name
    warnings.formatwarning = lambda text, category, file, line, source=None: (
        f"nishiki {who}: warning: {category.__name__}: {' '.join(str(text).split())} ({file}:{line})\n"
    )
    try:
        declared = declaration_of(name)
        module = import_module(f"nishiki.stages.{module_of(name)}")
        if kernels := sys.modules.get("nishiki.kernel_cache"):
            kernels.Announcement.message = f"{who}: compiling kernels for their first use"
        gc.freeze()
        gc.enable()
        run_stage(
            declared.settings,
            module.run,
            module.__doc__ or "",
            arguments=arguments[1:],
            digest_of_capture=getattr(module, "digest_of_capture", None),
            stands_for=declared.stands_for,
        )
    except Exception as error:
        print(_bug(who, error), file=sys.stderr)
        raise SystemExit(1) from None


def _usage() -> str:
    from nishiki.stages.table import NAMES

    return f"usage: stage.py NAME --help. Stages: {', '.join(NAMES)}"


def _bug(who: str, error: Exception) -> str:
    """Format the traceback of an error, and the error itself on one line."""
    *above, last = traceback.format_exception(error)
    message = " ".join(last.split())
    return "".join(above) + f"nishiki {who}: {message}"
