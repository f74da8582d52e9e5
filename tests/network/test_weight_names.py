"""Weights of version 0.1 still load: each old name has one of today, and the outputs are the same."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("safetensors")

import torch

from gknet.network.dmanet import DMANet, DMANetConfig
from gknet.network.weight_names import current_name
from gknet.training.checkpoint import load_weights, save_weights, warm_start
from tests.network.tiny import tiny

OLD_OF_GKNET = {
    "attention_norm.": "after_look.",
    "attention.": "look.",
    "sample_norm.": "after_seen.",
    "sample.": "seen.",
    "graph_norm.": "after_graph.",
    "graph.position.": "graph.place.",
}
OLD_OF_DMANET = {"channel_attention.": "channels.", "spatial_attention.conv.": "places.look."}
OLD_AT_THE_START_OF_DMANET = {"position.": "place.", "offset_cells.": "votes."}


def old_of_gknet(name: str) -> str:
    """The name in version 0.1."""
    if name.startswith("decoder.layers."):
        layer, rest = name[: len("decoder.layers.0.")], name[len("decoder.layers.0.") :]
        for new, old in OLD_OF_GKNET.items():
            if rest.startswith(new):
                return layer + old + rest[len(new) :]
    return name


def old_of_dmanet(name: str) -> str:
    for new, old in OLD_OF_DMANET.items():
        name = name.replace(new, old)
    for new, old in OLD_AT_THE_START_OF_DMANET.items():
        if name.startswith(new):
            name = old + name[len(new) :]
    return name


def dmanet() -> DMANet:
    return DMANet(DMANetConfig((4, 6, 8, 10), (2, 4, 4, 6), (1, 2, 1, 2), head=12, bins=4))


def test_old_names_become_those_of_today_and_those_stay() -> None:
    for network, old_of in ((tiny(5), old_of_gknet), (dmanet(), old_of_dmanet)):
        names = list(network.state_dict())
        changed = [name for name in names if old_of(name) != name]
        assert len(changed) > 10
        for name in names:
            assert current_name(old_of(name)) == name
            assert current_name(name) == name


@pytest.mark.parametrize("kind", ["gknet", "dmanet"])
def test_a_file_of_old_names_loads_and_gives_the_same_outputs(kind: str, tmp_path: Path) -> None:
    make, old_of = (lambda: tiny(5), old_of_gknet) if kind == "gknet" else (dmanet, old_of_dmanet)
    torch.manual_seed(1)
    trained = make()
    for parameter in trained.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    path = tmp_path / "old.safetensors"
    save_weights(path, {old_of(name): tensor for name, tensor in trained.state_dict().items()}, {})
    image = torch.rand(2, 3, 64, 64)
    expected = trained.eval().predict(image)

    loaded = make()
    loaded.load_state_dict(load_weights(path))
    warm = make()
    taken, total = warm_start(warm, path)
    assert taken == total
    for network in (loaded, warm):
        for found, wanted in zip(network.eval().predict(image), expected, strict=True):
            assert torch.equal(found, wanted)
