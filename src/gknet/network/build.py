"""The named networks, each constructor spelled out."""

from __future__ import annotations

from jaxtyping import Bool, Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.network.dmanet import DMANet, DMANetConfig
from gknet.network.gknet import GKNet, GKNetConfig
from gknet.network.gknet_paper import GKNetPaper, GKNetPaperConfig
from gknet.network.heatmap import HeatmapNetwork
from gknet.network.hrnet import HRNet, HRNetConfig
from gknet.network.locator import Locator, LocatorConfig
from gknet.network.resunet import ResUNet, ResUNetConfig

Network = HeatmapNetwork | DMANet | Locator
NETWORKS = (
    "gknet-s",
    "gknet-paper",
    "hrnet",
    "resunet",
    "dmanet",
    "gknet-xs",
    "hrnet-xs",
    "resunet-xs",
    "dmanet-xs",
    "locator",
)
GRAPH_NETWORKS = ("gknet-s", "gknet-paper", "gknet-xs")
"""Those that have a graph to choose."""
OWN_LOSS_NETWORKS = ("dmanet", "dmanet-xs", "locator")
"""Those that have no heatmaps, and a loss of their own."""

PAPER_STRIDE = 8
"""The paper holds every method to heatmaps of 32x32 at 256x256."""


def gknet_s(
    adjacency: Bool[ndarray, "n n"],
    points_m: Float[ndarray, "n 3"],
    graph: str = "skeleton",
    loss: str = "likelihood",
) -> GKNet:
    """The one that ships: 3.6 M parameters and 0.9 GMAC at 256, 256 -> 64x64.

    Without its graph branch it is widened to the same parameters, so that the ablation is one of the graph.
    """
    width = 34 if graph == "none" else 32
    config = GKNetConfig(width=width, pyramid_width=48, node_width=128, node_layers=3, heads=4, bins=12, graph=graph)
    return GKNet(config, adjacency, points_m, loss)


def gknet_xs(
    adjacency: Bool[ndarray, "n n"],
    points_m: Float[ndarray, "n 3"],
    graph: str = "skeleton",
    loss: str = "likelihood",
) -> GKNet:
    """The one to compare methods with on a CPU: 1.0 M parameters and 0.26 GMAC at 256, 256 -> 64x64.

    Without its graph branch it is widened as `gknet_s` is.
    """
    width, pyramid_width = (17, 32) if graph == "none" else (16, 24)
    config = GKNetConfig(width, pyramid_width, node_width=64, node_layers=3, heads=4, bins=12, graph=graph)
    return GKNet(config, adjacency, points_m, loss)


def gknet_paper(adjacency: Bool[ndarray, "n n"], graph: str = "skeleton", loss: str = "squared") -> GKNetPaper:
    """The paper's own sizes: 89 M parameters and 64 GMAC, 256 -> 32x32."""
    config = GKNetPaperConfig(base=64, node_width=512, node_hidden=2048, node_layers=3, heads=8, graph=graph)
    return GKNetPaper(config, adjacency, loss)


def hrnet(keypoints: int, loss: str = "squared") -> HRNet:
    """HRNet-W32: 28.6 M parameters and 10 GMAC, held to 32x32 as in the paper."""
    config = HRNetConfig(width=32, stem_width=64, bottlenecks=4, modules=(1, 4, 3), blocks=4)
    return HRNet(config, keypoints, loss, PAPER_STRIDE)


def hrnet_xs(keypoints: int, loss: str = "likelihood") -> HRNet:
    """The shape of its authors' HRNet-Small-v2 at the cost of gknet-xs, 256 -> 64x64.

    W32's depth would leave 5 channels to the finest branch, and take twice as long to train.
    """
    config = HRNetConfig(width=8, stem_width=12, bottlenecks=2, modules=(1, 3, 2), blocks=2)
    return HRNet(config, keypoints, loss)


def resunet(keypoints: int, loss: str = "squared") -> ResUNet:
    """ResNet-34 U-Net: 24 M parameters and 6 GMAC, held to 32x32 as in the paper."""
    return ResUNet(ResUNetConfig(width=64, blocks=(3, 4, 6, 3)), keypoints, loss, PAPER_STRIDE)


def resunet_xs(keypoints: int, loss: str = "likelihood") -> ResUNet:
    """ResUNet's shape at the cost of gknet-xs, 256 -> 64x64."""
    return ResUNet(ResUNetConfig(width=12, blocks=(3, 4, 6, 3)), keypoints, loss)


def dmanet() -> DMANet:
    """27.7 M parameters and 4.2 GMAC, about the encoder of other direct methods (ResNet-50); its own are not known."""
    return DMANet(DMANetConfig((64, 128, 256, 512), (64, 128, 256, 384), (3, 4, 6, 3), head=1024))


def dmanet_xs() -> DMANet:
    """DMANet's shape at the cost of gknet-xs."""
    return DMANet(DMANetConfig((22, 44, 88, 176), (9, 15, 30, 60), (2, 3, 5, 4), head=192))


def locator() -> Locator:
    """0.7 M parameters, the whole picture at 256x256 -> 64x64 cells."""
    return Locator(LocatorConfig(width=16, pyramid_width=32))


def default_loss(name: str) -> str:
    """The small networks learn a likelihood, those of the paper's sizes its squared error."""
    return "squared" if name in ("gknet-paper", "hrnet", "resunet") else "likelihood"


def build(
    name: str,
    adjacency: Bool[ndarray, "n n"],
    points_m: Float[ndarray, "n 3"],
    graph: str = "skeleton",
    loss: str | None = None,
) -> Network:
    """The network called `name`; `loss` None is its own. Only GKNet has a use for the graph and for where the keypoints
    are on the spacecraft, and heatmaps for the loss."""
    loss = default_loss(name) if loss is None else loss
    match name:
        case "gknet-s":
            return gknet_s(adjacency, points_m, graph, loss)
        case "gknet-xs":
            return gknet_xs(adjacency, points_m, graph, loss)
        case "gknet-paper":
            return gknet_paper(adjacency, graph, loss)
        case "hrnet":
            return hrnet(len(adjacency), loss)
        case "hrnet-xs":
            return hrnet_xs(len(adjacency), loss)
        case "resunet":
            return resunet(len(adjacency), loss)
        case "resunet-xs":
            return resunet_xs(len(adjacency), loss)
        case "dmanet":
            return dmanet()
        case "dmanet-xs":
            return dmanet_xs()
        case "locator":
            return locator()
    raise GknetError(f"network: expected one of {', '.join(NETWORKS)}, got '{name}'")
