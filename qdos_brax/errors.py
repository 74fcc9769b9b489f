"""The one exception that is a user's to mend."""

from __future__ import annotations


class UserError(Exception):
    """Bad input: a file, a flag, a shape, a value.

    The message is one line that names the cause and the mend. The command line prints it and exits with code 2;
    a library caller may catch it.
    """
