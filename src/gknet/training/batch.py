"""The only door from numpy to torch: cached crops become augmented batches, made by a thread ahead of the loop."""

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

TOLD_OF, MOST_TOLD = 0.5, 0.6
"""Share of the pictures with prompts, and the largest share of such a picture's keypoints that are told."""


@dataclass(frozen=True, eq=False)
class Sample:
    """A network's input and what is to be found in it: points in input pixels, and the pose.

    image (s, s, 3) uint8; points_px (k, 2); weight (k,) 1 where the point counts, 0 where it is out of view
    told (k,) whether a network that looks twice is told the point before it looks again
    pose (7,) as the input shows it, `CropPose.vector`; NaN where it has none to show
    """

    image: UInt8[ndarray, "s s 3"]
    points_px: Float[ndarray, "k 2"]
    weight: Float[ndarray, " k"]
    told: Bool[ndarray, " k"]
    pose: Float[ndarray, "7"]


@dataclass(frozen=True, eq=False)
class Batch:
    """Samples stacked. `position` counts the samples of all processes up to the end of this batch.

    image is (b, s, s, 3) uint8, so that its permuted view is channels_last.
    """

    image: UInt8[Tensor, "b s s 3"]
    points_px: Float[Tensor, "b k 2"]
    weight: Float[Tensor, "b k"]
    told: Bool[Tensor, "b k"]
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
    """A crop about the craft; row k of the points is keypoint k, whatever is out of view."""
    ranges = Augmentation()
    points, in_view = cache.points_px[row].astype(np.float64), cache.in_view[row]
    matrix = craft_warp(rng, points, in_view, size, ranges)
    image = photometric(rng, warp_image(cache.images[row], matrix, size), ranges)
    warped = warp_points(matrix, points)
    seen = in_view & points_inside(warped, size)
    points_px = np.where(seen[:, None], warped, 0.0).astype(np.float32)
    told = seen & (rng.random(len(points)) < _share_told(rng))
    return Sample(image, points_px, seen.astype(np.float32), told, _warped_pose(cache, row, matrix, size))


def _share_told(rng: np.random.Generator) -> float:
    return rng.uniform(0, MOST_TOLD) if rng.random() < TOLD_OF else 0.0


def draw_box(rng: np.random.Generator, cache: Cache, row: int, size: int) -> Sample:
    """A whole picture; the two points are the corners of the craft's box, clipped to the input."""
    matrix = picture_warp(rng, cache.size, size, PictureAugmentation())
    image = photometric(rng, warp_image(cache.images[row], matrix, size), Augmentation())
    corners = warp_points(matrix, cache.boxes_px[row].astype(np.float64).reshape(2, 2)).clip(0, size)
    low, high = corners.min(axis=0), corners.max(axis=0)
    seen = float((high - low).min() > size / 64)
    points_px, weight = np.stack([low, high]).astype(np.float32), np.full(2, seen, dtype=np.float32)
    return Sample(image, points_px, weight, np.zeros(2, dtype=bool), _warped_pose(cache, row, matrix, size))


def _warped_pose(cache: Cache, row: int, matrix: Float[ndarray, "3 3"], size: int) -> Float[ndarray, "7"]:
    vector = cache.poses[row].astype(np.float64)
    if np.isfinite(vector).all():
        vector = CropPose.from_vector(vector).warped(matrix, cache.size, size).vector
    return vector.astype(np.float32)


def points_inside(points: Float[ndarray, "n 2"], size: int) -> Bool[ndarray, " n"]:
    return np.all((points >= 0) & (points <= size), axis=1)


@dataclass(frozen=True)
class Loader:
    """Batches without end, from any position: sample i of epoch e is a function of (seed, e, i) alone."""

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
            torch.from_numpy(np.stack([sample.told for sample in samples])),
            torch.from_numpy(np.stack([sample.pose for sample in samples])),
            position + stage.batch * self.world,
        )

    def batches(self, position: int, stage_at: Callable[[int], Stage]) -> Generator[Batch, None, None]:
        """Batches from `position` on; `stage_at(position)` says how large the next one is. Close it when done."""
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
