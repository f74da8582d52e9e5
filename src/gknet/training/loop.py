"""The training loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from lightning_fabric import Fabric

from gknet.errors import DivergedError
from gknet.frame import Frame
from gknet.io.interrupt import Interrupted, Interruption
from gknet.training.batch import Batch, Loader
from gknet.training.checkpoint import (
    BEST,
    TrainingState,
    save_checkpoint,
    save_weights,
)
from gknet.training.learner import Learner
from gknet.training.metric_logger import MetricLogger
from gknet.training.run_file import TrainingRun
from gknet.training.schedule import Budget, Stage, learning_rate, stage_at
from gknet.training.settings import TrainSettings
from gknet.training.tasks import Task
from gknet.training.validation import InterruptibleFrames

REPORT_STEPS = 50
CHECKPOINT_S = 120.0


@dataclass(eq=False)
class Trainer:
    """A training run that is ready to go, or to go on: `run()` takes steps until the budget is spent.

    With a budget in samples every state is a function of the settings and the data alone, however often the run was
    stopped on its way there: the batch of a step and its learning rate follow from the samples seen, and a run stops
    between steps only. With a budget in minutes they follow from the clock.

    Attributes:
        out: Folder of run.json, metrics.csv, tensorboard/, checkpoint.pt and best.safetensors.
        settings: Of the run.
        record: The content of run.json.
        identity: What a checkpoint in `out` must agree with.
        fabric: The devices.
        task: Draws samples, computes the loss, validates.
        learner: The network and its optimizer.
        loader: Of the training data.
        frames: The val split, of which `rows` are used.
        rows: Of `frames`.
        budget: In samples or minutes.
        state: How far it is.
        logger: Of metrics.
        on_step: Called after each step with the samples seen so far.
    """

    out: Path
    settings: TrainSettings
    record: TrainingRun
    identity: dict[str, str]
    fabric: Fabric
    task: Task
    learner: Learner
    loader: Loader
    frames: Sequence[Frame]
    rows: Sequence[int]
    budget: Budget
    state: TrainingState
    logger: MetricLogger
    on_step: Callable[[int], None] = lambda samples: None

    def __post_init__(self) -> None:
        self._interruption = Interruption()
        self._started = self._reported_s = 0.0
        self._reported_samples = 0

    def run(self) -> TrainingState:
        """Train until the budget is spent.

        Returns:
            The last state, which is also in the checkpoint.

        Raises:
            Interrupted: A stop signal came (see `gknet.io.interrupt`). The checkpoint is of the last whole step.
            DivergedError: The loss is no number any more.
        """
        self._start_clocks()
        saved = time.monotonic()
        with self._interruption, self.logger, closing(self._batches()) as batches:
            while (was_due := self.state.is_validation_due) or self.progress < 1:
                if was_due:
                    self.validate()
                else:
                    self.step(next(batches))
                is_stopping = self._is_stopping()
                if was_due or is_stopping or time.monotonic() - saved > CHECKPOINT_S:
                    self.save()
                    saved = time.monotonic()
                if is_stopping:
                    self._interruption.raise_if_requested()
                    raise Interrupted  # another process of this run got the signal
        return self.state

    @property
    def progress(self) -> float:
        """0 at the start, 1 when the budget is spent."""
        return self.budget.progress(self.state.samples, self.state.elapsed_s)

    def step(self, batch: Batch) -> None:
        """Learn from one batch; a validation that it makes due comes next."""
        state, before = self.state, self.progress
        rate = learning_rate(self.settings.learning_rate, before, self.settings.warm_up, self.settings.cycles)
        loss = self.learner.step(batch, rate, state.steps).item()
        state.samples, state.steps, state.elapsed_s = batch.position, state.steps + 1, self._elapsed_s()
        state.learning_rate, state.input_size = rate, batch.image.shape[1]
        state.losses.append(loss)
        if not math.isfinite(loss):
            raise DivergedError(f"train: the loss became {loss} after {state.steps} steps; lower --lr")
        count = self.settings.validations
        state.is_validation_due = math.floor(self.progress * count) > math.floor(before * count)
        if not state.is_validation_due and state.steps % REPORT_STEPS == 0:
            self._report({})
        self.on_step(state.samples)

    def validate(self) -> None:
        """Validate the averaged weights and keep them if they are the best; one that is interrupted stays due."""
        values: dict[str, float] = {}
        try:
            if self.fabric.is_global_zero:
                values = self._validated()
        except Interrupted:
            return
        finally:
            self.fabric.barrier()
        self.state.is_validation_due = False
        self.state.elapsed_s = self._elapsed_s()
        self._report(values)

    def save(self) -> None:
        """Write run.json and the checkpoint."""
        if self.fabric.is_global_zero:
            self.record.save(self.out)
            save_checkpoint(self.out, self.state, self.learner, self.identity)

    def _validated(self) -> dict[str, float]:
        frames = InterruptibleFrames(self.frames, self._interruption)
        found = self.task.validate(self.learner.average, self.fabric.device, frames, self.rows)
        if self.state.best is None or found.score < self.state.best["score"]:
            best = {"score": found.score, "samples": self.state.samples, **found.values}
            self._keep(best)
        return {f"val_{name}": value for name, value in found.values.items()}

    def _keep(self, best: dict[str, float]) -> None:
        record = replace(self.record, best=best)
        metadata = {name: getattr(record, name) for name in ("network", "graph", "loss", "best")}
        save_weights(self.out / BEST, self.learner.average.state_dict(), metadata)
        self.state.best, self.record = best, record

    def _report(self, values: dict[str, float]) -> None:
        """A row of metrics: the mean over the steps since the last one, and the values of a validation."""
        state, seconds = self.state, max(1e-9, time.monotonic() - self._reported_s)
        row = {
            "progress": self.progress,
            "elapsed_s": state.elapsed_s,
            "samples": float(state.samples),
            "input_size": float(state.input_size),
            "learning_rate": state.learning_rate,
            "loss": sum(state.losses) / len(state.losses),
            "images_per_s": (state.samples - self._reported_samples) / seconds,
        }
        self.logger.log(row | values, state.elapsed_s / max(self.progress, 1e-9) * (1 - self.progress))
        state.losses.clear()
        self._reported_samples, self._reported_s = state.samples, time.monotonic()

    def _start_clocks(self) -> None:
        self._started = time.monotonic() - self.state.elapsed_s
        self._reported_samples, self._reported_s = self.state.samples, time.monotonic()

    def _batches(self) -> Generator[Batch, None, None]:
        return self.loader.batches(self.state.samples, self._stage)

    def _stage(self, samples: int) -> Stage:
        return stage_at(self.settings.input_stages, self.budget.progress(samples, self._elapsed_s()))

    def _elapsed_s(self) -> float:
        return time.monotonic() - self._started

    def _is_stopping(self) -> bool:
        """Whether any process of this run got a stop signal: all of them stop after the same step."""
        is_requested = self._interruption.requested
        if self.fabric.world_size == 1:
            return is_requested
        requests = self.fabric.all_reduce(torch.tensor(float(is_requested)), reduce_op="sum")
        return bool(cast(torch.Tensor, requests) > 0)
