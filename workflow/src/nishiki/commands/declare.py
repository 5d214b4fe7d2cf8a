"""Declare commands, the options that several of them share, and the completion of scene names."""

from collections.abc import Callable, Iterable
from pathlib import Path

import click

from nishiki.errors import UserError, require
from nishiki.installation import COMMAND, PROFILES, install_extras

CONFIGURATION = "config/config.yaml"


class Command(click.Command):
    """A command whose help ends with examples: the words behind the program's name, one example a string."""

    def __init__(self, *arguments, examples: tuple[str, ...] = (), **settings):
        super().__init__(*arguments, **settings)
        self.examples = examples

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options below their headings; of a group also its commands."""
        rows: dict[str, list] = {}
        for each in self.get_params(ctx):
            record = None if isinstance(each, click.Argument) else each.get_help_record(ctx)
            if record:
                rows.setdefault(getattr(each, "heading", "Options"), []).append(record)
        for heading, records in rows.items():
            with formatter.section(heading):
                formatter.write_dl(records)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the epilog as it stands, then the examples."""
        if self.epilog:
            formatter.write("\n" + self.epilog.strip("\n") + "\n")
        if self.examples:
            with formatter.section("Examples"):
                formatter.write("".join(f"  {COMMAND} {words}\n" for words in self.examples))


class Group(Command, click.Group):
    """Commands below a command, such as `rig run`."""

    command_class = Command
    sections: dict[str, Iterable[str]] | None = None

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, then the commands by section, each with the first sentence of its help."""
        super().format_options(ctx, formatter)
        for title, names in (self.sections or {"commands": self.list_commands(ctx)}).items():
            with formatter.section(title.capitalize()):
                rows = [(name, require(self.get_command(ctx, name)).get_short_help_str(200)) for name in names]
                formatter.write_dl(rows, col_max=14)


def command(*examples: str, **settings) -> Callable[[Callable], Command]:
    """Declare a command on the function that runs it; its docstring is the help.

    passed_on=True: options that are not known are kept, in order, among the arguments.
    """
    context = {"max_content_width": 100, "show_default": True}
    if settings.pop("passed_on", False):
        context |= {"ignore_unknown_options": True}
    return click.command(cls=Command, examples=examples, context_settings=context, **settings)


class Option(click.Option):
    """An option that stands below a heading of its own in the help."""

    def __init__(self, *arguments, heading: str = "Options", **settings):
        super().__init__(*arguments, **settings)
        self.heading = heading


def option(spelling: str, text: str, name: str = "", **settings) -> Callable[[Callable], Callable]:
    """Declare an option from its spelling: `--cores N`, `--turn one|another`, or `--quick`, which is a flag.

    name: parameter of the function that gets the value, where it is not the option's.
    """
    written, _, value = spelling.partition(" ")
    if "|" in value:
        settings["type"] = click.Choice(value.split("|"))
    elif value:
        settings["metavar"] = value
    else:
        settings["is_flag"] = True
    names = (*written.split("/"), *([name] if name else []))
    return click.option(*names, cls=Option, help=text, **settings)


def apply(*decorators: Callable) -> Callable[[Callable], Callable]:
    """Join declarations of options into one, in their order."""

    def join(function: Callable) -> Callable:
        for each in reversed(decorators):
            function = each(function)
        return function

    return join


def cores(context: click.Context, parameter: click.Parameter, text: str | None) -> str | None:
    """Check a number of processors."""
    if text not in (None, "all") and not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise click.BadParameter(f"expected a number of processors from 1, or all, found {text!r}")
    return text


def names_of_scenes(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the name of a scene from the scene table."""
    from nishiki.engine.project import load_project
    from nishiki.errors import UserError

    try:
        scenes = load_project(path=Path(context.params.get("configfile") or CONFIGURATION)).scenes
    except (UserError, OSError):
        return []
    return [name for name in scenes if name.startswith(incomplete)]


with_configuration = option("--configfile FILE", "configuration", default=CONFIGURATION)
with_cores = option("--cores N", "processors to use (default: all)", callback=cores)
with_profile = option("--profile NAME", "slurm for a cluster, or a folder with Snakemake's options", default="default")
with_gone = option(
    "--host-is-gone HOST", "a machine whose unfinished runs have certainly ended (repeatable)", "gone", multiple=True
)
with_json = option("--json", "print one JSON object per line", "as_json")
scene_argument = click.argument("scene", shell_complete=names_of_scenes, help="name of a scene")
any_scene_argument = click.argument(
    "scene", required=False, shell_complete=names_of_scenes, help="name of a scene (default: all)"
)


def profile_arguments(name: str, cores: str | None, scenes: Iterable[Iterable[Path]] = ()) -> list[str]:
    """Return Snakemake's arguments for a shipped profile or a profile folder, with the machine's share of a local one.

    scenes: manifests of each scene's artifacts, where stages may get one thread each so that scenes run side by side.

    Raises UserError where there is no such profile, or where the plugin that it needs is not installed.
    """
    import importlib.util

    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import memory_arguments, thread_arguments

    folder = profile_folder(name)
    if not (folder / "config.yaml").is_file():
        known = ", ".join(sorted(path.name for path in PROFILES.iterdir()))
        raise UserError(f"--profile {name}: no such profile; known: {known}, or a folder that holds a config.yaml")
    options, arguments = load_yaml(folder / "config.yaml"), ["--workflow-profile", str(folder)]
    if name == "default":  # Snakemake would name the profile on the screen
        arguments = ["--workflow-profile", "none"]
        for key, value in options.items():
            arguments += [f"--{key}"] if value is True else [f"--{key}", str(value)]
    executor = str(options.get("executor", "local"))
    if executor != "local":
        plugin = f"snakemake_executor_plugin_{executor.replace('-', '_')}"
        if importlib.util.find_spec(plugin) is None:
            remedy = install_extras(executor)
            raise UserError(f"--profile {name}: the plugin for {executor} is not installed. Remedy: {remedy}")
        return arguments + (["--cores", cores] if cores else [])
    return [*arguments, *memory_arguments(), *thread_arguments(cores, scenes), "--cores", cores or "all"]


def profile_folder(name: str) -> Path:
    """Return the folder of a shipped profile, or the folder that is named."""
    return PROFILES / name if (PROFILES / name).is_dir() else Path(name)
