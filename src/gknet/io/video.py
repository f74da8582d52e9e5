"""Videos in and out: frames of a file with their times, and an .mp4 that appears only when it is whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.errors import GknetError

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
"""FFmpeg's own words on standard error are for its developers; what is wrong is said by a GknetError."""

VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg"})


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """Frame `index` of a video; image is (h, w, 3) uint8 RGB."""

    index: int
    time_s: float
    image: UInt8[ndarray, "h w 3"]


@dataclass(frozen=True)
class Video:
    """A video that can be read. `announced` is the container's own count of frames, which may be an estimate or 0."""

    path: Path
    width: int
    height: int
    fps: float
    announced: int

    def frames(self, every: int = 1) -> Iterator[VideoFrame]:
        """Every `every`-th frame that decodes, in order."""
        capture = cv2.VideoCapture(str(self.path))
        try:
            index = 0
            while capture.grab():
                if index % every == 0:
                    decoded, image = capture.retrieve()
                    if decoded:
                        yield VideoFrame(index, index / self.fps, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
                index += 1
        finally:
            capture.release()


def open_video(path: str | Path) -> Video:
    """Check that a video opens and holds a frame; GknetError otherwise."""
    path = Path(path)
    if not path.is_file():
        raise GknetError(f"{path}: no such video")
    capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise GknetError(f"{path}: not a video that can be read")
        decoded, image = capture.read()
        if not decoded or image is None:
            raise GknetError(f"{path}: a video without frames")
        fps, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    finally:
        capture.release()
    fps = float(fps) if np.isfinite(fps) and fps > 0 else 25.0
    return Video(path, image.shape[1], image.shape[0], fps, max(0, int(count)))


class VideoWriter:
    """Writes an .mp4 (MPEG-4 part 2) under a temporary name; `with` renames it at the end, or removes it on an error.

    All frames take the size of the first; others are resized to it. The file is opened again before it is renamed.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self._path = Path(path)
        self._temporary = self._path.with_name(f".{self._path.stem}.part.mp4")
        self._fps = fps
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self.count = 0

    def __enter__(self) -> VideoWriter:
        return self

    def write(self, image: UInt8[ndarray, "h w 3"]) -> None:
        """Append an RGB image."""
        if self._writer is None:
            self._size = (image.shape[1] // 2 * 2, image.shape[0] // 2 * 2)
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = cv2.VideoWriter(str(self._temporary), code, self._fps, self._size)
            if not self._writer.isOpened():
                raise GknetError(f"{self._path}: cannot write an mp4 video here")
        if (image.shape[1], image.shape[0]) != self._size:
            image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        self._writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        self.count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is None:
            return
        self._writer.release()
        try:
            if kind is None:
                open_video(self._temporary)
                os.replace(self._temporary, self._path)
        finally:
            self._temporary.unlink(missing_ok=True)
