"""The list of networks: each is one file in this folder, one builder and one entry of NETWORKS.

Builders import what they build, so that reading the list loads no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxtyping import Bool, Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.network.spec import NetworkOptions, NetworkSpec, Stage, checked_graph, checked_loss

if TYPE_CHECKING:
    from gknet.network.dmanet import DMANet
    from gknet.network.gknet import GKNet
    from gknet.network.gknet_paper import GKNetPaper
    from gknet.network.hrnet import HRNet
    from gknet.network.locator import Locator
    from gknet.network.network import Network
    from gknet.network.resunet import ResUNet

PAPER_STRIDE = 8
"""The paper holds every method to heatmaps of 32x32 at 256x256."""

SMALL_FIRST = (Stage(0.4, 128, 32), Stage(0.3, 192, 32), Stage(0.3, 256, 32))
"""Small images first: most of what there is to learn is learnt there, at a quarter of the cost."""

PAPER_STAGES = (Stage(1.0, 256, 16),)
LOCATOR_STAGES = (Stage(0.4, 128, 32), Stage(0.6, 256, 32))


def gknet_s(options: NetworkOptions) -> GKNet:
    """The one that ships: 3.6 M parameters and 0.9 GMAC at 256, 256 -> 64x64.

    Without its graph branch it is widened to the same parameters, so that the ablation is one of the graph.
    """
    from gknet.network.gknet import GKNet, GKNetConfig

    width = 34 if options.graph == "none" else 32
    config = GKNetConfig(
        width=width, pyramid_width=48, node_width=128, node_layers=3, heads=4, bins=12, graph=options.graph
    )
    return GKNet(config, options.adjacency, options.points_m, options.loss)


def gknet_xs(options: NetworkOptions) -> GKNet:
    """The one to compare methods with on a CPU: 1.0 M parameters and 0.26 GMAC at 256, 256 -> 64x64.

    Without its graph branch it is widened as `gknet_s` is.
    """
    from gknet.network.gknet import GKNet, GKNetConfig

    width, pyramid_width = (17, 32) if options.graph == "none" else (16, 24)
    config = GKNetConfig(width, pyramid_width, node_width=64, node_layers=3, heads=4, bins=12, graph=options.graph)
    return GKNet(config, options.adjacency, options.points_m, options.loss)


def gknet_paper(options: NetworkOptions) -> GKNetPaper:
    """The paper's own sizes: 89 M parameters and 64 GMAC, 256 -> 32x32."""
    from gknet.network.gknet_paper import GKNetPaper, GKNetPaperConfig

    config = GKNetPaperConfig(base=64, node_width=512, node_hidden=2048, node_layers=3, heads=8, graph=options.graph)
    return GKNetPaper(config, options.adjacency, options.loss)


def hrnet(options: NetworkOptions) -> HRNet:
    """HRNet-W32: 28.6 M parameters and 10 GMAC, held to 32x32 as in the paper."""
    from gknet.network.hrnet import HRNet, HRNetConfig

    config = HRNetConfig(width=32, stem_width=64, bottlenecks=4, modules=(1, 4, 3), blocks=4)
    return HRNet(config, options.keypoint_count, options.loss, PAPER_STRIDE)


def hrnet_xs(options: NetworkOptions) -> HRNet:
    """The shape of its authors' HRNet-Small-v2 at the cost of gknet-xs, 256 -> 64x64.

    W32's depth would leave 5 channels to the finest branch, and take twice as long to train.
    """
    from gknet.network.hrnet import HRNet, HRNetConfig

    config = HRNetConfig(width=8, stem_width=12, bottlenecks=2, modules=(1, 3, 2), blocks=2)
    return HRNet(config, options.keypoint_count, options.loss)


def resunet(options: NetworkOptions) -> ResUNet:
    """ResNet-34 U-Net: 24 M parameters and 6 GMAC, held to 32x32 as in the paper."""
    from gknet.network.resunet import ResUNet, ResUNetConfig

    config = ResUNetConfig(width=64, blocks=(3, 4, 6, 3))
    return ResUNet(config, options.keypoint_count, options.loss, PAPER_STRIDE)


def resunet_xs(options: NetworkOptions) -> ResUNet:
    """ResUNet's shape at the cost of gknet-xs, 256 -> 64x64."""
    from gknet.network.resunet import ResUNet, ResUNetConfig

    return ResUNet(ResUNetConfig(width=12, blocks=(3, 4, 6, 3)), options.keypoint_count, options.loss)


def dmanet(options: NetworkOptions) -> DMANet:
    """27.7 M parameters and 4.2 GMAC, about the encoder of other direct methods (ResNet-50); its own are not known."""
    from gknet.network.dmanet import DMANet, DMANetConfig

    return DMANet(DMANetConfig((64, 128, 256, 512), (64, 128, 256, 384), (3, 4, 6, 3), head=1024))


def dmanet_xs(options: NetworkOptions) -> DMANet:
    """DMANet's shape at the cost of gknet-xs."""
    from gknet.network.dmanet import DMANet, DMANetConfig

    return DMANet(DMANetConfig((22, 44, 88, 176), (9, 15, 30, 60), (2, 3, 5, 4), head=192))


def locator(options: NetworkOptions) -> Locator:
    """0.7 M parameters, the whole image at 256x256 -> 64x64 cells."""
    from gknet.network.locator import Locator, LocatorConfig

    return Locator(LocatorConfig(width=16, pyramid_width=32))


NETWORKS: dict[str, NetworkSpec] = {
    "gknet-s": NetworkSpec("keypoints", gknet_s, SMALL_FIRST, "likelihood", has_graph=True),
    "gknet-xs": NetworkSpec("keypoints", gknet_xs, SMALL_FIRST, "likelihood", has_graph=True),
    "hrnet-xs": NetworkSpec("keypoints", hrnet_xs, SMALL_FIRST, "likelihood"),
    "resunet-xs": NetworkSpec("keypoints", resunet_xs, SMALL_FIRST, "likelihood"),
    "dmanet-xs": NetworkSpec("direct", dmanet_xs, SMALL_FIRST),
    "gknet-paper": NetworkSpec("keypoints", gknet_paper, PAPER_STAGES, "squared", has_graph=True),
    "hrnet": NetworkSpec("keypoints", hrnet, PAPER_STAGES, "squared"),
    "resunet": NetworkSpec("keypoints", resunet, PAPER_STAGES, "squared"),
    "dmanet": NetworkSpec("direct", dmanet, PAPER_STAGES),
    "locator": NetworkSpec("locator", locator, LOCATOR_STAGES),
}
"""Every network that can be trained, by the name that `gknet train --network` takes."""


def spec_of(name: str) -> NetworkSpec:
    """The entry of NETWORKS.

    Raises:
        GknetError: There is no network of that name.
    """
    if name not in NETWORKS:
        raise GknetError(f"network: expected one of {', '.join(NETWORKS)}, got '{name}'")
    return NETWORKS[name]


def build(
    name: str,
    adjacency: Bool[ndarray, "n n"],
    points_m: Float[ndarray, "n 3"],
    graph: str = "skeleton",
    loss: str | None = None,
) -> Network:
    """The network called `name`, with fresh weights.

    Args:
        name: A key of NETWORKS.
        adjacency: (n, n), True where two keypoints share an edge of the skeleton, and on the diagonal.
        points_m: (n, 3) keypoints in metres, in the body frame.
        graph: Edges of the graph branch; of no effect on a network without one.
        loss: Of a keypoint network; None is its own.

    Raises:
        GknetError: There is no such network, graph or loss.
    """
    spec = spec_of(name)
    chosen = checked_loss(loss or spec.loss or "likelihood")
    return spec.builder(NetworkOptions(adjacency, points_m, checked_graph(graph), chosen))
