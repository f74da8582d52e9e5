"""Videos in and out: frames of a file or a stream with their times, and an .mp4 that appears only when it is whole.

Frames come as the sensor stored them: a rotation flag is ignored, as for images, since it would not turn the camera
matrix. Times are those of the file, so a variable frame rate is kept.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.io.atomic import replacing
from gknet.io.opencv import checked_file, quiet, utf8_path

VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv"})
STREAM_SCHEMES = ("rtsp://", "rtsps://", "http://", "https://", "rtmp://", "udp://", "tcp://", "srt://")

MOST_FAILURES = 64
"""This many frames in a row that cannot be decoded are the end, when the file has no more of its announced length."""

MOST_ANNOUNCED = 10_000
"""How many of the announced frames are tried after the last good one."""

COUNTING_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi"})
"""Containers that have an index of their frames; the announced length of others is an estimate."""

STREAM_TIMEOUT_S = 10.0


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """A frame of a video.

    Attributes:
        index: its place in the video, from 0, with frames counted that cannot be decoded.
        time_s: as the file has it; None where it cannot be decoded.
        image: (h, w, 3) uint8 RGB; None where it cannot be decoded.
    """

    index: int
    time_s: float | None
    image: UInt8[ndarray, "h w 3"] | None


@dataclass(frozen=True)
class Video:
    """A video file that can be read.

    Attributes:
        path: of the file.
        width: in pixels, as the sensor has them.
        height: in pixels.
        fps: the mean number of frames per second; 25 where the file does not state it.
        announced: the container's own count of frames, which may be an estimate or 0.
    """

    path: Path
    width: int
    height: int
    fps: float
    announced: int

    def frames(self, every: int = 1) -> Iterator[VideoFrame]:
        """Every `every`-th frame in order, up to the last that decodes.

        A frame that cannot be decoded has no image. What is missing at the end is not listed: `missing_at_the_end`.
        """
        with _capture(self.path) as capture:
            index, last_time_s, waiting = 0, -1.0, 0
            while waiting < (MOST_ANNOUNCED if index < self.announced else MOST_FAILURES):
                if not capture.grab():
                    waiting += 1
                    index += 1
                    continue
                for bad in range(index - waiting, index):
                    if bad % every == 0:
                        yield VideoFrame(bad, None, None)
                waiting = 0
                last_time_s = time_s = self._time_s(capture, index, last_time_s)
                if index % every == 0:
                    yield VideoFrame(index, time_s, _retrieved(capture))
                index += 1

    def _time_s(self, capture: cv2.VideoCapture, index: int, before: float) -> float:
        """Of the frame that was grabbed; from its index where the file has no times that increase."""
        time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        return time_s if np.isfinite(time_s) and time_s > before else index / self.fps

    def missing_at_the_end(self, read: int) -> int:
        """How many announced frames were not there when `read` were; 0 where that may be an estimate's error."""
        missing = max(0, self.announced - read)
        exact = self.path.suffix.lower() in COUNTING_SUFFIXES
        return missing if exact or missing > max(2, self.announced // 50) else 0


@contextmanager
def _capture(source: Path | str | int) -> Iterator[cv2.VideoCapture]:
    """An open video of a file, a URL or a camera's number, without OpenCV's own rotation."""
    with ExitStack() as stack:
        stack.enter_context(quiet())
        if isinstance(source, int):
            capture = cv2.VideoCapture(source)
        elif isinstance(source, str):
            wait_ms = int(STREAM_TIMEOUT_S * 1000)
            limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, wait_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, wait_ms]
            capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
        else:
            capture = cv2.VideoCapture(stack.enter_context(utf8_path(source)), cv2.CAP_FFMPEG)
        stack.callback(capture.release)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture


def _retrieved(capture: cv2.VideoCapture) -> ndarray | None:
    """The frame that was grabbed as (h, w, 3) uint8 RGB; None where it cannot be decoded."""
    decoded, image = capture.retrieve()
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if decoded and image is not None and image.size else None


def _rate(capture: cv2.VideoCapture) -> float:
    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if np.isfinite(fps) and 0 < fps < 1e5 else 25.0


def open_video(path: str | Path) -> Video:
    """Check that a video opens and holds a frame.

    Args:
        path: of the file.

    Raises:
        GknetError: there is no such file, it is no video, or none of its frames decodes.
    """
    path = Path(path)
    checked_file(path, "video")
    with _capture(path) as capture:
        if not capture.isOpened():
            raise GknetError(f"{path}: not a video that can be read")
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        announced = int(count) if np.isfinite(count) and 0 < count < 2**31 else 0
        for _ in range(max(MOST_FAILURES, min(announced, MOST_ANNOUNCED))):
            if capture.grab() and (image := _retrieved(capture)) is not None:
                return Video(path, image.shape[1], image.shape[0], _rate(capture), announced)
    raise GknetError(f"{path}: a video without frames that can be decoded")


@dataclass(frozen=True)
class LiveVideo:
    """A camera or a stream.

    Attributes:
        source: the camera's number, or a URL of `STREAM_SCHEMES`.
        fps: frames per second, as the source states it; 25 where it does not.
        limit: how many frames are read at most.
    """

    source: int | str
    fps: float
    limit: int

    def frames(self, every: int = 1) -> Iterator[VideoFrame]:
        """Every `every`-th frame until the limit, or until none has come for `STREAM_TIMEOUT_S`.

        A time counts from when the source was opened.
        """
        with _capture(self.source) as capture:
            start = last = time.monotonic()
            index = failures = 0
            while index < self.limit and time.monotonic() - last < STREAM_TIMEOUT_S:
                if not capture.grab():
                    failures += 1
                    if isinstance(self.source, str) and failures >= MOST_FAILURES:
                        return
                    time.sleep(0.01)
                    continue
                failures, now = 0, time.monotonic()
                if index % every == 0:
                    yield VideoFrame(index, now - start, _retrieved(capture))
                index += 1
                last = time.monotonic()  # after the caller's own time


def open_live(source: int | str, limit: int) -> LiveVideo:
    """Check that a camera or a stream opens.

    Args:
        source: the camera's number, or a URL.
        limit: how many frames are read at most.

    Raises:
        GknetError: it does not open within `STREAM_TIMEOUT_S`.
    """
    with _capture(source) as capture:
        if not capture.isOpened():
            what = f"camera {source}" if isinstance(source, int) else source
            raise GknetError(f"{what}: cannot be opened; is it connected, and free?")
        return LiveVideo(source, _rate(capture), limit)


class VideoWriter:
    """Writes an .mp4 (MPEG-4 part 2) under a temporary name; `with` renames it at the end, or removes it on an error.

    All frames take the size of the first; others are resized to it. The file is opened again before it is renamed.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self._path = self._temporary = Path(path)
        self._fps = fps
        self._stack = ExitStack()
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self.count = 0

    def __enter__(self) -> VideoWriter:
        return self

    def write(self, image: UInt8[ndarray, "h w 3"]) -> None:
        """Append an RGB image.

        Raises:
            GknetError: no video can be written there, or none of that size.
        """
        if self._writer is None:
            self._size = (image.shape[1] // 2 * 2, image.shape[0] // 2 * 2)
            self._writer = self._opened()
        if (image.shape[1], image.shape[0]) != self._size:
            image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        self._writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        self.count += 1

    def _opened(self) -> cv2.VideoWriter:
        """OpenCV's writer of the temporary file, which is gone again where it does not open."""
        with ExitStack() as stack:
            try:
                self._temporary = stack.enter_context(replacing(self._path, keep_suffix=True))
            except OSError as error:
                raise GknetError(f"{self._path}: cannot write a video here ({error.strerror})") from error
            with quiet(), utf8_path(self._temporary) as name:
                writer = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"mp4v"), self._fps, self._size)
            if not writer.isOpened():
                width, height = self._size
                raise GknetError(f"{self._path}: cannot write an mp4 video of {width} x {height} pixels here")
            self._stack = stack.pop_all()
        return writer

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Complete the file, or remove what was written of it."""
        if self._writer is None:
            return
        self._writer.release()
        self._writer = None
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            open_video(self._temporary)
