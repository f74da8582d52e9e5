"""What `gknet predict` is given, all as Frames in order: images, videos, streams, or an SKD dataset."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from jaxtyping import UInt8
from numpy import ndarray

from gknet.dataset.skd import SkdDataset, open_dataset
from gknet.dataset.skd_format import SPLITS
from gknet.errors import GknetError
from gknet.frame import Failure, FailureKind, Frame, Unreadable
from gknet.io.image import read_image_file
from gknet.io.lens import Lens, camera_for
from gknet.io.text import printable
from gknet.io.video import LiveVideo, Video, VideoFrame, open_live, open_video
from gknet.predict.inputs import Found, Kind, find_files
from gknet.spacecraft import Spacecraft

LIVE_FRAMES = 100_000
"""A camera or a stream is read no further: it may never end. At 30 frames/s this is 55 minutes."""


class Source(Protocol):
    """Images in order."""

    @property
    def count(self) -> int:
        """How many images are expected."""
        ...

    @property
    def fps(self) -> float | None:
        """Images per second, where they are those of one video."""
        ...

    def __iter__(self) -> Iterator[Frame | Unreadable]: ...


@dataclass(frozen=True)
class ImageFiles:
    """Image files seen through one lens. Of a file with several pages the first is read, and the rest is reported.

    Attributes:
        files: what `find_files` found; a file that cannot be read is reported.
        lens: gives each image the camera of its size.
        bit_depth: see `gknet.io.image.read_image_file`.
    """

    files: tuple[Found, ...]
    lens: Lens
    bit_depth: int | None = None

    @property
    def count(self) -> int:
        return len(self.files)

    @property
    def fps(self) -> float | None:
        return None

    def __iter__(self) -> Iterator[Frame | Unreadable]:
        for file in self.files:
            more_pages = False
            try:
                if file.kind is Kind.BAD:
                    raise GknetError(file.reason)
                picture = read_image_file(file.path, self.bit_depth)
                more_pages = picture.has_more_pages
            except GknetError as error:
                yield Unreadable.because(file.name, printable(error))
            else:
                yield _frame(file.name, picture.image, self.lens)
            if more_pages:
                reason = "only the first page (or image of the animation) was read; save the others as files"
                yield Unreadable.because(f"{file.name}: further pages", f"{printable(file.path)}: {reason}")


@dataclass(frozen=True)
class VideoFile:
    """Every `every`-th frame of a video, by the name <video>/<index>. One that cannot be decoded keeps its index.

    Attributes:
        video: the file.
        lens: gives the frames their camera.
        every: take each n-th frame.
        name: of the video; that of its file without the suffix by default.
    """

    video: Video
    lens: Lens
    every: int
    name: str = ""

    @property
    def count(self) -> int:
        return -(-self.video.announced // self.every)

    @property
    def fps(self) -> float | None:
        return self.video.fps / self.every

    def __iter__(self) -> Iterator[Frame | Unreadable]:
        name, read = self.name or printable(self.video.path.stem), 0
        for shown in self.video.frames(self.every):
            read = shown.index + self.every
            yield _video_frame(shown, f"{name}/{shown.index:06d}", self.video.path, self.lens)
        if missing := self.video.missing_at_the_end(read):
            announced, path = self.video.announced, printable(self.video.path)
            reason = f"{path}: the last {missing} of {announced} frames cannot be read; is the video truncated?"
            yield Unreadable.because(f"{name}/{read:06d}", reason)


@dataclass(frozen=True)
class LiveFrames:
    """Every `every`-th frame of a camera or a stream, by the name <source>/<index>.

    Attributes:
        video: the camera or stream.
        lens: gives the frames their camera.
        every: take each n-th frame.
        name: of the source.
    """

    video: LiveVideo
    lens: Lens
    every: int
    name: str

    @property
    def count(self) -> int:
        return -(-self.video.limit // self.every)

    @property
    def fps(self) -> float | None:
        return self.video.fps / self.every

    def __iter__(self) -> Iterator[Frame | Unreadable]:
        for shown in self.video.frames(self.every):
            yield _video_frame(shown, f"{self.name}/{shown.index:06d}", self.name, self.lens)


def _video_frame(shown: VideoFrame, name: str, place: object, lens: Lens) -> Frame | Unreadable:
    if shown.image is None:
        return Unreadable.because(name, f"{printable(place)}: frame {shown.index} cannot be decoded")
    return _frame(name, shown.image, lens, shown.time_s)


def _frame(name: str, image: UInt8[ndarray, "h w 3"], lens: Lens, time_s: float | None = None) -> Frame | Unreadable:
    """An image with the camera of its size."""
    try:
        camera = camera_for(lens, image.shape[1], image.shape[0])
    except GknetError as error:
        return Unreadable(name, Failure(FailureKind.CAMERA_MISMATCH, printable(error)))
    return Frame(name, image, camera, time_s=time_s)


@dataclass(frozen=True)
class Chain:
    """Several sources, one after the other."""

    parts: tuple[Source, ...]

    @property
    def count(self) -> int:
        return sum(part.count for part in self.parts)

    @property
    def fps(self) -> float | None:
        return None

    def __iter__(self) -> Iterator[Frame | Unreadable]:
        for part in self.parts:
            yield from part


@dataclass(frozen=True, eq=False)
class DatasetFrames:
    """The frames of an SKD dataset with their truth; a bad one is reported and skipped."""

    dataset: SkdDataset

    @property
    def count(self) -> int:
        return len(self.dataset)

    @property
    def fps(self) -> float | None:
        return None

    def __iter__(self) -> Iterator[Frame | Unreadable]:
        for i in range(len(self.dataset)):
            try:
                frame = self.dataset.frame(i)
            except GknetError as error:
                yield Unreadable.because(f"{self.dataset.sequence_of(i)}: frame {i}", error)
            else:
                yield frame


def open_source(
    inputs: str | Path | Sequence[str | Path],
    lens: Lens | None,
    spacecraft: Spacecraft,
    split: str | None = None,
    every: int = 1,
    bit_depth: int | None = None,
    limit: int = LIVE_FRAMES,
) -> Source:
    """The images that the inputs name, see `gknet.predict.inputs`.

    Args:
        inputs: one or several: images, videos, folders, patterns, lists, camera numbers, URLs; or one SKD dataset.
        lens: the camera of images and videos; a dataset brings its own, and refuses another.
        spacecraft: whose frames are taken from a dataset that holds several.
        split: of a dataset.
        every: take each n-th image.
        bit_depth: of image files of more than 8 bits that do not state it.
        limit: how many frames of a camera or a stream are read at most.

    Raises:
        GknetError: an input does not exist or is of no known kind, or an option does not fit it.
    """
    if every < 1:
        raise GknetError(f"every: expected 1 or more, got {every}")
    if limit < 1:
        raise GknetError(f"limit: expected 1 frame or more, got {limit}")
    several = [inputs] if isinstance(inputs, str | Path) else list(inputs)
    for each in several:
        if not os.fspath(each).strip():
            raise GknetError("INPUT: expected an image, video, folder, pattern or list, got an empty name")
        if is_dataset(each):
            return _dataset(each, len(several), lens, spacecraft, split, every)
    if lens is None:
        raise GknetError(
            f"{printable(several[0])}: its camera is unknown; give --camera FILE, --focal-px F or --hfov-deg A"
        )
    files = find_files(several)
    alone = len(files) == 1
    parts = [_part(group, alone, lens, every, bit_depth, limit) for group in _grouped(files, every)]
    return parts[0] if len(parts) == 1 else Chain(tuple(parts))


def is_dataset(path: str | Path) -> bool:
    """Whether a folder is the root of an SKD dataset."""
    return any(os.path.isfile(os.path.join(path, f"{name}.json")) for name in SPLITS)


def _dataset(
    path: str | Path, inputs: int, lens: Lens | None, spacecraft: Spacecraft, split: str | None, every: int
) -> DatasetFrames:
    if inputs > 1:
        raise GknetError(f"{printable(path)}: a dataset is read alone, got {inputs} inputs")
    if lens is not None:
        raise GknetError(
            f"{printable(path)}: a dataset has its own camera; leave --camera, --focal-px and --hfov-deg out"
        )
    return DatasetFrames(open_dataset(Path(path), spacecraft, split, every))


def _grouped(files: Sequence[Found], every: int) -> list[tuple[Found, ...]]:
    """Runs of images, of which each `every`-th of all is taken, and videos and streams one by one."""
    groups: list[list[Found]] = []
    images = 0
    for file in files:
        if file.kind in (Kind.VIDEO, Kind.LIVE):
            groups.append([file])
            continue
        images += 1
        if (images - 1) % every:
            continue
        if not groups or groups[-1][0].kind in (Kind.VIDEO, Kind.LIVE):
            groups.append([])
        groups[-1].append(file)
    return [tuple(group) for group in groups]


def _part(group: tuple[Found, ...], alone: bool, lens: Lens, every: int, bit_depth: int | None, limit: int) -> Source:
    """The source of a run of images, a video or a stream. A video that cannot be opened among others is reported."""
    first = group[0]
    if first.kind is Kind.LIVE:
        live = open_live(int(first.path) if first.path.isdecimal() else first.path, limit)
        return LiveFrames(live, lens, every, first.name)
    if first.kind is not Kind.VIDEO:
        return ImageFiles(group, lens, bit_depth)
    try:
        return VideoFile(open_video(first.path), lens, every, first.name)
    except GknetError as error:
        if alone:
            raise
        return ImageFiles((Found(Kind.BAD, first.path, first.name, str(error)),), lens)
