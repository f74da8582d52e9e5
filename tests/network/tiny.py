"""Small graphs and networks that the tests share."""

from __future__ import annotations

import numpy as np
import torch

from gknet.network.gknet import GKNet, GKNetConfig


def chain(count: int) -> np.ndarray:
    matrix = np.eye(count, dtype=bool)
    for i in range(count - 1):
        matrix[i, i + 1] = matrix[i + 1, i] = True
    return matrix


def tiny(count: int, graph: str = "skeleton") -> GKNet:
    torch.manual_seed(0)
    return GKNet(GKNetConfig(width=4, pyramid_width=8, node_width=8, node_layers=2, heads=2, graph=graph), chain(count))
