"""What depends on how far the training is: input size, batch and learning rate, functions of progress 0 to 1."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from gknet.errors import GknetError
from gknet.network.spec import Stage


def parse_stages(text: str) -> tuple[Stage, ...]:
    """Stages from text such as '0.4:128:64,0.6:256:32', each share:input_size:batch.

    Raises:
        GknetError: The text is of another form, or the shares do not sum to 1.
    """
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


def stages_text(stages: Sequence[Stage]) -> str:
    """The text that `parse_stages` reads."""
    return ",".join(f"{stage.share:g}:{stage.input_size}:{stage.batch}" for stage in stages)


def stage_at(stages: tuple[Stage, ...], progress: float) -> Stage:
    """The stage at a progress from 0 to 1."""
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
    """How long to train.

    Attributes:
        minutes: By the clock; or
        samples: images seen. Exactly one of the two.
    """

    minutes: float | None = None
    samples: int | None = None

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.samples is None):
            raise GknetError("budget: expected either minutes or samples")
        if (self.minutes if self.minutes is not None else self.samples or 0) <= 0:
            raise GknetError(f"budget: expected a positive length, got {self.minutes or self.samples}")

    @classmethod
    def of(cls, samples: int | None, epochs: float | None, minutes: float | None, count: int) -> Budget:
        """The budget of the settings, with `count` samples to an epoch."""
        return cls(minutes, max(1, round(epochs * count)) if epochs is not None else samples)

    def progress(self, samples: int, elapsed_s: float) -> float:
        """0 at the start, 1 when the budget is spent."""
        if self.minutes is not None:
            return min(1.0, elapsed_s / (60 * self.minutes))
        assert self.samples is not None
        return min(1.0, samples / self.samples)
