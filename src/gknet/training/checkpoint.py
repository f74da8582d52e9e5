"""Files of a run: checkpoints that resume exactly, and weights as safetensors."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as safetensors_bytes
from torch import Tensor, nn

from gknet.errors import GknetError
from gknet.io.atomic import write_bytes
from gknet.io.torch_file import load_torch_file
from gknet.network.weight_names import with_current_names

CHECKPOINT = "checkpoint.pt"
BEST = "best.safetensors"


@dataclass(eq=False)
class TrainingState:
    """All that a run needs to go on as if it had never stopped.

    samples    seen so far, all processes together: the sampler's position
    elapsed_s  of the budget, validation included
    best       values of the best validation so far, its "score" among them; None before the first
    history    rows of metrics.csv
    """

    samples: int = 0
    steps: int = 0
    elapsed_s: float = 0.0
    best: dict[str, float] | None = None
    history: list[dict[str, float]] = field(default_factory=list)


def save_checkpoint(
    folder: Path,
    state: TrainingState,
    network: nn.Module,
    average: nn.Module,
    optimizer: torch.optim.Optimizer,
    identity: str,
) -> None:
    buffer = io.BytesIO()
    content = {
        "identity": identity,
        "state": asdict(state),
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        "torch_rng": torch.get_rng_state(),
        "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }
    torch.save(content, buffer)
    write_bytes(folder / CHECKPOINT, buffer.getvalue())


def load_checkpoint(
    folder: Path, network: nn.Module, average: nn.Module, optimizer: torch.optim.Optimizer, identity: str
) -> TrainingState:
    """Put a checkpoint's state into its arguments; `identity` names what must not have changed in between."""
    path = folder / CHECKPOINT
    if not path.exists():
        raise GknetError(f"{path}: no checkpoint to resume from; leave out --resume to start anew")
    content = load_torch_file(path)
    if not isinstance(content, dict) or "identity" not in content:
        raise GknetError(f"{path}: not a checkpoint of 'gknet train'")
    if content["identity"] != identity:
        raise GknetError(f"{path}: it is of another training ({content['identity']}; now {identity})")
    try:
        network.load_state_dict(content["network"])
        average.load_state_dict(content["average"])
        optimizer.load_state_dict(content["optimizer"])
        torch.set_rng_state(content["torch_rng"])
        if torch.cuda.is_available() and content["cuda_rng"]:
            torch.cuda.set_rng_state_all(content["cuda_rng"])
        return TrainingState(**content["state"])
    except (
        AttributeError,
        KeyError,
        TypeError,
        ValueError,
        RuntimeError,
    ) as error:  # a part is missing or of another kind
        first = (str(error).splitlines() or [""])[0]
        raise GknetError(
            f"{path}: it does not fit this training ({type(error).__name__}: {first}); train anew in another folder"
        ) from error


def save_weights(path: Path, weights: Mapping[str, Tensor], metadata: Mapping[str, object]) -> None:
    """Tensors as safetensors, with `metadata` as JSON under the key "gknet"."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
    write_bytes(path, safetensors_bytes(tensors, {"gknet": json.dumps(metadata)}))


def load_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a .safetensors file; floating-point ones as float32."""
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise GknetError(f"{path}: cannot read the weights ({error}); expected a .safetensors file") from error
    tensors = with_current_names(tensors)
    return {name: tensor.float() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}


def warm_start(network: nn.Module, path: Path) -> tuple[int, int]:
    """Take every tensor of `path` whose name and shape fit; the others stay fresh. Returns (taken, all)."""
    own = network.state_dict()
    fitting = {
        name: tensor for name, tensor in load_weights(path).items() if name in own and tensor.shape == own[name].shape
    }
    if not fitting:
        raise GknetError(f"{path}: no tensor fits this network")
    network.load_state_dict(fitting, strict=False)
    return len(fitting), len(own)
