"""The named networks, each constructor spelled out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TypeVar

from jaxtyping import Bool
from numpy import ndarray

from gknet.errors import GknetError
from gknet.network.gknet import GKNet, GKNetConfig
from gknet.network.gknet_paper import GKNetPaper, GKNetPaperConfig
from gknet.network.locator import Locator, LocatorConfig

Network = GKNet | GKNetPaper | Locator
NETWORKS = ("gknet-s", "gknet-paper", "locator")

Config = TypeVar("Config", GKNetConfig, GKNetPaperConfig, LocatorConfig)


def configured(config: type[Config], values: Mapping[str, object]) -> Config:
    """A configuration from plain values; a key that it does not know is an error."""
    known = [field.name for field in fields(config)]
    for key in values:
        if key not in known:
            raise GknetError(f"{config.__name__}: unknown key '{key}'; expected some of {', '.join(known)}")
    return config(**values)  # type: ignore[arg-type]


def gknet_s(adjacency: Bool[ndarray, "n n"], graph: str = "skeleton") -> GKNet:
    """The one that ships: 3.4 M parameters, 256 -> 64x64."""
    config = GKNetConfig(width=32, pyramid_width=48, node_width=128, node_layers=3, heads=4, graph=graph)
    return GKNet(config, adjacency)


def gknet_paper(adjacency: Bool[ndarray, "n n"], graph: str = "skeleton") -> GKNetPaper:
    """The paper's own sizes: about 90 M parameters, 256 -> 32x32."""
    config = GKNetPaperConfig(base=64, node_width=512, node_hidden=2048, node_layers=3, heads=8, graph=graph)
    return GKNetPaper(config, adjacency)


def locator() -> Locator:
    """0.7 M parameters, the whole picture at 256x256 -> 64x64 cells."""
    return Locator(LocatorConfig(width=16, pyramid_width=32))


def build(name: str, adjacency: Bool[ndarray, "n n"], graph: str = "skeleton") -> Network:
    """The network called `name`; the locator has no use for the graph."""
    if name == "gknet-s":
        return gknet_s(adjacency, graph)
    if name == "gknet-paper":
        return gknet_paper(adjacency, graph)
    if name == "locator":
        return locator()
    raise GknetError(f"network: expected one of {', '.join(NETWORKS)}, got '{name}'")
