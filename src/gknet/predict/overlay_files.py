"""Overlay images and the overlay video of a run. What cannot be written is counted, and costs nothing else."""

from __future__ import annotations

import hashlib
import os
import re
import sys
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path

from jaxtyping import UInt8
from numpy import ndarray

from gknet.io.image import write_image
from gknet.io.opencv import quiet
from gknet.io.text import counted, printable
from gknet.io.video import VideoWriter

_NAME_BYTES = 200
"""Of a file's name, which may have 255 on most file systems."""

_FORBIDDEN = re.compile(r'[/\\:*?"<>|]')
"""Characters that a file's name cannot have on some system."""


@dataclass
class Losses:
    """What could not be written.

    Attributes:
        what: What is counted, in the singular.
        count: How many were lost.
        first: The first one and why.
    """

    what: str
    count: int = 0
    first: str = ""

    def note(self, name: str, error: Exception) -> None:
        """Count one."""
        self.first = self.first or f"{name}: {str(error) or type(error).__name__}"
        self.count += 1

    @property
    def sentence(self) -> str | None:
        """For the user; None when nothing was lost."""
        words = counted(self.count, self.what)
        return f"{words} could not be written; the first, {self.first}" if self.count else None


@dataclass
class OverlayNames:
    """File names of overlays, one for each image: two images of a run never share one.

    The same images in the same order have the same names in every run.
    """

    _used: set[str] = field(default_factory=set)

    def name_for(self, picture: str) -> str:
        """The file name for an image: folders become part of it, the suffix becomes .jpg.

        Where another image has that name, the suffix is kept before .jpg, and then a number follows.
        """
        whole = _for_file_system(_FORBIDDEN.sub("_", printable(picture)))
        wanted = chain([os.path.splitext(whole)[0], whole], (f"{whole}-{number}" for number in count(2)))
        stem = next(stem for name in wanted if (stem := _short(name)).casefold() not in self._used)
        self._used.add(stem.casefold())
        return f"{stem}.jpg"


def _for_file_system(name: str) -> str:
    """The name, with an underscore for each character that this system's file names cannot hold."""
    encoding = sys.getfilesystemencoding()
    return name.encode(encoding, "replace").decode(encoding).replace("?", "_")


def _short(name: str) -> str:
    """A name that every file system takes: of a long one a hash of the whole and its end."""
    if len(name.encode("utf-8")) <= _NAME_BYTES:
        return name
    end = name.encode("utf-8")[-_NAME_BYTES + 20 :].decode("utf-8", errors="ignore")
    return f"{hashlib.sha256(name.encode('utf-8')).hexdigest()[:12]}_{end}"


@dataclass
class OverlayFolder:
    """Writes overlays/<name>.jpg."""

    folder: Path
    names: OverlayNames = field(default_factory=OverlayNames)
    losses: Losses = field(default_factory=lambda: Losses("overlay"))

    def write(self, name: str, picture: UInt8[ndarray, "h w 3"]) -> None:
        """Write the overlay of an image, or count it as lost."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with quiet():
                write_image(self.folder / self.names.name_for(name), picture)
        except Exception as error:  # whatever goes wrong with an overlay costs no pose
            self.losses.note(name, error)


@dataclass
class OverlayVideo:
    """Writes overlay.mp4. A frame that the codec refuses ends the video, and the frames before it are kept."""

    path: Path
    fps: float
    losses: Losses = field(default_factory=lambda: Losses("video frame"))
    _writer: VideoWriter | None = None

    def write(self, name: str, picture: UInt8[ndarray, "h w 3"]) -> None:
        """Append a frame, or count it as lost."""
        try:
            if self._writer is None:
                self._writer = VideoWriter(self.path, self.fps).__enter__()
            with quiet():
                self._writer.write(picture)
        except Exception as error:  # whatever goes wrong with the video costs no pose
            self.losses.note(name, error)

    def close(self) -> None:
        """Complete the file; one that cannot be completed is counted as lost with all its frames."""
        writer, self._writer = self._writer, None
        if writer is None or writer.count == 0:
            return
        try:
            with quiet():
                writer.__exit__(None, None, None)
        except Exception as error:
            self.losses.note(self.path.name, error)
            self.losses.count += writer.count - 1
