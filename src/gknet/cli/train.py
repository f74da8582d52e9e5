"""`gknet train` and `gknet export`: a network from a dataset, and a model from a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gknet.cli.dataclass_options import with_options
from gknet.cli.log_lines import log_lines
from gknet.cli.terminal import print_line
from gknet.training.schedule import parse_stages
from gknet.training.settings import TrainSettings


@with_options(TrainSettings, {"learning_rate": "--lr"}, {"stages": parse_stages}, panel="Settings")
def train(
    data: Annotated[Path, typer.Argument(help="Dataset in the SKD layout, with the splits train and val.")],
    out: Annotated[Path, typer.Option(help="Folder of the run.")],
    spacecraft: Annotated[str, typer.Option(help="Which spacecraft of the dataset.")],
    settings: TrainSettings,
    batch: Annotated[int | None, typer.Option(help="Batch of every stage, instead of the stages' own.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where the run in OUT stopped; give the same settings again.")
    ] = False,
    cache: Annotated[Path | None, typer.Option(help="Folder of the decoded crops; left out, DATA/cache.")] = None,
    val: Annotated[Path | None, typer.Option(help="Dataset with the split val; left out, DATA.")] = None,
) -> None:
    """Train a network; the best weights by validation are kept in OUT.

    Give one budget: --samples, --epochs or --minutes. After Ctrl-C or SIGTERM, --resume goes on where the run stopped;
    with --samples or --epochs the result is exactly that of a run that never stopped.
    """
    from lightning_fabric.utilities.rank_zero import rank_zero_only

    from gknet.training.train import train as run

    if batch is not None:
        settings = replace(settings, stages=tuple(replace(stage, batch=batch) for stage in settings.input_stages))
    with log_lines():
        state = run(data, spacecraft, out, settings, resume, cache, val)
    if rank_zero_only.rank == 0:  # type: ignore[attr-defined]  # the first of several processes
        best = ", ".join(f"{name} {value:.4g}" for name, value in (state.best or {}).items())
        print_line(f"{out}: {state.samples} samples in {state.elapsed_s / 60:.1f} min; best: {best or 'none'}")


def export(
    run: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    out: Annotated[Path, typer.Option(help="Folder for keypoints.onnx, direct.onnx or locator.onnx.")],
    tolerance: Annotated[
        float | None, typer.Option(help="Largest difference from torch, in units of the output.")
    ] = None,
) -> None:
    """Write a run's best weights as one ONNX file with metadata, checked against torch."""
    from gknet.training.export import TOLERANCE, export_run

    with log_lines():
        result = export_run(run, out, TOLERANCE if tolerance is None else tolerance)
    print_line(
        f"{result.onnx_path}: {result.onnx_path.stat().st_size / 1e6:.1f} MB, "
        f"differs from torch by {result.runtime_difference:.1e}; 16-bit weights change {result.rounding_difference:.1e}"
    )
