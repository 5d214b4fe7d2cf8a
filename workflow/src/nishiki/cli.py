"""Parse the command line and run its command. A command is declared on the function that runs it."""

import importlib
import os
import sys

import click

from nishiki.commands.declare import Group
from nishiki.errors import UserError, describe_machine_error
from nishiki.installation import COMMAND, use_kernel_cache
from nishiki.version import PROJECT_VERSION

SECTIONS = {
    "first steps": {"demo": "running", "init": "project", "run": "running", "status": "project", "view": "results"},
    "photographs and captures": {
        "convert": "capturing",
        "check": "capturing",
        "seal": "capturing",
        "add": "project",
        "rig": "capturing",
        "calibrate": "calibrate",
        "simulate": "running",
    },
    "results": {
        "plan": "inspecting",
        "explain": "inspecting",
        "export": "results",
        "pack": "archiving",
        "verify": "archiving",
    },
    "campaigns": {"table": "results", "sweep": "results", "prune": "archiving"},
    "maintenance": {
        "install": "project",
        "test": "project",
        "compile": "project",
        "schema": "inspecting",
        "completion": "project",
    },
}
"""Commands by section of the help, each with the module of `nishiki.commands` that declares it."""
MODULES = {name: module for section in SECTIONS.values() for name, module in section.items()}


class Commands(Group):
    """All commands; a module is imported when one of its commands is wanted."""

    sections = SECTIONS

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the help."""
        return list(MODULES)

    def get_command(self, ctx: click.Context, name: str) -> click.Command:
        """Return a command. Raises NoSuchCommand with the names that are like it."""
        if name not in MODULES:
            raise click.exceptions.NoSuchCommand(name, possibilities=MODULES, ctx=ctx)
        module = importlib.import_module(f"nishiki.commands.{MODULES[name]}")
        return next(each for each in vars(module).values() if isinstance(each, click.Command) and each.name == name)


commands = Commands(
    name=COMMAND,
    help="Turn photographs under controlled light into the appearance of an object, with provenance.",
    examples=(
        "demo                    simulate a painting, digitise it, write the report",
        "run my-photographs/     convert a folder of photographs, check it, digitise it",
        "run                     digitise every scene of config/scenes.tsv",
        "run --help              options of a command; so for every other one",
    ),
    context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]},
)
click.version_option(PROJECT_VERSION, message="nishiki %(version)s", help="Print the version.")(commands)


def main(arguments: list[str] | None = None) -> None:
    """Parse and run. Exit status 0: done; 1: a stage failed or damage was found; 2: bad input, told in one line."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if "_NISHIKI_COMPLETE" in os.environ:
        commands.main(words, prog_name="nishiki")
    use_kernel_cache()
    name = " ".join(["nishiki", *(word for word in words[:1] if word in MODULES)])
    try:
        with commands.make_context(COMMAND, words) as context:
            raise SystemExit(commands.invoke(context) or 0)
    except click.exceptions.Exit as ended:
        raise SystemExit(ended.exit_code) from None
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message())
        raise SystemExit(2) from None
    except click.UsageError as error:
        print(
            f"{name}: {error.format_message()} See {error.ctx.command_path if error.ctx else COMMAND} --help",
            file=sys.stderr,
        )
        raise SystemExit(2) from None
    except UserError as error:
        # Remedies name the launcher of a checkout; an installed package has the command instead.
        print(f"{name}: {str(error).replace('./nishiki ', f'{COMMAND} ')}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        raise SystemExit(0) from None
    except (KeyboardInterrupt, click.Abort):
        print(f"{name}: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except OSError as error:
        message = describe_machine_error(error)
        if message is None:
            raise
        print(f"{name}: {message}", file=sys.stderr)
        raise SystemExit(2) from None
