"""DMANet, reimplemented from its abstract (Zhao et al. 2024): a pose straight from a picture, without keypoints.

From the abstract: multi-scale attention blocks (MAB) for the features, a network that is dense in them, three branches
for position in the picture's plane, depth and attitude, the attitude by a soft classification based on Euler angles.

Chosen, since nothing more could be retrieved: everything inside an MAB (below), a residual block that leads into each
of four levels and dense connections within it, all widths and depths, how each branch reads the last features, and that
the plane's position and the depth are relative to the crop, so that DMANet sees the crops that keypoint networks see.
What the outputs mean as a pose is in gknet/direct.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.errors import GknetError
from gknet.network.attitude_prior import AttitudeHead
from gknet.network.backbone import POSITION_WIDTH, ConvNorm, ResidualBlock, check_input, normalised, position_encoding
from gknet.network.network import Network

KERNELS = (3, 5, 7)
"""Sides of the depthwise convolutions that look side by side in an MAB: the scales."""


@dataclass(frozen=True)
class DMANetConfig:
    """Sizes of the network.

    width    channels of the residual block that leads into each of the four levels (strides 4 to 32)
    growth   channels that each MAB of a level adds
    blocks   MABs of each level
    head     channels of each branch
    bins     cells of the attitude to a turn of an Euler angle (gknet.inference.attitude.AttitudeBins)
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
    """Which features count in this picture: a gate for each channel from its mean over the picture."""

    def __init__(self, width: int) -> None:
        super().__init__()
        narrow = max(8, width // 4)
        self.gate = nn.Sequential(nn.Conv2d(width, narrow, 1), nn.ReLU(), nn.Conv2d(narrow, width, 1), nn.Sigmoid())

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return x * self.gate(x.mean(dim=(2, 3), keepdim=True))


class SpatialAttention(nn.Module):
    """Which places count: a gate for each cell from the mean and the largest of its channels about it."""

    def __init__(self) -> None:
        super().__init__()
        self.look = nn.Conv2d(2, 1, 7, padding=3)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        summary = torch.cat([x.mean(dim=1, keepdim=True), x.amax(dim=1, keepdim=True)], dim=1)
        return x * torch.sigmoid(self.look(summary))


class MultiScaleAttention(nn.Module):
    """The MAB: depthwise convolutions of several sizes side by side, joined, then attention over channels and places.

    Its result is laid beside what it was given (dense connection): c channels in, c + growth out.
    """

    def __init__(self, inputs: int, growth: int) -> None:
        super().__init__()
        self.enter = ConvNorm(inputs, growth, 1)
        self.scales = nn.ModuleList([ConvNorm(growth, growth, kernel, groups=growth) for kernel in KERNELS])
        self.join = ConvNorm(len(KERNELS) * growth, growth, 1)
        self.channels, self.places = ChannelAttention(growth), SpatialAttention()

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        entered = self.enter(x)
        seen = self.join(torch.cat([scale(entered) for scale in self.scales], dim=1))
        return torch.cat([x, self.places(self.channels(seen))], dim=1)


class Branches(NamedTuple):
    """What the three branches say, as the loss sees it: (b, 2), (b,) and (b, k) logits of the attitude's cells."""

    offset: Tensor
    log_depth: Tensor
    attitude: Tensor


class DMANet(Network):
    """Image -> (b, 3 + k): offset x and y, log_depth, and the belief in each of k cells of attitude, summing to 1."""

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
        self.place = nn.Linear(POSITION_WIDTH, inputs)
        self.votes = nn.Sequential(ConvNorm(inputs, config.head, 1), nn.Conv2d(config.head, 3, 1))
        self.depth_cells = ConvNorm(inputs, config.head, 1)
        self.depth = nn.Linear(config.head, 1)
        self.attitude = AttitudeHead(inputs, config.head, config.bins**3 // 2)

    def branches(self, image: Float[Tensor, "b 3 h w"]) -> Branches:
        check_input(image)
        x = self.stem(normalised(image))
        for level in self.levels:
            x = level(x)
        code = position_encoding(x.shape[2], x.shape[3], x)
        x = x + self.place(code.permute(1, 2, 0)).permute(2, 0, 1)  # a mean over cells would forget where they are
        depth = self.depth(self.depth_cells(x).mean(dim=(2, 3)))[:, 0]
        return Branches(self._offset(self.votes(x).float()), depth.float(), self.attitude(x))

    @staticmethod
    def _offset(votes: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 2"]:
        """The mean of the cells' votes for the origin, each from its own centre; the first channel weighs them."""
        height, width = votes.shape[2:]
        x = (torch.arange(width, device=votes.device) + 0.5) / width - 0.5
        y = (torch.arange(height, device=votes.device) + 0.5) / height - 0.5
        centres = torch.stack([x.expand(height, -1), y[:, None].expand(-1, width)])  # (2, h, w) in sides of the crop
        weight = votes[:, :1].flatten(2).softmax(dim=2)
        return (weight * (centres + votes[:, 1:]).flatten(2)).sum(dim=2)

    def predict(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        """RGB in 0 to 1 -> what `gknet.inference.direct_estimator.decode_output` reads."""
        offset, log_depth, attitude = self.branches(image)
        return (torch.cat([offset, log_depth[:, None], functional.softmax(attitude, dim=1)], dim=1),)
