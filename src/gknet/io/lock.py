"""A lock on an output folder, so that two runs never write into it at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gknet.errors import GknetError

LOCK_NAME = ".gknet.lock"


@contextmanager
def locked(folder: str | Path, wait_s: float = 0.0) -> Iterator[None]:
    """Hold the folder's lock in the `with` block; the system frees it when the process ends, however it ends.

    Args:
        folder: An existing folder. The empty file `.gknet.lock` in it carries the lock.
        wait_s: Seconds to wait for another process that holds it.

    Raises:
        GknetError: Another process holds the lock.
        OSError: The folder cannot be written.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(Path(folder) / LOCK_NAME)
    try:
        lock.acquire(timeout=wait_s)
    except Timeout as error:
        raise GknetError(
            f"{folder}: another gknet command is writing into this folder; wait for it, or choose another folder"
        ) from error
    try:
        yield
    finally:
        lock.release()
