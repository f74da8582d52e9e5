"""What is exported is what was trained: one file that onnxruntime runs, and that a training can start from."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("lightning_fabric")

import onnx
import onnxruntime
import torch
from torch import nn

import gknet.training.export as exporting
from gknet.cli.main import run as command
from gknet.errors import GknetError
from gknet.inference.load import load_estimator
from gknet.inference.onnx_model import OnnxModel
from gknet.io.spacecraft_file import spacecraft_toml
from gknet.network.backbone import ConvNorm, check_input
from gknet.network.build import NETWORKS, build
from gknet.network.heatmap import HeatmapBranches, HeatmapNetwork
from gknet.network.spec import NetworkSpec, Stage
from gknet.training.checkpoint import BEST, load_weights, save_weights, warm_start
from gknet.training.export import Exported, export_run, round_weights
from gknet.training.onnx_graph import WEIGHTS, onnx_graph, weights_of_onnx
from gknet.training.run_file import TrainingRun
from gknet.training.settings import TrainSettings
from gknet.training.train import train
from tests.training.toy import toy_spacecraft

CRAFT = toy_spacecraft()
SIZE = 64


class ToyNetwork(HeatmapNetwork):
    """Two strided convolutions and a linear layer over the cells."""

    def __init__(self, keypoints: int, loss: str) -> None:
        super().__init__(loss, stride=4)
        self.body = nn.Sequential(ConvNorm(3, 8, 3, 2), ConvNorm(8, 16, 3, 2))
        self.head = nn.Linear(16, keypoints)

    def branches(self, image: torch.Tensor) -> HeatmapBranches:
        check_input(image)
        maps = self.head(self.body(image).permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
        return HeatmapBranches(maps, maps, None)


@pytest.fixture(scope="module", autouse=True)
def toy_is_registered() -> Iterator[None]:
    """A network is a class, a builder and an entry; nothing else names it."""
    spec = NetworkSpec("keypoints", lambda o: ToyNetwork(o.keypoint_count, o.loss), (Stage(1.0, SIZE, 4),), "squared")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(NETWORKS, "toy", spec)
        yield


def trained_toy() -> ToyNetwork:
    """As if it were trained: weights and statistics of no special value."""
    torch.manual_seed(0)
    network = build("toy", CRAFT.adjacency, CRAFT.points_m)
    assert isinstance(network, ToyNetwork)
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            if name.endswith("running_var"):
                tensor.uniform_(0.2, 2)
            elif tensor.is_floating_point():
                tensor.normal_(std=0.3)
    return network.eval()


def write_run(folder: Path, name: str, network: nn.Module) -> Path:
    """As a training leaves it, as far as an export reads it."""
    best = {"score": 1.0, "floor_cells": 0.2, "spread_scale": 0.5, "pose_scale": 2.0}
    loss = NETWORKS[name].loss or "likelihood"
    TrainingRun(name, "skeleton", loss, SIZE, spacecraft_toml(CRAFT), {}, "0", "none", best).save(folder)
    save_weights(folder / BEST, network.state_dict(), {"best": best})
    return folder


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("toy_run"), "toy", trained_toy())


@pytest.fixture(scope="module")
def exported(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export_run(run_folder, tmp_path_factory.mktemp("toy_model"))


def test_one_file_agrees_with_torch_and_has_its_metadata(exported: Exported) -> None:
    assert [path.name for path in exported.onnx_path.parent.iterdir()] == ["keypoints.onnx"]
    model = OnnxModel(exported.onnx_path, threads=1)
    assert (model.metadata.network, model.metadata.stride, model.metadata.input_size) == ("toy", 4, SIZE)
    assert model.metadata.bins is None
    assert (model.metadata.floor_cells, model.metadata.spread_scale, model.metadata.pose_scale) == (0.2, 0.5, 2.0)
    assert model.spacecraft.keypoint_names == CRAFT.keypoint_names
    network = trained_toy()
    round_weights(network)
    images = np.random.default_rng(0).random((3, 3, SIZE, SIZE), dtype=np.float32)
    with torch.inference_mode():
        expected = network(torch.from_numpy(images)).numpy()
    np.testing.assert_allclose(model(images), expected, atol=1e-5, rtol=1e-5)
    assert exported.runtime_difference < 1e-5
    assert 0 < exported.rounding_difference < 0.01


def test_the_file_gives_back_the_weights_bit_by_bit(exported: Exported) -> None:
    trained, found = trained_toy().state_dict(), weights_of_onnx(exported.onnx_path)
    assert set(trained) - set(found) == {f"body.{k}.norm.num_batches_tracked" for k in (0, 1)}
    for name, tensor in found.items():
        assert tensor.dtype == (torch.float16 if tensor.ndim > 1 else torch.float32)
        assert torch.equal(tensor, trained[name].to(tensor.dtype))


def test_a_training_starts_from_the_file(exported: Exported) -> None:
    expected = trained_toy()
    round_weights(expected)
    network = build("toy", CRAFT.adjacency, CRAFT.points_m).eval()
    taken, total = warm_start(network, exported.onnx_path)
    assert taken == total == len(weights_of_onnx(exported.onnx_path))
    loaded = build("toy", CRAFT.adjacency, CRAFT.points_m).eval()
    loaded.load_state_dict(load_weights(exported.onnx_path))
    image = torch.rand(2, 3, SIZE, SIZE)
    for each in (network, loaded):
        assert torch.equal(each(image), expected(image))


def test_an_export_of_the_export_is_the_same_file(exported: Exported, run_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_bytes((run_folder / "run.json").read_bytes())
    save_weights(tmp_path / BEST, load_weights(exported.onnx_path), {})
    other = export_run(tmp_path, tmp_path / "model")
    assert other.rounding_difference == 0
    assert weights_of_onnx(other.onnx_path).keys() == weights_of_onnx(exported.onnx_path).keys()
    for name, tensor in weights_of_onnx(other.onnx_path).items():
        assert torch.equal(tensor, weights_of_onnx(exported.onnx_path)[name])


def test_onnxruntime_folds_what_the_file_keeps_apart(exported: Exported, tmp_path: Path) -> None:
    """So normalisations, 16-bit weights and matrices as torch has them cost nothing at run time."""
    kinds = [node.op_type for node in onnx.load(exported.onnx_path).graph.node]
    assert {"BatchNormalization", "Cast"} <= set(kinds)
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_EXTENDED
    onnxruntime.InferenceSession(str(exported.onnx_path), options, providers=["CPUExecutionProvider"])
    folded = [node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node]
    assert not {"BatchNormalization", "Cast"} & set(folded)


def test_the_file_names_nothing_of_the_machine(exported: Exported) -> None:
    model = onnx_graph(ToyNetwork(2, "squared").eval(), torch.zeros(2, 3, SIZE, SIZE))
    parts = (model, model.graph, *model.graph.node, *model.graph.initializer, *model.graph.value_info)
    assert not any(part.doc_string or part.metadata_props for part in parts)
    content = exported.onnx_path.read_bytes()
    for trace in (b"site-packages", b".py", str(Path.cwd()).encode(), b"pkg."):
        assert trace not in content


def test_a_state_that_the_graph_does_not_hold_is_refused() -> None:
    network = ToyNetwork(2, "squared").eval()
    network.unused = nn.Parameter(torch.ones(3))
    with pytest.raises(GknetError, match="unused is not in the graph"):
        onnx_graph(network, torch.zeros(2, 3, SIZE, SIZE))


def test_weights_beyond_16_bits_are_refused(tmp_path: Path) -> None:
    for value in (1e6, float("nan")):
        network = trained_toy()
        with torch.no_grad():
            network.head.weight[0, 0] = value
        with pytest.raises(GknetError, match="too large for 16 bits"):
            export_run(write_run(tmp_path, "toy", network), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_export_that_differs_is_refused(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    true_run = exporting.run_onnx
    monkeypatch.setattr(exporting, "run_onnx", lambda model, images: true_run(model, images) + 0.01)
    with pytest.raises(GknetError, match="tolerance"):
        export_run(run_folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_file_without_such_weights_is_refused_in_one_line(exported: Exported, tmp_path: Path) -> None:
    model = onnx.load(exported.onnx_path)
    for tensor in model.graph.initializer:  # as version 0.1 wrote them
        tensor.name = tensor.name.replace(WEIGHTS, "network.")
    old = tmp_path / "old.onnx"
    old.write_bytes(model.SerializeToString())
    with pytest.raises(GknetError, match=r"old\.onnx: expected weights that can be trained on"):
        load_weights(old)
    damaged = tmp_path / "damaged.onnx"
    damaged.write_bytes(exported.onnx_path.read_bytes()[:1000])
    for path in (damaged, tmp_path / "missing.onnx"):
        with pytest.raises(GknetError, match="cannot read the weights") as caught:
            load_weights(path)
        assert "\n" not in str(caught.value)


def test_a_folder_that_is_no_run(run_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="gknet train"):
        export_run(tmp_path, tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(GknetError, match="JSON"):
        export_run(tmp_path, tmp_path)
    (tmp_path / "run.json").write_text(json.dumps({"network": "gknet-s"}))
    with pytest.raises(GknetError, match=r"run\.json"):
        export_run(tmp_path, tmp_path)
    (tmp_path / "run.json").write_bytes((run_folder / "run.json").read_bytes())
    with pytest.raises(GknetError, match="cannot read the weights"):
        export_run(tmp_path, tmp_path)
    other = build("hrnet-xs", CRAFT.adjacency, CRAFT.points_m)
    save_weights(tmp_path / BEST, other.state_dict(), {})
    with pytest.raises(GknetError, match=r"not of the network in run\.json"):
        export_run(tmp_path, tmp_path)


def test_a_registered_network_trains_exports_and_evaluates(data: Path, tmp_path: Path) -> None:
    settings = TrainSettings("toy", samples=4, device="cpu", cache_size=96, val_frames=2, validations=1, workers=1)
    state = train(data, "satellite_01", tmp_path / "run", settings, quiet=True)
    assert state.steps == 1
    model = export_run(tmp_path / "run", tmp_path / "model").onnx_path.parent
    assert load_estimator(model, threads=1).settings.input_size == SIZE
    words = ["eval", str(data), "--model", str(model), "--split", "val", "--out", str(tmp_path / "pages")]
    assert command(words) == 0
    content = json.loads((tmp_path / "pages" / "metrics.json").read_text())
    assert content["runs"]["oracle"]["frames"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "channels", "bins"), [("gknet-xs", 17, 12), ("dmanet-xs", None, 16), ("locator", 5, None)]
)
def test_each_kind_is_exported_as_it_is(name: str, channels: int | None, bins: int | None, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = build(name, CRAFT.adjacency, CRAFT.points_m).eval()
    result = export_run(write_run(tmp_path, name, network), tmp_path / "model")
    kind = NETWORKS[name].kind
    assert result.onnx_path.name == f"{kind}.onnx"
    model = OnnxModel(result.onnx_path, threads=1)
    assert (model.metadata.kind, model.metadata.network, model.metadata.bins) == (kind, name, bins)
    assert model.metadata.stride == (None if channels is None else 4)
    round_weights(network)
    images = np.random.default_rng(0).random((2, 3, SIZE, SIZE), dtype=np.float32)
    with torch.inference_mode():
        expected = network.predict(torch.from_numpy(images))
    found = model.predict(images) if kind == "keypoints" else (model(images),)
    assert expected[0].shape == ((2, channels, SIZE // 4, SIZE // 4) if channels else (2, 3 + 16**3 // 2))
    for got, wanted in zip(found, expected, strict=True):
        assert got is not None
        np.testing.assert_allclose(got, wanted, atol=1e-4, rtol=1e-3)
    weights = weights_of_onnx(result.onnx_path)
    numbers = sum(tensor.numel() for tensor in weights.values())
    numbers += 864 * 17 * 8 * 8 if kind == "keypoints" else 0  # where attitudes place keypoints
    assert result.onnx_path.stat().st_size < 0.65 * 4 * numbers
    for key, tensor in network.state_dict().items():
        assert key.endswith("num_batches_tracked") or torch.equal(weights[key].float(), tensor)
