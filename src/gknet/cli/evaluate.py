"""`gknet eval`: errors of a model on a dataset, oracle crop and detected crop side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gknet.cli.model_options import (
    DeviceOption,
    ModelOption,
    RotationsOption,
    SpacecraftOption,
    ThreadsOption,
    model_folder,
    open_estimator,
)
from gknet.cli.terminal import print_line, print_table

if TYPE_CHECKING:
    from gknet.evaluation.evaluate import Evaluation


def evaluate(
    data: Annotated[Path, typer.Argument(metavar="DATA", help="An SKD dataset folder.")],
    spacecraft: SpacecraftOption = None,
    model: ModelOption = None,
    split: Annotated[str, typer.Option(help="train, val, test, or all.")] = "test",
    every: Annotated[int, typer.Option(min=1, help="Take each n-th frame of a sequence.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for metrics.json and report.html.")] = Path("evaluation"),
    images: Annotated[int, typer.Option(min=0, max=1000, help="Images in each gallery of the report.")] = 6,
    threads: ThreadsOption = None,
    device: DeviceOption = "cpu",
    tta_rotations: RotationsOption = 1,
) -> None:
    """Score a model on a dataset with true poses: metrics.json and a report."""
    from gknet.dataset.skd import open_dataset
    from gknet.io.atomic import output_folder
    from gknet.io.progress import progress
    from gknet.report.table import metric_table
    from gknet.report.write import evaluate_section, write_report

    estimator = open_estimator(model_folder(spacecraft, model), threads, device, tta_rotations)
    dataset = open_dataset(data, estimator.spacecraft, None if split == "all" else split, every)
    name = data.resolve().name
    words = f"{name}, split {split}" + (f", every {every}th frame" if every > 1 else "")
    with output_folder(out):
        with progress() as bar:
            task = bar.add_task("frames", total=len(dataset))
            section = evaluate_section(dataset, estimator, words, images, lambda: bar.advance(task))
        title = f"Pose of {estimator.spacecraft.name} on {name}"
        written = write_report(out, title, [section], section.evaluation.to_dict())
    print_table(metric_table(section.evaluation))
    print_gaps(section.evaluation)
    for path in written:
        print_line(f"wrote {path}")


def print_gaps(evaluation: Evaluation) -> None:
    """One line for each thing that the dataset lacks, and one for the frames that are in no mean."""
    from gknet.evaluation.evaluate import UNKNOWN_WORDS
    from gknet.io.text import counted

    for column in evaluation.unknown:
        print_line(f"unknown, no column '{column}': {UNKNOWN_WORDS[column]}")
    bad = evaluation.skipped
    if bad:
        print_line(f"{counted(len(bad), 'frame')} skipped; the first, {bad[0].name}: {bad[0].failure}")
