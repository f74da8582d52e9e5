"""HRNet: parallel branches at four resolutions that exchange at every module, the finest never given up.

Sun et al. 2019 for the network, Chen et al. 2019 for spacecraft landmarks; W32 is their size. At 256x256 its heatmaps
are 64x64; the paper under reproduction holds every method to 32x32, which is `stride=8`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gknet.errors import GknetError
from gknet.network.backbone import ConvNorm, ResidualBlock, check_input, normalised
from gknet.network.heatmap import HeatmapBranches, HeatmapNetwork


@dataclass(frozen=True)
class HRNetConfig:
    """Sizes of the network; the defaults are HRNet-W32.

    Attributes:
        width: Channels of the finest branch; each coarser one has twice as many.
        stem_width: Channels of the stem; its bottlenecks have four times as many outside.
        bottlenecks: Of the first stage, which has one branch.
        modules: Of the second, third and fourth stage, which have two, three and four branches.
        blocks: Residual blocks of a branch in a module.
    """

    width: int = 32
    stem_width: int = 64
    bottlenecks: int = 4
    modules: tuple[int, int, int] = (1, 4, 3)
    blocks: int = 4

    def __post_init__(self) -> None:
        if min(self.width, self.stem_width, self.bottlenecks, self.blocks, *self.modules) < 1:
            raise GknetError(f"hrnet: expected sizes of at least 1, got {self}")


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions around a shortcut, four times as wide outside (He et al. 2016)."""

    def __init__(self, inputs: int, inner: int) -> None:
        super().__init__()
        outputs = 4 * inner
        self.body = nn.Sequential(
            ConvNorm(inputs, inner, 1), ConvNorm(inner, inner, 3), ConvNorm(inner, outputs, 1, relu=False)
        )
        self.shortcut = nn.Identity() if inputs == outputs else ConvNorm(inputs, outputs, 1, relu=False)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        return functional.relu(self.body(x) + self.shortcut(x), inplace=True)


class Exchange(nn.Module):
    """The finest `targets` branches receive the sum of all: 1x1 and up-sampling from coarser ones, strided 3x3 from
    finer ones."""

    def __init__(self, widths: list[int], targets: int) -> None:
        super().__init__()
        self.paths = nn.ModuleList(
            [
                nn.ModuleList([self._path(widths, source, target) for source in range(len(widths))])
                for target in range(targets)
            ]
        )

    @staticmethod
    def _path(widths: list[int], source: int, target: int) -> nn.Module:
        if source == target:
            return nn.Identity()
        if source > target:  # coarser to finer
            scale = float(2 ** (source - target))
            return nn.Sequential(
                ConvNorm(widths[source], widths[target], 1, relu=False), nn.Upsample(scale_factor=scale)
            )
        steps: list[nn.Module] = [ConvNorm(widths[source], widths[source], 3, 2) for _ in range(target - source - 1)]
        return nn.Sequential(*steps, ConvNorm(widths[source], widths[target], 3, 2, relu=False))

    def forward(self, branches: list[Tensor]) -> list[Tensor]:
        received = []
        for paths in self.paths:
            sent = [path(branch) for path, branch in zip(cast(nn.ModuleList, paths), branches, strict=True)]
            received.append(functional.relu(reduce(torch.add, sent)))
        return received


class ParallelModule(nn.Module):
    """Residual blocks in each branch, then one exchange, behind which `targets` branches go on."""

    def __init__(self, widths: list[int], blocks: int, targets: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            [nn.Sequential(*[ResidualBlock(width, width, 1) for _ in range(blocks)]) for width in widths]
        )
        self.exchange = Exchange(widths, targets)

    def forward(self, branches: list[Tensor]) -> list[Tensor]:
        return self.exchange([body(branch) for body, branch in zip(self.branches, branches, strict=True)])


class HRNet(HeatmapNetwork):
    """Image -> one heatmap per keypoint at a quarter or an eighth of the input's resolution."""

    def __init__(self, config: HRNetConfig, keypoints: int, loss: str = "likelihood", stride: int = 4) -> None:
        super().__init__(loss, stride)
        self.config = config
        stem, outer = config.stem_width, 4 * config.stem_width
        self.stem = nn.Sequential(ConvNorm(3, stem, 3, 2), ConvNorm(stem, stem, 3, 2))
        self.first = nn.Sequential(*[Bottleneck(stem if k == 0 else outer, stem) for k in range(config.bottlenecks)])
        widths = [config.width * 2**level for level in range(4)]
        self.begin = ConvNorm(outer, widths[0], 3)
        inputs = [outer, *widths[1:3]]
        self.new_branches = nn.ModuleList([ConvNorm(i, o, 3, 2) for i, o in zip(inputs, widths[1:], strict=True)])
        self.stages = nn.ModuleList()
        for branches, count in zip((2, 3, 4), config.modules, strict=True):
            kept = [branches] * count
            if branches == 4:
                kept[-1] = 1  # nothing but the finest branch is read from
            self.stages.append(nn.ModuleList([ParallelModule(widths[:branches], config.blocks, k) for k in kept]))
        self.narrow = ConvNorm(widths[0], widths[0], 3, 2) if stride == 8 else nn.Identity()
        self.head = nn.Conv2d(widths[0], keypoints, 1)
        nn.init.normal_(self.head.weight, std=0.001)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def branches(self, image: Float[Tensor, "b 3 h w"]) -> HeatmapBranches:
        check_input(image)
        x = self.first(self.stem(normalised(image)))
        streams, coarsest = [self.begin(x)], x
        for new_branch, modules in zip(self.new_branches, self.stages, strict=True):
            streams = [*streams, new_branch(coarsest)]
            for module in cast(nn.ModuleList, modules):
                streams = module(streams)
            coarsest = streams[-1]
        maps = self.head(self.narrow(streams[0]))
        return HeatmapBranches(maps, maps, None)
