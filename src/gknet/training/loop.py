"""The training loop, in one piece."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import torch

from gknet import __version__
from gknet.dataset.skd import SkdDataset
from gknet.errors import DivergedError, GknetError
from gknet.io.spacecraft_file import spacecraft_toml
from gknet.network.build import build
from gknet.network.locator import Locator
from gknet.training.batch import Loader
from gknet.training.checkpoint import (
    BEST,
    CHECKPOINT,
    TrainingState,
    load_checkpoint,
    save_checkpoint,
    save_weights,
    warm_start,
)
from gknet.training.metric_logger import MetricLogger
from gknet.training.optimizer import make_optimizer
from gknet.training.schedule import Budget, learning_rate, stage_at
from gknet.training.settings import TrainingRun, TrainSettings
from gknet.training.setup import check_cameras, make_fabric, make_task, open_cache, update_average
from gknet.training.validation import usable_rows, validation_rows

REPORT_STEPS = 50
CHECKPOINT_S = 120.0


def train(
    data: Path,
    spacecraft_name: str,
    out: Path,
    settings: TrainSettings,
    resume: bool = False,
    cache_folder: Path | None = None,
    val: Path | None = None,
    quiet: bool = False,
    on_step: Callable[[int], None] = lambda samples: None,
) -> TrainingState:
    """Train on the train split of the SKD folder `data`, validate on the val split of the folder `val`.

    val           `data` when None; crops to train on and whole frames to validate on are folders of their own
    out           gets run.json, metrics.csv, tensorboard/, checkpoint.pt and best.safetensors (averaged weights)
    resume        go on from out/checkpoint.pt; a larger budget prolongs the run
    cache_folder  of the decoded crops; data/cache when None
    on_step       called after each step with the samples seen so far
    """
    cv2.setNumThreads(1)
    if not resume and (out / CHECKPOINT).exists():
        raise GknetError(f"{out}: it holds a training already; --resume goes on with it, or choose another folder")
    training_data = SkdDataset(data, "train", spacecraft_name)
    val_data = SkdDataset(val or data, "val", spacecraft_name)
    spacecraft = training_data.spacecraft
    fabric = make_fabric(settings)
    torch.manual_seed(settings.seed)
    network = build(settings.network, spacecraft.adjacency, spacecraft.points_m, settings.graph, settings.chosen_loss)
    if settings.init is not None and not resume:
        taken, total = warm_start(network, settings.init)
        fabric.print(f"{settings.init}: {taken} of {total} tensors taken")
    check_cameras(network, training_data)
    rows = usable_rows(val_data, validation_rows(len(val_data), settings.val_frames), spacecraft, fabric.print)
    with fabric.rank_zero_first():
        cache = open_cache(training_data, settings, cache_folder or data / "cache", fabric.print)

    task = make_task(network, spacecraft, settings)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(network).to(fabric.device).eval()
    model, optimizer = fabric.setup(network, make_optimizer(network, settings))
    if not isinstance(network, Locator):
        model.mark_forward_method("branches")

    kind = f"{settings.network} ({settings.graph}, {settings.chosen_loss})"
    identity = f"{kind}, {spacecraft.name} with {spacecraft.keypoint_count} keypoints, seed {settings.seed}"
    state = load_checkpoint(out, network, average, optimizer, identity) if resume else TrainingState()
    toml = spacecraft_toml(replace(spacecraft, mesh_path=None))
    run = TrainingRun(
        settings.network,
        settings.graph,
        settings.chosen_loss,
        settings.input_size,
        toml,
        asdict(settings),
        __version__,
        str(data),
        state.best,
    )
    budget = Budget(settings.minutes, None if settings.epochs is None else round(settings.epochs * len(cache)))
    out.mkdir(parents=True, exist_ok=True)
    stages = settings.input_stages
    started = time.monotonic() - state.elapsed_s
    loader = Loader(cache, task.draw, settings.seed, fabric.global_rank, fabric.world_size)
    batches = loader.batches(
        state.samples, lambda place: stage_at(stages, budget.progress(place, time.monotonic() - started))
    )

    def save() -> None:
        if fabric.is_global_zero:
            run.save(out)
            save_checkpoint(out, state, network, average, optimizer, identity)

    def validate() -> dict[str, float]:
        """Look at the averaged weights, keep them if they are the best."""
        nonlocal run
        if not fabric.is_global_zero:
            return {}
        found = task.validate(average, fabric.device, val_data, rows)
        if state.best is None or found.score < state.best["score"]:
            state.best = {"score": found.score, "samples": state.samples, **found.values}
            run = replace(run, best=state.best)
            save_weights(
                out / BEST, average.state_dict(), {"network": run.network, "graph": run.graph, "loss": run.loss}
            )
        return {f"val_{name}": value for name, value in found.values.items()}

    with MetricLogger(out, state.history, quiet or not fabric.is_global_zero) as logger, closing(batches):
        progress = budget.progress(state.samples, state.elapsed_s)
        reported, saved = (state.samples, time.monotonic()), time.monotonic()
        losses: list[float] = []
        try:
            while progress < 1:
                batch = next(batches)
                rate = learning_rate(settings.learning_rate, progress, settings.warm_up, settings.cycles)
                for group in optimizer.param_groups:
                    group["lr"] = rate
                model.train()
                with fabric.autocast():  # Fabric itself casts in forward() alone, not in the other methods
                    loss = task.loss(model, batch, fabric.device)
                optimizer.zero_grad()
                fabric.backward(loss)
                fabric.clip_gradients(model, optimizer, max_norm=settings.clip, error_if_nonfinite=False)
                optimizer.step()
                update_average(average, network, min(settings.ema, (1 + state.steps) / (10 + state.steps)))

                before, now = progress, time.monotonic()
                state.samples, state.steps, state.elapsed_s = batch.position, state.steps + 1, now - started
                progress = budget.progress(state.samples, state.elapsed_s)
                losses.append(loss.item())
                if not math.isfinite(losses[-1]):
                    raise DivergedError(f"train: the loss became {losses[-1]} after {state.steps} steps; lower --lr")
                validating = math.floor(progress * settings.validations) > math.floor(before * settings.validations)
                if validating or state.steps % REPORT_STEPS == 0:
                    row = {
                        "progress": progress,
                        "elapsed_s": state.elapsed_s,
                        "samples": float(state.samples),
                        "input_size": float(batch.image.shape[1]),
                        "learning_rate": rate,
                        "loss": sum(losses) / len(losses),
                        "images_per_s": (state.samples - reported[0]) / max(1e-9, now - reported[1]),
                    }
                    if validating:
                        row |= validate()
                        fabric.barrier()
                        state.elapsed_s = time.monotonic() - started
                    logger.log(row, state.elapsed_s / max(progress, 1e-9) * (1 - progress))
                    reported, losses = (state.samples, time.monotonic()), []
                on_step(state.samples)
                if validating or time.monotonic() - saved > CHECKPOINT_S:
                    save()
                    saved = time.monotonic()
        except KeyboardInterrupt:
            save()
            raise
    return state
