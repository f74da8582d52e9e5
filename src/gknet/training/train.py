"""A training run from its settings: everything is built and checked, then the loop runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import cv2
from lightning_fabric.utilities.rank_zero import rank_zero_only

from gknet import __version__
from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.io.lock import LOCK_NAME, locked
from gknet.io.spacecraft_file import spacecraft_toml
from gknet.spacecraft import Spacecraft
from gknet.training.batch import Loader
from gknet.training.checkpoint import CHECKPOINT, TrainingState, load_checkpoint
from gknet.training.learner import Learner
from gknet.training.loop import Trainer
from gknet.training.metric_logger import MetricLogger
from gknet.training.run_file import TrainingRun
from gknet.training.schedule import Budget
from gknet.training.settings import TrainSettings
from gknet.training.setup import check_cameras, make_fabric, make_network, make_task, open_cache
from gknet.training.validation import usable_rows, validation_rows


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
    """Train on the train split of an SKD folder, and validate on the val split.

    Args:
        data: The SKD folder.
        spacecraft_name: Which spacecraft of it.
        out: Folder that gets run.json, metrics.csv, tensorboard/, checkpoint.pt and best.safetensors.
        settings: Of the run.
        resume: Go on from out/checkpoint.pt. A larger budget prolongs the run; see `gknet.training.settings.MAY_CHANGE`
            for what else may differ.
        cache_folder: Of the decoded crops; data/cache when None.
        val: The SKD folder to validate on; `data` when None.
        quiet: Nothing on standard output.
        on_step: Called after each step with the samples seen so far.

    Returns:
        The state at the end.

    Raises:
        GknetError: Something in the arguments or the data is wrong, or another training writes to `out`.
        Interrupted: A stop signal came; see `Trainer.run`.
    """
    cv2.setNumThreads(1)
    training_data, val_data = (
        SkdDataset(data, "train", spacecraft_name),
        SkdDataset(val or data, "val", spacecraft_name),
    )
    spacecraft = training_data.spacecraft
    with run_folder(out):
        if not resume and (out / CHECKPOINT).exists():
            raise GknetError(f"{out}: it holds a training already; --resume goes on with it, or choose another folder")
        fabric = make_fabric(settings)
        network = make_network(spacecraft, settings, is_fresh=not resume)
        check_cameras(network, training_data)
        rows = usable_rows(val_data, validation_rows(len(val_data), settings.val_frames), spacecraft)
        with fabric.rank_zero_first():
            cache = open_cache(training_data, settings, cache_folder or data / "cache")
        task = make_task(network, spacecraft, settings)
        learner = Learner(network, task, settings, fabric)
        identity = identity_of(spacecraft, settings)
        state = load_checkpoint(out, learner, identity) if resume else TrainingState()
        loader = Loader(cache, task.draw, settings.seed, fabric.global_rank, fabric.world_size)
        budget = Budget.of(settings.samples, settings.epochs, settings.minutes, len(cache))
        record = record_of(spacecraft, settings, data, state.best)
        logger = MetricLogger(out, state.history, fabric.is_global_zero and not quiet, fabric.is_global_zero)
        return Trainer(
            out,
            settings,
            record,
            identity,
            fabric,
            task,
            learner,
            loader,
            val_data,
            rows,
            budget,
            state,
            logger,
            on_step,
        ).run()


@contextmanager
def run_folder(out: Path) -> Iterator[None]:
    """The folder `out`, made and locked for one training; one that is still empty at the end is removed."""
    if rank_zero_only.rank != 0:  # type: ignore[attr-defined]
        yield
        return
    is_new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        try:
            yield
        finally:
            if is_new and [path.name for path in out.iterdir()] == [LOCK_NAME]:
                (out / LOCK_NAME).unlink()
                out.rmdir()


def identity_of(spacecraft: Spacecraft, settings: TrainSettings) -> dict[str, str]:
    """What a resumed run must have in common with the run that it goes on with."""
    return {"spacecraft": f"{spacecraft.name} with {spacecraft.keypoint_count} keypoints", **settings.fixed}


def record_of(
    spacecraft: Spacecraft, settings: TrainSettings, data: Path, best: dict[str, float] | None
) -> TrainingRun:
    """The run as run.json has it."""
    return TrainingRun(
        settings.network,
        settings.graph,
        settings.chosen_loss,
        settings.input_size,
        spacecraft_toml(replace(spacecraft, mesh_path=None)),
        asdict(settings),
        __version__,
        str(data),
        best,
    )
