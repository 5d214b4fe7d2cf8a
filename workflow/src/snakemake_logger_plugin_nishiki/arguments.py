"""Separate options of Snakemake from its targets on a command line."""

from collections.abc import Sequence
from difflib import get_close_matches

from nishiki.errors import UserError
from nishiki.stages.table import NAMES

BESIDE_STAGES = ("all", "publish", "part", "repeat", "sweep")
"""Rules that are not stages."""


def parse_words(words: Sequence[str]) -> list[str]:
    """Return the words that Snakemake takes for targets.

    Raises
    ------
    LookupError
        For an option that Snakemake does not know; its arguments are the option and the options that it knows.
    UserError
        Where Snakemake cannot read the value of an option, or an option names a stage that does not exist.
    """
    from snakemake.cli import get_argument_parser

    def refuse(message: str) -> None:
        raise UserError(f"{message}. Remedy: name scenes first; see ./nishiki run --help and snakemake --help")

    parser = get_argument_parser()
    parser.error = refuse
    options, unknown = parser.parse_known_args(list(words))
    for word in unknown:
        if word.startswith("-"):
            raise LookupError(word.split("=")[0], [name for name in parser._option_string_actions if name[:2] == "--"])
    rules = [*NAMES, *BESIDE_STAGES]
    named = [*options.until, *options.omit_from, *options.forcerun]
    for word in (word for word in named if "/" not in word and word not in rules):
        alike = get_close_matches(word, rules) or NAMES
        refuse(f"no stage {word!r}; expected one of {', '.join(alike)}")
    return [*options.targets, *unknown]
