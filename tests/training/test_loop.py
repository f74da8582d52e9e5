"""Training resumes exactly, keeps the best and warm-starts."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")

import torch

from gknet.errors import GknetError
from gknet.network.build import build
from gknet.training.checkpoint import BEST, CHECKPOINT, load_weights
from gknet.training.run_file import load_run
from gknet.training.schedule import Stage
from gknet.training.settings import TrainSettings
from gknet.training.train import train

SETTINGS = TrainSettings(
    epochs=3,
    stages=(Stage(0.5, 32, 4), Stage(0.5, 64, 4)),
    precision="32-true",
    device="cpu",
    cache_size=96,
    val_frames=2,
    validations=1,
)


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "straight"
    train(data, "satellite_01", out, SETTINGS, quiet=True)
    return out


@pytest.fixture(scope="module")
def located(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "locator"
    train(data, "satellite_01", out, replace(SETTINGS, network="locator", epochs=1), quiet=True)
    return out


def saved(out: Path) -> dict:
    return torch.load(out / CHECKPOINT, weights_only=True)


def test_a_run_leaves_its_files(finished: Path) -> None:
    run = load_run(finished)
    assert run.best is not None
    assert run.best["samples"] == 36
    with open(finished / "metrics.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["progress"]) == 1
    assert "val_rmse_px" in rows[-1]
    assert list((finished / "tensorboard").iterdir())
    assert not list(finished.glob(".*.tmp"))


def test_a_finished_run_is_prolonged(data: Path, located: Path) -> None:
    before = saved(located)["state"]["samples"]
    state = train(
        data, "satellite_01", located, replace(SETTINGS, network="locator", epochs=2), resume=True, quiet=True
    )
    assert (before, state.samples) == (12, 24)


def test_a_run_is_not_overwritten_and_not_confused(data: Path, finished: Path, tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="--resume"):
        train(data, "satellite_01", finished, SETTINGS, quiet=True)
    with pytest.raises(GknetError, match="another training"):
        train(data, "satellite_01", finished, replace(SETTINGS, network="locator"), resume=True, quiet=True)
    others = ({"graph": "identity"}, {"loss": "squared"}, {"stages": (Stage(1, 96, 4),)}, {"learning_rate": 1e-3})
    for other in others:  # the weights would fit
        with pytest.raises(GknetError, match="another training"):
            train(data, "satellite_01", finished, replace(SETTINGS, **other), resume=True, quiet=True)
    with pytest.raises(GknetError, match="no checkpoint"):
        train(data, "satellite_01", tmp_path, SETTINGS, resume=True, quiet=True)
    (tmp_path / CHECKPOINT).write_bytes(b"not a checkpoint")
    with pytest.raises(GknetError, match=r"checkpoint.pt: not readable"):
        train(data, "satellite_01", tmp_path, SETTINGS, resume=True, quiet=True)


def test_a_warm_start_takes_what_fits(finished: Path) -> None:
    from gknet.training.checkpoint import warm_start

    other = build("gknet-s", np.eye(5, dtype=bool), np.eye(5, 3))
    queries = other.state_dict()["decoder.queries"].clone()
    taken, total = warm_start(other, finished / BEST)
    assert 0.9 * total < taken < total
    name = "encoder.stem.conv.weight"
    assert torch.equal(other.state_dict()[name], load_weights(finished / BEST)[name])
    assert torch.equal(other.state_dict()["decoder.queries"], queries)
    with pytest.raises(GknetError, match="cannot read"):
        warm_start(other, finished / "run.json")
