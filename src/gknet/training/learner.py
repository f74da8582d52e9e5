"""One training step: a network, the running average of its weights, and their optimizer."""

from __future__ import annotations

import copy

import torch
from jaxtyping import Float
from lightning_fabric import Fabric
from torch import Tensor, nn

from gknet.network.network import Network
from gknet.training.batch import Batch
from gknet.training.optimizer import make_optimizer
from gknet.training.settings import TrainSettings
from gknet.training.tasks import Task


class Learner:
    """What learns: `step` is all that changes it.

    Attributes:
        network: The weights in training.
        average: Their running average, which is validated and kept.
        optimizer: Of the network's parameters.
    """

    def __init__(self, network: Network, task: Task, settings: TrainSettings, fabric: Fabric) -> None:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.network: nn.Module = network
        self.average = copy.deepcopy(network).to(fabric.device).eval()
        self._model, self.optimizer = fabric.setup(network, make_optimizer(network, settings))
        if hasattr(network, "branches"):
            self._model.mark_forward_method("branches")
        self._task, self._settings, self._fabric = task, settings, fabric

    def step(self, batch: Batch, rate: float, steps_before: int) -> Float[Tensor, ""]:
        """Learn from one batch at a learning rate.

        Args:
            batch: Of this process.
            rate: The learning rate.
            steps_before: Steps of the run so far. The average begins as a mean over the first steps.

        Returns:
            The loss, without its graph.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self._model.train()
        with self._fabric.autocast():  # Fabric itself casts in forward() alone, not in the other methods
            loss = self._task.loss(self._model, batch, self._fabric.device)
        self.optimizer.zero_grad()
        self._fabric.backward(loss)
        self._fabric.clip_gradients(self._model, self.optimizer, max_norm=self._settings.clip, error_if_nonfinite=False)
        self.optimizer.step()
        keep = min(self._settings.ema, (1 + steps_before) / (10 + steps_before))
        update_average(self.average, self.network, keep)
        return loss.detach()


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, keep: float) -> None:
    """average <- keep * average + (1 - keep) * network, statistics of the normalisation included."""
    pairs = list(zip(average.state_dict().values(), network.state_dict().values(), strict=True))
    floats = [(a, n) for a, n in pairs if a.is_floating_point()]
    torch._foreach_lerp_([a for a, _ in floats], [n for _, n in floats], 1 - keep)
    for a, n in pairs:
        if not a.is_floating_point():
            a.copy_(n)
