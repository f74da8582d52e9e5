"""A checkpoint that does not fit ends in one short line."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from gknet.errors import GknetError  # noqa: E402
from gknet.training.checkpoint import TrainingState, load_checkpoint, save_checkpoint  # noqa: E402


def parts(width: int) -> tuple[torch.nn.Module, torch.nn.Module, torch.optim.Optimizer]:
    network = torch.nn.Sequential(*(torch.nn.Linear(width, width) for _ in range(40)))
    return network, network, torch.optim.AdamW(network.parameters())


def test_a_checkpoint_of_another_shape_of_the_network_is_refused_in_one_short_line(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, TrainingState(samples=7), *parts(3), "one")
    with pytest.raises(GknetError, match=r"does not fit this training .*; train anew in another folder$") as caught:
        load_checkpoint(tmp_path, *parts(4), "one")
    assert len(str(caught.value)) < 250 + len(str(tmp_path))
    assert "\\n" not in str(caught.value)
    assert load_checkpoint(tmp_path, *parts(3), "one").samples == 7
