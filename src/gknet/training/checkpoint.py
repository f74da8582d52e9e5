"""Files of a run: checkpoints that resume exactly, and weights as safetensors."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

import torch
from pydantic import ConfigDict, Field, TypeAdapter
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as safetensors_bytes
from torch import Tensor, nn

from gknet.errors import GknetError
from gknet.io.atomic import write_bytes
from gknet.io.text import parse_json, printable, validated
from gknet.io.torch_file import load_torch_file
from gknet.network.weight_names import with_current_names, without_counters

CHECKPOINT = "checkpoint.pt"
BEST = "best.safetensors"

Count = Annotated[int, Field(ge=0, le=2**62)]


@dataclass(eq=False)
class TrainingState:
    """All that a run needs beside its tensors to go on as if it had never stopped.

    Attributes:
        samples: Seen so far, by all processes together: the sampler's position.
        steps: Of the optimizer.
        elapsed_s: Of the budget, validations included.
        best: Values of the best validation so far, its "score" among them; None before the first.
        history: Rows of metrics.csv.
        losses: Of the steps since the last row.
        learning_rate: Of the last step.
        input_size: Of the last step, in pixels.
        is_validation_due: Whether the validation after the last step is still to be done: it was interrupted.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    samples: Count = 0
    steps: Count = 0
    elapsed_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    best: dict[str, float] | None = None
    history: list[dict[str, float]] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    learning_rate: float = 0.0
    input_size: Count = 0
    is_validation_due: bool = False


class Learned(Protocol):
    """What a checkpoint holds tensors of: the network in training, its running average and the optimizer."""

    @property
    def network(self) -> nn.Module: ...
    @property
    def average(self) -> nn.Module: ...
    @property
    def optimizer(self) -> torch.optim.Optimizer: ...


def save_checkpoint(folder: Path, state: TrainingState, learned: Learned, identity: Mapping[str, str]) -> None:
    """Write checkpoint.pt into `folder`; `identity` is what a resumed run must agree with."""
    buffer = io.BytesIO()
    content = {
        "identity": dict(identity),
        "state": asdict(state),
        "network": learned.network.state_dict(),
        "average": learned.average.state_dict(),
        "optimizer": learned.optimizer.state_dict(),
        "torch_rng": torch.get_rng_state(),
        "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }
    torch.save(content, buffer)
    write_bytes(folder / CHECKPOINT, buffer.getvalue())


def load_checkpoint(folder: Path, learned: Learned, identity: Mapping[str, str]) -> TrainingState:
    """Put the tensors of checkpoint.pt into `learned`.

    Args:
        folder: Of the run.
        learned: As it was built for a new run.
        identity: As at `save_checkpoint`.

    Returns:
        The rest of the checkpoint. Its best validation is the one that best.safetensors is of.

    Raises:
        GknetError: There is no checkpoint, it is damaged, or it is of another training.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        raise GknetError(f"{path}: no checkpoint to resume from; leave out --resume to start anew")
    _check_sums(path)
    content = load_torch_file(path)
    if not isinstance(content, dict) or not isinstance(content.get("identity"), dict):
        raise GknetError(f"{path}: not a checkpoint of this version of 'gknet train'; train anew in another folder")
    _check_identity(path, content["identity"], identity)
    try:
        learned.network.load_state_dict(content["network"])
        learned.average.load_state_dict(content["average"])
        _load_optimizer(learned.optimizer, content["optimizer"])
        torch.set_rng_state(content["torch_rng"])
        if torch.cuda.is_available() and content["cuda_rng"]:
            torch.cuda.set_rng_state_all(content["cuda_rng"])
        state: TrainingState = validated(TypeAdapter(TrainingState), content["state"], path)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError, RuntimeError) as error:
        first = (str(error).splitlines() or [""])[0]  # a part is missing, or of another kind
        raise GknetError(
            f"{path}: it does not fit this training ({type(error).__name__}: {first}); train anew in another folder"
        ) from error
    if (folder / BEST).exists():  # it may be of a validation after the checkpoint
        best = weights_metadata(folder / BEST).get("best", state.best)
        state.best = validated(TypeAdapter(dict[str, float] | None), best, folder / BEST)
    return state


def _check_sums(path: Path) -> None:
    """Hold the file against its own checksums, which torch.load passes over."""
    try:
        with zipfile.ZipFile(path) as file:
            damaged = file.testzip()
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, zlib.error) as error:
        raise GknetError(f"{path}: not readable as a checkpoint ({error}); train anew in another folder") from error
    if damaged is not None:
        raise GknetError(f"{path}: not readable: {printable(damaged)} in it is damaged; train anew in another folder")


def _check_identity(path: Path, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    for name in now:
        if before.get(name) != now[name]:
            raise GknetError(
                f"{path}: it is of another training ({name} {before.get(name)}, now {now[name]}); "
                f"resume with what it was, or train anew in another folder"
            )


def _load_optimizer(optimizer: torch.optim.Optimizer, content: Any) -> None:
    """As `load_state_dict`, which takes tensors of any shape."""
    optimizer.load_state_dict(content)
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if torch.is_tensor(value) and value.ndim > 0 and value.shape != parameter.shape:
                raise ValueError(f"the optimizer's {name}: expected {tuple(parameter.shape)}, got {tuple(value.shape)}")


def save_weights(path: Path, weights: Mapping[str, Tensor], metadata: Mapping[str, object]) -> None:
    """Tensors as safetensors, with `metadata` as JSON under the key "gknet"."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
    write_bytes(path, safetensors_bytes(tensors, {"gknet": json.dumps(metadata)}))


def load_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a .safetensors file or of an exported .onnx file; floating-point ones as float32.

    Raises:
        GknetError: There is no such file, or it is damaged.
    """
    if path.exists() and not path.is_file():
        raise GknetError(f"{path}: expected a file of weights, got a folder or a pipe")
    if path.suffix == ".onnx":
        from gknet.training.onnx_graph import weights_of_onnx

        return {name: tensor.float() for name, tensor in weights_of_onnx(path).items()}
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise GknetError(f"{path}: cannot read the weights ({error}); expected a .safetensors file") from error
    tensors = without_counters(with_current_names(tensors))
    return {name: tensor.float() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}


def weights_metadata(path: Path) -> dict[str, Any]:
    """The metadata of `save_weights`; empty where a file has none.

    Raises:
        GknetError: There is no such file, or it is damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get("gknet", "{}")
    except (OSError, SafetensorError) as error:
        raise GknetError(f"{path}: cannot read the weights ({error}); expected a .safetensors file") from error
    content = parse_json(text, path)
    if not isinstance(content, dict):
        raise GknetError(f"{path}: expected metadata of 'gknet train', got something else")
    return content


def warm_start(network: nn.Module, path: Path) -> tuple[int, int]:
    """Take every tensor of `path` whose name and shape fit; the others stay fresh.

    Returns:
        How many were taken, and how many there are.

    Raises:
        GknetError: None fits, or the file cannot be read.
    """
    own = without_counters(network.state_dict())
    fitting = {
        name: tensor for name, tensor in load_weights(path).items() if name in own and tensor.shape == own[name].shape
    }
    if not fitting:
        raise GknetError(f"{path}: no tensor fits this network")
    network.load_state_dict(fitting, strict=False)
    return len(fitting), len(own)
