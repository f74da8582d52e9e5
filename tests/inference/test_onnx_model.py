"""An exported file is run, and refused when it isn't ours."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.inference.onnx_model import OnnxModel
from gknet.io.spacecraft_file import spacecraft_toml
from gknet.spacecraft import Spacecraft

onnx = pytest.importorskip("onnx")

CRAFT = Spacecraft("probe", ("a", "b", "c", "d"), np.vstack([np.eye(3), np.zeros(3)]), ((0, 1), (2, 3)), 1.5)
METADATA = {
    "kind": "keypoints",
    "version": "0.1.0",
    "network": "pool",
    "spacecraft": spacecraft_toml(CRAFT),
    "stride": 4,
    "input_size": 16,
    "tolerance": 1e-4,
}


def write_pool(path: Path, metadata: str | None, size: int | str = 16, channels: int = 4) -> Path:
    """A network that averages cells of 4 x 4 pixels: stride 4, channels are red, green, blue, red, ..."""
    helper = onnx.helper
    cells = size // 4 if isinstance(size, int) else "cells"
    nodes = [
        helper.make_node("AveragePool", ["image"], ["pooled"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Gather", ["pooled", "colours"], ["heatmaps"], axis=1),
    ]
    given = helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, ["b", 3, size, size])
    wanted = helper.make_tensor_value_info("heatmaps", onnx.TensorProto.FLOAT, ["b", channels, cells, cells])
    colours = onnx.numpy_helper.from_array(np.arange(channels) % 3, "colours")
    graph = helper.make_graph(nodes, "pool", [given], [wanted], [colours])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    if metadata is not None:
        helper.set_model_props(model, {"gknet": metadata})
    onnx.save(model, str(path))
    return path


def test_runs_and_knows_its_spacecraft(tmp_path: Path) -> None:
    network = OnnxModel(write_pool(tmp_path / "k.onnx", json.dumps(METADATA)), threads=1)
    images = np.random.default_rng(0).random((2, 3, 16, 16), dtype=np.float32)
    pooled = images.reshape(2, 3, 4, 4, 4, 4).mean(axis=(3, 5))
    np.testing.assert_allclose(network(images), pooled[:, [0, 1, 2, 0]], rtol=1e-5)
    assert network.metadata.stride == 4
    assert network.metadata.spread_scale == network.metadata.pose_scale == 1.0
    assert network.spacecraft.keypoint_names == CRAFT.keypoint_names
    np.testing.assert_allclose(network.spacecraft.points_m, CRAFT.points_m)
    assert network.spacecraft.mesh_path is None


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        (None, "metadata"),
        ("{", "JSON"),
        (json.dumps(METADATA | {"stride": 0}), "stride"),
        (json.dumps(METADATA | {"kind": "cat"}), "kind"),
        (json.dumps(METADATA | {"kind": "locator", "bins": 12}), "no bins for a locator"),
        (json.dumps(METADATA | {"kind": "direct", "bins": 12}), "bins for a direct network"),
        (json.dumps(METADATA | {"bins": 12}), "expected 2 outputs by its metadata, got 1"),
        (json.dumps(METADATA | {"input_size": 10**9}), "input_size"),
        (json.dumps(METADATA | {"input_size": 32}), r"input tensor\(float\) of \(b, 3, 32, 32\)"),
        (json.dumps(METADATA | {"stride": 8}), r"'heatmaps' of \(b, 4, 2, 2\)"),
        (json.dumps(METADATA | {"kind": "locator"}), r"'heatmaps' of \(b, 5, 4, 4\)"),
        (json.dumps(METADATA | {"kind": "direct", "stride": None, "bins": 4}), r"'heatmaps' of \(b, 35\)"),
        ("[" * 100_000, "nested too deeply"),
        (json.dumps({k: v for k, v in METADATA.items() if k != "spacecraft"}), "spacecraft"),
    ],
)
def test_foreign_metadata_is_refused(tmp_path: Path, metadata: str | None, words: str) -> None:
    with pytest.raises(GknetError, match=words):
        OnnxModel(write_pool(tmp_path / "k.onnx", metadata))


def test_bad_spacecraft_text_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(GknetError, match=r"k\.onnx"):
        OnnxModel(write_pool(tmp_path / "k.onnx", json.dumps(METADATA | {"spacecraft": "name = 3"})))


def test_a_graph_may_leave_its_size_open(tmp_path: Path) -> None:
    """Then the metadata's size is the only one."""
    network = OnnxModel(write_pool(tmp_path / "k.onnx", json.dumps(METADATA), size="side"), threads=1)
    assert network(np.zeros((1, 3, 16, 16), dtype=np.float32)).shape == (1, 4, 4, 4)


def test_bad_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="no such model file"):
        OnnxModel(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(GknetError, match=r"bad\.onnx") as caught:
        OnnxModel(tmp_path / "bad.onnx")
    assert "\n" not in str(caught.value)


def test_bad_arguments_are_refused(tmp_path: Path) -> None:
    path = write_pool(tmp_path / "k.onnx", json.dumps(METADATA))
    with pytest.raises(GknetError, match="device"):
        OnnxModel(path, device="abacus")
    for threads in (0, -1, 1025, 99_999):
        with pytest.raises(GknetError, match="1 to 1024"):
            OnnxModel(path, threads=threads)
    with pytest.raises(GknetError, match=r"\(b, 3, 16, 16\)"):
        OnnxModel(path)(np.zeros((1, 3, 8, 8), dtype=np.float32))
