"""A run's best weights as one ONNX file with metadata, refused when onnxruntime and torch disagree."""

from __future__ import annotations

import copy
import io
import json
import logging
import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from jaxtyping import Float, Float32
from numpy import ndarray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from gknet.errors import GknetError
from gknet.inference.onnx_model import METADATA_KEY
from gknet.inference.onnx_session import open_session
from gknet.io.atomic import write_bytes
from gknet.io.spacecraft_file import spacecraft_from_toml
from gknet.network.backbone import ConvNorm
from gknet.network.build import build
from gknet.network.dmanet import DMANet
from gknet.network.heatmap import HeatmapNetwork
from gknet.network.locator import Locator
from gknet.network.network import Network
from gknet.training.checkpoint import BEST, load_weights, save_weights
from gknet.training.run_file import TrainingRun, load_run

TOLERANCE = 1e-3
"""Largest difference between torch and onnxruntime: of a heatmap (its peak is 1), of a belief, of a crop's side."""

ROUNDING = 0.05
"""Largest difference that storing the weights in 16 bits may make, in the same units."""

OPSET = 18


@dataclass(frozen=True)
class Exported:
    """The files and how far their outputs are from torch's (see TOLERANCE and ROUNDING)."""

    onnx_path: Path
    weights_path: Path
    runtime_difference: float
    rounding_difference: float


def folded(network: Network) -> Network:
    """A copy whose normalisations are part of the convolutions before them."""
    network = copy.deepcopy(network).eval()
    for module in network.modules():
        if isinstance(module, ConvNorm) and isinstance(module.norm, nn.BatchNorm2d):
            module.conv = fuse_conv_bn_eval(module.conv, module.norm)
            module.norm = nn.Identity()
    return network


def in_half(tensor: Tensor) -> bool:
    """Matrices and kernels are stored in 16 bits; the few vectors keep 32."""
    return tensor.is_floating_point() and tensor.ndim > 1


@torch.no_grad()
def round_weights(network: nn.Module) -> None:
    for tensor in (*network.parameters(), *network.buffers()):
        if in_half(tensor):
            if tensor.abs().max() > torch.finfo(torch.float16).max:
                raise GknetError("export: a weight is too large for 16 bits; the training has diverged")
            tensor.copy_(tensor.half().float())


OUTPUTS = ("output", "attitude")
"""Names in the file; the second one is of a keypoint network with a belief in the attitude."""


class Answer(nn.Module):
    """All that a network has to say of a picture, as a tuple."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Float[Tensor, "b 3 s s"]) -> tuple[Tensor, ...]:
        network = self.network
        return network.predict(image) if isinstance(network, HeatmapNetwork) else (network(image),)


def onnx_graph(network: Network, example: Float[Tensor, "b 3 s s"]) -> onnx.ModelProto:
    """The graph image -> OUTPUTS, with a free batch axis."""
    answer = Answer(network)
    with torch.no_grad():
        names = OUTPUTS[: len(answer(example))]
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            answer,
            (example,),
            dynamo=True,
            external_data=False,
            opset_version=OPSET,
            input_names=["image"],
            output_names=list(names),
            dynamic_shapes=({0: torch.export.Dim("batch", min=1, max=1024)},),
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    for node in model.graph.node:  # stack traces with the paths of this machine, a quarter of a megabyte and more
        del node.metadata_props[:]
    return model


def store_in_half(model: onnx.ModelProto) -> None:
    """Initialisers in 16 bits, each with a Cast behind it that the runtime folds when it loads the file."""
    casts = []
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        half = values.astype(np.float16) if values.dtype == np.float32 and values.ndim > 1 else None
        if half is None or not np.array_equal(half.astype(np.float32), values):
            continue  # not one of the rounded weights
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(half, f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], f"{name}.cast", to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def example_images(size: int, folder: Path) -> Float32[ndarray, "b 3 s s"]:
    """Noise, flat and structured pictures, and up to four real ones of a dataset folder if it is still there."""
    rng = np.random.default_rng(0)
    pictures: list[ndarray] = [
        rng.integers(0, 256, (size, size, 3)).astype(np.uint8),
        np.zeros((size, size, 3), np.uint8),
    ]
    drawn = np.zeros((size, size, 3), np.uint8)
    cv2.rectangle(drawn, (size // 4, size // 3), (size // 2, size // 2), (200, 160, 60), -1)
    cv2.line(drawn, (size // 2, size // 2), (size - size // 8, size // 5), (240, 240, 240), 3)
    pictures.append(drawn)
    for path in sorted(folder.glob("data/*/image/*.jpg"))[:4] if folder.is_dir() else []:
        real = cv2.imread(str(path))
        if real is not None:
            pictures.append(cv2.resize(real[:, :, ::-1], (size, size), interpolation=cv2.INTER_AREA))
    return np.stack(pictures).transpose(0, 3, 1, 2).astype(np.float32) / 255


def in_rows(outputs: Sequence[ndarray]) -> Float32[ndarray, "b m"]:
    """All outputs for a picture in one row."""
    return np.concatenate([output.reshape(len(output), -1) for output in outputs], axis=1)


def run_onnx(model: bytes, images: Float32[ndarray, "b 3 s s"]) -> Float32[ndarray, "2 b m"]:
    """The answers to the pictures one by one, and to all of them together."""
    session = open_session(model)
    alone = np.concatenate([in_rows(session.run(None, {"image": image[None]})) for image in images])
    together = in_rows(session.run(None, {"image": images}))
    if alone.shape != together.shape:
        raise GknetError(f"export: a batch gives {together.shape}, its pictures one by one {alone.shape}")
    return np.stack([alone, together])


@torch.inference_mode()
def run_torch(network: Network, images: Float32[ndarray, "b 3 s s"]) -> Float32[ndarray, "b m"]:
    return in_rows([output.float().numpy() for output in Answer(network)(torch.from_numpy(images))])


def shape_of_output(network: Network) -> dict[str, object]:
    """The kind of a network, and what tells its output's shape."""
    if isinstance(network, DMANet):
        return {"kind": "direct", "bins": network.config.bins}
    if isinstance(network, Locator):
        return {"kind": "locator", "stride": network.stride}
    return {"kind": "keypoints", "stride": network.stride, "bins": network.attitude_bins}


def metadata(run: TrainingRun, network: Network, tolerance: float) -> dict[str, object]:
    """What the runtime must know to use the file."""
    best = run.best or {}
    return {
        **shape_of_output(network),
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


def export_run(folder: Path, out: Path, tolerance: float = TOLERANCE) -> Exported:
    """Export the best weights of a run: <kind>.onnx and <kind>.safetensors in `out`.

    Raises GknetError, and writes nothing, when onnxruntime differs from torch by more than `tolerance` or 16-bit
    weights change the output by more than ROUNDING.
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
    small = folded(network)
    round_weights(small)
    images = example_images(run.input_size, Path(run.data))
    model = onnx_graph(small, torch.from_numpy(images[:2]))
    store_in_half(model)
    about = metadata(run, network, tolerance)
    entry = model.metadata_props.add()
    entry.key, entry.value = METADATA_KEY, json.dumps(about)
    data = model.SerializeToString()

    expected = run_torch(small, images)
    runtime_difference = float(np.abs(run_onnx(data, images) - expected).max())
    rounding_difference = float(np.abs(run_torch(network, images) - expected).max())
    if not runtime_difference <= tolerance:
        raise GknetError(
            f"export: onnxruntime and torch differ by {runtime_difference:.2e}, over the tolerance of {tolerance:.1e}"
        )
    if not rounding_difference <= ROUNDING:
        raise GknetError(
            f"export: weights in 16 bits change the output by {rounding_difference:.2e}, more than {ROUNDING}"
        )
    out.mkdir(parents=True, exist_ok=True)
    kind = str(about["kind"])
    onnx_path, weights_path = out / f"{kind}.onnx", out / f"{kind}.safetensors"
    stored = {name: tensor.half() if in_half(tensor) else tensor for name, tensor in weights.items()}
    save_weights(weights_path, stored, about)
    write_bytes(onnx_path, data)
    return Exported(onnx_path, weights_path, runtime_difference, rounding_difference)
