"""Mistakes that a user can mend, as distinct from bugs."""


class UserError(Exception):
    """Bad input: the message says what was expected, what was found, where, and what to do.

    The command line prints it on one line without a traceback and exits with status 2.
    """
