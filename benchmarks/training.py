"""How much of the bare training speed the real loop keeps, and what the paper's size costs.

    python benchmarks/training.py [DATA] [--spacecraft satellite_01] [--size 256] [--batch 32] [--steps 20] [--paper]

"bare" is forward, loss, backward and AdamW on one fixed batch that lies in memory. "loop" is the same network fed by
the loader from a cache: decoding is done, but warp, light and noise are drawn anew, weights are averaged and gradients
clipped, as `gknet train` does it. Both alternate in one process, so that their ratio means something on a busy machine.
Without DATA the images are noise: their content does not change the work.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import gknet.io.openmp  # noqa: F401 (before torch)

# isort: split
import cv2
import numpy as np
import torch

from gknet.dataset.skd import SkdDataset
from gknet.fleet import load
from gknet.network.build import build
from gknet.spacecraft import Spacecraft
from gknet.training.batch import Batch, Loader
from gknet.training.cache import Cache
from gknet.training.learner import update_average
from gknet.training.optimizer import make_optimizer
from gknet.training.schedule import Stage
from gknet.training.settings import TrainSettings
from gknet.training.setup import cpu_has_bf16, make_task, open_cache

ROUNDS = 4


def noise_cache(spacecraft: Spacecraft, count: int = 512, size: int = 320) -> Cache:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.2 * size, 0.8 * size, (count, spacecraft.keypoint_count, 2)).astype(np.float32)
    boxes = np.concatenate([points.min(axis=1), points.max(axis=1)], axis=1)
    images = rng.integers(0, 256, (count, size, size, 3), dtype=np.uint8)
    poses = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], dtype=np.float32), (count, 1))
    return Cache(images, points, np.ones(points.shape[:2], dtype=bool), boxes, poses)


def stepper(network_name: str, spacecraft: Spacecraft, averaged: bool) -> Callable[[Batch], None]:
    """One training step on a batch; with averaging and clipping when it is the real loop's."""
    settings = TrainSettings(network_name, epochs=1)
    network = build(network_name, spacecraft.adjacency, spacecraft.points_m)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(network)
    task, optimizer, device = (
        make_task(network, spacecraft, settings),
        make_optimizer(network, settings),
        torch.device("cpu"),
    )

    def step(batch: Batch) -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=cpu_has_bf16()):
            loss = task.loss(network, batch, device)
        optimizer.zero_grad()
        loss.backward()
        if averaged:
            torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip)
        optimizer.step()
        if averaged:
            update_average(average, network, settings.ema)

    return step


def seconds(step: Callable[[Batch], None], batches: Iterator[Batch], steps: int) -> float:
    start = time.perf_counter()
    for _ in range(steps):
        step(next(batches))
    return time.perf_counter() - start


def endless(batch: Batch) -> Iterator[Batch]:
    while True:
        yield batch


def compare(name: str, loader: Loader, spacecraft: Spacecraft, stage: Stage, steps: int) -> None:
    bare, real = stepper(name, spacecraft, averaged=False), stepper(name, spacecraft, averaged=True)
    fixed = endless(loader.batch(0, stage))
    with closing(loader.batches(0, lambda place: stage)) as stream:
        for step, batches in ((bare, fixed), (real, stream)):
            seconds(step, batches, 2)
        pairs = [(seconds(bare, fixed, steps), seconds(real, stream, steps)) for _ in range(ROUNDS)]
    images = steps * stage.batch
    rates = [images / statistics.median(column) for column in zip(*pairs, strict=True)]
    ratio = statistics.median(first / second for first, second in pairs)
    print(f"{name:12} {stage.input_size}  bare {rates[0]:7.1f} img/s  loop {rates[1]:7.1f} img/s  ratio {ratio:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, nargs="?", help="an SKD folder; noise without")
    parser.add_argument("--spacecraft", default="satellite_01")
    parser.add_argument("--size", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--paper", action="store_true", help="time gknet-paper as well (90 M parameters)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    spacecraft = load(arguments.spacecraft)
    settings = TrainSettings(epochs=1)
    with tempfile.TemporaryDirectory() as scratch:
        if arguments.data is None:
            cache = noise_cache(spacecraft)
        else:
            data = SkdDataset(arguments.data, "train", arguments.spacecraft)
            spacecraft = data.spacecraft
            cache = open_cache(data, settings, Path(scratch), print)
        task = make_task(build("gknet-s", spacecraft.adjacency, spacecraft.points_m), spacecraft, settings)
        loader = Loader(cache, task.draw, seed=0)
        for size in arguments.size:
            compare("gknet-s", loader, spacecraft, Stage(1.0, size, arguments.batch), arguments.steps)
        if arguments.paper:
            compare("gknet-paper", loader, spacecraft, Stage(1.0, 256, 4), 1)


if __name__ == "__main__":
    main()
