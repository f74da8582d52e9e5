"""What the commands print, and streams that outlast what becomes of the terminal.

A name from outside may hold anything: lines are printed with `print_line`, which shows control characters as escapes. A
terminal that lacks a character gets an escape. A reader that goes away (`| head`) or a full disk behind the output ends
no work.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TextIO, cast

from gknet.io.text import printable

if TYPE_CHECKING:
    from rich.table import Table


def print_line(text: object) -> None:
    """One line on standard output. `typer.echo` would write past `lasting_output` where the encoding is ASCII."""
    print(printable(text))


def print_warning(text: object) -> None:
    """One line on standard error."""
    print_error(f"warning: {text}")


def print_error(text: str) -> None:
    """A line of gknet's on standard error; nothing where that is closed."""
    if sys.stderr is not None:
        print(f"gknet: {printable(text)}", file=sys.stderr)


def print_table(table: Table) -> None:
    """A table on standard output."""
    from rich.console import Console

    Console().print(table)


class LastingStream:
    """A text stream that goes on as if nothing had happened after a write has failed.

    Attributes:
        failure: The first error of a write; None when every write went well, or when the reader just went away.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_broken = False
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write; after a failure, do nothing."""
        if not self._is_broken:
            try:
                return self._stream.write(text)
            except OSError as error:
                self._give_up(error)
        return len(text)

    def flush(self) -> None:
        """Flush; after a failure, do nothing."""
        if not self._is_broken:
            try:
                self._stream.flush()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self._is_broken = True
        if error.errno not in (errno.EPIPE, errno.EBADF):
            self.failure = error
        with suppress(OSError, ValueError):  # what is still buffered has to go somewhere when Python ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def lasting_output() -> Iterator[LastingStream | None]:
    """Standard output and error as `LastingStream`s that can write every character; the former is yielded."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _lasting(sys.stdout), _lasting(sys.stderr)
    try:
        yield cast(LastingStream | None, sys.stdout)
    finally:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before


def _lasting(stream: TextIO | None) -> Any:
    if stream is None:  # closed by the caller: `>&-`
        return None
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="backslashreplace")
    return LastingStream(stream)
