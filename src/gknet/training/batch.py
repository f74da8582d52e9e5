"""Cached crops become augmented batches of tensors, made by a thread ahead of the loop. Numpy ends here."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from gknet.inference.crop_pose import CropPose
from gknet.training.augment import (
    Augmentation,
    PictureAugmentation,
    craft_warp,
    photometric,
    picture_warp,
    warp_image,
    warp_points,
)
from gknet.training.cache import Cache
from gknet.training.schedule import Stage

AHEAD = 3
"""Batches prepared ahead of the loop."""

PROMPTED_SAMPLES, PROMPTED_KEYPOINTS = 0.5, 0.6
"""Share of the samples with teacher-forced keypoints, and the largest share of such a sample's keypoints."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A network's input and its labels.

    Attributes:
        image: (s, s, 3) RGB.
        points_px: (k, 2) in pixels of the input; 0 where out of view.
        weight: (k,) 1 where the point counts, 0 where it is out of view.
        prompted: (k,) whether a two-pass network receives the point before its second pass (teacher forcing).
        pose: (7,) relative to the crop, `CropPose.vector`; NaN where there is none.
    """

    image: UInt8[ndarray, "s s 3"]
    points_px: Float[ndarray, "k 2"]
    weight: Float[ndarray, " k"]
    prompted: Bool[ndarray, " k"]
    pose: Float[ndarray, "7"]


@dataclass(frozen=True, eq=False)
class Batch:
    """Samples stacked.

    Attributes:
        image: (b, s, s, 3) RGB; its permuted view is channels_last.
        points_px: (b, k, 2), see `Sample`.
        weight: (b, k), see `Sample`.
        prompted: (b, k), see `Sample`.
        pose: (b, 7), see `Sample`.
        position: Samples of all processes up to the end of this batch.
    """

    image: UInt8[Tensor, "b s s 3"]
    points_px: Float[Tensor, "b k 2"]
    weight: Float[Tensor, "b k"]
    prompted: Bool[Tensor, "b k"]
    pose: Float[Tensor, "b 7"]
    position: int

    def __len__(self) -> int:
        return len(self.image)

    def network_input(self, device: torch.device) -> Float[Tensor, "b 3 s s"]:
        """RGB in 0 to 1, channels_last."""
        return self.image.to(device, non_blocking=True).permute(0, 3, 1, 2).float().div_(255)


Draw = Callable[[np.random.Generator, Cache, int, int], Sample]
"""(random numbers, cache, row, input size) -> Sample"""


def draw_keypoints(rng: np.random.Generator, cache: Cache, row: int, size: int) -> Sample:
    """A crop around the spacecraft; row k of the points is keypoint k, whatever is out of view."""
    ranges = Augmentation()
    points, in_view = cache.points_px[row].astype(np.float64), cache.in_view[row]
    matrix = craft_warp(rng, points, in_view, size, ranges)
    image = photometric(rng, warp_image(cache.images[row], matrix, size), ranges)
    warped = warp_points(matrix, points)
    valid = in_view & points_inside(warped, size)
    points_px = np.where(valid[:, None], warped, 0.0).astype(np.float32)
    prompted = valid & (rng.random(len(points)) < _prompted_share(rng))
    return Sample(image, points_px, valid.astype(np.float32), prompted, _warped_pose(cache, row, matrix, size))


def _prompted_share(rng: np.random.Generator) -> float:
    return rng.uniform(0, PROMPTED_KEYPOINTS) if rng.random() < PROMPTED_SAMPLES else 0.0


def draw_box(rng: np.random.Generator, cache: Cache, row: int, size: int) -> Sample:
    """A whole image; the two points are the corners of the spacecraft's box, clipped to the input."""
    matrix = picture_warp(rng, cache.size, size, PictureAugmentation())
    image = photometric(rng, warp_image(cache.images[row], matrix, size), Augmentation())
    corners = warp_points(matrix, cache.boxes_px[row].astype(np.float64).reshape(2, 2)).clip(0, size)
    low, high = corners.min(axis=0), corners.max(axis=0)
    is_valid = float((high - low).min() > size / 64)
    points_px, weight = np.stack([low, high]).astype(np.float32), np.full(2, is_valid, dtype=np.float32)
    return Sample(image, points_px, weight, np.zeros(2, dtype=bool), _warped_pose(cache, row, matrix, size))


def _warped_pose(cache: Cache, row: int, matrix: Float[ndarray, "3 3"], size: int) -> Float[ndarray, "7"]:
    vector = cache.poses[row].astype(np.float64)
    if np.isfinite(vector).all():
        vector = CropPose.from_vector(vector).warped(matrix, cache.size, size).vector
    return vector.astype(np.float32)


def points_inside(points: Float[ndarray, "n 2"], size: int) -> Bool[ndarray, " n"]:
    """Which points lie in a square image."""
    return np.all((points >= 0) & (points <= size), axis=1)


@dataclass(frozen=True)
class Loader:
    """Batches without end, from any position: sample i of epoch e is a function of (seed, e, i) alone.

    Attributes:
        cache: Of the training data.
        draw: Makes a sample from a row of the cache.
        seed: Of the order and the augmentation.
        rank: Of this process.
        world: How many processes there are.
    """

    cache: Cache
    draw: Draw
    seed: int
    rank: int = 0
    world: int = 1

    def sample(self, position: int, size: int) -> Sample:
        """The sample at `position` in the endless order of shuffled epochs."""
        epoch, place = divmod(position, len(self.cache))
        row = int(_order(self.seed, epoch, len(self.cache))[place])
        return self.draw(np.random.default_rng((self.seed, epoch, row)), self.cache, row, size)

    def batch(self, position: int, stage: Stage) -> Batch:
        """The batch that begins at `position`; processes take turns, sample by sample."""
        places = range(position + self.rank, position + stage.batch * self.world, self.world)
        samples = [self.sample(place, stage.input_size) for place in places]
        return Batch(
            torch.from_numpy(np.stack([sample.image for sample in samples])),
            torch.from_numpy(np.stack([sample.points_px for sample in samples])),
            torch.from_numpy(np.stack([sample.weight for sample in samples])),
            torch.from_numpy(np.stack([sample.prompted for sample in samples])),
            torch.from_numpy(np.stack([sample.pose for sample in samples])),
            position + stage.batch * self.world,
        )

    def batches(self, position: int, stage_at: Callable[[int], Stage]) -> Generator[Batch, None, None]:
        """Batches from a position on, prepared by a thread. Close the generator when done.

        Args:
            position: Of the first sample.
            stage_at: Position -> the stage of the batch that begins there.
        """
        ready: queue.Queue[Batch | BaseException] = queue.Queue(AHEAD)
        stop = threading.Event()

        def work() -> None:
            place = position
            try:
                while not stop.is_set():
                    batch = self.batch(place, stage_at(place))
                    place = batch.position
                    _put(ready, batch, stop)
            except BaseException as error:
                _put(ready, error, stop)

        thread = threading.Thread(target=work, name="batches", daemon=True)
        thread.start()
        try:
            while True:
                item = ready.get()
                if isinstance(item, BaseException):
                    raise item
                yield item
        finally:
            stop.set()
            thread.join()


@lru_cache(maxsize=2)
def _order(seed: int, epoch: int, count: int) -> Int[ndarray, " count"]:
    return np.random.default_rng((seed, epoch)).permutation(count)


def _put(ready: queue.Queue, item: Batch | BaseException, stop: threading.Event) -> None:
    while not stop.is_set():
        try:
            ready.put(item, timeout=0.1)
            return
        except queue.Full:
            continue
