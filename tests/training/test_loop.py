"""Training resumes exactly, keeps the best, warm-starts; export agrees with torch or is refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")

import torch

import gknet.training.export as exporting
from gknet.errors import GknetError
from gknet.inference.attitude import AttitudeBins
from gknet.inference.load import load_estimator
from gknet.inference.onnx_model import OnnxModel
from gknet.io.spacecraft_file import spacecraft_from_toml
from gknet.network.build import build
from gknet.training.checkpoint import BEST, CHECKPOINT, load_weights
from gknet.training.export import export_run
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


@pytest.fixture(scope="module")
def glancing(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "xs"
    train(data, "satellite_01", out, replace(SETTINGS, network="gknet-xs", epochs=1), quiet=True)
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


def test_exports_agree_with_torch_and_know_what_they_are(
    finished: Path, glancing: Path, located: Path, tmp_path: Path
) -> None:
    for run, kind, channels in ((finished, "keypoints", 17), (glancing, "keypoints", 17), (located, "locator", 5)):
        result = export_run(run, tmp_path)
        assert result.onnx_path == tmp_path / f"{kind}.onnx"
        assert result.runtime_difference <= 1e-3
        network = OnnxModel(result.onnx_path, threads=1)
        assert network.metadata.kind == kind
        assert network.metadata.stride == 4
        assert network.spacecraft.name == "satellite_01"
        size = network.metadata.input_size
        assert size == load_run(run).input_size == 64  # the last stage's
        assert network(np.zeros((2, 3, size, size), np.float32)).shape == (2, channels, size // 4, size // 4)
        assert network.metadata.bins == (12 if kind == "keypoints" else None)
        places = 864 * channels * 8 * 8 if kind == "keypoints" else 0  # where attitudes put keypoints
        numbers = places + sum(t.numel() for t in load_weights(run / BEST).values())
        assert result.onnx_path.stat().st_size < 0.65 * 4 * numbers
        assert b"site-packages" not in result.onnx_path.read_bytes()  # no traces of the machine that exported it
        again = load_weights(result.weights_path)
        for name, tensor in load_weights(run / BEST).items():
            torch.testing.assert_close(again[name], tensor, atol=1e-3, rtol=1e-3)


def test_an_exported_belief_in_the_attitude_is_that_of_the_trained_weights(glancing: Path, tmp_path: Path) -> None:
    run = load_run(glancing)
    spacecraft = spacecraft_from_toml(run.spacecraft_toml, "run.json")
    trained = build(run.network, spacecraft.adjacency, spacecraft.points_m, run.graph, run.loss).eval()
    trained.load_state_dict(load_weights(glancing / BEST))
    images = np.random.default_rng(0).random((2, 3, 64, 64), dtype=np.float32)
    seen = OnnxModel(export_run(glancing, tmp_path).onnx_path, threads=1).predict(images)
    with torch.no_grad():
        heatmaps, attitude = trained.predict(torch.from_numpy(images))
    np.testing.assert_allclose(seen.heatmaps, heatmaps, atol=0.01)
    np.testing.assert_allclose(seen.attitude, attitude, atol=1e-3)
    np.testing.assert_allclose(seen.attitude.sum(axis=1), 1, rtol=1e-4)
    estimator = load_estimator(tmp_path, threads=1)
    assert estimator.bins == AttitudeBins(12)


def test_an_export_that_differs_is_refused(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    true_run = exporting.run_onnx
    monkeypatch.setattr(exporting, "run_onnx", lambda model, images: true_run(model, images) + 0.01)
    with pytest.raises(GknetError, match="tolerance"):
        export_run(finished, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_no_run(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="gknet train"):
        export_run(tmp_path, tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(GknetError, match="JSON"):
        export_run(tmp_path, tmp_path)
    (tmp_path / "run.json").write_text(json.dumps({"network": "gknet-s"}))
    with pytest.raises(GknetError, match="expected the keys"):
        export_run(tmp_path, tmp_path)
    (tmp_path / "run.json").write_text((finished / "run.json").read_text())
    with pytest.raises(GknetError, match="cannot read the weights"):
        export_run(tmp_path, tmp_path)
