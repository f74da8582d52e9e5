"""The models that ship: for each spacecraft a locator and a gknet-s, trained on the `skd` recipe, and their figures.

    pip install '.[render,train]'
    python recipes/shipped_models.py --work runs/shipped --out src/gknet/models --results results/shipped_models

Hardware   2 CPU cores with bfloat16 (AVX-512), no GPU
Time       about 25 minutes of rendering, then 17 minutes for the first weights and 8 to 15 a spacecraft
Expected   the table of README.md, printed from results/shipped_models/*/metrics.json

Every stage keeps what is done: run the command again after an interruption. Only train sequences are trained on, val
sequences choose the weights and scale the covariances, and test sequences serve `judge` alone. README.md and
docs/experiments.md say where the making of the weights that ship differed from this.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import dataclass
from pathlib import Path

from gknet.cli.evaluate import evaluate
from gknet.fleet import NAMES
from gknet.render.generate import generate
from gknet.training.checkpoint import BEST, CHECKPOINT
from gknet.training.export import export_run
from gknet.training.loop import train
from gknet.training.schedule import Stage
from gknet.training.settings import TrainSettings

SEED = 0
FIRST_STAGES = (Stage(0.55, 128, 16), Stage(0.25, 192, 16), Stage(0.20, 256, 16))
KEYPOINT_STAGES = (Stage(0.55, 128, 16), Stage(0.45, 192, 16))
FULL_STAGES = (Stage(0.4, 128, 32), Stage(0.2, 192, 32), Stage(0.4, 256, 32))


@dataclass(frozen=True)
class Scale:
    """How much is rendered and trained. `every` = 2 takes each second frame of a sequence of 300.

    first_minutes     of the run on the first spacecraft whose weights all three start from
    keypoint_minutes  of each spacecraft's own run
    """

    crops_every: int
    pictures_every: int
    val_every: int
    test_every: int
    first_minutes: float
    keypoint_minutes: tuple[float, float, float]
    locator_minutes: float
    stages: tuple[Stage, ...]


SCALES = {
    "cpu": Scale(2, 6, 30, 15, 17, (5, 11.5, 9.5), 3, KEYPOINT_STAGES),
    "full": Scale(1, 1, 10, 1, 60, (600, 600, 600), 60, FULL_STAGES),
}


def render(work: Path, scale: Scale) -> None:
    """Crops to train the keypoints on, small whole pictures for the locator, whole frames to judge by."""
    for name in NAMES:
        generate("skd", work / "crops", SEED, name, "train", window="target", every=scale.crops_every)
        generate("skd", work / "pictures", SEED, name, "train", every=scale.pictures_every, size=256)
        generate("skd", work / "frames", SEED, name, "val", every=scale.val_every)
        generate("skd", work / "frames", SEED, name, "test", every=scale.test_every)
        generate("skd-hard", work / "hard", SEED, name, "test", every=scale.test_every)


def train_all(work: Path, scale: Scale) -> None:
    """Every keypoint network starts from one short run on the first spacecraft, where the shapes fit."""
    first = work / "runs" / "first"
    run(work, "crops", NAMES[0], first, keypoint_settings(scale.first_minutes, FIRST_STAGES, None))
    for name, minutes in zip(NAMES, scale.keypoint_minutes, strict=True):
        settings = keypoint_settings(minutes, scale.stages, first / BEST)
        run(work, "crops", name, work / "runs" / f"{name}_keypoints", settings)
        run(work, "pictures", name, work / "runs" / f"{name}_locator", locator_settings(scale.locator_minutes))


def run(work: Path, data: str, name: str, out: Path, settings: TrainSettings) -> None:
    """One training, from where it stopped; crops or small pictures to learn from, whole frames to validate on."""
    train(work / data, name, out, settings, (out / CHECKPOINT).exists(), work / "cache", val=work / "frames")


def keypoint_settings(minutes: float, stages: tuple[Stage, ...], init: Path | None) -> TrainSettings:
    return TrainSettings("gknet-s", minutes=minutes, stages=stages, validations=4, val_frames=100, seed=SEED, init=init)


def locator_settings(minutes: float) -> TrainSettings:
    return TrainSettings("locator", minutes=minutes, validations=2, val_frames=100, seed=SEED)


def ship(work: Path, out: Path) -> None:
    for name in NAMES:
        for kind in ("keypoints", "locator"):
            export_run(work / "runs" / f"{name}_{kind}", out / name)


def judge(work: Path, models: Path, results: Path) -> None:
    """The test sequences of both recipes, oracle crop and detected crop; the repository keeps the figures alone."""
    for name in NAMES:
        for data in ("frames", "hard"):
            pages = work / "evaluation" / f"{name}_{data}"
            evaluate(work / data, model=models / name, split="test", out=pages)
            kept = results / f"{name}_{'skd' if data == 'frames' else 'skd-hard'}.json"
            kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(pages / "metrics.json", kept)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--work", type=Path, required=True, help="folder of data, caches and runs (30 GB at full scale)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the exported models")
    parser.add_argument("--results", type=Path, required=True, help="folder of the figures")
    parser.add_argument("--scale", choices=sorted(SCALES), default="cpu")
    arguments = parser.parse_args()
    scale = SCALES[arguments.scale]
    render(arguments.work, scale)
    train_all(arguments.work, scale)
    ship(arguments.work, arguments.out)
    judge(arguments.work, arguments.out, arguments.results)


if __name__ == "__main__":
    main()
