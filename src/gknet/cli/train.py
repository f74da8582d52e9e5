"""`gknet train` and `gknet export`: from a dataset to weights, from weights to one file for onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def train(
    data: Annotated[Path, typer.Argument(help="Dataset in the SKD layout, with the splits train and val.")],
    out: Annotated[Path, typer.Option(help="Folder of the run.")],
    spacecraft: Annotated[str, typer.Option(help="Which spacecraft of the dataset.")],
    network: Annotated[
        str,
        typer.Option(
            help="gknet-s, gknet-xs, hrnet-xs, resunet-xs, dmanet-xs, gknet-paper, hrnet, resunet, dmanet or locator."
        ),
    ] = "gknet-s",
    graph: Annotated[
        str, typer.Option(help="skeleton, identity (no edges), random (as many) or none (no graph branch).")
    ] = "skeleton",
    loss: Annotated[str | None, typer.Option(help="likelihood or squared [the network's own].")] = None,
    minutes: Annotated[float | None, typer.Option(help="Budget by the clock.")] = None,
    epochs: Annotated[float | None, typer.Option(help="Budget by passes over the data.")] = None,
    stages: Annotated[
        str | None, typer.Option(help="share:input_size:batch,... such as 0.4:128:32,0.6:256:32.")
    ] = None,
    batch: Annotated[int | None, typer.Option(help="Batch of every stage.")] = None,
    optimizer: Annotated[
        str | None, typer.Option(help="muon, or adamw at about half the learning rate [muon].")
    ] = None,
    lr: Annotated[float | None, typer.Option(help="Peak learning rate.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of weights, order and augmentation.")] = None,
    device: Annotated[str | None, typer.Option(help="auto, cpu, cuda.")] = None,
    devices: Annotated[int | None, typer.Option(help="More than one trains with DDP.")] = None,
    precision: Annotated[str | None, typer.Option(help="auto, 32-true, bf16-mixed, 16-mixed.")] = None,
    init: Annotated[Path | None, typer.Option(help=".safetensors to start from, of any spacecraft.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where the run in OUT stopped.")] = False,
    cache: Annotated[Path | None, typer.Option(help="Folder of the decoded crops [DATA/cache].")] = None,
    val: Annotated[Path | None, typer.Option(help="Dataset whose val split is looked at [DATA].")] = None,
    val_frames: Annotated[int | None, typer.Option(help="Frames of the val split to look at.")] = None,
    validations: Annotated[int | None, typer.Option(help="How often to look at them.")] = None,
) -> None:
    """Train a network; the best weights by validation are kept in OUT."""
    from dataclasses import replace

    from gknet.training.loop import train as run
    from gknet.training.schedule import parse_stages
    from gknet.training.settings import TrainSettings

    chosen = {
        "optimizer": optimizer,
        "learning_rate": lr,
        "seed": seed,
        "device": device,
        "devices": devices,
        "precision": precision,
        "init": init,
        "val_frames": val_frames,
        "validations": validations,
        "stages": None if stages is None else parse_stages(stages),
    }
    given = {name: value for name, value in chosen.items() if value is not None}
    settings = TrainSettings(network=network, graph=graph, loss=loss, minutes=minutes, epochs=epochs, **given)  # type: ignore[arg-type]
    if batch is not None:
        settings = replace(settings, stages=tuple(replace(stage, batch=batch) for stage in settings.input_stages))
    state = run(data, spacecraft, out, settings, resume, cache, val)
    best = ", ".join(f"{name} {value:.4g}" for name, value in (state.best or {}).items())
    typer.echo(f"{out}: {state.samples} samples in {state.elapsed_s / 60:.1f} min; best: {best or 'none'}")


def export(
    run: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    out: Annotated[Path, typer.Option(help="Folder for keypoints.onnx, direct.onnx or locator.onnx, and the weights.")],
    tolerance: Annotated[
        float | None, typer.Option(help="Largest difference from torch, in units of the output.")
    ] = None,
) -> None:
    """Write a run's best weights as one ONNX file with metadata, checked against torch, and as safetensors."""
    from gknet.training.export import TOLERANCE, export_run

    result = export_run(run, out, TOLERANCE if tolerance is None else tolerance)
    typer.echo(
        f"{result.onnx_path}: {result.onnx_path.stat().st_size / 1e6:.1f} MB, "
        f"differs from torch by {result.runtime_difference:.1e}; 16-bit weights change {result.rounding_difference:.1e}"
    )
