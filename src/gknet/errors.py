"""The one exception that the user is meant to read."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


class GknetError(Exception):
    """Bad input or a missing piece. The message is one line: what, what was expected, what came, the remedy.

    The command line prints it without a traceback and exits with code 2.
    """


class DivergedError(GknetError):
    """The loss of a training is no longer a number."""


class MissingExtraError(GknetError):
    """An optional part of gknet is needed that is not installed.

    Args:
        extra: Name of the extra.
        module: What could not be imported.
    """

    def __init__(self, extra: str, module: str) -> None:
        super().__init__(f"this needs the module '{module}': {install_words(extra)}")


def install_words(extra: str) -> str:
    """How an extra is installed, in a clone of the repository and elsewhere."""
    return f"install the extra '{extra}': pip install '.[{extra}]' in a clone, else pip install 'gknet[{extra}]'"


@contextmanager
def ends_in_one_line() -> Iterator[None]:
    """For scripts: a GknetError becomes one line on standard error and exit code 2."""
    try:
        yield
    except GknetError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from error
