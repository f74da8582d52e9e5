"""GKNet as the paper describes it, as large as the authors' (about 90 M parameters).

The flow of data, for b images of h x w with n keypoints:

    image (b, 3, h, w)
      |
    down: U-Net encoder -> skips at strides 1 to 16, F (b, 1024, h/32, w/32)
      |-- up: U-Net decoder -> F' (b, 64, h, w) -> pixel_head -> F'' (b, n, h/8, w/8)        eq. 1
      |-- cells of F + position -> memory (b, h/32 w/32, 512)
      |     GraphDecoder: eq. 2 and 3 -> nodes (b, n, 512) -> node_map -> (b, n, 32, 32), resized to h/8 x w/8
    Fusion -> fused maps (b, n, h/8, w/8)

The paper does not state the channels (here 64 to 1024), the convolutions per level (two of 3x3), the skips (at every
level), the step from F' to F'' (an 8x8 convolution of stride 8), or the size of the graph branch (three layers of 512
channels, C_out = H W, so that a node's output is the map of its keypoint).

The paper makes the nodes from F by one reshaping, which fixes their number, and takes the linear layer behind eq. 2
from GraphCape. The nodes here follow GraphCape too: one learnt query per keypoint attends to the cells of F (with their
positions) before each graph layer, with residuals and LayerNorms around both. W_adj has a bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor, nn
from torch.nn import functional

from gknet.network.backbone import POSITION_WIDTH, ConvNorm, check_input, normalised, position_encoding
from gknet.network.graph import Fusion, GraphDecoder, normalised_adjacency
from gknet.network.heatmap import HeatmapBranches, HeatmapNetwork
from gknet.network.spec import checked_graph

PAPER_INPUT = 256
"""Side of the input in pixels, for which a node's output is its map, cell by cell; other inputs resize it."""


@dataclass(frozen=True)
class GKNetPaperConfig:
    """Sizes of the network.

    Attributes:
        base: Channels at full resolution.
        node_width: Channels of a graph node.
        node_hidden: Channels of the graph convolution (eq. 2).
        node_layers: Layers of the graph decoder.
        heads: Attention heads.
        graph: As in `gknet.network.gknet.GKNetConfig`.
    """

    base: int = 64
    node_width: int = 512
    node_hidden: int = 2048
    node_layers: int = 3
    heads: int = 8
    graph: str = "skeleton"

    def __post_init__(self) -> None:
        checked_graph(self.graph)


def _level(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(ConvNorm(inputs, outputs), ConvNorm(outputs, outputs))


class GKNetPaper(HeatmapNetwork):
    """Image -> one heatmap per keypoint at an eighth of the input's resolution: 256 -> 32."""

    def __init__(self, config: GKNetPaperConfig, adjacency: Bool[ndarray, "n n"], loss: str = "squared") -> None:
        super().__init__(loss, stride=8)
        self.config = config
        keypoints = len(adjacency)
        widths = [config.base * factor for factor in (1, 2, 4, 8, 16, 16)]
        self.down = nn.ModuleList([_level(i, o) for i, o in zip([3, *widths[:-1]], widths, strict=True)])
        self.up = nn.ModuleList(
            [_level(below + skip, skip) for below, skip in zip(widths[:0:-1], widths[-2::-1], strict=True)]
        )
        self.pixel_head = nn.Conv2d(widths[0], keypoints, self.stride, self.stride)
        nn.init.normal_(self.pixel_head.weight, std=1e-3)
        self.decoder: GraphDecoder | None = None
        if config.graph != "none":
            edges = normalised_adjacency(adjacency, checked_graph(config.graph))
            width = config.node_width
            self.cells = nn.Conv2d(widths[-1], width, 1)
            self.position = nn.Linear(POSITION_WIDTH, width)
            self.decoder = GraphDecoder(edges, width, config.node_hidden, config.heads, config.node_layers)
            self.map_side = PAPER_INPUT // self.stride
            self.node_map = nn.Linear(width, self.map_side**2)
            nn.init.normal_(self.node_map.weight, std=1e-4)
            self.fusion = Fusion(keypoints)

    def branches(self, image: Float[Tensor, "b 3 h w"]) -> HeatmapBranches:
        check_input(image)
        x = normalised(image)
        skips = []
        for level, block in enumerate(self.down):
            x = block(functional.max_pool2d(x, 2) if level else x)
            skips.append(x)
        coarse = skips.pop()  # F, stride 32
        x = coarse
        for block, skip in zip(self.up, reversed(skips), strict=True):
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0, mode="nearest"), skip], dim=1))
        pixels = self.pixel_head(x)  # eq. 1
        if self.decoder is None:
            return HeatmapBranches(pixels, pixels, None)
        nodes = self._node_maps(coarse, pixels)
        return HeatmapBranches(self.fusion(pixels, nodes), pixels, nodes)

    def _node_maps(self, coarse: Float[Tensor, "b c h w"], pixels: Tensor) -> Float[Tensor, "b n h8 w8"]:
        assert self.decoder is not None
        code = position_encoding(coarse.shape[2], coarse.shape[3], coarse).flatten(1).T
        memory = self.cells(coarse).permute(0, 2, 3, 1).flatten(1, 2) + self.position(code)
        maps = self.node_map(self.decoder(memory))
        maps = maps.reshape(maps.shape[0], -1, self.map_side, self.map_side)
        if maps.shape[2:] == pixels.shape[2:]:
            return maps
        return functional.interpolate(maps, size=pixels.shape[2:], mode="bilinear")
