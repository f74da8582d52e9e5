"""What a training run is made of, and the run.json that remembers it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from gknet.errors import GknetError
from gknet.io.atomic import write_text
from gknet.network.build import GRAPH_NETWORKS, NETWORKS, OWN_LOSS_NETWORKS, default_loss
from gknet.network.spec import checked_graph, checked_loss
from gknet.training.cache import Window
from gknet.training.schedule import Stage

OPTIMIZERS = ("muon", "adamw")
PAPER_STAGES = (Stage(1.0, 256, 16),)
STAGES = {
    "gknet-s": (Stage(0.4, 128, 32), Stage(0.3, 192, 32), Stage(0.3, 256, 32)),
    "gknet-paper": PAPER_STAGES,
    "hrnet": PAPER_STAGES,
    "resunet": PAPER_STAGES,
    "dmanet": PAPER_STAGES,
    "locator": (Stage(0.4, 128, 32), Stage(0.6, 256, 32)),
}
"""Small pictures first: most of what there is to learn is seen there, at a quarter of the cost."""


@dataclass(frozen=True)
class TrainSettings:
    """One training run.

    loss              "likelihood" or "squared"; None takes the network's own
    minutes, epochs   the budget: exactly one of them
    stages            None takes the network's own (STAGES)
    optimizer         "muon" (and AdamW for what it is not for) or "adamw"
    warm_up           share of the budget in which the learning rate rises
    cycles            of the cosine; more than one are warm restarts
    ema               how much of the averaged weights stays at each step
    auxiliary         weight of the loss on each branch's own maps
    clip              largest norm of the gradient
    val_frames        frames of the val split, evenly spread
    validations       how often they are looked at
    cache_size        side of the cached crops in pixels
    init              .safetensors to start from; tensors that do not fit stay fresh
    """

    network: str = "gknet-s"
    graph: str = "skeleton"
    loss: str | None = None
    minutes: float | None = None
    epochs: float | None = None
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
        if self.network not in NETWORKS:
            raise GknetError(f"network: expected one of {', '.join(NETWORKS)}, got '{self.network}'")
        if checked_graph(self.graph) != "skeleton" and self.network not in GRAPH_NETWORKS:
            raise GknetError(f"graph: {self.network} has none to choose; only {', '.join(GRAPH_NETWORKS)} have")
        if self.loss is not None and checked_loss(self.loss) and self.network in OWN_LOSS_NETWORKS:
            raise GknetError(f"loss: {self.network} has its own; leave it out")
        if self.optimizer not in OPTIMIZERS:
            raise GknetError(f"optimizer: expected one of {', '.join(OPTIMIZERS)}, got '{self.optimizer}'")
        if (self.minutes is None) == (self.epochs is None):
            raise GknetError("train: give either --minutes or --epochs")
        for name in ("learning_rate", "cycles", "clip", "devices", "val_frames", "validations", "cache_size"):
            if not getattr(self, name) > 0:  # nan is not
                raise GknetError(f"{name}: expected a positive number, got {getattr(self, name)}")
        if not 0 <= self.ema < 1 or not 0 <= self.warm_up < 1:
            raise GknetError(f"ema and warm_up: expected values in [0, 1), got {self.ema} and {self.warm_up}")

    @property
    def chosen_loss(self) -> str:
        return default_loss(self.network) if self.loss is None else self.loss

    @property
    def input_stages(self) -> tuple[Stage, ...]:
        return self.stages or STAGES.get(self.network, STAGES["gknet-s"])

    @property
    def input_size(self) -> int:
        """Side of the input in pixels at which the network is validated and deployed: the last stage's."""
        return self.input_stages[-1].input_size

    @property
    def window(self) -> Window:
        """What of a frame the network sees."""
        return "picture" if self.network == "locator" else "craft"


@dataclass(frozen=True)
class TrainingRun:
    """run.json: what `gknet export` and a resumed run need to know.

    spacecraft_toml  the text of the spacecraft's file
    data             the folder it was trained on
    best             the best validation so far, None before the first
    """

    network: str
    graph: str
    loss: str
    input_size: Annotated[int, Field(gt=0, multiple_of=32)]
    spacecraft_toml: str
    settings: dict[str, object]
    version: str
    data: str
    best: dict[str, float] | None

    def save(self, folder: Path) -> None:
        write_text(folder / "run.json", json.dumps(asdict(self), indent=1, default=str) + "\n")


def load_run(folder: Path) -> TrainingRun:
    path = folder / "run.json"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise GknetError(
            f"{path}: cannot read the run ({error.strerror}); expected a folder of 'gknet train'"
        ) from error
    except ValueError as error:
        raise GknetError(f"{path}: not valid JSON: {error}") from error
    names = {field.name for field in fields(TrainingRun)}
    if not isinstance(values, dict) or set(values) != names:
        raise GknetError(f"{path}: expected the keys {', '.join(sorted(names))}")
    try:
        return TypeAdapter(TrainingRun).validate_python(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise GknetError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
