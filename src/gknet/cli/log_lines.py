"""What the library logs, as lines on standard output while a command runs."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from gknet.cli.terminal import print_line


class _LineHandler(logging.Handler):
    """One line a record."""

    def emit(self, record: logging.LogRecord) -> None:
        print_line(" ".join(self.format(record).split()))


@contextmanager
def log_lines(level: int = logging.INFO) -> Iterator[None]:
    """Show the records of the logger "gknet" and its children from `level` on."""
    logger, handler = logging.getLogger("gknet"), _LineHandler()
    before = logger.level, logger.propagate
    logger.setLevel(level)
    logger.propagate = False
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.level, logger.propagate = before
