"""One stage by name, as the workflow or a person calls it: `python scripts/stage.py NAME --help`."""

import sys
from importlib import import_module
from importlib.util import find_spec

from nishiki.artifacts.stage import run_stage


def main() -> None:
    """Arguments in, one artifact out; the first argument names the stage."""
    arguments = sys.argv[1:]
    name = arguments[0] if arguments else ""
    if not name.isidentifier() or find_spec(f"nishiki.stages.{name}") is None:
        from nishiki.stages.table import NAMES

        print(
            f"nishiki: unknown stage {name!r}; usage: stage.py NAME --help. Stages: {', '.join(NAMES)}", file=sys.stderr
        )
        raise SystemExit(2)
    declared = import_module(f"nishiki.stages.{name}.declaration").STAGE
    module = import_module(f"nishiki.stages.{name}.run")
    run_stage(
        declared.settings,
        module.run,
        module.__doc__,
        arguments=arguments[1:],
        digest_of_capture=getattr(module, "digest_of_capture", None),
    )
