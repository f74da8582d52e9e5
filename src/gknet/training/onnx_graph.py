"""A network as an ONNX graph, and its weights as the file keeps them: one form for onnxruntime and for training.

Every parameter and statistic of the network is an initializer of its own, named WEIGHTS + its name in the state dict.
Normalisations are not folded into convolutions, and matrices are not transposed: onnxruntime does both when it loads
the file. Matrices and kernels are stored in 16 bits, each with a Cast behind it that onnxruntime folds likewise.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from jaxtyping import Float
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from gknet.errors import GknetError
from gknet.network.network import Network
from gknet.network.weight_names import without_counters

OPSET = 18

OUTPUTS = ("output", "attitude")
"""Names in the file; the second one is of a keypoint network with an attitude prior."""

WEIGHTS = "weights."
"""Prefix of the initializers that are the network's state. The other ones belong to the spacecraft or the graph."""

TRACED = "network."
"""The prefix that `_Outputs` gives to the network's parameters and buffers."""


class _Outputs(nn.Module):
    """All outputs of a network, as the exported graph has them."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Float[Tensor, "b 3 s s"]) -> tuple[Tensor, ...]:
        return self.network.predict(image)


def in_half(tensor: Tensor) -> bool:
    """Whether the file keeps a tensor in 16 bits: matrices and kernels; the few vectors keep 32."""
    return tensor.is_floating_point() and tensor.ndim > 1


def onnx_graph(network: Network, example: Float[Tensor, "b 3 s s"]) -> onnx.ModelProto:
    """The graph image -> OUTPUTS in float32, with a free batch axis.

    Args:
        network: In evaluation mode.
        example: Two images or more, of the size that the graph is for.

    Raises:
        GknetError: A part of the network's state does not reach the graph under its own name.
    """
    traced = _traced(_Outputs(network), example)
    state = without_counters(network.state_dict())
    held = _taken(traced)
    _as_inputs(traced, held)  # what depends on the network's tensors stays in the graph; all else is computed now
    from onnxscript import optimizer

    model = optimizer.optimize(traced)
    _as_initializers(model, held, {TRACED + name: WEIGHTS + name for name in state})
    _without_traces(model)
    kept = _weights_in(model)
    for name, tensor in state.items():
        if name not in kept or not np.array_equal(kept[name], tensor.cpu().numpy()):
            raise GknetError(f"export: {name} is not in the graph as it is in the network; does `predict` use it?")
    return model


def store_in_half(model: onnx.ModelProto) -> None:
    """Keep matrices and kernels in 16 bits where that is exact: those that `round_weights` has rounded."""
    casts = []
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.ndim < 2:
            continue
        half = values.astype(np.float16)
        if not np.array_equal(half.astype(np.float32), values):
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(half, name))
        casts.append(helper.make_node("Cast", [name], [f"{name}.float"], f"{name}.cast", to=TensorProto.FLOAT))
    float_names = {cast.input[0]: cast.output[0] for cast in casts}
    for node in model.graph.node:
        for k, name in enumerate(node.input):
            node.input[k] = float_names.get(name, name)
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def weights_of_onnx(path: Path) -> dict[str, Tensor]:
    """The state of the network that an exported file is of, exactly as it was exported.

    Returns:
        Tensors by their names in the state dict: matrices and kernels in float16, vectors in float32. The counters of
        batch normalisations are left out.

    Raises:
        GknetError: There is no such file, it is damaged, or it was exported before the file kept these weights.
    """
    try:
        model = onnx.load(path)
    except (OSError, DecodeError) as error:
        raise GknetError(
            f"{path}: cannot read the weights ({error}); expected an .onnx file of 'gknet export'"
        ) from error
    weights = {name: torch.from_numpy(values.copy()) for name, values in _weights_in(model).items()}
    if not weights:
        raise GknetError(
            f"{path}: expected weights that can be trained on, as 'gknet export' writes them since version 0.2; "
            "export it again, or start from the .safetensors beside it"
        )
    return weights


def _traced(outputs: _Outputs, example: Float[Tensor, "b 3 s s"]) -> onnx.ModelProto:
    with torch.no_grad():
        names = OUTPUTS[: len(outputs(example))]
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            outputs,
            (example,),
            dynamo=True,
            external_data=False,
            opset_version=OPSET,
            input_names=["image"],
            output_names=list(names),
            dynamic_shapes=({0: torch.export.Dim("batch", min=1, max=1024)},),
            verbose=False,
            optimize=False,
        )
    assert program is not None
    return program.model_proto


def _taken(model: onnx.ModelProto) -> list[TensorProto]:
    """The network's parameters and buffers, taken out of the graph's initializers."""
    initializers = list(model.graph.initializer)
    del model.graph.initializer[:]
    model.graph.initializer.extend([tensor for tensor in initializers if not tensor.name.startswith(TRACED)])
    return [tensor for tensor in initializers if tensor.name.startswith(TRACED)]


def _as_inputs(model: onnx.ModelProto, held: Sequence[TensorProto]) -> None:
    for tensor in held:
        model.graph.input.append(helper.make_tensor_value_info(tensor.name, tensor.data_type, list(tensor.dims)))


def _as_initializers(model: onnx.ModelProto, held: Sequence[TensorProto], names: Mapping[str, str]) -> None:
    """Undo `_as_inputs`; `names` are those that the file has instead."""
    taken = {tensor.name for tensor in held}
    inputs = [each for each in model.graph.input if each.name not in taken]
    del model.graph.input[:]
    model.graph.input.extend(inputs)
    for node in model.graph.node:
        for k, name in enumerate(node.input):
            node.input[k] = names.get(name, name)
    for tensor in held:
        tensor.name = names.get(tensor.name, tensor.name)
        model.graph.initializer.append(tensor)


def _without_traces(model: onnx.ModelProto) -> None:
    """Leave out stack traces, which name paths of this machine; shapes stay, which halve the time to load."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.initializer, *graph.input, *graph.output, *graph.value_info):
        del part.metadata_props[:]
        part.doc_string = ""


def _weights_in(model: onnx.ModelProto) -> dict[str, np.ndarray]:
    """The initializers that are weights, by their names in the state dict."""
    return {
        tensor.name.removeprefix(WEIGHTS): numpy_helper.to_array(tensor)
        for tensor in model.graph.initializer
        if tensor.name.startswith(WEIGHTS)
    }
