"""Names in a state dict: those that have changed, so that weights of version 0.1 still load, and those of no use."""

from __future__ import annotations

import re
from collections.abc import Mapping

from torch import Tensor

RENAMED = (
    (r"^decoder\.layers\.(\d+)\.look\.", r"decoder.layers.\1.attention."),
    (r"^decoder\.layers\.(\d+)\.after_look\.", r"decoder.layers.\1.attention_norm."),
    (r"^decoder\.layers\.(\d+)\.seen\.", r"decoder.layers.\1.sample."),
    (r"^decoder\.layers\.(\d+)\.after_seen\.", r"decoder.layers.\1.sample_norm."),
    (r"^decoder\.layers\.(\d+)\.graph\.place\.", r"decoder.layers.\1.graph.position."),
    (r"^decoder\.layers\.(\d+)\.after_graph\.", r"decoder.layers.\1.graph_norm."),
    (r"^levels\.(\d+)\.(\d+)\.channels\.", r"levels.\1.\2.channel_attention."),
    (r"^levels\.(\d+)\.(\d+)\.places\.look\.", r"levels.\1.\2.spatial_attention.conv."),
    (r"^place\.", "position."),
    (r"^votes\.", "offset_cells."),
)
"""Patterns of old names and what replaces them: of GKNet's decoders, then of DMANet."""

COUNTER = "num_batches_tracked"
"""Of each batch normalisation. Nothing reads it, and PyTorch fills it in where it is missing."""


def current_name(name: str) -> str:
    """The name of a parameter today; a name of today stays as it is."""
    for old, new in RENAMED:
        name = re.sub(old, new, name)
    return name


def with_current_names(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of any version under the names of today."""
    return {current_name(name): tensor for name, tensor in weights.items()}


def without_counters(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights without the counters of batch normalisations."""
    return {name: tensor for name, tensor in weights.items() if name.rpartition(".")[2] != COUNTER}
