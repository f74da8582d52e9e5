"""Decoded crops of a dataset in one memory-mapped file, so that the CPU trains and does not decode."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Frame
from gknet.inference.crop import Crop
from gknet.inference.crop_pose import CropPose, has_square_pixels
from gknet.spacecraft import Spacecraft

CACHE_MARGIN = 1.6
"""A cached crop's side over the longer side of the keypoints' box: room to turn and to shift."""

WHOLE = 0.8
"""A crop that would cover this share of the picture's side takes the whole picture instead."""

LAYOUT = 2

Window = Literal["craft", "picture"]


@runtime_checkable
class FrameSource(Protocol):
    """A dataset whose labels can be read without its pictures."""

    def __len__(self) -> int: ...
    def frame(self, i: int, image: bool = True) -> Frame: ...


@dataclass(frozen=True, eq=False)
class Cache:
    """Square crops and their labels, in pixels of the crop.

    images    (m, s, s, 3) uint8, memory-mapped
    points_px (m, n, 2) the projected keypoints; NaN behind the camera
    in_view   (m, n) the keypoint is inside the picture and inside the crop, hidden or not
    boxes_px  (m, 4) the true box x0, y0, x1, y1: the keypoints' box, clipped to the picture
    poses     (m, 7) the true pose as the crop shows it, `CropPose.vector`; NaN where the origin is behind the camera
              or pixels are not square, since a turned picture is of no pose then
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
        return self.images.shape[1]


def whole_picture(frame: Frame, size: int) -> Crop:
    """The smallest centred square around the picture."""
    width, height = frame.camera.width, frame.camera.height
    side = max(width, height)
    return Crop(-((side - width) // 2), -((side - height) // 2), side, size)


def craft_window(frame: Frame, box: Box, size: int) -> Crop:
    """The square around the craft, or the whole picture when that is hardly more."""
    whole = whole_picture(frame, size)
    around = Crop.around(box, size, CACHE_MARGIN)
    return whole if around.side >= WHOLE * whole.side else around


def _label_key(frames: FrameSource, spacecraft: Spacecraft, window: Window, size: int, stamp: str) -> str:
    """A name for the cache that changes with anything that it was made of."""
    digest = hashlib.sha256(f"{LAYOUT} {window} {size} {CACHE_MARGIN} {WHOLE} {stamp}".encode())
    digest.update(np.append(spacecraft.points_m, spacecraft.diameter_m).tobytes())
    for i in range(len(frames)):
        try:
            frame = frames.frame(i, image=False)
        except GknetError as error:  # a bad label: the frame is left out, and reported when the cache is written
            digest.update(str(error).encode())
            continue
        digest.update(f"{frame.name} {frame.camera.width} {frame.camera.height}".encode())
        digest.update(frame.camera.matrix.tobytes())
        if frame.cam_from_body is not None:
            digest.update(frame.cam_from_body.rotation.tobytes() + frame.cam_from_body.translation_m.tobytes())
    return digest.hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class _Row:
    image: UInt8[ndarray, "s s 3"]
    points_px: Float[ndarray, "n 2"]
    in_view: Bool[ndarray, " n"]
    box_px: Float[ndarray, "4"]
    pose: Float[ndarray, "7"]


def cached_row(frame: Frame, spacecraft: Spacecraft, window: Window, size: int) -> _Row | None:
    """One frame as the cache keeps it; None when nothing of the craft is in the picture."""
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
    folder: Path,
    size: int,
    window: Window = "craft",
    stamp: str = "",
    workers: int = 2,
    advance: Callable[[int, int], None] = lambda done, total: None,
    report: Callable[[str], None] = print,
) -> Cache:
    """The cache of `frames` under `folder`, built if it is not there. A bad frame is reported and left out.

    stamp    stands for the pictures' content, such as sizes and times of the files
    advance  is called with (done, total)
    """
    if len(frames) == 0:
        raise GknetError("cache: the dataset has no frames for this split and spacecraft")
    place = folder / _label_key(frames, spacecraft, window, size, stamp)
    if not (place / "labels.npz").exists():
        _write_cache(frames, spacecraft, place, size, window, workers, advance, report)
    labels = np.load(place / "labels.npz")
    count = len(labels["points_px"])
    images = np.memmap(place / "images.u8", dtype=np.uint8, mode="r", shape=(count, size, size, 3))
    return Cache(images, labels["points_px"], labels["in_view"], labels["boxes_px"], labels["poses"])


def _write_cache(
    frames: FrameSource,
    spacecraft: Spacecraft,
    place: Path,
    size: int,
    window: Window,
    workers: int,
    advance: Callable[[int, int], None],
    report: Callable[[str], None],
) -> None:
    temporary = place.with_name(f"{place.name}.{os.getpid()}.tmp")
    temporary.mkdir(parents=True)

    def row(i: int) -> _Row | str | None:
        try:
            return cached_row(frames.frame(i), spacecraft, window, size)
        except GknetError as error:
            return str(error)

    kept: list[tuple[ndarray, ...]] = []
    try:
        with ThreadPoolExecutor(workers) as pool, open(temporary / "images.u8", "wb") as images:
            for start in range(0, len(frames), 256):  # in order and bounded in memory
                for done, item in enumerate(pool.map(row, range(start, min(start + 256, len(frames)))), start + 1):
                    if isinstance(item, str):
                        report(f"left out: {item}")
                    elif item is not None:
                        images.write(item.image.tobytes())
                        kept.append((item.points_px, item.in_view, item.box_px, item.pose))
                    advance(done, len(frames))
        if not kept:
            raise GknetError("cache: no frame shows the spacecraft; is this the right dataset?")
        points, in_view, boxes, poses = (np.stack(column) for column in zip(*kept, strict=True))
        np.savez(
            temporary / "labels.npz",
            points_px=points.astype(np.float32),
            in_view=in_view,
            boxes_px=boxes.astype(np.float32),
            poses=poses.astype(np.float32),
        )
        if place.exists():  # another process was faster
            return
        os.replace(temporary, place)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
