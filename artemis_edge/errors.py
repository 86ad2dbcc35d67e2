"""What a user is told: one sentence that says what is wrong and what to do."""

from __future__ import annotations


class UserError(Exception):
    """A fault the user can mend. The command line prints the sentence and ends with ``exit_code``."""

    exit_code = 1


class InputError(UserError):
    """Bad usage or bad input: nothing was done. Exit code 2."""

    exit_code = 2


class RunError(UserError):
    """The work began and could not be finished; what was done so far is kept. Exit code 1."""
