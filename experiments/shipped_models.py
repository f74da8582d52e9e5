"""The models that ship: for each spacecraft a locator and a gknet-s, trained on the `skd` recipe, and their figures.

    pip install '.[render,train]'
    python experiments/shipped_models.py --work runs/shipped --start src/gknet/models --out models --results results/new

Hardware   2 CPU cores, no GPU
Time       45 minutes of rendering, then 70 minutes of training: two runs at a time, one thread each, which is faster
           than one run on two threads
Expected   the table of README.md, printed by experiments/shipped_tables.py from RESULTS

--start names the models of the release before, whose weights are trained on, with another --seed than theirs, or they
see the same images in the same order again; with --keep-locators its locators ship as they are. Without --start all
three begin with a run of 17 minutes on the first one. What ships is the mean of the weights before and after a run,
with the share that validates best, if both are of the same network. Every stage keeps what is done: run the command
again after an interruption.
Only train sequences are trained on, val sequences choose the weights and scale the covariances, and test sequences
serve `judge` alone.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import gknet.io.openmp  # noqa: F401 (before torch)

# isort: split
import torch
from torch import Tensor

from gknet.dataset.skd import SkdDataset, open_dataset
from gknet.errors import ends_in_one_line
from gknet.fleet import NAMES
from gknet.inference.load import load_estimator
from gknet.network.build import build
from gknet.render.generate import generate
from gknet.render.options import Options, Selection
from gknet.render.recipe import RECIPES, Recipe
from gknet.render.render_progress import RenderProgress
from gknet.report.write import evaluate_section, write_report
from gknet.training.checkpoint import BEST, CHECKPOINT, load_weights, save_weights
from gknet.training.export import export_run
from gknet.training.run_file import load_run
from gknet.training.schedule import Stage
from gknet.training.settings import TrainSettings
from gknet.training.setup import make_task
from gknet.training.train import train
from gknet.training.validation import validation_rows

KINDS = ("keypoints", "locator")
DATA_SEED = 0
FIRST_RATE, FURTHER_RATE = 4e-3, 2e-3
"""From scratch, and of weights that are trained on: the first rate would undo much of what they know."""
SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Of the later weights in the mean with those that a run began with."""
FIRST = "first"
FIRST_STAGES = (Stage(0.55, 128, 16), Stage(0.25, 192, 16), Stage(0.20, 256, 16))
KEYPOINT_STAGES = (Stage(1.0, 192, 16),)
FULL_STAGES = (Stage(0.4, 128, 32), Stage(0.2, 192, 32), Stage(0.4, 256, 32))


@dataclass(frozen=True)
class Scale:
    """How much is rendered and trained. `every` = 2 takes each second frame of a sequence of 300.

    sequences         of the training data, for all three spacecraft, 3/5 of them to train on: more than skd's 300, with
                      few frames of each, since frames of one sequence share their light and their background
    first_minutes     of the run on the first spacecraft whose weights all three start from, unless others are given
    keypoint_minutes  of each spacecraft's own run
    jobs              runs at a time; each has its share of the cores
    """

    sequences: int
    crops_every: int
    pictures_every: int
    val_every: int
    test_every: int
    first_minutes: float
    keypoint_minutes: tuple[float, float, float]
    locator_minutes: float
    stages: tuple[Stage, ...]
    jobs: int


SCALES = {
    "cpu": Scale(
        sequences=4500,
        crops_every=50,
        pictures_every=100,
        val_every=30,
        test_every=15,
        first_minutes=17,
        keypoint_minutes=(38, 46, 36),
        locator_minutes=7,
        stages=KEYPOINT_STAGES,
        jobs=2,
    ),
    "full": Scale(
        sequences=4500,
        crops_every=6,
        pictures_every=30,
        val_every=10,
        test_every=1,
        first_minutes=60,
        keypoint_minutes=(600, 600, 600),
        locator_minutes=60,
        stages=FULL_STAGES,
        jobs=1,
    ),
}


def render(work: Path, scale: Scale, kinds: tuple[str, ...] = KINDS) -> None:
    """Crops to train the keypoints on, small whole images for the locators, whole frames to judge by.

    The first 300 sequences of the longer recipe are skd's own, so its train split holds none of skd's val and test.
    """
    longer = RECIPES["skd"].model_copy(update={"sequences": scale.sequences})
    for name in NAMES:
        train, val, test = (
            Selection((name,), split, every=every)
            for split, every in (("train", scale.crops_every), ("val", scale.val_every), ("test", scale.test_every))
        )
        render_part(longer, work / "crops", Options(DATA_SEED, "target"), train)
        if "locator" in kinds:
            few = replace(train, every=scale.pictures_every)
            render_part(longer, work / "pictures", Options(DATA_SEED, size=256), few)
        render_part("skd", work / "frames", Options(DATA_SEED), val)
        render_part("skd", work / "frames", Options(DATA_SEED), test)
        render_part("skd-hard", work / "hard", Options(DATA_SEED), test)


def render_part(recipe: str | Recipe, out: Path, options: Options, selection: Selection) -> None:
    with RenderProgress() as progress:
        generate(recipe, out, options, selection, on_progress=progress.show)


@dataclass(frozen=True)
class Job:
    """A training: of a spacecraft, on the dataset `work / data`, into the folder `work / "runs" / run`."""

    work: Path
    data: str
    name: str
    run: str
    settings: TrainSettings


def jobs(work: Path, scale: Scale, start: Path | None, seed: int, kinds: tuple[str, ...] = KINDS) -> list[Job]:
    """The keypoint networks, then the locators; from the models in `start`, or from the first run's weights."""
    keypoints: list[Job] = []
    locators: list[Job] = []
    for name, minutes in zip(NAMES, scale.keypoint_minutes, strict=True):
        init: Path | None = work / "runs" / FIRST / BEST if start is None else start / name / "keypoints.onnx"
        settings = run_settings("gknet-s", minutes, 6, seed, init, scale.stages)
        keypoints.append(Job(work, "crops", name, f"{name}_keypoints", settings))
        init = None if start is None else start / name / "locator.onnx"
        settings = run_settings("locator", scale.locator_minutes, 3, seed, init, None)
        locators.append(Job(work, "pictures", name, f"{name}_locator", settings))
    return keypoints + (locators if "locator" in kinds else [])


def run_settings(
    network: str, minutes: float, validations: int, seed: int, init: Path | None, stages: tuple[Stage, ...] | None
) -> TrainSettings:
    return TrainSettings(
        network,
        minutes=minutes,
        stages=stages,
        learning_rate=FIRST_RATE if init is None else FURTHER_RATE,
        validations=validations,
        val_frames=200,
        seed=seed,
        init=init,
    )


def check_start(start: Path | None) -> None:
    """Before hours of rendering, not after them."""
    if start is None:
        return
    for name in NAMES:
        for kind in KINDS:
            load_weights(start / name / f"{kind}.onnx")


def train_all(work: Path, scale: Scale, start: Path | None, seed: int, kinds: tuple[str, ...] = KINDS) -> None:
    """Every network, `scale.jobs` at a time."""
    if start is None:
        settings = run_settings("gknet-s", scale.first_minutes, 6, seed, None, FIRST_STAGES)
        run(Job(work, "crops", NAMES[0], FIRST, settings))
    threads = max(1, (os.cpu_count() or 1) // scale.jobs)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(scale.jobs, context, torch.set_num_threads, (threads,)) as pool:
        for future in as_completed([pool.submit(run_and_blend, job) for job in jobs(work, scale, start, seed, kinds)]):
            print(future.result(), flush=True)


def run_and_blend(job: Job) -> str:
    return f"{run(job)}; {blend(job)}"


def run(job: Job) -> str:
    """One training, from where it stopped; crops or small images to learn from, whole frames to validate on."""
    work, out = job.work, job.work / "runs" / job.run
    resume = (out / CHECKPOINT).exists()
    state = train(work / job.data, job.name, out, job.settings, resume, work / "cache", work / "frames", quiet=True)
    return f"{out}: {state.samples} samples in {state.elapsed_s / 60:.1f} min, best {state.best}"


def blend(job: Job) -> str:
    """Into "blended": the mean of the weights before and after the run, with the share that validates best.

    Weights that are trained on forget some of what they knew; a mean of both knows more than either (Wortsman et al.
    2022, "Robust fine-tuning of zero-shot models").
    """
    trained, out = job.work / "runs" / job.run, job.work / "blended" / job.run
    if (out / BEST).exists():
        return f"{out}: done before"
    val_data = SkdDataset(job.work / "frames", "val", job.name)
    rows = validation_rows(len(val_data), job.settings.val_frames)
    record = load_run(trained)
    network = build(
        record.network, val_data.spacecraft.adjacency, val_data.spacecraft.points_m, record.graph, record.loss
    ).eval()
    task = make_task(network, val_data.spacecraft, job.settings)
    before = after = load_weights(trained / BEST)
    if job.settings.init is not None:
        before = load_weights(job.settings.init)
    if shapes(before) != shapes(after):  # of another network, which gave what fitted
        before = after
    found = {}
    for share in SHARES:
        network.load_state_dict(mean(before, after, share))
        found[share] = task.validate(network, torch.device("cpu"), val_data, rows)
        if before is after:
            break
    share = min(found, key=lambda share: found[share].score)
    best = {"score": found[share].score, "share": share, **found[share].values}
    out.mkdir(parents=True, exist_ok=True)
    replace(record, best=best).save(out)
    save_weights(out / BEST, mean(before, after, share), {"network": record.network, "graph": record.graph})
    return f"{out}: " + ", ".join(f"share {each} scores {found[each].score:.4g}" for each in found)


def shapes(weights: dict[str, Tensor]) -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in weights.items()}


def mean(before: dict[str, Tensor], after: dict[str, Tensor], share: float) -> dict[str, Tensor]:
    """`share` of the later weights; whole numbers are counters and stay."""
    return {
        name: torch.lerp(before[name], new, share) if new.is_floating_point() else new for name, new in after.items()
    }


def ship(work: Path, out: Path, start: Path | None, kinds: tuple[str, ...] = KINDS) -> None:
    """Those of `kinds` from their runs, the others from the models in `start`."""
    for name, kind in product(NAMES, KINDS):
        if kind in kinds:
            export_run(work / "blended" / f"{name}_{kind}", out / name)
        else:
            assert start is not None
            shutil.copyfile(start / name / f"{kind}.onnx", out / name / f"{kind}.onnx")


def judge(work: Path, models: Path, results: Path) -> None:
    """The test sequences of both recipes, each crop as it is and with 4 rotations averaged; the repository keeps the
    figures alone."""
    results.mkdir(parents=True, exist_ok=True)
    for name, (data, recipe), tta_rotations in product(NAMES, (("frames", "skd"), ("hard", "skd-hard")), (1, 4)):
        pages = work / "evaluation" / f"{name}_{data}_{tta_rotations}"
        pages.mkdir(parents=True, exist_ok=True)
        estimator = load_estimator(models / name, tta_rotations=tta_rotations)
        dataset = open_dataset(work / data, estimator.spacecraft, "test", 1)
        section = evaluate_section(dataset, estimator, f"{data}, split test", pictures=6)
        write_report(pages, f"Pose of {name} on {data}", [section], section.evaluation.to_dict())
        shutil.copyfile(
            pages / "metrics.json", results / f"{name}_{recipe}{'_tta4' if tta_rotations == 4 else ''}.json"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--work", type=Path, required=True, help="folder of data, caches and runs (30 GB at full scale)"
    )
    parser.add_argument("--start", type=Path, help="folder of the models whose weights are trained on")
    parser.add_argument("--keep-locators", action="store_true", help="ship those of --start as they are")
    parser.add_argument("--out", type=Path, required=True, help="folder of the exported models")
    parser.add_argument("--results", type=Path, required=True, help="folder of the figures")
    parser.add_argument("--seed", type=int, default=1, help="of the trainings; the data has a seed of its own")
    parser.add_argument("--scale", choices=sorted(SCALES), default="cpu")
    arguments = parser.parse_args()
    if arguments.keep_locators and arguments.start is None:
        parser.error("--keep-locators: expected --start beside it, which names the models whose locators ship")
    scale, start = SCALES[arguments.scale], arguments.start
    kinds = KINDS[:1] if arguments.keep_locators else KINDS
    check_start(start)
    render(arguments.work, scale, kinds)
    train_all(arguments.work, scale, start, arguments.seed, kinds)
    ship(arguments.work, arguments.out, start, kinds)
    judge(arguments.work, arguments.out, arguments.results)


if __name__ == "__main__":
    with ends_in_one_line():
        main()
