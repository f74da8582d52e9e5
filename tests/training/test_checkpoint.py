"""A checkpoint that does not fit ends in one short line."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

pytest.importorskip("torch")

import torch

from gknet.errors import GknetError
from gknet.io.torch_file import load_torch_file
from gknet.training.checkpoint import (
    BEST,
    CHECKPOINT,
    TrainingState,
    load_checkpoint,
    load_weights,
    save_checkpoint,
    save_weights,
)
from gknet.training.run_file import TrainingRun, load_run


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


def test_another_training_is_refused_by_what_differs(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, TrainingState(), learned(3), {"seed": "1", "stages": "1:64:4"})
    with pytest.raises(GknetError, match=r"another training \(stages 1:64:4, now 1:96:2\)"):
        load_checkpoint(tmp_path, learned(3), {"seed": "1", "stages": "1:96:2"})


def test_a_flipped_bit_is_found_wherever_it_is(tmp_path: Path) -> None:
    """Or it is in the zip file's padding and changes nothing."""
    saved = learned(3)
    save_checkpoint(tmp_path, TrainingState(samples=7), saved, {"seed": "1"})
    path = tmp_path / CHECKPOINT
    content, found = path.read_bytes(), 0
    for position in range(0, len(content), len(content) // 200):
        path.write_bytes(content[:position] + bytes([content[position] ^ 4]) + content[position + 1 :])
        loaded = learned(3)
        try:
            assert load_checkpoint(tmp_path, loaded, {"seed": "1"}).samples == 7
        except GknetError:
            found += 1
            continue
        for name, tensor in saved.network.state_dict().items():
            assert torch.equal(loaded.network.state_dict()[name], tensor)
    assert found > 100


def test_weights_carry_the_validation_that_they_are_of(tmp_path: Path) -> None:
    """A run that was killed between best.safetensors and run.json has an older run.json."""
    run = TrainingRun("gknet-s", "skeleton", "squared", 64, "", {}, "1", "data", {"score": 2.0})
    run.save(tmp_path)
    assert load_run(tmp_path) == run
    save_weights(tmp_path / BEST, {"w": torch.zeros(2)}, {"best": {"score": 1.0}})
    assert load_run(tmp_path) == replace(run, best={"score": 1.0})
    save_weights(tmp_path / BEST, {"w": torch.zeros(2)}, {})
    assert load_run(tmp_path) == run


def test_weights_in_a_pipe_are_refused_before_they_block(tmp_path: Path) -> None:
    pipe = tmp_path / "weights.safetensors"
    os.mkfifo(pipe)
    with pytest.raises(GknetError, match="a folder or a pipe"):
        load_weights(pipe)
    with pytest.raises(GknetError, match="a folder or a pipe"):
        load_torch_file(pipe)
