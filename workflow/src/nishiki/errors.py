"""Mistakes that a user can mend, as distinct from bugs."""

import re

UNSEEN = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


class UserError(Exception):
    """Bad input: the message says what was expected, what was found, where, and what to do.

    The command line prints it on one line without a traceback and exits with status 2.
    """

    def __str__(self) -> str:
        return "\n".join(printable(line) for line in super().__str__().split("\n"))


def printable(text: str) -> str:
    """The text with control characters, changes of direction and halves of surrogates escaped.

    Names of files come from strangers: a terminal would obey some of them, and UTF-8 has no place for others.
    """
    return UNSEEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
