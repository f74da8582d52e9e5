"""A run's best weights as one ONNX file with metadata, refused when onnxruntime and torch disagree."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float32
from numpy import ndarray
from torch import nn

from gknet.errors import GknetError
from gknet.inference.onnx_model import METADATA_KEY
from gknet.inference.onnx_session import open_session
from gknet.io.atomic import write_bytes
from gknet.io.spacecraft_file import spacecraft_from_toml
from gknet.network.build import build, spec_of
from gknet.network.network import Network
from gknet.training.checkpoint import BEST, load_weights
from gknet.training.onnx_graph import in_half, onnx_graph, store_in_half
from gknet.training.run_file import TrainingRun, load_run

TOLERANCE = 1e-3
"""Largest difference between torch and onnxruntime: of a heatmap (its peak is 1), a probability, a crop's side."""

ROUNDING = 0.05
"""Largest difference that storing the weights in 16 bits may make, in the same units."""


@dataclass(frozen=True)
class Exported:
    """An exported file.

    Attributes:
        onnx_path: The file, `<kind>.onnx`.
        runtime_difference: Largest difference of its outputs from those of torch on the same weights.
        rounding_difference: Largest difference that the 16-bit weights make.
    """

    onnx_path: Path
    runtime_difference: float
    rounding_difference: float


def export_run(folder: Path, out: Path, tolerance: float = TOLERANCE) -> Exported:
    """Export the best weights of a run.

    Args:
        folder: Of the run.
        out: Folder that gets keypoints.onnx, direct.onnx or locator.onnx.
        tolerance: Largest difference from torch, in the units of TOLERANCE.

    Raises:
        GknetError: The run is incomplete, onnxruntime differs from torch by more than `tolerance`, or 16-bit weights
            change the output by more than ROUNDING. Nothing is written then.
    """
    run = load_run(folder)
    spacecraft = spacecraft_from_toml(run.spacecraft_toml, str(folder / "run.json"))
    network = build(run.network, spacecraft.adjacency, spacecraft.points_m, run.graph, run.loss)
    weights = load_weights(folder / BEST)
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise GknetError(
            f"{folder / BEST}: it is not of the network in run.json, as this version builds it; train it anew"
        ) from error
    network.eval()
    images = example_images(run.input_size, Path(run.data))
    exact = run_torch(network, images)
    round_weights(network)
    expected = run_torch(network, images)
    about = metadata(run, network, tolerance)
    data = onnx_bytes(network, images, about)

    runtime_difference = float(np.abs(run_onnx(data, images) - expected).max())
    rounding_difference = float(np.abs(exact - expected).max())
    if not runtime_difference <= tolerance:
        raise GknetError(
            f"export: onnxruntime and torch differ by {runtime_difference:.2e}, over the tolerance of {tolerance:.1e}"
        )
    if not rounding_difference <= ROUNDING:
        raise GknetError(
            f"export: weights in 16 bits change the output by {rounding_difference:.2e}, more than {ROUNDING}"
        )
    out.mkdir(parents=True, exist_ok=True)
    onnx_path = out / f"{about['kind']}.onnx"
    write_bytes(onnx_path, data)
    return Exported(onnx_path, runtime_difference, rounding_difference)


@torch.no_grad()
def round_weights(network: nn.Module) -> None:
    """Round the matrices and kernels of a network to 16 bits.

    Raises:
        GknetError: One is beyond their range.
    """
    for tensor in network.state_dict().values():
        if in_half(tensor):
            if not tensor.abs().max() <= torch.finfo(torch.float16).max:
                raise GknetError("export: a weight is too large for 16 bits; the training has diverged")
            tensor.copy_(tensor.half().float())


def metadata(run: TrainingRun, network: Network, tolerance: float) -> dict[str, object]:
    """What the runtime must know to use the file: see `gknet.inference.onnx_model.Metadata`."""
    best = run.best or {}
    shape = {"stride": network.stride, "bins": network.attitude_bins}
    return {
        "kind": spec_of(run.network).kind,
        **{name: value for name, value in shape.items() if value is not None},
        "version": run.version,
        "network": run.network,
        "graph": run.graph,
        "loss": run.loss,
        "spacecraft": run.spacecraft_toml,
        "input_size": run.input_size,
        "tolerance": tolerance,
        **{name: best[name] for name in ("floor_cells", "spread_scale", "pose_scale") if name in best},
        "validation": best,
    }


def onnx_bytes(network: Network, images: Float32[ndarray, "b 3 s s"], about: dict[str, object]) -> bytes:
    """The content of the file: the graph for images of this size, with rounded weights in 16 bits, and metadata."""
    model = onnx_graph(network, torch.from_numpy(images[:2]))
    store_in_half(model)
    entry = model.metadata_props.add()
    entry.key, entry.value = METADATA_KEY, json.dumps(about)
    return model.SerializeToString()


def example_images(size: int, folder: Path) -> Float32[ndarray, "b 3 s s"]:
    """Noise, a flat and a drawn image, and up to four real ones of a dataset folder if it is still there."""
    rng = np.random.default_rng(0)
    images: list[ndarray] = [
        rng.integers(0, 256, (size, size, 3)).astype(np.uint8),
        np.zeros((size, size, 3), np.uint8),
    ]
    drawn = np.zeros((size, size, 3), np.uint8)
    cv2.rectangle(drawn, (size // 4, size // 3), (size // 2, size // 2), (200, 160, 60), -1)
    cv2.line(drawn, (size // 2, size // 2), (size - size // 8, size // 5), (240, 240, 240), 3)
    images.append(drawn)
    for path in sorted(folder.glob("data/*/image/*.jpg"))[:4] if folder.is_dir() else []:
        real = cv2.imread(str(path))
        if real is not None:
            images.append(cv2.resize(real[:, :, ::-1], (size, size), interpolation=cv2.INTER_AREA))
    return np.stack(images).transpose(0, 3, 1, 2).astype(np.float32) / 255


def run_onnx(model: bytes, images: Float32[ndarray, "b 3 s s"]) -> Float32[ndarray, "2 b m"]:
    """The outputs for the images one by one, and for all of them together."""
    session = open_session(model)
    alone = np.concatenate([_in_rows(session.run(None, {"image": image[None]})) for image in images])
    together = _in_rows(session.run(None, {"image": images}))
    if alone.shape != together.shape:
        raise GknetError(f"export: a batch gives {together.shape}, its images one by one {alone.shape}")
    return np.stack([alone, together])


@torch.inference_mode()
def run_torch(network: Network, images: Float32[ndarray, "b 3 s s"]) -> Float32[ndarray, "b m"]:
    """The same from torch."""
    return _in_rows([output.float().numpy() for output in network.predict(torch.from_numpy(images))])


def _in_rows(outputs: Sequence[ndarray]) -> Float32[ndarray, "b m"]:
    """All outputs for an image in one row."""
    return np.concatenate([output.reshape(len(output), -1) for output in outputs], axis=1)
