"""The one exception whose cause the user can fix."""

from __future__ import annotations


class UserError(Exception):
    """Report bad input: a file, a flag, a shape, a value.

    The message is one line that names the cause and the fix. The command line prints it and exits with code 2;
    a library caller may catch it.
    """
