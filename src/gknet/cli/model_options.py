"""The options with which `predict`, `eval` and `demo` choose a model and how it runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gknet.errors import GknetError

if TYPE_CHECKING:
    from gknet.frame import PoseEstimator

SpacecraftOption = Annotated[
    str | None, typer.Option(help="Name of a shipped model: satellite_01, satellite_02 or satellite_03.")
]
ModelOption = Annotated[
    Path | None, typer.Option(help="Path of a model folder: keypoints.onnx or direct.onnx, and perhaps locator.onnx.")
]
ThreadsOption = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Threads of the network; all cores by default.")
]
DeviceOption = Annotated[str, typer.Option(help="cpu, or cuda with the package onnxruntime-gpu.")]
RotationsOption = Annotated[
    int, typer.Option(help="Average the heatmaps of 1, 2 or 4 rotations of each crop: more accurate, slower.")
]


def model_folder(spacecraft: str | None, model: Path | None) -> Path:
    """The folder that --spacecraft NAME or --model PATH means; a name is never a path, a path never a name."""
    from gknet.inference.load import shipped_folder

    if (spacecraft is None) == (model is None):
        raise GknetError("give either --spacecraft NAME (a shipped model) or --model PATH")
    return model if model is not None else shipped_folder(spacecraft or "")


def open_estimator(folder: Path, threads: int | None, device: str, tta_rotations: int = 1) -> PoseEstimator:
    """The estimator in a model's folder."""
    from gknet.inference.load import load_estimator

    return load_estimator(folder.absolute(), threads=threads, device=device, tta_rotations=tta_rotations)
