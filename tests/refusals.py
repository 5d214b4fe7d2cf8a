"""Expected refusals: class and kind of an error, the names and figures in its message, but not its sentence."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def refused(
    error: type[BaseException], *facts: object, kind: str | None = None, by: str | None = None
) -> Iterator[pytest.ExceptionInfo]:
    """Expect an error whose message has these facts: files, settings, values, figures.

    kind: of one of its problems; by: name of the function that refuses, where the message alone does not tell.
    """
    with pytest.raises(error) as caught:
        yield caught
    if kind is not None:
        assert kind in {problem.kind for problem in caught.value.problems}
    if by is not None:
        assert by in {entry.frame.code.raw.co_name for entry in caught.traceback}
    expect_facts(str(caught.value), *facts)


def expect_facts(text: str, *facts: object) -> None:
    """Expect each of some names and figures in a text, as whole words."""
    missing = [fact for fact in map(str, facts) if not re.search(rf"(?<!\w){re.escape(fact)}(?!\w)", text)]
    assert not missing, text
