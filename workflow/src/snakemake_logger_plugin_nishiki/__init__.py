"""Snakemake's logger plugin for `./nishiki run`: one line a finished stage, and on a terminal one live line below.

Snakemake finds the package by its name on the module path. The handler shows what a user has to know; everything else
that Snakemake says stands in its log file.
"""

from dataclasses import dataclass, field

from snakemake_interface_logger_plugins.settings import LogHandlerSettingsBase

from snakemake_logger_plugin_nishiki.handler import RunHandler


@dataclass
class LogHandlerSettings(LogHandlerSettingsBase):
    """Options of the handler on Snakemake's command line: `--logger-nishiki-...`."""

    expected: str = field(
        default="",
        metadata={"help": "JSON: scenes, finished (numbers), seconds (expected processor seconds of a job, by rule)"},
    )
    failures: int = field(
        default=-1, metadata={"help": "descriptor of an open file that gets one JSON object a failed job; -1: none"}
    )


class LogHandler(RunHandler):
    """The handler under the name that Snakemake looks for."""
