"""What OpenCV needs around it: silence on standard error, and file names that it can take."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from gknet.errors import GknetError

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
"""FFmpeg's messages are for its developers; a GknetError states what is wrong. -8 is its word for silence."""


@contextmanager
def quiet() -> Iterator[None]:
    """OpenCV prints nothing in the `with` block; what is wrong is stated by a GknetError."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)


def checked_file(path: Path, what: str) -> os.stat_result:
    """The state of a regular file; anything else is refused: a pipe or a device could block, or never end."""
    try:
        found = path.stat()
    except FileNotFoundError as error:
        raise GknetError(f"{path}: no such {what}") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the path
        raise GknetError(f"{path}: the {what} cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe or a device; save its content to a file"
        raise GknetError(f"{path}: no such {what}; it is {kind}")
    return found


@contextmanager
def utf8_path(path: Path) -> Iterator[str]:
    """An absolute path that OpenCV can take; it crashes on a name that is not UTF-8, so such a file gets a link.

    The name "a:b.mp4" would be taken for a URL of the protocol "a", and an absolute path is not.
    """
    absolute = path.absolute()
    try:
        str(absolute).encode("utf-8")
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder) / f"link{absolute.suffix.encode('ascii', 'ignore').decode()}"
            link.symlink_to(absolute)
            yield str(link)
    else:
        yield str(absolute)
