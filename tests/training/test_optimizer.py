"""Muon's step against its formula, and which weights it gets."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")

import torch

from gknet.errors import GknetError
from gknet.network.build import NETWORKS, build
from gknet.training.optimizer import Muon, make_optimizer, orthogonalised
from gknet.training.settings import TrainSettings

CHAIN = np.eye(8, dtype=bool) | np.eye(8, k=1, dtype=bool) | np.eye(8, k=-1, dtype=bool)
POINTS = np.random.default_rng(0).uniform(-1, 1, (8, 3))


def polar(matrix: torch.Tensor) -> torch.Tensor:
    """The nearest orthogonal matrix, exactly."""
    u, _, vt = torch.linalg.svd(matrix, full_matrices=False)
    return u @ vt


@pytest.mark.parametrize("shape", [(16, 40), (40, 16), (24, 24)])
def test_every_direction_counts_about_the_same(shape: tuple[int, int]) -> None:
    sizes = torch.tensor([1e-3, 1, 1e3])[:, None, None]
    matrices = sizes * torch.randn(3, *shape, generator=torch.Generator().manual_seed(0))
    found = orthogonalised(matrices)
    for matrix, result in zip(matrices, found, strict=True):
        assert torch.cosine_similarity(result.flatten(), polar(matrix).flatten(), dim=0) > 0.97
        values = torch.linalg.svdvals(result)[: min(shape) // 2]
        assert ((values > 0.6) & (values < 1.3)).all()


def test_two_steps_follow_the_formula() -> None:
    generator = torch.Generator().manual_seed(1)
    start = torch.randn(20, 4, 3, 3, generator=generator)
    parameter = torch.nn.Parameter(start.clone().to(memory_format=torch.channels_last))
    optimizer = Muon([{"params": [parameter], "weight_decay": 0.5, "matrices": True}], lr=0.1, momentum=0.9)
    mean, expected = torch.zeros(20, 36), start.reshape(20, 36)
    for _ in range(2):
        gradient = torch.randn(20, 4, 3, 3, generator=generator)
        parameter.grad = gradient.to(memory_format=torch.channels_last)
        optimizer.step()
        flat = gradient.reshape(20, 36)
        mean = 0.9 * mean + 0.1 * flat
        update = orthogonalised((0.1 * flat + 0.9 * mean)[None])[0]
        expected = (1 - 0.1 * 0.5) * expected - 0.1 * 0.2 * 36**0.5 * update
    assert torch.allclose(parameter.detach().reshape(20, 36), expected, atol=1e-5)


def test_a_step_is_as_long_as_one_of_adamw() -> None:
    parameter = torch.nn.Parameter(torch.zeros(64, 64))
    parameter.grad = torch.randn(64, 64, generator=torch.Generator().manual_seed(2))
    Muon([{"params": [parameter], "matrices": True}], lr=0.01).step()
    assert 0.15 < parameter.detach().square().mean().sqrt() / 0.01 < 0.25


def test_what_is_no_matrix_moves_as_under_adamw() -> None:
    generator = torch.Generator().manual_seed(3)
    start = torch.randn(30, generator=generator)
    ours, theirs = (torch.nn.Parameter(start.clone()) for _ in range(2))
    optimizers = (
        Muon([{"params": [ours], "weight_decay": 0.3}], lr=0.1),
        torch.optim.AdamW([theirs], lr=0.1, weight_decay=0.3),
    )
    for _ in range(3):
        ours.grad = torch.randn(30, generator=generator)
        theirs.grad = ours.grad.clone()
        for optimizer in optimizers:
            optimizer.step()
    assert torch.allclose(ours, theirs, atol=1e-6)
    assert not torch.allclose(ours, start, atol=0.1)


@pytest.mark.parametrize("name", [name for name in NETWORKS if name.endswith(("xs", "-s", "locator"))])
def test_every_weight_is_trained_once(name: str) -> None:
    network = build(name, CHAIN, POINTS)
    optimizer = make_optimizer(network, TrainSettings(name, epochs=1))
    held = [id(parameter) for group in optimizer.param_groups for parameter in group["params"]]
    assert sorted(held) == sorted(id(parameter) for parameter in network.parameters())
    large = [p for group in optimizer.param_groups if group["matrices"] for p in group["params"]]
    left = [p for group in optimizer.param_groups if not group["matrices"] for p in group["params"] if p.ndim > 1]
    assert all(min(len(p), p[0].numel()) < 8 for p in left)  # the finest maps of hrnet-xs: each method by one rule
    assert sum(p.numel() for p in large) > 0.9 * sum(p.numel() for p in network.parameters())
    for group in optimizer.param_groups:
        assert all((parameter.ndim > 1) == (group["weight_decay"] > 0) for parameter in group["params"])


def test_a_gradient_scaler_that_overflows_moves_nothing() -> None:
    network = build("gknet-xs", CHAIN, POINTS)
    optimizer = make_optimizer(network, TrainSettings(epochs=1, precision="16-mixed"))
    scaler = torch.amp.GradScaler("cpu", init_scale=4.0)
    scaler.scale(torch.ones(()))  # it makes itself ready
    before = [parameter.clone() for parameter in network.parameters()]
    for gradient, moved in ((float("inf"), False), (1.0, True)):
        for parameter in network.parameters():
            parameter.grad = torch.full_like(parameter, gradient)
        scaler.unscale_(optimizer)
        scaler.step(optimizer)
        scaler.update()
        same = [torch.equal(old, new) for old, new in zip(before, network.parameters(), strict=True)]
        assert not any(same) if moved else all(same)


def test_adamw_alone() -> None:
    optimizer = make_optimizer(build("gknet-xs", CHAIN, POINTS), TrainSettings(epochs=1, optimizer="adamw"))
    assert isinstance(optimizer, torch.optim.AdamW)


def test_an_unknown_optimizer() -> None:
    with pytest.raises(GknetError, match="optimizer: expected one of muon, adamw, got 'sgd'"):
        TrainSettings(epochs=1, optimizer="sgd")
