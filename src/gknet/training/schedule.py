"""What depends on how far the training is: input size, batch and learning rate, functions of progress 0 to 1."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gknet.errors import GknetError


@dataclass(frozen=True)
class Stage:
    """A stretch of the training: its share of the budget, the input's side in pixels and the batch."""

    share: float
    input_size: int
    batch: int

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise GknetError(f"stage: expected a share in (0, 1], got {self.share}")
        if self.input_size < 32 or self.input_size % 32:
            raise GknetError(f"stage: expected an input size that is a multiple of 32, got {self.input_size}")
        if self.batch < 1:
            raise GknetError(f"stage: expected a batch of at least 1, got {self.batch}")


def parse_stages(text: str) -> tuple[Stage, ...]:
    """Stages from '0.4:128:64,0.6:256:32', each share:input_size:batch."""
    stages = []
    for part in text.split(","):
        try:
            share, size, batch = part.split(":")
            stages.append(Stage(float(share), int(size), int(batch)))
        except ValueError as error:
            raise GknetError(f"stages: expected share:input_size:batch,... such as 1:256:32, got '{text}'") from error
    total = sum(stage.share for stage in stages)
    if abs(total - 1) > 1e-6:
        raise GknetError(f"stages: expected shares that sum to 1, got {total:g}")
    return tuple(stages)


def stage_at(stages: tuple[Stage, ...], progress: float) -> Stage:
    end = 0.0
    for stage in stages:
        end += stage.share
        if progress < end - 1e-12:
            return stage
    return stages[-1]


def learning_rate(peak: float, progress: float, warm_up: float, cycles: int = 1) -> float:
    """Linear up to `peak` during the share `warm_up`, then half a cosine down to zero, `cycles` times over.

    More than one cycle are the warm restarts of the paper's training (80 epochs, one every 16).
    """
    if progress < warm_up:
        return peak * max(progress / warm_up, 0.01)
    along = min(1.0, (progress - warm_up) / (1 - warm_up))
    if along < 1:
        along = cycles * along % 1
    return peak * 0.5 * (1 + math.cos(math.pi * along))


@dataclass(frozen=True)
class Budget:
    """How long to train: by the clock or by the samples seen; exactly one of the two."""

    minutes: float | None = None
    samples: int | None = None

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.samples is None):
            raise GknetError("budget: give either minutes or epochs")
        if (self.minutes if self.minutes is not None else self.samples or 0) <= 0:
            raise GknetError(f"budget: expected a positive length, got {self.minutes or self.samples}")

    def progress(self, samples: int, elapsed_s: float) -> float:
        """0 at the start, 1 when the budget is spent."""
        if self.minutes is not None:
            return min(1.0, elapsed_s / (60 * self.minutes))
        assert self.samples is not None
        return min(1.0, samples / self.samples)
