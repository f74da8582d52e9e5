"""Decoded crops of a dataset in one memory-mapped file, so that a training does not decode."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, Protocol, runtime_checkable

import numpy as np
from filelock import FileLock
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Frame
from gknet.inference.crop import Crop
from gknet.inference.crop_pose import CropPose, has_square_pixels
from gknet.spacecraft import Spacecraft

logger = logging.getLogger(__name__)

CACHE_MARGIN = 1.6
"""A cached crop's side over the longer side of the keypoints' box: room to rotate and to shift."""

WHOLE = 0.8
"""A crop that would cover this share of the image's side becomes the whole image."""

LAYOUT = 3
"""Of the files; a cache of another one is built anew."""

IMAGES, LABELS, HEADER = "images.u8", "labels.npz", "cache.json"

Window = Literal["craft", "image"]


@runtime_checkable
class FrameSource(Protocol):
    """A dataset whose labels can be read without its images."""

    def __len__(self) -> int: ...
    def frame(self, i: int, image: bool = True) -> Frame: ...


@dataclass(frozen=True, eq=False)
class Cache:
    """Square crops and their labels, in pixels of the crop.

    Attributes:
        images: (m, s, s, 3) uint8 RGB, memory-mapped.
        points_px: (m, n, 2) the projected keypoints; NaN behind the camera.
        in_view: (m, n) whether the keypoint is inside the image and inside the crop, hidden or not.
        boxes_px: (m, 4) the true box x0, y0, x1, y1: the keypoints' box, clipped to the image.
        poses: (m, 7) the true pose relative to the crop, `CropPose.vector`; NaN where the origin is behind the camera
            or pixels are not square, since a rotated image has no pose then.
    """

    images: UInt8[ndarray, "m s s 3"]
    points_px: Float[ndarray, "m n 2"]
    in_view: Bool[ndarray, "m n"]
    boxes_px: Float[ndarray, "m 4"]
    poses: Float[ndarray, "m 7"]

    def __len__(self) -> int:
        return len(self.images)

    @property
    def size(self) -> int:
        """Side of the crops in pixels."""
        return self.images.shape[1]


def whole_picture(frame: Frame, size: int) -> Crop:
    """The smallest centred square around the image."""
    width, height = frame.camera.width, frame.camera.height
    side = max(width, height)
    return Crop(-((side - width) // 2), -((side - height) // 2), side, size)


def craft_window(frame: Frame, box: Box, size: int) -> Crop:
    """The square around the spacecraft, or the whole image when that is hardly more."""
    whole = whole_picture(frame, size)
    around = Crop.around(box, size, CACHE_MARGIN)
    return whole if around.side >= WHOLE * whole.side else around


def _content_key(frames: FrameSource, spacecraft: Spacecraft, window: Window, size: int, stamp: str) -> str:
    """A digest that changes with anything that a cache is made of."""
    digest = hashlib.sha256(f"{LAYOUT} {window} {size} {CACHE_MARGIN} {WHOLE} {stamp}".encode())
    digest.update(np.append(spacecraft.points_m, spacecraft.diameter_m).tobytes())
    for i in range(len(frames)):
        try:
            frame = frames.frame(i, image=False)
        except GknetError as error:  # a bad label: the frame is left out, and reported when the cache is written
            digest.update(str(error).encode(errors="surrogateescape"))
            continue
        name = frame.name.encode(errors="surrogateescape")
        digest.update(name + f" {frame.camera.width} {frame.camera.height}".encode())
        digest.update(frame.camera.matrix.tobytes())
        if frame.cam_from_body is not None:
            digest.update(frame.cam_from_body.rotation.tobytes() + frame.cam_from_body.translation_m.tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class _Row:
    image: UInt8[ndarray, "s s 3"]
    points_px: Float[ndarray, "n 2"]
    in_view: Bool[ndarray, " n"]
    box_px: Float[ndarray, "4"]
    pose: Float[ndarray, "7"]


def cached_row(frame: Frame, spacecraft: Spacecraft, window: Window, size: int) -> _Row | None:
    """One frame as the cache keeps it; None when nothing of the spacecraft is in the image."""
    assert frame.image is not None
    points_m = spacecraft.points_m
    pixels = frame.keypoints_px(points_m)
    inside = frame.camera.contains(pixels)
    box = frame.true_box(points_m)
    if box is None:
        return None
    crop = craft_window(frame, box, size) if window == "craft" else whole_picture(frame, size)
    points = crop.to_input(pixels)
    inside = inside & ((points >= 0) & (points <= size)).all(axis=1)
    corners = crop.to_input(np.array([[box.x0, box.y0], [box.x1, box.y1]]))
    assert frame.cam_from_body is not None
    square = has_square_pixels(frame.camera)
    pose = CropPose.of(frame.cam_from_body, frame.camera, crop, spacecraft.diameter_m) if square else None
    vector = np.full(7, np.nan) if pose is None else pose.vector
    return _Row(crop.cut(frame.image), points, inside, corners.ravel(), vector)


def build_cache(
    frames: FrameSource,
    spacecraft: Spacecraft,
    place: Path,
    size: int,
    window: Window = "craft",
    stamp: str = "",
    workers: int = 2,
    advance: Callable[[int, int], None] = lambda done, total: None,
    report: Callable[[str], None] = logger.warning,
) -> Cache:
    """The cache of a dataset in the folder `place`, built when it is not there, damaged, or of other content.

    Args:
        frames: The dataset. A frame that cannot be read is reported and left out.
        spacecraft: Of the frames.
        place: The folder of this cache alone. What else it holds is removed when the cache is built.
        size: Side of the crops in pixels.
        window: "craft" or "image".
        stamp: Stands for the images' content, such as sizes and times of the files.
        workers: Threads.
        advance: Called with (done, total) while the cache is built.
        report: Called with a line for each frame that is left out.

    Returns:
        The cache.

    Raises:
        GknetError: The dataset has no frames, or none that shows the spacecraft.
    """
    if len(frames) == 0:
        raise GknetError("cache: the dataset has no frames for this split and spacecraft")
    key = _content_key(frames, spacecraft, window, size, stamp)
    cache = _read_cache(place, key, size)
    if cache is not None:
        return cache
    place.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(place.with_name(f".{place.name}.lock")):  # one process builds it, the others wait
        cache = _read_cache(place, key, size)
        if cache is None:
            _write_cache(place, key, _rows(frames, spacecraft, window, size, workers, advance, report))
            cache = _read_cache(place, key, size)
    if cache is None:
        raise GknetError(f"{place}: the cache does not read as it was written; is the disk in order?")
    return cache


def _header(key: str, count: int, labels: bytes) -> dict[str, object]:
    return {"key": key, "count": count, "labels_sha256": hashlib.sha256(labels).hexdigest()}


def _read_cache(place: Path, key: str, size: int) -> Cache | None:
    """The cache in `place`; None where it is absent, damaged, or of other content."""
    try:
        header = json.loads((place / HEADER).read_bytes())
        content = (place / LABELS).read_bytes()
        if header != _header(key, header["count"], content):
            return None
        labels = np.load(io.BytesIO(content))
        images = np.memmap(place / IMAGES, dtype=np.uint8, mode="r").reshape(header["count"], size, size, 3)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return Cache(images, labels["points_px"], labels["in_view"], labels["boxes_px"], labels["poses"])


def _write_cache(place: Path, key: str, rows: Iterable[_Row]) -> None:
    """Put a cache of `rows` in `place`, instead of what is there."""
    for left in place.parent.glob(f".{place.name}.*.tmp"):  # of builders that were killed
        shutil.rmtree(left, ignore_errors=True)
    temporary = place.with_name(f".{place.name}.{secrets.token_hex(8)}.tmp")
    temporary.mkdir()
    try:
        kept = []
        with open(temporary / IMAGES, "wb") as images:
            for row in rows:
                images.write(row.image.tobytes())
                kept.append((row.points_px, row.in_view, row.box_px, row.pose))
            _sync(images)
        if not kept:
            raise GknetError("cache: no frame shows the spacecraft; is this the right dataset?")
        labels = _labels(kept)
        for name, content in ((LABELS, labels), (HEADER, json.dumps(_header(key, len(kept), labels)).encode())):
            with open(temporary / name, "wb") as file:
                file.write(content)
                _sync(file)
        shutil.rmtree(place, ignore_errors=True)
        os.replace(temporary, place)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _rows(
    frames: FrameSource,
    spacecraft: Spacecraft,
    window: Window,
    size: int,
    workers: int,
    advance: Callable[[int, int], None],
    report: Callable[[str], None],
) -> Iterator[_Row]:
    """The rows of all frames that show the spacecraft, in order and bounded in memory."""

    def row(i: int) -> _Row | str | None:
        try:
            return cached_row(frames.frame(i), spacecraft, window, size)
        except GknetError as error:
            return str(error)

    with ThreadPoolExecutor(workers) as pool:
        for start in range(0, len(frames), 256):
            for done, item in enumerate(pool.map(row, range(start, min(start + 256, len(frames)))), start + 1):
                if isinstance(item, str):
                    report(f"left out: {item}")
                elif item is not None:
                    yield item
                advance(done, len(frames))


def _labels(rows: Sequence[tuple[ndarray, ...]]) -> bytes:
    points, in_view, boxes, poses = (np.stack(column) for column in zip(*rows, strict=True))
    content = io.BytesIO()
    np.savez(
        content,
        points_px=points.astype(np.float32),
        in_view=in_view,
        boxes_px=boxes.astype(np.float32),
        poses=poses.astype(np.float32),
    )
    return content.getvalue()


def _sync(file: BinaryIO) -> None:
    """Wait until the content is on the disk: a crash of the machine must not leave a cache of zeros."""
    file.flush()
    os.fsync(file.fileno())
