"""YAML as plain data: no tags, no anchors, bounded in size, depth and number of values.

An alias stands for its anchor's whole content: nine lists of nine aliases each unfold to 387 million values wherever
the result is printed or checked ("billion laughs"). Nothing in a capture or a configuration needs one.
"""

import re
from typing import Any

import yaml

from nishiki.formats.files import bound

LONG_NUMBER = re.compile(r"[-+]?[0-9][xb]?[0-9a-f_:]{256,}", re.IGNORECASE)
"""Whole numbers in notations that Python reads in any length, and which it refuses to write out."""
SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NotPlain(yaml.MarkedYAMLError):
    """YAML that is not plain data, or too much of it."""


def load(text: str, loader: type = SafeLoader) -> Any:
    """Parse a YAML text. yaml.YAMLError where it is not plain YAML: `problem` says why, `problem_mark` where.

    loader: a safe loader of the YAML library, or one derived from it.
    """
    try:
        _look_through(text)
        return yaml.load(text, Loader=loader)
    except (ValueError, OverflowError, RecursionError, TypeError) as error:
        # dates and numbers that do not exist (2024-13-45, an integer of 5000 digits), texts that are not Unicode
        raise NotPlain(None, None, str(error)[:200] or type(error).__name__, None) from None


def _look_through(text: str) -> None:
    """Every event of the parser, before anything is built from them."""
    depth = values = 0
    for event in yaml.parse(text, Loader=SafeLoader):
        values += 1
        problem = ""
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            problem = "anchors (&) and aliases (*) are not used"
        elif getattr(event, "tag", None) not in (None, "!"):
            problem = "tags (!) are not used"
        elif isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.ScalarEvent):
            event.value.encode()  # a lone half of a surrogate pair is no text
            problem = f"a number of about {4 * len(event.value)} bits" if LONG_NUMBER.fullmatch(event.value) else ""
        if depth > bound("settings_depth"):
            problem = f"nested more than {bound('settings_depth')} levels deep"
        if values > 2 * bound("settings_values"):
            problem = f"more than {bound('settings_values')} values"
        if problem:
            raise NotPlain(None, None, problem, event.start_mark)
