"""YAML as plain data: no tags, no anchors, bounded in size, depth and number of values.

An alias stands for its anchor's whole content: nine lists of nine aliases each unfold to 387 million values wherever
the result is printed or checked ("billion laughs"). Nothing in a capture or a configuration needs one.
"""

from typing import Any

import yaml

from nishiki.formats.files import bound

LONGEST_BITS = 1024  # of a whole number
SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NotPlain(yaml.MarkedYAMLError):
    """YAML that is not plain data, or too much of it."""


def load(text: str, loader: type = SafeLoader) -> Any:
    """Parse a YAML text. yaml.YAMLError where it is not plain YAML: `problem` says why, `problem_mark` where.

    loader: a safe loader of the YAML library, or one derived from it.
    """
    try:
        _look_through(text)
        content = yaml.load(text, Loader=loader)
        _expect_numbers(content)
        return content
    except (ValueError, OverflowError, RecursionError, TypeError) as error:
        # dates and numbers that do not exist (2024-13-45, an integer of 5000 digits), texts that are not Unicode
        raise NotPlain(None, None, str(error)[:200] or type(error).__name__, None) from None


def _expect_numbers(content: Any) -> None:
    """ValueError for whole numbers too long to be written out (Python refuses to), which hexadecimal ones can be."""
    pending = [content]
    while pending:
        value = pending.pop()
        if isinstance(value, int) and value.bit_length() > LONGEST_BITS:
            raise ValueError(f"a whole number of {value.bit_length()} bits")
        if isinstance(value, dict):
            pending += [*value.keys(), *value.values()]
        elif isinstance(value, list):
            pending += value


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
        if depth > bound("settings_depth"):
            problem = f"nested more than {bound('settings_depth')} levels deep"
        if values > 2 * bound("settings_values"):
            problem = f"more than {bound('settings_values')} values"
        if problem:
            raise NotPlain(None, None, problem, event.start_mark)
