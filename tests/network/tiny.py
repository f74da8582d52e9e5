"""Small graphs and networks that the tests share."""

from __future__ import annotations

import numpy as np
import torch

from gknet.network.gknet import GKNet, GKNetConfig
from gknet.network.graph import GraphLayer


def chain(count: int) -> np.ndarray:
    matrix = np.eye(count, dtype=bool)
    for i in range(count - 1):
        matrix[i, i + 1] = matrix[i + 1, i] = True
    return matrix


def points(count: int) -> np.ndarray:
    """(count, 3) keypoints in metres, no two alike."""
    return np.random.default_rng(count).uniform(-1, 1, (count, 3)) * (3, 2, 1)


def layers_of(network: GKNet) -> list[GraphLayer]:
    """The layers of the graph decoder."""
    assert network.decoder is not None
    return [layer for layer in network.decoder.layers if isinstance(layer, GraphLayer)]


def tiny(count: int, graph: str = "skeleton", bins: int = 4) -> GKNet:
    torch.manual_seed(0)
    config = GKNetConfig(width=4, pyramid_width=8, node_width=8, node_layers=2, heads=2, bins=bins, graph=graph)
    return GKNet(config, chain(count), points(count))
