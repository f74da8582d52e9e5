"""The optimizers: AdamW, and Muon for the weights that mix channels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim.adamw import adamw

from gknet.training.settings import TrainSettings

QUINTIC = (3.4445, -4.7750, 2.0315)
"""Of Jordan's Newton-Schulz iteration (2024): a few rounds take singular values of 0.01 to 1 near 1."""
ROUNDS = 5
RMS = 0.2
"""Of an update over its learning rate: about what AdamW's is, so that one learning rate serves both (Liu 2025)."""
SMALLEST = 8
"""Matrices with fewer rows or columns have few directions to balance and get AdamW."""


def orthogonalised(matrices: Float[Tensor, "k r c"]) -> Float[Tensor, "k r c"]:
    """About U V^T of each matrix U S V^T: every direction of an update counts about the same."""
    a, b, c = QUINTIC
    x = matrices / matrices.norm(dim=(1, 2), keepdim=True).clamp(min=1e-7)
    tall = x.shape[1] > x.shape[2]
    x = x.mT if tall else x
    for _ in range(ROUNDS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.mT if tall else x


class Muon(torch.optim.Optimizer):
    """Orthogonalised momentum (Jordan et al. 2024) for matrices and kernels, AdamW for the rest; decoupled decay.

    A kernel is a matrix of its outputs by all the rest. torch.optim.Muon refuses kernels and computes in bfloat16,
    which is slow on most CPUs. One optimizer, not two, since a gradient scaler counts its steps.
    """

    def __init__(self, groups: Sequence[dict[str, Any]], lr: float, momentum: float = 0.95) -> None:
        """As any optimizer.

        Args:
            groups: Of parameters; those with "matrices": True are orthogonalised.
            lr: The learning rate.
            momentum: Of the running mean of the gradient.
        """
        super().__init__(groups, {"lr": lr, "weight_decay": 0.0, "momentum": momentum, "matrices": False})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One step, see `torch.optim.Optimizer.step`."""
        value = None
        if closure is not None:
            with torch.enable_grad():
                value = closure()
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            if group["matrices"]:
                self._step_matrices(parameters, group)
            else:
                self._step_adamw(parameters, group)
        return value

    def _step_matrices(self, parameters: list[nn.Parameter], group: dict[str, Any]) -> None:
        alike: dict[tuple[int, int], list[nn.Parameter]] = defaultdict(list)
        for parameter in parameters:
            alike[_matrix_shape(parameter)].append(parameter)
        for shape, same in alike.items():
            ahead = torch.stack([self._ahead(parameter, group["momentum"]).reshape(shape) for parameter in same])
            scale = group["lr"] * RMS * max(shape) ** 0.5
            for parameter, update in zip(same, orthogonalised(ahead), strict=True):
                parameter.mul_(1 - group["lr"] * group["weight_decay"])
                parameter.sub_(update.reshape(parameter.shape), alpha=scale)

    def _ahead(self, parameter: nn.Parameter, momentum: float) -> Tensor:
        """The running mean of the gradient, as it will be at the next step if nothing changes (Nesterov)."""
        gradient, state = parameter.grad, self.state[parameter]
        assert gradient is not None
        if not state:
            state["mean"] = torch.zeros_like(parameter)
        state["mean"].lerp_(gradient, 1 - momentum)
        return gradient.lerp(state["mean"], momentum)

    def _step_adamw(self, parameters: list[nn.Parameter], group: dict[str, Any]) -> None:
        for parameter in parameters:
            state = self.state[parameter]
            if not state:
                state |= {"mean": torch.zeros_like(parameter), "square": torch.zeros_like(parameter)}
                state["step"] = torch.zeros((), dtype=torch.float32)
        states = [self.state[parameter] for parameter in parameters]
        adamw(
            list(parameters),
            [parameter.grad for parameter in parameters if parameter.grad is not None],
            [state["mean"] for state in states],
            [state["square"] for state in states],
            [],
            [state["step"] for state in states],
            foreach=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=group["lr"],
            weight_decay=group["weight_decay"],
            eps=1e-8,
            maximize=False,
        )


def _matrix_shape(parameter: Tensor) -> tuple[int, int]:
    return parameter.shape[0], parameter[0].numel()


def make_optimizer(network: nn.Module, settings: TrainSettings) -> torch.optim.Optimizer:
    """The optimizer of the settings; only matrices and kernels decay."""
    rate, decay = settings.learning_rate, settings.weight_decay
    many = [p for p in network.parameters() if p.ndim > 1]
    vectors = {"params": [p for p in network.parameters() if p.ndim <= 1], "weight_decay": 0.0}
    if settings.optimizer == "adamw":
        # The fused one unscales gradients by itself, which a clipped fp16 training must do before.
        fused = settings.precision != "16-mixed"
        return torch.optim.AdamW([{"params": many, "weight_decay": decay}, vectors], lr=rate, fused=fused)
    large: list[nn.Parameter] = []
    small: list[nn.Parameter] = []
    for parameter in many:
        (large if min(_matrix_shape(parameter)) >= SMALLEST else small).append(parameter)
    groups = [{"params": large, "weight_decay": decay, "matrices": True}, {"params": small, "weight_decay": decay}]
    return Muon([*groups, vectors], rate)
