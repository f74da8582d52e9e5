"""What a training run is made of. It loads no library: the command line reads its options from here."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from gknet.errors import GknetError
from gknet.network.build import NETWORKS, spec_of
from gknet.network.spec import Stage, checked_graph, checked_loss
from gknet.training.schedule import stages_text

if TYPE_CHECKING:
    from gknet.training.cache import Window

OPTIMIZERS = ("muon", "adamw")
DEVICES = ("auto", "cpu", "cuda", "mps")
PRECISIONS = ("auto", "32-true", "bf16-mixed", "16-mixed")
BUDGETS = ("samples", "epochs", "minutes")

MAY_CHANGE = (*BUDGETS, "validations", "device", "devices", "precision", "workers", "init")
"""Settings that `--resume` may give anew. Every other one shapes the weights or what they are judged by, and stays."""

BOUNDS: dict[str, tuple[float, float]] = {
    "samples": (1, 1e12),
    "epochs": (1e-6, 1e6),
    "minutes": (1e-6, 1e6),
    "learning_rate": (1e-12, 10),
    "weight_decay": (0, 10),
    "warm_up": (0, 0.99),
    "cycles": (1, 10_000),
    "auxiliary": (0, 100),
    "ema": (0, 0.999999),
    "clip": (1e-6, 1e6),
    "seed": (0, 2**32 - 1),
    "devices": (1, 1024),
    "workers": (1, 256),
    "val_frames": (1, 1e9),
    "validations": (1, 1e6),
    "cache_size": (32, 4096),
}
"""The smallest and the largest value of each setting that is a number; NaN lies in none."""


@dataclass(frozen=True)
class TrainSettings:
    """One training run. Exactly one of `samples`, `epochs` and `minutes` is the budget.

    Attributes:
        network: gknet-s, gknet-xs, hrnet-xs, resunet-xs, dmanet-xs, gknet-paper, hrnet, resunet, dmanet or locator.
        graph: skeleton, identity (no edges), random (as many) or none (no graph branch).
        loss: likelihood or squared; left out, the network's own.
        samples: Budget in images seen, by all devices together.
        epochs: Budget in passes over the data.
        minutes: Budget by the clock, for convenience: such a run cannot be repeated exactly.
        stages: share:input_size:batch,... such as 0.4:128:32,0.6:256:32; left out, the network's own.
        optimizer: muon (AdamW takes the parameters that Muon is not for), or adamw at about half the learning rate.
        learning_rate: At its peak.
        weight_decay: Of matrices and kernels, decoupled.
        warm_up: Share of the budget in which the learning rate rises.
        cycles: Of the cosine that the learning rate follows; more than one are warm restarts.
        auxiliary: Weight of the loss on the maps of each branch.
        ema: How much of the averaged weights stays at each step.
        clip: Largest norm of the gradient.
        seed: Of weights, order and augmentation.
        device: auto, cpu, cuda or mps.
        devices: How many; more than one train with DDP.
        precision: auto, 32-true, bf16-mixed or 16-mixed.
        workers: Threads that decode images for the cache.
        val_frames: Frames of the val split to validate on, evenly spread.
        validations: How many there are over the budget.
        cache_size: Side of the cached crops in pixels.
        init: A .safetensors or exported .onnx file to start from, of any spacecraft; what does not fit stays fresh.
    """

    network: str = "gknet-s"
    graph: str = "skeleton"
    loss: str | None = None
    samples: int | None = None
    epochs: float | None = None
    minutes: float | None = None
    stages: tuple[Stage, ...] | None = None
    optimizer: str = "muon"
    learning_rate: float = 4e-3
    weight_decay: float = 1e-2
    warm_up: float = 0.03
    cycles: int = 1
    auxiliary: float = 0.2
    ema: float = 0.997
    clip: float = 5.0
    seed: int = 0
    device: str = "auto"
    devices: int = 1
    precision: str = "auto"
    workers: int = 2
    val_frames: int = 200
    validations: int = 8
    cache_size: int = 320
    init: Path | None = None

    def __post_init__(self) -> None:
        for name, choices in (("optimizer", OPTIMIZERS), ("device", DEVICES), ("precision", PRECISIONS)):
            if getattr(self, name) not in choices:
                raise GknetError(f"{name}: expected one of {', '.join(choices)}, got '{getattr(self, name)}'")
        if sum(getattr(self, name) is not None for name in BUDGETS) != 1:
            raise GknetError("train: expected exactly one budget: --samples, --epochs or --minutes")
        for name, (low, high) in BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise GknetError(f"{name}: expected a number from {low:g} to {high:g}, got {value:g}")
        self._check_network()

    def _check_network(self) -> None:
        spec = spec_of(self.network)
        if checked_graph(self.graph) != "skeleton" and not spec.has_graph:
            have = ", ".join(name for name, other in NETWORKS.items() if other.has_graph)
            raise GknetError(f"graph: {self.network} has none to choose; only {have} have")
        if self.loss is not None and checked_loss(self.loss) and spec.loss is None:
            raise GknetError(f"loss: {self.network} has its own; leave it out")

    @property
    def chosen_loss(self) -> str:
        """The loss of the settings, or else the network's own; "likelihood" where there is nothing to choose."""
        return self.loss or spec_of(self.network).loss or "likelihood"

    @property
    def input_stages(self) -> tuple[Stage, ...]:
        """The stages of the settings, or else the network's own."""
        return self.stages or spec_of(self.network).stages

    @property
    def input_size(self) -> int:
        """Side of the input in pixels at which the network is validated and deployed: the last stage's."""
        return self.input_stages[-1].input_size

    @property
    def window(self) -> Window:
        """The part of a frame that is the network's input."""
        return "image" if spec_of(self.network).kind == "locator" else "craft"

    @property
    def fixed(self) -> dict[str, str]:
        """Each setting that a resumed run must have as it was, as text, defaults filled in."""
        texts = {field.name: str(getattr(self, field.name)) for field in fields(self) if field.name not in MAY_CHANGE}
        return texts | {"loss": self.chosen_loss, "stages": stages_text(self.input_stages)}
