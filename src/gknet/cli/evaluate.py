"""`gknet eval`: errors of a model on a dataset, oracle crop and detected crop side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from gknet.dataset.skd import SkdDataset
    from gknet.evaluation.evaluate import Evaluation
    from gknet.frame import PoseEstimator
    from gknet.report.page import Section


def evaluate(
    data: Annotated[Path, typer.Argument(metavar="DATA", help="An SKD dataset folder.")],
    spacecraft: Annotated[str | None, typer.Option(help="A shipped model: satellite_01, satellite_02, ...")] = None,
    model: Annotated[
        Path | None, typer.Option(help="A folder with keypoints.onnx (or direct.onnx), locator.onnx.")
    ] = None,
    split: Annotated[str, typer.Option(help="train, val, test, or all.")] = "test",
    every: Annotated[int, typer.Option(help="Take each n-th frame of a sequence.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for metrics.json and report.html.")] = Path("evaluation"),
    pictures: Annotated[int, typer.Option(help="Pictures in each gallery of the report.")] = 6,
    threads: Annotated[int | None, typer.Option(help="Threads of the network; all cores by default.")] = None,
    tta_rotations: Annotated[
        int, typer.Option(help="Average the heatmaps of 1, 2 or 4 rotations of each crop: more accurate, slower.")
    ] = 1,
) -> None:
    """Score a model on a dataset with true poses: metrics.json and a report."""
    from rich.console import Console

    from gknet.cli.predict import choose_estimator
    from gknet.dataset.skd import open_dataset
    from gknet.report.table import metric_table

    estimator = choose_estimator(spacecraft, model, threads, tta_rotations)
    dataset = open_dataset(data, estimator.spacecraft, None if split == "all" else split, every)
    words = f"{data.resolve().name}, split {split}" + (f", every {every}th frame" if every > 1 else "")
    section = evaluate_section(dataset, estimator, words, pictures)
    out.mkdir(parents=True, exist_ok=True)
    title = f"Pose of {estimator.spacecraft.name} on {data.resolve().name}"
    written = write_report(out, title, [section], section.evaluation.to_dict())
    Console().print(metric_table(section.evaluation))
    tell_gaps(section.evaluation)
    for path in written:
        typer.echo(f"wrote {path}")


def evaluate_section(dataset: SkdDataset, estimator: PoseEstimator, words: str, pictures: int) -> Section:
    """Evaluate with a progress bar, with the pictures for the page. Without a locator only the oracle's crop is run."""
    from gknet.evaluation.evaluate import PROTOCOL_WORDS, evaluate
    from gknet.io.progress import progress
    from gknet.report.gallery import galleries
    from gknet.report.page import Section

    protocols = tuple(PROTOCOL_WORDS) if estimator.has_locator else ("oracle",)
    with progress() as bar:
        task = bar.add_task(estimator.spacecraft.name, total=len(dataset))
        evaluation = evaluate(dataset, estimator, protocols, words, on_frame=lambda: bar.advance(task))
    return Section(evaluation, galleries(evaluation.runs[-1], dataset, estimator.spacecraft, pictures))


def write_report(out: Path, title: str, sections: list[Section], content: dict[str, object]) -> tuple[Path, Path]:
    """metrics.json and report.html, each whole or absent."""
    import json

    from gknet import __version__
    from gknet.io.atomic import write_text
    from gknet.report.page import page

    metrics_path, page_path = out / "metrics.json", out / "report.html"
    text = json.dumps({"gknet": __version__, **content}, indent=1, allow_nan=False)
    write_text(metrics_path, text + "\n")
    write_text(page_path, page(title, sections))
    return metrics_path, page_path


def tell_gaps(evaluation: Evaluation) -> None:
    """One line for each thing that the dataset does not say, and one for the frames that are in no mean."""
    from gknet.evaluation.evaluate import UNKNOWN_WORDS

    for column in evaluation.unknown:
        typer.echo(f"unknown, no column '{column}': {UNKNOWN_WORDS[column]}")
    bad = evaluation.passed_over
    if bad:
        typer.echo(f"{len(bad)} frames were passed over; the first, {bad[0].name}: {bad[0].failure}")
