"""DMANet, reimplemented from its abstract (Zhao et al. 2024): direct pose regression from an image, without keypoints.

    image (b, 3, h, w)
      |
    stem -> stride 4
    levels at strides 4, 8, 16 and 32: a residual block, then multi-scale attention blocks (MAB) with dense connections
      |
    features (b, d, h/32, w/32) + position
      |-- offset_cells -> votes of the cells for the origin, weighted mean -> offset (b, 2)
      |-- depth_cells  -> mean over the cells -> log_depth (b,)
      |-- attitude     -> mean over the cells -> logits of the attitude classes (b, k)

From the abstract: multi-scale attention blocks for the features, densely connected; three branches for the position in
the image plane, the depth and the attitude; the attitude by a soft classification based on Euler angles.

Chosen, since nothing more could be retrieved: everything inside an MAB (below), the residual block that leads into each
of the four levels and dense connections within them, all widths and depths, how each branch reads the last features,
and that the position and the depth are relative to the crop, so that DMANet receives the same crops as keypoint
networks. What the outputs mean as a pose is in gknet/inference/direct_estimator.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gknet.errors import GknetError
from gknet.network.attitude_prior import AttitudeHead
from gknet.network.backbone import (
    POSITION_WIDTH,
    ConvNorm,
    ResidualBlock,
    cell_centres,
    check_input,
    normalised,
    position_encoding,
)
from gknet.network.direct_pose import DirectNetwork, PoseBranches

KERNELS = (3, 5, 7)
"""Sides of the parallel depthwise convolutions in an MAB: the scales."""


@dataclass(frozen=True)
class DMANetConfig:
    """Sizes of the network.

    Attributes:
        width: Channels of the residual block that leads into each of the four levels (strides 4 to 32).
        growth: Channels that each MAB of a level adds.
        blocks: MABs of each level.
        head: Channels of each branch.
        bins: Cells per turn of the attitude (`gknet.inference.attitude.AttitudeBins`).
    """

    width: tuple[int, int, int, int]
    growth: tuple[int, int, int, int]
    blocks: tuple[int, int, int, int]
    head: int
    bins: int = 16

    def __post_init__(self) -> None:
        if min(self.head, *self.width, *self.growth, *self.blocks) < 1:
            raise GknetError(f"dmanet: expected sizes of at least 1, got {self}")
        if self.bins < 4 or self.bins % 2:
            raise GknetError(f"dmanet: expected an even number of bins of 4 or more, got {self.bins}")


class ChannelAttention(nn.Module):
    """A gate in 0 to 1 for each channel, from its mean over the image."""

    def __init__(self, width: int) -> None:
        super().__init__()
        narrow = max(8, width // 4)
        self.gate = nn.Sequential(nn.Conv2d(width, narrow, 1), nn.ReLU(), nn.Conv2d(narrow, width, 1), nn.Sigmoid())

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return x * self.gate(x.mean(dim=(2, 3), keepdim=True))


class SpatialAttention(nn.Module):
    """A gate in 0 to 1 for each cell, from the mean and the largest of the channels around it."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(2, 1, 7, padding=3)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        summary = torch.cat([x.mean(dim=1, keepdim=True), x.amax(dim=1, keepdim=True)], dim=1)
        return x * torch.sigmoid(self.conv(summary))


class MultiScaleAttention(nn.Module):
    """The MAB: parallel depthwise convolutions of several sizes, joined, then attention over channels and cells.

    Its result is appended to its input (dense connection): (b, inputs, h, w) -> (b, inputs + growth, h, w).
    """

    def __init__(self, inputs: int, growth: int) -> None:
        super().__init__()
        self.enter = ConvNorm(inputs, growth, 1)
        self.scales = nn.ModuleList([ConvNorm(growth, growth, kernel, groups=growth) for kernel in KERNELS])
        self.join = ConvNorm(len(KERNELS) * growth, growth, 1)
        self.channel_attention, self.spatial_attention = ChannelAttention(growth), SpatialAttention()

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        entered = self.enter(x)
        joined = self.join(torch.cat([scale(entered) for scale in self.scales], dim=1))
        return torch.cat([x, self.spatial_attention(self.channel_attention(joined))], dim=1)


class DMANet(DirectNetwork):
    """Image -> offset, log_depth and attitude, relative to the crop."""

    def __init__(self, config: DMANetConfig) -> None:
        super().__init__()
        self.config = config
        self.attitude_bins = config.bins
        inputs = config.width[0]
        self.stem = nn.Sequential(ConvNorm(3, inputs, 7, 2), nn.MaxPool2d(3, 2, 1))
        self.levels = nn.ModuleList()
        for level, (width, growth, blocks) in enumerate(zip(config.width, config.growth, config.blocks, strict=True)):
            mabs = [MultiScaleAttention(width + block * growth, growth) for block in range(blocks)]
            self.levels.append(nn.Sequential(ResidualBlock(inputs, width, 2 if level else 1), *mabs))
            inputs = width + blocks * growth
        self.position = nn.Linear(POSITION_WIDTH, inputs)
        self.offset_cells = nn.Sequential(ConvNorm(inputs, config.head, 1), nn.Conv2d(config.head, 3, 1))
        self.depth_cells = ConvNorm(inputs, config.head, 1)
        self.depth = nn.Linear(config.head, 1)
        self.attitude = AttitudeHead(inputs, config.head, config.bins**3 // 2)

    def branches(self, image: Float[Tensor, "b 3 h w"]) -> PoseBranches:
        check_input(image)
        x = self.stem(normalised(image))
        for level in self.levels:
            x = level(x)
        encoding = position_encoding(x.shape[2], x.shape[3], x)
        x = x + self.position(encoding.permute(1, 2, 0)).permute(2, 0, 1)  # a mean over cells would lose the position
        depth = self.depth(self.depth_cells(x).mean(dim=(2, 3)))[:, 0]
        return PoseBranches(self._offset(self.offset_cells(x).float()), depth.float(), self.attitude(x))

    @staticmethod
    def _offset(cells: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 2"]:
        """The weighted mean of the cells' votes for the origin, each relative to the cell's own centre.

        The first channel has the logits of the weights, the other two the votes in sides of the crop.
        """
        height, width = cells.shape[2:]
        centres = cell_centres(height, width, cells).permute(2, 0, 1) - 0.5  # (2, h, w) in sides of the crop
        weight = cells[:, :1].flatten(2).softmax(dim=2)
        return (weight * (centres + cells[:, 1:]).flatten(2)).sum(dim=2)
