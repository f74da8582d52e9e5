"""Files that are either whole or absent: written under a temporary name in their folder, then renamed.

A temporary name is hidden and random, so writers on other hosts of a shared folder never meet, and what a killed writer
left behind never stands in anybody's way.
"""

from __future__ import annotations

import os
import re
import secrets
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_NAME_CHARACTERS = 40
"""Of the file's own name in a temporary one: at most 160 bytes, so a name that is legal for a file always is."""


@contextmanager
def replacing(
    path: str | Path, keep_suffix: bool = False, keep_on_error: Callable[[], bool] = lambda: False
) -> Iterator[Path]:
    """A temporary file beside `path` that takes its place when the `with` block ends.

        with replacing(path) as temporary:
            temporary.write_bytes(data)

    Args:
        path: The file to write. Its folder exists; a file of that name is replaced.
        keep_suffix: End the temporary name as `path` ends, for writers that choose a format by the suffix.
        keep_on_error: Called when the block ends with an exception: whether the file is renamed then too. Otherwise it
            is removed.

    Yields:
        The path of an empty file with the permissions that the process's umask gives.

    Raises:
        OSError: The file cannot be made or renamed. The error names `path`, not the temporary file.
    """
    path = Path(path)
    ending = path.suffix if keep_suffix else ""
    temporary = path.with_name(f".{path.name[:_NAME_CHARACTERS]}.{secrets.token_hex(8)}.tmp{ending}")
    with naming(path):
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        with naming(path, temporary):
            yield temporary
    except BaseException:
        if keep_on_error():
            _rename(temporary, path)
        else:
            temporary.unlink(missing_ok=True)
        raise
    _rename(temporary, path)


def _rename(temporary: Path, path: Path) -> None:
    try:
        with naming(path):
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def stale_temporaries(folder: str | Path, name: str | None = None) -> list[Path]:
    """Temporary files in a folder that killed writers left behind.

    Args:
        folder: Where to search, without its sub-folders. The caller holds the folder's lock; otherwise a file may
            belong to a writer at work.
        name: Only those for a file of this name.
    """
    start = "" if name is None else re.escape(name[:_NAME_CHARACTERS])
    pattern = re.compile(rf"\.{start}{'.*' if name is None else ''}\.[0-9a-f]{{16}}\.tmp(\.\w+)?", re.DOTALL)
    return sorted(path for path in Path(folder).glob(".*") if pattern.fullmatch(path.name) and path.is_file())


@contextmanager
def output_folder(folder: str | Path) -> Iterator[Path]:
    """A folder to write into, made where it is absent; one that it made is removed again when it stays empty.

    Raises:
        OSError: The folder cannot be made, or no file can be written into it. Better now than after an hour.
    """
    folder = Path(folder)
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with naming(folder), tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"x")
        yield folder
    finally:
        if is_new:
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def naming(path: str | Path, instead_of: Path | None = None) -> Iterator[None]:
    """An OSError in the `with` block that names no file names `path`; one of `instead_of` names `path` instead."""
    try:
        yield
    except OSError as error:
        unnamed = error.filename is None or instead_of is None or Path(os.fsdecode(error.filename)) == instead_of
        if error.errno is None or not unnamed:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` to `path`; a crash, or another writer of the same path, never leaves a half-written file.

    Raises:
        OSError: It cannot be written; the error names `path`.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8, see `write_bytes`. What UTF-8 lacks (lone surrogates) becomes a backslash escape."""
    write_bytes(path, text.encode("utf-8", errors="backslashreplace"))
