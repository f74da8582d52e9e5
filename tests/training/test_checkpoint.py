"""A checkpoint that does not fit ends in one short line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

pytest.importorskip("torch")

import torch

from gknet.errors import GknetError
from gknet.training.checkpoint import TrainingState, load_checkpoint, save_checkpoint


@dataclass(frozen=True)
class Learned:
    network: torch.nn.Module
    average: torch.nn.Module
    optimizer: torch.optim.Optimizer


def learned(width: int) -> Learned:
    network = torch.nn.Sequential(*(torch.nn.Linear(width, width) for _ in range(40)))
    return Learned(network, network, torch.optim.AdamW(network.parameters()))


def test_a_checkpoint_of_another_shape_of_the_network_is_refused_in_one_short_line(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, TrainingState(samples=7), learned(3), {"seed": "1"})
    with pytest.raises(GknetError, match=r"does not fit this training .*; train anew in another folder$") as caught:
        load_checkpoint(tmp_path, learned(4), {"seed": "1"})
    assert len(str(caught.value)) < 250 + len(str(tmp_path))
    assert "\\n" not in str(caught.value)
    assert load_checkpoint(tmp_path, learned(3), {"seed": "1"}).samples == 7
