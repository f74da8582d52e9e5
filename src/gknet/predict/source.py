"""What `gknet predict` may be given, all as Frames in order: an image, a folder of them, a video, an SKD dataset."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from gknet.dataset.skd import SkdDataset, open_dataset
from gknet.dataset.skd_format import SPLITS
from gknet.errors import GknetError
from gknet.frame import Frame, Unreadable
from gknet.io.image import read_image
from gknet.io.lens import Lens, camera_for
from gknet.io.video import VIDEO_SUFFIXES, Video, open_video
from gknet.spacecraft import Spacecraft

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})


class Source(Protocol):
    """Pictures in order; `count` is how many are expected, `fps` their rate where they are a video."""

    @property
    def count(self) -> int: ...
    @property
    def fps(self) -> float | None: ...
    def __iter__(self) -> Iterator[Frame | Unreadable]: ...


@dataclass(frozen=True)
class ImageFiles:
    """Image files seen through one lens; names are relative to `folder`."""

    folder: Path
    paths: tuple[Path, ...]
    lens: Lens

    @property
    def count(self) -> int:
        return len(self.paths)

    @property
    def fps(self) -> float | None:
        return None

    def __iter__(self) -> Iterator[Frame | Unreadable]:
        for path in self.paths:
            name = path.relative_to(self.folder).as_posix()
            try:
                image = read_image(path)
                camera = camera_for(self.lens, image.shape[1], image.shape[0])
            except GknetError as error:
                yield Unreadable.because(name, error)
            else:
                yield Frame(name, image, camera)


@dataclass(frozen=True)
class VideoFile:
    """Every `every`-th frame of a video; a video that ends far before its announced length says so at the end."""

    video: Video
    lens: Lens
    every: int

    @property
    def count(self) -> int:
        return -(-self.video.announced // self.every)

    @property
    def fps(self) -> float | None:
        return self.video.fps / self.every

    def __iter__(self) -> Iterator[Frame | Unreadable]:
        stem, camera, read = self.video.path.stem, camera_for(self.lens, self.video.width, self.video.height), 0
        for shown in self.video.frames(self.every):
            read += 1
            yield Frame(f"{stem}/{shown.index:06d}", shown.image, camera, time_s=shown.time_s)
        if read < self.count - max(2, self.count // 50):
            reason = f"{self.video.path}: the video ends after {read} of {self.count} frames; is it truncated?"
            yield Unreadable.because(f"{stem}/{read * self.every:06d}", reason)


@dataclass(frozen=True, eq=False)
class DatasetFrames:
    """The frames of an SKD dataset with their truth; a bad one is reported and passed over."""

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
    path: str | Path, lens: Lens | None, spacecraft: Spacecraft, split: str | None = None, every: int = 1
) -> Source:
    """What lies at `path`, by its kind.

    lens        the camera of images and videos; a dataset brings its own, and refuses another
    spacecraft  whose frames are taken from a dataset that holds several
    """
    path = Path(path)
    if every < 1:
        raise GknetError(f"every: expected 1 or more, got {every}")
    if not path.exists():
        raise GknetError(f"{path}: no such image, video or folder")
    if path.is_dir() and any((path / f"{name}.json").exists() for name in SPLITS):
        if lens is not None:
            raise GknetError(f"{path}: a dataset has its own camera; leave --camera, --focal-px and --hfov-deg out")
        return DatasetFrames(open_dataset(path, spacecraft, split, every))
    if lens is None:
        raise GknetError(f"{path}: its camera is unknown; give --camera FILE, --focal-px F or --hfov-deg A")
    if path.is_dir():
        return _image_folder(path, lens, every)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return VideoFile(open_video(path), lens, every)
    return ImageFiles(path.parent, (path,), lens)


def _image_folder(folder: Path, lens: Lens, every: int) -> ImageFiles:
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    if not paths:
        raise GknetError(f"{folder}: no image in this folder (looked for {', '.join(sorted(IMAGE_SUFFIXES))})")
    return ImageFiles(folder, tuple(paths[::every]), lens)
